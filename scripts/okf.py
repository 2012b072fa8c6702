"""Noise learned by ``torchfra.fit`` beside the OKF of Greenberg, Yannay & Mannor (2023), on their lidar.

    python scripts/okf.py --draws 5 --seed 1 --json out/okf.json
    python scripts/okf.py --draws 1 --tracks 200 --filters 'KF,OKF' --no-compile

Targets, sensor and OKF are those of ``scripts/learned/{lidar,okf}.py``.  Of the tracks of a draw 70 % are learned from
and the others judge: mean squared error of positions over all their steps, m^2.  A line for each filter: the mean over
draws, the mean ratio to that of the KF, and the median over draws of the seconds that it took to learn, of one core.
The first draw, in which kernels compile, is beside it.

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
from functools import partial
from typing import Any

import torch
from learned import lidar
from learned.okf import OKF, AnyNoise, Tracks, mse, optimised, prior, sampled, squared
from lists import check_list
from torch import Tensor

import torchfra
from torchfra import presets
from torchfra.cli.command import add_output_options, check_files, check_least, exit_status, make_parser
from torchfra.fitting import Batch
from torchfra.motion import ConstantVelocity, UnknownTurn
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.sensors import RangeBearing
from torchfra.tables import formed_table, significant
from torchfra.types import Estimate, Gaussian

PUBLISHED = {"KF": (808.0, 852.0), "OKF": (674.0, 749.0)}
"""Mean squared errors on the lidar of two draws that the authors have published, m^2; 27 and 29 s to learn."""
HELD_OUT, ITERATIONS, PATIENCE = 0.15, 40, 3
"""Of a fit: share of its tracks that are not learned from, iterations at most, validations without improvement."""
RATE_OF_TURN = 0.2
"""Standard deviation of the turn rate at the start, rad/s."""
LEARNED = 0.7
"""Share of the tracks that are learned from."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns the exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("--filters", metavar="A,B", help=f"of {', '.join(WAYS)} (default: all)")
    p.add_argument("--draws", type=int, default=5, metavar="N", help="of tracks (default: 5)")
    p.add_argument("--tracks", type=int, default=1000, metavar="N", help="of a draw (default: 1000)")
    p.add_argument("--iterations", type=int, default=ITERATIONS, metavar="N", help=f"of a fit (default: {ITERATIONS})")
    p.add_argument("--no-compile", action="store_true", help="run interpreted")
    p.add_argument("--seed", type=int, default=1, metavar="S", help="of the first draw (default: 1)")
    add_output_options(p)

    def run() -> None:
        options = p.parse_args(arguments)
        check_list(p, "filters", options.filters or "KF", WAYS)
        compare(options)

    return exit_status("okf", run)


def compare(options: argparse.Namespace) -> None:
    """All draws, and the table when the last one is done.

    Raises:
        ValueError: fewer than 1 draw, 20 tracks or 0 iterations.
    """
    check_files({"json": options.json})
    check_least(options, draws=1, tracks=20, iterations=0)
    found: dict[str, list[dict[str, float]]] = {}
    for draw in progress_bar(range(options.draws), "draw", not options.quiet):
        for way, figures in of_draw(options.seed + draw, options).items():
            found.setdefault(way, []).append(figures)
    if not options.quiet:
        print(table(found))
    kept = {name: getattr(options, name) for name in ("draws", "tracks", "iterations", "seed")}
    write_results(options.json, {**kept, "found": found, "published": PUBLISHED})


def of_draw(seed: int, options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Error and seconds of each filter on the tracks of a seed."""
    tracks, count = lidar.simulate(options.tracks, seed), round(LEARNED * options.tracks)
    train, test = tracks.rows(slice(count)), tracks.rows(slice(count, None))
    asked = list(WAYS) if options.filters is None else ["KF", *options.filters.split(",")]
    figures = {}
    for name in [name for name in WAYS if name in asked]:
        begun = time.process_time()
        estimate = WAYS[name](train, options)
        seconds = time.process_time() - begun
        with torch.no_grad():
            figures[name] = {"mse": float(mse(estimate(test), test)), "seconds": seconds}
    return figures


# ---------------------------------------------------------------- ways to learn

Estimates = Callable[[Tracks], Tensor]
"""From tracks to means ``(B, T, n)``."""
Way = Callable[[Tracks, argparse.Namespace], Estimates]
"""From tracks to learn from to estimates."""


def given(f: Any, z: Tensor, tracks: Tracks) -> dict[str, Any]:
    """Arguments of a filter: the first measurement is at the time of the start, where a turn rate is around 0."""
    dt = torch.ones(z.shape[1], dtype=torch.float64)
    dt[0] = 0.0
    mean, root = prior(tracks)
    more = f.motion.size - mean.shape[-1]
    pad = torch.nn.functional.pad
    rates = torch.diag(pad(torch.full((more,), RATE_OF_TURN, dtype=dt.dtype), (mean.shape[-1], 0)))
    return {"z": z, "prior": Gaussian(pad(mean, (0, more)), pad(root, (0, more, 0, more)) + rates), "dt": dt}


def kf(tracks: Tracks, options: argparse.Namespace) -> Estimates:
    """Sample covariances."""
    sampled_noise = OKF(tracks)
    return lambda test: sampled_noise(test.z)


def okf(tracks: Tracks, options: argparse.Namespace, *, together: bool) -> Estimates:
    """Adam, in plain torch."""
    learned = optimised(OKF(tracks), tracks, options.seed, together=together)
    return lambda test: learned(test.z)


def fitted(f: Any, measured: Callable[[Tensor], Tensor], tracks: Tracks, options: argparse.Namespace) -> Estimates:
    """``torchfra.fit`` of all values by the squared error, each step as much as any other.

    Args:
        f: the filter.
        measured: from positions to what it is given.
        tracks: to learn from.
        options: of the command.
    """
    steps = float(tracks.lasts.sum(1).double().mean())

    def loss(estimate: Estimate, batch: Batch) -> Tensor:
        return squared(estimate.mean, batch) / steps  # type: ignore[arg-type]  # it has a truth as well

    learned = torchfra.fit(
        f, {**given(f, measured(tracks.z), tracks), "truth": tracks.truth}, learn="all", loss=loss,
        iterations=options.iterations, held_out=HELD_OUT, patience=PATIENCE, polish=False,
        compile=False if options.no_compile else None, seed=options.seed, quiet=True,
    ).filter  # fmt: skip
    return lambda test: learned(**given(learned, measured(test.z), test)).mean


def same(tracks: Tracks, options: argparse.Namespace) -> Estimates:
    """The Kalman filter of positions, with noise by ``torchfra.fit``."""
    process, measurement = sampled(tracks)
    f = presets.srckf(AnyNoise(process), lidar.AnyPosition(measurement))
    return fitted(f, lambda z: z, tracks, options)


def with_lidar(tracks: Tracks, options: argparse.Namespace, turns: bool = False) -> Estimates:
    """Ranges and bearings, of a target that goes straight or turns."""
    motion = UnknownTurn(4.0, 0.01) if turns else ConstantVelocity(25.0)
    sensor = RangeBearing(torch.tensor([lidar.RANGE, lidar.BEARING], dtype=torch.float64))
    return fitted(presets.srckf(motion, sensor), lidar.polar, tracks, options)


WAYS: dict[str, Way] = {
    "KF": kf,
    "OKF": partial(okf, together=False),
    "OKF together": partial(okf, together=True),
    "fit": same,
    "fit lidar": with_lidar,
    "fit lidar and turn": partial(with_lidar, turns=True),
}


def table(found: dict[str, list[dict[str, float]]]) -> str:
    """A line for each filter, and for each published draw."""
    kf = [draw["mse"] for draw in found["KF"]]
    rows = []
    for name, draws in found.items():
        errors = [draw["mse"] for draw in draws]
        ratios = [error / plain for error, plain in zip(errors, kf, strict=True)]
        seconds = [draw["seconds"] for draw in draws]
        numbers = statistics.mean(errors), statistics.mean(ratios), statistics.median(seconds), seconds[0]
        rows.append([name, *map(significant, numbers)])
    for plain, learned in zip(*PUBLISHED.values(), strict=True):
        rows.append([f"OKF, published, KF {plain:g}", significant(learned), significant(learned / plain), "", ""])
    return formed_table("markdown", ["", "MSE m^2", "ratio", "s", "first s"], rows)


if __name__ == "__main__":
    sys.exit(main())
