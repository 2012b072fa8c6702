"""Times filters on one job: two bearings, six states, 100 steps, float64, as one tensor program.

    python scripts/benchmark.py --batch 1,10000 --filters ukf,srckf,fra_srckf,fra

Prints microseconds per track and step: median and interquartile range of several passes, the filters in turn.  Tracks
are those of the scenario named; FRA's time depends on how many of its steps are abnormal, and that share is printed.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from pathlib import Path

import numpy as np
import torch

from torchfra import keep_memory
from torchfra.cli import SCENARIOS, named
from torchfra.evaluate import FILTERS, progress_bar, run
from torchfra.files import write_json
from torchfra.version import __version__


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("--batch", default="1,1000,10000", help="tracks at once (default: 1,1000,10000)")
    parser.add_argument("--filters", default="ukf,srckf,fra_srckf,fra", help=f"out of {', '.join(FILTERS)}")
    parser.add_argument("--scenario", default="bearings-outliers", choices=list(SCENARIOS))
    parser.add_argument("--initial", default="truth", choices=["truth", "paper"], help="initial state (default: truth)")
    parser.add_argument("--passes", type=int, default=7, help="timed passes (default: 7)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results for machines to read")
    options = parser.parse_args(arguments)
    kept = keep_memory()
    scenario = named(options.scenario, initial=options.initial)
    names = options.filters.split(",")
    rows = []
    for batch in map(int, options.batch.split(",")):
        tracks = scenario.simulate(batch, 0)
        filters = {name: FILTERS[name](scenario.motion, scenario.sensor) for name in names}
        seconds: dict[str, list[float]] = {name: [] for name in names}
        with torch.no_grad():
            info = {name: run(f, scenario, tracks).info for name, f in filters.items()}
            for _ in progress_bar(range(options.passes), f"pass of {batch}", True):
                for name, f in filters.items():
                    start = time.perf_counter()
                    run(f, scenario, tracks)
                    seconds[name].append(time.perf_counter() - start)
        for name in names:
            low, middle, high = np.percentile(seconds[name], [25, 50, 75]) / batch / scenario.steps * 1e6
            share = info[name].abnormal.double().mean().item() if hasattr(info[name], "abnormal") else None
            rows.append({"filter": name, "batch": batch, "median": middle, "q1": low, "q3": high, "abnormal": share})
            said = "" if share is None else f"  {share:.0%} of the steps abnormal"
            print(f"{name:<10} batch {batch:>6}: {middle:8.2f} us per track and step [{low:.2f}, {high:.2f}]{said}")
    if options.json is not None:
        versions = {"torchfra": __version__, "torch": torch.__version__, "python": platform.python_version()}
        settings = {"scenario": options.scenario, "initial": options.initial, "threads": torch.get_num_threads()}
        write_json(options.json, {"settings": settings | {"keep_memory": kept}, "versions": versions, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
