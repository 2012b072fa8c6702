"""Noise learned by ``torchfra.fit`` beside the OKF of Greenberg, Yannay & Mannor (2023), on their lidar.

    python scripts/okf.py --draws 5 --seed 1 --json out/okf.json
    python scripts/okf.py --draws 1 --tracks 200 --filters 'KF,OKF' --no-compile

Targets, lidar and OKF are those of ``scripts/learned/lidar.py``.  Of the tracks of a draw 70 % are learned from and the
others judge: mean squared error of positions over all their steps, m^2.  A line for each filter: the mean over draws,
the mean ratio to that of the KF, and the median over draws of the seconds that it took to learn, of one core.  The
first draw, in which kernels compile, is beside it.

- KF: noise by sample covariances.
- OKF: by Adam in plain torch from there, as its authors train it: each track of a batch by itself, as theirs, or all
  together.
- fit: the same filter, with as many free numbers, by ``torchfra.fit``.
- lidar, lidar and turn: ``torchfra.fit`` of filters that know that ranges and bearings are measured, and of a motion
  whose turn rate is in the state.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from learned.lidar import (
    BEARING,
    OKF,
    RANGE,
    AnyNoise,
    AnyPosition,
    Tracks,
    mse,
    optimised,
    prior,
    sampled,
    simulate,
    squared,
)
from torch import Tensor

import torchfra
from torchfra import presets
from torchfra.cli.command import (
    add_json_option,
    add_quiet_option,
    check_files,
    check_list,
    exit_status,
    make_parser,
)
from torchfra.fitting import Batch
from torchfra.motion import ConstantVelocity, UnknownTurn
from torchfra.running.atomic_write import write_json
from torchfra.running.progress import progress_bar
from torchfra.running.versions import versions
from torchfra.sensors import RangeBearing
from torchfra.tables import formed_table, significant
from torchfra.types import Estimate, Gaussian

PUBLISHED = {"KF": (808.0, 852.0), "OKF": (674.0, 749.0)}
"""Mean squared errors of two draws that the authors have published, m^2; 27 and 29 s to learn."""
LEARNED = 0.7
"""Share of the tracks that are learned from."""
HELD_OUT, ITERATIONS, PATIENCE = 0.15, 40, 3
"""Of a fit: share of its tracks that are not learned from, iterations at most, validations without improvement."""
RATE_OF_TURN = 0.2
"""Standard deviation of the turn rate at the start, rad/s."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns the exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    names = ",".join(WAYS)
    p.add_argument("--filters", metavar="A,B", default=names, help=f"(default: {names})")
    p.add_argument("--draws", type=int, default=5, metavar="N", help="of tracks (default: 5)")
    p.add_argument("--tracks", type=int, default=1000, metavar="N", help="of a draw (default: 1000)")
    p.add_argument("--iterations", type=int, default=ITERATIONS, metavar="N", help=f"of a fit (default: {ITERATIONS})")
    p.add_argument("--no-compile", action="store_true", help="run interpreted")
    p.add_argument("--seed", type=int, default=1, metavar="S", help="of the first draw (default: 1)")
    add_json_option(p)
    add_quiet_option(p)

    def run() -> None:
        options = p.parse_args(arguments)
        check_list(p, "filters", options.filters, WAYS)
        compare(options)

    return exit_status("okf", run)


def compare(options: argparse.Namespace) -> None:
    """All draws, and the table when the last one is done.

    Raises:
        ValueError: fewer than 1 draw, 20 tracks or 0 iterations.
    """
    check_files({"json": options.json})
    for name, value, least in (
        ("draws", options.draws, 1),
        ("tracks", options.tracks, 20),
        ("iterations", options.iterations, 0),
    ):
        if value < least:
            raise ValueError(f"{name}: expected {least} or more, received {value}")
    names = list(dict.fromkeys(["KF", *options.filters.split(",")]))
    found: dict[str, list[dict[str, float]]] = {name: [] for name in names}
    for draw in progress_bar(range(options.draws), "draw", not options.quiet):
        tracks = simulate(options.tracks, options.seed + draw)
        count = round(LEARNED * options.tracks)
        train, test = tracks.rows(slice(count)), tracks.rows(slice(count, None))
        for name in names:
            begun = time.process_time()
            estimate = WAYS[name](train, options)
            seconds = time.process_time() - begun
            with torch.no_grad():
                found[name].append({"mse": float(mse(estimate(test), test)), "seconds": seconds})
    if not options.quiet:
        print(table(found), flush=True)
    if options.json is not None:
        kept = {name: getattr(options, name) for name in ("draws", "tracks", "iterations", "seed")}
        write_json(options.json, {**kept, "versions": versions(), "found": found, "published": PUBLISHED})


# ---------------------------------------------------------------- ways to learn

Estimates = Callable[[Tracks], Tensor]
"""From tracks to means ``(B, T, n)``."""


def kf(tracks: Tracks, options: argparse.Namespace) -> Estimates:
    """Sample covariances."""
    okf = OKF(tracks)
    return lambda test: okf(test.z)


def okf(tracks: Tracks, options: argparse.Namespace, together: bool = False) -> Estimates:
    """Adam, in plain torch."""
    learned = optimised(OKF(tracks), tracks, options.seed, together=together)
    return lambda test: learned(test.z)


def same(tracks: Tracks, options: argparse.Namespace) -> Estimates:
    """The same filter."""
    process, measurement = sampled(tracks)
    f = presets.srckf(AnyNoise(process), AnyPosition(measurement))
    return fitted(f, tracks, lambda x: x.z, options)


def lidar(tracks: Tracks, options: argparse.Namespace, turns: bool = False) -> Estimates:
    """Ranges and bearings, of a target that goes straight or turns."""
    motion = UnknownTurn(4.0, 0.01) if turns else ConstantVelocity(25.0)
    sensor = RangeBearing(torch.tensor([RANGE, BEARING], dtype=torch.float64))
    return fitted(presets.srckf(motion, sensor), tracks, lambda x: x.polar, options)


def fitted(f: Any, tracks: Tracks, seen: Callable[[Tracks], Tensor], options: argparse.Namespace) -> Estimates:
    """``torchfra.fit`` of all values by the squared error, each step as much as any other."""
    data = {"z": seen(tracks), "prior": started(f, tracks), "truth": tracks.truth, "dt": times(tracks)}
    steps = float((~tracks.truth[..., 0].isnan()).sum(1).double().mean())

    def loss(estimate: Estimate, batch: Batch) -> Tensor:
        return squared(estimate.mean, batch) / steps  # type: ignore[arg-type]  # it has a truth as well

    found = torchfra.fit(
        f, data, learn="all", loss=loss, iterations=options.iterations, held_out=HELD_OUT, patience=PATIENCE,
        polish=False, compile=False if options.no_compile else None, seed=options.seed, quiet=True,
    )  # fmt: skip
    return lambda test: found.filter(seen(test), started(f, test), dt=times(test)).mean


def started(f: Any, tracks: Tracks) -> Gaussian:
    """The belief at the first measurement, before it counts; a turn rate around 0."""
    mean, root = prior(tracks)
    more = f.motion.size - mean.shape[-1]
    pad = torch.nn.functional.pad
    root = pad(root, (0, more, 0, more)) + torch.diag(torch.tensor([0.0] * 4 + [RATE_OF_TURN] * more, dtype=root.dtype))
    return Gaussian(pad(mean, (0, more)), root)


def times(tracks: Tracks) -> Tensor:
    """Seconds ``(T,)`` before each step: the first measurement is at the time of the start."""
    dt = torch.ones(tracks.z.shape[1], dtype=torch.float64)
    dt[0] = 0.0
    return dt


WAYS: dict[str, Callable[[Tracks, argparse.Namespace], Estimates]] = {
    "KF": kf,
    "OKF": okf,
    "OKF together": lambda tracks, options: okf(tracks, options, together=True),
    "fit": same,
    "fit lidar": lidar,
    "fit lidar and turn": lambda tracks, options: lidar(tracks, options, turns=True),
}
"""From tracks to learn from to estimates."""


def table(found: dict[str, list[dict[str, float]]]) -> str:
    """A line for each filter."""
    kf = [draw["mse"] for draw in found["KF"]]
    rows = []
    for name, draws in found.items():
        errors = [draw["mse"] for draw in draws]
        ratios = [error / plain for error, plain in zip(errors, kf, strict=True)]
        seconds = [draw["seconds"] for draw in draws]
        numbers = statistics.mean(errors), statistics.mean(ratios), statistics.median(seconds), seconds[0]
        rows.append([name, *map(significant, numbers)])
    for draw in range(2):
        plain, learned = PUBLISHED["KF"][draw], PUBLISHED["OKF"][draw]
        rows.append([f"OKF, published, KF {plain:g}", significant(learned), significant(learned / plain), "", ""])
    return formed_table("markdown", ["", "MSE m^2", "ratio", "s", "first s"], rows)


if __name__ == "__main__":
    sys.exit(main())
