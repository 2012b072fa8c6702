"""All filters on both scenarios of Wang et al. (2021): a table of errors, whose lines go into documents as they are.

    python scripts/bearings.py --runs 500 --seed 42 --compile --json out/bearings.json
    python scripts/bearings.py --runs 500 --seed 42 --filters ukf,srckf,fra --one-by-one

A column for each scenario, prior and reading of "10 sigma": ten times the covariance, or ten times the standard
deviation.  Mean over time of the RMSE of the position, m; in brackets the share of the runs that diverged (more than
2000 m over time).  ``--one-by-one`` prints times relative to ``ukf`` instead, of all runs at once and of single ones.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from typing import Any

from papers import bearings

from torchfra.catalogue import make_scenario
from torchfra.cli.command import add_output_options, add_runs_options, check_files, exit_status, make_parser
from torchfra.evaluation import evaluate
from torchfra.running.versions import write_results

COLUMNS = {
    f"{number}{prior}, {reading}": (name, {"outliers": reading, "initial": initial})
    for number, prior, name, initial in (
        (1, ", bad prior", "bearings-outliers", "paper"),
        (1, ", good prior", "bearings-outliers", "truth"),
        (2, "", "bearings-manoeuvre", "truth"),
    )
    for reading in ("covariance", "std")
}
FILTERS = ("gpb", "gpb_one_motion", "ukf", "srckf", "mr_ckf", "rsrckf", "asrckf", "rmckf", "fra_srckf",
           "fra_srckf_literal", "fra", "imm_srckf", "imm_rsrckf", "imm_fra")  # fmt: skip
TIMED, SINGLE = ("1, bad prior, covariance", "2, covariance"), 3
"""Columns of which times are measured, and how many runs of them one by one."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command."""
    p = make_parser(__doc__)
    add_runs_options(p, 100)
    p.add_argument("--filters", metavar="A,B", default=",".join(FILTERS), help=f"(default: {','.join(FILTERS)})")
    p.add_argument("--compile", action="store_true", help="run compiled kernels")
    p.add_argument("--one-by-one", action="store_true", help="times relative to ukf, which has to be among the filters")
    add_output_options(p)
    options = p.parse_args(arguments)
    return exit_status("bearings", lambda: compare(options))


def compare(options: argparse.Namespace) -> None:
    """The table of errors or of times.

    Raises:
        ValueError: an unknown filter.
    """
    check_files({"json": options.json})
    columns: dict[str, dict[str, Any]] = {}
    for column in TIMED if options.one_by_one else COLUMNS:
        name, settings = COLUMNS[column]
        scenario = make_scenario(name, **settings)
        filters = bearings.filters(scenario, options.filters.split(","))

        def of(runs: int, seed: int) -> dict[str, Any]:
            return evaluate(scenario, filters, runs=runs, seed=seed, compile=options.compile)  # noqa: B023  # at once

        if options.one_by_one:
            single = [of(1, options.seed + i) for i in range(SINGLE)]
            columns[f"{column}, one run"] = {
                f: {"relative_time": statistics.median(each[f]["relative_time"] for each in single)} for f in filters
            }
        columns[column] = of(options.runs, options.seed)
    if not options.quiet:
        print(table(columns, "relative_time" if options.one_by_one else "mean_rmse_position"))
    write_results(options.json, {"runs": options.runs, "seed": options.seed, "columns": columns})


def table(columns: dict[str, dict[str, Any]], key: str) -> str:
    """Lines of Markdown, one for each filter."""
    lines = [f"| | {' | '.join(columns)} |", f"|{'---|' * (len(columns) + 1)}"]
    for name in next(iter(columns.values())):
        cells = [cell(of[name]) if key != "relative_time" else f"{of[name][key]:.2f}" for of in columns.values()]
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def cell(of: dict[str, Any]) -> str:
    """An error, and the share of diverged runs if there are some."""
    error = of["mean_rmse_position"]
    text = f"{error:.0f}" if error < 1e4 else f"{error:.0e}".replace("e+", "e").replace("e0", "e")
    return f"{text} ({100 * of['divergence_rate']:.1f} %)" if of["divergence_rate"] else text


if __name__ == "__main__":
    sys.exit(main())
