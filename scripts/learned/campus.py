"""Which of two filters of a robot is nearer to it now: a network reads it from what both say.

One filter takes the errors of satellite positions for white and for outliers, the other has them in its state as faults
that begin, stay, move and end.  They are wrong at different times.  The network says at each step how much the second
one counts, from what both said until then, and learns it on days with a truth by the errors of the weighed positions.
A day has few faults, so its pieces are varied: in most of them the errors of positions are those of another time of the
day, turned by any angle, and in all they are larger or smaller by a factor.  A penalty holds weights near a half.

Source: Jacobs, Jordan, Nowlan & Hinton (1991), "Adaptive Mixtures of Local Experts", for a network that weighs experts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from recorded_bench.tracks import Track
from torch import Tensor, nn

from torchfra.filters import Filter
from torchfra.types import Estimate, Gaussian

MEMORIES = (30, 150)
"""Steps over which signals are averaged."""
UNITS, NETWORKS = 8, 3
"""Units of a network, and networks, of other first weights and draws, whose mean counts."""
PIECES, LENGTH, START = 48, 900, 3.0
"""Varied pieces of each day, their steps, and the standard deviation of the position that they begin with, m."""
MOVED, FACTORS = 0.7, (0.6, 1.7)
"""Share of the pieces with errors of another time, and the factors on errors, log-uniform."""
ITERATIONS, BATCH, RATE, DECAY = 400, 4096, 1e-2, 1e-2
"""Of learning: steps of Adam, of the robot in each, its rate, which falls to a tenth, and the weight decay."""
SCALE = 10.0 * math.sqrt(2)
"""Error of a position, m, from which on it counts by its logarithm."""
PENALTY = 40.0
"""On the mean square of what the weight has beyond a half, m^2."""


class Heard(NamedTuple):
    """Estimates of two filters for a day."""

    signals: Tensor
    """``(..., T, k)``"""
    positions: Tensor
    """``(..., T, 2, 2)`` of the two filters, m."""
    truth: Tensor
    """``(..., T, 2)`` m."""


class Weight(nn.Module):
    """How much the second filter counts, ``(..., T)`` between 0 and 1, by signals ``(..., T, k)``; at first a half."""

    def __init__(self, signals: Tensor) -> None:
        super().__init__()
        rows = signals.flatten(0, -2)
        self.register_buffer("mean", rows.mean(0))
        self.register_buffer("std", rows.std(0) + 1e-6)
        last = nn.Linear(UNITS, 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.network = nn.Sequential(nn.Linear(rows.shape[-1], UNITS), nn.Tanh(), last).to(rows)

    def forward(self, signals: Tensor) -> Tensor:
        """The weights."""
        usual = ((signals - self.mean) / self.std).clamp(-3, 3)  # type: ignore[operator]  # a buffer
        weight: Tensor = self.network(usual).squeeze(-1).sigmoid()
        return weight


def signals(z: Tensor, first: Estimate, second: Estimate) -> Tensor:
    """What a network hears, ``(..., T, 11)``: none of it needs a later step.

    Args:
        z: ``(..., T, 2)`` positions, m.
        first: of a filter with outliers.
        second: of interacting models of two more states, the error of positions; the first and the last are no fault.
    """
    measured, step = ~z[..., 0].isnan(), torch.arange(z.shape[-2])
    age = step - torch.where(measured, step, 0).cummax(-1).values
    gap = torch.where(measured, (z - first.mean[..., :2]).norm(dim=-1), 0.0).log1p()
    fault = second.info.probabilities[..., 1:-1].sum(-1)
    error = second.mean[..., -2:].norm(dim=-1).log1p()
    apart = (first.mean[..., :2] - second.mean[..., :2]).norm(dim=-1).log1p()
    stds = [torch.linalg.matrix_norm(of.scale_tril[..., :2, :2]).log() for of in (first, second)]
    return torch.stack(
        [age.to(z).log1p(), gap, *(averaged(gap, n) for n in MEMORIES), first.info.outlier[..., 0], fault,
         averaged(fault, MEMORIES[-1]), error, *stds, apart], -1
    )  # fmt: skip


def averaged(x: Tensor, steps: int) -> Tensor:
    """Sums over the last steps of ``x (..., T)``, divided by their number."""
    total = x.cumsum(-1)
    return (total - torch.cat([torch.zeros_like(x[..., :steps]), total[..., :-steps]], -1)[..., : x.shape[-1]]) / steps


def varied(day: Track, rng: torch.Generator) -> Track:
    """Pieces of a day, each of which begins near its truth, with the prior's other components."""
    steps, length = len(day.z), min(LENGTH, len(day.z))

    def pieces() -> Tensor:
        return torch.randint(0, steps - length + 1, (PIECES, 1), generator=rng) + torch.arange(length)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(PIECES, 1, generator=rng, dtype=day.z.dtype)

    here, moved = pieces(), uniform(0.0, 1.0) < MOVED
    source = torch.where(moved, pieces(), here)
    angle = torch.where(moved, uniform(0.0, 2 * math.pi), 0.0)
    mirror = torch.where(moved & (uniform(0.0, 1.0) < 0.5), -1.0, 1.0)
    east, north = (day.z - day.truth)[source].unbind(-1)
    north = mirror * north
    turned = torch.stack([angle.cos() * east - angle.sin() * north, angle.sin() * east + angle.cos() * north], -1)
    factor = uniform(*map(math.log, FACTORS)).exp().unsqueeze(-1)
    near = day.truth[here[:, 0]] + START * torch.randn(PIECES, 2, generator=rng, dtype=day.z.dtype)
    mean = torch.cat([near, day.prior.mean[2:].expand(PIECES, -1)], -1)
    root = torch.block_diag(START * torch.eye(2).to(mean), day.prior.scale_tril[2:, 2:]).expand(PIECES, -1, -1)
    assert day.u is not None
    z, prior = day.truth[here] + factor * turned, Gaussian(mean, root)
    return day._replace(z=z, u=day.u[here], dt=day.dt[here], truth=day.truth[here], prior=prior)


def heard(day: Track, filters: Sequence[Filter], extended: Callable[[Gaussian], Gaussian]) -> Heard:
    """What two filters say of a day; ``extended`` makes the second one's prior of the first one's."""
    with torch.no_grad():
        first, second = (
            f(day.z, prior, u=day.u, dt=day.dt)
            for f, prior in zip(filters, (day.prior, extended(day.prior)), strict=True)
        )
    positions = torch.stack([first.mean[..., :2], second.mean[..., :2]], -2)
    return Heard(signals(day.z, first, second), positions, day.truth)


def learned(
    days: Sequence[Track],
    filters: Sequence[Filter],
    extended: Callable[[Gaussian], Gaussian],
    seed: int = 0,
    progress: Callable[[range], Iterable[int]] = iter,
) -> list[Weight]:
    """Networks after Adam has followed the errors of weighed positions on days and on pieces of them.

    Args:
        days: all of each, as ``recorded_bench.nclt`` reads them; their prior is of the first filter.
        filters: two, which themselves do not learn; ``signals`` says what is asked of them.
        extended: makes the second one's prior of the first one's.
        seed: of the networks' first weights and of the pieces.
        progress: from the numbers of networks to the same, as they are shown.

    Raises:
        ValueError: a day of less than 2 steps, or without a truth at some of them.
    """
    for day in days:
        if len(day.z) < 2 or not bool(day.truth.isfinite().all()):
            raise ValueError(f"network: expected a day with a truth at 2 steps or more, received {len(day.z)} steps, "
                             f"{int(day.truth.isnan().any(-1).sum())} without")  # fmt: skip
    rng = torch.Generator().manual_seed(seed)
    parts = [heard(part, filters, extended) for day in days for part in (day, varied(day, rng))]
    signals, positions, truth = (
        torch.cat([x.reshape(-1, *x.shape[x.dim() - kept :]) for x in of])
        for of, kept in zip(zip(*parts, strict=True), (1, 2, 1), strict=True)
    )
    networks = []
    for number in progress(range(NETWORKS)):
        torch.manual_seed(NETWORKS * seed + number)
        network = Weight(signals)
        optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, ITERATIONS, RATE / 10)
        for _ in range(ITERATIONS):
            chosen = torch.randint(len(truth), (BATCH,), generator=rng)
            weight = network(signals[chosen])
            error = (weighed(weight, positions[chosen]) - truth[chosen]).square().sum(-1)
            loss = SCALE**2 * (error / SCALE**2).log1p().mean() + PENALTY * (weight - 0.5).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        networks.append(network)
    return networks


def weighed(weight: Tensor, positions: Tensor) -> Tensor:
    """Positions ``(..., 2)`` of both filters ``(..., 2, 2)``, of which the second has a weight ``(...)``."""
    first, second = positions.unbind(-2)
    return first + weight.unsqueeze(-1) * (second - first)
