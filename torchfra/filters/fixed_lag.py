"""Fixed-lag smoothing of a stream: estimates a fixed number of steps back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from torchfra import tree
from torchfra.filters.base import Filter
from torchfra.filters.several_sensors import joined
from torchfra.gaussian.arguments import measurements_of
from torchfra.gaussian.inputs import Frame, Measurements, Time
from torchfra.hyper import Part, spoilt
from torchfra.sensors.base import Sensor
from torchfra.steps.checks import check_lengths, check_step
from torchfra.steps.loop import Options, backward
from torchfra.steps.records import Record, Smoothed, innovation, undecided
from torchfra.steps.recursion import HasBelief, in_full_precision
from torchfra.types import Gaussian, Innovation


class WindowStep(NamedTuple):
    """The parts of a step that the backward pass needs."""

    belief: Gaussian
    info: object
    past: object
    frame: Frame


class FixedLagState(NamedTuple):
    """State after a step."""

    inner: HasBelief
    """State of the filter."""
    window: tuple[WindowStep, ...] = ()
    """The steps up to ``lag`` back, the newest last."""
    smoothed: Smoothed | None = None
    """Smoothed estimate at the first step of the window: see ``lagged``."""

    @property
    def belief(self) -> Gaussian:
        """The estimate now, of the filter."""
        return self.inner.belief

    @property
    def lagged(self) -> Gaussian:
        """The estimate ``lag`` steps back; that of the first step while there are fewer, before any the prior."""
        return self.belief if self.smoothed is None else self.smoothed.belief


class FixedLag(Part):
    """A filter whose ``step`` also gives the estimate ``lag`` steps back, smoothed by all later ones: ``state.lagged``.

    These are the estimates of ``smooth(..., lag=lag)``.  A step takes the time of one step forwards and ``lag`` steps
    backwards.  It runs interpreted, even if the filter is compiled.

    Args:
        filter: a filter that can be smoothed.
        lag: number of steps.

    Raises:
        ValueError: not a filter, or a lag below 1.
        NotImplementedError: see ``Filter.smooth``.
    """

    def __init__(self, filter: Filter, lag: int) -> None:
        super().__init__()
        if not isinstance(filter, Filter):
            raise ValueError(f"filter: expected one of torchfra.filters, received {type(filter).__name__}")
        check_lengths(lag=lag)
        filter.limits.check_smooths()
        self.filter, self.lag = filter, lag

    def init(self, prior: Gaussian) -> FixedLagState:
        """The state before the first measurement: see ``Filter``."""
        return FixedLagState(self.filter.init(prior))

    @in_full_precision
    def step(
        self,
        state: FixedLagState,
        z: Tensor,
        *,
        dt: Time = 1.0,
        u: Tensor | None = None,
        std: Tensor | None = None,
        noise: Tensor | None = None,
        sensor: Sensor | None = None,
    ) -> tuple[FixedLagState, Innovation]:
        """One measurement (or scan); arguments and errors are those of ``Filter.step``.

        Returns:
            The next state, with the filtered estimate in ``belief`` and the estimate ``lag`` steps back in ``lagged``;
            and the innovation.
        """
        f, other = self.filter, self.filter.other_sensor(sensor)
        f.limits.check_smooths(several=other is not None)
        inner, record, step = step_kept(f, state.inner, measurements_of(z, dt, u, std, noise, other))
        window = (*state.window, step)[-self.lag - 1 :]
        smoothed, rank = smooth_window(f, inner, window), inner.belief.mean.dim() - 1
        first: Smoothed = tree.map_tensors(lambda x: x.select(rank, 0), smoothed)
        return FixedLagState(inner, window, first), innovation(record, step.frame.measurement_noise, scans=f.scans)


def step_kept(f: Filter, state: HasBelief, measurements: Measurements) -> tuple[HasBelief, Record, WindowStep]:
    """One step of a filter: the next state, the record, and the parts of it for the backward pass."""
    (frame,), _ = f._frames(check_step(f, state, measurements), state.belief.mean.dim() - 1)
    state, record = f.advance(spoilt(f, state, measurements.sensor), frame)
    return state, record, WindowStep(record.belief, record.info, record.past, frame)


def smooth_window(f: Filter, inner: HasBelief, window: Sequence[WindowStep]) -> Smoothed:
    """The backward pass over a window that ends in the filter's state ``inner``, time behind the batch."""
    rank = inner.belief.mean.dim() - 1
    steps = [tree.map_tensors(lambda x: x.unsqueeze(rank), step[:3]) for step in window]
    belief, info, kept = joined(steps, rank)
    past = f.past(*f.finish(inner, belief, info), inner, kept)
    *earlier, now = tree.unbind(tree.map_tensors(lambda x: x.movedim(rank, 0), past), len(window))
    return backward(f, [*earlier, undecided(now)], [step.frame for step in window], rank, None, Options())
