"""Positions that measurements imply, and errors of measurements, for maps."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.scenarios import Scenario, Tracks
from torchfra.scenarios.bounds import slopes
from torchfra.sensors.base import Sensor

_ITERATIONS = 40
_CONVERGED = 1e-6
"""Largest step of the last iteration: m, and a share of the fix's distance from the truth."""
_PARALLEL = 1e-6
"""Smallest ratio of the weakest measured direction to the strongest: parallel lines of sight give no fix."""


def fixes(scenario: Scenario, tracks: Tracks) -> Tensor:
    """The position that each measurement implies, ``(B, T, J, d)``, m; ``J`` is 1 except for scans.

    Two bearings imply the place where they cross, a range and a bearing the polar fix: the position whose measurement
    is closest to the actual one, in standard deviations.  It is found by Gauss-Newton steps from the truth, each
    shortened until it comes closer.  All other components of the state are the true ones.  The position is NaN where
    fewer elements were measured than it has, or where there is none.  Where filters have other coordinates than the
    truth, it is that of ``Sensor.locate``.
    """
    sensor, z, truth = scenario.sensor, tracks.z, tracks.truth
    if scenario.conversion is not None:
        place = sensor.locate(z) if sensor.locates else z.new_full((*z.shape[:-1], scenario.motion.dims), torch.nan)
        return place if z.dim() == 4 else place.unsqueeze(2)
    places = list(range(*scenario.position.indices(truth.shape[-1]))[: sensor.reads])
    u = None if tracks.u is None else tracks.u.expand(*truth.shape[:-1], -1)
    x, step, slope, share = truth, truth[..., places], truth, torch.ones_like(truth[..., :1])
    for _ in range(_ITERATIONS):
        step, slope = _gauss_newton(sensor, z, x, u, places)
        there = x.index_add(-1, torch.tensor(places), share * step)
        closer = _distance(sensor, z, there, u) <= _distance(sensor, z, x, u)
        x, share = torch.where(closer, there, x), torch.where(closer, (2 * share).clamp(max=1.0), share / 4)
    offset = (x - truth)[..., places]
    strength = torch.linalg.svdvals(slope.nan_to_num())
    crossing = strength[..., len(places) - 1 :].amax(-1) > _PARALLEL * strength[..., 0]
    converged = step.norm(dim=-1) <= _CONVERGED * (1 + offset.norm(dim=-1))
    measured = (~z.isnan()).sum(-1) >= len(places)
    return torch.where((measured & crossing & converged).unsqueeze(-1), x[..., places], torch.nan).unsqueeze(2)


def deviations(scenario: Scenario, tracks: Tracks) -> Tensor:
    """Largest error among the elements of each measurement, ``(B, T, J)``.

    In standard deviations, as the sensor states them.  0 where nothing was measured or the truth is unknown, and
    where filters have other coordinates than the truth.
    """
    if scenario.conversion is not None:
        return tracks.z.new_zeros(*tracks.z.shape[:2], 1 if tracks.z.dim() == 3 else tracks.z.shape[2])
    return _residual(scenario.sensor, tracks.z, tracks.truth, tracks.u).nan_to_num(nan=0.0).abs().amax(-1, keepdim=True)


def _gauss_newton(sensor: Sensor, z: Tensor, x: Tensor, u: Tensor | None, places: list[int]) -> tuple[Tensor, Tensor]:
    """The step ``(..., d)`` of the components ``places`` of states ``x``, and the slope of the measurement there."""
    slope = slopes(sensor, x, u)[..., places]
    slope = sensor.measurement_noise(z).whiten(torch.where(z.isnan().unsqueeze(-1), 0.0, slope))
    residual = _residual(sensor, z, x, u)
    good = slope.isfinite().flatten(-2).all(-1) & residual.isfinite().all(-1)
    step = torch.linalg.pinv(torch.where(good[..., None, None], slope, 0.0)) @ residual.unsqueeze(-1)
    return torch.where(good.unsqueeze(-1), step.squeeze(-1), torch.nan), slope


def _distance(sensor: Sensor, z: Tensor, x: Tensor, u: Tensor | None) -> Tensor:
    """Distance of states ``x`` from the measurement, in standard deviations, ``(..., 1)``."""
    return _residual(sensor, z, x, u).square().sum(-1, keepdim=True).sqrt()


def _residual(sensor: Sensor, z: Tensor, x: Tensor, u: Tensor | None) -> Tensor:
    """Residual of the measurement at states ``x``, in standard deviations, ``(..., m)``; 0 where missing."""
    gap = torch.where(z.isnan(), 0.0, sensor.difference(z, sensor(x, u)))
    return sensor.measurement_noise(z).whiten(gap.unsqueeze(-1)).squeeze(-1)
