"""Whole tracks through a filter: forwards, and backwards over what the forward pass has kept."""

from __future__ import annotations

from typing import Any, NamedTuple

from torchfra.filters.failures import diagnose, diagnose_smoothed, with_gradients, without_failed_gradients
from torchfra.filters.several_sensors import SensorsInTurn
from torchfra.gaussian.inputs import Measurements
from torchfra.steps.checks import needed_inputs
from torchfra.steps.engine import Engine
from torchfra.steps.loop import Options
from torchfra.steps.records import Smoothed, SmoothInfo
from torchfra.steps.recursion import Recursion
from torchfra.types import Estimate, Gaussian


class WholeTracks(NamedTuple):
    """How a call of a filter runs tracks."""

    f: Recursion
    """The filter."""
    engine: Engine
    """That runs its steps."""
    turns: SensorsInTurn | None
    """The sensor of each step; None for the filter's own."""
    options: Options
    """Of the loop over steps."""

    def estimate(self, measurements: Measurements, prior: Gaussian) -> Estimate:
        """The filtered estimate."""
        measurements = self._needed(measurements, prior)
        estimate, _, _ = self._run(measurements, prior, past=False)
        return without_failed_gradients(
            self.f, estimate, estimate, measurements, prior, lambda z, x: self._run(z, x, past=False)[0]
        )

    def with_past(self, measurements: Measurements, prior: Gaussian) -> Estimate:
        """The filtered estimate with its past for the backward pass."""
        estimate, past = self._filtered(self._needed(measurements, prior), prior, None)
        return estimate._replace(past=past)

    def smoothed(
        self, measurements: Measurements, prior: Gaussian, lag: int | None, filtered: Estimate | None
    ) -> Estimate:
        """The smoothed estimate, by ``lag`` later steps or all, from the ``filtered`` one if there is one."""
        measurements = self._needed(measurements, prior)
        estimate = self._back(measurements, prior, lag, filtered)
        return without_failed_gradients(
            self.f, estimate, estimate.info.filtered, measurements, prior, lambda z, x: self._back(z, x, lag, None)
        )

    def _needed(self, measurements: Measurements, prior: Gaussian) -> Measurements:
        """The measurements with the inputs that they need alone."""
        if self.turns is not None:
            return measurements
        return needed_inputs(self.f, measurements, lambda: self.f._batch(measurements, prior))

    def _run(self, measurements: Measurements, prior: Gaussian, *, past: bool) -> tuple[Estimate, Any, Any]:
        """The estimate, and for a backward pass the last state and ``Record.past`` of all steps."""
        f, options = self.f, self.options._replace(past=past)
        estimate, state, kept = (self.turns or self.engine).forward(f, measurements, prior, options)
        if estimate.failure is None:
            estimate = estimate._replace(failure=diagnose(f, estimate, measurements, prior))
        return with_gradients(f, estimate), state, kept

    def _filtered(self, measurements: Measurements, prior: Gaussian, estimate: Estimate | None) -> tuple[Estimate, Any]:
        """The filtered estimate, and its past for the backward pass."""
        f, state, steps = self.f, None, None
        if estimate is not None:
            targets, length = prior.mean.shape[-1 - f.scans : -1], measurements.z.shape[-2 - f.scans]
            expected = (*(self.turns or f)._batch(measurements, prior), *targets, length, f.motion.size)
            if estimate.mean.shape != expected:
                received = tuple(estimate.mean.shape)
                raise ValueError(f"estimate: expected one of these tracks, {expected}, received {received}")
            if estimate.failure is None:
                estimate = estimate._replace(failure=diagnose(f, estimate, measurements, prior))
            if estimate.past:
                return estimate._replace(past=()), estimate.past
        more = type(f).last is not Recursion.last  # it goes back over more than the beliefs that an estimate holds
        if estimate is None or more:
            estimate, state, steps = self._run(measurements, prior, past=more)
        return estimate, f.past(Gaussian(estimate.mean, estimate.scale_tril), estimate.info, state, steps)

    def _back(
        self, measurements: Measurements, prior: Gaussian, lag: int | None, filtered: Estimate | None
    ) -> Estimate:
        """The smoothed estimate."""
        filtered, past = self._filtered(measurements, prior, filtered)
        f, rank, frames = self.f, filtered.mean.dim() - 2, (self.turns or self.f)._frames
        smoothed: Smoothed = self.engine.backward(
            f, past, measurements, rank, lambda: frames(measurements, rank)[0], lag, self.options
        )
        info = SmoothInfo(filtered, smoothed.probabilities, smoothed.outlier, smoothed.repaired)
        estimate = Estimate(*smoothed.belief, filtered.nis, filtered.log_likelihood, info)
        return estimate._replace(failure=diagnose_smoothed(estimate, filtered))
