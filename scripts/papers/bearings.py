"""Wang et al. (2021): bearings from two moving stations, with outliers (scenario 1) and a manoeuvre (scenario 2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from papers.experiment import SHOWN, Experiment, Figures, Filters, Results, Study, catalogue_filters, filtered
from papers.figures import innovations, rmse_curves
from torchfra import plotting, presets
from torchfra.evaluation import table
from torchfra.filters import Filter
from torchfra.scenarios import Scenario

GATE = 5.991
"""Normalised innovations squared above it are drawn as abnormal: the 95 % point of chi-square with two elements."""
NUMBERS = {"bearings-outliers": (2, 3, 4, 5), "bearings-manoeuvre": (6, 7, 8, 9)}
"""Numbers of the paper's figures, in whose names they stand."""
LITERAL = "fra_srckf_literal"
OWN: dict[str, Callable[[Scenario], Filter]] = {
    LITERAL: lambda s: presets.fra_srckf(s.motion, s.sensor, rcond=0.0, fading_max=math.inf),
    "gpb_one_motion": lambda s: presets.gpb(s.motion, s.sensor),
    "imm_rsrckf": lambda s: presets.imm(s.bank or s.motion, s.sensor, inner=presets.rsrckf, self_transition=0.99),
}
"""Filters that the catalogue has not: the paper's formulas without the safeguards that it does not give, ``gpb`` with
as little information as filters of one motion have, and robust filters inside interacting motions."""


def filters(scenario: Scenario, names: Sequence[str]) -> Filters:
    """Filters of these names, those of ``OWN`` among them, in their order."""
    made = catalogue_filters(scenario, known) if (known := [name for name in names if name not in OWN]) else {}
    return {name: OWN[name](scenario) if name in OWN else made[name] for name in names}


def summarise(study: Study, results: Results) -> tuple[dict[str, Any], str]:
    """Nothing to add: position and velocity errors, divergence and run time of every filter."""
    return {}, table(results)


def draw(study: Study, results: Results, summary: dict[str, Any]) -> Figures:
    """Paths of the first run; of all runs the innovations, as quartiles, and both errors over time."""
    scenario = study.scenario
    first = scenario.simulate(1, study.seed)
    paths = {name: filtered(f, scenario, first).mean[0] for name, f in study.filters.items()}
    compared = [name for name in ("srckf", "fra_srckf", "fra") if name in paths] or list(paths)
    tracks = scenario.simulate(min(study.runs, SHOWN), study.seed)
    nis = {name: filtered(study.filters[name], scenario, tracks).nis for name in compared}
    stations = first.u if scenario.name == "bearings-outliers" else None  # the paper's figure 6 leaves them out
    figures = {
        "tracks": plotting.tracks(first.truth[0], paths, f"{scenario.name}, first run", stations),
        "innovations": innovations(nis, GATE, scenario.dt, f"{scenario.name}, quartiles of {len(tracks.z)} runs"),
        "position": rmse_curves(results, "position", scenario.dt, study.title),
        "velocity": rmse_curves(results, "velocity", scenario.dt, study.title),
    }
    return {f"wang-{n}-{kind}": f for n, (kind, f) in zip(NUMBERS[scenario.name], figures.items(), strict=True)}


_FILTERS = ("ukf", "srckf", "mr_ckf", "rsrckf", "rmckf", "fra_srckf", "fra")
EXPERIMENTS = {name: Experiment(_FILTERS, filters, summarise, draw) for name in NUMBERS}
