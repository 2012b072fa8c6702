"""What a run learned: values before and after, and position errors on unseen tracks."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from torchfra.app.evaluate import evaluate, versions
from torchfra.tables import text_table
from train.filters import make_filter, natural_values, set_temperature
from train.training import Training


def report(training: Training, start: dict[str, float], *, quiet: bool = True) -> dict[str, Any]:
    """What results.json holds.

    Args:
        training: at its end; its filter gets the best values.
        start: the values before the first iteration.
        quiet: whether to show no progress bar.
    """
    training.filter.load_state_dict(training.best["filter"])
    set_temperature(training.filter, 0.0)
    values = {"start": start, "learned": training.learned_values()}
    if training.teacher is not None:
        values["known"] = {path: v for path, v in natural_values(training.teacher).items() if path in start}
    return {
        "config": dataclasses.asdict(training.config),
        "iterations": training.iteration,
        "best": training.best["iteration"],
        "left_out": sum(int(row["left out"]) for row in training.rows),
        "seconds": sum(row["seconds"] for row in training.rows),
        "values": values,
        "tasks": _errors(training, quiet) if training.config.test_runs else [],
        "versions": versions(),
    }


def _errors(training: Training, quiet: bool) -> list[dict[str, Any]]:
    """For each task the errors on unseen tracks before and after, decided hard."""
    config, tasks = training.config, []
    filters = {
        "before": make_filter(config, training.scenarios[0], config.start, learn=False).to("cpu"),
        "after": training.filter.to("cpu"),
    }
    for task, scenario in zip(config.tasks, training.held_out, strict=True):
        results = evaluate(scenario, filters, runs=config.test_runs, seed=config.test_seed, progress=not quiet)
        errors: dict[str, Any] = {"scenario": task.scenario, **task.options}
        for name, result in results.items():
            keys = [key for key in ("rmse_position", "rmse_x", "rmse_y", "rmse_z") if key in result]
            means = {key: np.nanmean(result[key][config.skip :]).item() for key in keys}
            errors[name] = means | {"divergence_rate": result["divergence_rate"]}
        tasks.append(errors)
    return tasks


def report_text(result: dict[str, Any]) -> str:
    """The report as tables."""
    values = result["values"]
    rows = [[path, *(f"{column[path]:.5g}" for column in values.values())] for path in values["start"]]
    text = text_table(["", *values], rows) + "\n"
    rows = []
    for task in result["tasks"]:
        before, after = task["before"], task["after"]
        diverged = f"{before['divergence_rate']:.2%} -> {after['divergence_rate']:.2%}"
        rows.append([task["scenario"], f"{before['rmse_position']:.1f}", f"{after['rmse_position']:.1f}", diverged])
    if rows:
        text += text_table(("position RMSE, m", "before", "after", "diverged"), rows) + "\n"
    return text + (
        f"best after {result['best']} of {result['iterations']} iterations, {result['seconds']:.0f} s, "
        f"{result['left_out']} tracks left out"
    )
