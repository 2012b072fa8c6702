"""What every filter is: a pure ``step``, and ``forward``, the only loop over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint as once_more

from torchfra.gaussian.inputs import Frame, Time, batch_rank, check, make_frames
from torchfra.gaussian.update import density
from torchfra.linalg.triangular import tria
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Estimate, Gaussian, Innovation

F = TypeVar("F", bound="Filter")
Mix = Callable[[Gaussian], Gaussian]


class Record(NamedTuple):
    """What a step leaves behind besides its state; innovations in units of the measurement noise."""

    belief: Gaussian
    residual: Tensor
    """``(..., m)``."""
    root: Tensor
    """``(..., m, m)`` lower root of the residual's covariance."""
    normalised: Tensor
    """``(..., m)`` the residual divided by its root."""
    info: Any
    density: Tensor | None = None
    """``(...)`` log density of the residual, where it is not that of a Gaussian with this root."""
    evidence: Tensor | None = None
    """``(...)`` log density of the residual as the filter trusts it, where that is another."""


class Kept(NamedTuple):
    """What an estimate holds of a step, before ``finish``."""

    belief: Gaussian
    nis: Tensor
    log_likelihood: Tensor
    info: Any


class Filter(nn.Module):
    """Abstract: a subclass gives ``begin`` and ``advance``.  Nothing of a track is ever kept in the module.

    All is computed in the dtype and on the device of the measurements.

    Args:
        motion: how targets move.
        sensor: what is measured.

    Raises:
        ValueError: the sensor reads more components than the motion's state has.
    """

    kernel_numbers: tuple[str, ...] = ()
    """Attributes that are plain numbers and that compiled kernels read when they run."""

    def __init__(self, motion: Motion, sensor: Sensor) -> None:
        super().__init__()
        if sensor.reads > motion.size:
            raise ValueError(f"sensor: expected one that reads at most {motion.size} states, this reads {sensor.reads}")
        self.motion, self.sensor = motion, sensor
        self._compiled: Any = None

    def compile(self: F) -> F:  # type: ignore[override]  # torch's own compiles forward, step by step unrolled
        """From here on run as compiled kernels, on the CPU: same results (to rounding), same gradients.

        The step is traced once for one track, every entry of every matrix a number of its own, and goes with its loop
        over time through the machine's C++ compiler (``g++``, or what ``CXX`` names): seconds for a form of call that
        no earlier process has compiled (they are kept in ``~/.cache/torchfra``, or where ``TORCHFRA_CACHE`` says).
        New values of data and hyperparameters need no new kernel, and neither does another number of tracks or steps;
        another dtype, other optional arguments, or a changed attribute does.

        On other devices, under ``torch.compile`` and in transforms of ``torch.func`` the filter runs as without.
        Gradients are of first order.  A step of the filter may do what torch does to a single track with sums,
        products, elementary functions and triangular solutions, without looking at values from Python.

        Returns:
            The filter itself.

        Raises:
            CompileError: (a ``RuntimeError``) when a kernel is needed and there is no compiler, or the step is too
                large for one: seven models in space with ``fra`` for each, say.
            NotImplementedError: then too, if the filter does what kernels cannot.
        """
        from torchfra.filters.compiled import Compiled

        self._compiled = Compiled()
        return self

    def init(self, prior: Gaussian) -> Any:
        """The state before the first measurement.

        Args:
            prior: the belief one ``dt`` earlier, ``mean (..., n)`` and any root ``(..., n, n)``; its batch is that of
                the tracks to come.

        Raises:
            ValueError: a shape that does not fit.
        """
        n = self.motion.size
        mean, root = prior
        if mean.shape[-1:] != (n,) or root.shape[-2:] != (n, n):
            raise ValueError(
                f"prior: expected (..., {n}) and (..., {n}, {n}), received {tuple(mean.shape)} and {tuple(root.shape)}"
            )
        batch = torch.broadcast_shapes(mean.shape[:-1], root.shape[:-2])
        batch = (1,) * (self._rank() - len(batch)) + batch
        return self.begin(Gaussian(mean.expand((*batch, n)), tria(root).expand((*batch, n, n))))  # eq. (7)

    def begin(self, belief: Gaussian) -> Any:
        """The state that a belief of full batch and triangular root makes; it has a ``belief``."""
        raise TypeError(f"{type(self).__name__} needs a begin")

    def advance(self, state: Any, frame: Frame, mix: Mix | None = None) -> tuple[Any, Record]:
        """One step on a prepared frame: the next state and what to keep of the step.

        ``mix``, if there is one, makes another belief of the one that the step starts from: interacting models do.
        """
        raise TypeError(f"{type(self).__name__} needs an advance")

    def finish(self, state: Any, belief: Gaussian, info: Any) -> tuple[Gaussian, Any]:
        """Beliefs ``(..., T, ...)`` and info of a sequence that ended in ``state``.

        A filter that decides late puts its last decisions here.
        """
        return belief, info

    def step(
        self,
        state: Any,
        z: Tensor,
        *,
        dt: Time = 1.0,
        u: Tensor | None = None,
        std: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> tuple[Any, Innovation]:
        """One measurement, for streaming.

        Args:
            state: from ``init`` or the step before; it is not changed.
            z: ``(..., m)``; NaN is missing, and a step with nothing measured is a pure prediction.
            dt: seconds since the last step, a number or ``(...)``.
            u: ``(..., k)`` what the models need to know, such as where the stations are.
            std: ``(..., m)`` standard deviation of this measurement, instead of the sensor's.
            noise: ``(..., m, m)`` root of its covariance, instead of the sensor's.

        Returns:
            The next state, whose ``belief`` is the estimate, and what the measurement said.

        Raises:
            ValueError: a shape or a value that does not fit.
        """
        given = (z, dt, u, std, noise)
        if self._compiled is not None and self._compiled.takes(z):
            compiled: tuple[Any, Innovation] = self._compiled.step(
                self, state, given, lambda: self._at_once(state, *given)
            )
            return compiled
        return self.observe(state, self._at_once(state, *given))

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
    ) -> Estimate:
        """Whole tracks.

        Args:
            z: ``(..., T, m)`` measurements; NaN is missing, element by element.
            prior: the belief one ``dt`` before the first of them: ``mean (..., n)`` and any root ``(..., n, n)``.
            dt: seconds between steps, a number or what broadcasts with ``(..., T)``: ``(T,)`` for each step,
                ``(..., 1)`` for each track, ``(..., T)`` for both.
            u: ``(..., T, k)`` or ``(T, k)`` what the models need to know at a step, such as where the stations are.
            std: ``(..., T, m)`` standard deviations of the measurements, instead of the sensor's.
            noise: ``(..., T, m, m)`` roots of their covariances, instead of the sensor's.
            truncate: steps after which gradients flow no further back (truncated back-propagation); None for all.
            checkpoint: steps between states that are kept for the way back, which computes the steps between anew:
                less memory for more time.  None keeps everything, and after ``compile`` a state every sqrt(T) steps.

        Raises:
            ValueError: a shape or a value that does not fit.
        """
        check_lengths(truncate=truncate, checkpoint=checkpoint)
        batch = self._batch(z, prior, dt, u, std, noise)
        rank, n = len(batch), self.motion.size
        mean, root = (x.to(z) for x in prior)
        state = self.init(Gaussian(mean.expand((*batch, n)), root.expand((*batch, n, n))))
        if self._compiled is not None and self._compiled.takes(z):
            given = (z, dt, u, std, noise)
            state, kept = self._compiled.forward(self, state, given, checkpoint, truncate)
        else:
            frames, log_norm = make_frames(self.motion, self.sensor, z, dt, u, std, noise, rank)
            state, records = self._filter(state, frames, checkpoint, truncate)
            names = ("belief", "root", "normalised", "info", "density")
            belief, root, normalised, info, own = (stack([getattr(r, name) for r in records], rank) for name in names)
            kept = Kept(belief, *_scores(normalised, root, log_norm.movedim(0, -1), own), info)
        belief, info = self.finish(state, kept.belief, kept.info)
        return Estimate(*belief, kept.nis, kept.log_likelihood, info)

    def keep(self, state: Any, frame: Frame) -> tuple[Any, Kept]:
        """One step on a prepared frame: the next state, and what the estimate holds of it."""
        state, record = self.advance(state, frame)
        scores = _scores(record.normalised, record.root, frame.measurement_noise.log_norm, record.density)
        return state, Kept(record.belief, *scores, record.info)

    def observe(self, state: Any, frame: Frame) -> tuple[Any, Innovation]:
        """One step on a prepared frame: the next state, and what the measurement said."""
        state, record = self.advance(state, frame)
        residual = frame.measurement_noise.colour(record.residual.unsqueeze(-1)).squeeze(-1)
        scores = _scores(record.normalised, record.root, frame.measurement_noise.log_norm, record.density)
        return state, Innovation(residual, frame.measurement_noise.colour(record.root), *scores)

    def _filter(
        self, state: Any, frames: list[Frame], checkpoint: int | None, truncate: int | None
    ) -> tuple[Any, list[Record]]:
        def run(state: Any, first: int, last: int) -> tuple[Any, list[Record]]:
            records = []
            for k in range(first, last):
                if truncate is not None and k and k % truncate == 0:
                    state = _detached(state)
                state, record = self.advance(state, frames[k])
                records.append(record)
            return state, records

        if checkpoint is None or not torch.is_grad_enabled():
            return run(state, 0, len(frames))
        records = []
        for first in range(0, len(frames), checkpoint):
            last = min(first + checkpoint, len(frames))
            state, more = once_more(run, state, first, last, use_reentrant=False)
            records += more
        return state, records

    def _at_once(
        self, state: Any, z: Tensor, dt: Time, u: Tensor | None, std: Tensor | None, noise: Tensor | None
    ) -> Frame:
        """The frame of a single step, checked."""
        z = z.unsqueeze(-2)
        dt = dt.unsqueeze(-1) if isinstance(dt, Tensor) and dt.dim() else dt
        u, std, noise = (x if x is None else x.unsqueeze(e) for x, e in ((u, -2), (std, -2), (noise, -3)))
        batch = self._batch(z, state.belief, dt, u, std, noise)
        if batch != state.belief.mean.shape[:-1]:
            held = tuple(state.belief.mean.shape[:-1])
            raise ValueError(f"state: expected one from a prior of batch {tuple(batch)}, this is of {held}")
        (frame,), _ = make_frames(self.motion, self.sensor, z, dt, u, std, noise, len(batch))
        return frame

    def _rank(self) -> int:
        """Batch dimensions there are at least."""
        return batch_rank(self)

    def _batch(
        self, z: Tensor, prior: Gaussian, dt: Time, u: Tensor | None, std: Tensor | None, noise: Tensor | None
    ) -> torch.Size:
        """The batch of all that was handed in, checked, and as many dimensions as the hyperparameters have in front."""
        batch = check(self.motion, self.sensor, z, prior, dt, u, std, noise)
        return torch.Size((1,) * (self._rank() - len(batch))) + batch


def _scores(normalised: Tensor, root: Tensor, log_norm: Tensor, own: Tensor | None) -> tuple[Tensor, Tensor]:
    """Normalised innovation squared and log density."""
    nis = normalised.square().sum(-1)
    return nis, log_norm + (density(root, normalised) if own is None else own)


def _detached(state: Any) -> Any:
    """A tensor, or tuples of them, without what gradients would flow back through."""
    if state is None or isinstance(state, Tensor):
        return state if state is None else state.detach()
    return type(state)(*map(_detached, state))


def check_lengths(**lengths: int | None) -> None:
    """Whether these are numbers of steps, or None.

    Raises:
        ValueError: names the first that is not.
    """
    for name, length in lengths.items():
        if length is not None and length < 1:
            raise ValueError(f"{name}: expected at least 1 step, received {length}")


def stack(steps: Sequence[Any], rank: int) -> Any:
    """Tensors, or tuples of them, stacked over time behind ``rank`` batch dimensions; None stays None."""
    first = steps[0]
    if first is None:
        return None
    if isinstance(first, Tensor):
        return torch.stack(torch.broadcast_tensors(*steps), rank)
    return type(first)(*(stack(parts, rank) for parts in zip(*steps, strict=True)))
