"""Errors of estimates from scans: in range and direction, in space, as raw measurements, and targets that swap."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra import metrics
from torchfra.angles import wrap
from torchfra.coordinates import AZIMUTH, ELEVATION, from_cartesian
from torchfra.scenarios import Scenario, Tracks
from torchfra.types import Estimate

CONVERGED, LOST = 10, 100.0
"""Steps that do not count in averages, and the RMSE of a run, m, from which on a track of it is lost."""
INVERSE_RANGE = 5
"""Component of the modified spherical state."""
RANGE = 2
"""Element of a measurement."""
_FARTHEST = 25.0
"""Squared distance, in standard deviations, up to which the nearest measurement of a scan may come from a target."""


def errors(scenario: Scenario, estimate: Estimate, tracks: Tracks) -> dict[str, Tensor]:
    """Per run, target and step ``(B, N, T)``: errors in spherical coordinates and in space, ``swaps`` and ``ospa``.

    Args:
        scenario: with estimates in modified spherical coordinates.
        estimate: as the filter gives it, of several targets ``(B, N, T)`` or of one ``(B, T)``.
        tracks: what was filtered.
    """
    parts = (estimate.mean, scenario.cartesian(estimate).mean, tracks.truth)
    mean, cartesian, truth = (x if x.dim() == 4 else x.unsqueeze(1) for x in parts)
    angles, position = from_cartesian(truth), scenario.truth_position
    return {
        "range": range_errors(estimate._replace(mean=mean), truth),
        "azimuth": wrap(mean[..., AZIMUTH] - angles[..., AZIMUTH]),
        "elevation": mean[..., ELEVATION] - angles[..., ELEVATION],
        "position": metrics.error(cartesian, truth, position),
        "raw": measured_ranges(scenario, tracks),
        "swaps": metrics.swaps(cartesian, truth, position, LOST),
        "ospa": metrics.ospa(cartesian, truth, position, cutoff=LOST).distance,
    }


def range_errors(estimate: Estimate, truth: Tensor) -> Tensor:
    """Errors ``(..., T)`` in range of estimates in modified spherical coordinates, m."""
    return 1 / estimate.mean[..., INVERSE_RANGE] - 1 / from_cartesian(truth)[..., INVERSE_RANGE]


def measured_ranges(scenario: Scenario, tracks: Tracks) -> Tensor:
    """Range errors ``(B, N, T)`` of the measurements nearest to each target, m; NaN where it was missed."""
    truth, z = (tracks.truth, tracks.z) if tracks.z.dim() == 4 else (tracks.truth.unsqueeze(1), tracks.z.unsqueeze(-2))
    exact = scenario.sensor(from_cartesian(truth)).movedim(1, 2).unsqueeze(-2)  # (B, T, N, 1, m)
    gap = scenario.sensor.difference(z.unsqueeze(-3), exact)
    std = scenario.sensor.std() * float(str(scenario.settings["noise_scale"]))
    distance, nearest = (gap / std).square().sum(-1).nan_to_num(torch.inf).min(-1)
    error = gap[..., RANGE].gather(-1, nearest.unsqueeze(-1)).squeeze(-1)
    return torch.where(distance < _FARTHEST, error, torch.nan).movedim(1, 2)


def averages(of: dict[str, Tensor]) -> dict[str, Any]:
    """Of the errors of all runs.

    Returns:
        ``rmse_range``, ``rmse_azimuth``, ``rmse_elevation`` and ``rmse_position`` over time of each target ``[N][T]``;
        from step 11 on ``rmse`` of the position, ``rmse_kept`` without the runs that are ``lost``, ``median_run``, and
        root mean square range errors ``raw_range`` and ``filtered_range``; ``swaps``, and ``ospa`` over time.
    """
    over_time = {f"rmse_{key}": of[key].square().mean(0).sqrt().tolist()
                 for key in ("range", "azimuth", "elevation", "position")}  # fmt: skip
    converged = slice(CONVERGED, None)
    of_run = of["position"][..., converged].square().mean((-2, -1)).sqrt()
    lost = of_run > LOST
    ranges = of["range"][..., converged].square()
    return {
        "rmse": of_run.square().mean().sqrt().item(),
        "rmse_kept": of_run[~lost].square().mean().sqrt().item(),
        "median_run": of_run.median().item(),
        "lost": int(lost.sum()),
        "swaps": int(of["swaps"].sum()),
        "raw_range": of["raw"][..., converged].square().nanmean().sqrt().item(),
        "filtered_range": ranges.mean().sqrt().item(),
        "filtered_range_median_run": ranges.mean((-2, -1)).sqrt().median().item(),
        "ospa": of["ospa"].mean(0).tolist(),
        **over_time,
    }
