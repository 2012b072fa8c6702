"""Constant gains: the base of such filters, the one of a single set of gains, and their arithmetic, axis by axis."""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple, TypeAlias, TypeVar

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.filters.alphabeta import gains as design
from torchfra.filters.alphabeta.gains import Gains
from torchfra.filters.base import Filter
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_divide, safe_sqrt
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import tria
from torchfra.motion.base import Motion
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.sensors.base import Sensor
from torchfra.sensors.position import Position
from torchfra.steps.records import Record
from torchfra.steps.recursion import Limits, S
from torchfra.types import Gaussian

T = TypeVar("T")  # an info
Rows: TypeAlias = list[list[Tensor]]
"""Rows of the covariance roots of all axes: entry i, j is ``(..., d)``."""


def measures_positions(sensor: Sensor) -> bool:
    """Whether a sensor measures positions with one standard deviation, as constant gains need."""
    return isinstance(sensor, Position) and sensor.std is not None


def moves_along_axes(motion: Motion, dims: int) -> bool:
    """Whether a motion is one of constant velocity or acceleration in so many dimensions, as constant gains need."""
    return isinstance(motion, ConstantVelocity | ConstantAcceleration) and motion.dims == dims


class ConstantGainFilter(Filter[S]):
    """Abstract: a filter of positions, axis by axis."""

    gamma: Hyper | None

    def __init__(self, motion: Motion, sensor: Sensor, period: Value | None) -> None:
        if not measures_positions(sensor):
            raise ValueError(f"sensor: expected a Position with a std, received {type(sensor).__name__}")
        if not moves_along_axes(motion, sensor.size):
            raise ValueError(
                f"motion: expected constant velocity or acceleration in {sensor.size} dimensions, received {motion}"
            )
        super().__init__(motion, sensor)
        self.limits = Limits(
            smoothing=f"{type(self).__name__}: constant gains have no process noise, which the backward pass needs; "
            "smooth with presets.srckf, or a bank of motions",
            other_sensors="constant gains are chosen for one sensor's noise",
            zero_dt=False,
        )
        self.period = None if period is None else Hyper(period, name="period")

    def _first(self, belief: Gaussian) -> tuple[Tensor, Tensor]:
        """The initial mean, of which the first two measurements leave nothing, and zeros ``(..., d)``."""
        d = self.motion.dims
        zero = torch.zeros_like(belief.mean[..., :d])
        return torch.cat([belief.mean[..., :d], *[zero] * (self.motion.orders - 1)], -1), zero

    def _first_root(self, belief: Gaussian) -> Tensor:
        """Entries ``(..., p, d)`` of the covariance root of each axis."""
        return axis_roots(belief.scale_tril, self.motion.orders, 2 if self.gamma is None else 3)

    def _components(self, mean: Tensor) -> tuple[Tensor, ...]:
        """Position, velocity(, acceleration) ``(..., d)`` of a mean."""
        components: tuple[Tensor, ...] = mean.unflatten(-1, (self.motion.orders, self.motion.dims)).unbind(-2)
        return components

    def finish(self, state: S, belief: Gaussian, info: T) -> tuple[Gaussian, T]:
        """Beliefs of all steps with full roots; steps keep only the nonzero entries of roots."""
        return Gaussian(belief.mean, full_root(belief.scale_tril, belief.mean.shape[-1])), info


class AlphaBetaState(NamedTuple):
    """State of a single filter after a step."""

    mean: Tensor
    """``(..., n)``."""
    root: Tensor
    """``(..., p, d)`` nonzero entries of the covariance root of each axis."""
    used: Tensor
    """``(..., d)`` number of measurements used."""
    since: Tensor
    """``(..., d)`` seconds since the last used measurement."""

    @property
    def belief(self) -> Gaussian:
        """The estimate."""
        return Gaussian(self.mean, full_root(self.root, self.mean.shape[-1]))


class AlphaBeta(ConstantGainFilter[AlphaBetaState]):
    """Alpha-beta filter, or alpha-beta-gamma with a motion of constant acceleration.

    The first two measurements give position and velocity.  ``Estimate.scale_tril`` is a root of the covariance of
    errors by the prior and the measurement noise under these gains: it grows while measurements are missing, and
    otherwise reaches a steady state.  Errors by manoeuvres are not in it.

    Args:
        motion: constant velocity (two gains) or acceleration (three; with two the acceleration stays 0); only its
            dimensions and orders count.
        sensor: a ``Position``.
        gains: of the filter; ``torchfra.filters.alphabeta.gains`` has designs.
        expanding: use the gains of a least-squares line until they have fallen to ``gains`` (two gains only).
        period: seconds between measurements for which the gains are designed; shorter steps have smaller gains.  If
            steps differ much, constant gains are not stable without it; it should be near the longest step.  None for
            steps that hardly differ.

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
        period: Value | None = None,
    ) -> None:
        super().__init__(motion, sensor, period)
        if (gains.gamma is not None and motion.orders == 2) or not design.stable(gains):
            more = "" if motion.orders == 2 else ", or these and gamma"
            raise ValueError(f"gains: expected stable alpha and beta{more}, received {gains}")
        if expanding and gains.gamma is not None:
            raise ValueError("expanding: expected two gains, received three")
        self.alpha = Hyper(gains.alpha, constraints.unit_interval, name="alpha")
        self.beta = Hyper(gains.beta, constraints.interval(0.0, 4.0), name="beta")
        self.gamma = (
            None if gains.gamma is None else Hyper(gains.gamma, constraints.nonnegative, finite=True, name="gamma")
        )
        self.expanding = expanding

    def begin(self, belief: Gaussian) -> AlphaBetaState:
        """The state before the first measurement."""
        mean, zero = self._first(belief)
        return AlphaBetaState(mean, self._first_root(belief), zero, zero)

    def advance(self, state: AlphaBetaState, frame: Frame) -> tuple[AlphaBetaState, Record]:
        """One step: prediction, residual, update by the gains."""
        dt, since = frame.dt.unsqueeze(-1), state.since + frame.dt.unsqueeze(-1)
        predicted = predict_axes(self._components(state.mean), dt)
        residual = frame.measured * (frame.z - predicted[0])
        gains = self._gains(since, state.used)
        std, rows = frame.measurement_noise.std, predict_root(root_rows(state.root), dt)
        mean = torch.cat(update_axes(predicted, gains, since, residual), -1)
        root = corrected_root(rows, gains, since, frame.measured, std)
        root = root.expand(*mean.shape[:-1], *root.shape[-2:])
        state = AlphaBetaState(mean, root, state.used + frame.measured, since * (1 - frame.measured))
        return state, record(Gaussian(mean, root), residual, frame, residual_spread(rows, std), None)

    def _gains(self, since: Tensor, used: Tensor) -> list[Tensor]:
        """Gains of this step: larger for the first measurements, smaller for short steps."""
        gains = [h(since).unsqueeze(-1) for h in (self.alpha, self.beta)]
        gains += [] if self.gamma is None else [self.gamma(since).unsqueeze(-1) / 2]
        if self.expanding:
            line = design.expanding_memory(used + 1)
            gains = [torch.maximum(*pair) for pair in zip(gains, line[:2], strict=True)]
        return startup_gains(short_step_gains(gains, since, self.period), used)


# ---------------------------------------------------------------- arithmetic, axis by axis


def record(belief: Gaussian, residual: Tensor, frame: Frame, std: Tensor, info: object) -> Record:
    """The record of a step.

    Args:
        belief: mean and entries of the root after the step.
        residual: ``(..., d)``, 0 where nothing was measured.
        frame: of the step.
        std: ``(..., d)`` standard deviation of the residual, in units of the measurement noise.
        info: of the step.
    """
    std = std.expand_as(residual)
    whitened = residual * frame.measurement_noise.scale
    std = torch.where(frame.measured > 0, std, 1.0)
    return Record(belief, whitened, std.diag_embed(), whitened / std, info)


def predict_axes(parts: tuple[Tensor, ...], dt: Tensor) -> list[Tensor]:
    """Position, velocity(, acceleration) after ``dt``."""
    if len(parts) == 2:
        return [parts[0] + dt * parts[1], parts[1]]
    p, v, a = parts
    return [p + dt * v + dt**2 / 2 * a, v + dt * a, a]


def update_axes(predicted: list[Tensor], gains: list[Tensor], since: Tensor, residual: Tensor) -> list[Tensor]:
    """Position, velocity(, acceleration) after the update by a residual; those without a gain are 0."""
    moved = [x + g / since**i * residual for i, (x, g) in enumerate(zip(predicted, gains, strict=False))]
    return moved + [torch.zeros_like(residual) for _ in predicted[len(gains) :]]


def short_step_gains(gains: list[Tensor], since: Tensor, period: Hyper | None) -> list[Tensor]:
    """Gains for a step shorter than their period: the tracking index falls with the square of the step."""
    if period is None:
        return gains
    share = (since / period(since).unsqueeze(-1)).clamp_max(1.0)
    return [gain * share ** (i + 1) for i, gain in enumerate(gains)]


def startup_gains(gains: list[Tensor], count: Tensor) -> list[Tensor]:
    """Gains that take the position from the first measurement and the velocity from the second; later unchanged."""
    first = [1.0] + [0.0] * (len(gains) - 1)
    second = [1.0, 1.0] + [0.0] * (len(gains) - 2)
    # Thresholds are halfway between whole numbers, as soft choices count a measurement as a share of one.
    return [
        torch.where(count < 0.5, a, torch.where(count < 1.5, b, gain))
        for a, b, gain in zip(first, second, gains, strict=True)
    ]


def root_rows(entries: Tensor) -> Rows:
    """Rows of covariance roots from their nonzero entries ``(..., p, d)``, which are stored row by row."""
    size = 2 if entries.shape[-2] == 3 else 3
    zero = torch.zeros_like(entries[..., 0, :])
    return [[entries[..., i * (i + 1) // 2 + j, :] if j <= i else zero for j in range(size)] for i in range(size)]


def axis_roots(root: Tensor, orders: int, size: int) -> Tensor:
    """Entries ``(..., p, d)`` of the root of each axis, of its first ``size`` orders, from a root ``(..., n, n)``."""
    rows = tria(root.unflatten(-2, (orders, -1)).transpose(-2, -3)[..., :size, :])
    return torch.stack([rows[..., i, j] for i in range(size) for j in range(i + 1)], -2)


def predict_root(rows: Rows, dt: Tensor) -> Rows:
    """Rows of a root after ``dt``."""
    return [list(column) for column in zip(*(predict_axes(tuple(c), dt) for c in zip(*rows, strict=True)), strict=True)]


def corrected_root(rows: Rows, gains: list[Tensor], since: Tensor, used: Tensor, std: Tensor) -> Tensor:
    """Entries ``(..., p, d)`` of a root of ``(I - K H) P (I - K H)^T + K R K^T``, the errors' covariance for any gains.

    Args:
        rows: of a root of P.
        gains: of position, velocity(, acceleration).
        since: seconds that the gains are divided by.
        used: 1 where the measurement is used, 0 where K is 0.
        std: root of R.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 5.2 (Joseph form).
    """
    gains = [used * gain / since**i for i, gain in enumerate(gains)]
    rest = [[*(a - g * b for a, b in zip(row, rows[0], strict=True)), g * std]
            for g, row in zip(gains, rows, strict=True)]  # fmt: skip
    entries: list[list[Tensor]] = [[] for _ in rest]
    for i, row in enumerate(rest):  # modified Gram-Schmidt
        norm = safe_sqrt(reduce(torch.add, (x.square() for x in row)))
        unit = [safe_divide(x, norm) for x in row]
        entries[i].append(norm)
        for k in range(i + 1, len(rest)):
            along = reduce(torch.add, (x * u for x, u in zip(rest[k], unit, strict=True)))
            rest[k] = [x - along * u for x, u in zip(rest[k], unit, strict=True)]
            entries[k].append(along)
    return torch.stack(torch.broadcast_tensors(*(x for row in entries for x in row)), -2)


def root_spreads(entries: Tensor) -> Tensor:
    """Standard deviations ``(..., k, d)`` of position, velocity(, acceleration)."""
    rows = root_rows(entries)
    return torch.stack([safe_sqrt(reduce(torch.add, (x.square() for x in row))) for row in rows], -2)


def residual_spread(rows: Rows, std: Tensor) -> Tensor:
    """Standard deviation of the residual of a predicted position, in std of the measurement."""
    return (1 + reduce(torch.add, (x.square() for x in rows[0])) / std.square()).sqrt()


def full_root(entries: Tensor, n: int) -> Tensor:
    """Root ``(..., n, n)`` from its entries ``(..., p, d)``; states without entries are certain."""
    p, d = entries.shape[-2:]
    places = [(row, column) for row in range(3) for column in range(row + 1)][:p]
    if not is_traced(entries) and entries.dim() > 3 and entries.stride(0) == 1:
        # Kernels write the entries of neighbouring tracks side by side; the root keeps that layout.
        batch = entries.shape[:-2]
        root = entries.new_zeros((*batch[1:], n, n, batch[0])).movedim(-1, 0)
        for i, (row, column) in enumerate(places):
            block = root[..., row * d : (row + 1) * d, column * d : (column + 1) * d]
            block.diagonal(dim1=-2, dim2=-1).copy_(entries[..., i, :])
        return root
    place = torch.zeros(p * d, n * n, dtype=entries.dtype, device=entries.device)
    for i, (row, column) in enumerate(places):
        for axis in range(d):
            place[i * d + axis, (row * d + axis) * n + column * d + axis] = 1
    spread: Tensor = (entries.flatten(-2) @ place).unflatten(-1, (n, n))
    return spread
