"""The OKF: a Kalman filter whose noise learns from squared errors.

It is of constant velocity in steps of a second, with any covariance of the process noise of a step and of the
measurement noise.  They are sample covariances of what the models are off in tracks with a truth (KF), or are learned
from there by the squared error of positions (OKF).

Source: Greenberg, Yannay & Mannor (2023), "Optimization or Architecture: How to Hack Kalman Filtering"; how many tracks
make an iteration and the rates are those of the example that its authors have published with it ("simple lidar").
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.hyper import Hyper
from torchfra.motion import ConstantVelocity
from torchfra.types import Gaussian

LEAST = 1e-6
"""Added to the variances of samples."""
BATCH, RATE, CLIP, HALVED, VALID = 10, 1e-2, 1.0, 150, 0.15
"""Tracks of an iteration, Adam's rate, the largest norm of a gradient, iterations until the rate is halved, and the
share of the tracks by which the best values are chosen."""
VALIDATED = 30
"""Iterations between validations."""


class Tracks(NamedTuple):
    """Tracks of different lengths, which end in NaN."""

    truth: Tensor
    """``(B, T, 2 d)`` positions, m, and velocities, m/s."""
    z: Tensor
    """``(B, T, m)`` measurements, of which the first ``d`` are the position, m."""

    @property
    def lasts(self) -> Tensor:
        """``(B, T)`` whether a track has this step."""
        return ~self.truth[..., 0].isnan()

    def rows(self, index: Tensor | slice) -> Tracks:
        """Some of the tracks, as long as the longest of them."""
        some = Tracks(self.truth[index], self.z[index])
        longest = int(some.lasts.sum(1).max())
        return Tracks(some.truth[:, :longest], some.z[:, :longest])


def draws(runs: int, seed: int) -> tuple[Callable[..., Tensor], Callable[..., Tensor]]:
    """Uniform numbers ``(runs, ...)``, by ``uniform(low, high, *shape)``, and ``normal(*shape)`` ones, of one seed."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(runs, *shape, generator=rng, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(runs, *shape, generator=rng, dtype=torch.float64)

    return uniform, normal


class Model(NamedTuple):
    """What a Kalman filter assumes besides its noise."""

    matrix: Callable[[Tensor], Tensor]
    """From a position ``(..., d)`` to what is measured of a state there, ``H (..., m, 2 d)``."""
    start: Callable[[Tensor], Tensor]
    """From first measurements ``(B, m)`` to first states ``(B, 2 d)``."""
    variance: float
    """Of each component of the state at the first measurement, before it counts."""


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
    """Constant velocity with process noise of any covariance ``(2 d, 2 d)`` in a step of 1 s, none in one of 0 s."""

    def __init__(self, covariance: Tensor) -> None:
        super().__init__(1.0, len(covariance) // 2)
        del self.q
        self.noise = Cholesky(covariance)

    def process_noise(self, dt: Tensor) -> Tensor:
        """Its root ``(..., 2 d, 2 d)``."""
        return self.noise(dt) * dt[..., None, None]


def sampled(tracks: Tracks, model: Model) -> tuple[Tensor, Tensor]:
    """Sample covariances of process ``(2 d, 2 d)`` and measurement noise ``(m, m)``.

    A position that is off by half of what its velocity is makes the first singular but for ``LEAST``.
    """
    place, velocity = tracks.truth.chunk(2, -1)
    moved = torch.cat([place + velocity, velocity], -1)
    expected = (model.matrix(place) @ tracks.truth.unsqueeze(-1)).squeeze(-1)
    off, missed = tracks.truth[:, 1:] - moved[:, :-1], tracks.z - expected
    process, measured = (x[~x.isnan().any(-1)].mT.cov() for x in (off, missed))
    return tuple(x + LEAST * torch.eye(len(x), dtype=x.dtype) for x in (process, measured))  # type: ignore[return-value]


def prior(tracks: Tracks, model: Model) -> Gaussian:
    """The belief at the first measurement of each track before it counts: wide around the model's first state."""
    mean = model.start(tracks.z[:, 0])
    return Gaussian(mean, model.variance**0.5 * torch.eye(mean.shape[-1], dtype=mean.dtype))


def squared(means: Tensor, tracks: Tracks) -> Tensor:
    """Squared distance ``(B,)`` from the true positions, summed over the steps of each track."""
    dims = tracks.truth.shape[-1] // 2
    truth = tracks.truth[..., :dims]
    return torch.where(truth.isnan(), 0.0, means[..., :dims] - truth).square().sum((-1, -2))


def mse(means: Tensor, tracks: Tracks) -> Tensor:
    """Mean of the squared distance over all steps of all tracks, m^2."""
    return squared(means, tracks).sum() / tracks.lasts.sum()


# ---------------------------------------------------------------- the OKF


class OKF(nn.Module):
    """A Kalman filter of constant velocity in plain torch, with the covariances of ``sampled`` to begin with."""

    def __init__(self, tracks: Tracks, model: Model) -> None:
        super().__init__()
        self.model = model
        self.process, self.measurement = (Cholesky(x) for x in sampled(tracks, model))
        for part in (self.process, self.measurement):
            part.diagonal.learn()
            part.below.learn()

    def forward(self, z: Tensor) -> Tensor:
        """Estimates ``(B, T, 2 d)`` of measurements ``(B, T, m)``; after the last one they stay finite."""
        q, r = (root @ root.mT for root in (self.process(z), self.measurement(z)))
        n = len(q)
        one, f = torch.eye(n, dtype=z.dtype), torch.eye(n, dtype=z.dtype)
        f = f + torch.diag(torch.ones(n // 2, dtype=z.dtype), n // 2)
        mean, covariance, means = self.model.start(z[:, 0]), self.model.variance * one, []
        for step, measured in enumerate(z.unbind(1)):
            if step:
                mean, covariance = mean @ f.mT, f @ covariance @ f.mT + q
            h = self.model.matrix(measured[:, : n // 2].nan_to_num(1.0))
            gain = covariance @ h.mT @ torch.linalg.inv(h @ covariance @ h.mT + r)
            gap = torch.where(measured.isnan(), 0.0, measured - (h @ mean.unsqueeze(-1)).squeeze(-1))
            mean = mean + (gain @ gap.unsqueeze(-1)).squeeze(-1)
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
        parts = [train.rows(part) for part in chosen.split(BATCH if together else 1)]
        errors = torch.cat([squared(okf(part.z), part) for part in parts])
        loss = errors.sum() / sum(int(part.lasts.sum()) for part in parts)
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
