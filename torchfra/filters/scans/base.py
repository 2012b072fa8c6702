"""Filters of scans: several targets, whose measurements do not say whose they are."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.base import Filter, S
from torchfra.filters.gpb import GPB
from torchfra.filters.records import Record, Smoothed
from torchfra.filters.tracks import Past
from torchfra.gaussian.inputs import BackwardStep, Frame, Measurements, Whole, make_frames
from torchfra.hyper import hypers
from torchfra.linalg.tracing import is_traced
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Innovation


class ScanPast(NamedTuple):
    """What the way back needs of a scan; ``(..., N, T, ...)`` of a whole sequence."""

    inner: Past
    """Of the targets' filters."""
    searched: Tensor
    """``(..., N)`` how often the covariance of a target that seemed lost has been quadrupled."""


class ScanFilter(Filter[S]):
    """Abstract: measurements ``z (..., T, J, m)``, beliefs ``(..., N, n)``.

    Frames are of measurements ``(..., 1, J)``, to be held against targets ``(..., N, 1)``.  Records have innovations in
    the measurement's own units, and the log density of the scan.
    """

    scans = True
    keeps_past = True
    one_sensor = "gate and clutter are of the elements of one sensor"
    inner: Any

    def _batch(self, measurements: Measurements, prior: Gaussian, name: str = "prior") -> torch.Size:
        """The batch of scenes, checked; targets are no part of it."""
        batch = super()._batch(measurements, prior, name)
        if isinstance(self.inner, GPB):
            self.inner.qualities.check_noise("noise", measurements.noise)
        count = prior.mean.shape[-2]
        for path, hyper in hypers(self).items():
            if hyper.batch_rank and hyper.raw.shape[-1 - hyper.event_dim] not in (1, count):
                shape = tuple(hyper.raw.shape)
                raise ValueError(
                    f"{path}: expected a value for each of {count} targets or one for all, received {shape}"
                )
        return batch

    def _frames(self, measurements: Measurements, rank: int) -> tuple[list[Frame], Tensor]:
        """A frame of measurements ``(..., 1, J)`` for each step, and the log norms of the noise, time first."""
        z, dt, u, std, noise = measurements
        z = z.transpose(-3, -2).unsqueeze(-4)
        std = std if std is None else std.transpose(-3, -2).unsqueeze(-4)
        noise = noise if noise is None else noise.transpose(-4, -3).unsqueeze(-5)
        dt = dt.unsqueeze(-2).unsqueeze(-2) if isinstance(dt, Tensor) and dt.dim() > 1 else dt
        u = u.unsqueeze(-3).unsqueeze(-3) if u is not None and u.dim() > 2 else u
        frames, log_norm = make_frames(Measurements(z, dt, u, std, noise), self.motion, self.sensor, rank + 1)
        if not self.whole(measurements):
            return frames, log_norm
        unit = self.sensor.measurement_noise(torch.zeros_like(frames[0].z[..., :1, :]))
        return [frame._replace(measurement_noise=unit) for frame in frames], log_norm

    def whole(self, measurements: Measurements) -> bool:
        """Whether measurements are complete or missing, and all have the same noise: then they share their gains."""
        z, _, _, std, noise = measurements
        if isinstance(measurements, Whole):
            return True
        own = type(self.sensor).measurement_noise is not Sensor.measurement_noise
        if own or std is not None or noise is not None or is_traced(z):
            return False
        missing = z.isnan()
        return bool((missing == missing[..., :1]).all())

    def _scores(self, record: Record, log_norm: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised innovation squared of the combined innovation, and log density of the scan."""
        assert record.density is not None
        return record.normalised.square().sum(-1), record.density

    def innovation_of(self, record: Record, frame: Frame) -> Innovation:
        """The combined innovation, its root, and what they say of the scan."""
        assert record.residual is not None
        return Innovation(record.residual, record.root, *self._scores(record, frame.measurement_noise.log_norm))

    def for_each_target(self, measurements: Measurements) -> Measurements:
        """Measurements for the way back of targets: time steps and ``u`` of scenes have a dimension for targets."""
        dt, u = measurements.dt, measurements.u
        dt = dt.unsqueeze(-2) if isinstance(dt, Tensor) and dt.dim() > 1 else dt
        return measurements._replace(dt=dt, u=u.unsqueeze(-3) if u is not None and u.dim() > 2 else u)

    def past(self, belief: Gaussian, info: Any, state: Any, steps: Tensor) -> ScanPast:
        """What the way back needs: of each target its beliefs, in which associations stay as they were."""
        return ScanPast(self.inner.past(belief, info, None, None), steps)

    def last(self, past: ScanPast) -> tuple[Gaussian, Smoothed]:
        """The last scan, which no later one speaks of."""
        last: tuple[Gaussian, Smoothed] = self.inner.last(past.inner)
        return last

    def smooth_step(self, step: BackwardStep, after: Gaussian) -> tuple[Gaussian, Smoothed]:
        """One scan back, of each target for itself."""
        belief, factor = tree.insert_batch_dimension(step.past.inner.belief), step.ahead.inner.factor
        ahead = self.inner.carry(belief, step.frame, None if factor is None else factor.unsqueeze(-1))
        times = 2 ** (step.ahead.searched - step.past.searched).clamp_min(0.0)[..., None, None, None]
        spread, noise = times * ahead.spread, times * ahead.process_noise
        subtracted = None if ahead.subtracted is None else times * ahead.subtracted
        ahead = ahead._replace(spread=spread, process_noise=noise, subtracted=subtracted)
        told = self.inner.reverse(belief, ahead, tree.insert_batch_dimension(after))
        repaired = None if told.repaired is None else told.repaired.squeeze(-1)
        told = Smoothed(tree.remove_batch_dimension(told.belief), repaired=repaired)
        return told.belief, told
