"""A target that turns, seen by a lidar, and the OKF: a Kalman filter whose noise learns from squared errors.

It is of constant velocity, with any covariance of the process noise of a step ``(4, 4)`` and of the measurement noise
``(2, 2)``.  They are sample covariances of what the models are off in tracks with a truth (KF), or are learned from
there by the squared error of positions (OKF).

Source: Greenberg, Yannay & Mannor (2023), "Optimization or Architecture: How to Hack Kalman Filtering", for the target,
the lidar, the start of a track and how the OKF learns; numbers that the paper does not print are those of the example
that its authors have published with it ("simple lidar").
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.hyper import Hyper
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian

PLACE, SPEEDS = 600.0, (30.0, 90.0)
"""A start is at most so far off in x and y, m, and has one of these speeds, m/s."""
INTERVALS, LENGTHS = (4, 6), (5, 8)
"""How many parts of constant acceleration a track has, and how many steps of a second each, the ends included."""
ALONG, ACROSS = 2.0, 15.0
"""Accelerations of a part, m/s^2: the standard deviation along the path, and the largest across."""
RANGE, BEARING = 2.0, math.radians(1.5)
"""Standard deviations of the lidar, m and rad."""
START, LEAST = 1e3, 1e-6
"""Variances of each component: of the state at the first measurement, before it counts; added to those of samples."""
BATCH, RATE, CLIP, HALVED, VALID = 10, 1e-2, 1.0, 150, 0.15
"""Of the OKF: tracks of an iteration, Adam's rate, the largest norm of a gradient, iterations until the rate is halved,
and the share of the tracks by which the best values are chosen."""
VALIDATED = 30
"""Iterations between validations."""


class Tracks(NamedTuple):
    """Tracks of different lengths, which end in NaN."""

    truth: Tensor
    """``(B, T, 4)`` positions, m, and velocities, m/s."""
    z: Tensor
    """``(B, T, 2)`` measured positions, m."""

    def rows(self, index: Tensor | slice) -> Tracks:
        """Some of the tracks."""
        return Tracks(self.truth[index], self.z[index])

    @property
    def polar(self) -> Tensor:
        """``(B, T, 2)`` the same measurements as ranges, m, and bearings clockwise from +y, rad."""
        return torch.stack([self.z.norm(dim=-1), torch.atan2(self.z[..., 0], self.z[..., 1])], -1)


def simulate(runs: int, seed: int) -> Tracks:
    """Tracks of a target that goes straight and turns in parts of constant acceleration."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(runs, *shape, generator=rng, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(runs, *shape, generator=rng, dtype=torch.float64)

    most, steps = INTERVALS[1], INTERVALS[1] * LENGTHS[1]
    parts = uniform(INTERVALS[0], INTERVALS[1] + 1, 1).long()
    ends = uniform(LENGTHS[0], LENGTHS[1] + 1, most).long().cumsum(-1)
    part = (torch.arange(steps) >= ends.unsqueeze(-1)).sum(1)  # (B, T) number of the part that a step is in
    lasts = part < parts
    along, across = (
        x.gather(1, part.clamp_max(most - 1)) for x in (ALONG * normal(most), uniform(-ACROSS, ACROSS, most))
    )
    heading, speed = uniform(0.0, 2 * math.pi), uniform(*SPEEDS)
    place, velocity = uniform(-PLACE, PLACE, 2), speed.unsqueeze(-1) * torch.stack([heading.cos(), heading.sin()], -1)
    states = [torch.cat([place, velocity], -1)]
    for forward, aside in zip(along.unbind(-1), across.unbind(-1), strict=True):
        ahead = velocity / velocity.norm(dim=-1, keepdim=True)
        left = torch.stack([-ahead[:, 1], ahead[:, 0]], -1)
        acceleration = forward.unsqueeze(-1) * ahead + aside.unsqueeze(-1) * left
        place, velocity = place + velocity + acceleration / 2, velocity + acceleration
        states.append(torch.cat([place, velocity], -1))
    there = torch.cat([torch.ones(runs, 1, dtype=torch.bool), lasts], 1)
    truth = torch.where(there.unsqueeze(-1), torch.stack(states, 1), torch.nan)
    distance = truth[..., :2].norm(dim=-1) + RANGE * normal(steps + 1)
    bearing = torch.atan2(truth[..., 1], truth[..., 0]) + BEARING * normal(steps + 1)
    return Tracks(truth, distance.unsqueeze(-1) * torch.stack([bearing.cos(), bearing.sin()], -1))


# ---------------------------------------------------------------- covariances of any form


class Cholesky(nn.Module):
    """A covariance ``(n, n)`` by its lower root: logarithms of the diagonal, and what is below, are free numbers."""

    def __init__(self, covariance: Tensor) -> None:
        super().__init__()
        root = torch.linalg.cholesky(covariance)
        row, column = torch.tril_indices(len(root), len(root), -1)
        self.diagonal = Hyper(root.diagonal(), event_dim=1, name="diagonal")
        self.below = Hyper(root[row, column], constraints.real, event_dim=1, name="below")
        places = torch.zeros(len(row), *root.shape, dtype=root.dtype)
        places[torch.arange(len(row)), row, column] = 1.0
        self.register_buffer("places", places, persistent=False)

    def forward(self, like: Tensor) -> Tensor:
        """The root ``(..., n, n)``."""
        diagonal, below = self.diagonal(like), self.below(like)
        return torch.diag_embed(diagonal) + (below[..., None, None] * self.places.to(like)).sum(-3)


class AnyNoise(ConstantVelocity):
    """Constant velocity with process noise of any covariance ``(4, 4)`` in a step of 1 s, and none in one of 0 s."""

    def __init__(self, covariance: Tensor) -> None:
        super().__init__(1.0)
        del self.q
        self.noise = Cholesky(covariance)

    def process_noise(self, dt: Tensor) -> Tensor:
        """Its root ``(..., 4, 4)``."""
        return self.noise(dt) * dt[..., None, None]


class AnyPosition(Position):
    """The position, with noise of any covariance ``(2, 2)``."""

    def __init__(self, covariance: Tensor) -> None:
        super().__init__(noise=torch.linalg.cholesky(covariance))
        self.noise = Cholesky(covariance)

    def measurement_noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> MeasurementNoise:
        """As it is learned, where a measurement has none of its own."""
        return super().measurement_noise(z, std, self.noise(z) if std is None and root is None else root)


def sampled(tracks: Tracks) -> tuple[Tensor, Tensor]:
    """Sample covariances of process ``(4, 4)`` and measurement noise ``(2, 2)``.

    A position is off by half of what its velocity is, so that the first is singular but for ``LEAST``.
    """
    truth = tracks.truth
    moved = torch.cat([truth[..., :2] + truth[..., 2:], truth[..., 2:]], -1)
    off, missed = truth[:, 1:] - moved[:, :-1], tracks.z - truth[..., :2]
    process, measured = (x[~x.isnan().any(-1)].mT.cov() for x in (off, missed))
    least = LEAST * torch.eye(4, dtype=truth.dtype)
    return process + least, measured + least[:2, :2]


def prior(tracks: Tracks) -> Gaussian:
    """The belief at the first measurement of each track before it counts: there, at rest, and wide."""
    mean = torch.cat([tracks.z[:, 0], torch.zeros_like(tracks.z[:, 0])], -1)
    return Gaussian(mean, START**0.5 * torch.eye(4, dtype=mean.dtype))


def squared(means: Tensor, tracks: Tracks) -> Tensor:
    """Squared distance ``(B,)`` from the true positions, summed over the steps of each track."""
    truth = tracks.truth[..., :2]
    return torch.where(truth.isnan(), 0.0, means[..., :2] - truth).square().sum((-1, -2))


def mse(means: Tensor, tracks: Tracks) -> Tensor:
    """Mean of the squared distance over all steps of all tracks, m^2."""
    return squared(means, tracks).sum() / (~tracks.truth[..., 0].isnan()).sum()


# ---------------------------------------------------------------- the OKF


class OKF(nn.Module):
    """A Kalman filter of constant velocity in plain torch, with the covariances of ``sampled`` to begin with."""

    def __init__(self, tracks: Tracks) -> None:
        super().__init__()
        self.process, self.measurement = (Cholesky(x) for x in sampled(tracks))
        for part in (self.process, self.measurement):
            part.diagonal.learn()
            part.below.learn()

    def forward(self, z: Tensor) -> Tensor:
        """Estimates ``(B, T, 4)`` of measurements ``(B, T, 2)``; after the last one they are predictions."""
        q, r = (root @ root.mT for root in (self.process(z), self.measurement(z)))
        f = torch.eye(4, dtype=z.dtype) + torch.diag(torch.ones(2, dtype=z.dtype), 2)
        h, one = torch.eye(2, 4, dtype=z.dtype), torch.eye(4, dtype=z.dtype)
        mean, covariance = torch.cat([z[:, 0], torch.zeros_like(z[:, 0])], -1), START * one
        means = []
        for step, measured in enumerate(z.unbind(1)):
            if step:
                mean, covariance = mean @ f.mT, f @ covariance @ f.mT + q
            gain = covariance @ h.mT @ torch.linalg.inv(h @ covariance @ h.mT + r)
            mean = mean + torch.where(measured.isnan(), 0.0, measured - mean @ h.mT) @ gain.mT
            left = one - gain @ h
            covariance = left @ covariance @ left.mT + gain @ r @ gain.mT
            means.append(mean)
        return torch.stack(means, 1)


def optimised(okf: OKF, tracks: Tracks, seed: int, epochs: int = 1, together: bool = True) -> OKF:
    """The filter after Adam has followed the squared errors of batches of tracks.

    Args:
        okf: it learns.
        tracks: to learn from; the last of them choose among the values of its validations.
        seed: of the order of the tracks.
        epochs: how often each track is seen.
        together: whether the tracks of a batch go through the filter together; its authors take one at a time.
    """
    rng, count = torch.Generator().manual_seed(seed), round((1 - VALID) * len(tracks.z))
    train, valid = tracks.rows(slice(count)), tracks.rows(slice(count, None))
    optimiser = torch.optim.Adam(okf.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.StepLR(optimiser, HALVED, 0.5)
    best, values = math.inf, okf.state_dict()
    batches = [b for _ in range(epochs) for b in torch.randperm(count, generator=rng).split(BATCH) if len(b) == BATCH]
    for number, chosen in enumerate(batches, 1):
        batch = train.rows(chosen)
        parts = batch.z.split(BATCH if together else 1)
        loss = mse(torch.cat([okf(part) for part in parts]), batch)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(okf.parameters(), CLIP)
        optimiser.step()
        schedule.step()
        if number % VALIDATED == 0 or number == len(batches):
            with torch.no_grad():
                score = float(mse(okf(valid.z), valid))
            if score < best:
                best, values = score, {name: x.clone() for name, x in okf.state_dict().items()}
    okf.load_state_dict(values)
    return okf
