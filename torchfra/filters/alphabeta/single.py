"""A single constant-gain filter."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.filters.alphabeta import gains as design
from torchfra.filters.alphabeta.axes import (
    ConstantGainFilter,
    corrected_root,
    full_root,
    predict_axes,
    predict_root,
    record,
    residual_spread,
    root_rows,
    short_step_gains,
    startup_gains,
    update_axes,
)
from torchfra.filters.alphabeta.gains import Gains
from torchfra.filters.records import Record
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Value
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian


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
        initiation: ``"two-point"`` takes position and velocity from the first two measurements, ``"prior"`` from the
            prior.
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
        initiation: str = "two-point",
        period: Value | None = None,
    ) -> None:
        super().__init__(motion, sensor, initiation, period)
        if (gains.gamma is not None and motion.orders == 2) or not design.stable(gains):
            more = "" if motion.orders == 2 else ", or these and gamma"
            raise ValueError(f"gains: expected stable alpha and beta{more}, received {gains}")
        if expanding and gains.gamma is not None:
            raise ValueError("expanding: expected two gains, received three")
        self.alpha = Hyper(gains.alpha, constraints.unit_interval, name="alpha")
        self.beta = Hyper(gains.beta, constraints.interval(0.0, 4.0), name="beta")
        self.gamma = None if gains.gamma is None else Hyper(gains.gamma, constraints.nonnegative, name="gamma")
        self.expanding = expanding

    def begin(self, belief: Gaussian) -> AlphaBetaState:
        """The state before the first measurement."""
        mean, zero, count = self._first(belief)
        return AlphaBetaState(mean, self._first_root(belief), count, zero)

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
        return state, record(state, residual, frame, residual_spread(rows, std), None)

    def _gains(self, since: Tensor, used: Tensor) -> list[Tensor]:
        """Gains of this step: larger for the first measurements, smaller for short steps."""
        gains = [h(since).unsqueeze(-1) for h in (self.alpha, self.beta)]
        gains += [] if self.gamma is None else [self.gamma(since).unsqueeze(-1) / 2]
        if self.expanding:
            line = design.expanding_memory(used + 1)
            gains = [torch.maximum(*pair) for pair in zip(gains, line[:2], strict=True)]
        return startup_gains(short_step_gains(gains, since, self.period), used)
