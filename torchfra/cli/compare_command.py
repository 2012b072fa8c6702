"""``torchfra compare``: runs many tracks through several filters."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from torchfra.catalogue import filters_for, learned_filter, scan_filters, track_filters
from torchfra.cli.command import Failures, add_output_options, check_files
from torchfra.cli.compiling import add_compile_option, choose, reporters
from torchfra.cli.loading import load_filters, load_module
from torchfra.cli.sources import RANGES, add_source_options, scenario_of
from torchfra.cli.track_command import FILES
from torchfra.evaluation import (
    check_limit,
    headline,
    leaders,
    mapped_run,
    measure,
    not_finite,
    recordings_table,
    report,
    results_of,
    table,
)
from torchfra.evaluation.comparison import FORMS, Comparison, bound_of, table_form
from torchfra.filters import Filter
from torchfra.pictures import picture_format
from torchfra.running import distributed
from torchfra.running.atomic_write import write_json
from torchfra.scenarios import Scenario
from torchfra.tables import printable

_EXAMPLES = """examples:
  torchfra compare flights/*.json.gz --sensor radar --json radar.json
  torchfra compare --scenario bearings-outliers --runs 500 --filters srckf,rmckf,fra
  torchfra compare --ranges walks --json walks.json
  torchfra compare --ranges a1.csv a2.csv a3.csv a4.csv --anchors anchors.csv --reference path.csv --dt 0.2
  torchfra compare --scenario bearings-outliers --runs 200 --table errors.tex --print errors.pdf
  torchfra compare --scenario mine.py:figure_eight --filters gpb,mine.py:my_filter
  torchfra compare --scenario bearings-outliers --runs 1000000 --filters srckf
  torchrun --nproc-per-node 2 -m torchfra compare --scenario bearings-outliers --runs 10000"""

MOST_SHOWN, MOST_ON_MAP = 5, 3
"""Largest numbers of filters whose errors are drawn over time, and whose estimates are on the map."""
WORTHWHILE = 100_000
"""Steps of all runs together from which compiling saves time."""


def add_to(command: argparse.ArgumentParser) -> None:
    """Adds the description, the options and the function of the command to its parser."""
    command.description = (
        "Run many tracks through several filters: one table, and one figure with a run on a map, the\n"
        "errors of all runs, and errors over time.  The tracks are recorded ones seen by a simulated sensor (FILE),\n"
        "those of a scenario, or recorded together with ranges from anchors.\n\n"
        f"{FILES}\n\n{RANGES}"
    )
    command.epilog = _EXAMPLES
    add = command.add_argument
    add_source_options(command)
    names = f"{', '.join(track_filters())}, for clutter-* {', '.join(scan_filters())}"
    add("--filters", metavar="A,B", help=f"some of {names} (default: all), or module:function, file.py:function")
    own = "run this module or file first: filters and scenarios that it registers then have names here"
    add("--import", dest="modules", metavar="MODULE", action="append", default=[], help=own)
    learned = "also the filter NAME (default: fra) with values that training wrote, as 'learned'"
    add("--learned", metavar="[NAME=]FILE", help=learned)
    add(
        "--runs",
        type=int,
        metavar="M",
        help="number of tracks (default: 100; for files each window, for recordings and your own tracks each once)",
    )
    add("--seed", type=int, default=0, metavar="S", help="seed of the random numbers (default: 0)")
    add_compile_option(command, f"for {WORTHWHILE:,} steps or more of all tracks together")
    add("--all", action="store_true", help="a line for each filter, also for those with the same errors")
    scale = (
        "position error above which a run has diverged, m (default: the scenario's, or ten times the error of a single "
        "measurement)"
    )
    add("--limit", type=float, metavar="M", help=scale)
    add("--figure", type=Path, metavar="FILE", help="PNG, PDF or SVG (default: compare-SCENARIO.png)")
    add("--table", type=Path, metavar="FILE", help=f"table of intervals, tests and the bound: {', '.join(FORMS)}")
    add(
        "--print",
        dest="printed",
        type=Path,
        metavar="FILE",
        help="figure of errors and the bound, one column wide: PDF, SVG or PNG",
    )
    add_output_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command; under ``torchrun`` in every process, of which the first writes."""
    inputs = _inputs(options)
    check_limit(options.limit)
    check_files(_outputs(options), inputs)
    for module in options.modules:
        load_module(module, "import")
    scenario, runs = scenario_of(options)
    options.figure = options.figure or Path(f"compare-{scenario.name}.png")
    check_files(_outputs(options), inputs)
    filters = _filters(options, scenario)
    first = distributed.rank() == 0
    quiet = options.quiet or not first
    tell, fallback = reporters(options.compile, quiet)
    compile = choose(options.compile, runs * scenario.steps >= WORTHWHILE, tell)
    metrics = measure(
        scenario, filters, runs=runs, seed=options.seed, compile=compile, fallback=fallback, progress=not quiet
    )
    if first:
        results = results_of(metrics, filters, scenario, runs, options.limit)
        least = bound_of(scenario, runs, options.seed) if _for_paper(options) else None
        _write(options, Comparison(scenario, runs, options.seed, results, metrics, least), filters)


def _filters(options: argparse.Namespace, scenario: Scenario) -> dict[str, Filter]:
    """The filters to compare, by name."""
    names = filters_for(scenario) if options.filters is None else [name for name in options.filters.split(",") if name]
    made = load_filters(names, scenario)
    if options.learned is None:
        return made
    name, equals, file = options.learned.rpartition("=")
    return made | {"learned": learned_filter(file, scenario, name if equals else "fra")}


def _outputs(options: argparse.Namespace) -> dict[str, Path | None]:
    """The files that are written, by option."""
    if options.table is not None:
        table_form(options.table)
    for option, path in (("figure", options.figure), ("print", options.printed)):
        if path is not None:
            picture_format(path, option)
    return {"json": options.json, "figure": options.figure, "table": options.table, "print": options.printed}


def _inputs(options: argparse.Namespace) -> list[str | Path]:
    """The files that are read."""
    learned = options.learned and options.learned.rpartition("=")[2]
    paths = [*options.files, *(options.ranges or []), options.anchors, options.reference, learned]
    return [path for path in paths if path is not None]


def _write(options: argparse.Namespace, comparison: Comparison, filters: Mapping[str, Filter]) -> None:
    """Prints the results, and writes the requested files."""
    scenario, results, failures = comparison.scenario, comparison.results, Failures()
    title = _title(scenario, comparison.runs, options.seed)
    if not options.quiet:
        numbers = recordings_table(results, scenario) if scenario.recordings else table(results, every=options.all)
        print(f"{title}\n{headline(results, comparison.runs)}\n{numbers}", flush=True)  # before a file can fail
        if _for_paper(options):
            print(f"\n{_TWO_TABLES}\n\n{comparison}", flush=True)
    if options.json is not None:
        with failures.of("json"):
            write_json(options.json, report(scenario, results, runs=comparison.runs, seed=options.seed))
    if options.table is not None:
        with failures.of("table"):
            comparison.save(options.table)
    if options.printed is not None:
        with failures.of("print"):
            comparison.plot(options.printed)
    with failures.of("figure"):
        _draw(options, comparison, filters, leaders(results, MOST_SHOWN), title)
    failures.messages += not_finite(results)
    failures.end()


_TWO_TABLES = (
    "above, RMSE is over all runs at each step, then the mean over time; below, run RMSE is over the time of each run, "
    "then the mean over runs"
)


def _for_paper(options: argparse.Namespace) -> bool:
    """Whether the user wants intervals, tests and the bound."""
    return options.table is not None or options.printed is not None


def _draw(
    options: argparse.Namespace, comparison: Comparison, filters: Mapping[str, Filter], shown: Sequence[str], title: str
) -> None:
    from torchfra import plotting  # matplotlib takes long to import

    scenario, results = comparison.scenario, comparison.results
    on_map = {name: filters[name] for name in shown[:MOST_ON_MAP]}
    errors = [comparison.metrics[name].errors() for name in shown[:2]]
    limit = next(iter(results.values()))["limit"]
    mapped = mapped_run(scenario, on_map, errors, options.seed)
    plotting.save(plotting.comparison(results, shown, scenario.mean_dt, limit, title, mapped), options.figure)
    if not options.quiet:
        print(f"figure: {printable(str(options.figure))}")


def _title(scenario: Scenario, runs: int, seed: int) -> str:
    """The scenario, with its numbers of runs and steps."""
    if scenario.recordings:
        return f"{scenario.name}: {runs} of {len(scenario.recordings)} recordings, up to {scenario.steps} steps"
    settings = ", ".join(f"{key} {value}" for key, value in scenario.settings.items() if isinstance(value, str))
    return f"{scenario.name}: {runs} runs of {scenario.steps} steps, seed {seed}, {settings}"
