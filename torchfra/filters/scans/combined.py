"""Updates of an SRCKF by all measurements that may be a target's, weighted by their association probabilities."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.adaptive.fading import Memory
from torchfra.adaptive.noise import NoiseMemory, SageHusa
from torchfra.association.clusters import Association
from torchfra.filters.scans.scan import Scan, chosen, gated_first
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.model import canonical
from torchfra.gaussian.update import correct
from torchfra.linalg.safe import safe_divide, safe_sqrt
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import hstack, tria
from torchfra.types import Gaussian, Prediction, Whitened


def learn_noise(
    estimate: SageHusa | None, memory: NoiseMemory | None, whitened: Whitened, when: str, *, association: Association,
    frame: Frame,
) -> NoiseMemory | None:  # fmt: skip
    """The memory of the noise estimate after a scan, if ``when`` equals its ``adapt``; else unchanged.

    Equation numbers are those of Chen, Zou & Wu; this is their eq. (19).

    Args:
        estimate: the noise estimate of the inner filter; None for none.
        memory: before the scan.
        whitened: the measurements.
        when: ``"innovation"`` or ``"residual"``.
        association: of targets and measurements.
        frame: of the scan.
    """
    share = association.probabilities
    if estimate is None or memory is None or estimate.adapt != when:
        return memory
    return estimate.forward(memory, *weighted_mean(estimate.excess(whitened), share, frame.measured))


def fade(
    f: SRCKF, prediction: Prediction, rescaled: Whitened, memory: Memory | None, scan: Scan, association: Association,
    frame: Frame,
) -> tuple[Prediction, Whitened, Memory | None, Tensor | None]:  # fmt: skip
    """Prediction and measurements with fading factors, the memory of innovations, and the factors ``(..., N)``."""
    if f.fading is None or memory is None:
        return prediction, rescaled, None, None
    share = association.probabilities
    residual, total = weighted_mean(rescaled.residual, share, frame.measured)
    memory = f.fading.remember(memory, residual, (total >= 0.5).to(residual))
    nearest = likeliest(share, rescaled)
    nis = scan.candidates.nis.gather(-1, share.argmax(-1, keepdim=True))
    weights = torch.ones_like(nearest.residual) if f.robust is None else f.robust(nearest.residual, nis)
    factor = f.fading(prediction, nearest, memory, weights)
    factor = torch.where(total.amax(-1) >= 0.5, factor, 1.0)  # 1 if the target was probably missed
    prediction = f.faded(prediction, factor)
    return prediction, f.compare(prediction.belief, frame), memory, factor.squeeze(-1)


def update(
    f: SRCKF, predicted: Gaussian, rescaled: Whitened, scan: Scan, association: Association, frame: Frame
) -> tuple[Gaussian, Tensor | None]:
    """The Gaussian with the moments of all association hypotheses, and the weights of a robust filter."""
    log_weights, weights = association.log_weights, None
    if f.robust is None:
        log_weights, rescaled = gated(log_weights, rescaled)
        each, _, _ = correct(predicted, rescaled)
    else:
        weights = f.robust(rescaled.residual, scan.candidates.nis)
        each = f.robust.correct(predicted, rescaled, weights, frame.measurement_noise).belief
    if each.scale_tril.shape[-3] == 1:
        belief = moments_with_one_root(predicted, each, log_weights)
    else:
        belief = moment_match(missed_or_measured(predicted, each), log_weights.movedim(-1, 0))
    return canonical(f.motion, belief), weights


def missed_or_measured(predicted: Gaussian, each: Gaussian) -> Gaussian:
    """Beliefs ``(J + 1, ..., N)`` of the association hypotheses: missed, or one of the measurements ``(..., N, J)``."""
    mean = torch.cat([predicted.mean.expand_as(each.mean[..., :1, :]), each.mean], -2)
    root = torch.cat([predicted.scale_tril.expand_as(each.scale_tril[..., :1, :, :]), each.scale_tril], -3)
    return Gaussian(mean.movedim(-2, 0), root.movedim(-3, 0))


def moments_with_one_root(predicted: Gaussian, each: Gaussian, log_weights: Tensor) -> Gaussian:
    """The moments of all association hypotheses where the measurements leave one posterior covariance ``S S^T``.

    The covariance is that of the probabilistic data association filter, ``w_0 P- + (1 - w_0) P_c`` plus the spread of
    the means, by its root: ``tria([sqrt(w_0) S-, sqrt(w_1 + ... + w_J) S, sqrt(w_i) (mean_i - mean)])``.

    Args:
        predicted: ``(..., 1)`` the belief if the target was missed.
        each: means ``(..., J, n)``, root ``(..., 1, n, n)``.
        log_weights: ``(..., J + 1)``; minus infinity for a belief of zero weight, which may then be NaN.

    Source: Bar-Shalom & Fortmann (1988), "Tracking and Data Association", section 6.4.
    """
    root = (0.5 * log_weights).exp()
    weight = root.square()
    means = torch.cat([x.expand(*log_weights.shape[:-1], -1, -1) for x in (predicted.mean, each.mean)], -2)
    means = torch.where((log_weights != -torch.inf).unsqueeze(-1), means, 0.0)
    middle = (weight.unsqueeze(-1) * means).sum(-2, keepdim=True)
    both = torch.stack([root[..., 0], safe_sqrt(weight[..., 1:].sum(-1))], -1)[..., None, None]
    roots = torch.cat(torch.broadcast_tensors(predicted.scale_tril, each.scale_tril), -3)
    if_missed, if_measured = torch.where(both == 0, 0.0, both * roots).unbind(-3)
    spread = (root.unsqueeze(-1) * (means - middle)).mT
    return Gaussian(middle.squeeze(-2), tria(hstack(if_missed, if_measured, spread)))


def gated(log_weights: Tensor, whitened: Whitened) -> tuple[Tensor, Whitened]:
    """The measurements ``(..., N, K)`` in each gate.

    K is the largest number of measurements in a gate; while code is traced it is J.

    Args:
        log_weights: ``(..., N, J + 1)`` of a miss, and of each measurement.
        whitened: the measurements.
    """
    inside = log_weights[..., 1:] > -torch.inf
    if is_traced(log_weights):
        return log_weights, whitened
    order = gated_first(inside)
    if order.shape == inside.shape:
        return log_weights, whitened
    associated = log_weights[..., 1:].gather(-1, order)
    return torch.cat([log_weights[..., :1], associated], -1), chosen(whitened, order, inside.shape)


def likeliest(share: Tensor, whitened: Whitened) -> Whitened:
    """The measurement ``(..., N, 1)`` with the largest ``share (..., N, J)``."""
    return chosen(whitened, share.argmax(-1, keepdim=True), share.shape)


def weighted_mean(x: Tensor, share: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
    """Mean ``(..., N, 1, m)`` of ``x (..., N, J, m)``, weighted by association probabilities, and their sum.

    The mean is 0 where the sum is below a half, so that nothing is learned from it.

    Args:
        x: values of each measurement.
        share: ``(..., N, J)`` probability that it is the target's.
        measured: ``(..., 1, J, m)`` 1 where measured.
    """
    weight = share.unsqueeze(-1) * measured
    x = torch.where(weight > 0, x, 0.0)  # a value of zero weight may be infinite
    total = weight.sum(-2, keepdim=True)
    return safe_divide((weight * x).sum(-2, keepdim=True), torch.where(total >= 0.5, total, 0.0)), total


def combined(
    share: Tensor, residual: Tensor, root: Tensor, normalised: Tensor, frame: Frame
) -> tuple[Tensor, Tensor, Tensor]:
    """The combined innovation of each target, in the units of the measurement.

    Args:
        share: ``(..., N, J)`` association probability of each measurement.
        residual: ``(..., N, J, m)`` in units of the measurement noise.
        root: ``(..., N, J, m, m)`` root of its covariance, in units of the measurement noise.
        normalised: ``(..., N, J, m)`` residual divided by its root.
        frame: of the scan, with the measurement noise.

    Returns:
        The weighted innovation ``(..., N, m)``, the root of the likeliest one's covariance, and the weighted normalised
        innovation.
    """
    noise = frame.measurement_noise
    weight, best = share.unsqueeze(-1), share.argmax(-1)[..., None, None, None]
    coloured, root = noise.colour(residual.unsqueeze(-1)).squeeze(-1), noise.colour(root)
    if root.shape[-3] > 1:  # otherwise all measurements share it
        root = root.expand(*share.shape, *root.shape[-2:])
        root = root.gather(-3, best.expand(*share.shape[:-1], 1, *root.shape[-2:]))
    return (weight * coloured).sum(-2), root.squeeze(-3), (weight * normalised).sum(-2)
