"""How far learned values and ``fra`` are from the best filter of each case.

    python scripts/regret.py out/train/fra_bearings/state_dict.pt --runs 500 --seed 3 --json out/regret.json

Six cases of the bearings experiments: scenario 1 with a poor and a good start, and scenario 2, outliers in covariance
and in standard deviations.  Regret is the mean position RMSE divided by that of the best filter of a single motion,
learned values excepted, minus 1.  Several state dictionaries may be given: each becomes a row of every case, under the
name of its folder.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from torchfra.app.atomic_write import write_json
from torchfra.app.command import add_json_option, add_quiet_option, add_runs_options, exit_status, make_parser
from torchfra.app.evaluate import evaluate, versions
from torchfra.app.progress import progress_bar
from torchfra.catalogue import FILTERS, filters_for, learned_filter, make_scenario, scenario_filters
from torchfra.tables import text_table

CASES = {
    f"{number}, {start}{outliers}": (name, outliers, initial)
    for number, name, starts in (
        (1, "bearings-outliers", {"poor start, ": "paper", "good start, ": "truth"}),
        (2, "bearings-manoeuvre", {"": "truth"}),
    )
    for start, initial in starts.items()
    for outliers in ("covariance", "std")
}


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns 0, or 2 after one line on standard error if an argument or a file was wrong."""
    p = make_parser(__doc__)
    p.add_argument("files", metavar="STATE_DICT", nargs="*", type=Path, help="learned values of fra")
    add_runs_options(p, 500, seed=3)
    add_json_option(p)
    add_quiet_option(p)
    options = p.parse_args(arguments)
    return exit_status("regret", lambda: regret(options))


def regret(options: argparse.Namespace) -> None:
    """All cases, as a table when the last one is done."""
    cases: dict[str, Any] = {}
    for case, (name, outliers, initial) in progress_bar(CASES.items(), "case", not options.quiet):
        scenario = make_scenario(name, outliers=outliers, initial=initial)
        single = [name for name in filters_for(scenario) if not FILTERS[name].bank]
        learned = {str(path): learned_filter(path, scenario) for path in options.files}
        filters = scenario_filters(single, scenario) | learned
        results = evaluate(scenario, filters, runs=options.runs, seed=options.seed, progress=not options.quiet)
        cases[case] = case_result(results, list(learned))
    if not options.quiet:
        print(table(cases))
    if options.json is not None:
        write_json(options.json, {"runs": options.runs, "seed": options.seed, "versions": versions(), "cases": cases})


def case_result(results: dict[str, Any], learned: list[str]) -> dict[str, Any]:
    """One case: the best filter that was not learned, and the regret of ``fra`` and of the learned ones."""
    rmse = {name: of["mean_rmse_position"] for name, of in results.items()}
    best = min((name for name in rmse if name not in learned), key=rmse.__getitem__)
    compared = {
        name: {"rmse": rmse[name], "regret": rmse[name] / rmse[best] - 1,
               "divergence_rate": results[name]["divergence_rate"]}
        for name in ("fra", *learned)
    }  # fmt: skip
    return {"best": best, "best_rmse": rmse[best], "all": rmse, "ours": compared}


def table(cases: dict[str, Any]) -> str:
    """The cases as text: a line for each compared filter; a state dictionary is called by its folder."""
    rows = [
        [case, result["best"], f"{result['best_rmse']:.1f}", Path(name).parent.name or name, f"{of['rmse']:.1f}",
         f"{of['regret']:+.1%}", f"{of['divergence_rate']:.2%}"]
        for case, result in cases.items()
        for name, of in result["ours"].items()
    ]  # fmt: skip
    return text_table(["case", "best", "RMSE m", "compared", "RMSE m", "regret", "diverged"], rows, align="<<><>")


if __name__ == "__main__":
    sys.exit(main())
