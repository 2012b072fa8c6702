"""The step at which a track has failed, and the cause."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchfra import tree
from torchfra.gaussian.inputs import Measurements
from torchfra.hyper import hypers, out_of_range
from torchfra.linalg.tracing import is_traced
from torchfra.steps.recursion import Recursion
from torchfra.types import Cause, Estimate, Failure, Gaussian


def diagnose(f: Recursion, estimate: Estimate, measurements: Measurements, prior: Gaussian) -> Failure:
    """The step at which each track has failed, and the cause.

    Args:
        f: the filter.
        estimate: ``(..., T)`` of the tracks.
        measurements: of the tracks.
        prior: the belief before the first step.
    """
    mean, root, scores = (x.detach() for x in (estimate.mean, estimate.scale_tril, estimate.log_likelihood))
    tracks = mean.shape[:-2]
    if not is_traced(mean, scores):
        # If a belief is not finite, neither is the next score: three sums are a cheaper test than every root.
        total = scores.sum() + mean.select(-2, -1).sum() + root.select(-3, -1).sum()
        if math.isfinite(total.item()):
            step, cause = (torch.full(tracks, value, device=mean.device) for value in (-1, int(Cause.NONE)))
            return Failure(step, cause)
    bad, values = Gaussian(mean, root).failed, out_of_range(f)
    step = torch.where(bad.any(-1), bad.to(torch.int64).argmax(-1), -1)
    reasons = {
        Cause.PRIOR: prior.failed,
        Cause.MEASUREMENT: _by_then(measurements.z.isinf().flatten(-1 - f.scans).any(-1), step, f.scans),
        Cause.VALUE: bad.new_zeros(()) if values is None else values,
    }
    if measurements.u is not None:
        reasons[Cause.INPUT] = _by_then(~measurements.u.isfinite().all(-1), step, f.scans)
    cause = torch.full_like(step, Cause.ARITHMETIC)
    for reason in sorted(reasons, reverse=True):
        cause = torch.where(reasons[reason], int(reason), cause)
    names = () if values is None or is_traced(values) else bad_values(f)
    return Failure(step, torch.where(step < 0, int(Cause.NONE), cause), names)


def diagnose_smoothed(smoothed: Estimate, filtered: Estimate) -> Failure:
    """The failure of the filtered estimate, and of tracks of which the backward pass alone has failed its last step."""
    assert filtered.failure is not None
    mean, root = smoothed.mean.detach(), smoothed.scale_tril.detach()
    # The backward pass ends at the first step, which is not finite if a later one is not.
    if not is_traced(mean) and math.isfinite((mean.select(-2, 0).sum() + root.select(-3, 0).sum()).item()):
        return filtered.failure
    bad, (step, cause, values) = Gaussian(mean, root).failed, filtered.failure
    last = bad.shape[-1] - 1 - bad.flip(-1).to(torch.int64).argmax(-1)
    here = bad.any(-1) & (step < 0)
    return Failure(torch.where(here, last, step), torch.where(here, int(Cause.ARITHMETIC), cause), values)


def diagnose_step(f: Recursion, before: Gaussian, measurements: Measurements, after: Gaussian) -> Failure:
    """The failure, at step 0, of a single step between two beliefs of a filter of single targets."""
    mean, root = after.mean.unsqueeze(-2), after.scale_tril.unsqueeze(-3)
    estimate = Estimate(mean, root, mean[..., 0], mean[..., 0], None)
    return diagnose(f, estimate, measurements.as_track(), before)


def bad_values(f: nn.Module) -> tuple[str, ...]:
    """Paths of the hyperparameters that are NaN or out of their range."""
    if out_of_range(f) is None:
        return ()
    return tuple(path for path, hyper in hypers(f).items() if bool(hyper.out_of_range().any()))


def with_gradients(f: nn.Module, estimate: Estimate) -> Estimate:
    """The estimate with a gradient of 0 where it does not depend on any value that is learned.

    That is so of a threshold that no measurement has reached, and of one that hard decisions alone depend on: the loss
    of such tracks can be differentiated like any other.
    """
    if not torch.is_grad_enabled():
        return estimate
    learned = [x for x in f.parameters() if x.requires_grad]
    if not learned or all(x.requires_grad for x in estimate[:4]):
        return estimate
    nothing = torch.stack([0 * x.sum() for x in learned]).sum()
    tied: dict[str, Any] = {name: x + nothing.to(x) for name, x in zip(estimate._fields[:4], estimate[:4], strict=True)}
    return estimate._replace(**{name: x for name, x in tied.items() if not getattr(estimate, name).requires_grad})


def without_failed_gradients(
    f: Recursion, estimate: Estimate, filtered: Estimate, measurements: Measurements, prior: Gaussian,
    again: Callable[[Measurements, Gaussian], Estimate],
) -> Estimate:  # fmt: skip
    """The estimate, where gradients are needed without those of failed tracks.

    NaN and infinity of a failed track would reach the gradients of values that tracks share, even if the loss leaves
    that track out, as 0 times infinity is NaN.  So all tracks are estimated once more, with the data of a good track in
    place of each failed one, whose own estimate has no gradient.

    Args:
        f: the filter.
        estimate: filtered or smoothed, of all tracks.
        filtered: the filtered estimate, whose ``failure`` names the failed tracks.
        measurements: of all tracks.
        prior: the beliefs before the first step.
        again: makes the estimate from other measurements and another prior.
    """
    outputs = filtered.mean, filtered.scale_tril, filtered.log_likelihood
    if f.scans or is_traced(*outputs) or not (torch.is_grad_enabled() and any(x.requires_grad for x in outputs)):
        return estimate
    assert filtered.failure is not None
    failed = filtered.failure.step >= 0
    if not bool(failed.any()) or bool(failed.all()):
        return estimate
    good = int((~failed).flatten().to(torch.int8).argmax())

    def failed_with(event: int) -> Tensor:
        """``failed`` with as many dimensions of an event behind it."""
        return failed.reshape(*failed.shape, *[1] * event)

    def replaced(x: Tensor, event: int) -> Tensor:
        if x.shape[: x.dim() - event].numel() <= 1:
            return x  # all tracks share it
        every = x.expand(*failed.shape, *x.shape[x.dim() - event :])
        return torch.where(failed_with(event), every.flatten(0, -event - 1)[good].detach(), every)

    def chosen(x: Tensor, other: Tensor) -> Tensor:
        if x.shape[: failed.dim()] != failed.shape:
            return other
        return torch.where(failed_with(x.dim() - failed.dim()), x.detach(), other)

    data: Measurements = tree.map_ranked(lambda event, x: replaced(x, event + 1), measurements)
    result = again(data, Gaussian(replaced(prior.mean, 1), replaced(prior.scale_tril, 2)))
    return tree.map_tensors(chosen, estimate, result)


def _by_then(bad: Tensor, step: Tensor, scans: bool) -> Tensor:
    """``(...)`` bool, whether any step up to the one after ``step`` is bad, as the next step may decide an estimate.

    Args:
        bad: ``(..., T)`` bool; for scans without the dimension of targets that ``step`` has.
        step: ``(...)`` the first step whose estimate is not finite.
        scans: whether targets are the last dimension of ``step``.
    """
    bad = bad.unsqueeze(-2) if scans else bad
    return (bad & (torch.arange(bad.shape[-1], device=bad.device) <= step.unsqueeze(-1) + 1)).any(-1)
