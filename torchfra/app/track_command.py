"""``torchfra track``: filters the positions of recorded tracks."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchfra import readers
from torchfra.app import distributed
from torchfra.app.atomic_write import write_json, write_text
from torchfra.app.command import (
    Failures,
    add_bound_option,
    add_json_option,
    add_quiet_option,
    check_files,
    check_folder,
)
from torchfra.app.compiling import add_compile_option, choose, reporters
from torchfra.app.filtered import Filtered
from torchfra.app.progress import progress_bar
from torchfra.app.track import DEFAULT, GATE, check_settings, successive_steps, track
from torchfra.catalogue import FILTERS, track_filters
from torchfra.kernel.build import CompileError
from torchfra.readers import Recording
from torchfra.tables import printable
from torchfra.version import __version__

FILES = """FILE holds one or several recorded tracks: OpenSky state vectors (CSV: time, icao24, lat, lon), gzip-JSON
tracks (timestamp, latitude, longitude, altitude, ...), or plain CSV with columns t,x,y[,z] in seconds and metres.
Plain CSV holds one target; other columns are ignored."""

_EXAMPLES = """examples:
  torchfra track flight.json.gz --sigma 30 --out filtered
  torchfra track flight.json.gz --filter vsimm_srckf    # another filter, here one of interacting models
  torchfra track long.csv --filter alphabeta --compile --no-plots    # the fastest way through a large file"""

WORTHWHILE, WORTHWHILE_OF_BANKS = 5_000, 50_000
"""Steps in sequence that take an interpreted filter about as long as compiling it."""
_LONGEST_NAME = 100
"""Bytes of a file's name, of which file systems take 255, and characters of a target's in a line."""


def add_to(commands: Any) -> None:
    """Adds the command to a parser's subparsers."""
    command = commands.add_parser(
        "track",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        help="filter the positions of a recorded track",
        description=f"Filter recorded positions: writes NAME.csv and NAME.png for each target.\n\n{FILES}",
        epilog=_EXAMPLES,
    )
    add = command.add_argument
    add("file", metavar="FILE", type=Path)
    add("--filter", default=DEFAULT, metavar="NAME", help=f"one of {', '.join(track_filters())} (default: {DEFAULT})")
    add("--dt", type=float, metavar="S", help="also estimate every S seconds between the fixes")
    add("--sigma", type=float, default=25.0, metavar="M", help="std of a recorded position, m (default: 25)")
    add("--q", type=float, default=1.0, help="variance of the change of acceleration per step, m^2/s^4 (default: 1)")
    add_compile_option(
        command, f"for {WORTHWHILE:,} steps or more, of filters with several models {WORTHWHILE_OF_BANKS:,}"
    )
    add("--out", type=Path, default=Path("out"), metavar="DIR", help="where to write (default: out)")
    add("--no-plots", action="store_true", help="write the tables only")
    add_bound_option(add)
    add_json_option(command)
    add_quiet_option(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command; in the first process alone, which is enough for a file."""
    if distributed.rank():
        return
    check_folder("out", options.out)
    check_files({"json": options.json}, [options.file])
    check_settings(options.filter, options.dt, options.sigma, options.q)
    recordings = readers.read(options.file, max_bytes=options.max_bytes)
    files, failures = _files(recordings, options), Failures()
    start = time.perf_counter()
    results = _tracked(recordings, options, failures)
    seconds = time.perf_counter() - start
    for recording, path in progress_bar(files.items(), "file", not options.quiet):
        if (result := results.get(recording)) is not None:
            with failures.of(printable(recording.name)):
                _write(result, options, path)
    if options.json is not None:
        settings = {key: getattr(options, key) for key in ("filter", "dt", "sigma", "q")}
        head = {"file": options.file.name, "version": __version__, "settings": settings}
        rate = sum(len(result.time) for result in results.values()) / seconds
        with failures.of("json"):
            tracks = [result.summary() for result in results.values()]
            write_json(options.json, {**head, "steps_per_second": rate, "tracks": tracks})
    failures.end()


def _files(recordings: Sequence[Recording], options: argparse.Namespace) -> dict[Recording, Path]:
    """The table of each target, once it is known that it can be written."""
    names: set[str] = set()
    files = {recording: options.out / f"{_unused(recording.name, names)}.csv" for recording in recordings}
    endings = (".csv",) if options.no_plots else (".csv", ".png")
    paths = [path.with_name(f"{path.stem}{ending}") for path in files.values() for ending in endings]
    check_files({"json": options.json} | {f"out, {path.name}": path for path in paths})
    return files


def _tracked(
    recordings: Sequence[Recording], options: argparse.Namespace, failures: Failures
) -> dict[Recording, Filtered]:
    """All targets filtered at once; or, where that fails, one after the other, without those that cannot be."""
    tell, fallback = reporters(options.compile, options.quiet)
    entry = FILTERS[options.filter]
    least = WORTHWHILE_OF_BANKS if entry.bank or entry.either else WORTHWHILE
    compile = choose(options.compile, successive_steps(recordings) >= least, tell)
    settings = {"dt": options.dt, "sigma": options.sigma, "q": options.q, "compile": compile, "fallback": fallback}
    try:
        done = track(recordings, options.filter, **settings, progress=not options.quiet)
        return dict(zip(recordings, done, strict=True))
    except Exception as error:
        if len(recordings) == 1 or isinstance(error, CompileError | NotImplementedError):
            raise
        found = {}
        for recording in recordings:
            with failures.of(printable(recording.name)):
                (found[recording],) = track([recording], options.filter, **settings)
        return found


def _write(result: Filtered, options: argparse.Namespace, path: Path) -> None:
    """The files of a target, and its line in any case.

    Raises:
        OSError: a file cannot be written.
        ValueError: an estimate is not finite.
    """
    if not options.quiet:
        print(_line(result, path))
    write_text(path, result.csv())
    if not options.no_plots:
        _draw(result, options.filter, path.with_name(f"{path.stem}.png"))
    if failed := int(result.failed.sum()):
        raise ValueError(f"NaN or infinity in {failed} of {len(result.time)} steps")


def _draw(result: Filtered, name: str, path: Path) -> None:
    from torchfra.app import plotting  # matplotlib takes long to import

    figure = plotting.filtered(
        result.time, result.raw, result.position, result.std, result.nis, result.marks(),
        GATE[result.raw.shape[1]], f"{result.recording.name}, {name}", result.models, result.leading,
    )  # fmt: skip
    plotting.save(figure, path)


def _unused(name: str, used: set[str]) -> str:
    """A file name, without its ending, that no other target of this call has, not even where case does not count."""
    name = re.sub(r"[^\w.-]+", "_", name).encode()[:_LONGEST_NAME].decode(errors="ignore").strip("_.") or "track"
    number, candidate = 2, name
    while candidate.casefold() in used:
        number, candidate = number + 1, f"{name}-{number}"
    used.add(candidate.casefold())
    return candidate


def _line(result: Filtered, path: Path) -> str:
    summary, above = result.summary(), {"above the gate": "steps above the gate"}
    marked = ", ".join(f"{mark.sum()} {above.get(name, f'{name}s')}" for name, mark in result.marks().items())
    repairs = ", ".join(f"{count} {what}" for what, count in summary["repairs"].items()) or "none"
    failed = ", FAILED: NaN or infinity" if summary["failed"] else ""
    return (
        f"{printable(summary['name'], _LONGEST_NAME)}: {summary['steps']} steps over "
        f"{summary['seconds'] / 60:.1f} min, {marked}, {summary['missing']} missing, "
        f"median correction {summary['median_correction']:.1f} m{failed}; repairs: {repairs} -> {printable(str(path))}"
    )
