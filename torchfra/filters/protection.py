"""Protection levels: the radius that the error of a position exceeds with a stated probability."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchfra.filters.base import Filter
from torchfra.types import Estimate

_BISECTIONS = 60
"""Number of bisections of a bracket around the radius, after which it is narrower than rounding."""


@torch.no_grad()
def protection_level(
    f: Filter, estimate: object, *, risk: float = 1e-3, fault: tuple[float, float] | None = None
) -> Tensor:
    """Radius around the estimated position, m, that the error exceeds with a probability of ``risk`` at most.

    It takes all hypotheses of the filter, each with its own mean, covariance and probability, and holds if motion and
    noise are as stated.  No filter detects an error of a sensor that grows as slowly as the sensor's own drift.
    ``fault`` states how often such an error occurs and its size; all of it counts as an error of the estimate.

    Args:
        f: the filter, of a motion whose state has a position in metres, of 1 to 3 dimensions.
        estimate: of whole tracks, made by the filter with ``past=True``, or the filter's state after a step.
        risk: probability between 0 and 1.
        fault: share of the time with an undetected fault, from 0 to 1, and the standard deviation per axis of its
            error, m; None for none.

    Returns:
        ``(..., T)`` or ``(...)``, an upper bound of the quantile: the smallest radius at which the sum over hypotheses
        of weight times ``P(|N(0, I)| > (radius - distance) / std)`` is ``risk``, where ``std`` is the largest standard
        deviation of any direction.  It has no gradient.

    Raises:
        ValueError: a motion without such a position, a risk or a fault out of its range, an estimate without its past,
            or an argument that is neither an estimate nor a state.

    Source: Blanch, Walter, Enge et al. (2015), "Baseline Advanced RAIM User Algorithm and Possible Improvements", eqs.
    (28)-(30), for levels of several hypotheses.  Differs: hypotheses are weighed by what has been measured.
    """
    _check(f, risk, fault)
    beliefs, log_weights = f.hypotheses(_past_or_state(estimate))
    centre = estimate.mean if isinstance(estimate, Estimate) else estimate.belief.mean  # type: ignore[attr-defined]  # a state
    where = f.motion.position
    distance = (beliefs.mean - centre.unsqueeze(-2))[..., where].norm(dim=-1)
    std = torch.linalg.matrix_norm(beliefs.scale_tril[..., where, :], ord=2)
    weight = log_weights.exp()
    if fault is not None:
        share, size = fault
        std = torch.cat([std, (std.square() + size**2).sqrt()], -1)
        weight = torch.cat([(1 - share) * weight, share * weight], -1)
        distance = torch.cat([distance, distance], -1)
    beyond = _TAILS[centre[..., where].shape[-1]]
    one = std.new_ones(())
    # No tail is left in double precision beyond 100 standard deviations.
    k = _bisected(lambda r: beyond(r) > risk, 0 * one, 100 * one)
    # At the radius that the widest hypothesis needs alone, no hypothesis exceeds the risk.
    widest = torch.where(weight > 0, distance + k * std, 0.0).amax(-1)

    def too_small(radius: Tensor) -> Tensor:
        normalised = ((radius.unsqueeze(-1) - distance) / std).clamp_min(0.0)
        return (torch.where(weight > 0, weight * beyond(normalised), 0.0)).sum(-1) > risk

    level = _bisected(too_small, torch.zeros_like(widest), widest)
    return torch.where(centre.isfinite().all(-1), level, torch.nan)


def _bisected(too_small: Callable[[Tensor], Tensor], low: Tensor, high: Tensor) -> Tensor:
    """The smallest value that is large enough, by bisection."""
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        small = too_small(middle)
        low, high = torch.where(small, middle, low), torch.where(small, high, middle)
    return high


_TAILS: dict[int, Callable[[Tensor], Tensor]] = {
    1: lambda r: torch.erfc(r / math.sqrt(2)),
    2: lambda r: torch.exp(-r.square() / 2),
    3: lambda r: torch.erfc(r / math.sqrt(2)) + math.sqrt(2 / math.pi) * r * torch.exp(-r.square() / 2),
}
"""Probability that a standard normal vector is longer than ``r``, by its number of dimensions."""


def _past_or_state(estimate: object) -> object:
    """The past of an estimate, or a state: either holds the hypotheses."""
    if isinstance(estimate, Estimate):
        if isinstance(estimate.past, tuple) and not estimate.past:
            raise ValueError("estimate: expected one made with past=True, received one without its past")
        return estimate.past
    if not hasattr(estimate, "belief"):
        received = type(estimate).__name__
        raise ValueError(f"estimate: expected an estimate or a state that step has returned, received {received}")
    return estimate


def _check(f: Filter, risk: float, fault: tuple[float, float] | None) -> None:
    """Checks arguments.

    Raises:
        ValueError: names the first that is wrong.
    """
    motion = f.motion
    kinds = motion.kinds[motion.position]
    if len(kinds) not in _TAILS or set(kinds) != {"position"}:
        expected = "a filter of a motion with a position in metres, of 1 to 3 dimensions"
        raise ValueError(f"f: expected {expected}, received one of [{', '.join(motion.components)}]")
    if not 0 < risk < 1:
        raise ValueError(f"risk: expected a probability between 0 and 1, received {risk}")
    if fault is not None and not (len(fault) == 2 and 0 <= fault[0] <= 1 and 0 <= fault[1] < math.inf):
        raise ValueError(f"fault: expected a share from 0 to 1 and metres of 0 or more, received {fault}")
