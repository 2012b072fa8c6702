"""The objective of a fit: the loss of every track at many sets of values at once, and its gradient for each of them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from torchfra import losses
from torchfra.filters import Filter
from torchfra.filters.srckf import SRCKF
from torchfra.fitting.data import Batch, Source
from torchfra.fitting.vector import Vector
from torchfra.hyper import one_of
from torchfra.motion.bank import Bank
from torchfra.numbers import is_integer, positive
from torchfra.scenarios.base import Scenario
from torchfra.steps.engine import INTERPRETED
from torchfra.types import CompileError, Estimate, Gaussian

LOSSES = ("likelihood", "smoothed", "robust", "mse", "nll")
NEEDS_TRUTH = ("robust", "mse", "nll")
LARGEST = 2_000_000
"""Largest number of steps of tracks in one call of the filter; more are divided into parts, to bound the memory."""
OF_KERNELS = 100_000
"""The same of kernels on the CPU, which take up to 1.6 times as long for a sweep of 400 tracks if all is one call."""
FOLDS = 5
"""Number of folds of the smoothed likelihood: each hides every fifth measurement."""
LossFunction = Callable[[Estimate, Batch], Tensor]
"""A user's loss function: from an estimate and its tracks to one number per track, ``(..., N)``."""


class Objective:
    """The loss of each track as a function of the values; both are on the CPU, the tracks where the filter is.

    Args:
        f: the filter, whose learned values are replaced in each call.
        vector: of its learned values.
        loss: one of ``LOSSES`` or a function.
        scale: of the robust loss, m.
        states: components of state and truth in the loss.
        convert: from estimates to the coordinates of the truth.
        skip: number of steps at the start of each track that the loss leaves out.
        truncate: steps after which backpropagation through time is cut; None for never.

    Raises:
        ValueError: an unknown loss, or one that does not tell what is to be learned.
    """

    def __init__(
        self, f: Filter, vector: Vector, loss: str | LossFunction, *, scale: float, states: slice, skip: int = 0,
        convert: Callable[[Estimate], Estimate] | None = None, truncate: int | None = None,
    ) -> None:  # fmt: skip
        if not callable(loss):
            one_of(loss=(loss, LOSSES))
        self.filter, self.vector, self.loss, self.scale, self.states = f, vector, loss, scale, states
        self.skip, self.convert, self.truncate = skip, convert, truncate
        if loss == "smoothed" and f.scans:
            raise ValueError("loss: expected another than 'smoothed' for scans of several targets")
        clutter = [path for path in vector.hypers if path.startswith("clutter.")] if loss == "likelihood" else []
        if clutter:
            expected = "another than 'likelihood', which is over that of false measurements alone,"
            raise ValueError(f"loss: expected {expected}, to learn {', '.join(clutter)}")
        self.call = _Call(f, loss == "smoothed")

    def compile(self) -> None:
        """Makes the filter run as compiled kernels."""
        self.filter.compile()
        if self.call.one_step is not None:
            self.call.one_step.compile()

    def interpret(self) -> None:
        """Makes the filter run interpreted."""
        for part in (self.filter, self.call.one_step):
            if part is not None:
                part.engine = INTERPRETED

    @torch.no_grad()
    def choose_scale(self, tracks: Batch) -> None:
        """Takes as the scale of a robust loss the median over tracks of the error of the filter's values."""
        if self.loss == "robust":
            assert tracks.truth is not None
            mean = self._estimate(tracks).mean
            self.scale = positive("scale", float(losses.mse(mean, tracks.truth, self.states).nanmedian().sqrt()))

    @property
    def name(self) -> str:
        """The name of the loss."""
        return self.loss if isinstance(self.loss, str) else getattr(self.loss, "__name__", "own")

    def of_filter(self, f: Filter, batch: Batch) -> Tensor:
        """The loss ``(N,)`` of another filter with its own values."""
        other = copy.copy(self)
        other.filter, other.call = f, _Call(f, self.loss == "smoothed")
        with torch.no_grad():
            return other._measured(batch).reshape(-1).cpu()

    def losses(self, raw: Tensor, batch: Batch) -> Tensor:
        """Losses ``(R, N)`` of each track at values ``raw (R, N, P)`` for each track, or ``(R, 1, P)`` for all."""
        with torch.no_grad():
            return self._in_parts(lambda raw, part: self._values(raw, part)[0].unsqueeze(-1), raw, batch).squeeze(-1)

    def gradients(self, raw: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Losses ``(R, N)`` of each track and their gradients ``(R, N, P)``; for ``raw`` see ``losses``."""

        def both(raw: Tensor, part: Batch) -> Tensor:
            # Every track has its own copy of the values.  The gradient of the sum of all losses with respect to one
            # copy is then that of this track alone, and NaN from a track that diverged stays with it.
            with torch.enable_grad():
                loss, copies = self._values(raw, part)
                if not loss.requires_grad:  # of thresholds of hard decisions alone, through which no gradient passes
                    return torch.cat([loss.unsqueeze(-1), torch.zeros_like(copies)], -1)
                (gradient,) = torch.autograd.grad(loss.sum(), [copies], materialize_grads=True, allow_unused=True)
            return torch.cat([loss.detach().unsqueeze(-1), gradient], -1)

        whole = self._in_parts(both, raw, batch)
        return whole[..., 0], whole[..., 1:]

    def estimate(self, raw: Tensor, batch: Batch) -> Estimate:
        """Estimates of tracks ``(R, N)``, in the coordinates of the truth; for ``raw`` see ``losses``."""
        with torch.no_grad():
            values = self.vector.parameters(raw.to(batch.z).expand(-1, len(batch.z), -1))
            estimate: Estimate = self.call.of(values, batch, self._estimate)
            return estimate

    def _in_parts(self, work: Callable[[Tensor, Batch], Tensor], raw: Tensor, batch: Batch) -> Tensor:
        raw = raw.detach().to(batch.z).expand(-1, len(batch.z), -1)
        largest = OF_KERNELS if batch.z.is_cpu and self.filter.engine is not INTERPRETED else LARGEST
        each = max(1, largest // (len(raw) * batch.z.shape[1] * (FOLDS if self.loss == "smoothed" else 1)))
        parts = [slice(i, i + each) for i in range(0, len(batch.z), each)]
        return torch.cat([work(raw[:, part], batch.rows(part)) for part in parts], 1).to("cpu", torch.float64)

    def _values(self, raw: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Losses ``(R, N)`` and the copies of the values ``(R, N, P)`` that they follow from."""
        copies = raw.clone().requires_grad_()
        shared = copies.unsqueeze(2) if self.filter.scans else copies  # among the targets of a scene
        loss = self.call.of(self.vector.parameters(shared), batch, self._measured)
        return loss, copies

    def _estimate(self, batch: Batch) -> Estimate:
        options: dict[str, Any] = {"dt": batch.dt, "u": batch.u, "std": batch.std, "truncate": self.truncate}
        estimate: Estimate = self.filter(batch.z, batch.belief(self.filter), **options)
        return estimate if self.convert is None else self.convert(estimate)

    def _measured(self, batch: Batch) -> Tensor:
        """The loss of each track."""
        if self.loss == "smoothed":
            return self._hidden(batch)
        mean, root, nis, density, info, *_ = self._estimate(batch)
        skip = self.skip
        counted = Estimate(mean[..., skip:, :], root[..., skip:, :, :], nis[..., skip:], density[..., skip:], info)
        if not isinstance(self.loss, str):
            return _of_tracks(self.loss(counted, batch), batch)
        if self.loss == "likelihood":  # the sum over a track, not its mean, so that long tracks weigh more
            total = -counted.log_likelihood.sum(-1)
            return total.sum(-1) if self.filter.scans else total
        assert batch.truth is not None
        truth = batch.truth[..., skip:, :]
        if self.loss == "nll":
            each = losses.nll(counted, truth, self.states)
        elif self.loss == "mse":
            each = losses.mse(counted.mean, truth, self.states)
        else:
            each = losses.robust_mse(counted.mean, truth, self.states, self.scale)
        return each.mean(-1) if self.filter.scans else each

    def _hidden(self, batch: Batch) -> Tensor:
        """Minus the log density of each measurement given those before and after it; every fifth is hidden in turn."""
        steps = torch.arange(batch.z.shape[1], device=batch.z.device)
        hides = steps % FOLDS == torch.arange(FOLDS, device=batch.z.device).unsqueeze(1)  # (F, T)
        z = batch.z.masked_fill(hides[:, None, None, :, None], torch.nan)  # (F, 1, N, T, m)
        smoothed = self.filter.smooth(z, batch.belief(self.filter), dt=batch.dt, u=batch.u, std=batch.std)
        fold = steps % FOLDS
        mean = smoothed.mean[fold, ..., steps, :]  # (T, R, N, n): of the fold that hides the step
        root = smoothed.scale_tril[fold, ..., steps, :, :]
        z = batch.z.movedim(1, 0).unsqueeze(1).unsqueeze(-2)  # (T, 1, N, 1, m): each step a track of its own
        u, std = (None if x is None else x.movedim(1, 0).unsqueeze(1).unsqueeze(-2) for x in (batch.u, batch.std))
        assert self.call.one_step is not None
        density: Tensor = self.call.one_step(z, Gaussian(mean, root), dt=0.0, u=u, std=std).log_likelihood
        return -density[self.skip :].sum((0, -1))


def _of_tracks(found: object, batch: Batch) -> Tensor:
    """Checks the result of a user's loss function.

    Raises:
        ValueError: it is not one number for each track.
    """
    if not isinstance(found, Tensor) or found.shape[-1:] != batch.z.shape[:1]:
        received = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
        raise ValueError(f"loss: expected one number for each track, ({len(batch.z)},), received {received}")
    return found


def objective_of(
    f: Filter,
    vector: Vector,
    data: Source,
    tracks: Batch,
    loss: str | LossFunction | None,
    scale: float | None,
    skip: int,
) -> Objective:
    """The loss of a fit.

    Args:
        f: the filter that learns.
        vector: of its values.
        data: that was given.
        tracks: that it came to.
        loss: by name, of one's own, or None for the robust error where there is a truth, else the likelihood.
        scale: of the robust loss; None for 1 until ``choose_scale``.
        skip: steps at the start of each track that do not count.

    Raises:
        ValueError: a loss that needs a truth where there is none, a number out of its range, or a standard deviation of
            the sensor that is to be learned where each measurement has its own.
    """
    kind = loss or ("likelihood" if tracks.truth is None else "robust")
    if isinstance(kind, str) and kind in NEEDS_TRUTH and tracks.truth is None:
        raise ValueError(f"loss: expected 'likelihood' or 'smoothed' for data without a truth, received {kind!r}")
    own = [path for path in vector.hypers if "sensor" in path.split(".") and path.endswith(".std")]
    if tracks.std is not None and own:
        raise ValueError(f"learn: expected none of {', '.join(own)}, which data with std do not use")
    if not is_integer(skip, 0) or skip >= tracks.z.shape[1]:
        raise ValueError(f"skip: expected less than the {tracks.z.shape[1]} steps of the tracks, received {skip}")
    states, convert = f.motion.position, None
    if isinstance(data, Scenario):
        states, convert = data.truth_position, data.cartesian
    scale = 1.0 if scale is None else scale
    return Objective(f, vector, kind, scale=positive("scale", scale), skip=skip, states=states, convert=convert)


def compiled(objective: Objective, tracks: Batch, wanted: bool | None) -> tuple[list[str], bool]:
    """Compiles the filter where it can be compiled; notes for the user, and whether it runs as kernels."""
    if wanted is False or not (tracks.z.is_cpu or tracks.z.is_cuda):
        return [], False
    from torchfra.compiler.llvm import binding  # only where it is needed

    try:
        if tracks.z.is_cpu:
            binding()
        objective.compile()
        objective.gradients(objective.vector.raw()[None, None], tracks.rows(slice(1)))
    except (CompileError, NotImplementedError) as error:
        if wanted:
            raise
        objective.interpret()
        return [f"the filter runs interpreted: {' '.join(str(error).split())}"], False
    return [], True


class _Call(nn.Module):
    """Calls with other values than the filter's own, for ``torch.func.functional_call``."""

    def __init__(self, f: Filter, hides: bool) -> None:
        super().__init__()
        self.filter = f
        motion = f.motion[0] if isinstance(f.motion, Bank) else f.motion
        self.one_step = SRCKF(motion, f.sensor) if hides else None

    def of(self, values: Mapping[str, Tensor], batch: Batch, work: Callable[[Batch], Any]) -> Any:
        """The result of ``work`` on the tracks with these values in the filter."""
        replaced = {f"filter.{name}": x for name, x in values.items()}
        return functional_call(self, replaced, (batch, work), tie_weights=False)  # or both that share one stay replaced

    def forward(self, batch: Batch, work: Callable[[Batch], Any]) -> Any:
        """The result of ``work`` on the tracks with the filter's values."""
        return work(batch)
