"""How good the satellite positions and wheels of a robot are now: a network reads it from their last seconds.

A filter takes what it says in place of the data sheet: a standard deviation of each position, and the wheels' speed,
corrected.  It learns on days with a truth, by the errors of the filtered positions, so through the filter.  Pieces of a
day are varied, as a day has few faults: in half of them the errors of positions are those of another time of the day,
turned by any angle, and in all they are larger or smaller by a factor.  A penalty holds what it says near the values
that the filter has without it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra import losses
from torchfra.angles import wrap
from torchfra.filters import Filter
from torchfra.types import Gaussian

LAGS, MEMORIES = (1, 3, 10, 30, 100), (30, 150)
"""Steps over which the ways of positions and wheels are compared, and over which the gaps between them are averaged."""
UNITS = 16
STD_RANGE, SPEED_RANGE = 2.5, 0.2
"""Largest logarithms of factors on the first standard deviation and on the speed."""
ITERATIONS, PIECES, LENGTH = 300, 16, 600
"""Of learning: steps of Adam, pieces of the day in each, and steps of a piece."""
RATE, DECAY, CLIP = 3e-3, 1e-3, 1.0
"""Of Adam: its rate, which falls to a tenth, the weight decay, and the largest norm of a gradient."""
MOVED, FACTORS = 0.5, (0.5, 3.0)
"""Share of the pieces with errors of another time, and the factors on errors, log-uniform."""
SCALE = 10.0
"""Error of a piece, m, from which on it counts by its logarithm."""
PENALTY = 0.02
"""On the mean squares of what the network says: of the logarithm of the factor on the standard deviation, and of that
of the factor on the speed as a part of its range."""


class Day(NamedTuple):
    """Pieces of a day, or all of it."""

    z: Tensor
    """``(..., T, 2)`` positions, m, NaN without a new fix."""
    u: Tensor
    """``(..., T, 2)`` speed of the wheels, m/s, and heading, rad."""
    truth: Tensor
    """``(..., T, 2)`` m."""
    prior: Gaussian


class Quality(nn.Module):
    """Standard deviations of positions and corrected speeds from the signals until now.

    Args:
        std: standard deviation that it begins with, m.
        scale: logarithm of the wheels' scale.
    """

    def __init__(self, std: float, scale: float) -> None:
        super().__init__()
        self.std, self.scale = std, scale
        self.positions = perceptron(len(LAGS) * (1 + len(MEMORIES)) + 1)
        self.wheels = perceptron(4)

    def forward(self, z: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Standard deviations ``(B, T, 2)``, m, and ``u (B, T, 2)``, corrected, of ``z`` and ``u`` of that shape."""
        return self.applied(z, u, *self.factors(z, u))

    def factors(self, z: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithms ``(B, T, 1)`` of the factors on the standard deviation and on the speed."""
        return (
            STD_RANGE * said(self.positions, of_positions(z, self.way(u))),
            SPEED_RANGE * said(self.wheels, of_wheels(u)),
        )

    def applied(self, z: Tensor, u: Tensor, log_std: Tensor, log_speed: Tensor) -> tuple[Tensor, Tensor]:
        """What ``forward`` returns, by these."""
        return (self.std * log_std.exp()).expand_as(z), torch.cat([u[..., :1] * log_speed.exp(), u[..., 1:]], -1)

    def way(self, u: Tensor) -> Tensor:
        """``(B, T, 2)`` m from the start, by the wheels alone."""
        speed, heading = u.unbind(-1)
        steps = torch.stack([heading.cos(), heading.sin()], -1) * (speed * math.exp(self.scale)).unsqueeze(-1)
        return steps.cumsum(1)


def perceptron(signals: int) -> nn.Sequential:
    """A number from signals ``(N, signals)``, at first 0; while it is in training mode it learns their usual size."""
    last = nn.Linear(UNITS, 1)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(
        nn.BatchNorm1d(signals, momentum=None, affine=False), nn.Linear(signals, UNITS), nn.Tanh(), last
    )


def said(network: nn.Module, signals: Tensor) -> Tensor:
    """What a network says of signals ``(B, T, k)``: ``(B, T, 1)`` between -1 and 1."""
    found: Tensor = network(signals.float().flatten(0, 1)).tanh().unflatten(0, signals.shape[:2])
    return found.to(signals)


def of_positions(z: Tensor, way: Tensor) -> Tensor:
    """``(B, T, k)``: how far positions and wheels disagree on the way of the last seconds, and the age of the fix."""
    measured, place = ~z[..., 0].isnan(), torch.arange(z.shape[1])
    last = torch.where(measured, place, -1).cummax(1).values
    fix = z.gather(1, last.clamp_min(0).unsqueeze(-1).expand_as(z))
    ever, gap = last >= 0, fix - way
    found = []
    for lag in LAGS:
        known = ever & delayed(ever, lag)
        apart = torch.where(known.unsqueeze(-1), gap - delayed(gap, lag), 0.0).norm(dim=-1).log1p()
        total = apart.cumsum(1)
        found += [apart, *((total - delayed(total, n)) / n for n in MEMORIES)]
    age = (place - last).to(z)
    return torch.stack([*found, age.log1p()], -1)


def of_wheels(u: Tensor) -> Tensor:
    """``(B, T, 4)``: the speed, what it was less now, how far the heading has turned, and its size."""
    speed, heading = u.unbind(-1)
    turn = wrap(heading - torch.cat([heading[:, :1], heading[:, :-1]], 1))
    before = torch.cat([speed[:, :1], speed[:, :-1]], 1)
    return torch.stack([speed, before - speed, turn, turn.abs()], -1)


def delayed(x: Tensor, lag: int) -> Tensor:
    """``x (B, T, ...)`` so many steps later, 0 before."""
    return torch.cat([torch.zeros_like(x[:, :lag]), x[:, :-lag]], 1)


def varied(day: Day, beliefs: Gaussian, rng: torch.Generator) -> Day:
    """Pieces of a day; ``beliefs (T, n)`` of a filter are what they begin with."""
    steps, length = len(day.z), min(LENGTH, len(day.z) - 1)

    def pieces() -> Tensor:
        return torch.randint(1, steps - length + 1, (PIECES, 1), generator=rng) + torch.arange(length)

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
    before = here[:, 0] - 1
    return Day(
        day.truth[here] + factor * turned, day.u[here], day.truth[here],
        Gaussian(beliefs.mean[before], beliefs.scale_tril[before]),
    )  # fmt: skip


def learned(
    days: Sequence[Day],
    f: Filter,
    std: float,
    scale: float,
    seed: int = 0,
    progress: Callable[[range], Iterable[int]] = iter,
) -> Quality:
    """The network after Adam has followed the errors of the filter's positions on some days.

    Args:
        days: all of each; an iteration has pieces of one of them, the more often the longer it is.
        f: the filter, which itself does not learn.
        std: standard deviation of a position that the network begins with, m.
        scale: logarithm of the wheels' scale.
        seed: of the network's first weights and of the pieces.
        progress: from the numbers of iterations to the same, as they are shown.

    Raises:
        ValueError: a day of less than 2 steps, or without a truth at some of them.
    """
    for day in days:
        if len(day.z) < 2 or not bool(day.truth.isfinite().all()):
            raise ValueError(f"network: expected a day with a truth at 2 steps or more, received {len(day.z)} steps, "
                             f"{int(day.truth.isnan().any(-1).sum())} without")  # fmt: skip
    torch.manual_seed(seed)
    rng, network = torch.Generator().manual_seed(seed), Quality(std, scale)
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, ITERATIONS, RATE / 10)
    beliefs, steps = [], torch.tensor([float(len(day.z)) for day in days])
    with torch.no_grad():
        for day in days:
            network(day.z.unsqueeze(0), day.u.unsqueeze(0))  # what is usual: the network's units of its signals
            beliefs.append(Gaussian(*f(day.z, day.prior, u=day.u)[:2]))
    network.eval()  # and these stay
    for _ in progress(range(ITERATIONS)):
        chosen = int(torch.multinomial(steps, 1, generator=rng))
        piece = varied(days[chosen], beliefs[chosen], rng)
        log_std, log_speed = network.factors(piece.z, piece.u)
        stds, u = network.applied(piece.z, piece.u, log_std, log_speed)
        estimate = f(piece.z, piece.prior, u=u, std=stds)
        loss = losses.robust_mse(estimate.mean, piece.truth, slice(0, 2), SCALE * math.sqrt(2)).mean()
        loss = loss + PENALTY * (log_std.square().mean() + (log_speed / SPEED_RANGE).square().mean())
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), CLIP)
        optimiser.step()
        schedule.step()
    return network
