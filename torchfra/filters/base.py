"""What every filter is: a pure ``step``, and ``forward`` over whole tracks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Generic

import torch
from torch import Tensor
from typing_extensions import Self, TypeVar

from torchfra.filters.checks import check_lengths, check_models, check_step
from torchfra.filters.engine import INTERPRETED, Engine
from torchfra.filters.failures import diagnosed
from torchfra.filters.fusion import fused
from torchfra.filters.other_sensors import HasViews, SensorViews
from torchfra.filters.precision import in_full_precision
from torchfra.filters.records import Kept, Record
from torchfra.filters.smoothing import Smoother
from torchfra.gaussian.arguments import check, check_belief
from torchfra.gaussian.inputs import Frame, Measurements, Time, batch_rank, with_values
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.triangular import tria
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Estimate, Gaussian, Innovation

Mix = Callable[[Gaussian], Gaussian]
S = TypeVar("S", default=Any)  # the states of a filter


class Filter(HasViews, Smoother, Generic[S]):
    """Abstract: ``TrackFilter`` for tracks of one target, ``ScanFilter`` for scans of several.

    A subclass gives ``begin`` and ``advance``.  Nothing of a track stays in it; it runs where ``z`` is, in its dtype.

    Args:
        motion: how targets move; None for a filter around another one, whose models are its own.
        sensor: what is measured; likewise.

    Raises:
        ValueError: the sensor reads more components than the motion's state has.
    """

    scans = False
    """Whether a measurement is a scan ``(..., T, J, m)``, and beliefs are those of targets ``(..., N, n)``."""
    instants = True
    """Whether a step may take no time, as that to a second measurement at the same instant."""
    annealed: tuple[str, ...] = ()
    """Attributes that are plain numbers and may change between calls, such as a temperature that is lowered."""
    slow_to_compile = False  # some ten seconds or more: commands compile such a filter only when told to
    engine: Engine
    """What runs its steps: see ``compile``."""

    def __init__(self, motion: Motion | None = None, sensor: Sensor | None = None) -> None:
        super().__init__()
        self.engine, self._views = INTERPRETED, SensorViews()
        if motion is not None and sensor is not None:
            check_models(motion, sensor)
            self.motion, self.sensor = motion, sensor

    @in_full_precision
    def init(self, prior: Gaussian) -> S:
        """The state before the first measurement.

        Args:
            prior: the belief one ``dt`` earlier, ``mean (..., n)`` and any root ``(..., n, n)``; its batch is that of
                the tracks to come.

        Raises:
            ValueError: a shape that does not fit.
        """
        n, (mean, root) = self.motion.size, check_belief(prior, size=self.motion.size)
        batch = broadcast_shapes(mean.shape[:-1], root.shape[:-2], (1,) * self._rank())
        mean = mean.resolve_neg().expand((*batch, n))  # torch makes no new tensor like one that is marked as negated
        return self.begin(Gaussian(mean, tria(root).expand((*batch, n, n))))  # eq. (7)

    def begin(self, belief: Gaussian) -> S:
        """The state that a belief of full batch and triangular root makes; it has a ``belief``."""
        raise TypeError(f"{type(self).__name__} needs a begin")

    def advance(self, state: S, frame: Frame, mix: Mix | None = None) -> tuple[S, Record]:
        """One step on a prepared frame: the next state and what to keep of the step.

        ``mix``, if there is one, makes another belief of the one that the step starts from: interacting models do.
        """
        raise TypeError(f"{type(self).__name__} needs an advance")

    def finish(self, state: Any, belief: Gaussian, info: Any) -> tuple[Gaussian, Any]:
        """Beliefs ``(..., T, ...)`` and info of a sequence that ended in ``state``.

        A filter that decides late puts its last decisions here.
        """
        return belief, info

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
        """One measurement (or scan), for streaming.

        Args:
            state: from ``init`` or the step before; it is not changed.
            z: ``(..., m)``, of scans ``(..., J, m)``; NaN is missing; with nothing measured a step is a prediction.
            dt: seconds since the last step, a number or ``(...)``; 0 for another measurement at the same instant.
            u: ``(..., k)`` what the models need to know, such as where the stations are.
            std: like ``z``: standard deviation of this measurement's noise, instead of the sensor's.
            noise: like ``z`` with one more ``m``: root of the noise covariance, instead of the sensor's.
            sensor: that has measured, if it is not the filter's own: see ``with_sensor``.

        Returns:
            The next state, whose ``belief`` is the estimate, and what the measurement said.

        Raises:
            ValueError: a shape or a value that does not fit.
        """
        if sensor is not None and sensor is not self.sensor:
            return self.with_sensor(sensor).step(state, z, dt=dt, u=u, std=std, noise=noise)
        return self.engine.step(self, state, Measurements(z, dt, u, std, noise))

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
        """Whole tracks, or sequences of scans.

        Args:
            z: ``(..., T, m)`` measurements, of scans ``(..., T, J, m)``; NaN is missing, element by element.
            prior: the belief one ``dt`` before the first of them: ``mean (..., n)`` and any root ``(..., n, n)``; of
                several targets ``(..., N, n)`` and ``(..., N, n, n)``.
            dt: seconds between steps, a number or what broadcasts with ``(..., T)``: ``(T,)`` for each step,
                ``(..., 1)`` for each track, ``(..., T)`` for both.
            u: ``(..., T, k)`` or ``(T, k)`` what the models need to know at a step, such as where the stations are.
            std: like ``z``: standard deviations of the measurement noise, instead of the sensor's.
            noise: like ``z`` with one more ``m``: roots of the noise covariances, instead of the sensor's.
            truncate: steps after which gradients flow no further back (truncated back-propagation); None for all.
            checkpoint: steps between states that are kept for the way back, which computes the steps between anew:
                less memory for more time.  None keeps everything, after ``compile`` no more than 64 MiB.
            sensors: where steps have several: ``z (..., T, m)`` has the elements of the largest, NaN behind those
                of a smaller; ``std`` and ``noise`` likewise, and so has ``info`` what it says of elements.
            which: ``(T,)`` number of each step's sensor, beside ``sensors``; ``dt`` 0 for two at the same instant.  The
                ``u`` of a step is for its sensor: a ``RangeBearing`` without a ``position`` stands there.
            past: whether the estimate shall hold what ``smooth(estimate=)`` needs: of several models what each knew.

        Returns:
            Estimates ``(..., T, n)``, of several targets ``(..., N, T, n)``.

        Raises:
            ValueError: a shape or a value that does not fit.
            NotImplementedError: ``past`` of a filter that cannot be smoothed.
        """
        check_lengths(truncate=truncate, checkpoint=checkpoint)
        f = self if sensors is None and which is None else fused(self, sensors, which)
        given = Measurements(z, dt, u, std, noise), prior, checkpoint, truncate
        return f._remembered(*given) if past else f._forth(*given)[0]

    if TYPE_CHECKING:  # what torch types as a call that may return anything
        __call__ = forward

    def compile(self, *args: Any, **options: Any) -> Self:  # type: ignore[override]  # torch's own returns None
        """From here on run as compiled kernels, on CPU or GPU: same results (to rounding), same gradients.

        It needs a C++ compiler (what ``CXX`` names, or ``g++``, ``clang++``, zig), on a GPU torch's own NVRTC, and some
        seconds for a form of call that no earlier process has compiled.  Gradients are of first order.  Under
        ``torch.compile`` and in transforms of ``torch.func`` the filter runs as without.
        ``torchfra/compiler/README.md`` has the details.

        Args:
            args: with any argument this is ``nn.Module.compile``, and so ``torch.compile``, instead:
                ``f.compile(backend="inductor")``.
            options: likewise.

        Returns:
            The filter itself.

        Raises:
            CompileError: (a ``RuntimeError``) when a kernel is needed and there is no compiler.
            NotImplementedError: then too, if the filter does what kernels cannot.
        """
        if args or options:
            super().compile(*args, **options)
        else:
            from torchfra.compiler.engine import Compiled

            self.engine = Compiled(INTERPRETED)
        return self

    def keep(self, state: S, frame: Frame, past: bool = False) -> tuple[S, Kept]:
        """One step on a prepared frame: the next state, and what the estimate (and the way back) needs of it."""
        state, record = self.advance(state, frame)
        nis, log_likelihood = self._scores(record, frame.measurement_noise.log_norm)
        return state, Kept(record.belief, nis, log_likelihood, record.info, record.past if past else None)

    def observe(self, state: S, frame: Frame) -> tuple[S, Innovation]:
        """One step on a prepared frame: the next state, and what the measurement said."""
        state, record = self.advance(state, frame)
        return state, self.innovation_of(record, frame)

    def _forth(
        self, measurements: Measurements, prior: Gaussian, checkpoint: int | None, truncate: int | None,
        past: bool = False,
    ) -> tuple[Estimate, Any, Any]:  # fmt: skip
        """The estimate of whole tracks, and for a backward pass the last state and what steps have kept."""
        estimate, state, kept = self.engine.forward(self, measurements, prior, checkpoint, truncate, past)
        return diagnosed(self, estimate, measurements, prior), state, kept

    def begun(self, measurements: Measurements, prior: Gaussian) -> tuple[S, int]:
        """The state before the first measurement of whole tracks, and its batch dimensions; all is checked."""
        batch = self._batch(measurements, prior) + prior.mean.shape[-1 - self.scans : -1]
        mean, root = (x.to(measurements.z) for x in prior)
        return self.init(Gaussian(mean.expand((*batch, self.motion.size)), root)), len(batch)

    def estimate_of(self, state: S, kept: Kept) -> Estimate:
        """The estimate of whole tracks, from the last state and what is kept of all steps."""
        belief, info = self.finish(state, kept.belief, kept.info)
        return Estimate(*belief, kept.nis, kept.log_likelihood, info)

    def _frame(self, state: Any, measurements: Measurements) -> Frame:
        """The frame of a single step, checked."""
        return self._frames(check_step(self, state, measurements), state.belief.mean.dim() - 1)[0][0]

    def _rank(self) -> int:
        """Batch dimensions there are at least."""
        return max(batch_rank(self), int(self.scans))

    def _batch(self, measurements: Measurements, prior: Gaussian, name: str = "prior") -> torch.Size:
        """The batch of all, checked, with the dimensions of the hyperparameters; messages call the prior ``name``."""
        batch = check(
            measurements, prior, self.motion, self.sensor.size, scans=self.scans, name=name, instants=self.instants
        )
        return with_values(self, torch.Size((1,) * (self._rank() - self.scans - len(batch))) + batch, self.scans)

    def _frames(self, measurements: Measurements, rank: int) -> tuple[list[Frame], Tensor]:
        """A frame for each step, and the log norms of the measurement noise, time first."""
        raise TypeError(f"{type(self).__name__} needs a _frames: see TrackFilter and ScanFilter")

    def _scores(self, record: Record, log_norm: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised innovation squared and log likelihood."""
        raise TypeError(f"{type(self).__name__} needs a _scores: see TrackFilter and ScanFilter")

    def innovation_of(self, record: Record, frame: Frame) -> Innovation:
        """What the measurement of a step said, in its own units."""
        raise TypeError(f"{type(self).__name__} needs an innovation_of: see TrackFilter and ScanFilter")
