"""How far from the best filter of each case: one set of learned values against every filter's own constants.

    python scripts/regret.py out/train/fra_bearings/state_dict.pt --runs 500 --seed 3 --json out/regret.json

Six cases of the bearings experiments: scenario 1 with a poor and a good start, and scenario 2, outliers in covariance
and in standard deviations.  Regret is the mean position RMSE over that of the best filter of a single motion, learned
values excepted, less 1.  Several state dictionaries may be given: each becomes a column.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from torchfra import keep_memory
from torchfra.app.atomic_write import write_json
from torchfra.app.evaluate import evaluate, versions
from torchfra.catalogue import FILTERS, filters_for, learned_filter, make_scenario, scenario_filters

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
    """Prints the table; 0 if it did, 2 with one line on standard error if something handed in was wrong."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("files", metavar="STATE_DICT", nargs="*", type=Path, help="learned values of fra")
    parser.add_argument("--runs", type=int, default=500, metavar="M", help="of each case (default: 500)")
    parser.add_argument("--seed", type=int, default=3, metavar="S", help="of the random numbers (default: 3)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results for machines to read")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, and nothing printed but errors")
    options = parser.parse_args(arguments)
    keep_memory()
    rows: dict[str, Any] = {}
    try:
        for case, (name, outliers, initial) in CASES.items():
            scenario = make_scenario(name, outliers=outliers, initial=initial)
            single = [name for name in filters_for(scenario) if not FILTERS[name].bank]
            filters = scenario_filters(single, scenario) | {
                str(path): learned_filter(path, scenario) for path in options.files
            }
            results = evaluate(scenario, filters, runs=options.runs, seed=options.seed, progress=not options.quiet)
            rows[case] = row(results, [*map(str, options.files)])
            if not options.quiet:
                print(said(case, rows[case]), flush=True)
        if options.json is not None:
            write_json(
                options.json, {"runs": options.runs, "seed": options.seed, "versions": versions(), "cases": rows}
            )
    except (ValueError, OSError) as error:
        print(f"regret: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


def row(results: dict[str, Any], ours: list[str]) -> dict[str, Any]:
    """One case: the best filter that was not learned, and what ``fra`` and the learned ones are to it."""
    rmse = {name: of["mean_rmse_position"] for name, of in results.items()}
    best = min((name for name in rmse if name not in ours), key=rmse.__getitem__)
    others = {name: {"rmse": rmse[name], "regret": rmse[name] / rmse[best] - 1,
                     "divergence_rate": results[name]["divergence_rate"]} for name in ("fra", *ours)}  # fmt: skip
    return {"best": best, "best_rmse": rmse[best], "all": rmse, "ours": others}


def said(case: str, row: dict[str, Any]) -> str:
    """A case as a line of text."""
    cells = [f"{name.split('/')[-2] if '/' in name else name} {of['rmse']:.1f} m ({of['regret']:+.1%}, "
             f"{of['divergence_rate']:.2%} diverged)" for name, of in row["ours"].items()]  # fmt: skip
    return f"{case:<26} best {row['best']} {row['best_rmse']:.1f} m; " + "; ".join(cells)


if __name__ == "__main__":
    sys.exit(main())
