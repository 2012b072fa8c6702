"""Times filters on one job: two bearings, six states, 100 steps, float64, as one tensor program.

    python scripts/benchmark.py                                    filters, eager and compiled
    python scripts/benchmark.py --peers --filters srckf,fra        and seven other libraries in the same passes
    python scripts/benchmark.py --what linear,long --peers         positions: Kalman filters; one track of 10,000 steps
    python scripts/benchmark.py --what step,training               one measurement at a time; forward and backward
    python scripts/benchmark.py --what layer --peers               a network in front learns; the same in JAX
    python scripts/benchmark.py --what scaling --figure scaling.png
    python scripts/benchmark.py --what cores --filters srckf       on one thread, on two, in two processes
    python scripts/benchmark.py --what positions                   the alpha-beta bank on 100,000 tracks in space
    python scripts/benchmark.py --what roof                        every filter against what this machine can do at most

Prints a table for each job when it is done, in microseconds per track and step: median and quartiles of several passes,
one pass of each system in turn, so that a machine whose speed drifts treats them alike.  A pass repeats short calls for
20 ms (for cores and training 200) and takes their median, so that caches are warm.  Compile time is apart.  Filters of
torchfra return full estimates (means, roots, scores at every step); the others the last mean only.  Each of the others
runs in a process of its own, which sleeps while the others are timed.
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from benchmarks.cores import cores
from benchmarks.layer import layer
from benchmarks.linear import linear, long
from benchmarks.roof import FILTERS, PRECISIONS, roof
from benchmarks.scaling import draw, scaling
from benchmarks.timing import Row, table
from benchmarks.tracks import positions, step, tracks
from benchmarks.training import training
from lists import check_list

from torchfra import keep_memory
from torchfra.catalogue import SCENARIOS, track_filters
from torchfra.cli.command import add_json_option, check_files, exit_status, make_parser
from torchfra.running.versions import write_results

BEARINGS = [name for name in SCENARIOS if name.startswith("bearings")]
KINDS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "tracks": tracks,
    "linear": linear,
    "long": long,
    "step": step,
    "training": training,
    "layer": layer,
    "scaling": scaling,
    "positions": positions,
    "cores": cores,
    "roof": roof,
}


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    return exit_status("benchmark", lambda: benchmark(checked(parser(), arguments)))


def checked(p: argparse.ArgumentParser, arguments: list[str] | None) -> argparse.Namespace:
    """The options, or the end of the program with a message if they make no sense."""
    options = p.parse_args(arguments)
    check_list(p, "what", options.what, KINDS)
    check_list(p, "filters", options.filters, track_filters())
    check_list(p, "modes", options.modes, ("compiled", "eager"))
    if options.batch is not None and not all(n.isdecimal() and int(n) > 0 for n in options.batch.split(",")):
        p.error(f"--batch: expected whole numbers of 1 or more, separated by commas, received {options.batch}")
    if options.device == "cuda" and (options.peers or not set(options.what.split(",")) <= {"tracks", "positions"}):
        p.error("--device cuda: expected --what tracks or positions, without --peers")
    if options.figure is not None and "scaling" not in options.what.split(","):
        p.error(f"--figure: expected beside --what scaling, received beside {options.what}")
    return options


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = make_parser(__doc__)
    p.add_argument("--what", default="tracks", help=f"some of {', '.join(KINDS)} (default: tracks)")
    p.add_argument(
        "--batch", help="tracks at once (default: 1,1000,10000; 64 for training and layer, 100000 for positions)"
    )
    p.add_argument("--filters", default=FILTERS, help=f"some of {', '.join(track_filters())}")
    p.add_argument("--modes", default="compiled,eager", help="compiled, eager or both (default)")
    p.add_argument("--device", default="cpu", help="cpu (default) or cuda, for tracks and positions")
    p.add_argument("--scenario", default="bearings-outliers", choices=BEARINGS)
    p.add_argument("--initial", default="truth", choices=["truth", "paper"], help="initial state (default: truth)")
    p.add_argument("--precision", default="double", choices=PRECISIONS, help="for roof (default: double)")
    p.add_argument("--passes", type=int, default=7, help="timed passes (default: 7)")
    p.add_argument("--peers", action="store_true", help="also other libraries, where installed, and C++; "
                   "the environment variable TORCHFRA_PEERS_PYTHON may name the Python that has them")  # fmt: skip
    p.add_argument("--figure", type=Path, metavar="FILE", help="PNG of the results of 'scaling'")
    add_json_option(p)
    return p


def benchmark(options: argparse.Namespace) -> None:
    """Times what the options say, prints the results and writes them."""
    check_files({"json": options.json, "figure": options.figure})
    threads = torch.get_num_threads()
    device = torch.cuda.get_device_name() if options.device == "cuda" else options.device
    print(f"torch {torch.__version__}, {threads} threads, {platform.machine()}, {device}")
    rows: list[Row] = []
    for kind in options.what.split(","):
        with torch.set_grad_enabled(kind in ("training", "layer")):
            done = KINDS[kind](options)
        print(f"\n{kind}, microseconds per track and step:\n{table(done)}", flush=True)
        if kind == "scaling" and options.figure is not None:
            draw(done, options.figure)
        rows += done
    settings = {key: str(value) if isinstance(value, Path) else value for key, value in vars(options).items()}
    settings |= {"threads": threads, "keep_memory": keep_memory()}
    write_results(options.json, {"settings": settings, "rows": rows})


if __name__ == "__main__":
    sys.exit(main())
