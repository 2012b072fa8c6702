"""Smoothing: the way back over a track that has been filtered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra import tree
from torchfra.filters.checks import check_lengths
from torchfra.filters.fusion import fused
from torchfra.filters.loop import scan
from torchfra.filters.precision import in_full_precision
from torchfra.gaussian.inputs import Frame, Measurements, Time
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Estimate, Gaussian


class SmoothInfo(NamedTuple):
    """What a smoother says besides its beliefs."""

    filtered: Estimate
    """What the filter said on its way forward."""
    probabilities: Tensor | None = None
    """``(..., T, K)`` of the models of a bank, or ``(..., T, R)`` of the regimes of ``GPB``."""
    outlier: Tensor | None = None
    """``(..., T, B)`` of each block of ``GPB`` that it was an outlier."""
    repaired: Tensor | None = None
    """``(..., T)`` bool, of rules with negative weights and motions that are not linear: the joint covariance of this
    state and the next was not positive definite and was repaired."""


class Told(NamedTuple):
    """What a step of the way back says of the state it has come to."""

    belief: Gaussian
    probabilities: Tensor | None = None
    outlier: Tensor | None = None
    repaired: Tensor | None = None


class BackwardStep(NamedTuple):
    """What a step of the way back starts from: two steps of the past, and the frame that led from one to the other."""

    past: Any
    ahead: Any
    frame: Frame
    carried: Any
    """The past that the step was predicted from: without a gradient where that of the way forward was cut after it.

    What comes later is known by how it has changed a prediction.  If one of the two had a gradient and the other not,
    that of their difference would be of the size of its rounding error.
    """


class Smoother(nn.Module):
    """Abstract, a part of ``Filter``: smoothed estimates of whole tracks.

    A filter gives ``past``, ``last`` and ``smooth_step``, and where it decides late ``fresh`` and ``decided``.  If its
    estimate does not hold all of that, it says ``keeps_past`` and puts it into ``Record.past``.
    """

    keeps_past = False
    """Whether the way back needs more of a step than an estimate holds of it."""

    kernels_back = False
    """Whether the way back can run as a kernel."""

    if TYPE_CHECKING:  # of Filter
        kernels_for: Callable[[Tensor], Any]
        motion: Motion
        scans: bool

        def _forth(
            self, measurements: Measurements, prior: Gaussian, checkpoint: int | None, truncate: int | None, past: bool
        ) -> tuple[Estimate, Any, Any]: ...
        def _batch(self, measurements: Measurements, prior: Gaussian) -> torch.Size: ...
        def _frames(self, measurements: Measurements, rank: int) -> tuple[list[Frame], Tensor]: ...

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
        """Whole tracks, each step by the measurements before and after it: Rauch-Tung-Striebel after the filter.

        What the filter has settled on stays: weights of measurements and estimates of their noise are in the beliefs
        that it carried on, fading factors widen the predictions as they did.  (How Huber's regression weighs the
        prediction is not known to the way back.)

        Args:
            z: as of ``forward``, like all others that are not below.
            prior: likewise.
            dt: likewise.
            u: likewise.
            std: likewise.
            noise: likewise.
            truncate: steps after which gradients of the way forward flow no further back; nor do those of predictions
                on the way back.
            checkpoint: steps between states that are kept for gradients, both ways.
            lag: measurements up to so many steps later count for the estimate of a step; None for all there are.
            estimate: what ``forward`` gave for the same arguments, so that it need not run again; of several models,
                if it was told ``past=True``: else an estimate does not hold what each knew, and they run all the same.
            sensors: as of ``forward``.
            which: likewise.

        Returns:
            Smoothed beliefs in the shapes of ``forward``; ``nis`` and ``log_likelihood`` are those of the filter, and
            ``info`` is a ``SmoothInfo``.

        Raises:
            ValueError: as of ``forward``; ``lag`` below 1, or an estimate of other tracks.
            NotImplementedError: constant gains, which do not say how states follow from each other; ``GPB`` over
                several sensors, as its way back is of one sensor's outliers; ``JPDA`` around several models.
        """
        f: Any = self if sensors is None and which is None else fused(self, sensors, which)
        f.check_smooths()
        check_lengths(lag=lag, truncate=truncate, checkpoint=checkpoint)
        measurements = Measurements(z, dt, u, std, noise)
        filtered, past = f._filtered(measurements, prior, checkpoint, truncate, estimate)
        rank = filtered.mean.dim() - 2
        if self.kernels_back and (kernels := self.kernels_for(z)) is not None:
            told: Told = kernels.back(self, past, measurements, rank, lag, truncate)
        else:
            frames, _ = f._frames(measurements, rank)
            *steps, last = tree.unbind(tree.map_tensors(lambda x: x.movedim(rank, 0), past), len(frames))
            told = sweep(self, [*steps, self.decided(last)], frames, rank, checkpoint, lag, truncate)
        info = SmoothInfo(filtered, told.probabilities, told.outlier, told.repaired)
        return Estimate(*told.belief, filtered.nis, filtered.log_likelihood, info)

    def check_smooths(self) -> None:
        """Raises a ``NotImplementedError`` that says why, of a filter that cannot be smoothed."""

    def check_smooths_several(self) -> None:
        """Raises a ``NotImplementedError`` that says why, of a filter that cannot be smoothed over several sensors."""

    def past(self, belief: Gaussian, info: Any, state: Any, steps: Any) -> Any:
        """What the way back needs: a tree of ``(..., T, ...)`` tensors.

        Args:
            belief: of ``forward``.
            info: likewise.
            state: after the last step; None of a filter that keeps no past.
            steps: ``Record.past`` of all steps; likewise.
        """
        raise TypeError(f"{type(self).__name__} needs a past, a last and a smooth_step to smooth")

    def fresh(self, past: Any) -> Any:
        """Of one step the past as it was at the step itself, before a later measurement decided anything of it."""
        return past

    def decided(self, past: Any) -> Any:
        """Of a last step the past as it stays, as no later measurement will decide anything of it."""
        return past

    def needed_ahead(self, past: Any) -> Any:
        """What smoothing a step reads of the past of the step after it; all other fields are None."""
        return past

    def last(self, past: Any) -> tuple[Any, Told]:
        """The state of the way back at its first step, the last of the track, and what it says of that."""
        raise TypeError(f"{type(self).__name__} needs a past, a last and a smooth_step to smooth")

    def smooth_step(self, step: BackwardStep, after: Any) -> tuple[Any, Told]:
        """One step back: the next state from that ``after`` the step, and what it says.

        States may have one more dimension in front of the batch, of several states for the same past.
        """
        raise TypeError(f"{type(self).__name__} needs a past, a last and a smooth_step to smooth")

    def _remembered(
        self, measurements: Measurements, prior: Gaussian, checkpoint: int | None, truncate: int | None
    ) -> Estimate:
        """The filtered estimate, which holds its past."""
        self.check_smooths()
        estimate, past = self._filtered(measurements, prior, checkpoint, truncate, None)
        return estimate._replace(past=past)

    def _filtered(
        self, measurements: Measurements, prior: Gaussian, checkpoint: int | None, truncate: int | None,
        estimate: Estimate | None,
    ) -> tuple[Estimate, Any]:  # fmt: skip
        """The filtered estimate, and what the way back needs of it."""
        state = steps = None
        if estimate is not None:
            z = measurements.z
            targets, length = prior.mean.shape[-1 - self.scans : -1], z.shape[-2 - self.scans]
            expected = (*self._batch(measurements, prior), *targets, length, self.motion.size)
            if estimate.mean.shape != expected:
                received = tuple(estimate.mean.shape)
                raise ValueError(f"estimate: expected one of these tracks, {expected}, received {received}")
            if estimate.past:
                return estimate._replace(past=()), estimate.past
        if estimate is None or self.keeps_past:
            estimate, state, steps = self._forth(measurements, prior, checkpoint, truncate, self.keeps_past)
        return estimate, self.past(Gaussian(estimate.mean, estimate.scale_tril), estimate.info, state, steps)


def sweep(
    f: Smoother, past: Any, frames: Sequence[Frame], rank: int, checkpoint: int | None, lag: int | None,
    truncate: int | None = None,
) -> Told:  # fmt: skip
    """What the way back says of all steps, stacked over time behind ``rank`` batch dimensions.

    Args:
        f: takes the steps.
        past: of each step.
        frames: one for each step.
        rank: batch dimensions.
        checkpoint: steps between states that are kept for gradients.
        lag: steps after which measurements are no longer looked at; None for all there are.
        truncate: steps after which gradients of the way forward were cut.
    """
    carried = [tree.detach(x) if truncate and k % truncate == 0 else x for k, x in enumerate(past, 1)]
    steps = [BackwardStep(*of) for of in zip(past[:-1], past[1:], frames[1:], carried[:-1], strict=True)]
    state, end = f.last(past[-1])
    if lag is None:
        smooth_step = partial(_back, f)
    else:
        smooth_step, state = partial(_lagged, f), tree.stack([state] * lag, 0)
    _, told = scan(smooth_step, state, steps[::-1], checkpoint)
    every: Told = tree.stack([*told[::-1], end], rank)
    return every


def _back(f: Smoother, after: Any, step: BackwardStep) -> tuple[Any, Told]:
    return f.smooth_step(step, after)


def _lagged(f: Smoother, window: Any, step: BackwardStep) -> tuple[Any, Told]:
    """One step back of several states: ``window[l]`` knows the measurements up to ``l`` steps later.

    What the newest of them has not decided yet is taken as it was at the step itself.
    """
    ahead = f.fresh(step.ahead)
    if ahead is step.ahead:
        before, told = f.smooth_step(step, window)
    else:
        before, told = f.smooth_step(step._replace(ahead=ahead), tree.map_tensors(lambda x: x[:1], window))
        if len(tree.flatten(window)[0]) > 1:
            older, told = f.smooth_step(step, tree.map_tensors(lambda x: x[1:], window))
            before = tree.map_tensors(lambda *xs: torch.cat(xs), before, older)
    now, _ = f.last(f.fresh(step.past))
    window = tree.map_tensors(lambda x, older: torch.cat([x.unsqueeze(0), older[:-1]]), now, before)
    return window, tree.map_tensors(lambda x: x[-1], told)
