"""What an SRCKF learns from all measurements that may be a target's, by their probabilities."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra.adaptive.fading import Memory
from torchfra.adaptive.noise import NominalNoise
from torchfra.association.clusters import Association
from torchfra.filters.scans.hypotheses import Scan, gated, likeliest, missed_or_measured, weighted_mean
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import missed_or_hit, moment_match
from torchfra.gaussian.model import canonical
from torchfra.linalg.safe import safe_divide
from torchfra.types import Gaussian, Prediction, Whitened


def learned(
    side: NominalNoise, memory: Any, whitened: Whitened, when: str, *, association: Association, frame: Frame,
    share_noise: bool,
) -> Any:  # fmt: skip
    """The memory of the measurement noise after a scan, if ``when`` is when the inner filter learns: eq. (19).

    Args:
        side: of the inner filter.
        memory: before.
        whitened: the measurements.
        when: ``"innovation"`` or ``"residual"``.
        association: which of them is whose.
        frame: of the scan.
        share_noise: whether all targets share the estimate.
    """
    share = association.probabilities
    if side.adapt != when:
        return memory
    memory = side(memory, *weighted_mean(side.excess(whitened), share, frame.measured))
    if not share_noise:
        return memory
    measured = share.sum(-1)[..., None, None]  # how probably each target was
    total = measured.sum(-3, keepdim=True)
    mean = safe_divide((measured * memory.scale).sum(-3, keepdim=True), total)
    return memory._replace(scale=torch.where(total >= 0.5, mean, memory.scale))


def widen(
    f: SRCKF, prediction: Prediction, known: Whitened, memory: Memory | None, scan: Scan, association: Association,
    frame: Frame,
) -> tuple[Prediction, Whitened, Memory | None, Tensor | None]:  # fmt: skip
    """Prediction and measurements with fading factors, the innovations remembered, and the factors ``(..., N)``."""
    if memory is None:
        return prediction, known, None, None
    share = association.probabilities
    residual, total = weighted_mean(known.residual, share, frame.measured)
    memory = f.fading.remember(memory, residual, (total >= 0.5).to(residual))
    nearest = likeliest(share, known)
    nis = scan.candidates.nis.gather(-1, share.argmax(-1, keepdim=True))
    factor = f.fading(prediction, nearest, memory, f.robust(nearest.residual, nis))
    factor = torch.where(total.amax(-1) >= 0.5, factor, 1.0)  # nothing was measured that could ask for it
    prediction = f.fading.inflate(prediction, factor)
    return prediction, f.compare(prediction.belief, frame), memory, factor.squeeze(-1)


def update(
    f: SRCKF, predicted: Gaussian, known: Whitened, scan: Scan, association: Association, frame: Frame
) -> tuple[Gaussian, Tensor | None]:
    """The Gaussian with the moments of all that may have happened, and the weights of a robust filter."""
    robust, log_weights = f.robust, association.log_weights
    if robust.plain:
        log_weights, known = gated(log_weights, known)
    weights = robust(known.residual, scan.candidates.nis)
    each = robust.correct(predicted, known, weights, frame.measurement_noise)
    if each.belief.scale_tril.shape[-3] == 1:
        belief = missed_or_hit(predicted, each.belief, log_weights)
    else:
        belief = moment_match(missed_or_measured(predicted, each.belief), log_weights.movedim(-1, 0))
    return canonical(f.motion, belief), None if robust.plain else weights
