"""How far presets are from the truth on recordings for which others have published figures.

    python scripts/recordings.py nclt 2012-11-16.csv 2013-04-05.csv --json out/nclt.json --figure out/nclt.png
    python scripts/recordings.py nclt 2012-11-16.csv --network 2013-01-10.csv 2013-02-23.csv --filters gpb
    python scripts/recordings.py uwb LOS/Trajectory_A/Case_1 NLOS/Trajectory_B/Case_3 --filters gpb,rsrckf
    python scripts/recordings.py autoferry scenario2_detections.json.gz --figure out/harbour.png

Kinds, each with one setting of motion, sensor and filters for all of its recordings:

- nclt: a robot on a campus, a CSV file for each day: wheels, a measured heading, which they steady, and satellite
  positions; it has ``imm`` too, with the errors of positions as interacting models;
- uwb: ranges from anchors to a tag on a cart, a folder for each run, with the path that was driven;
- smartloc: pseudoranges of satellites to a car among high buildings, NAME_Input.txt with NAME_GT.txt beside it; it has
  ``gpb_odometry`` too, with the car's speed and turn rate;
- autoferry: two boats in a harbour among land and other boats, NAME_detections.json with NAME_groundTruth.json beside
  it, gzipped or not; filters are the sensors, ``radar`` and ``radar_lidar``, and errors are those of sets of targets.

A table has for each recording what presets reach beside what others have published: the root mean square error, on line
and smoothed, per axis or of the distance as the published figures are, and the normalised estimation error squared of
positions per dimension, on line and smoothed, which is 1 where covariances are consistent; and the percentage of steps
whose error is beyond the protection level of 1e-3.  Covariances of filters that take errors for white contain a bias
that lasts for the whole recording.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

from lists import check_list
from recorded_bench import autoferry, nclt, smartloc, uwb
from recorded_bench.tracks import Figures, Followed, followed, judged, picture

from torchfra.catalogue import track_filters
from torchfra.cli.command import Failures, add_output_options, check_files, exit_status, make_parser
from torchfra.cli.compiling import add_compile_option, choose, reporters
from torchfra.evaluation.compiling import compiled
from torchfra.filters import Filter
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.tables import significant, text_table

KINDS = {"nclt": nclt, "uwb": uwb, "smartloc": smartloc, "autoferry": autoferry}
DEFAULT = "gpb,rsrckf,srckf"
NETWORK = "network"
"""What the estimates are called that a network has weighed."""
WORTHWHILE = 3000
"""Steps of all tracks from which on compiling saves time."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("kind", choices=KINDS, help="what the recordings are")
    p.add_argument("files", nargs="+", type=Path, metavar="FILE", help="a recording each: a file, of uwb a folder")
    p.add_argument("--filters", metavar="A,B", help=f"presets (default: {DEFAULT}, and what a kind has besides)")
    p.add_argument("--network", nargs="+", type=Path, metavar="FILE", help="nclt: days that a network learns from "
                   "which of gpb and imm is nearer now; the table has their estimates so weighed too")  # fmt: skip
    p.add_argument("--seed", type=int, default=0, metavar="S", help="of the network (default: 0)")
    add_compile_option(p, f"for {WORTHWHILE:,} steps or more")
    p.add_argument("--figure", type=Path, metavar="FILE", help="PNG: path and error over time of each recording")
    add_output_options(p)

    def run() -> None:
        options = p.parse_args(arguments)
        own, sets = KINDS[options.kind].OWN_PRESETS, options.kind == "autoferry"
        options.filters = options.filters or ",".join(own if sets else [*own, DEFAULT])
        check_list(p, "filters", options.filters, own if sets else [*track_filters(), *own])
        compare(options)

    return exit_status("recordings", run)


def compare(options: argparse.Namespace) -> None:
    """Runs all filters on all recordings; the table when the last one is done.

    Raises:
        ValueError: two recordings of one name, or a file that is no such recording.
    """
    check_files({"json": options.json, "figure": options.figure}, options.files)
    kind, names = KINDS[options.kind], list(dict.fromkeys(options.filters.split(",")))
    tracks = [kind.read(path) for path in options.files]
    if twice := {track.name for track in tracks if sum(other.name == track.name for other in tracks) > 1}:
        raise ValueError(f"files: expected each recording once, received {', '.join(sorted(twice))} several times")
    tell, _ = reporters(options.compile, options.quiet)
    if options.network is not None and kind is not nclt:
        raise ValueError(f"network: expected recordings of nclt, received {options.kind}")
    several = kind is autoferry
    compile = not several and choose(options.compile, sum(len(track.z) for track in tracks) >= WORTHWHILE, tell)
    found: dict[str, dict[str, Any]] = {track.name: {} for track in tracks}
    if options.network is not None:
        days = [nclt.read(path) for path in options.network]
        both = [nclt.make(name, days[0])[0] for name in nclt.MIXED]
        mixture = nclt.learned_mixture(
            days,
            [ready(f, name, options) for f, name in zip(both, nclt.MIXED, strict=True)] if compile else both,
            options.seed,
            lambda steps: progress_bar(steps, "learning", not options.quiet),
        )
        names.append(NETWORK)

    def follow(name: str, track: Any, bias: float | None = None) -> Followed:
        f, prior = kind.make(name, track)
        return followed(ready(f, name, options) if compile else f, prior, track, kind.UNNOTICED, bias)

    for track, name in progress_bar([(t, n) for t in tracks for n in names], "filter", not options.quiet):
        if several:
            found[track.name][name] = autoferry.follow(name, track)
            continue
        if name == NETWORK:
            of = mixture(track, [follow(one, track) for one in nclt.MIXED])
        else:
            of = follow(name, track, None if name in kind.IN_STATE else kind.BIAS)
        found[track.name][name] = judged(of, track, kind.METRIC)
    write(options, tracks, found)


def ready(f: Filter, name: str, options: argparse.Namespace) -> Filter:
    """A filter that runs compiled, or as it is where it has no kernel and none is wanted by all means."""
    _, fallback = reporters(options.compile, options.quiet)
    return compiled({name: f}, lambda f: None, fallback=fallback)[name]


def write(options: argparse.Namespace, tracks: list[Any], found: dict[str, dict[str, Any]]) -> None:
    """Prints the table, writes files, and complains of what is not finite."""
    kind, failures = KINDS[options.kind], Failures()
    if not options.quiet:
        print(f"{table(kind, tracks, found)}\n{kind.NOTE}", flush=True)
    figures = {name: of_filters(of) for name, of in found.items()}
    published = {track.name: {kind.METRIC: track.published} for track in tracks}
    with failures.of("json"):
        write_results(options.json, {options.kind: figures, "published": published})
    if options.figure is not None:
        from torchfra import plotting  # matplotlib takes long to import

        with failures.of("figure"):
            plotting.save((autoferry.picture if kind is autoferry else picture)(tracks, found), options.figure)
    failures.messages += [
        f"{track}, {name}: an error that is not finite"
        for track, of in found.items()
        for name, one in of.items()
        if not all(math.isfinite(value) for value in one.figures.values())
    ]
    failures.end()


def table(kind: Any, tracks: list[Any], found: dict[str, dict[str, Any]]) -> str:
    """A row for each recording, and one of means where there are several; columns of presets and of others."""
    names, figures = list(found[tracks[0].name]), {name: of_filters(of) for name, of in found.items()}
    others = list(dict.fromkeys(method for track in tracks for method in track.published))
    parts = kind.PARTS
    header = ["recording", *(f"{name} {part}" for name in names for part in parts), *others]
    rows = [
        [track.name, *(significant(figures[track.name][name][part]) for name in names for part in parts),
         *(significant(track.published.get(method, math.nan)) for method in others)]
        for track in tracks
    ]  # fmt: skip
    if len(tracks) > 1:
        own = [fmean(figures[track.name][name][part] for track in tracks) for name in names for part in parts]
        of_others = [fmean(track.published.get(method, math.nan) for track in tracks) for method in others]
        rows.append(["mean", *map(significant, [*own, *of_others])])
    return text_table(header, rows)


def of_filters(of: dict[str, Any]) -> dict[str, Figures]:
    """The figures alone."""
    return {name: one.figures for name, one in of.items()}


if __name__ == "__main__":
    sys.exit(main())
