"""Joint association of a few targets by recursion over sets of them: exact, without a list of events."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from torchfra.association.clusters import Association, GatedScans
from torchfra.linalg.safe import safe_log

_IMPOSSIBLE = -1e30
"""Finite log weight of a measurement outside the gate; an event below a tenth of it is impossible."""
_NOTHING = 100 * _IMPOSSIBLE
"""Log weight of sets of more targets than there have been measurements."""


def check_sets(targets: int, count: int, exact: tuple[int, int], permutations: bool) -> None:
    """Checks that all joint events of a scan are summed, whatever its clusters are.

    Raises:
        NotImplementedError: large clusters would use belief propagation, whose number of rounds depends on the data, or
            not all events count.
    """
    if targets > 1 and not permutations:
        raise NotImplementedError("permutations: kernels count all joint events, expected True, received False")
    if targets > 1 and (targets > exact[0] or count > exact[1]):
        raise NotImplementedError(
            f"exact: kernels have no belief propagation, expected exact=({targets}, {count}) or more for {targets} "
            f"targets and scans of {count} measurements, received {exact}"
        )


def sum_over_sets(scans: GatedScans) -> Association:
    """Association of all targets ``(R, N)``, summed over all joint events of a scan.

    Measurement by measurement, ``total[S]`` becomes the sum over all events in which exactly the targets of the set S
    are measured: those where the new measurement is false, and those where it belongs to a target of S.  A backward
    recursion gives the derivative of the log of the sum with respect to each log weight, which is its probability.
    Sums are divided by their largest term, so that nothing under- or overflows: ``best`` is the log of that term.

    Source: Fortmann, Bar-Shalom & Scheffe (1983) for the events; the recursion is Bellman's (1962), over subsets.
    """
    targets = scans.log_ratio.shape[-2]
    log_ratio = torch.where(scans.gated, scans.log_ratio, _IMPOSSIBLE)
    start = log_ratio.new_full((len(log_ratio), (1 << targets) - 1), _NOTHING)
    best = torch.cat([torch.zeros_like(start[:, :1]), start], -1)
    total, steps = (best == 0).to(log_ratio), []
    for ratio in log_ratio.unbind(-1):
        step = _Step(best, total, ratio)
        steps.append(step)
        best, total = step.best, step.total
    log_sum = torch.where(best > 0.1 * _IMPOSSIBLE, best + safe_log(total), -torch.inf)
    probability, evidence = _of_sets(scans, log_sum)
    missed = [_pairs(probability, t)[0].sum((-2, -1)) for t in range(targets)]
    adjoint = probability / torch.where(probability > 0, total, 1.0)
    columns = []
    for step in reversed(steps):
        adjoint, measured = step.back(adjoint)
        columns.append(measured)
    every = torch.stack([torch.stack(missed, -1), *columns[::-1]], -1)
    return Association(safe_log(every), evidence)


class _Step:
    """One more measurement.

    Args:
        best: ``(R, 2^N)`` before it.
        total: ``(R, 2^N)`` before it, divided by the exponential of ``best``.
        ratio: ``(R, N)`` log weights of the measurement.
    """

    def __init__(self, best: Tensor, total: Tensor, ratio: Tensor) -> None:
        self.before, self.best = total, best
        weights = ratio[..., None, None].unbind(1)
        for t, weight in enumerate(weights):
            through = _pairs(best, t)[0] + weight.detach()
            rest, inside = _pairs(self.best, t)
            self.best = _joined(rest, torch.maximum(inside, through))
        self._kept = (best - self.best).exp()
        self._shares = [
            (_pairs(best, t)[0] + weight - _pairs(self.best, t)[1]).exp() for t, weight in enumerate(weights)
        ]
        self.total = self._kept * total
        for t, share in enumerate(self._shares):
            rest, inside = _pairs(self.total, t)
            self.total = _joined(rest, inside + share * _pairs(total, t)[0])

    def back(self, adjoint: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of the log of the sum: by the total before, and ``(R, N)`` by the log weights.

        ``adjoint`` is the derivative by the total after.
        """
        before, measured = self._kept * adjoint, []
        for t, share in enumerate(self._shares):
            shared = share * _pairs(adjoint, t)[1]
            measured.append((shared * _pairs(self.before, t)[0]).sum((-2, -1)))
            rest, inside = _pairs(before, t)
            before = _joined(rest + shared, inside)
        return before, torch.stack(measured, -1)


def _pairs(table: Tensor, t: int) -> tuple[Tensor, ...]:
    """A table ``(R, 2^N)`` split into the entries of sets without target ``t``, and those of the sets with it added."""
    halves: tuple[Tensor, ...] = table.unflatten(-1, (-1, 2, 1 << t)).unbind(-2)
    return halves


def _joined(without: Tensor, holding: Tensor) -> Tensor:
    """The reverse of ``_pairs``."""
    return torch.stack([without, holding], -2).flatten(-3)


def _of_sets(scans: GatedScans, log_sum: Tensor) -> tuple[Tensor, Tensor]:
    """Probability ``(R, 2^N)`` that exactly the targets of a set are measured, and evidence as of an ``Association``.

    Args:
        scans: the scans.
        log_sum: ``(R, 2^N)`` log of the sum over all ways in which they are; minus infinity for none.
    """
    clusters, inside = scans.clusters, _membership(scans.log_ratio.shape[-2]).to(log_sum)
    always = scans.log_miss == -torch.inf
    log_miss, always = torch.where(always, 0.0, scans.log_miss), always.to(log_sum)
    together = clusters.members.to(log_sum)
    within = log_sum.unsqueeze(-2) + (together * log_miss.unsqueeze(-2)) @ (1 - inside)  # (R, N, 2^N), of each cluster
    overall = log_sum + (log_miss.unsqueeze(-2) @ (1 - inside)).squeeze(-2)
    if scans.diffuse:
        # Any number f of false measurements is equally probable: with d detections the factor is f! / (f + d)!.
        count = clusters.weight.unsqueeze(-1)
        factor = torch.lgamma((count - together @ inside).clamp_min(0.0) + 1) - torch.lgamma(count + 1)
        within, overall = within + factor, overall + (factor / clusters.size.unsqueeze(-1)).sum(-2)
    within = torch.where((1 - together) @ inside == 0, within, -torch.inf)
    within = _fewest(within, (together * always.unsqueeze(-2)) @ (1 - inside))
    overall = _fewest(overall, (always.unsqueeze(-2) @ (1 - inside)).squeeze(-2))
    return overall.softmax(-1), within.logsumexp(-1) / clusters.size


def _fewest(log_event: Tensor, misses: Tensor) -> Tensor:
    """Log weights of events; minus infinity without the fewest ``misses`` of targets that are always measured."""
    misses = torch.where(log_event > -torch.inf, misses, torch.inf)
    return torch.where(misses == misses.amin(-1, keepdim=True), log_event, -torch.inf)


@lru_cache(maxsize=16)
def _membership(targets: int) -> Tensor:
    """``(N, 2^N)``: 1 where a set holds a target."""
    with torch.inference_mode(False):
        return (torch.arange(1 << targets) >> torch.arange(targets).unsqueeze(-1)) % 2
