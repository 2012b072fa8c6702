"""What learning the threshold and the weakening of FRA gains, and whether its decisions should be soft meanwhile.

    python scripts/learning.py --json out/learning.json
    python scripts/learning.py --learn threshold,weakening,gate
    python scripts/learning.py --starts 0.3:30 --ways hard,1-0.1 --restarts 8

Cells are scenario 1 (a bad prior) and scenario 2 of Wang et al. (2021), each with outliers of ten times the covariance
or the standard deviation.  A way is ``hard``, a temperature, or two between which it falls geometrically.  A training
is Adam on new tracks in each iteration, with the robust loss; the filter that is judged decides hard.  Training i
learns from tracks of seed S + i and is judged on others, of seed S + i + 10000; an error is the mean over time of the
RMSE of the position, a gain is the change of the error on the same tracks, with a 95 % interval over the trainings.
Beside them are the best point of a grid (chosen on tracks of seed S + 20000, judged as the trainings are) and
``torchfra.fit`` from each start, alone or with others around it.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from collections.abc import Sequence
from typing import Any

import torch
from lists import check_list, numbers_in

from torchfra import fit, losses, metrics, presets, scenarios
from torchfra.cli.command import add_output_options, check_files, check_least, exit_status, make_parser
from torchfra.filters import Filter
from torchfra.fitting import sweep
from torchfra.fitting.descent import falling
from torchfra.hyper import natural_values
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.scenarios import Scenario, Tracks
from torchfra.tables import text_table
from torchfra.types import Gaussian

CELLS = {
    f"{number}-{outliers}": (make, outliers)
    for number, make in ((1, scenarios.bearings_outliers), (2, scenarios.bearings_manoeuvre))
    for outliers in ("covariance", "std")
}
WAYS = "hard,1,1-0.1,10-0.1"
THRESHOLDS = (0.1, 0.2, 0.35, 0.6, 1.0, 1.345, 2.0, 3.0, 5.0, 8.0, 13.0)
WEAKENINGS = (1.01, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 8.0, 13.0, 20.0, 40.0, 100.0)
JUDGES, CHOICE = 10_000, 20_000
"""Added to the seed for tracks that judge, and for those that choose the best point of the grid."""
SCALE = 100.0
"""Error above which a track counts less, m."""
BATCH, RATE, CLIP = 32, 0.1, 1.0
"""Tracks of an iteration, the first learning rate, and the largest norm of a gradient."""
_NEAR = 0.01
"""How much larger than the least loss of the grid one may be that is as good as it."""
STUDENT = {1: 12.71, 2: 4.30, 3: 3.18, 4: 2.78, 5: 2.57, 6: 2.45, 7: 2.36, 8: 2.31, 9: 2.26}
"""95 % point of Student's t, by degrees of freedom."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command."""
    p = make_parser(__doc__)
    p.add_argument("--cells", default=",".join(CELLS), metavar="A,B", help=f"some of {','.join(CELLS)} (all)")
    p.add_argument("--ways", default=WAYS, metavar="A,B", help=f"to decide while learning (default: {WAYS})")
    p.add_argument("--learn", default="threshold,weakening", metavar="A,B", help="(default: threshold,weakening)")
    p.add_argument("--starts", default="1.345:2", metavar="A,B", help="THRESHOLD:WEAKENING (default: 1.345:2)")
    p.add_argument("--trainings", type=int, default=10, metavar="N", help="of each way, 2 to 10 (default: 10)")
    p.add_argument("--iterations", type=int, default=100, metavar="K", help="of a training (default: 100)")
    p.add_argument("--runs", type=int, default=500, metavar="M", help="that judge a training (default: 500)")
    p.add_argument("--seed", type=int, default=0, metavar="S", help="of the first training (default: 0)")
    p.add_argument("--restarts", type=int, default=1, metavar="R", help="starts of fit (default: 1)")
    p.add_argument("--no-grid", action="store_true", help="neither the grid nor fit")
    p.add_argument("--no-compile", action="store_true", help="interpret filters, which takes a hundred times as long")
    add_output_options(p)
    options = p.parse_args(arguments)
    check_list(p, "cells", options.cells, list(CELLS))
    return exit_status("learning", lambda: study(options))


def study(options: argparse.Namespace) -> None:
    """All cells, each printed as soon as it is known.

    Raises:
        ValueError: an option out of its range.
    """
    check_files({"json": options.json})
    check_least(options, trainings=2, iterations=1, runs=1, restarts=1)
    if options.trainings > len(STUDENT) + 1:
        raise ValueError(f"trainings: expected at most {len(STUDENT) + 1}, received {options.trainings}")
    ways = {name: temperatures(name) for name in options.ways.split(",")}
    starts = {start: values(start) for start in options.starts.split(",")}
    known = {name: CELLS[name][0](CELLS[name][1]) for name in options.cells.split(",")}
    for start in starts.values():
        made(next(iter(known.values())), start, options.learn.split(","), options)  # what is out of range is said now
    settings = {key: value for key, value in vars(options).items() if key not in ("json", "quiet")}
    cells: dict[str, Any] = {}
    for name, scenario in known.items():
        cells[name] = of_cell(scenario, ways, starts, options)
        if not options.quiet:
            print(f"{name}\n{table(cells[name])}", flush=True)
        write_results(options.json, {**settings, "cells": cells})  # after each, as all of them take long


def values(start: str) -> list[float]:
    """Threshold and weakening of a start.

    Raises:
        ValueError: they are not two numbers.
    """
    found = numbers_in("starts", start.replace(":", ","))
    if len(found) != 2:
        raise ValueError(f"starts: expected THRESHOLD:WEAKENING, received {start!r}")
    return found


def temperatures(way: str) -> tuple[float, float]:
    """The first and the last temperature of a way.

    Raises:
        ValueError: it is neither ``hard`` nor one or two numbers.
    """
    if way == "hard":
        return 0.0, 0.0
    found = numbers_in("ways", way.replace("-", ","))
    if len(found) > 2:
        raise ValueError(f"ways: expected hard, a temperature or two, received {way!r}")
    return found[0], found[-1]


def of_cell(
    scenario: Scenario,
    ways: dict[str, tuple[float, float]],
    starts: dict[str, list[float]],
    options: argparse.Namespace,
) -> dict[str, Any]:
    """Errors of a scenario: with the defaults, of each way from each start, of the grid and of the fits."""
    names, seeds = tuple(options.learn.split(",")), range(options.seed, options.seed + options.trainings)
    judges = [scenario.simulate(options.runs, JUDGES + seed) for seed in seeds]
    default = made(scenario, (1.345, 2.0), names, options)
    before = [error(default, scenario, tracks) for tracks in judges]
    found: dict[str, Any] = {"before": before, "trainings": {}}
    jobs = [(start, way, i) for start in starts for way in ways for i in range(options.trainings)]
    # Tracks of a training do not depend on the way, so that ways are compared on the same ones.
    lessons = [scenario.simulate(BATCH * options.iterations, seed) for seed in seeds]
    for start, way, i in progress_bar(jobs, "training", not options.quiet):
        f = made(scenario, starts[start], names, options)
        learn(f, scenario, lessons[i], ways[way], options.iterations)
        row = found["trainings"].setdefault(f"{way}, from {start}", {"after": [], "values": []})
        row["after"].append(error(f, scenario, judges[i]))
        row["values"].append([natural_values(f)[key] for key in learned(f, names)])
    if not options.no_grid:
        found["grid"] = of_grid(default, scenario, judges, options)
        found["fits"] = of_fits(scenario, starts, judges, options)
    return found


def made(scenario: Scenario, start: Sequence[float], names: Sequence[str], options: argparse.Namespace) -> Filter:
    """The filter that learns."""
    f = presets.fra(scenario.motion, scenario.sensor, threshold=start[0], weakening=start[1], learn=names)
    return f if options.no_compile else f.compile()


def learned(f: Filter, names: Sequence[str]) -> list[str]:
    """Paths of the learned values, in the order of their names."""
    return [path for name in names for path in natural_values(f) if path.rpartition(".")[2] == name]


def learn(f: Any, scenario: Scenario, lessons: Tracks, way: tuple[float, float], iterations: int) -> None:
    """A training; the filter decides hard afterwards."""
    hot, cold = way
    optimiser = torch.optim.Adam(f.parameters(), lr=RATE)
    for i in range(iterations):
        progress, part = i / iterations, slice(i * BATCH, (i + 1) * BATCH)
        f.temperature = hot and hot * (cold / hot) ** progress
        for group in optimiser.param_groups:
            group["lr"] = falling(RATE, progress)
        prior = Gaussian(lessons.prior.mean[part], lessons.prior.scale_tril)
        mean = f(lessons.z[part], prior, u=lessons.u).mean
        loss = losses.robust_mse(mean, lessons.truth[part], scenario.position, SCALE).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(f.parameters(), CLIP)
        optimiser.step()
    f.temperature = 0.0


def error(f: Filter, scenario: Scenario, tracks: Tracks) -> float:
    """Mean over time of the RMSE of the position, m."""
    with torch.no_grad():
        estimate = f(tracks.z, tracks.prior, u=tracks.u)
    return metrics.rmse(estimate.mean, tracks.truth, scenario.position).mean().item()


def of_grid(f: Filter, scenario: Scenario, judges: list[Tracks], options: argparse.Namespace) -> dict[str, Any]:
    """The best point of the grid, judged, and the losses of all points."""
    values = {"threshold": THRESHOLDS, "weakening": WEAKENINGS}
    grid = sweep(f, scenario, values, loss="robust", scale=SCALE, seed=CHOICE + options.seed,
                 compile=not options.no_compile)  # fmt: skip
    at_best = made(scenario, tuple(grid.best.values()), tuple(values), options)
    near = [
        point for point, loss in zip(grid.points, grid.losses, strict=True) if loss <= (1 + _NEAR) * min(grid.losses)
    ]
    return {
        "after": [error(at_best, scenario, tracks) for tracks in judges],
        "values": [list(grid.best.values())],
        "points": grid.points,
        "losses": grid.losses,
        "near": near,
    }


def of_fits(
    scenario: Scenario, starts: dict[str, list[float]], judges: list[Tracks], options: argparse.Namespace
) -> dict[str, Any]:
    """Results of ``fit`` from each start, judged, and what it prints."""
    found = {}
    for start, values in starts.items():
        for restarts in sorted({1, options.restarts}):
            learn = tuple(options.learn.split(","))
            fitted = fit(made(scenario, values, learn, options), scenario, learn=learn, loss="robust", scale=SCALE,
                         restarts=restarts, seed=CHOICE + options.seed, compile=not options.no_compile)  # fmt: skip
            name = f"fit, from {start}" if restarts == 1 else f"fit, from {restarts} around {start}"
            found[name] = {
                "after": [error(fitted.filter, scenario, tracks) for tracks in judges],
                "values": [[natural_values(fitted.filter)[path] for path in learned(fitted.filter, learn)]],
                "text": str(fitted),
            }
    return found


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and half the width of its 95 % interval."""
    half = STUDENT[len(values) - 1] * statistics.stdev(values) / math.sqrt(len(values))
    return statistics.mean(values), half


def table(cell: dict[str, Any]) -> str:
    """Errors before and after, gains and values."""
    before = cell["before"]
    rows = [["defaults", f"{statistics.mean(before):.1f}", "", ""]]
    named = {**cell["trainings"], **({"grid": cell["grid"]} if "grid" in cell else {}), **cell.get("fits", {})}
    for name, of in named.items():
        mean, half = interval([100 * (a / b - 1) for a, b in zip(of["after"], before, strict=True)])
        middle = ", ".join(f"{statistics.median(x):.3g}" for x in zip(*of["values"], strict=True))
        if "near" in of:  # how flat the loss is
            ends = [f"{min(x):g} to {max(x):g}" for x in zip(*of["near"], strict=True)]
            middle += f" (within {_NEAR:.0%}: {', '.join(ends)})"
        rows.append([name, f"{statistics.mean(of['after']):.1f}", f"{mean:+.1f} +- {half:.1f}", middle])
    return text_table(["", "error m", "gain %", "values"], rows)


if __name__ == "__main__":
    sys.exit(main())
