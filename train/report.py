"""The report of a run: values before and after, and position errors on test tracks."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import torch

from torchfra.evaluation import evaluate
from torchfra.filters import Filter
from torchfra.fitting.descent import Descent
from torchfra.hyper import natural_values
from torchfra.running.progress import progress_bar
from torchfra.running.versions import versions
from torchfra.tables import text_table
from train.batches import simulate
from train.gpb.regret import Regrets
from train.training import Training, make_filter, set_temperature


def report(training: Training, descent: Descent, start: dict[str, float], *, quiet: bool = True) -> dict[str, Any]:
    """The contents of results.json.

    Args:
        training: whose filter is set to the best values.
        descent: after its last iteration.
        start: the values before the first iteration.
        quiet: whether to show no progress bar.
    """
    training.filter.load_state_dict(descent.best)
    set_temperature(training.filter, 0.0)
    values = {"start": start, "learned": training.natural()}
    if training.teacher is not None:
        values["known"] = {path: v for path, v in natural_values(training.teacher).items() if path in start}
    result = {
        "config": dataclasses.asdict(training.config),
        "iterations": descent.iteration,
        "best": descent.improved,
        "left_out": sum(int(row["left out"]) for row in descent.rows),
        "seconds": sum(row["seconds"] for row in descent.rows),
        "values": values,
        "tasks": [],
        "versions": versions(),
    }
    if isinstance(training, Regrets):
        result["preset"] = training.preset()
    if training.config.test_runs:
        result["tasks"] = _regrets(training, quiet) if isinstance(training, Regrets) else _errors(training, quiet)
    return result


def _errors(training: Training, quiet: bool) -> list[dict[str, Any]]:
    """For each task the errors on test tracks before and after, with hard decisions."""
    config, tasks = training.config, []
    filters = {
        "before": make_filter(config, training.scenarios[0], config.start, learn=False).to("cpu"),
        "after": cast(Filter, training.filter).to("cpu"),
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


@torch.no_grad()
def _regrets(training: Regrets, quiet: bool) -> list[dict[str, Any]]:
    """For each task the best rival on test tracks, and errors before and after, filtered and lagged."""
    config, tasks = training.config, []
    learned = copy.deepcopy(training.filter.state_dict())
    for i in progress_bar(range(len(config.tasks)), "test", not quiet):
        task = config.tasks[i]
        runs = task.runs or config.test_runs
        name, best = training.best_rival(i, held_out=True, runs=runs, seed=config.test_seed)
        batch = simulate([training.held_out[i]], first=0, runs=runs, seed=config.test_seed)
        errors: dict[str, Any] = {"scenario": task.scenario, **task.options, "models": task.models,
                                  "weight": task.weight, "rival": {"filter": name, "rmse_position": best}}  # fmt: skip
        for when, state in (("before", training.start), ("after", learned)):
            training.filter.load_state_dict(state)
            both = training.errors([i], batch)
            rmses = zip(("filtered", "lagged"), both.squeeze(-1).tolist(), strict=True)
            errors[when] = {kind: {"rmse_position": rmse, "regret": rmse / best - 1} for kind, rmse in rmses}
        tasks.append(errors)
    return tasks


def not_finite(result: dict[str, Any]) -> list[str]:
    """A message for each task whose errors with the learned values are not finite."""
    return [
        f"task {number}, {task['scenario']}: the errors after learning are not finite"
        for number, task in enumerate(result["tasks"], 1)
        if not all(map(math.isfinite, _numbers(task["after"])))
    ]


def _numbers(values: dict[str, Any]) -> Iterator[float]:
    """All numbers in nested dictionaries."""
    for value in values.values():
        yield from _numbers(value) if isinstance(value, dict) else (value,)


def report_text(result: dict[str, Any]) -> str:
    """The report as tables."""
    values = result["values"]
    rows = [[path, *(f"{column[path]:.5g}" for column in values.values())] for path in values["start"]]
    text = text_table(["", *values], rows) + "\n"
    rows = []
    for task in [] if "preset" in result else result["tasks"]:
        before, after = task["before"], task["after"]
        diverged = f"{before['divergence_rate']:.2%} -> {after['divergence_rate']:.2%}"
        rows.append([task["scenario"], f"{before['rmse_position']:.1f}", f"{after['rmse_position']:.1f}", diverged])
    if rows:
        text += text_table(("position RMSE, m", "before", "after", "diverged"), rows) + "\n"
    if "preset" in result:
        text += _regrets_text(result)
    return text + (
        f"best after {result['best']} of {result['iterations']} iterations, {result['seconds']:.0f} s, "
        f"{result['left_out']} tracks left out"
    )


def _regrets_text(result: dict[str, Any]) -> str:
    """Regrets of all tasks, and the values as arguments of the preset."""
    rows = []
    for task in result["tasks"]:
        known = {"scenario", "models", "weight", "rival", "before", "after"}
        options = ", ".join(f"{value}" for key, value in task.items() if key not in known)
        regrets = [f"{task[when][kind]['regret']:+.1%}" for when in ("before", "after") for kind in task["after"]]
        rival = [task["rival"]["filter"], f"{task['rival']['rmse_position']:.4g}"]
        rows.append([task["scenario"], options, task["models"], f"{task['weight']:g}", *rival, *regrets])
    head = ("task", "options", "models", "weight", "best rival", "RMSE m", "before", "lagged", "after", "lagged")
    text = text_table(head, rows, align="<<<><>") + "\n" if rows else ""
    text += "".join(f"{name} = {_short(value)}\n" for name, value in result["preset"].items())
    return text


def _short(value: Any) -> str:
    """Numbers, also in lists, with four digits."""
    return f"({', '.join(map(_short, value))})" if isinstance(value, list) else f"{value:.4g}"
