"""What gpb gives up where its stated model holds, to be good elsewhere: a search for each regret that is allowed there.

    python -m train.frontier --holds 0.005,0.015,0.03,0.06 --json out/frontier.json --figure out/frontier.png
    python -m train.frontier --holds 0.01,0.1 batch=64 iterations=20

Each search is the run gpb of train.tune, in OUT/HOLDS, with another regret that is allowed where targets move as
filters are told; a search that is there already is not made again.  Then the worst regret on unseen tracks (learning
and validation go by others): where the stated model holds, against that in the scenarios, recorded flights and ranges.
KEY=VALUE changes fields of train.config.Config in all searches.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from torchfra import plotting
from torchfra.cli.command import (
    Failures,
    add_json_option,
    add_quiet_option,
    check_files,
    check_folder,
    exit_status,
    make_parser,
)
from torchfra.running.atomic_write import write_json
from torchfra.running.versions import versions
from torchfra.tables import text_table
from train.config import Config, check, read_changes
from train.runs_gpb import gpb
from train.tune import tune

NOISE = ("q", "std")
"""Options of tracks that are not drawn from what filters are told."""


def main(arguments: list[str] | None = None) -> int:
    """Prints a line for each search; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("changes", metavar="KEY=VALUE", nargs="*", help="fields of train.config.Config")
    p.add_argument("--holds", metavar="A,B", default="0.005,0.015,0.03,0.06", help="regrets that are allowed")
    p.add_argument("--out", type=Path, metavar="DIR", default=Path("out/frontier"), help="(default: out/frontier)")
    p.add_argument("--figure", type=Path, metavar="FILE", help="PNG: one worst regret against the other")
    add_json_option(p)
    add_quiet_option(p)
    return exit_status("frontier", lambda: frontier(p.parse_args(arguments)))


def frontier(options: argparse.Namespace) -> None:
    """All searches; the table when the last one is done.

    Raises:
        ValueError: regrets that are no numbers of 0 or more, or settings that make no sense.
    """
    configs = {holds: config_for(holds, options.changes) for holds in allowed(options.holds)}
    check_folder("out", options.out)
    check_files({"json": options.json, "figure": options.figure})
    points = []
    for holds, config in configs.items():
        out = options.out / f"{holds:g}"
        done = out / "results.json"
        result = json.loads(done.read_text()) if done.exists() else tune(config, out, quiet=options.quiet)
        points.append({"allowed": holds, **worst(result), "preset": result["preset"]})
    failures = Failures()
    if not options.quiet:
        print(text_table(
            ["allowed", "worst where the model holds", "task", "worst in the scenarios", "task"],
            [[f"{p['allowed']:.1%}", *(x for key in ("holds", "scenarios") for x in shown(p[key]))] for p in points],
            align=">><><",
        ))  # fmt: skip
    if options.json is not None:
        with failures.of("json"):
            write_json(options.json, {"points": points, "changes": options.changes, "versions": versions()})
    if options.figure is not None:
        with failures.of("figure"):
            plotting.save(picture(points), options.figure)
    failures.end()


def allowed(text: str) -> list[float]:
    """The regrets that are allowed where the stated model holds.

    Raises:
        ValueError: no number, or one below 0.
    """
    try:
        values = [float(part) for part in text.split(",") if part]
    except ValueError:
        values = []
    if not values or not all(0 <= value < float("inf") for value in values):
        raise ValueError(f"holds: expected numbers of 0 or more with commas between them, received {text!r}")
    return values


def config_for(holds: float, changes: list[str]) -> Config:
    """The settings of a search."""
    return check(replace(gpb(holds), **read_changes(changes)))


def worst(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The largest filtered regrets on unseen tracks: where the stated model holds, and in the scenarios that count."""
    found: dict[str, dict[str, Any]] = {}
    for task in result["tasks"]:
        told = task["scenario"] == "as-stated"
        if (told and (task["outliers"] != "none" or any(key in task for key in NOISE))) or not task["weight"]:
            continue
        kind, regret = "holds" if told else "scenarios", task["after"]["filtered"]["regret"]
        if kind not in found or not regret <= found[kind]["regret"]:
            named = {"rival", "before", "after", "weight"}
            found[kind] = {"regret": regret, "task": {key: x for key, x in task.items() if key not in named}}
    return found


def shown(of: dict[str, Any]) -> tuple[str, str]:
    """A regret and its task."""
    return f"{of['regret']:+.1%}", " ".join(str(x) for x in of["task"].values())


def picture(points: list[dict[str, Any]]) -> Figure:
    """Worst regrets against each other, a point for each search."""
    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.subplots()
    x, y = ([100 * p[key]["regret"] for p in points] for key in ("holds", "scenarios"))
    axes.plot(x, y, "o-", color="#0072b2", linewidth=0.8)
    for p, right, up in zip(points, x, y, strict=True):
        axes.annotate(f" {p['allowed']:.1%} allowed", (right, up), fontsize=8)
    axes.set_xlabel("worst regret where the stated model holds, %")
    axes.set_ylabel("worst regret in scenarios, on flights and ranges, %")
    axes.grid(alpha=0.3)
    return figure


if __name__ == "__main__":
    sys.exit(main())
