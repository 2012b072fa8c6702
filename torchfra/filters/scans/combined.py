"""Updates of an SRCKF by all measurements that may be a target's, weighted by their association probabilities."""

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
    estimate: NominalNoise, memory: Any, whitened: Whitened, when: str, *, association: Association, frame: Frame,
    share_noise: bool,
) -> Any:  # fmt: skip
    """The memory of the noise estimate after a scan, if ``when`` equals its ``adapt``; else as it is: eq. (19).

    Args:
        estimate: the noise estimate of the inner filter.
        memory: before the scan.
        whitened: the measurements.
        when: ``"innovation"`` or ``"residual"``.
        association: of targets and measurements.
        frame: of the scan.
        share_noise: whether all targets share the estimate.
    """
    share = association.probabilities
    if estimate.adapt != when:
        return memory
    memory = estimate(memory, *weighted_mean(estimate.excess(whitened), share, frame.measured))
    if not share_noise:
        return memory
    measured = share.sum(-1)[..., None, None]  # probability that each target was measured
    total = measured.sum(-3, keepdim=True)
    mean = safe_divide((measured * memory.scale).sum(-3, keepdim=True), total)
    return memory._replace(scale=torch.where(total >= 0.5, mean, memory.scale))


def fade(
    f: SRCKF, prediction: Prediction, rescaled: Whitened, memory: Memory | None, scan: Scan, association: Association,
    frame: Frame,
) -> tuple[Prediction, Whitened, Memory | None, Tensor | None]:  # fmt: skip
    """Prediction and measurements with fading factors, the memory of innovations, and the factors ``(..., N)``."""
    if memory is None:
        return prediction, rescaled, None, None
    share = association.probabilities
    residual, total = weighted_mean(rescaled.residual, share, frame.measured)
    memory = f.fading.remember(memory, residual, (total >= 0.5).to(residual))
    nearest = likeliest(share, rescaled)
    nis = scan.candidates.nis.gather(-1, share.argmax(-1, keepdim=True))
    factor = f.fading(prediction, nearest, memory, f.robust(nearest.residual, nis))
    factor = torch.where(total.amax(-1) >= 0.5, factor, 1.0)  # 1 if the target was probably missed
    prediction = f.fading.inflate(prediction, factor)
    return prediction, f.compare(prediction.belief, frame), memory, factor.squeeze(-1)


def update(
    f: SRCKF, predicted: Gaussian, rescaled: Whitened, scan: Scan, association: Association, frame: Frame
) -> tuple[Gaussian, Tensor | None]:
    """The Gaussian with the moments of all association hypotheses, and the weights of a robust filter."""
    robust, log_weights = f.robust, association.log_weights
    if robust.plain:
        log_weights, rescaled = gated(log_weights, rescaled)
    weights = robust(rescaled.residual, scan.candidates.nis)
    each = robust.correct(predicted, rescaled, weights, frame.measurement_noise)
    if each.belief.scale_tril.shape[-3] == 1:
        belief = missed_or_hit(predicted, each.belief, log_weights)
    else:
        belief = moment_match(missed_or_measured(predicted, each.belief), log_weights.movedim(-1, 0))
    return canonical(f.motion, belief), None if robust.plain else weights
