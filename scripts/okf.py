"""Noise learned by ``torchfra.fit`` beside the OKF of Greenberg, Yannay & Mannor (2023), on their lidar and radar.

    python scripts/okf.py --draws 5 --seed 1 --json out/okf.json
    python scripts/okf.py --problems toy,close,const_v,const_a,free --draws 3 --seed 1 --json out/okf-radar.json
    python scripts/okf.py --draws 1 --tracks 200 --filters 'KF,OKF' --no-compile

Targets, sensors and OKF are those of ``scripts/learned/{lidar,radar,okf}.py``.  Of the tracks of a draw 70 % (lidar) or
60 % (radar) are learned from and the others judge: mean squared error of positions over all their steps, m^2.  A line
for each filter: the mean over draws, the mean ratio to that of the KF, and the median over draws of the seconds that it
took to learn, of one core.  The first draw, in which kernels compile, is beside it.

- KF: noise by sample covariances.
- OKF: by Adam in plain torch from there, as its authors train it: each track of a batch by itself, as theirs, or all
  together.
- fit: the same filter, with as many free numbers, by ``torchfra.fit``.
- lidar, lidar and turn: ``torchfra.fit`` of filters that know that ranges and bearings are measured, and of a motion
  whose turn rate is in the state.
- radar: ``torchfra.fit`` of a filter that knows what the radar measures, from its data sheet and the sampled process
  noise; gpb: around what this has learned.
- converted: the same noise, of positions, turned to where each target is measured.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from learned import lidar, radar
from learned.okf import OKF, AnyNoise, Model, Tracks, mse, optimised, prior, sampled, squared
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
LASTING = 10.0
"""Factor on the sampled process noise that a fit begins with: accelerations last for many steps, noise does not."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns the exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("--problems", metavar="A,B", default="lidar", help=f"of {', '.join(PROBLEMS)} (default: lidar)")
    p.add_argument("--filters", metavar="A,B", help=f"of {', '.join(WAYS)} (default: all of a problem)")
    p.add_argument("--draws", type=int, default=5, metavar="N", help="of tracks (default: 5)")
    p.add_argument("--tracks", type=int, metavar="N", help="of a draw (default: 1000 of the lidar, 2500 of the radar)")
    p.add_argument("--iterations", type=int, default=ITERATIONS, metavar="N", help=f"of a fit (default: {ITERATIONS})")
    p.add_argument("--no-compile", action="store_true", help="run interpreted")
    p.add_argument("--seed", type=int, default=1, metavar="S", help="of the first draw (default: 1)")
    add_output_options(p)

    def run() -> None:
        options = p.parse_args(arguments)
        check_list(p, "problems", options.problems, PROBLEMS)
        check_list(p, "filters", options.filters or "KF", WAYS)
        compare(options)

    return exit_status("okf", run)


def compare(options: argparse.Namespace) -> None:
    """All draws, and the tables when the last one is done.

    Raises:
        ValueError: fewer than 1 draw, 20 tracks or 0 iterations.
    """
    check_files({"json": options.json})
    check_least(options, draws=1, tracks=20, iterations=0)
    chosen = dict.fromkeys(options.problems.split(","))
    cells = [(name, draw) for name in chosen for draw in range(options.draws)]
    found: dict[str, dict[str, list[dict[str, float]]]] = {}
    for name, draw in progress_bar(cells, "draw", not options.quiet):
        for way, figures in of_draw(PROBLEMS[name], options.seed + draw, options).items():
            found.setdefault(name, {}).setdefault(way, []).append(figures)
    if not options.quiet:
        for name, ways in found.items():
            print(f"{name}\n\n{table(ways, PUBLISHED if name == 'lidar' else {})}\n", flush=True)
    kept = {name: getattr(options, name) for name in ("draws", "tracks", "iterations", "seed")}
    write_results(options.json, {**kept, "found": found, "published": PUBLISHED})


def of_draw(problem: Problem, seed: int, options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Error and seconds of each filter on the tracks of a seed."""
    runs = problem.tracks if options.tracks is None else options.tracks
    tracks, count = problem.simulate(runs, seed), round(problem.learned * runs)
    train, test = tracks.rows(slice(count)), tracks.rows(slice(count, None))
    asked = list(problem.ways) if options.filters is None else ["KF", *options.filters.split(",")]
    figures = {}
    for name in [name for name in problem.ways if name in asked]:
        begun = time.process_time()
        estimate = problem.ways[name](train, options)
        seconds = time.process_time() - begun
        with torch.no_grad():
            figures[name] = {"mse": float(mse(estimate(test), test)), "seconds": seconds}
    return figures


# ---------------------------------------------------------------- ways to learn

Estimates = Callable[[Tracks], Tensor]
"""From tracks to means ``(B, T, n)``."""
Way = Callable[[Tracks, argparse.Namespace], Estimates]
"""From tracks to learn from to estimates."""


class Problem(NamedTuple):
    """Targets that a sensor sees, and filters for them."""

    simulate: Callable[[int, int], Tracks]
    """From a number and a seed."""
    tracks: int
    learned: float
    """Share of the tracks that are learned from."""
    ways: dict[str, Way]


class Task(NamedTuple):
    """What a filter of this library is given of tracks."""

    z: Callable[[Tracks], Tensor]
    prior: Callable[[Tracks], Gaussian]
    """Of the states that the motion of a Kalman filter has."""
    u: Callable[[Tracks], Tensor | None] = lambda tracks: None

    def of(self, f: Any, tracks: Tracks) -> dict[str, Any]:
        """Arguments of a filter: the first measurement is at the time of the start, where a turn rate is around 0."""
        dt = torch.ones(tracks.z.shape[1], dtype=torch.float64)
        dt[0] = 0.0
        mean, root = self.prior(tracks)
        more = f.motion.size - mean.shape[-1]
        pad = torch.nn.functional.pad
        rates = torch.diag(pad(torch.full((more,), RATE_OF_TURN, dtype=dt.dtype), (mean.shape[-1], 0)))
        begins = Gaussian(pad(mean, (0, more)), pad(root, (0, more, 0, more)) + rates)
        given = {"z": self.z(tracks), "prior": begins, "dt": dt, "u": self.u(tracks)}
        return {name: x for name, x in given.items() if x is not None}


def kf(model: Model, tracks: Tracks, options: argparse.Namespace) -> Estimates:
    """Sample covariances."""
    sampled_noise = OKF(tracks, model)
    return lambda test: sampled_noise(test.z)


def okf(model: Model, tracks: Tracks, options: argparse.Namespace, *, together: bool) -> Estimates:
    """Adam, in plain torch."""
    learned = optimised(OKF(tracks, model), tracks, options.seed, together=together)
    return lambda test: learned(test.z)


def plain(model: Model) -> dict[str, Way]:
    """Sample covariances, and the OKF, of each track by itself or of a batch."""
    return {
        "KF": partial(kf, model),
        "OKF": partial(okf, model, together=False),
        "OKF together": partial(okf, model, together=True),
    }


def fitted(f: Any, task: Task, tracks: Tracks, options: argparse.Namespace, around: Any = None) -> Estimates:
    """``torchfra.fit`` of all values by the squared error, each step as much as any other.

    Args:
        f: the filter.
        task: what it is given.
        tracks: to learn from.
        options: of the command.
        around: of a motion and a sensor a filter that takes what these have learned.
    """
    steps = float(tracks.lasts.sum(1).double().mean())

    def loss(estimate: Estimate, batch: Batch) -> Tensor:
        return squared(estimate.mean, batch) / steps  # type: ignore[arg-type]  # it has a truth as well

    found = torchfra.fit(
        f, {**task.of(f, tracks), "truth": tracks.truth}, learn="all", loss=loss, iterations=options.iterations,
        held_out=HELD_OUT, patience=PATIENCE, polish=False, compile=False if options.no_compile else None,
        seed=options.seed, quiet=True,
    ).filter  # fmt: skip
    learned: Any = found if around is None else around(found.motion, found.sensor)
    if around is not None and not options.no_compile:
        learned.compile()
    return lambda test: learned(**task.of(learned, test)).mean


def same_lidar(tracks: Tracks, options: argparse.Namespace) -> Estimates:
    """The Kalman filter of positions, with noise by ``torchfra.fit``."""
    process, measurement = sampled(tracks, lidar.MODEL)
    f = presets.srckf(AnyNoise(process), lidar.AnyPosition(measurement))
    return fitted(f, Task(lambda x: x.z, partial(prior, model=lidar.MODEL)), tracks, options)


def with_lidar(tracks: Tracks, options: argparse.Namespace, turns: bool = False) -> Estimates:
    """Ranges and bearings, of a target that goes straight or turns."""
    motion = UnknownTurn(4.0, 0.01) if turns else ConstantVelocity(25.0)
    sensor = RangeBearing(torch.tensor([lidar.RANGE, lidar.BEARING], dtype=torch.float64))
    task = Task(lambda x: lidar.polar(x.z), partial(prior, model=lidar.MODEL))
    return fitted(presets.srckf(motion, sensor), task, tracks, options)


def same_radar(tracks: Tracks, options: argparse.Namespace) -> Estimates:
    """The same filter, which knows in which direction the rate is measured."""
    process, measurement = sampled(tracks, radar.MODEL)
    f = presets.srckf(AnyNoise(process), radar.AnyDoppler(measurement))
    task = Task(lambda x: x.z, partial(prior, model=radar.MODEL), lambda x: radar.direction(x.z))
    return fitted(f, task, tracks, options)


def with_radar(kind: radar.Kind, tracks: Tracks, options: argparse.Namespace, around: Any = None) -> Estimates:
    """What the radar measures, by its data sheet; the first measurement is in the prior."""
    f = presets.srckf(AnyNoise(LASTING * sampled(tracks, radar.MODEL)[0]), radar.sensor(kind))
    task = Task(partial(radar.after_first, kind), partial(radar.believed, kind, learned=tracks))
    return fitted(f, task, tracks, options, around)


def converted(kind: radar.Kind, tracks: Tracks, options: argparse.Namespace) -> Estimates:
    """Positions, with the data sheet's noise turned to where a target is; the first measurement is in the prior."""
    f = presets.srckf(AnyNoise(LASTING * sampled(tracks, radar.MODEL)[0]), radar.Converted())
    task = Task(
        lambda x: radar.without_first(x.z),
        partial(radar.believed, kind, learned=tracks),
        lambda x: radar.direction(x.z),
    )
    return fitted(f, task, tracks, options)


def radar_problem(kind: radar.Kind) -> Problem:
    """As many targets as the authors learn from and judge with."""
    ways = {
        **plain(radar.MODEL),
        "fit": same_radar,
        "fit radar": partial(with_radar, kind),
        "gpb": partial(with_radar, kind, around=presets.gpb),
    }
    if not kind.even:
        ways["fit converted"] = partial(converted, kind)
    return Problem(partial(radar.simulate, kind), 2500, 0.6, ways)


PROBLEMS = {
    "lidar": Problem(
        lidar.simulate,
        1000,
        0.7,
        {
            **plain(lidar.MODEL),
            "fit": same_lidar,
            "fit lidar": with_lidar,
            "fit lidar and turn": partial(with_lidar, turns=True),
        },
    ),
    **{name: radar_problem(kind) for name, kind in radar.KINDS.items()},
}
WAYS = list(dict.fromkeys(way for problem in PROBLEMS.values() for way in problem.ways))


def table(found: dict[str, list[dict[str, float]]], published: dict[str, tuple[float, float]]) -> str:
    """A line for each filter, and for each published draw."""
    kf = [draw["mse"] for draw in found["KF"]]
    rows = []
    for name, draws in found.items():
        errors = [draw["mse"] for draw in draws]
        ratios = [error / plain for error, plain in zip(errors, kf, strict=True)]
        seconds = [draw["seconds"] for draw in draws]
        numbers = statistics.mean(errors), statistics.mean(ratios), statistics.median(seconds), seconds[0]
        rows.append([name, *map(significant, numbers)])
    for plain, learned in zip(*published.values(), strict=True):
        rows.append([f"OKF, published, KF {plain:g}", significant(learned), significant(learned / plain), "", ""])
    return formed_table("markdown", ["", "MSE m^2", "ratio", "s", "first s"], rows)


if __name__ == "__main__":
    sys.exit(main())
