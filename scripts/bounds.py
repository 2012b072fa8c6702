"""How far every filter is from the Cramer-Rao bound of every cell: scenarios, and cells of scripts/regret.py.

    python scripts/bounds.py --runs 200 --seed 11 --jobs 2 --json out/bounds.json
    python scripts/bounds.py --cells reentry,noise-change --filters srckf,gpb --runs 500
    python scripts/bounds.py --cells '2-*,flights-*' --filters srckf,gpb

A line for each cell: the bound on the position RMSE, mean over time, what it takes as known, and for each filter by
how much its error is above; at the end whether any is below, and how far single steps are, in standard errors of the
mean square over the runs.  The bound is that of the true process, which no filter knows: where a target's manoeuvres
are not random it is that of who knows them, and where measurements have outliers it has their information.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from typing import Any

import torch
from lists import check_list
from regrets.cells import Cell, all_cells, chosen_cells

import torchfra
from torchfra.catalogue import FILTERS, SCENARIOS, filters_for, make_scenario
from torchfra.cli import command
from torchfra.running.jobs import add_jobs_option, finished
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.tables import formed_table, significant

Found = dict[str, Any]


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    p = command.make_parser(__doc__)
    p.add_argument("--cells", metavar="A,B", default="*", help="names, or patterns such as '2-*' (default: all)")
    p.add_argument("--filters", metavar="A,B", help="those of them that go with a cell (default: all)")
    add_jobs_option(p)
    command.add_runs_options(p, 200, seed=11)
    command.add_output_options(p)

    def run() -> None:
        options = p.parse_args(arguments)
        if options.filters is not None:
            check_list(p, "filters", options.filters, FILTERS)
        bounds(options)

    return command.exit_status("bounds", run)


def known_cells() -> dict[str, Cell]:
    """All of them: scenarios of the catalogue at their defaults, and the cells of scripts/regret.py."""
    return {name: Cell(partial(make_scenario, name)) for name in SCENARIOS} | all_cells()


def bounds(options: argparse.Namespace) -> None:
    """All cells, and the table when the last one is done.

    Raises:
        ValueError: a name that no cell has, no filter that fits any, or fewer than 1 job.
    """
    command.check_least(options, jobs=1)
    command.check_files({"json": options.json})
    names = list(chosen_cells(known_cells(), options.cells.split(",")))
    listed = None if options.filters is None else options.filters.split(",")
    parts = [(name, listed, options.runs, options.seed) for name in names]
    done = progress_bar(finished(of_cell, parts, options.jobs), "cell", not options.quiet)
    every = {names[number]: of for number, of in done}
    found = {name: of for name in names if (of := every[name]) is not None}
    if not found:
        expected = f"a cell that has a bound, and filters that go with it, among {options.cells}"
        raise ValueError(f"cells, filters: expected {expected}, received {options.filters or 'all filters'}")
    if not options.quiet:
        print(table(found))
        print(summary(found), flush=True)
    write_results(options.json, {"runs": options.runs, "seed": options.seed, "cells": found})


def of_cell(cell: str, listed: list[str] | None, runs: int, seed: int) -> Found | None:
    """The bound of a cell, and of each filter the error, the ratio to it and the lowest step; None without either.

    Banks and missing measurements have no bound: see ``Scenario.law``.
    """
    scenario = known_cells()[cell].make()
    if scenario.law is None:
        return None
    known = filters_for(scenario)
    names = known if listed is None else [name for name in listed if name in known]
    if not names:
        return None
    comparison = torchfra.compare(names, scenario, runs=runs, seed=seed)
    assert comparison.bound is not None
    least = comparison.bound.rmse(scenario.truth_position)
    filters = {}
    for name, of in comparison.results.items():
        error = of["mean_rmse_position"]
        ratio = torch.tensor(of["rmse_position"]) / least
        # the standard error of the root of a mean square over runs and dimensions, of errors that are normal
        sure = 1 / (2 * comparison.metrics[name].sums["count_position"] * scenario.motion.dims).sqrt()
        low = ((ratio - 1) / sure).nan_to_num(nan=torch.inf).min()
        filters[name] = {"rmse": error, "ratio": error / float(least.nanmean()), "lowest_step": float(low)}
    return {"bound": float(least.nanmean()), "kind": comparison.bound.kind, "known": comparison.bound.known,
            "filters": filters}  # fmt: skip


def table(found: dict[str, Found]) -> str:
    """Cells by filters: by what factor the error is above the bound."""
    names = list(dict.fromkeys(name for of in found.values() for name in of["filters"]))
    header = ["times the bound", "bound, m", "", *(f"`{name}`" for name in names)]
    rows = []
    for cell, of in found.items():
        ratios = [of["filters"].get(name, {}).get("ratio") for name in names]
        rows.append(
            [cell, significant(of["bound"]), of["kind"], *("" if x is None else significant(x) for x in ratios)]
        )
    kinds: dict[str, list[str]] = {}
    for cell, of in found.items():
        kinds.setdefault(", ".join(of["known"]) or "nothing", []).append(cell)
    known = "; ".join(f"{what}: {', '.join(cells)}" for what, cells in kinds.items())
    return formed_table("markdown", header, rows, f"Taken as known: {known}.")


def summary(found: dict[str, Found]) -> str:
    """The cell that is nearest to its bound, and the lowest step."""
    cells = [(f["ratio"], f["lowest_step"], f"{f_name} in {cell}") for cell, of in found.items()
             for f_name, f in of["filters"].items()]  # fmt: skip
    ratio, _, nearest = min(cells)
    low, lowest = min((low, where) for _, low, where in cells)
    below = sum(one < 1 for one, _, _ in cells)
    return (f"{len(cells)} errors in {len(found)} cells, {below} below the bound; nearest: {nearest}, {ratio:.3f} "
            f"times; lowest single step: {lowest}, {low:+.1f} standard errors")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
