"""``torchfra compare``: runs many tracks through several filters."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchfra import readers, scenarios
from torchfra.app import distributed
from torchfra.app.atomic_write import write_json
from torchfra.app.command import add_json_option, add_quiet_option
from torchfra.app.compiling import add_compile_option, choose, reporters
from torchfra.app.evaluate import Result, evaluate, report, table
from torchfra.app.track_command import FILES
from torchfra.catalogue import (
    SCENARIOS,
    filters_for,
    learned_filter,
    make_scenario,
    scan_filters,
    scenario_filters,
    track_filters,
)
from torchfra.filters import Filter
from torchfra.scenarios import Scenario

_EXAMPLES = """examples:
  torchfra compare flights/*.json.gz --sensor radar --json radar.json
  torchfra compare --scenario bearings-outliers --runs 500 --filters srckf,rmckf,fra
  torchfra compare --scenario bearings-outliers --runs 1000000 --filters srckf
  torchrun --nproc-per-node 2 -m torchfra compare --scenario bearings-outliers --runs 10000"""

_FILE_OPTIONS = ("sensor", "q", "dt", "steps", "repair")
"""Options that a scenario of a paper does not take."""
WORTHWHILE = 100_000
"""Steps of all runs together from which compiling takes no longer than it saves."""


def add_to(commands: Any) -> None:
    """Adds the command to a parser's subparsers."""
    command = commands.add_parser(
        "compare",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        help="run a batch of tracks through several filters",
        description="Run many tracks through several filters: one table and one figure.  The tracks are recorded ones\n"
        f"seen by a simulated sensor (FILES), or those of a paper's scenario.\n\n{FILES}",
        epilog=_EXAMPLES,
    )
    add = command.add_argument
    add("files", metavar="FILE", type=Path, nargs="*")
    add("--scenario", metavar="NAME", help=f"instead of files, one of {', '.join(SCENARIOS)}")
    names = f"{', '.join(track_filters())}, of clutter-* {', '.join(scan_filters())}"
    add("--filters", metavar="A,B", help=f"out of {names} (default: all)")
    learned = "also the filter NAME (default: fra) with values that training wrote, as 'learned'"
    add("--learned", metavar="[NAME=]FILE", help=learned)
    add("--runs", type=int, metavar="M", help="tracks (default: 100; of files, each window once)")
    add("--seed", type=int, default=0, metavar="S", help="seed of the random numbers (default: 0)")
    outliers = "covariance (default), std, bursts (files and bearings-*), offset (bearings-*) or none"
    add("--outliers", metavar="MODE", help=outliers)
    _add_file_options(add)
    add_compile_option(command, f"for {WORTHWHILE:,} steps or more of all tracks together")
    add("--figure", type=Path, metavar="FILE", help="PNG (default: compare-SCENARIO.png)")
    add_json_option(command)
    add_quiet_option(command)
    command.set_defaults(run=run)


def _add_file_options(add: Any) -> None:
    """Those of ``_FILE_OPTIONS``; their defaults are those of ``scenarios.recorded``."""
    q = "for files: variance of the change of acceleration that filters assume per step, m^2/s^4 (default: 0.25)"
    add("--sensor", help="for files: bearings (default), radar or position")
    add("--q", type=float, help=q)
    add("--dt", type=float, metavar="S", help="for files: seconds per step (default: 5)")
    add("--steps", type=int, metavar="T", help="for files: steps per window (default: 120)")
    repair = "for files: mend time stamps that are off by seconds, so that the tracks can be flown (default: --repair)"
    add("--repair", action=argparse.BooleanOptionalAction, help=repair)


def run(options: argparse.Namespace) -> None:
    """Runs the command; under ``torchrun`` in every process, of which the first writes."""
    scenario, runs = _scenario(options)
    filters = _filters(options, scenario)
    first = distributed.rank() == 0
    quiet = options.quiet or not first
    tell, fallback = reporters(options.compile, quiet)
    results = evaluate(
        scenario,
        filters,
        runs=runs,
        seed=options.seed,
        compile=choose(options.compile, runs * scenario.steps >= WORTHWHILE, tell),
        fallback=fallback,
        progress=not quiet,
    )
    if first:
        _write(options, scenario, runs, results)


def _scenario(options: argparse.Namespace) -> tuple[Scenario, int]:
    """What is tracked, and how many runs of it."""
    if bool(options.files) == (options.scenario is not None):
        received = "both" if options.files else "neither"
        raise ValueError(f"compare: expected either files or --scenario, received {received}")
    chosen = {name: getattr(options, name) for name in _FILE_OPTIONS if getattr(options, name) is not None}
    if options.scenario is not None:
        for name in chosen:
            raise ValueError(f"{name}: goes with files, not with --scenario")
        return make_scenario(options.scenario, outliers=options.outliers), 100 if options.runs is None else options.runs
    recordings = [recording for file in options.files for recording in readers.read(file)]
    scenario = scenarios.recorded(recordings, outliers=options.outliers or "covariance", **chosen)
    windows = int(str(scenario.settings["windows"]))
    return scenario, windows if options.runs is None else options.runs


def _filters(options: argparse.Namespace, scenario: Scenario) -> Sequence[str] | dict[str, Filter]:
    names = filters_for(scenario) if options.filters is None else [name for name in options.filters.split(",") if name]
    if options.learned is None:
        return names
    name, equals, file = options.learned.rpartition("=")
    learned = learned_filter(file, scenario, name if equals else "fra")
    return scenario_filters(names, scenario) | {"learned": learned}


def _write(options: argparse.Namespace, scenario: Scenario, runs: int, results: dict[str, Result]) -> None:
    from torchfra.app import plotting  # matplotlib takes long to import

    path = options.figure or Path(f"compare-{scenario.name}.png")
    plotting.save(plotting.rmse_curves(results, "position", scenario.dt, f"{scenario.name}, {runs} runs"), path)
    if options.json is not None:
        write_json(options.json, report(scenario, results, runs=runs, seed=options.seed))
    if not options.quiet:
        settings = ", ".join(f"{key} {value}" for key, value in scenario.settings.items() if isinstance(value, str))
        print(f"{scenario.name}: {runs} runs of {scenario.steps} steps, seed {options.seed}, {settings}")
        print(table(results))
        print(f"figure: {path}")
