"""Repeats the experiments of Wang et al. (2021): figures 2 to 9 and table 2, as ours.

    python scripts/reproduce.py bearings-outliers                            scenario 1, figures 2-5
    python scripts/reproduce.py bearings-manoeuvre                           scenario 2, figures 6-9
    python scripts/reproduce.py bearings-outliers --outliers std --runs 500 --json out/std.json

Every run of an experiment is fixed by the seed.  Run times are relative to the UKF on the same runs, as in table 2.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from torchfra import keep_memory, plotting
from torchfra.cli import SCENARIOS, named
from torchfra.evaluate import FILTERS, evaluate, report, run, table
from torchfra.files import write_json
from torchfra.scenarios import Scenario

PAPER = "ukf,srckf,mr_ckf,rsrckf,rmckf,fra_srckf,fra"
GATE = 5.991
FIGURES = {"bearings-outliers": (2, 3, 4, 5), "bearings-manoeuvre": (6, 7, 8, 9)}


def main(arguments: list[str] | None = None) -> int:
    """Runs an experiment; 0 if it did, 2 with one line on standard error if something handed in was wrong."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("experiment", choices=list(SCENARIOS))
    parser.add_argument("--runs", type=int, default=100, metavar="M", help="Monte-Carlo runs (default: 100)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the random numbers (default: 0)")
    parser.add_argument("--outliers", default="covariance", help="covariance (default), std, offset or none")
    parser.add_argument(
        "--truth-noise", type=float, default=0.0, help="variance of noise on the truth, m^2/s^4 (default: 0)"
    )
    parser.add_argument("--initial", choices=["paper", "truth"], help="state to start from (default: the experiment's)")
    parser.add_argument(
        "--filters", default=PAPER, metavar="A,B", help=f"out of {', '.join(FILTERS)} (default: {PAPER})"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results for machines to read")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write the figures there")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, and nothing printed but errors")
    options = parser.parse_args(arguments)
    keep_memory()
    try:
        initial = {} if options.initial is None else {"initial": options.initial}
        scenario = named(options.experiment, options.outliers, truth_noise=options.truth_noise, **initial)
        names = options.filters.split(",")
        results = evaluate(scenario, names, runs=options.runs, seed=options.seed, progress=not options.quiet)
        if options.json is not None:
            write_json(options.json, report(scenario, results, runs=options.runs, seed=options.seed))
        if options.plots is not None:
            plots(scenario, results, options.plots, options.runs, options.seed)
    except (ValueError, OSError) as error:
        print(f"reproduce: error: {error}", file=sys.stderr)
        return 2
    if not options.quiet:
        print(f"{scenario.name}: {options.runs} runs, seed {options.seed}, outliers {options.outliers}")
        print(table(results))
    return 0


def plots(scenario: Scenario, results: dict[str, dict[str, object]], folder: Path, runs: int, seed: int) -> None:
    """The four figures of an experiment: paths and innovations of its first run, and both errors over time."""
    one = scenario.simulate(1, seed)
    with torch.no_grad():
        estimates = {name: run(FILTERS[name](scenario.motion, scenario.sensor), scenario, one) for name in results}
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
    for number, kind, figure in zip(FIGURES[scenario.name], kinds, figures, strict=True):
        plotting.save(figure, folder / f"figure-{number}-{kind}.png")


if __name__ == "__main__":
    sys.exit(main())
