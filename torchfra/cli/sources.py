"""Sources of a comparison: recorded tracks, a scenario by its name, or recorded ranges."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchfra import readers, scenarios
from torchfra.catalogue import SCENARIOS, make_scenario
from torchfra.cli.loading import is_place, load_scenario
from torchfra.cli.reading_options import READING, add_bound_option, add_reading_options
from torchfra.scenarios import Scenario

RANGES = """Recorded ranges (--ranges) are folders, each and those below it one recording, or the files of one: ranges
from anchors and the reference path.  The columns determine what a file holds: t,range of one anchor (and x,y[,z], where
it is), t,anchor,range of several, anchor,x,y[,z], or t,x,y[,z] of the path; metres, and seconds, or ms, us or ns since
1970."""
_TAKEN = {
    "files": ("outliers", "sensor", "q", "dt", "steps", "repair", "max_bytes", *READING),
    "--scenario": ("outliers",),
    "--ranges": ("anchors", "reference", "height", "q", "dt", "max_bytes"),
}
"""Options of each source."""
_OPTIONS = tuple(dict.fromkeys(name for names in _TAKEN.values() for name in names))


def add_source_options(command: argparse.ArgumentParser) -> None:
    """Adds the options of the sources; their defaults are those of the scenarios."""
    add = command.add_argument
    q = "for files and ranges: variance of the change of acceleration that filters assume per step, m^2/s^4 (default: "
    add("files", metavar="FILE", type=Path, nargs="*")
    own = "or your own function that makes one: module:function, or file.py:function"
    add("--scenario", metavar="NAME", help=f"instead of files, one of {', '.join(SCENARIOS)}, {own}")
    add("--ranges", metavar="PATH", type=Path, nargs="+", help="instead of files, recorded ranges")
    add("--outliers", metavar="MODE", help="what is larger in outliers, covariance (default) or std; or bursts (files, "
        "bearings-*), offset (bearings-*), none; for ranges-outliers short (default), nlos, both, none")  # fmt: skip
    add("--sensor", help="for files: bearings (default), radar or position")
    add("--q", type=float, help=f"{q}0.25, for ranges 0.3)")
    add("--dt", type=float, metavar="S", help="for files and ranges: seconds per step (default: 5, for ranges 0.1)")
    add("--steps", type=int, metavar="T", help="for files: steps per window (default: 120)")
    repair = "for files: correct time stamps that are off by seconds, so that speeds are possible (default: --repair)"
    add("--repair", action=argparse.BooleanOptionalAction, help=repair)
    add("--anchors", type=Path, metavar="FILE", help="for ranges: positions of the anchors")
    add("--reference", type=Path, metavar="FILE", help="for ranges: true path of the target")
    height = "for ranges: height of the target, m (default: the median of the path's)"
    add("--height", type=float, metavar="M", help=height)
    add_bound_option(add, default=None)
    add_reading_options(command.add_argument_group("reading files").add_argument)


def scenario_of(options: argparse.Namespace) -> tuple[Scenario, int]:
    """The scenario, and the number of runs.

    Raises:
        ValueError: not exactly one source, an option that does not fit it, or one that is out of its range.
    """
    sources = {"files": options.files, "--scenario": options.scenario, "--ranges": options.ranges}
    chosen = [source for source, value in sources.items() if value]
    if len(chosen) != 1:
        received = " and ".join(chosen) or "none"
        raise ValueError(f"compare: expected one of files, --scenario and --ranges, received {received}")
    (source,) = chosen
    values = {name: getattr(options, name) for name in _OPTIONS if getattr(options, name) is not None}
    for name in sorted(values.keys() - set(_TAKEN[source])):
        expected = " or ".join(other for other, names in _TAKEN.items() if name in names)
        raise ValueError(f"{name}: expected beside {expected}, received beside {source}")
    if source == "--scenario":
        make = load_scenario if is_place(options.scenario) else make_scenario
        scenario = make(options.scenario, **values)
        return scenario, (len(scenario.recordings) or 100) if options.runs is None else options.runs
    bound = {"max_bytes": values.pop("max_bytes", readers.MAX_BYTES)}
    if source == "--ranges":
        return _recorded_ranges(options.ranges, options.runs, bound, **values)
    reading = {name: values.pop(name) for name in READING if name in values}
    recordings = [recording for file in options.files for recording in readers.read(file, **bound, **reading)]
    scenario = scenarios.recorded(recordings, **values)
    windows = int(str(scenario.settings["windows"]))
    return scenario, windows if options.runs is None else options.runs


def _recorded_ranges(
    paths: list[Path], runs: int | None, bound: dict[str, int], anchors: Path | None = None,
    reference: Path | None = None, **values: float,
) -> tuple[Scenario, int]:  # fmt: skip
    """The scenario of recordings in folders, or of one in files."""
    folders = [path for path in paths if path.is_dir()]
    if folders and len(folders) < len(paths):
        raise ValueError("ranges: expected either folders or the files of one recording, received both")
    found = [folder for path in folders for folder in readers.range_folders(path)]
    if reference is not None and len(found) > 1:
        raise ValueError(f"reference: expected one recording beside it, received {len(found)}")
    each: list[Path | list[Path]] = [*found] or [paths]
    recordings = [readers.read_ranges(one, anchors=anchors, reference=reference, **bound) for one in each]
    if runs is not None and runs > len(recordings):
        raise ValueError(f"runs: expected at most one for each of {len(recordings)} recordings, received {runs}")
    scenario = scenarios.recorded_ranges(recordings, **values)
    return scenario, len(recordings) if runs is None else runs
