"""Du & Zhang (2020): ADS-B positions of an aircraft that turns twice, and interacting models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from papers.experiment import Experiment, Figures, Filters, Results, Study, catalogue_filters, filtered
from papers.figures import by_coordinate, probabilities
from torchfra import plotting, presets
from torchfra.scenarios import Scenario
from torchfra.tables import text_table

CONVERGED = 18
"""Samples before sample 21, which do not count in the averages: filters start with sample 3."""
FIRST = 3
"""The first sample that filters see."""
NUMBERS = {"tracks": "2-tracks", "mean_error": "3-4-mean-error", "rmse": "5-6-rmse", "mape": "7-8-mape",
           "probabilities": "probabilities"}  # fmt: skip
"""Names of figures: the numbers of the paper's, of which each panel is one; it has none of probabilities."""
_MODELS = {"imm3": 3, "imm5": 5}
_COLUMNS = {"mean error": "mean_error", "largest": "largest_mean_error", "RMSE m": "rmse", "MAPE %": "mape"}


def filters(scenario: Scenario, names: Sequence[str]) -> Filters:
    """Filters of these names; ``imm3`` and ``imm5`` run the first three and all five models of the bank."""
    made: Filters = {}
    for name in names:
        if name in _MODELS and scenario.bank is not None:
            made[name] = presets.imm_srckf(scenario.bank[: _MODELS[name]], scenario.sensor)
        else:
            made |= catalogue_filters(scenario, [name])
    return made


def summarise(study: Study, results: Results) -> tuple[dict[str, Any], str]:
    """``averages`` over time by coordinate, and the names of the ``models``."""
    bank = study.scenario.bank
    of = averages(results)
    rows = [
        [name, *(f"{values[f'{q}_x']:.2f} / {values[f'{q}_y']:.2f}" for q in _COLUMNS.values()),
         f"{results[name]['relative_time']:.2f}"]
        for name, values in of.items()
    ]  # fmt: skip
    lines = ["averages over time from sample 21 on, x / y", text_table(["filter", *_COLUMNS, "time / UKF"], rows)]
    return {"averages": of, "models": bank.names if bank is not None else []}, "\n".join(lines)


def averages(results: Results) -> dict[str, dict[str, float]]:
    """Over time, from sample 21 on: signed mean error, its largest size, RMSE and relative error by coordinate."""
    of_filters: dict[str, dict[str, float]] = {}
    for name, of in results.items():
        over_time = {f"{q}_{axis}": np.array(of[f"{q}_{axis}"][CONVERGED:]) for axis in "xy"
                     for q in ("mean_error", "rmse", "mape")}  # fmt: skip
        largest = {f"largest_{key}": float(np.abs(v).max()) for key, v in over_time.items() if "mean_error" in key}
        of_filters[name] = {key: float(values.mean()) for key, values in over_time.items()} | largest
    return of_filters


def draw(study: Study, results: Results, summary: dict[str, Any]) -> Figures:
    """Paths of the first run; signed error, RMSE and relative error over time; probabilities of the models."""
    scenario = study.scenario
    one = scenario.simulate(1, study.seed)
    paths = {name: filtered(f, scenario, one).mean[0] for name, f in study.filters.items()}
    start = FIRST * scenario.dt
    figures = {"tracks": plotting.tracks(one.truth[0], paths, f"{scenario.name}, first run")}
    for quantity in ("mean_error", "rmse", "mape"):
        figures[quantity] = by_coordinate(results, quantity, start, scenario.dt, study.title)
    of = {name: result["probabilities"] for name, result in results.items() if "probabilities" in result}
    if of and scenario.bank is not None:
        figures["probabilities"] = probabilities(of, scenario.bank.names, start, scenario.dt, study.title)
    return {f"du-{NUMBERS[name]}": figure for name, figure in figures.items()}


EXPERIMENTS = {"adsb-turns": Experiment(("srckf", "imm3", "imm5", "vsimm_srckf"), filters, summarise, draw)}
