"""Qin et al. (2018): Huber filters under contaminated noise, on the growth model and on a re-entry."""

from __future__ import annotations

from typing import Any

import numpy as np

from papers.experiment import Experiment, Figures, Results, Study, catalogue_filters
from papers.figures import against, rmse_curves
from torchfra.catalogue import make_scenario
from torchfra.evaluation import evaluate
from torchfra.scenarios import Scenario
from torchfra.tables import text_table

filters = catalogue_filters
NUMBERS = {
    "growth": {"position": (2, 1)},
    "reentry": {"position": (3, 6), "velocity": (4, 7), "parameter": (5, 8)},
}
"""Numbers of the paper's figures, by quantity: over time, and over the size of the contamination."""


def summarise(study: Study, results: Results) -> tuple[dict[str, Any], str]:
    """``by_size``: mean square errors for each size of the contamination; prints root mean square errors and those."""
    sizes = by_size(study)
    tables = [_table(study.scenario, results)]
    if sizes:
        names = list(study.filters)
        rows = [[size, *(f"{of[name]['mmse']:.4g}" for name in names)] for size, of in sizes.items()]
        tables.append(text_table(["noise times", *names], rows))
    return {"by_size": sizes}, "\n".join(tables)


def by_size(study: Study) -> dict[str, Results]:
    """Mean square errors of every filter for each size of the contamination.

    Returns:
        By size and filter: ``mse`` of the position over time, its mean ``mmse``, and the means of the other quantities,
        such as ``mmse_velocity``.
    """
    errors: dict[str, Results] = {}
    for size in study.sizes:
        scenario = make_scenario(study.scenario.name, **study.options, size=float(size))
        results = evaluate(  # the models of the filters are the same for every size
            scenario, study.filters, runs=study.runs, seed=study.seed, compile=study.compile, progress=study.progress
        )
        errors[f"{size:g}"] = {name: _mean_squares(of, scenario) for name, of in results.items()}
    return errors


def _mean_squares(of: dict[str, Any], scenario: Scenario) -> dict[str, Any]:
    mse = np.square(of["rmse_position"])
    others = {f"mmse_{q}": float(np.square(of[f"rmse_{q}"]).mean()) for q in scenario.quantities if q != "position"}
    return {"mmse": float(mse.mean()), "mse": mse.tolist(), **others}


def _quantities(scenario: Scenario) -> list[str]:
    """Those that the state has: the state of the growth model is one position."""
    return [q for q in scenario.quantities if scenario.motion.size > 1 or q == "position"]


def _table(scenario: Scenario, results: Results) -> str:
    quantities = _quantities(scenario)
    rows = [
        [name, *(f"{np.square(of[f'rmse_{q}']).mean() ** 0.5:.4g}" for q in quantities), f"{of['relative_time']:.2f}"]
        for name, of in results.items()
    ]
    return text_table(["filter", *quantities, "time / UKF"], rows)


def draw(study: Study, results: Results, summary: dict[str, Any]) -> Figures:
    """Errors over time, and mean square errors over the size of the contamination."""
    scenario, sizes, numbers = study.scenario, summary["by_size"], NUMBERS[study.scenario.name]
    figures = {}
    for q in _quantities(scenario):
        over_time, over_sizes = numbers[q]
        figures[f"qin-{over_time}-{q}"] = rmse_curves(results, q, scenario.dt, study.title)
        if sizes:
            key = "mmse" if q == "position" else f"mmse_{q}"
            curves = {name: [of[name][key] for of in sizes.values()] for name in study.filters}
            axes = "times the noise grows", f"mean square error of the {q}"
            figures[f"qin-{over_sizes}-mmse-{q}"] = against(list(map(float, sizes)), curves, *axes, study.title)
    return figures


_FILTERS = ("ghckf", "hghckf1", "hghckf2")
EXPERIMENTS = {
    "growth": Experiment(_FILTERS, filters, summarise, draw, sizes=range(1, 21)),
    "reentry": Experiment(_FILTERS, filters, summarise, draw, sizes=()),
}
