"""Confidence intervals of an evaluation's results, and the consistency of filters."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra.evaluation.running_metrics import RunningMetrics
from torchfra.metrics.statistics import chi_square_bounds, mean_interval, median_interval


def sureness(of: RunningMetrics) -> dict[str, Any]:
    """Intervals of 95 % over the runs, ``[value, low, high]``, and the consistency of covariances.

    Args:
        of: the metrics of a filter.

    Returns:
        ``mean_track_rmse_position`` and ``median_track_rmse_position`` and so on for all quantities, of the root mean
        square errors of single runs; ``mean_log_likelihood`` per measurement (not of scans);
        ``anees``: the mean normalised error squared of the position per component, and ``anis``: that of the
        innovations per element (not of scans), both 1 of an honest filter, and of both
        ``*_bounds``: what it is within at a step with 95 % probability if the filter is honest (chi-square), and
        ``*_inside``: the share of steps at which it is.
    """
    found: dict[str, Any] = {}
    for name in of.states:
        errors = of.runs(f"rmse_{name}")
        found[f"mean_track_rmse_{name}"] = list(mean_interval(errors))
        found[f"median_track_rmse_{name}"] = list(median_interval(errors))
    if "log_likelihood" in of.of_runs:
        found["mean_log_likelihood"] = list(mean_interval(of.runs("log_likelihood")))
    for name in ("nees", "nis"):
        if name in of.consistency:
            found |= _consistency(f"a{name}", of.consistency[name], of.consistency[f"{name}_components"])
            found[f"a{name}"] = list(mean_interval(of.runs(name)))
    return found


def _consistency(name: str, squares: Tensor, components: Tensor) -> dict[str, Any]:
    """The bounds of the step with the most components, and how many steps are within their own."""
    known = components > 0
    if not bool(known.any()):
        return {f"{name}_bounds": [torch.nan, torch.nan], f"{name}_inside": torch.nan}
    bounds = {count: chi_square_bounds(count) for count in components[known].unique().tolist()}
    mean = squares[known] / components[known]
    pairs = torch.tensor([bounds[count] for count in components[known].tolist()], dtype=mean.dtype)
    inside = (mean >= pairs[:, 0]) & (mean <= pairs[:, 1])
    return {f"{name}_bounds": list(bounds[float(components.max())]), f"{name}_inside": inside.double().mean().item()}
