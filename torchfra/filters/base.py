"""What every filter is: a pure ``step``, and ``forward``, the only loop over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from typing_extensions import Self

import torch
from torch import Tensor, nn

from torchfra.filters.frames import Frame, Time, batch_rank, check, make_frames
from torchfra.linalg import is_traced, tria
from torchfra.motion import Motion
from torchfra.sensors import Sensor
from torchfra.types import Estimate, Gaussian, Innovation


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


class Filter(nn.Module):
    """Abstract: a subclass gives ``begin`` and ``advance``.  Nothing of a track is ever kept in the module.

    All is computed in the dtype and on the device of the measurements.

    Args:
        motion: how targets move.
        sensor: what is measured.

    Raises:
        ValueError: the sensor reads more components than the motion's state has.
    """

    def __init__(self, motion: Motion, sensor: Sensor) -> None:
        super().__init__()
        if sensor.reads > motion.size:
            raise ValueError(f"sensor: expected one that reads at most {motion.size} states, this reads {sensor.reads}")
        self.motion, self.sensor = motion, sensor
        self._compiled: Any = None

    def compile(self, checkpoint: int | None = None) -> Self:  # type: ignore[override]  # what torch has compiles less
        from torchfra.filters.compiled import Compiled
        self._compiled = Compiled(self, checkpoint)
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
        batch = (1,) * (batch_rank(self) - len(batch)) + batch
        return self.begin(Gaussian(mean.expand((*batch, n)), tria(root).expand((*batch, n, n))))  # eq. (7)

    def begin(self, belief: Gaussian) -> Any:
        """The state that a belief of full batch and triangular root makes; it has a ``belief``."""
        raise TypeError(f"{type(self).__name__} needs a begin")

    def advance(self, state: Any, frame: Frame) -> tuple[Any, Record]:
        """One step on a prepared frame: the next state and what to keep of the step."""
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
        if isinstance(dt, Tensor) and dt.dim():
            dt = dt.unsqueeze(-1)
        u, std, noise = (x if x is None else x.unsqueeze(e) for x, e in ((u, -2), (std, -2), (noise, -3)))
        (frame,), _, batch = self._prepare(z.unsqueeze(-2), state.belief, dt, u, std, noise)
        if batch != state.belief.mean.shape[:-1]:
            held = tuple(state.belief.mean.shape[:-1])
            raise ValueError(f"state: expected one from a prior of batch {tuple(batch)}, this is of {held}")
        state, record = self.advance(state, frame)
        nis, log_likelihood = _scores(record.normalised, record.root, frame.noise.log_norm)
        residual = frame.noise.colour(record.residual.unsqueeze(-1)).squeeze(-1)
        return state, Innovation(residual, frame.noise.colour(record.root), nis, log_likelihood)

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

        Raises:
            ValueError: a shape or a value that does not fit.
        """
        if truncate is not None and truncate < 1:
            raise ValueError(f"truncate: expected at least 1 step, received {truncate}")
        if self._compiled is not None and not is_traced(z):
            return self._compiled.forward(self, z, prior, dt, u, std, noise, truncate)
        frames, log_norm, batch = self._prepare(z, prior, dt, u, std, noise)
        mean, root = (x.to(z) for x in prior)
        rank, n = len(batch), mean.shape[-1:]
        state, records = self.init(Gaussian(mean.expand(batch + n), root.expand(batch + n + n))), []
        for k, frame in enumerate(frames):
            if truncate is not None and k and k % truncate == 0:
                state = _detached(state)
            state, record = self.advance(state, frame)
            records.append(record)
        normalised = _stack([r.normalised for r in records], rank)
        root = _stack([r.root for r in records], rank)
        nis, log_likelihood = _scores(normalised, root, log_norm.movedim(0, -1))
        belief, info = (_stack([getattr(r, name) for r in records], rank) for name in ("belief", "info"))
        belief, info = self.finish(state, belief, info)
        return Estimate(*belief, nis, log_likelihood, info)

    def _prepare(
        self,
        z: Tensor,
        prior: Gaussian,
        dt: Time,
        u: Tensor | None,
        std: Tensor | None,
        noise: Tensor | None,
    ) -> tuple[list[Frame], Tensor, torch.Size]:
        """Frames of ``z (..., T, m)``, the log of their noise, time first, and the batch of all that was handed in."""
        batch = check(self.motion, self.sensor, z, prior, dt, u, std, noise)
        rank = max(len(batch), batch_rank(self))
        frames, log_norm = make_frames(self.motion, self.sensor, z, dt, u, std, noise, rank)
        return frames, log_norm, torch.Size((1,) * (rank - len(batch))) + batch


def _scores(normalised: Tensor, root: Tensor, log_norm: Tensor) -> tuple[Tensor, Tensor]:
    """Normalised innovation squared and log density."""
    nis = normalised.square().sum(-1)
    return nis, log_norm - 0.5 * nis - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _detached(state: Any) -> Any:
    """A tensor, or tuples of them, without what gradients would flow back through."""
    if state is None or isinstance(state, Tensor):
        return state if state is None else state.detach()
    return type(state)(*map(_detached, state))


def _stack(steps: Sequence[Any], rank: int) -> Any:
    """Tensors, or tuples of them, stacked over time behind ``rank`` batch dimensions; None stays None."""
    first = steps[0]
    if first is None:
        return None
    if isinstance(first, Tensor):
        return torch.stack(torch.broadcast_tensors(*steps), rank)
    return type(first)(*(_stack(parts, rank) for parts in zip(*steps, strict=True)))
