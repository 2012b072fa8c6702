"""Many targets with initiation and deletion of tracks: how well they are followed, and how fast.

    python scripts/targets.py --runs 200 --seed 7 --json out/targets.json --picture out/targets.png

- many: ten aircraft in clutter, ``scenarios.clutter_many``;
- recorded: flights over Switzerland (sample tracks of the package ``traffic``) as recorded: positions with a standard
  deviation of 50 m every 5 s, of which 10 % are missing, among 300 false ones per scan;
- folded: all flights of that day at once, moved by whole half hours into one;
- crowd: 200 targets in a square of 100 km and 300 false measurements per scan, 1 s apart.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import torch
from lists import check_list
from matplotlib.figure import Figure
from torch import Tensor

from torchfra import metrics, presets, readers, scenarios
from torchfra.association import ChiSquare, Clutter
from torchfra.cli.command import add_output_options, add_runs_options, check_files, exit_status, make_parser
from torchfra.motion import ConstantVelocity
from torchfra.plotting import save
from torchfra.readers import Recording, resample
from torchfra.running.versions import write_results
from torchfra.sensors import Position
from torchfra.tables import text_table
from torchfra.targets import Deletion, Merging, Targets, TwoPoint, collect

WHAT = ("many", "recorded", "folded", "crowd")
DT = 5.0
"""Seconds between scans of the recorded flights."""
CROWD = 120
"""Scans of the crowd, after which it would have left the square."""
AT_ONCE, PART = 20, 10
"""Runs that are simulated side by side, and scans that are compared with the truth at once."""
DETECTION, FALSE = 0.9, 300
"""Probability that a target is measured, and expected false measurements per scan."""
STD = 50.0
"""Standard deviation of the positions, m."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the tables; returns the exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    add_runs_options(p, 200, 7)
    p.add_argument("--what", default=",".join(WHAT), metavar="A,B", help=f"some of {', '.join(WHAT)} (default: all)")
    p.add_argument("--scans", type=int, default=360, metavar="T", help="of the recorded flights (default: 360)")
    p.add_argument("--picture", type=Path, metavar="FILE", help="draw the recorded flights, else the folded ones")
    p.add_argument("--compile", action="store_true", help="run filters compiled to machine code")
    add_output_options(p)
    options = p.parse_args(arguments)
    check_list(p, "what", options.what, WHAT)
    if options.scans < 2:
        p.error(f"--scans: expected 2 or more, received {options.scans}")
    return exit_status("targets", lambda: compare(options))


def compare(options: argparse.Namespace) -> None:
    """Runs the chosen parts, prints and writes."""
    check_files({"json": options.json, "picture": options.picture})
    what, found = options.what.split(","), {}
    flights = swiss_traffic() if {"recorded", "folded"} & set(what) else []
    worlds = {name: recorded(flights, options.seed, DT, options.scans, folded=name == "folded")
              for name in ("folded", "recorded") if name in what}  # fmt: skip
    with torch.no_grad():
        if "many" in what:
            found["many"] = many(options.runs, options.seed, options.compile)
        for name, world in worlds.items():
            found[name], estimate = streamed(world, options.compile)
            if options.picture is not None:
                save(picture(world, estimate), options.picture)
        if "crowd" in what:
            found["crowd"] = streamed(crowd(options.seed, min(options.scans, CROWD)), options.compile)[0]
    if not options.quiet:
        keys = list(dict.fromkeys(key for figures in found.values() for key in figures))
        rows = [[key, *(f"{of[key]:.4g}" if key in of else "" for of in found.values())] for key in keys]
        print(text_table(["", *found], rows))
    settings = {"runs": options.runs, "seed": options.seed, "scans": options.scans}
    write_results(options.json, {"settings": settings, **found})


def many(runs: int, seed: int, compiled: bool) -> dict[str, float]:
    """Ten aircraft in clutter."""
    scenario = scenarios.clutter_many()
    f = presets.jpda(scenario.motion, scenario.sensor, clutter=scenario.clutter, detection=scenario.detection,
                     gate=ChiSquare(0.99999))  # fmt: skip
    f = f.compile() if compiled else f
    targets = Targets(f, birth=TwoPoint(80.0), deletion=Deletion(4), merging=Merging())
    parts = []
    for first in range(0, runs, AT_ONCE):
        tracks = scenario.simulate(min(AT_ONCE, runs - first), seed, first=first)
        estimate = scenario.cartesian(targets(tracks.z, dt=scenario.dt))
        parts.append(numbers(estimate.mean, tracks.truth, scenario.truth_position, 100.0))
    return summary({key: torch.cat([part[key] for part in parts]) for key in parts[0]})


def streamed(world: World, compiled: bool = False) -> tuple[dict[str, float], Tensor]:
    """One scan after the other, each timed; also the means of all targets ``(K, T, n)``."""
    if compiled:
        world.targets.filter.compile()
    states, times = [world.targets.init()], []
    for scan in world.scans:
        start = time.process_time()
        states.append(world.targets.step(states[-1], scan, dt=world.dt))
        times.append(time.process_time() - start)
    estimate = collect(states[1:])
    found = summary(numbers(estimate.mean[None], world.truth[None], slice(0, 2), world.cutoff))
    took = 1e3 * torch.tensor(times[5:] or times)  # the first ones import what they need
    tracks = torch.tensor([float(len(state.track.identity)) for state in states[1:]])
    found["targets at once"] = float((~world.truth.isnan().any(-1)).sum(0).max())
    found["tracks at once, tentative ones counted, median"] = float(tracks.median())
    for name, share in (("median", 0.5), ("99 %", 0.99), ("largest", 1.0)):
        found[f"ms per scan, {name}"] = float(took.quantile(share))
    return found, estimate.mean


def numbers(mean: Tensor, truth: Tensor, states: slice, cutoff: float) -> dict[str, Tensor]:
    """What became of the targets of each run ``(R, ...)``, to be summed up."""
    scans = zip(mean.split(PART, -2), truth.split(PART, -2), strict=True)
    parts = [metrics.gospa(*part, states, cutoff=cutoff)._asdict() for part in scans]
    gospa = {f"GOSPA, {name}, m": torch.cat([part[name] for part in parts], -1).mean(-1) for name in parts[0]}
    lives = metrics.lives(mean, truth, states, cutoff=cutoff)
    of_targets = ("length", "followed", "longest", "switches", "breaks")
    counts = {name: getattr(lives, name).sum(-1) for name in of_targets}
    tracks = {"track_length": lives.track_length.sum(-1), "false": lives.false.sum(-1)}
    return gospa | counts | tracks | {
        "begun": lives.begun.nanmean(-1), "targets": (lives.length > 0).sum(-1),
        "false_tracks": lives.false_tracks, "missed_targets": lives.missed_targets,
    }  # fmt: skip


def summary(of: dict[str, Tensor]) -> dict[str, float]:
    """Figures of all runs together."""
    total = {key: float(value.double().sum()) for key, value in of.items()}
    found = {key: float(value.mean()) for key, value in of.items() if key.startswith("GOSPA")}
    lives = max(total["length"], 1.0)  # of no scan if runs end before any target is there
    return found | {
        "runs without a switch of identity": float((of["switches"] == 0).double().mean()),
        "targets": total["targets"],
        "switches": total["switches"],
        "breaks": total["breaks"],
        "missed targets": total["missed_targets"],
        "false tracks": total["false_tracks"],
        "share of a target's life in which it is followed": total["followed"] / lives,
        "share that one track follows it for": total["longest"] / lives,
        "scans until it is confirmed": float(of["begun"].nanmean()),
        "share of the tracks' scans that are false": total["false"] / max(total["track_length"], 1.0),
    }


# ---------------------------------------------------------------- worlds with many targets


class World(NamedTuple):
    """Truth and scans, and the manager for them."""

    truth: Tensor
    """``(M, T, 2 or 4)`` positions, NaN where a target is not there."""
    scans: list[Tensor]
    """Scans ``(J, 2)``."""
    dt: float
    targets: Targets
    cutoff: float
    """Distance from which on a target is not followed, m."""


def recorded(flights: Sequence[Recording], seed: int, dt: float, scans: int, *, folded: bool) -> World:
    """Aircraft as recorded, from the middle of the recorded time on.

    Args:
        flights: without gaps, see ``torchfra.readers.flyable``.
        seed: of the measurements.
        dt: seconds between scans.
        scans: how many.
        folded: whether all flights are moved by a whole multiple of that time, so that they begin in it.

    Raises:
        ValueError: no flight is there for two scans.
    """
    start, end = min(f.time[0] for f in flights), max(f.time[-1] for f in flights)
    grid, rows = (start + end - dt * scans) / 2 + dt * np.arange(scans), []
    for flight in flights:
        ((time, position),) = resample(flight, 1.0, max_gap=math.inf)
        time = time - folded * dt * scans * ((time[0] - grid[0]) // (dt * scans))
        inside = (grid >= time[0]) & (grid <= time[-1])
        if inside.sum() >= 2:
            axes = [np.interp(grid, time, x) for x in position[:, :2].T]
            rows.append(np.where(inside[:, None], np.stack(axes, -1), np.nan))
    if not rows:
        raise ValueError(
            f"scans: expected so many, {dt:g} s apart, that a flight is there in two of them, received {scans} in the "
            f"middle of {end - start:g} s"
        )
    truth = torch.from_numpy(np.stack(rows))
    corners = truth.nan_to_num(nan=math.inf).amin((0, 1)), truth.nan_to_num(nan=-math.inf).amax((0, 1))
    return _world(truth, corners, seed, dt, q=4.0, speed=350.0)


def crowd(seed: int, scans: int, count: int = 200, width: float = 100e3) -> World:
    """Targets of up to 300 m/s with accelerations of 1 m/s^2 in a square, all of them there from the first scan on."""
    rng, dt = np.random.default_rng([seed, 0]), 1.0
    motion = ConstantVelocity(1.0)
    matrix = motion.transition(torch.tensor(dt, dtype=torch.float64)).numpy()
    speed, course = rng.uniform(50, 300, count), rng.uniform(0, 2 * np.pi, count)
    velocity = speed[:, None] * np.stack([np.sin(course), np.cos(course)], -1)
    state, rows = np.concatenate([rng.uniform(0, width, (count, 2)), velocity], -1), []
    for _ in range(scans):
        push = rng.standard_normal((count, 2))
        state = state @ matrix.T + np.concatenate([push / 2, push], -1)
        rows.append(state)
    corners = torch.zeros(2).double(), torch.full((2,), width).double()
    return _world(torch.from_numpy(np.stack(rows, 1)), corners, seed, dt, q=1.0, speed=350.0)


def _world(truth: Tensor, corners: tuple[Tensor, Tensor], seed: int, dt: float, q: float, speed: float) -> World:
    """Scans in any order of what is measured of the truth, and of false measurements anywhere."""
    rng, (low, high), scans = np.random.default_rng([seed, 1]), corners, []
    for position in truth[..., :2].unbind(1):
        measured = position[~position.isnan().any(-1)].numpy()
        measured = measured[rng.random(len(measured)) < DETECTION]
        measured = measured + STD * rng.standard_normal(measured.shape)
        false = rng.uniform(low.numpy(), high.numpy(), (rng.poisson(FALSE), 2))
        scans.append(torch.from_numpy(rng.permutation(np.concatenate([measured, false]))))
    clutter = Clutter(volume=float((high - low).prod()), rate=float(FALSE))
    f = presets.jpda(ConstantVelocity(q), Position(STD), clutter=clutter, detection=DETECTION, gate=ChiSquare(0.99999))
    manager = Targets(f, birth=TwoPoint(speed), deletion=Deletion(5), merging=Merging())
    return World(truth, scans, dt, manager, 10 * STD)


def swiss_traffic() -> list[Recording]:
    """All flights of a day over Switzerland, of the sample tracks that come with the package ``traffic``.

    Gaps of a minute split them, and their time stamps are mended: ``torchfra.readers.flyable``.

    Raises:
        ImportError: the package is not installed.
    """
    (file,) = (file for file in readers.samples("collections") if file.name.startswith("switzerland"))
    return [piece for recording in readers.read(file) for piece in readers.flyable(recording, max_gap=60.0)]


def picture(world: World, mean: Tensor) -> Figure:
    """The scans, the truth, and the targets ``(K, T, n)`` that were found, each identity in a colour; km."""
    figure = Figure(figsize=(12, 6), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    left.set_title(f"what is measured: a tenth of the {len(world.scans)} scans")
    for scan in world.scans[::10]:
        left.plot(*(scan / 1e3).T, ".", color="black", markersize=0.6, alpha=0.5, rasterized=True)
    right.set_title(f"{len(mean)} targets found (colours), {len(world.truth)} true ones (grey, below)")
    colours = matplotlib.colormaps["tab20"].colors  # type: ignore[attr-defined]
    for track in world.truth:
        right.plot(*(track[:, :2] / 1e3).T, color="lightgrey", linewidth=3)
    for i, track in enumerate(mean):
        right.plot(*(track[:, :2] / 1e3).T, color=colours[i % len(colours)], linewidth=0.8)
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.set_xlabel("east, km")
    left.set_ylabel("north, km")
    return figure


if __name__ == "__main__":
    sys.exit(main())
