"""Smoothing: the way back over a track that has been filtered."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra.filters.checks import check_lengths
from torchfra.filters.engine import Engine
from torchfra.filters.fusion import fused
from torchfra.filters.precision import in_full_precision
from torchfra.filters.records import Smoothed
from torchfra.gaussian.inputs import BackwardStep as BackwardStep
from torchfra.gaussian.inputs import Measurements, Time
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Estimate, Gaussian

Told = Smoothed


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


class Smoother(nn.Module):
    """Abstract, a part of ``Filter``: smoothed estimates of whole tracks.

    A filter gives ``past``, ``last`` and ``smooth_step``, and where it decides late ``fresh`` and ``decided``.  If its
    estimate does not hold all of that, it says ``keeps_past`` and puts it into ``Record.past``.
    """

    keeps_past = False
    """Whether the way back needs more of a step than an estimate holds of it."""

    if TYPE_CHECKING:  # of Filter
        engine: Engine
        motion: Motion
        scans: bool

        def _forth(
            self, measurements: Measurements, prior: Gaussian, checkpoint: int | None, truncate: int | None, past: bool
        ) -> tuple[Estimate, Any, Any]: ...
        def _batch(self, measurements: Measurements, prior: Gaussian) -> torch.Size: ...

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
        every = self.engine.backward(
            self, past, measurements, rank, lambda: f._frames(measurements, rank)[0], checkpoint, lag, truncate
        )
        info = SmoothInfo(filtered, every.probabilities, every.outlier, every.repaired)
        return Estimate(*every.belief, filtered.nis, filtered.log_likelihood, info)

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

    def last(self, past: Any) -> tuple[Any, Smoothed]:
        """The state of the way back at its first step, the last of the track, and what it says of that."""
        raise TypeError(f"{type(self).__name__} needs a past, a last and a smooth_step to smooth")

    def smooth_step(self, step: BackwardStep, after: Any) -> tuple[Any, Smoothed]:
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
