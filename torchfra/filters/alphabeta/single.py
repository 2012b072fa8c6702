"""One filter of constant gains, and what it shares with a bank of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.filters.alphabeta import gains as design
from torchfra.filters.alphabeta.gains import Gains
from torchfra.filters.base import Mix
from torchfra.filters.records import Record
from torchfra.filters.tracks import TrackFilter
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Value
from torchfra.linalg.tracing import is_traced
from torchfra.motion.base import Motion
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.sensors.base import Sensor
from torchfra.sensors.position import Position
from torchfra.types import Gaussian


class AlphaBetaState(NamedTuple):
    """What one filter knows after a step."""

    mean: Tensor
    """``(..., n)``."""
    root: Tensor
    """``(..., p, d)`` the entries of the covariance's root that are not zero, for each axis."""
    used: Tensor
    """``(..., d)`` measurements that were used."""
    since: Tensor
    """``(..., d)`` seconds since the last of them."""
    interval: Tensor
    """``(..., d)`` seconds between the last two."""

    @property
    def belief(self) -> Gaussian:
        """The estimate, with the steady-state covariance of its gains."""
        return Gaussian(self.mean, unfolded(self.root, self.mean.shape[-1]))


class Gained(TrackFilter):
    """Abstract: a filter of positions, axis by axis."""

    def __init__(self, motion: Motion, sensor: Sensor, start: str, period: Value | None) -> None:
        if not isinstance(sensor, Position) or sensor.std is None:
            raise ValueError(f"sensor: expected a Position with a std, received {type(sensor).__name__}")
        if not isinstance(motion, ConstantVelocity | ConstantAcceleration) or motion.dims != sensor.size:
            raise ValueError(
                f"motion: expected constant velocity or acceleration in {sensor.size} dimensions, received {motion}"
            )
        if start not in ("points", "prior"):
            raise ValueError(f"start: expected 'points' or 'prior', received {start!r}")
        super().__init__(motion, sensor)
        self.start = start
        self.period = None if period is None else Hyper(period, name="period")

    def _first(self, belief: Gaussian) -> tuple[Tensor, Tensor, Tensor]:
        """Mean to start from, zeros ``(..., d)``, and the measurements it counts for."""
        d = self.motion.dims
        nothing = torch.zeros_like(belief.mean[..., :d])
        if self.start == "prior":
            return belief.mean, nothing, nothing + 2
        zeros = [nothing] * (self.motion.orders - 1)
        return torch.cat([belief.mean[..., :d], *zeros], -1), nothing, nothing

    def finish(self, state: Any, belief: Gaussian, info: Any) -> tuple[Gaussian, Any]:
        """See ``Filter``."""
        return Gaussian(belief.mean, unfolded(belief.scale_tril, belief.mean.shape[-1])), info


class AlphaBeta(Gained):
    """Alpha-beta filter, or alpha-beta-gamma with a motion of constant acceleration.

    The first two measurements make position and velocity.  ``Estimate.scale_tril`` is the steady state's for the noise
    of the sensor, whatever the track has seen so far; velocities follow the time step.

    Args:
        motion: constant velocity (two gains) or acceleration (three; with two the acceleration stays 0); only its
            dimensions and orders count.
        sensor: a ``Position``.
        gains: ``torchfra.gains``.
        expanding: use the gains of a least-squares line until they have fallen to ``gains`` (two gains only).
        start: ``"points"`` from the first two measurements, or ``"prior"``.
        period: seconds between measurements that the gains are meant for: those of shorter steps are smaller.  Where
            steps differ much constant gains are not stable, and it should be near the longest; None for steps that
            hardly differ.

    Raises:
        ValueError: gains that are not stable, or a motion or a sensor of another kind.

    Source: Kalata (1984); Bar-Shalom, Li & Kirubarajan (2001), section 6.5.
    """

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        gains: Gains,
        *,
        expanding: bool = False,
        start: str = "points",
        period: Value | None = None,
    ) -> None:
        super().__init__(motion, sensor, start, period)
        if (gains.gamma is not None and motion.orders == 2) or not design.stable(gains):
            raise ValueError(f"gains: expected stable ones, at most {motion.orders}, received {gains}")
        if expanding and gains.gamma is not None:
            raise ValueError("expanding: expected two gains, received three")
        self.alpha = Hyper(gains.alpha, constraints.unit_interval, name="alpha")
        self.beta = Hyper(gains.beta, constraints.interval(0.0, 4.0), name="beta")
        self.gamma = None if gains.gamma is None else Hyper(gains.gamma, constraints.nonnegative, name="gamma")
        self.expanding = expanding

    def begin(self, belief: Gaussian) -> AlphaBetaState:
        """See ``Filter``."""
        mean, nothing, count = self._first(belief)
        entries = nothing.unsqueeze(-2).expand(*nothing.shape[:-1], 3 if self.gamma is None else 6, -1)
        return AlphaBetaState(mean, entries, count, nothing, nothing + 1)

    def advance(self, state: AlphaBetaState, frame: Frame, mix: Mix | None = None) -> tuple[AlphaBetaState, Record]:
        """See ``Filter``."""
        d, k = self.motion.dims, self.motion.orders
        dt, since = frame.dt.unsqueeze(-1), state.since + frame.dt.unsqueeze(-1)
        parts = state.mean.unflatten(-1, (k, d)).unbind(-2)
        ahead = predicted_parts(parts, dt)
        residual = frame.seen * (frame.z - ahead[0])
        alpha, beta = (h(residual).unsqueeze(-1) for h in (self.alpha, self.beta))
        column = [alpha, beta] + ([] if self.gamma is None else [self.gamma(residual).unsqueeze(-1) / 2])
        entries, variance = two_gains(alpha, beta) if self.gamma is None else three_gains(alpha, beta, 2 * column[2])
        interval = torch.where(frame.seen > 0, since, state.interval)
        root, spread = scaled(entries, interval, frame.measurement_noise.std), variance.sqrt()
        if self.expanding:
            line = design.expanding_memory(state.used + 1)
            column = [torch.maximum(*pair) for pair in zip(column, line[:2], strict=True)]
        column = started(shortened(column, since, self.period), state.used)
        moved = updated_parts(ahead, column, since, residual)
        used, since = state.used + frame.seen, since * (1 - frame.seen)
        mean = torch.cat(moved, -1)
        root = root.expand(*mean.shape[:-1], *root.shape[-2:])
        state = AlphaBetaState(mean, root, used, since, interval)
        return state, kept(state, residual, frame, spread, None)


def predicted_parts(parts: tuple[Tensor, ...], dt: Tensor) -> list[Tensor]:
    """Position, velocity(, acceleration) after ``dt``."""
    if len(parts) == 2:
        return [parts[0] + dt * parts[1], parts[1]]
    p, v, a = parts
    return [p + dt * v + dt**2 / 2 * a, v + dt * a, a]


def updated_parts(ahead: list[Tensor], column: list[Tensor], since: Tensor, residual: Tensor) -> list[Tensor]:
    """What was predicted after a residual; what has no gain is 0."""
    moved = [x + g / since**i * residual for i, (x, g) in enumerate(zip(ahead, column, strict=False))]
    return moved + [torch.zeros_like(residual) for _ in ahead[len(column) :]]


def shortened(column: list[Tensor], since: Tensor, period: Hyper | None) -> list[Tensor]:
    """Gains for a step shorter than they are meant for, as those of a tracking index that falls with its square."""
    if period is None:
        return column
    share = (since / period(since).unsqueeze(-1)).clamp_max(1.0)
    return [gain * share ** (i + 1) for i, gain in enumerate(column)]


def started(column: list[Tensor], count: Tensor) -> list[Tensor]:
    """Gains of the first measurement (a position), of the second (a velocity), and then as they are."""
    first = [1.0] + [0.0] * (len(column) - 1)
    second = [1.0, 1.0] + [0.0] * (len(column) - 2)
    return [
        torch.where(count < 0.5, a, torch.where(count < 1.5, b, gain))
        for a, b, gain in zip(first, second, column, strict=True)
    ]


def two_gains(alpha: Tensor, beta: Tensor) -> tuple[list[Tensor], Tensor]:
    """Entries of the steady state's root, row by row, and the variance of the residual, for a noise of 1."""
    position, cross, velocity, ahead = design.variances(alpha, beta)
    first = position.sqrt()
    along = cross / first
    return [first, along, (velocity - along.square()).sqrt()], 1 + ahead


def three_gains(alpha: Tensor, beta: Tensor, gamma: Tensor) -> tuple[list[Tensor], Tensor]:
    """The same for three gains."""
    rows = [[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]
    transition = torch.tensor(rows, dtype=alpha.dtype, device=alpha.device)
    root = design.steady_root(transition, torch.stack([alpha, beta, gamma / 2], -1))
    ahead = (transition[0].unsqueeze(-2) @ root).squeeze(-2)
    return [root[..., i, j] for i in range(3) for j in range(i + 1)], 1 + ahead.square().sum(-1)


def scaled(entries: Sequence[Tensor], dt: Tensor, std: Tensor) -> Tensor:
    """Entries ``(..., p, d)`` for this time step and noise."""
    rows = [i for i in range(3) for _ in range(i + 1)]
    scaled = [entry / dt**i * std for i, entry in zip(rows, entries, strict=False)]
    return torch.stack(torch.broadcast_tensors(*scaled), -2)


def unfolded(entries: Tensor, n: int) -> Tensor:
    """``(..., n, n)`` root from its entries ``(..., p, d)``; states without any are certain."""
    p, d = entries.shape[-2:]
    places = [(row, column) for row in range(3) for column in range(row + 1)][:p]
    if not is_traced(entries) and entries.dim() > 3 and entries.stride(0) == 1:
        # From kernels tracks lie side by side: so they stay.
        batch = entries.shape[:-2]
        whole = entries.new_zeros((*batch[1:], n, n, batch[0])).movedim(-1, 0)
        for i, (row, column) in enumerate(places):
            block = whole[..., row * d : (row + 1) * d, column * d : (column + 1) * d]
            block.diagonal(dim1=-2, dim2=-1).copy_(entries[..., i, :])
        return whole
    place = torch.zeros(p * d, n * n, dtype=entries.dtype, device=entries.device)
    for i, (row, column) in enumerate(places):
        for axis in range(d):
            place[i * d + axis, (row * d + axis) * n + column * d + axis] = 1
    spread: Tensor = (entries.flatten(-2) @ place).unflatten(-1, (n, n))
    return spread


def kept(state: Any, residual: Tensor, frame: Frame, spread: Tensor, info: Any) -> Record:
    """What is kept of a step; the covariance unfolds in ``finish``."""
    std = spread.expand_as(residual)
    whitened = residual * frame.measurement_noise.scale
    std = torch.where(frame.seen > 0, std, 1.0)
    return Record(Gaussian(state.mean, state.root), whitened, std.diag_embed(), whitened / std, info)
