"""How well recorded tracks are cleaned, where the truth is known.

    python scripts/clean_check.py --json out/clean.json --plot out/clean.png
    python scripts/clean_check.py --runs 2 --flights 3 --steps 200 --periods 5 --noises 15
    python scripts/clean_check.py --kinds gliders,drones --clean package.module:function

Truth: recorded flights of the package traffic, their time stamps mended and their paths made smooth, on a grid of one
second; ships and drones that are simulated; and the paths of recorded ranges where a folder of them is given: as they
were walked, noise and outliers are a fiftieth and periods an eighth, and turns, which are corners, not asked for.
Every truth is measured at each period and noise as often as there are runs: Gaussian noise, and 3 % of the fixes
outliers of 100 m to 10 km, half of them in bursts, of which every second one has one offset, as of a second target.
A case is a truth at a period and noise.  Its figures, over all runs:

- the error across the ground (root mean square) at the fixes that are no outliers over that of these fixes as they are;
- the error at all fixes over that of a smoother of constant velocity that has the true sigma and outliers, and whose
  process noise is the one that makes its error least;
- precision of flagged outliers, and recall of those beyond 6 sigma;
- sigma found over the true one, the mean over the runs;
- turns of 1.5 deg/s or more for 10 s or more: the share of their time that is in a segment to that side, and the share
  of the listed ones' time in which the truth turns that way by half of that or more;
- the share of true coordinates within the 68 % and 95 % bands.

Errors and sigma are asked of every case, shares of all cases of a period as one.

Eight kinds are harder, and asked for by name: late, ships of 5 to 19 m/s with time stamps off by 0.2 s, one in five by
2 s; lasting, ships whose errors last 20 s; heights, drones with heights in steps of 25 ft, one in ten missing; animals,
fixes of 24 min, 2 h and 4 h for 1, 5 and 10 s and noise of 100, 500 and 1000 m for 3, 15 and 30 m; slow, a walk, a
bike, a car, a drone and a boat with white noise, alone and with errors correlated over 10, 20 or 40 s, half as large
and as large; rare, fixes of 6 min, 30 min and 1 h for 1, 5 and 10 s of a walk, a car, a ship, an aircraft and an animal
that rest for minutes to hours; bursts, the same targets with three fixes an hour, 4, 20 or 40 s apart for 1, 5 and
10 s; gaps, those of slow with white noise and forty fixes an hour, 3, 15 or 30 s apart for 1, 5 and 10 s.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cleaning.bounds import bounds_table, cases_table, table, verdicts
from cleaning.figures import Counts, add, figures
from cleaning.measured import GHOSTS, Case, Measured, measured
from cleaning.truths import HARDER, KINDS, truths
from lists import numbers_in

from torchfra.cleaning import Cleaned
from torchfra.cli.command import Failures, add_output_options, check_files, exit_status, make_parser
from torchfra.readers.recording import Recording
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results

Cleaner = Callable[[Sequence[Recording]], Sequence[Cleaned]]
TOGETHER = 64
"""Recordings that are handed over at once."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the tables; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    return exit_status("clean_check", lambda: check(parser().parse_args(arguments)))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = make_parser(__doc__)
    harder = f"of {','.join((*KINDS, *HARDER))} (default: {','.join(KINDS)})"
    p.add_argument("--kinds", metavar="A,B", default=",".join(KINDS), help=harder)
    p.add_argument("--flights", metavar="N", type=int, default=8, help="truths of each kind (default: 8)")
    p.add_argument("--ranges", metavar="FOLDER", type=Path, help="with recorded ranges and the paths that were walked")
    p.add_argument("--periods", metavar="S,S", default="1,5,10", help="seconds between fixes (default: 1,5,10)")
    p.add_argument("--noises", metavar="M,M", default="3,15,30", help="of a fix per axis, m (default: 3,15,30)")
    p.add_argument("--steps", metavar="K", type=int, default=600, help="most fixes of a track (default: 600)")
    p.add_argument("--runs", metavar="M", type=int, default=10, help="of each case (default: 10)")
    p.add_argument("--seed", metavar="S", type=int, default=0, help="of the first run (default: 0)")
    ghosts = f"share of the bursts whose fixes all have one offset (default: {GHOSTS})"
    p.add_argument("--ghosts", metavar="SHARE", type=float, default=GHOSTS, help=ghosts)
    cleaner = "what cleans: a function of recordings (default: torchfra.cleaning:clean_tracks)"
    p.add_argument("--clean", metavar="MODULE:NAME", default="torchfra.cleaning:clean_tracks", help=cleaner)
    p.add_argument("--cases", action="store_true", help="print a line for each case, too")
    p.add_argument("--plot", type=Path, metavar="FILE", help="PNG: every case against the bounds")
    add_output_options(p)
    return p


def check(options: argparse.Namespace) -> None:
    """Cleans all cases; tables when the last one is done."""
    periods, noises = (numbers_in(name, getattr(options, name)) for name in ("periods", "noises"))
    module, _, name = options.clean.partition(":")
    clean: Cleaner = getattr(importlib.import_module(module), name)
    check_files({"json": options.json, "plot": options.plot})
    known = truths(options.kinds.split(","), options.flights, options.ranges)
    cases = [Case(truth, period, noise) for period in periods for noise in noises for truth in known]
    found, seconds = judged(clean, cases, options)
    failures = Failures()
    if not options.quiet:
        lines = f"{cases_table(found)}\n\n" if options.cases else ""
        print(f"{lines}{table(found)}\n\n{bounds_table(found)}\n\n{seconds:.0f} s of cleaning", flush=True)
    named = ("kinds", "flights", "steps", "runs", "seed", "ghosts", "clean")
    head = {name: getattr(options, name) for name in named}
    with failures.of("json"):
        write_results(options.json, {**head, "seconds": seconds, "bounds": verdicts(found), "cases": found})
    if options.plot is not None:
        from cleaning.picture import picture  # matplotlib takes long to import

        from torchfra import plotting

        title = f"{len(found)} cases of {options.runs} runs, seed {options.seed}; green is what must be reached"
        with failures.of("plot"):
            plotting.save(picture(found, title), options.plot)
    failures.end()


def judged(clean: Cleaner, cases: Sequence[Case], options: argparse.Namespace) -> tuple[list[dict[str, Any]], float]:
    """Figures of all cases that have enough fixes, and the seconds that cleaning took."""
    seeds = range(options.seed, options.seed + options.runs)
    runs: list[Measured] = [
        run
        for case in cases
        for seed in seeds
        if (run := measured(case, options.steps, seed, options.ghosts)) is not None
    ]
    counts = {run.case: Counts() for run in runs}
    seconds, parts = 0.0, range(0, len(runs), TOGETHER)
    for first in progress_bar(parts, f"{TOGETHER} tracks", not options.quiet):
        part = runs[first : first + TOGETHER]
        begin = time.perf_counter()
        cleaned = clean([run.recording() for run in part])
        seconds += time.perf_counter() - begin
        for run, one in zip(part, cleaned, strict=True):
            add(counts[run.case], run, one)
    return [figures(case, of, [r for r in runs if r.case is case]) for case, of in counts.items()], seconds


if __name__ == "__main__":
    sys.exit(main())
