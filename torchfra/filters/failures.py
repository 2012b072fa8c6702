"""The step at which a track has failed, and the cause."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

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
