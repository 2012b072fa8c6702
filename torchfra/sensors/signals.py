"""Ranges from signals with unsynchronised clocks: pseudoranges of satellites, and time differences of arrival."""

from __future__ import annotations

from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.hyper import Value
from torchfra.sensors.base import Expected, Sensor
from torchfra.sensors.composed import Biased, Stacked, noise_root
from torchfra.sensors.ranges import RangeRates, Ranges


class Pseudoranges(Biased):
    """Pseudoranges of satellites, m, and their rates, m/s: ranges and range rates biased by the receiver's clock.

    The state is that of ``Augmented(ConstantVelocity(q, 3), Clock(...))``, in the coordinates of the satellites.
    Pseudoranges must be corrected for satellite clocks, the Earth's rotation and the atmosphere.  A satellite out of
    view is NaN.

    Args:
        count: number of satellites, whose positions come with each step, ``u (..., 3 m)``; with ``rates`` their
            velocities behind them, ``u (..., 6 m)``.
        std: of the pseudoranges' noise, m; a number or ``(..., m)``.
        rates: standard deviation of the rates' noise, m/s; a number or ``(..., m)``.  None for no rates.
        clock: component of the state that holds the clock's offset, m, with its drift, m/s, behind it:
            ``motion.components.index("clock")``.

    Raises:
        ValueError: no satellites, ``clock`` below 0.

    Source: Brown & Hwang (2012), "Introduction to Random Signals and Applied Kalman Filtering", section 9.4.
    """

    bias_kinds = ("clock",)

    def __init__(self, count: int, std: Value, rates: Value | None = None, *, clock: int = 6) -> None:
        ranges = Ranges(count=count, std=std, dims=3)
        if rates is None:
            super().__init__(ranges, clock)
        else:
            both = Stacked(ranges, RangeRates(count=count, std=rates, dims=3))
            super().__init__(both, [clock] * count + [clock + 1] * count)
        self.count = count

    def describe(self) -> str:
        """The number of satellites."""
        return f"pseudoranges of {self.count} satellites"


class TimeDifferences(Sensor):
    """Differences of arrival times at anchors against the first one, times the speed of the signal: m.

    The first arrival is in all differences, so their noise is correlated.  ``std`` here is that of arrivals.  In
    contrast, ``std=`` of a filter's call, with the measurements, is that of differences with independent noise;
    ``noise=`` there is for correlated noise.

    Args:
        anchors: see ``Ranges``; ``m + 1`` anchors have ``m`` differences.
        std: of each arrival's noise, times the speed, m; a number or ``(..., m + 1)`` with one per anchor.
        count: see ``Ranges``.
        dims: see ``Ranges``.
        height: see ``Ranges``.
        noise: of the arrivals, see ``Ranges``.

    Raises:
        ValueError: see ``Ranges``; or a single anchor.

    Source: Foy (1976), "Position-Location Solutions by Taylor-Series Estimation".
    """

    def __init__(
        self, anchors: ArrayLike | None = None, std: Value | None = None, *, count: int | None = None,
        dims: int | None = None, height: float | None = None, noise: Tensor | None = None,
    ) -> None:  # fmt: skip
        arrivals = Ranges(anchors, std, count=count, dims=dims, height=height, noise=noise)
        if arrivals.size < 2:
            raise ValueError(f"anchors: expected 2 or more for a difference, received {arrivals.size}")
        self._lay_out(arrivals.reads, [False] * (arrivals.size - 1))
        self.arrivals, self.dims = arrivals, arrivals.dims

    @property
    def root(self) -> Tensor | None:  # type: ignore[override]  # of the arrivals
        """A root ``(..., m, m + 1)`` of the noise covariance."""
        arrivals = noise_root(self.arrivals)
        return arrivals[..., 1:, :] - arrivals[..., :1, :]

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The positions that it reads."""
        return self.arrivals.expects

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The differences ``(..., m)`` of distances."""
        away = self.arrivals(x, u)
        differences: Tensor = away[..., 1:] - away[..., :1]
        return differences

    def describe(self) -> str:
        """The number of anchors."""
        return f"time differences of {self.arrivals.describe()}"
