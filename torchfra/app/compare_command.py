"""``torchfra compare``: runs many tracks through several filters."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchfra.app import distributed
from torchfra.app.atomic_write import write_json
from torchfra.app.command import add_json_option, add_quiet_option
from torchfra.app.compiling import add_compile_option, choose, reporters
from torchfra.app.evaluate import Result, evaluate, recordings_table, report, table
from torchfra.app.sources import RANGES, add_source_options, scenario_of
from torchfra.app.track_command import FILES
from torchfra.catalogue import filters_for, learned_filter, scan_filters, scenario_filters, track_filters
from torchfra.filters import Filter
from torchfra.scenarios import Scenario

_EXAMPLES = """examples:
  torchfra compare flights/*.json.gz --sensor radar --json radar.json
  torchfra compare --scenario bearings-outliers --runs 500 --filters srckf,rmckf,fra
  torchfra compare --ranges walks --json walks.json
  torchfra compare --ranges a1.csv a2.csv a3.csv a4.csv --anchors anchors.csv --reference path.csv --dt 0.2
  torchfra compare --scenario bearings-outliers --runs 1000000 --filters srckf
  torchrun --nproc-per-node 2 -m torchfra compare --scenario bearings-outliers --runs 10000"""

WORTHWHILE = 100_000
"""Steps of all runs together from which compiling takes no longer than it saves."""


def add_to(commands: Any) -> None:
    """Adds the command to a parser's subparsers."""
    command = commands.add_parser(
        "compare",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        help="run a batch of tracks through several filters",
        description="Run many tracks through several filters: one table and one figure.  The tracks are recorded ones\n"
        "seen by a simulated sensor (FILE), those of a scenario, or recorded together with ranges from anchors.\n\n"
        f"{FILES}\n\n{RANGES}",
        epilog=_EXAMPLES,
    )
    add = command.add_argument
    add_source_options(add)
    names = f"{', '.join(track_filters())}, of clutter-* {', '.join(scan_filters())}"
    add("--filters", metavar="A,B", help=f"out of {names} (default: all)")
    learned = "also the filter NAME (default: fra) with values that training wrote, as 'learned'"
    add("--learned", metavar="[NAME=]FILE", help=learned)
    add(
        "--runs",
        type=int,
        metavar="M",
        help="tracks (default: 100; of files each window once, of ranges each recording)",
    )
    add("--seed", type=int, default=0, metavar="S", help="seed of the random numbers (default: 0)")
    add_compile_option(command, f"for {WORTHWHILE:,} steps or more of all tracks together")
    add("--figure", type=Path, metavar="FILE", help="PNG (default: compare-SCENARIO.png)")
    add_json_option(command)
    add_quiet_option(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command; under ``torchrun`` in every process, of which the first writes."""
    scenario, runs = scenario_of(options)
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
        print(_text(options, scenario, runs, results))
        print(f"figure: {path}")


def _text(options: argparse.Namespace, scenario: Scenario, runs: int, results: dict[str, Result]) -> str:
    """What was tracked, and the table of the results."""
    if scenario.recordings:
        head = f"{scenario.name}: {runs} of {len(scenario.recordings)} recordings, up to {scenario.steps} steps"
        return f"{head}\n{recordings_table(results, scenario)}"
    settings = ", ".join(f"{key} {value}" for key, value in scenario.settings.items() if isinstance(value, str))
    head = f"{scenario.name}: {runs} runs of {scenario.steps} steps, seed {options.seed}, {settings}"
    return f"{head}\n{table(results)}"
