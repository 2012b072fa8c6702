"""Repeats the experiments of the papers: their figures, averages and run times, as ours.

    python scripts/reproduce.py bearings-outliers       Wang et al. (2021), scenario 1: figures 2-5
    python scripts/reproduce.py bearings-manoeuvre      scenario 2: figures 6-9
    python scripts/reproduce.py adsb-turns              Du & Zhang (2020): errors by coordinate, model probabilities
    python scripts/reproduce.py bearings-outliers --outliers std --runs 500 --json out/std.json

Every run of an experiment is fixed by the seed.  Run times are relative to the UKF on the same runs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from torchfra import keep_memory, plotting, presets
from torchfra.cli import SCENARIOS, named
from torchfra.evaluate import FILTERS, chosen, evaluate, learned, report, run, table
from torchfra.files import write_json
from torchfra.filters import Filter
from torchfra.kernel.build import CompileError
from torchfra.scenarios import Scenario

BEARINGS = "ukf,srckf,mr_ckf,rsrckf,rmckf,fra_srckf,fra"
PAPER = {"bearings-outliers": BEARINGS, "bearings-manoeuvre": BEARINGS, "adsb-turns": "srckf,imm3,imm5,vsimm_srckf"}
GATE = 5.991
NUMBERS = {"bearings-outliers": (2, 3, 4, 5), "bearings-manoeuvre": (6, 7, 8, 9)}
SETTLED = 18
"""Samples of adsb-turns before sample 21, which do not count in the averages: filters start with sample 3."""

Results = dict[str, dict[str, Any]]
Filters = dict[str, Filter]
Figures = dict[str, Figure]


def main(arguments: list[str] | None = None) -> int:
    """Runs an experiment; 0 if it did, 2 with one line on standard error if something handed in was wrong."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("experiment", choices=list(SCENARIOS))
    parser.add_argument("--runs", type=int, default=100, metavar="M", help="Monte-Carlo runs (default: 100)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the random numbers (default: 0)")
    parser.add_argument("--outliers", help="of bearings: covariance (default), std, offset or none")
    parser.add_argument("--truth-noise", type=float, help="of bearings: variance of noise on the truth, m^2/s^4")
    parser.add_argument("--initial", choices=["paper", "truth"], help="of bearings: state to start from")
    parser.add_argument("--turns", choices=["acceleration", "arc"], help="of adsb-turns (default: acceleration)")
    known = ", ".join(FILTERS)
    parser.add_argument(
        "--filters", metavar="A,B", help=f"out of {known}, and of adsb-turns imm3 and imm5 (default: the paper's)"
    )
    parser.add_argument("--learned", metavar="NAME=FILE", help="also the filter NAME with values that training wrote")
    parser.add_argument("--compile", action="store_true", help="run compiled kernels")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results for machines to read")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write the figures there")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, and nothing printed but errors")
    options = parser.parse_args(arguments)
    keep_memory()
    try:
        scenario = named(
            options.experiment, options.outliers, truth_noise=options.truth_noise, initial=options.initial,
            turns=options.turns,
        )  # fmt: skip
        filters = filters_of(scenario, (options.filters or PAPER[scenario.name]).split(","))
        if options.learned is not None:
            name, _, file = options.learned.partition("=")
            filters["learned"] = learned(file, scenario, name)
        results = evaluate(scenario, filters, runs=options.runs, seed=options.seed, compile=options.compile,
                           progress=not options.quiet)  # fmt: skip
        whole = report(scenario, results, runs=options.runs, seed=options.seed)
        if scenario.name == "adsb-turns":
            whole["averages"] = averages(results)
            whole["models"] = scenario.bank.names if scenario.bank is not None else []
        if options.json is not None:
            write_json(options.json, whole)
        if options.plots is not None:
            draw = adsb if scenario.name == "adsb-turns" else bearings
            for name, figure in draw(scenario, filters, results, options.runs, options.seed).items():
                plotting.save(figure, options.plots / f"{name}.png")
    except (ValueError, OSError, CompileError) as error:
        print(f"reproduce: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    if not options.quiet:
        said = ", ".join(f"{key} {value}" for key, value in scenario.settings.items())
        print(f"{scenario.name}: {options.runs} runs, seed {options.seed}, {said}")
        print(table(results) if scenario.name != "adsb-turns" else averages_table(whole["averages"], results))
    return 0


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


if __name__ == "__main__":
    sys.exit(main())
