"""The ``torchfra`` command."""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchfra import readers, scenarios
from torchfra.app import distributed
from torchfra.app.atomic_write import write_json, write_text
from torchfra.app.evaluate import evaluate, report, table
from torchfra.app.memory import keep_memory
from torchfra.app.progress import progress_bar
from torchfra.catalogue import (
    SCENARIOS,
    filters_for,
    learned_filter,
    make_scenario,
    scan_filters,
    scenario_filters,
    track_filters,
)
from torchfra.filters import Filter
from torchfra.kernel.build import CompileError
from torchfra.scenarios import Scenario
from torchfra.version import __version__

TRACKS, SCANS = ", ".join(track_filters()), ", ".join(scan_filters())
_FILES = """FILE is a recorded track, or several: OpenSky state vectors (CSV: time, icao24, lat, lon), gzip-JSON
tracks (timestamp, latitude, longitude, altitude, ...), or plain CSV with columns t,x,y[,z] in seconds and metres."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    shape = argparse.RawDescriptionHelpFormatter
    top = argparse.ArgumentParser("torchfra", description="Robust, adaptive tracking of manoeuvring targets.")
    top.add_argument("--version", action="version", version=f"torchfra {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    t = commands.add_parser(
        "track",
        formatter_class=shape,
        help="filter the positions of a recorded track",
        description=f"Filter recorded positions: writes NAME.csv and NAME.png for each target.\n\n{_FILES}",
        epilog="examples:\n  torchfra track flight.json.gz --sigma 30 --out filtered\n"
        "  torchfra track flight.json.gz --filter vsimm_srckf    # interacting models: the figure shades which leads\n"
        "  torchfra track long.csv --filter alphabeta --compile --no-plots    # the fastest way through a large file",
    )
    t.add_argument("file", metavar="FILE", type=Path)
    t.add_argument(
        "--filter", default="fra", metavar="NAME", help=f"one of {', '.join(track_filters())} (default: fra)"
    )
    t.add_argument("--dt", type=float, metavar="S", help="also estimate every S seconds between the fixes")
    t.add_argument("--sigma", type=float, default=25.0, metavar="M", help="std of a recorded position, m (default: 25)")
    t.add_argument(
        "--q", type=float, default=1.0, help="variance of the change of acceleration per step, m^2/s^4 (default: 1)"
    )
    t.add_argument("--compile", action="store_true", help="run compiled kernels: for long files, needs g++")
    t.add_argument("--out", type=Path, default=Path("out"), metavar="DIR", help="where to write (default: out)")
    t.add_argument("--no-plots", action="store_true", help="write the tables only")
    _common(t)
    t.set_defaults(run=_track)

    c = commands.add_parser(
        "compare",
        formatter_class=shape,
        help="run a batch of tracks through several filters",
        description="Run many tracks through several filters: one table and one figure.  The tracks are recorded ones\n"
        f"seen by a simulated sensor (FILES), or those of a paper's scenario.\n\n{_FILES}",
        epilog="examples:\n  torchfra compare flights/*.json.gz --sensor radar --json radar.json\n"
        "  torchfra compare --scenario bearings-outliers --runs 500 --filters srckf,rmckf,fra\n"
        "  torchfra compare --scenario bearings-outliers --runs 1000000 --filters srckf --compile\n"
        "  torchrun --nproc-per-node 2 -m torchfra compare --scenario bearings-outliers --runs 10000",
    )
    c.add_argument("files", metavar="FILE", type=Path, nargs="*")
    c.add_argument("--scenario", metavar="NAME", help=f"instead of files, one of {', '.join(SCENARIOS)}")
    c.add_argument("--filters", metavar="A,B", help=f"out of {TRACKS}, of clutter-* {SCANS} "
                   "(default: all)")  # fmt: skip
    c.add_argument(
        "--learned",
        metavar="[NAME=]FILE",
        help="also the filter NAME (default: fra) with values that training wrote, as 'learned'",
    )
    c.add_argument("--runs", type=int, metavar="M", help="tracks (default: 100; of files, each window once)")
    c.add_argument("--seed", type=int, default=0, metavar="S", help="of the random numbers (default: 0)")
    c.add_argument("--outliers", metavar="MODE", help="covariance (default), std, offset (scenarios only) or none")
    c.add_argument("--sensor", default="bearings", help="for files: bearings (default), radar or position")
    c.add_argument(
        "--q", type=float, default=0.25, help="for files: variance of the change of acceleration that filters assume "
        "per step, m^2/s^4 (default: 0.25)"
    )  # fmt: skip
    c.add_argument("--dt", type=float, default=5.0, metavar="S", help="for files: seconds per step (default: 5)")
    c.add_argument("--steps", type=int, default=120, metavar="T", help="for files: steps per window (default: 120)")
    c.add_argument("--compile", action="store_true", help="run compiled kernels: many times faster, needs g++")
    c.add_argument("--figure", type=Path, metavar="FILE", help="PNG (default: compare-SCENARIO.png)")
    _common(c)
    c.set_defaults(run=_compare)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 0 if it did its work, 2 with one line on standard error if something handed in was wrong."""
    options = parser().parse_args(arguments)
    keep_memory()
    with distributed.team():
        try:
            options.run(options)
        except (ValueError, OSError, ImportError, CompileError) as error:
            if distributed.rank() == 0:
                print(f"torchfra: error: {' '.join(str(error).split())}", file=sys.stderr)
            return 2
    return 0


def _common(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", type=Path, metavar="FILE", help="write the results for machines to read")
    command.add_argument("--quiet", action="store_true", help="no progress bar, and nothing printed but errors")


def _track(options: argparse.Namespace) -> None:
    if distributed.rank():
        return  # one process is enough for a file
    from torchfra.app.track import GATE, track

    recordings = readers.read(options.file)
    begun = time.perf_counter()
    results = track(
        recordings,
        options.filter,
        dt=options.dt,
        sigma=options.sigma,
        q=options.q,
        compile=options.compile,
        progress=not options.quiet,
    )
    seconds = time.perf_counter() - begun
    used: set[str] = set()
    for result in progress_bar(results, "file", not options.quiet):
        name = _unused(re.sub(r"[^\w.-]+", "_", result.recording.name).strip("_.") or "track", used)
        write_text(options.out / f"{name}.csv", result.csv())
        if not options.no_plots:
            from torchfra.app import plotting

            flags = {name: result.flags[name] for name in ("outlier", "manoeuvre")}
            figure = plotting.filtered(
                result.time, result.raw, result.position, result.nis, flags, GATE[result.raw.shape[1]],
                f"{result.recording.name}, {options.filter}", result.models, result.leading,
            )  # fmt: skip
            plotting.save(figure, options.out / f"{name}.png")
        if not options.quiet:
            print(_said(result.summary(), options.out / f"{name}.csv"))
    if options.json is not None:
        settings = {"filter": options.filter, "dt": options.dt, "sigma": options.sigma, "q": options.q}
        tracks = [result.summary() for result in results]
        rate = sum(len(result.time) for result in results) / seconds
        write_json(
            options.json,
            {"file": options.file.name, "version": __version__, "settings": settings, "steps_per_second": rate,
             "tracks": tracks},
        )  # fmt: skip


def _compare(options: argparse.Namespace) -> None:
    if bool(options.files) == (options.scenario is not None):
        raise ValueError(
            "compare: expected either files or --scenario, received " + ("both" if options.files else "neither")
        )
    if options.scenario is not None:
        scenario = make_scenario(options.scenario, outliers=options.outliers)
        runs = 100 if options.runs is None else options.runs
    else:
        recordings = [r for file in options.files for r in readers.read(file)]
        scenario = scenarios.recorded(
            recordings, options.sensor, dt=options.dt, steps=options.steps, outliers=options.outliers or "covariance",
            q=options.q,
        )  # fmt: skip
        runs = int(str(scenario.settings["windows"])) if options.runs is None else options.runs
    names = filters_for(scenario) if options.filters is None else [name for name in options.filters.split(",") if name]
    first = distributed.rank() == 0
    filters: Sequence[str] | dict[str, Filter] = names
    if options.learned is not None:
        name, equals, file = options.learned.rpartition("=")
        filters = scenario_filters(names, scenario) | {
            "learned": learned_filter(file, scenario, name if equals else "fra")
        }
    results = evaluate(
        scenario,
        filters,
        runs=runs,
        seed=options.seed,
        compile=options.compile,
        progress=first and not options.quiet,
    )
    if not first:
        return
    figure = options.figure or Path(f"compare-{scenario.name}.png")
    from torchfra.app import plotting

    plotting.save(plotting.rmse_curves(results, "position", scenario.dt, f"{scenario.name}, {runs} runs"), figure)
    if options.json is not None:
        write_json(options.json, report(scenario, results, runs=runs, seed=options.seed))
    if not options.quiet:
        print(f"{scenario.name}: {runs} runs of {scenario.steps} steps, seed {options.seed}, {_settings(scenario)}")
        print(table(results))
        print(f"figure: {figure}")


def _settings(scenario: Scenario) -> str:
    return ", ".join(f"{key} {value}" for key, value in scenario.settings.items() if isinstance(value, str))


def _unused(name: str, used: set[str]) -> str:
    """A file name that no other target of this call has."""
    number, candidate = 2, name
    while candidate in used:
        number, candidate = number + 1, f"{name}-{number}"
    used.add(candidate)
    return candidate


def _said(summary: dict[str, Any], path: Path) -> str:
    repairs = ", ".join(f"{count} {what}" for what, count in summary["repairs"].items()) or "none"
    lost = " LOST ITS NUMBERS" if summary["failed"] else ""
    return (
        f"{summary['name']}: {summary['steps']} steps over {np.round(summary['seconds'] / 60, 1)} min, "
        f"{summary['outlier']} outliers, {summary['manoeuvre']} manoeuvres, {summary['missing']} missing, "
        f"fixes moved by {summary['median_correction']:.1f} m in the median{lost}; repairs: {repairs} -> {path}"
    )
