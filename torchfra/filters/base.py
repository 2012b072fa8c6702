"""The base of all filters: the two or three functions that a filter gives, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import torch
from torch import Tensor
from typing_extensions import Self

from torchfra.filters.forecast import Forecast, forecast_by
from torchfra.filters.several_sensors import SensorsInTurn
from torchfra.filters.whole_tracks import WholeTracks
from torchfra.gaussian.arguments import belief_of, measurements_of
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import Frame, Time
from torchfra.gaussian.rules import Rule
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.steps.checks import check_lengths, check_state, check_step, needed_inputs
from torchfra.steps.engine import INTERPRETED, Engine
from torchfra.steps.loop import Options
from torchfra.steps.recursion import Mix, Recursion, S, in_full_precision
from torchfra.types import Estimate, Gaussian, Innovation

P = ParamSpec("P")
R = TypeVar("R")


def by_its_engine(method: Callable[P, R]) -> Callable[P, R]:
    """A method for whole tracks, run by the filter's engine."""

    @wraps(method)
    def call(*arguments: P.args, **options: P.kwargs) -> R:
        return arguments[0].engine.call(method, *arguments, **options)  # type: ignore[attr-defined,no-any-return]

    return call


class Filter(Recursion[S]):
    """Abstract: a subclass gives two functions, and a third for smoothing other than Rauch-Tung-Striebel's.

    ::

        begin(belief) -> state                           usually a named tuple, with a ``belief``
        advance(state, frame) -> state, Record           one step; a frame has everything of it but the belief
        retreat(step, after) -> state, Smoothed          one step of the backward pass

    From these come ``step``, ``forward``, ``smooth`` with or without a lag, ``FixedLag``, ``predict``, other sensors,
    streams, batches, gradients, ``torch.func.vmap``, fitting and ``compile``.  To write them there are ``predicted``
    and ``compare``, which carry a Gaussian through motion and sensor by a rule.  ``retreat`` is
    Rauch-Tung-Striebel's unless a filter has another.

    ``advance`` is pure and takes any batch: choices are ``torch.where``, the state that goes in is not changed.
    Nothing of a track stays in a filter; it runs where ``z`` is, in its dtype.  What has measured is ``frame.sensor``,
    which may be another than the filter's own: what a state remembers of measurements is of its own sensor, so such a
    step neither uses nor changes it.

    Args:
        motion: how targets move; a linear motion is propagated exactly, without sigma points.  None for a filter around
            another one, whose models it uses.
        sensor: what is measured; None for a filter around another one.
        rule: from a dimension to the rule that carries a Gaussian through a function (``torchfra.gaussian``).

    Raises:
        ValueError: the sensor reads more components than the motion's state has, or the rule is not callable.
    """

    engine: Engine
    """The engine that runs its steps: see ``compile``."""

    def __init__(
        self, motion: Motion | None = None, sensor: Sensor | None = None, rule: Callable[[int], Rule] = third_degree
    ) -> None:
        super().__init__(motion, sensor, rule)
        self.engine = INTERPRETED

    # ------------------------------------------------------------ further functions that it may override

    def hypotheses(self, source: S) -> tuple[Gaussian, Tensor]:
        """Hypotheses ``(..., H, n)`` of a state, or of an estimate's past, and logs ``(..., H)`` of their weights."""
        mean, root = source.belief
        return Gaussian(mean.unsqueeze(-2), root.unsqueeze(-3)), torch.zeros_like(mean[..., :1])

    def forecast(self, state: S, frame: Frame, *mix: Mix) -> Forecast:
        """The prediction of state and measurement, by the frame of a step without a measurement; as in ``advance``."""
        _, record = self.advance(state, frame, *mix)
        return forecast_by(self, self.finish(state, record.belief, None)[0], frame)

    # ------------------------------------------------------------ to use a filter

    @in_full_precision
    def step(
        self,
        state: S,
        z: Tensor,
        *,
        dt: Time = 1.0,
        u: Tensor | None = None,
        std: Tensor | None = None,
        noise: Tensor | None = None,
        sensor: Sensor | None = None,
    ) -> tuple[S, Innovation]:
        """One step, by one measurement (or scan), for streaming.

        Args:
            state: from ``init`` or the step before; it is not changed.
            z: ``(..., m)``, or ``(..., J, m)`` for a scan; NaN is missing; a step without one is a prediction.
            dt: seconds since the last step, a number or ``(...)``; 0 for another measurement at the same instant.
            u: ``(..., k)`` inputs that the models need, such as the positions of stations.
            std: shaped like ``z``: standard deviation of this measurement's noise, instead of the sensor's.
            noise: shaped like ``z`` with one more ``m``: root of the noise covariance, instead of the sensor's.
            sensor: the sensor that has measured, if it is not the filter's own; it reads at most the components that
                the state has.  The filter's memory of innovations and outliers is of its own sensor, so a measurement
                of another one neither uses nor changes it.

        Returns:
            The next state, whose ``belief`` is the estimate, and the innovation, with the alarm of a filter that
            detects a faulty sensor.  ``belief.failed`` says which tracks have failed; a new ``init`` begins them again.
            For another sensor than the filter's own the alarm is of this measurement only; ``stream.Tracker`` remembers
            each sensor.

        Raises:
            ValueError: a shape or a value that does not fit.
        """
        measurements = measurements_of(z, dt, u, std, noise, self.other_sensor(sensor))
        if measurements.u is not None:
            measurements = needed_inputs(self, measurements, lambda: check_step(self, state, measurements))
        stepped: tuple[S, Innovation] = self.engine.step(self, state, measurements)
        return stepped

    @by_its_engine
    @in_full_precision
    def forward(
        self,
        z: Tensor,
        prior: Gaussian,
        *,
        dt: Time = 1.0,
        u: Tensor | None = None,
        std: Tensor | None = None,
        noise: Tensor | None = None,
        truncate: int | None = None,
        checkpoint: int | None = None,
        past: bool = False,
        sensors: Sequence[Sensor] | None = None,
        which: Tensor | Sequence[int] | None = None,
    ) -> Estimate:
        """Filters whole tracks, or sequences of scans.

        Args:
            z: ``(..., T, m)`` measurements, or ``(..., T, J, m)`` of scans; NaN is missing, element by element.
            prior: the belief one ``dt`` before the first of them: ``mean (..., n)`` and any root ``(..., n, n)``; for
                several targets ``(..., N, n)`` and ``(..., N, n, n)``.
            dt: seconds between steps, a number or a tensor that broadcasts with ``(..., T)``: ``(T,)`` for each step,
                ``(..., 1)`` for each track, ``(..., T)`` for both.
            u: ``(..., T, k)`` or ``(T, k)`` inputs that the models need at a step, such as the positions of stations.
            std: shaped like ``z``: standard deviations of the measurement noise, instead of the sensor's.
            noise: shaped like ``z`` with one more ``m``: roots of the noise covariances, instead of the sensor's.
            truncate: steps after which gradients flow no further back (truncated back-propagation); None for all.
            checkpoint: steps between states that are kept for the gradient, which recomputes the steps between: less
                memory for more time.  None keeps everything, after ``compile`` no more than 64 MiB.
            sensors: several sensors, of which each step has one: ``z (..., T, m)`` has the elements of the largest, and
                NaN behind those of a smaller one; so do ``std``, ``noise`` and the elements in ``info``.
            which: ``(T,)`` index of each step's sensor, beside ``sensors``; ``dt`` is 0 between two at the same
                instant.  The ``u`` of a step is that of its sensor, such as where a ``RangeBearing`` is.
            past: whether the estimate holds what ``smooth(estimate=)`` needs, such as the belief of each model.

        Returns:
            Estimates ``(..., T, n)``, or ``(..., N, T, n)`` for several targets.

        Warns:
            RuntimeWarning: ``z`` or ``dt`` in single precision has lost its digits before, as northings and Unix times;
                or the prior is 1e12 times as wide as a linear sensor's noise; 1e7 times in single precision, where
                moments are matched (``gpb``, ``imm``) and two measurements do not tell the state, as of accelerations.

        Raises:
            ValueError: a shape or a value that does not fit.
            NotImplementedError: ``past`` for a filter that cannot be smoothed.
        """
        check_lengths(truncate=truncate, checkpoint=checkpoint)
        turns = None if sensors is None and which is None else SensorsInTurn(self, self.engine, sensors, which)
        whole = WholeTracks(self, self.engine, turns, Options(checkpoint, truncate))
        measurements = measurements_of(z, dt, u, std, noise)
        if not past:
            return whole.estimate(measurements, belief_of(prior))
        self.limits.check_smooths(several=turns is not None)
        return whole.with_past(measurements, belief_of(prior))

    if TYPE_CHECKING:  # torch types a call as one that may return anything
        __call__ = forward

    @by_its_engine
    @in_full_precision
    def smooth(
        self,
        z: Tensor,
        prior: Gaussian,
        *,
        dt: Time = 1.0,
        u: Tensor | None = None,
        std: Tensor | None = None,
        noise: Tensor | None = None,
        truncate: int | None = None,
        checkpoint: int | None = None,
        lag: int | None = None,
        estimate: Estimate | None = None,
        sensors: Sequence[Sensor] | None = None,
        which: Tensor | Sequence[int] | None = None,
    ) -> Estimate:
        """Smooths whole tracks: Rauch-Tung-Striebel after the filter, so that later measurements count for each step.

        The backward pass keeps the decisions of the filter: weights of measurements and estimates of the noise are in
        the filtered beliefs, and fading factors widen the predictions as before.  (The weights that Huber's regression
        gives to the prediction are not used.)

        It has the arguments of ``forward``, ``past`` excepted, and these:

        - ``truncate``: steps after which gradients flow no further back: those of the forward pass, and those of
          predictions in the backward pass.
        - ``checkpoint``: steps between states that are kept for gradients, in both passes.
        - ``lag``: number of later steps whose measurements count for the estimate of a step; None for all.
        - ``estimate``: the result of ``forward`` for the same arguments, so that the filter need not run again.  A
          filter of several models runs again nevertheless, unless ``forward`` was called with ``past=True``.

        Returns:
            Smoothed beliefs in the shapes of ``forward``; ``nis``, ``log_likelihood`` and ``failure`` are those of the
            filter, and ``info`` is a ``SmoothInfo``.  Where only the backward pass fails, ``failure`` has the step at
            which it has.

        Raises:
            ValueError: see ``forward``; ``lag`` below 1, or an estimate of other tracks.
            NotImplementedError: filters of constant gains, which have no process noise; ``GPB`` over several sensors,
                as its backward pass has outliers of one sensor; ``JPDA`` around several models.
        """
        turns = None if sensors is None and which is None else SensorsInTurn(self, self.engine, sensors, which)
        self.limits.check_smooths(several=turns is not None)
        check_lengths(lag=lag, truncate=truncate, checkpoint=checkpoint)
        whole = WholeTracks(self, self.engine, turns, Options(checkpoint, truncate))
        return whole.smoothed(measurements_of(z, dt, u, std, noise), belief_of(prior), lag, estimate)

    @in_full_precision
    def predict(self, state: S, dt: Time, *, u: Tensor | None = None, sensor: Sensor | None = None) -> Forecast:
        """The prediction of state and measurement after ``dt`` seconds; it runs interpreted.

        For several models or hypotheses it is the Gaussian with their moments.  ``FRA`` predicts from its provisional
        estimate; the prediction of ``GPB`` includes manoeuvres that may begin.

        Args:
            state: from ``init`` or ``step``; it is not changed.
            dt: seconds after that state, 0 or more, a number or ``(...)``.
            u: ``(..., k)`` inputs that the models need at that time.
            sensor: the sensor whose measurement is predicted, if it is not the filter's own.

        Returns:
            Mean and root of the state, and of a measurement.

        Raises:
            ValueError: a shape or a value that does not fit.
            NotImplementedError: for a filter of scans.
        """
        if self.scans:
            raise NotImplementedError(f"{type(self).__name__} has no predict: in a scan many measurements are expected")
        other = self.other_sensor(sensor)
        check_state(self, state)
        mean = state.belief.mean
        nothing = mean.new_full((*mean.shape[:-1], (other or self.sensor).size), torch.nan)
        track = check_step(self, state, measurements_of(nothing, dt, u, sensor=other))
        (frame,), _ = self._frames(track, mean.dim() - 1)
        return self.forecast(state, frame)

    def compile(self, *args: Any, wait: bool = True, **options: Any) -> Self:  # type: ignore[override]  # torch's own returns None
        """Makes all later calls run as compiled kernels, on CPU or GPU: same results (to rounding), same gradients.

        It needs the package llvmlite (``pip install 'torchfra[compiler]'``), on a GPU torch's own NVRTC, and up to some
        seconds for the first call with these kinds of arguments.  Without llvmlite it warns once, and the filter
        runs interpreted on the CPU.  Gradients are of first order.  To ``torch.compile`` a call for whole tracks is one
        operation (from torch 2.11 on, with one sensor, not of scans); its other calls, and those inside of transforms
        of ``torch.func``, run interpreted.  ``torchfra/compiler/README.md`` has the details.

        Args:
            wait: whether the first call of a kind waits for its kernels.  If not, it runs interpreted while a thread
                compiles; later calls run compiled once the thread is done, and raise its error if it failed.  Calls
                with gradients always wait.
            args: with any other argument this is ``nn.Module.compile``, and so ``torch.compile``, instead:
                ``f.compile(backend="inductor")``.
            options: see ``args``.

        Returns:
            The filter itself.

        Raises:
            CompileError: (a ``RuntimeError``) when a kernel is needed and cannot be compiled.
            NotImplementedError: when a kernel is needed for an operation that kernels do not have.
        """
        if args or options:
            super().compile(*args, **options)
        else:
            from torchfra.compiler.engine import Compiled, InBackground
            from torchfra.compiler.llvm import is_installed, missing

            if not is_installed():
                missing()
            self.engine = Compiled() if wait else InBackground()
        return self
