"""Joint association by the sum over all joint events."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import torch
from torch import Tensor

from torchfra.association.clusters import Association, Clusters

_CHOICES = 300_000
"""Largest table of events to go through."""


def check_exact(exact: tuple[int, int]) -> None:
    """Whether all events of so many targets and measurements may be gone through.

    Raises:
        ValueError: they are too many.
    """
    targets, count = exact
    if min(exact) < 0 or (count + 1) ** targets > _CHOICES:
        raise ValueError(
            f"exact: expected targets and measurements with (measurements + 1)^targets up to {_CHOICES}, such as 4 and "
            f"10, received {targets} and {count}"
        )


@torch.compiler.assume_constant_result  # type: ignore[untyped-decorator]  # or its loop would be traced
def events(targets: int, count: int) -> Tensor:
    """``(E, targets)`` all joint events: for each target 0, missed, or 1 to ``count``, each of those once at most.

    Raises:
        ValueError: more than 300,000 choices, ``(count + 1)^targets``.
    """
    return _events(targets, count)


@lru_cache(maxsize=64)
def _events(targets: int, count: int) -> Tensor:
    check_exact((targets, count))
    every = [e for e in product(range(count + 1), repeat=targets) if len(set(e) - {0}) == sum(a > 0 for a in e)]
    return torch.tensor(every, dtype=torch.int64)


def enumerate_events(log_ratio: Tensor, log_miss: Tensor, counted: Tensor, *, diffuse: bool) -> tuple[Tensor, Tensor]:
    """One cluster: log probabilities ``(R, n, j + 1)`` and the log of the sum over all events ``(R,)``.

    Args:
        log_ratio: ``(R, n, j)``.
        log_miss: ``(R, n)``.
        counted: ``(R,)`` measurements in the cluster's gates.
        diffuse: see ``associate``.
    """
    n, j = log_ratio.shape[-2:]
    choice = events(n, j).to(log_ratio.device)
    missed, certain = choice == 0, log_miss == -torch.inf
    options = torch.cat([torch.where(certain, 0.0, log_miss).unsqueeze(-1), log_ratio], -1)
    score = sum(options[:, t].index_select(-1, choice[:, t]) for t in range(n))
    assert isinstance(score, Tensor)
    if diffuse:
        false = (counted.unsqueeze(-1) - (~missed).sum(-1)).clamp_min(0.0)
        score = score + torch.lgamma(false + 1) - torch.lgamma(counted + 1).unsqueeze(-1)
    # Of targets that are always measured as few are missed as can be.
    forced = certain.to(score) @ missed.to(score).mT
    forced = torch.where(score > -torch.inf, forced, torch.inf)
    score = torch.where(forced == forced.amin(-1, keepdim=True), score, -torch.inf)
    whole = score.logsumexp(-1)
    chosen = torch.nn.functional.one_hot(choice, j + 1).to(score).flatten(-2)
    probability = ((score - whole.unsqueeze(-1)).exp() @ chosen).unflatten(-1, (n, j + 1))
    return _log(probability), whole


def _enumerated(
    ratio: Tensor,
    miss: Tensor,
    gated: Tensor,
    within: Clusters,
    wanted: Tensor,
    table: tuple[int, int],
    diffuse: bool,
    found: Association,
    traced: bool,
) -> Association:
    """Clusters of several targets by their events, in the place of what was ``found``."""
    runs, targets, _ = ratio.shape
    first = within.together.to(torch.int64).argmax(-1)  # of each target's cluster
    if traced:
        heads = torch.ones_like(wanted)
    else:
        heads = wanted & (first == torch.arange(targets, device=ratio.device))
        table = int(within.size[heads].amax()), max(int(within.gated[heads].amax()), 1)
    place = heads.flatten().nonzero().squeeze(-1) if not traced else torch.arange(runs * targets, device=ratio.device)
    run, head = place // targets, place % targets
    member = within.together[run, head]  # (k, N)
    seen = (member.unsqueeze(-1) & gated[run]).any(-2)  # (k, J)
    who = member.to(torch.int8).argsort(dim=-1, descending=True, stable=True)[:, : table[0]]
    what = seen.to(torch.int8).argsort(dim=-1, descending=True, stable=True)[:, : table[1]]
    real = member.gather(-1, who)
    small = ratio[run.unsqueeze(-1), who].gather(-1, what.unsqueeze(-2).expand(-1, table[0], -1))
    small = torch.where(real.unsqueeze(-1), small, -torch.inf)
    none = torch.where(real, miss[run.unsqueeze(-1), who], 0.0)
    log_weights, whole = enumerate_events(small, none, within.counted[run, head], diffuse=diffuse)
    # Back to where they came from: each target looks up its cluster, its place in there, and that of each measurement.
    row = torch.zeros(runs * targets, dtype=torch.int64, device=ratio.device).index_put(
        (place,), torch.arange(len(place), device=ratio.device)
    )
    row = row[torch.arange(runs, device=ratio.device).unsqueeze(-1) * targets + first]  # (R, N)
    slot = (within.together.cumsum(-1) - 1).diagonal(dim1=-2, dim2=-1).clamp(0, table[0] - 1)
    own = log_weights[row, slot]  # (R, N, j + 1)
    order = (seen.cumsum(-1) * seen)[row]  # 0 for those in no gate of the cluster
    order = torch.where(order <= table[1], order, 0)
    measured = torch.where(order > 0, own.gather(-1, order), -torch.inf)
    exact = torch.cat([own[..., :1], measured], -1)
    evidence = whole[row] / within.size
    return Association(
        torch.where(wanted.unsqueeze(-1), exact, found.log_weights), torch.where(wanted, evidence, found.evidence)
    )


def _log(probability: Tensor) -> Tensor:
    """Minus infinity of 0, without its gradient."""
    some = probability > 0
    return torch.where(some, torch.where(some, probability, 1.0).log(), -torch.inf)
