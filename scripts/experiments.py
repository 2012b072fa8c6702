"""What each experiment of ``reproduce.py`` shows: filters by default, averages and figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from scans import scan_filters

from torchfra import presets
from torchfra.app import plotting
from torchfra.app.evaluate import evaluate, run
from torchfra.catalogue import make_scenario, scenario_filters
from torchfra.filters import Filter
from torchfra.filters.alphabeta import AlphaBeta, AlphaBetaBank, gains
from torchfra.scenarios import Scenario

_BEARINGS, _HUBER = "ukf,srckf,mr_ckf,rsrckf,rmckf,fra_srckf,fra", "ghckf,hghckf1,hghckf2"
PAPER = {
    "bearings-outliers": _BEARINGS,
    "bearings-manoeuvre": _BEARINGS,
    "adsb-turns": "srckf,imm3,imm5,vsimm_srckf",
    "alpha-beta": "f1,f2,f3,paper,alphabeta",
    "clutter-straight": "ukf_jpda_paper,iaukf_jpda_paper,ukf_jpda_safe,iaukf_jpda_safe",
    "clutter-crossing": "ukf_jpda_paper,iaukf_jpda_paper,ukf_jpda_safe,iaukf_jpda_safe",
    "noise-change": "ukf,iaukf",
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
    if scenario.name == "alpha-beta":
        return weave_filters(scenario, names)
    if scenario.clutter is not None:
        return scan_filters(scenario, names)
    bank = scenario.bank
    sizes = {"imm3": 3, "imm5": 5} if scenario.name == "adsb-turns" and bank is not None else {}
    own: dict[str, Callable[[], Filter]] = {
        name: lambda count=count: presets.imm_srckf(bank[:count], scenario.sensor) for name, count in sizes.items()
    }
    return {name: own[name]() if name in own else scenario_filters([name], scenario)[name] for name in names}


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
    name: str, sizes: Sequence[float], filters: Filters, options: dict[str, Any], **how: Any
) -> dict[str, Results]:
    """Mean square errors of every filter for each size of the contamination.

    Returns:
        By size and filter: ``mse`` of the position over time, its mean ``mmse``, and the means of the other quantities,
        ``mmse_velocity`` say.
    """
    found: dict[str, Results] = {}
    for size in sizes:
        scenario = make_scenario(name, **options, size=float(size))
        results = evaluate(scenario, filters, **how)  # whose models are those of every size
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


def weave_filters(scenario: Scenario, names: Sequence[str]) -> Filters:
    """The filters of these names; ``f1``, ``f2`` and ``f3`` are the paper's single ones, ``paper`` its bank."""
    motion, sensor = scenario.motion, scenario.sensor
    found: Filters = {}
    for name in names:
        if name in ("f1", "f2", "f3"):
            found[name] = AlphaBeta(motion, sensor, gains.kalata((1.5, 0.5, 0.1)[int(name[1]) - 1]))
        elif name == "paper":
            thresholds = {"manoeuvre": 3.5, "outlier": 10.0, "degrees": [6 / 7], "margin": 3.6}
            found[name] = presets.alphabeta(motion, sensor, gains=gains.levels(), **thresholds)
        else:
            found |= scenario_filters([name], scenario)
    return found


def weave_figures(scenario: Scenario, filters: Filters, results: Results, runs: int, seed: int) -> Figures:
    """Errors by coordinate over time, and how often each level is in use along x."""
    title = f"{scenario.name}, {runs} runs"
    figures = {
        f"alpha-beta-{q}": plotting.by_coordinate(results, q, 1.0, scenario.dt, title) for q in ("mean_error", "rmse")
    }
    tracks, shares = scenario.simulate(min(runs, 1000), seed), {}
    for name, f in filters.items():
        if isinstance(f, AlphaBetaBank):
            with torch.no_grad():
                level = run(f, scenario, tracks).info.level[..., 0].round().long()
            shares[name] = torch.nn.functional.one_hot(level, len(_LEVELS)).double().mean(0)
    if shares:
        figures["alpha-beta-levels"] = plotting.probabilities(shares, _LEVELS, 1.0, scenario.dt, title)
    return figures


_LEVELS = ("level 1, fastest", "level 2", "level 3, slowest")


def weave_decisions(scenario: Scenario, filters: Filters, runs: int, seed: int) -> dict[str, dict[str, Any]]:
    """RMSE along each axis in 20-73 s and 74-120 s, and what the banks decided along x at 97 to 104 s."""
    tracks, found = scenario.simulate(runs, seed), {}
    for name, f in filters.items():
        with torch.no_grad():
            e = run(f, scenario, tracks)
        square = (e.mean[..., :3] - tracks.truth[..., :3]).square()
        of: dict[str, Any] = {}
        for part, steps in (("level", slice(19, 73)), ("manoeuvre", slice(73, 120))):
            each = square[:, steps].mean(1).sqrt()
            of |= {f"{part}_{axis}": each[:, i].mean().item() for i, axis in enumerate("xyz")}
        if hasattr(e.info, "rejected"):
            for key in ("manoeuvre", "rejected"):
                at = getattr(e.info, key)[..., 0].double().mean(0)
                of[key] = {str(k): at[k - 1].item() for k in range(97, 105)}
            of["restarts_per_run"] = e.info.restarted[..., 0].double().sum(1).mean().item()
        found[name] = of
    return found


def weave_table(of: dict[str, dict[str, Any]]) -> str:
    """As text."""
    lines = [f"{'filter':<12}{'level x, m':>12}{'manoeuvre x':>13}{'restarts':>10}   rejected at 97 ... 104 s, %"]
    for name, values in of.items():
        line = f"{name:<12}{values['level_x']:>12.1f}{values['manoeuvre_x']:>13.1f}"
        if "rejected" in values:
            rejected = " ".join(f"{100 * v:.0f}" for v in values["rejected"].values())
            line += f"{values['restarts_per_run']:>10.3f}   {rejected}"
        lines.append(line)
    return "\n".join(lines)
