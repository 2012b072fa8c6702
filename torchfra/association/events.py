"""Joint association events of a few targets, and the sum over all of them."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import torch
from torch import Tensor

from torchfra.linalg.safe import safe_log
from torchfra.numbers import is_integer

_LARGEST = 300_000
"""Largest product of choices to enumerate."""


def check_exact(exact: tuple[int, int]) -> None:
    """Checks that the joint events of so many targets and measurements are few enough to enumerate.

    Raises:
        ValueError: there are too many, or ``exact`` is no pair of numbers.
    """
    pair = isinstance(exact, tuple | list) and len(exact) == 2 and all(is_integer(x, 0) for x in exact)
    if not pair or (exact[1] + 1) ** exact[0] > _LARGEST:
        raise ValueError(
            f"exact: expected targets and measurements with (measurements + 1)^targets up to {_LARGEST}, such as "
            f"(4, 10), received {exact!r}"
        )


def joint_events(targets: int, measurements: int) -> Tensor:
    """All joint association events of ``targets`` and ``measurements``.

    Returns:
        ``(E, targets)``: of each event and target 0 if it is missed, otherwise the number of its measurement from 1 to
        ``measurements``.  No measurement occurs twice in an event.

    Raises:
        ValueError: ``(measurements + 1)^targets`` is larger than 300,000.
    """
    return _joint_events(targets, measurements)


def permuted_events(targets: int, measurements: int) -> Tensor:
    """Number ``(E,)`` of the kind of each joint event: those of one kind have the same targets and measurements."""
    return _permuted_events(targets, measurements)


# Keeps the loop out of the graph: what torch.compiler.assume_constant_result does, which would import torch._dynamo.
joint_events._dynamo_marked_constant = True  # type: ignore[attr-defined]
permuted_events._dynamo_marked_constant = True  # type: ignore[attr-defined]


@lru_cache(maxsize=64)
def _joint_events(targets: int, measurements: int) -> Tensor:
    check_exact((targets, measurements))
    choices = product(range(measurements + 1), repeat=targets)
    feasible = [event for event in choices if len(set(event) - {0}) == sum(choice > 0 for choice in event)]
    return torch.tensor(feasible, dtype=torch.int64)


@lru_cache(maxsize=64)
def _permuted_events(targets: int, measurements: int) -> Tensor:
    events = _joint_events(targets, measurements)
    kind: Tensor = torch.cat([events > 0, events.sort(-1)[0]], -1).unique(dim=0, return_inverse=True)[1]
    return kind


def sum_over_events(
    log_ratio: Tensor, log_miss: Tensor, weight: Tensor, diffuse: bool, permutations: bool = True
) -> tuple[Tensor, Tensor]:
    """Marginal probabilities of one cluster from all of its joint events.

    Args:
        log_ratio: ``(R, n, j)``, as in ``GatedScans``.
        log_miss: ``(R, n)``, as in ``GatedScans``.
        weight: ``(R,)`` number of measurements in the gates of the cluster, as in ``Clusters``.
        diffuse: whether any number of false measurements is equally probable a priori; otherwise it is Poisson.
        permutations: whether probabilities count all events of one kind, or the most probable of each kind alone.

    Returns:
        Log probabilities ``(R, n, j + 1)`` of a miss and of each measurement, and ``(R,)`` the log of the sum over all
        events.
    """
    targets, measurements = log_ratio.shape[-2:]
    events = joint_events(targets, measurements).to(log_ratio.device)
    missed, always_measured = events == 0, log_miss == -torch.inf
    choices = torch.cat([torch.where(always_measured, 0.0, log_miss).unsqueeze(-1), log_ratio], -1)
    log_event = sum(choices[:, t].index_select(-1, events[:, t]) for t in range(targets))
    assert isinstance(log_event, Tensor)
    if diffuse:  # the number of false measurements f has the factor f! / (number of measurements)!
        false = (weight.unsqueeze(-1) - (~missed).sum(-1)).clamp_min(0.0)
        log_event = log_event + torch.lgamma(false + 1) - torch.lgamma(weight + 1).unsqueeze(-1)
    # Only events with the fewest misses of targets that are always measured are possible.
    misses = always_measured.to(log_event) @ missed.to(log_event).mT
    misses = torch.where(log_event > -torch.inf, misses, torch.inf)
    log_event = torch.where(misses == misses.amin(-1, keepdim=True), log_event, -torch.inf)
    log_total = log_event.logsumexp(-1)
    if not permutations:
        kind = permuted_events(targets, measurements).to(events.device).expand(log_event.shape)
        best = torch.full_like(log_event, -torch.inf).scatter_reduce(-1, kind, log_event.detach(), "amax")
        log_event = torch.where(log_event >= best.gather(-1, kind), log_event, -torch.inf)
    log_counted = log_total if permutations else log_event.logsumexp(-1)
    chosen = torch.nn.functional.one_hot(events, measurements + 1).to(log_event).flatten(-2)
    probability = ((log_event - log_counted.unsqueeze(-1)).exp() @ chosen).unflatten(-1, (targets, measurements + 1))
    return safe_log(probability), log_total
