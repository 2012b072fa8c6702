"""How far off the position can be: a radius that it exceeds with a probability that is stated."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchfra.filters.base import Filter
from torchfra.types import Estimate

_HALVINGS = 60
"""Of a bracket around the radius: what is left of it is below rounding."""


@torch.no_grad()
def protection_level(f: Filter, of: object, *, risk: float = 1e-3, fault: tuple[float, float] | None = None) -> Tensor:
    """How far the position can be from its estimate, m: farther only with a probability of ``risk`` or less.

    It is a radius for all hypotheses that the filter holds, each with its own mean and covariance: a hypothesis far
    from the estimate counts by its probability.  It holds as far as models and noise do.  No filter knows of an error
    of a sensor that grows as slowly as its own drift, so that it was believed: ``fault`` states how often there is one
    and how large it is, and the estimate is taken to be off by all of it.

    Args:
        f: the filter.
        of: its estimate of whole tracks, made with ``past=True``, or its state after a step.
        risk: between 0 and 1.
        fault: share of the time with a fault that nobody has noticed, from 0 to 1, and the standard deviation per axis
            of its error, m; None for none.

    Returns:
        ``(..., T)`` or ``(...)``, an upper bound of the quantile: the smallest radius at which the sum over hypotheses
        of weight and ``P(|N(0, I)| > (radius - distance) / std)`` is ``risk``, with the largest standard deviation of
        any direction.  No gradients flow.

    Raises:
        ValueError: a risk or a fault out of its range, an estimate without its past, or what is neither.

    Source: Blanch, Walter, Enge et al. (2015), "Baseline Advanced RAIM User Algorithm and Possible Improvements", eqs.
    (28)-(30), for levels of several hypotheses.  Differs: hypotheses are weighed by what has been measured.
    """
    _check(risk, fault)
    beliefs, log_weights = f.hypotheses(_known(of))
    centre = of.mean if isinstance(of, Estimate) else of.belief.mean  # type: ignore[attr-defined]  # a state has one
    where = f.motion.position
    away = (beliefs.mean - centre.unsqueeze(-2))[..., where].norm(dim=-1)
    std = torch.linalg.matrix_norm(beliefs.scale_tril[..., where, :], ord=2)
    weight = log_weights.exp()
    if fault is not None:
        share, size = fault
        std = torch.cat([std, (std.square() + size**2).sqrt()], -1)
        weight = torch.cat([(1 - share) * weight, share * weight], -1)
        away = torch.cat([away, away], -1)
    beyond = _TAILS[centre[..., where].shape[-1]]
    one = std.new_ones(())
    k = _halved(lambda r: beyond(r) > risk, 0 * one, 100 * one)
    # At the radius of the widest hypothesis none has more than the risk.
    widest = torch.where(weight > 0, away + k * std, 0.0).amax(-1)

    def too_small(radius: Tensor) -> Tensor:
        normalised = ((radius.unsqueeze(-1) - away) / std).clamp_min(0.0)
        return (torch.where(weight > 0, weight * beyond(normalised), 0.0)).sum(-1) > risk

    level = _halved(too_small, torch.zeros_like(widest), widest)
    return torch.where(centre.isfinite().all(-1), level, torch.nan)


def _halved(too_small: Callable[[Tensor], Tensor], low: Tensor, high: Tensor) -> Tensor:
    """The least value that is not too small, by bisection."""
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        small = too_small(middle)
        low, high = torch.where(small, middle, low), torch.where(small, high, middle)
    return high


_TAILS: dict[int, Callable[[Tensor], Tensor]] = {
    1: lambda r: torch.erfc(r / math.sqrt(2)),
    2: lambda r: torch.exp(-r.square() / 2),
    3: lambda r: torch.erfc(r / math.sqrt(2)) + math.sqrt(2 / math.pi) * r * torch.exp(-r.square() / 2),
}
"""By dimensions of space the probability that a standard normal vector is longer than ``r``."""


def _known(of: object) -> object:
    """What holds the hypotheses of an estimate or a state."""
    if isinstance(of, Estimate):
        if isinstance(of.past, tuple) and not of.past:
            raise ValueError("of: expected an estimate made with past=True, received one without its past")
        return of.past
    if not hasattr(of, "belief"):
        raise ValueError(f"of: expected an estimate or what step has returned, received {type(of).__name__}")
    return of


def _check(risk: float, fault: tuple[float, float] | None) -> None:
    """Checks arguments.

    Raises:
        ValueError: names the first that is wrong.
    """
    if not 0 < risk < 1:
        raise ValueError(f"risk: expected a probability between 0 and 1, received {risk}")
    if fault is not None and not (len(fault) == 2 and 0 <= fault[0] <= 1 and 0 <= fault[1] < math.inf):
        raise ValueError(f"fault: expected a share from 0 to 1 and metres of 0 or more, received {fault}")
