"""The step at which a track has failed, and the cause."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra import tree
from torchfra.gaussian.inputs import Measurements
from torchfra.hyper import hypers
from torchfra.linalg.tracing import is_traced
from torchfra.types import Cause, Estimate, Failure, Gaussian


def diagnose(f: Any, estimate: Estimate, measurements: Measurements, prior: Gaussian) -> Failure:
    """At which step each track of a sequence has failed, and why.

    Args:
        f: the filter.
        estimate: ``(..., T)`` of the sequence.
        measurements: of the sequence.
        prior: the belief before them.
    """
    mean, root, scores = (x.detach() for x in (estimate.mean, estimate.scale_tril, estimate.log_likelihood))
    tracks = mean.shape[:-2]
    if not is_traced(mean, scores):
        # A belief that is not finite makes the next score not finite too: sums show it without a test of every root.
        total = scores.sum() + mean.select(-2, -1).sum() + root.select(-3, -1).sum()
        if math.isfinite(total.item()):
            return Failure(*(torch.full(tracks, value, device=mean.device) for value in (-1, int(Cause.NONE))))
    bad = _broken(mean, root)
    step = torch.where(bad.any(-1), bad.to(torch.int64).argmax(-1), -1)
    reasons = {
        Cause.PRIOR: _broken(*prior),
        Cause.MEASUREMENT: _by_then(measurements.z.isinf().flatten(-1 - f.scans).any(-1), step, f.scans),
        Cause.VALUE: torch.stack([bad.new_zeros(()), *(h().isnan().any() for h in hypers(f).values())]).any(),
    }
    if measurements.u is not None:
        reasons[Cause.INPUT] = _by_then(~measurements.u.isfinite().all(-1), step, f.scans)
    cause = torch.full_like(step, Cause.ARITHMETIC)
    for reason in sorted(reasons, reverse=True):
        cause = torch.where(reasons[reason], int(reason), cause)
    return Failure(step, torch.where(step < 0, int(Cause.NONE), cause))


class Spared(NamedTuple):
    """Tracks of which none fails, in place of those that do."""

    failed: Tensor
    """``(...)`` which did."""
    measurements: Measurements
    prior: Gaussian


def spared(f: Any, estimate: Estimate, measurements: Measurements, prior: Gaussian) -> Spared | None:
    """The data of a track that did not fail for those that did; None where gradients need no such thing.

    What is not finite in one track would reach the gradient of a value that all tracks share, as 0 times infinity is
    NaN, although no loss looks at that track.
    """
    outputs = estimate.mean, estimate.scale_tril, estimate.log_likelihood
    if f.scans or is_traced(*outputs) or not (torch.is_grad_enabled() and any(x.requires_grad for x in outputs)):
        return None
    assert estimate.failure is not None
    failed = estimate.failure.step >= 0
    if not bool(failed.any()) or bool(failed.all()):
        return None
    good = int((~failed).flatten().to(torch.int8).argmax())

    def of_good(x: Any, event: int) -> Any:
        if not isinstance(x, Tensor) or x.shape[: x.dim() - event].numel() <= 1:
            return x  # of all tracks
        every = x.expand(*failed.shape, *x.shape[x.dim() - event :])
        return torch.where(
            failed.reshape(*failed.shape, *[1] * event), every.flatten(0, -event - 1)[good].detach(), every
        )

    z, dt, u, std, noise = measurements
    data = Measurements(of_good(z, 2), of_good(dt, 1), of_good(u, 2), of_good(std, 2), of_good(noise, 3))
    return Spared(failed, data, Gaussian(of_good(prior.mean, 1), of_good(prior.scale_tril, 2)))


def mended(failed: Tensor, estimate: Estimate, others: Estimate) -> Estimate:
    """The tracks that have ``failed (...)`` from one estimate, without gradients, and all others from another."""

    def either(x: Tensor, other: Tensor) -> Tensor:
        if x.shape[: failed.dim()] != failed.shape:
            return other
        return torch.where(failed.reshape(*failed.shape, *[1] * (x.dim() - failed.dim())), x.detach(), other)

    result: Estimate = tree.map_tensors(either, estimate, others)
    return result


def _broken(mean: Tensor, root: Tensor) -> Tensor:
    """``(...)`` where a belief is not finite."""
    return ~(mean.isfinite().all(-1) & root.isfinite().flatten(-2).all(-1))


def _by_then(bad: Tensor, step: Tensor, scans: bool) -> Tensor:
    """``(...)`` whether anything was bad until the step after ``step``, which may have decided its estimate.

    Args:
        bad: ``(..., T)``, of scans without the targets that ``step`` has.
        step: ``(...)``.
        scans: whether targets are the last dimension of ``step``.
    """
    bad = bad.unsqueeze(-2) if scans else bad
    return (bad & (torch.arange(bad.shape[-1], device=bad.device) <= step.unsqueeze(-1) + 1)).any(-1)
