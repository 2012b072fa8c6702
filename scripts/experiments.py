"""What each experiment of ``reproduce.py`` shows: filters by default, averages and figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from torchfra import plotting, presets
from torchfra.cli import named
from torchfra.evaluate import chosen, evaluate, run
from torchfra.filters import Filter
from torchfra.scenarios import Scenario

_BEARINGS, _HUBER = "ukf,srckf,mr_ckf,rsrckf,rmckf,fra_srckf,fra", "ghckf,hghckf1,hghckf2"
PAPER = {
    "bearings-outliers": _BEARINGS,
    "bearings-manoeuvre": _BEARINGS,
    "adsb-turns": "srckf,imm3,imm5,vsimm_srckf",
    "growth": _HUBER,
    "reentry": _HUBER,
}
GATE = 5.991
NUMBERS = {"bearings-outliers": (2, 3, 4, 5), "bearings-manoeuvre": (6, 7, 8, 9)}
SETTLED = 18
"""Samples of adsb-turns before sample 21, which do not count in the averages: filters start with sample 3."""

Results = dict[str, dict[str, Any]]
Filters = dict[str, Filter]
Figures = dict[str, Figure]


def filters_of(scenario: Scenario, names: list[str]) -> Filters:
    """The filters of these names; ``imm3`` and ``imm5`` run the first three and all five models of a bank."""
    bank = scenario.bank
    sizes = {"imm3": 3, "imm5": 5} if scenario.name == "adsb-turns" and bank is not None else {}
    own: dict[str, Callable[[], Filter]] = {
        name: lambda count=count: presets.imm_srckf(bank[:count], scenario.sensor) for name, count in sizes.items()
    }
    return {name: own[name]() if name in own else chosen([name], scenario)[name] for name in names}


def bearings(
    scenario: Scenario, filters: dict[str, Filter], results: Results, runs: int, seed: int
) -> dict[str, Figure]:
    """The four figures of an experiment: paths and innovations of its first run, and both errors over time."""
    one = scenario.simulate(1, seed)
    with torch.no_grad():
        estimates = {name: run(f, scenario, one) for name, f in filters.items()}
    paths = {name: estimate.mean[0] for name, estimate in estimates.items()}
    shown = [name for name in ("srckf", "fra_srckf", "fra") if name in estimates] or list(estimates)
    nis = {name: estimates[name].nis[0] for name in shown}
    stations = one.u if scenario.name == "bearings-outliers" else None  # the paper's figure 6 leaves them out
    title = f"{scenario.name}, {runs} runs"
    figures = (
        plotting.tracks(one.truth[0], paths, f"{scenario.name}, first run", stations),
        plotting.innovations(nis, GATE, scenario.dt, f"{scenario.name}, first run"),
        plotting.rmse_curves(results, "position", scenario.dt, title),
        plotting.rmse_curves(results, "velocity", scenario.dt, title),
    )
    kinds = ("tracks", "innovations", "position", "velocity")
    numbers = NUMBERS[scenario.name]
    return {f"figure-{n}-{kind}": figure for n, kind, figure in zip(numbers, kinds, figures, strict=True)}


def adsb(scenario: Scenario, filters: Filters, results: Results, runs: int, seed: int) -> Figures:
    """Paths of the first run; signed error, RMSE and relative error over time; probabilities of the models."""
    one = scenario.simulate(1, seed)
    with torch.no_grad():
        paths = {name: run(f, scenario, one).mean[0] for name, f in filters.items()}
    title, start = f"{scenario.name}, {runs} runs", 3 * scenario.dt
    figures = {"tracks": plotting.tracks(one.truth[0], paths, f"{scenario.name}, first run")}
    for quantity in ("mean_error", "rmse", "mape"):
        figures[quantity] = plotting.by_coordinate(results, quantity, start, scenario.dt, title)
    of = {name: result["probabilities"] for name, result in results.items() if "probabilities" in result}
    if of and scenario.bank is not None:
        figures["probabilities"] = plotting.probabilities(of, scenario.bank.names, start, scenario.dt, title)
    return {f"adsb-{name}": figure for name, figure in figures.items()}


def averages(results: Results) -> dict[str, dict[str, float]]:
    """Over time, from sample 21 on: mean error (signed, and its size), RMSE and relative error by coordinate."""
    found: dict[str, dict[str, float]] = {}
    for name, of in results.items():
        over_time = {f"{q}_{axis}": np.array(of[f"{q}_{axis}"][SETTLED:]) for axis in "xy"
                     for q in ("mean_error", "rmse", "mape")}  # fmt: skip
        largest = {f"largest_{key}": float(np.abs(v).max()) for key, v in over_time.items() if "mean_error" in key}
        found[name] = {key: float(values.mean()) for key, values in over_time.items()} | largest
    return found


def averages_table(of: dict[str, dict[str, float]], results: Results) -> str:
    """As text."""
    titles = {"mean error": "mean_error", "largest": "largest_mean_error", "RMSE m": "rmse", "MAPE %": "mape"}
    lines = ["averages over time from sample 21 on, x / y"]
    lines.append(f"{'filter':<12}" + "".join(f"{title:>16}" for title in titles) + f"{'time / UKF':>12}")
    for name, values in of.items():
        cells = [f"{values[f'{q}_x']:.2f} / {values[f'{q}_y']:.2f}" for q in titles.values()]
        time = results[name]["relative_time"]
        lines.append(f"{name:<12}" + "".join(f"{cell:>16}" for cell in cells) + f"{time:>12.2f}")
    return "\n".join(lines)


def by_size(
    name: str, sizes: Sequence[float], names: Sequence[str], options: dict[str, Any], **how: Any
) -> dict[str, Results]:
    """Mean square errors of every filter for each size of the contamination.

    Returns:
        By size and filter: ``mse`` of the position over time, its mean ``mmse``, and the means of the other quantities,
        ``mmse_velocity`` say.
    """
    found: dict[str, Results] = {}
    for size in sizes:
        scenario = named(name, **options, size=float(size))
        results = evaluate(scenario, filters_of(scenario, list(names)), **how)
        found[f"{size:g}"] = {f: _squares(of, scenario) for f, of in results.items()}
    return found


def _squares(of: dict[str, Any], scenario: Scenario) -> dict[str, Any]:
    mse = np.square(of["rmse_position"])
    others = {f"mmse_{q}": float(np.square(of[f"rmse_{q}"]).mean()) for q in scenario.quantities if q != "position"}
    return {"mmse": float(mse.mean()), "mse": mse.tolist(), **others}


def contaminated(
    scenario: Scenario, filters: Filters, results: Results, sizes: dict[str, Results], title: str
) -> Figures:
    """Errors over time, and over the size of the contamination."""
    figures = {
        f"{scenario.name}-{q}": plotting.rmse_curves(results, q, scenario.dt, title)
        for q in scenario.quantities
        if scenario.motion.size > 1 or q == "position"
    }
    if sizes:
        curves = {f: [of[f]["mmse"] for of in sizes.values()] for f in filters}
        x = [float(size) for size in sizes]
        axes = "times the noise grows", "mean square error of the position"
        figures[f"{scenario.name}-mmse"] = plotting.against(x, curves, *axes, title)
    return figures


def rms_table(results: Results, scenario: Scenario) -> str:
    """Root mean square errors over time and runs, as text."""
    names = [q for q in scenario.quantities if scenario.motion.size > 1 or q == "position"]
    lines = [f"{'filter':<12}" + "".join(f"{q:>14}" for q in names) + f"{'time / UKF':>12}"]
    for name, of in results.items():
        cells = [np.square(of[f"rmse_{q}"]).mean() ** 0.5 for q in names]
        lines.append(f"{name:<12}" + "".join(f"{cell:>14.4g}" for cell in cells) + f"{of['relative_time']:>12.2f}")
    return "\n".join(lines)


def sizes_table(sizes: dict[str, Results]) -> str:
    """Mean square errors of the position, as text."""
    names = list(next(iter(sizes.values())))
    lines = [f"{'grows':<8}" + "".join(f"{name:>12}" for name in names)]
    lines += [f"{size:<8}" + "".join(f"{of[name]['mmse']:>12.4g}" for name in names) for size, of in sizes.items()]
    return "\n".join(lines)
