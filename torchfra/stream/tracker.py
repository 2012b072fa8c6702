"""A filter in a loop: measurements in any order, the estimate after each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from operator import index
from typing import Any, NamedTuple, ParamSpec, TypeVar

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchfra import tree
from torchfra.filters.alarms import faulty_seconds
from torchfra.filters.base import Filter
from torchfra.filters.failures import diagnose_step
from torchfra.filters.fixed_lag import smooth_window, step_kept
from torchfra.filters.forecast import Forecast
from torchfra.filters.protection import protection_level
from torchfra.gaussian.arguments import belief_of, check_belief
from torchfra.sensors.base import Sensor
from torchfra.steps.recursion import HasBelief, in_full_precision
from torchfra.stream.arguments import check_counts, seconds
from torchfra.stream.intake import Intake
from torchfra.stream.window import At, Clock, Entry, Known, Window
from torchfra.types import Alarm, Failure, Gaussian, Innovation

OUTCOMES = ("used", "late", "duplicate", "old", "jumped")
FORMAT = 1
"""Version of the dictionary of a saved track."""

P = ParamSpec("P")
R = TypeVar("R")


def without_gradients(method: Callable[P, R]) -> Callable[P, R]:
    """``torch.no_grad`` around a method, in half of its time."""

    @wraps(method)
    def plain(*arguments: P.args, **options: P.kwargs) -> R:
        with torch.set_grad_enabled(False):
            return method(*arguments, **options)

    return plain


class Report(NamedTuple):
    """The result of ``Tracker.update``."""

    time: float
    """s, of the newest measurement."""
    belief: Gaussian
    """The estimate then."""
    outcome: str
    """``"used"`` in turn; ``"late"``, put in where it belongs; ``"duplicate"`` or ``"old"``, left out; or ``"jumped"``:
    used, after the clock had been set back."""
    innovation: Innovation | None
    """Innovation of the measurement; None for one that was left out."""
    alarm: Alarm | None = None
    """Whether its sensor is faulty: ``Tracker.alarms``; None for filters without alarms."""
    failure: Failure | None = None
    """See ``Tracker.failure``."""


class Tracker:
    """A filter in a loop, from times and measurements to estimates.

    Measurements may come late.  Those of the last ``lag`` seconds are kept with the states after them; after a late one
    all later ones are filtered again, so that estimates are, to the last bit, those of the same measurements in the
    order of their times (at one instant, in the order of the sensors).  A measurement that has come before, with the
    same time, sensor, value, noise and ``u``, is left out.  NaN is missing.  No gradients flow.

    With an ``origin`` the filter has positions relative to it, and beliefs and measurements outside are in double
    precision.  At 6e6 m, with a sensor of 1 m, a float32 ``srckf`` is then within 2 mm of the float64 one up to 10 km
    from the origin and within 2 cm up to 100 km, ``gpb`` within 2 cm and 10 cm; without an origin they are 0.6 and 3 m
    off.  Elements of a measurement that a shift of positions shifts are shifted to the origin; others, such as ranges,
    are measured from the sensor's position, which must be relative to the origin, as must ``u``.

    Args:
        filter: any filter of single targets, compiled or not.
        prior: the belief at ``time``; its batch is that of several streams, measured at the same times.
        time: seconds, by any clock.
        sensors: by name, where there are others than the filter's own: see ``Filter.step``.
        lag: seconds that a measurement may come late; infinity to keep all.
        steps: largest number of measurements that are kept, beside those of the newest instant; None for any number.
        old: ``"refuse"`` a measurement that comes later than that, by an error, or ``"count"`` it and leave it out.
        jump: seconds above ``lag``: a measurement that is so long before the newest comes from a clock that was set
            back.  It counts as one step after the newest, as long as the last step was, and times continue from there.
            Late measurements with times of the clock before are recognised, as these are far ahead.  None for a clock
            that is never set back.
        origin: ``(dims,)`` position, m.
        dtype: of the filter; None for the prior's.

    Raises:
        ValueError: an argument out of its range, a sensor that the filter cannot have, or an origin beside a motion
            that depends on the position.
    """

    def __init__(
        self,
        filter: Filter,
        prior: Gaussian,
        *,
        time: float = 0.0,
        sensors: Mapping[str, Sensor] | None = None,
        lag: float = 0.0,
        steps: int | None = None,
        old: str = "refuse",
        jump: float | None = None,
        origin: Sequence[float] | Tensor | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        check_counts(lag, steps, old, jump)
        prior = belief_of(prior)
        like = check_belief(prior).mean
        self._intake = Intake(filter, sensors, origin, like.dtype if dtype is None else dtype, like.device)
        self.filter, self.lag, self.steps, self.old, self.jump = filter, float(lag), steps, old, jump
        with torch.no_grad():
            state = self._intake.start(prior)
            self._window = Window(seconds("time", time), self._begun(state))
        self._counts = dict.fromkeys(OUTCOMES, 0)
        self._clock = Clock(jump)
        self._failure: Failure | None = None

    @in_full_precision
    @torch.no_grad()
    def restart(self, prior: Gaussian, which: Tensor | None = None) -> None:
        """Begins streams again at the time of the newest measurement, such as those that have failed.

        Earlier measurements are forgotten, those of all streams.  ``counts`` go on, and so does the clock.

        Args:
            prior: the belief then; its batch is that of the streams.
            which: ``(...)`` bool, the streams that begin again; None for all.

        Raises:
            ValueError: a prior of another size or batch.
        """
        batch, now = self._intake.batch, self._now
        begun = self._begun(self._intake.start(belief_of(prior)))
        like = [(x.shape, x.dtype) for x in tree.flatten(now)]
        if like != [(x.shape, x.dtype) for x in tree.flatten(begun)]:
            self._intake.batch = batch
            raise ValueError(f"prior: expected one of streams {tuple(batch)}, received {tuple(prior.mean.shape[:-1])}")
        if which is not None:
            begun = tree.where(which, begun, now)
        self._window = Window(self._window.newest, begun)
        failure, self._failure = self._failure, None
        if failure is not None and which is not None:
            step, cause, values = failure
            step, cause = torch.where(which, -1, step), torch.where(which, 0, cause)
            self._failure = Failure(step, cause, values) if bool((step >= 0).any()) else None

    def _begun(self, state: HasBelief) -> Known:
        """A first state, and an alarm for each sensor if the filter has alarms: its state counts their seconds."""
        alarms = getattr(state, "duration", None) is not None
        return Known(state, tuple(_no_alarm(x, state.belief.mean) for x in self._intake.sensors if alarms))

    @property
    def failure(self) -> Failure | None:
        """Which streams have failed, and why; None if none has.

        A step is a measurement that was put in, counted from 0.  A failed stream stays NaN until ``restart``.
        """
        return self._failure

    @property
    def time(self) -> float:
        """Seconds, of the newest measurement, or of the prior."""
        return self._clock.outside(self._window.newest)

    @property
    def state(self) -> Any:
        """The filter's state now."""
        return self._now.state

    @property
    def _now(self) -> Known:
        """State and alarms after the latest measurement in the window."""
        return self._window.before(len(self._window.entries))[1]

    @property
    def belief(self) -> Gaussian:
        """The estimate now, by all measurements so far."""
        return self._intake.outward(self.state.belief)

    @property
    def lagged(self) -> At | None:
        """The estimate at the measurement before the newest, given both; None of filters that do not have it."""
        entries, state = self._window.entries, self.state
        if not entries or not hasattr(state, "lagged"):
            return None
        time, _ = self._window.before(len(entries) - 1)
        return At(self._clock.outside(time), self._intake.outward(state.lagged))

    @property
    def alarms(self) -> dict[str, Alarm]:
        """For each sensor whether it is faulty, since when, and by how much; empty for filters without alarms.

        It is that of the sensor's last measurement, except for ``duration``, which counts to now.
        """
        return dict(zip(self._intake.names, self._now.alarms, strict=False))

    @property
    def counts(self) -> dict[str, int]:
        """Number of measurements with each outcome: see ``Report``."""
        return dict(self._counts)

    @in_full_precision
    @without_gradients
    def update(
        self,
        time: float,
        z: ArrayLike,
        sensor: str | None = None,
        *,
        u: ArrayLike | None = None,
        std: ArrayLike | None = None,
        noise: ArrayLike | None = None,
    ) -> Report:
        """The estimate after one more measurement.

        Args:
            time: seconds, by the same clock as all others.
            z: ``(..., m)`` numbers; NaN is missing.
            sensor: its name, if the tracker has several.
            u: ``(..., k)`` inputs that the models need at that time.
            std: ``(..., m)`` standard deviations of this measurement's noise, or a number, instead of the sensor's.
            noise: ``(..., m, m)`` root of its covariance, instead of the sensor's.

        Raises:
            ValueError: a value or a shape that does not fit, no such sensor, or a measurement that is too old and to be
                refused.  The track stays as it was.
        """
        stamp, window, newest = seconds("time", time), self._window, self._window.newest
        inside, jumped = self._clock.inside(stamp, newest)
        entry = self._intake.entry(inside, z, sensor, u, std, noise)
        if inside <= newest:
            if window.holds(entry):
                return self._report("duplicate", entry, self.belief)
            if inside < newest - self.lag or window.precedes(inside):
                return self._old(time, entry)
        innovation, belief = self._put(entry)
        self._clock.tick(stamp, inside, newest, jumped)
        window.trim(window.newest - self.lag, self.steps)
        return self._report("jumped" if jumped else "late" if inside < newest else "used", entry, belief, innovation)

    @torch.no_grad()
    def predict(self, time: float, sensor: str | None = None, *, u: ArrayLike | None = None) -> Forecast:
        """The predicted state at a time, and the predicted measurement of a sensor.

        Args:
            time: seconds, not before the measurements that are kept; the estimate is that of the last one up to it.
            sensor: whose measurement is expected, by name; by default the only one's, or of several the filter's own.
            u: ``(..., k)`` inputs that the models need at that time.

        Raises:
            ValueError: a time before that, or no such sensor.
        """
        inside, intake = seconds("time", time) + self._clock.behind, self._intake
        own = sensor is None and len(intake.sensors) > 1
        there = self.filter.sensor if own else intake.sensors[intake.number(sensor)]
        if inside < self._window.time:
            since = self._clock.outside(self._window.time)
            raise ValueError(f"time: expected seconds since {since}, received {time}")
        since, known = self._window.at(inside)
        u = intake.inputs(u)
        forecast = self.filter.predict(known.state, inside - since, u=u, sensor=there)
        return forecast if intake.origin is None else intake.origin.forecast(there, forecast, u)

    def protection_level(self, *, risk: float = 1e-3, fault: tuple[float, float] | None = None) -> Tensor:
        """Protection level of the current position, ``(...)`` m: see ``filters.protection_level``.

        Args:
            risk: probability that it is farther.
            fault: share of the time with an undetected fault, and the standard deviation of its error, m.

        Raises:
            ValueError: a risk or a fault out of its range.
        """
        return protection_level(self.filter, self.state, risk=risk, fault=fault)

    @in_full_precision
    @torch.no_grad()
    def smoothed(self) -> list[At]:
        """Estimates at the times of all measurements that are kept, each by all of them, the oldest first.

        The first is the one of a fixed lag.

        Raises:
            NotImplementedError: see ``Filter.smooth``; of ``gpb`` with another sensor than its own too.
        """
        f, others = self.filter, self._intake.others
        f.limits.check_smooths(several=any(sensor is not None for sensor in others))
        time, state, moments = self._window.time, self._window.state.state, []
        for entry in self._window.entries:
            state, _, moment = step_kept(f, state, entry.after(time, others[entry.sensor]))
            moments.append(moment)
            time = entry.time
        if not moments:
            return []
        beliefs, rank = smooth_window(f, state, moments).belief, state.belief.mean.dim() - 1
        each = [Gaussian(*pair) for pair in zip(*(x.unbind(rank) for x in beliefs), strict=True)]
        times = [self._clock.outside(entry.time) for entry in self._window.entries]
        return [At(time, self._intake.outward(belief)) for time, belief in zip(times, each, strict=True)]

    def state_dict(self) -> dict[str, Any]:
        """The whole track as tensors, numbers and words: for ``torch.save``, and ``load_state_dict``."""
        window = self._window
        return {
            "format": FORMAT,
            **self._intake.kind(),
            "time": window.time,
            "state": tree.flatten(window.state),
            "forgot": window.forgot,
            "entries": [{**entry._asdict(), "state": tree.flatten(entry.state)} for entry in window.entries],
            "clock": self._clock.state_dict(),
            "counts": dict(self._counts),
            "failure": None if self._failure is None else tuple(self._failure),
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Continues a saved track of the same filter, sensors and arguments, with bit-equal results.

        Args:
            values: from ``state_dict``, or of it from ``torch.load(..., weights_only=True)``.

        Raises:
            ValueError: they are not of a tracker like this one; the track stays as it was.
        """
        like, clock = self._window.state, Clock(self.jump)
        try:
            for name, expected in {"format": FORMAT, **self._intake.kind()}.items():
                received = values.get(name) if isinstance(values, Mapping) else None
                if received != expected:
                    raise ValueError(f"expected {name} {expected!r}, received {received!r}")
            window = Window(seconds("time", values["time"]), _state_like(like, values["state"]))
            window.forgot = bool(values["forgot"])
            for x in values["entries"]:
                time, known = seconds("time", x["time"]), _state_like(like, x["state"])
                window.entries.append(Entry(**{**x, "time": time, "state": known}))
                self._intake.check(window.entries[-1])
            clock.load_state_dict(values["clock"])
            counts = {outcome: index(values["counts"][outcome]) for outcome in OUTCOMES}
            failed = values.get("failure")  # files of earlier versions have none
            failure = None if failed is None else Failure(*failed)
            if failure is not None and {failure.step.shape, failure.cause.shape} != {self._intake.batch}:
                raise ValueError(f"expected a failure of streams {tuple(self._intake.batch)}, received {failed}")
        except KeyError as error:
            raise ValueError(f"values: expected all entries of state_dict, received none of {error}") from None
        except (TypeError, AttributeError, IndexError, RuntimeError):
            raise ValueError("values: expected what state_dict gives, received entries of other types") from None
        except ValueError as error:
            raise ValueError(f"values: {error}") from None
        self._window, self._clock, self._counts, self._failure = window, clock, counts, failure

    def _old(self, time: float, entry: Entry) -> Report:
        """Refuses a measurement that comes too late, or counts it."""
        if self.old == "refuse":
            first = max(self._window.newest - self.lag, self._window.time)
            bound = "after" if self._window.precedes(first) else "since"
            raise ValueError(f"time: expected seconds {bound} {self._clock.outside(first)}, received {time}")
        return self._report("old", entry, self.belief)

    def _put(self, entry: Entry) -> tuple[Innovation, Gaussian]:
        """Inserts an entry at its place, filters it and all after it; gives its innovation and the new estimate."""
        window = self._window
        place = window.place(entry)
        (time, known), done, innovations = window.before(place), [], []
        for each in (entry, *window.entries[place:]):
            f, other = self.filter, self._intake.others[each.sensor]
            measurements = each.after(time, other)
            state, (innovation, belief) = f.engine.step(f, known.state, measurements, True)
            alarm = innovation.alarm
            if other is None and len(known.alarms) == 1:  # the filter's own memory is that of its only sensor
                alarms: tuple[Alarm, ...] = (alarm,)
            else:
                alarms = _alarms_after(known.alarms, each.sensor, alarm, measurements.z, each.time - time)
            if not _is_finite(state.belief):
                self._note_failure(diagnose_step(f, known.state.belief, measurements, state.belief))
            known = Known(state, alarms)
            done.append(each._replace(state=known))
            innovations.append(innovation)
            time = each.time
        window.entries[place:] = done
        return innovations[0], self._intake.outward(belief, copy=False)

    def _note_failure(self, now: Failure) -> None:
        """Remembers the failures of a measurement, of streams that had not failed before."""
        put_in = sum(self._counts[outcome] for outcome in ("used", "late", "jumped"))
        now = now._replace(step=torch.where(now.step < 0, -1, put_in))
        if self._failure is not None:
            earlier = self._failure.step >= 0
            step, cause = (torch.where(earlier, a, b) for a, b in zip(self._failure[:2], now[:2], strict=True))
            now = Failure(step, cause, self._failure.values or now.values)
        self._failure = now

    def _report(self, outcome: str, entry: Entry, belief: Gaussian, innovation: Innovation | None = None) -> Report:
        self._counts[outcome] += 1
        alarms = self._now.alarms
        return Report(self.time, belief, outcome, innovation, alarms[entry.sensor] if alarms else None, self._failure)


def _is_finite(belief: Gaussian) -> bool:
    """Whether all numbers of a belief are finite; of one small belief without arithmetic on tensors."""
    if belief.mean.dim() == 1 and len(belief.mean) <= 16:
        return all(map(math.isfinite, belief.mean.tolist() + belief.scale_tril.flatten().tolist()))
    return math.isfinite((belief.mean.sum() + belief.scale_tril.sum()).item())


def _state_like(like: Known, tensors: Sequence[Tensor]) -> Known:
    """A saved state, of the form of another."""
    form, received = ([(x.shape, x.dtype) for x in xs] for xs in (tree.flatten(like), tensors))
    if received != form:
        raise ValueError(f"expected states of {form}, received {received}")
    return tree.unflatten(like, iter(tensors))


def _no_alarm(sensor: Sensor, mean: Tensor) -> Alarm:
    """The alarm of a sensor before its first measurement, batched like a mean ``(..., n)``."""
    blocks, elements = (mean.new_zeros(*mean.shape[:-1], count) for count in (len(sensor.blocks), sensor.size))
    return Alarm(blocks, blocks.clone(), elements)


def _alarms_after(
    alarms: tuple[Alarm, ...], number: int, alarm: Alarm | None, z: Tensor, dt: float
) -> tuple[Alarm, ...]:
    """All alarms after a measurement ``z (..., m)`` by the sensor of this number, ``dt`` seconds after the last one.

    Args:
        alarms: before it.
        number: of the sensor.
        alarm: the filter's, of this measurement; None for filters without alarms.
        z: NaN is missing; where all is, the alarm stays.
        dt: seconds.
    """
    if alarm is None:
        return ()
    measured = ~z.isnan().all(-1, keepdim=True)
    after = []
    for i, (probability, duration, offset) in enumerate(alarms):
        now = torch.where(measured, alarm.probability, probability) if i == number else probability
        off = torch.where(measured, alarm.offset, offset) if i == number else offset
        after.append(Alarm(now, faulty_seconds(duration, probability, now, duration.new_tensor(dt)), off))
    return tuple(after)
