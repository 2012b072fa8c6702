"""Wang et al. (2021): bearings from two moving stations, with outliers (scenario 1) and a manoeuvre (scenario 2)."""

from __future__ import annotations

from typing import Any

from papers.experiment import Experiment, Figures, Results, Study, catalogue_filters, filtered
from papers.figures import innovations, rmse_curves
from torchfra import plotting
from torchfra.evaluation import table

GATE = 5.991
"""Normalised innovations squared above it are drawn as abnormal: the 95 % point of chi-square with two elements."""
NUMBERS = {"bearings-outliers": (2, 3, 4, 5), "bearings-manoeuvre": (6, 7, 8, 9)}
"""Figures of the paper."""
filters = catalogue_filters


def summarise(study: Study, results: Results) -> tuple[dict[str, Any], str]:
    """Nothing to add: position and velocity errors, divergence and run time of every filter."""
    return {}, table(results)


def draw(study: Study, results: Results, summary: dict[str, Any]) -> Figures:
    """Paths and innovations of the first run, and both errors over time."""
    scenario = study.scenario
    first = scenario.simulate(1, study.seed)
    estimates = {name: filtered(f, scenario, first) for name, f in study.filters.items()}
    paths = {name: estimate.mean[0] for name, estimate in estimates.items()}
    compared = [name for name in ("srckf", "fra_srckf", "fra") if name in estimates] or list(estimates)
    nis = {name: estimates[name].nis[0] for name in compared}
    stations = first.u if scenario.name == "bearings-outliers" else None  # the paper's figure 6 leaves them out
    title = f"{scenario.name}, first run"
    figures = {
        "tracks": plotting.tracks(first.truth[0], paths, title, stations),
        "innovations": innovations(nis, GATE, scenario.dt, title),
        "position": rmse_curves(results, "position", scenario.dt, study.title),
        "velocity": rmse_curves(results, "velocity", scenario.dt, study.title),
    }
    return {f"figure-{n}-{kind}": f for n, (kind, f) in zip(NUMBERS[scenario.name], figures.items(), strict=True)}


_FILTERS = ("ukf", "srckf", "mr_ckf", "rsrckf", "rmckf", "fra_srckf", "fra")
EXPERIMENTS = {name: Experiment(_FILTERS, filters, summarise, draw) for name in NUMBERS}
