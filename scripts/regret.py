"""How far filters and learned values are from the best other filter of each case.

    python scripts/regret.py --filters fra --json out/regret.json --figure out/regret.png
    python scripts/regret.py --filters fra --cells '1-*-std,2-std' out/train/fra_bearings/state_dict.pt
    python scripts/regret.py --filters fra,imm_srckf --cells 'flights-*' --flights a.json.gz b.json.gz
    python scripts/regret.py --smooth --cells '2-*' --runs 100
    python scripts/regret.py --filters gpb --cells 'stated-*-none' --runs 100
    python scripts/regret.py --open 84 --filters gpb --runs 40 --seed 71

Cells: scenario 1 of the bearings experiments with the paper's prior and with a good one, and scenario 2; recorded
flights by bearings, position and radar; each with outliers none, covariance, std and bursts; simulated ranges with
outliers; tracks drawn from the models that are stated to filters, with and without outliers, or with process or
measurement noise that is stated several times off (stated-*); and recorded ranges, where folders of them are given.

Regret is the mean position RMSE divided by that of the best filter of the catalogue that is not compared, at its
defaults, a bank of motions among them, minus 1.  There are two tables: of filtered estimates, and of lagged ones,
where every filter that waits for a measurement before it decides has its later estimate, and the others the only one
they have.  The 95 % interval is of a bootstrap over the runs, which are the same for all filters; a run is lost above
2000 m, of ranges above 20 m.

With --open so many cells are drawn at random (regrets.open_cells): motion, sensor, time steps, outliers, jumps and
what is stated wrongly.  One table has them sorted by the ratio of filtered errors, those that are lost first, in
standard deviations of a measured position, with the NEES of positions per dimension; a line below it says the ratio in
the median, in nine of ten, in 95 of 100 and at worst.  Others are, unless named, srckf, rsrckf, mr_ckf, hghckf, iaukf,
fra and imm_srckf, of two levels of process noise where a cell has one motion.

With --smooth no filter is compared with another: one table has the errors of each as it filters, 1 and 5 steps later,
and smoothed, the change from the first to the last, and the NEES of positions per dimension, which is 1 where
covariances are consistent; --plot draws one run of the last cell by the last filter, with bands.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from regrets import opened, smoothed
from regrets.cells import Cell, all_cells, chosen_cells
from regrets.ratios import KINDS, RESAMPLES, both_kinds, errors, not_finite, panels, summary, summary_lines, table
from regrets.tuning import specialists

from torchfra.catalogue import FILTERS, filters_for, learned_filter, scenario_filters, track_filters
from torchfra.cli.command import Failures, add_output_options, add_runs_options, check_files, exit_status, make_parser
from torchfra.cli.compare_command import WORTHWHILE
from torchfra.cli.compiling import add_compile_option, choose, reporters
from torchfra.evaluation import run
from torchfra.evaluation.compiling import compiled
from torchfra.filters import Filter
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.scenarios import Scenario

USUAL_STEPS = 100
"""Of a run, to tell before any is made whether compiling pays."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the tables; returns its exit status: see ``torchfra.cli.command.exit_status``."""

    def run() -> None:
        options = parser().parse_args(arguments)
        (gains if options.smooth else regret if options.open is None else in_the_open)(options)

    return exit_status("regret", run)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = make_parser(__doc__)
    first, usual = track_filters()[0], ",".join(smoothed.FILTERS)
    learned = "learned values of the filter NAME, or of the first of --filters, are compared too"
    p.add_argument("learned", metavar="[NAME=]STATE_DICT", nargs="*", help=learned)
    compared = f"compared with all others (default: {first}), or smoothed (default: {usual})"
    p.add_argument("--filters", metavar="A,B", help=compared)
    p.add_argument("--smooth", action="store_true", help="what smoothing gains")
    p.add_argument("--open", metavar="CELLS", type=int, help="so many random cells instead, drawn by the seed")
    p.add_argument("--cells", metavar="A,B", default="*", help="names, or patterns such as '1-*-std' (default: all)")
    p.add_argument("--flights", metavar="FILE", nargs="+", type=Path, help="recorded flights (default: samples)")
    p.add_argument("--others", metavar="A,B", help="of all other filters, those that compete (default: all)")
    ranges = "with recorded ranges and the path that was taken: a cell for each recording there or below"
    p.add_argument("--ranges", metavar="FOLDER", nargs="+", type=Path, default=[], help=ranges)
    tuned = "copies of these compete too, with process noise and threshold searched in each cell, on 64 other runs"
    p.add_argument("--tuned", metavar="A,B", default="", help=tuned)
    p.add_argument("--own-models", action="store_true", help="learned values leave motion and sensor of a cell alone")
    add_runs_options(p, 500, seed=3)
    add_compile_option(p, f"in cells of {WORTHWHILE:,} steps or more")
    p.add_argument("--plot", type=Path, metavar="FILE", help="with --smooth, PNG: errors of one run, with bands")
    p.add_argument("--figure", type=Path, metavar="FILE", help="PNG: cells by filters, coloured by the ratio")
    add_output_options(p)
    return p


def regret(options: argparse.Namespace) -> None:
    """All cells; tables when the last one is done."""
    if options.plot is not None:
        raise ValueError("plot: expected --smooth beside it")
    names = compared_filters(track_filters()[0] if options.filters is None else options.filters)
    tuned = compared_filters(options.tuned, "tuned") if options.tuned else []
    others = None if options.others is None else compared_filters(options.others, "others")
    learned = {file.rpartition("=")[2]: file.rpartition("=")[0] or names[0] for file in options.learned}
    inputs = [*learned, *(options.flights or []), *options.ranges]
    check_files({"json": options.json, "figure": options.figure}, inputs)
    cells = chosen_cells(all_cells(options.flights, options.ranges), options.cells.split(","))
    tell, _ = reporters(options.compile, options.quiet)
    compile = choose(options.compile, options.runs * USUAL_STEPS >= WORTHWHILE, tell)
    filters_of = partial(cell_filters, names=names, learned=learned, others=others, own_models=options.own_models)
    results, made = {}, prepared(cells, filters_of, options)
    for name, (scenario, runs, filters) in progress_bar(made.items(), "cell", not options.quiet):
        if compile and (options.compile or runs * scenario.steps >= WORTHWHILE):
            filters = with_kernels(filters, scenario, options)
        to_tune = {name: filters[name] for name in tuned if name in filters}
        special, factors = specialists(to_tune, scenario, options.seed)
        filters |= special
        found = errors(scenario, filters, runs=runs, seed=options.seed, progress=not options.quiet)
        settings = {"dt": scenario.mean_dt, "steps": scenario.steps, "limit": scenario.limit, **scenario.settings}
        results[name] = {"scenario": scenario.name, "runs": runs, "settings": settings, "tuned": factors}
        results[name] |= both_kinds(found, {*names, *learned}, scenario.limit)
    write(results, names, learned, options)


def gains(options: argparse.Namespace) -> None:
    """What smoothing gains in all cells, and a table of it when the last one is done.

    Raises:
        ValueError: arguments that go with comparisons alone.
    """
    if options.learned or options.tuned or options.figure is not None:
        raise ValueError("smooth: expected no learned values, --tuned or --figure beside it")
    names = None if options.filters is None else compared_filters(options.filters)
    check_files({"json": options.json, "plot": options.plot}, [*(options.flights or []), *options.ranges])
    cells = chosen_cells(all_cells(options.flights, options.ranges), options.cells.split(","))
    results: dict[str, dict[str, Any]] = {}
    made = prepared(cells, partial(smoothed_filters, names=names), options)
    for name, (scenario, runs, filters) in progress_bar(made.items(), "cell", not options.quiet):
        found = smoothed.errors(scenario, filters, runs=runs, seed=options.seed, progress=not options.quiet)
        results[name] = {"scenario": scenario.name, "runs": runs, "smoothing": smoothed.results(found)}
    failures = Failures()
    if not options.quiet:
        print(smoothed.table(results), flush=True)
    head = {"runs": options.runs, "seed": options.seed, "resamples": RESAMPLES}
    with failures.of("json"):
        write_results(options.json, {**head, "cells": results})
    if options.plot is not None:
        from regrets.figures import bands  # matplotlib takes long to import

        from torchfra import plotting

        last = list(filters)[-1]
        runs = smoothed.one_run(filters[last], scenario, options.seed)
        with failures.of("plot"):
            plotting.save(bands(runs, scenario.mean_dt, "error, m", f"{last}, {name}"), options.plot)
    failures.end()


def prepared(
    cells: Mapping[str, Cell], filters_of: Callable[[str, Scenario], dict[str, Filter]], options: argparse.Namespace
) -> dict[str, tuple[Scenario, int, dict[str, Filter]]]:
    """Scenario, number of runs and filters of each cell: all of them before the first run, which may take hours."""
    made = {}
    for name, cell in progress_bar(cells.items(), "prepared", not options.quiet):
        scenario = cell.make()
        made[name] = scenario, options.runs if cell.runs is None else cell.runs, filters_of(name, scenario)
    return made


def in_the_open(options: argparse.Namespace) -> None:
    """Random cells, and a table of them when the last one is done; the file has those that are done.

    Raises:
        ValueError: arguments that go with other cells alone.
    """
    if options.open < 1:
        raise ValueError(f"open: expected 1 cell or more, received {options.open}")
    given = {"tuned": options.tuned, "learned": options.learned, "figure": options.figure, "plot": options.plot,
             "flights": options.flights, "ranges": options.ranges}  # fmt: skip
    if any(given.values()):
        received = ", ".join(name for name, value in given.items() if value)
        raise ValueError(f"open: expected no options for other cells beside it, received {received}")
    names = compared_filters(track_filters()[0] if options.filters is None else options.filters)
    others = compared_filters(",".join(opened.OTHERS) if options.others is None else options.others, "others")
    if not set(others).difference(names):
        raise ValueError(f"others: expected some beside those compared, received {', '.join(others)}")
    check_files({"json": options.json}, [])
    cells = chosen_cells(opened.open_cells(options.open, options.seed), options.cells.split(","))
    tell, _ = reporters(options.compile, options.quiet)
    compile = choose(options.compile, options.runs * USUAL_STEPS >= WORTHWHILE, tell)
    results: dict[str, Any] = {}
    head = {"runs": options.runs, "seed": options.seed, "resamples": RESAMPLES, "compared": names}
    failures = Failures()
    for name, cell in progress_bar(cells.items(), "cell", not options.quiet):
        scenario = cell.make()
        filters = opened.open_filters(scenario, names, others)
        filters = with_kernels(filters, scenario, options) if compile else filters
        found = opened.results(scenario, filters, names, runs=options.runs, seed=options.seed)
        settings = {"steps": scenario.steps, "limit": scenario.limit, **scenario.settings}
        results[name] = {"runs": options.runs, "settings": settings, **found}
        of = opened.summary(results, names)
        if not failures.messages:  # cell by cell, as all of them may take hours
            with failures.of("json"):
                write_results(options.json, {**head, "summary": of, "cells": results})
    if not options.quiet:
        print(f"{opened.table(results, names)}\n{opened.summary_lines(of, len(results))}", flush=True)
    failures.end()


def compared_filters(listed: str, argument: str = "filters") -> list[str]:
    """The names in a comma-separated list.

    Raises:
        ValueError: one that is no filter of single targets, or none at all.
    """
    names = [name for name in listed.split(",") if name]
    if not names or not all(name in FILTERS and not FILTERS[name].scans for name in names):
        raise ValueError(f"{argument}: expected some of {', '.join(track_filters())}, received {listed!r}")
    return names


def cell_filters(
    cell: str, scenario: Scenario, names: list[str], learned: Mapping[str, str], others: list[str] | None = None,
    *, own_models: bool,
) -> dict[str, Filter]:  # fmt: skip
    """All filters of a cell: those that are compared, by name or file, and those of ``others`` that go with it.

    Raises:
        ValueError: a filter that does not go with it, or values that do not fit.
    """
    known = filters_for(scenario)
    check_names(cell, names, known)
    competing = [name for name in known if others is None or name in others]
    if not set(competing).difference(names):
        raise ValueError(f"others: expected some that go with {cell} beside those compared, received {others}")
    filters = scenario_filters(list(dict.fromkeys([*competing, *names])), scenario)
    for path, name in learned.items():
        filters[path] = learned_filter(path, scenario, name, models=not own_models)
    return filters


def smoothed_filters(cell: str, scenario: Scenario, names: list[str] | None) -> dict[str, Filter]:
    """The filters of a cell that are smoothed: these, or the usual ones that go with it.

    Raises:
        ValueError: a filter that does not go with it.
        NotImplementedError: a filter that is not smoothed.
    """
    known = filters_for(scenario)
    names = [name for name in smoothed.FILTERS if name in known] if names is None else names
    check_names(cell, names, known)
    filters = scenario_filters(names, scenario)
    for f in filters.values():
        f.limits.check_smooths()
    return filters


def check_names(cell: str, names: list[str], known: list[str]) -> None:
    """Checks that filters go with a cell.

    Raises:
        ValueError: one does not.
    """
    for name in names:
        if FILTERS[name].listed and name not in known:
            raise ValueError(f"filters: expected some that go with {cell}, received {name}")


def with_kernels(filters: dict[str, Filter], scenario: Scenario, options: argparse.Namespace) -> dict[str, Filter]:
    """The filters, compiled where that can be."""
    _, fallback = reporters(options.compile, options.quiet)
    one = scenario.simulate(1, options.seed)
    return compiled(filters, lambda f: run(f, scenario, one), fallback=fallback, progress=not options.quiet)


def write(
    results: dict[str, dict[str, Any]], names: list[str], learned: Mapping[str, str], options: argparse.Namespace
) -> None:
    """Prints both tables, and writes files."""
    compared = [*names, *learned]
    of, failures = summary(results, compared), Failures()
    if not options.quiet:
        for kind in KINDS:
            print(f"{table(results, compared, kind)}\n{summary_lines(of, kind)}\n", flush=True)
    head = {"runs": options.runs, "seed": options.seed, "resamples": RESAMPLES}
    head |= {"compared": compared, "learned": learned, "own_models": options.own_models}
    with failures.of("json"):
        write_results(options.json, {**head, "summary": of, "cells": results})
    if options.figure is not None:
        from regrets.figures import ratios  # matplotlib takes long to import

        from torchfra import plotting

        title = f"{options.runs} runs, seed {options.seed}"
        with failures.of("figure"):
            plotting.save(ratios(panels(results, compared), list(results), title), options.figure)
    failures.messages += not_finite(results)
    failures.end()


if __name__ == "__main__":
    sys.exit(main())
