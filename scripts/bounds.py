"""How far every filter is from the Cramer-Rao bound of every scenario.

    python scripts/bounds.py --runs 200 --seed 11 --json out/bounds.json
    python scripts/bounds.py --scenarios reentry,noise-change --filters srckf,gpb --runs 500
    python scripts/bounds.py --cells '2-*,flights-*' --filters srckf,gpb

A line for each scenario: the bound on the position RMSE, mean over time, what it takes as known, and for each filter by
how much its error is above; at the end whether any is below, and how far single steps are, in standard errors of the
mean square over the runs.  The bound is that of the true process, which no filter knows: where a target's manoeuvres
are not random it is that of who knows them, and where measurements have outliers it has their information.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial

import torch
from regrets.cells import all_cells, chosen_cells

import torchfra
from torchfra.app.atomic_write import write_json
from torchfra.app.command import (
    add_json_option,
    add_quiet_option,
    add_runs_options,
    check_files,
    check_list,
    exit_status,
    make_parser,
)
from torchfra.app.evaluate import versions
from torchfra.app.progress import progress_bar
from torchfra.catalogue import FILTERS, SCENARIOS, filters_for, make_scenario
from torchfra.scenarios import Scenario
from torchfra.tables import formed_table, significant


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns its exit status: see ``torchfra.app.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("--scenarios", metavar="A,B", default=",".join(SCENARIOS), help="(default: all)")
    p.add_argument(
        "--cells", metavar="A,B", help="instead, cells of scripts/regret.py by names, or patterns such as '2-*'"
    )
    p.add_argument("--filters", metavar="A,B", help="those of them that go with a scenario (default: all)")
    add_runs_options(p, 200, seed=11)
    add_json_option(p)
    add_quiet_option(p)

    def run() -> None:
        options = p.parse_args(arguments)
        check_list(p, "scenarios", options.scenarios, SCENARIOS)
        if options.filters is not None:
            check_list(p, "filters", options.filters, FILTERS)
        bounds(options)

    return exit_status("bounds", run)


def bounds(options: argparse.Namespace) -> None:
    """All scenarios, and the table when the last one is done."""
    check_files({"json": options.json})
    found = {}
    makers: dict[str, Callable[[], Scenario]]
    if options.cells is None:
        makers = {name: partial(make_scenario, name) for name in options.scenarios.split(",")}
    else:
        makers = {name: cell.make for name, cell in chosen_cells(all_cells(), options.cells.split(",")).items()}
    for name, make in progress_bar(makers.items(), "scenario", not options.quiet):
        scenario = make()
        known = filters_for(scenario)
        names = known if options.filters is None else [f for f in options.filters.split(",") if f in known]
        if names:
            found[name] = cell(scenario, names, options)
    if not options.quiet:
        print(table(found))
        print(summary(found), flush=True)
    if options.json is not None:
        write_json(
            options.json, {"runs": options.runs, "seed": options.seed, "versions": versions(), "scenarios": found}
        )


def cell(scenario: Scenario, names: list[str], options: argparse.Namespace) -> dict[str, object]:
    """The bound of a scenario, and of each filter the error, the ratio to it and the lowest step."""
    comparison = torchfra.compare(names, scenario, runs=options.runs, seed=options.seed)
    assert comparison.bound is not None
    least = comparison.bound.rmse(scenario.truth_position)
    filters = {}
    for name, of in comparison.results.items():
        error = of["mean_rmse_position"]
        ratio = torch.tensor(of["rmse_position"]) / least
        # the standard error of the root of a mean square over runs and dimensions, of errors that are normal
        sure = 1 / (2 * comparison.metrics[name].counts["position"] * scenario.motion.dims).sqrt()
        low = ((ratio - 1) / sure).nan_to_num(nan=torch.inf).min()
        filters[name] = {"rmse": error, "ratio": error / float(least.nanmean()), "lowest_step": float(low)}
    return {"bound": float(least.nanmean()), "kind": comparison.bound.kind, "known": comparison.bound.known,
            "filters": filters}  # fmt: skip


def table(found: dict[str, dict]) -> str:
    """Filters by scenarios: by what factor the error is above the bound."""
    header = ["times the bound", *found]
    rows = [["bound, m", *(significant(of["bound"]) for of in found.values())]]
    rows.append(["of", *(of["kind"] for of in found.values())])
    for name in dict.fromkeys(name for of in found.values() for name in of["filters"]):
        ratios = [of["filters"].get(name, {}).get("ratio") for of in found.values()]
        rows.append([f"`{name}`", *("" if x is None else significant(x) for x in ratios)])
    known = "; ".join(f"{name}: {', '.join(of['known']) or 'nothing'}" for name, of in found.items())
    return formed_table("markdown", header, rows, f"Taken as known: {known}.")


def summary(found: dict[str, dict]) -> str:
    """The cell that is nearest to its bound, and the lowest step."""
    cells = [(f["ratio"], f["lowest_step"], f"{f_name} in {s}") for s, of in found.items()
             for f_name, f in of["filters"].items()]  # fmt: skip
    ratio, _, nearest = min(cells)
    low, lowest = min((low, where) for _, low, where in cells)
    below = sum(one < 1 for one, _, _ in cells)
    return (f"{len(cells)} cells, {below} below the bound; nearest: {nearest}, {ratio:.3f} times; lowest single step: "
            f"{lowest}, {low:+.1f} standard errors")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
