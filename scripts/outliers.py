"""What an argument that fits the outliers gains: the table of torchfra/robust/README.md.

    python scripts/outliers.py

For each kind of outliers simulated tracks (``KINDS``), filtered by the plain Kalman filter, by ``gpb`` as it is, and by
``gpb`` with the argument for that kind.  Errors of the position are root mean squares over all steps from the tenth on,
m, with the standard error over tracks; behind them is the normalised squared error of the position per dimension, 1
where the covariance is right.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra import Gaussian, presets
from torchfra.cli.command import add_output_options, check_files, check_least, exit_status, make_parser
from torchfra.motion import ConstantVelocity
from torchfra.running.versions import write_results
from torchfra.sensors import Position, Ranges, Sensor
from torchfra.tables import formed_table

FIRST = 10
FLIES, WALKS = ConstantVelocity(0.5, continuous=True), ConstantVelocity(0.2, continuous=True)
GPS, ANCHORS = Position(5.0), Ranges([[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]], 0.1)
STEP = 40.0
"""m, of a grid of quantised fixes."""


class Kind(NamedTuple):
    """Outliers in words, how they come about, and the argument for them."""

    words: str
    sensor: Sensor
    errors: Callable[[Tensor, Tensor, torch.Generator], Tensor]
    """From measurements without noise and noise ``(B, T, m)`` to measurements."""
    argument: str
    fitted: Callable[[], Any]


def runs(like: Tensor, seconds: tuple[float, float], generator: torch.Generator) -> Tensor:
    """``(...)`` bool, whether a fault is on, by mean sojourn times of none and of one, in steps."""
    draw, on, found = (
        torch.rand(like.shape, generator=generator, dtype=like.dtype),
        torch.zeros_like(like[..., 0]) > 0,
        [],
    )
    for k in range(like.shape[-1]):
        on = torch.where(on, draw[..., k] > 1 / seconds[1], draw[..., k] < 1 / seconds[0])
        found.append(on)
    return torch.stack(found, -1)


def normal(shape: Any, generator: torch.Generator) -> Tensor:
    """Standard normal numbers."""
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def wild(true: Tensor, noise: Tensor, generator: torch.Generator) -> Tensor:
    """One in twenty fixes is anywhere within 10 km."""
    anywhere = 2e4 * torch.rand(true.shape, generator=generator, dtype=true.dtype) - 1e4
    often = torch.rand(true.shape[:-1], generator=generator, dtype=true.dtype) < 0.05
    return torch.where(often.unsqueeze(-1), anywhere, true + noise)


def bursts(true: Tensor, noise: Tensor, generator: torch.Generator) -> Tensor:
    """Runs of ten fixes on average with thirty times the noise, each on its own."""
    return true + torch.where(runs(true[..., 0], (100.0, 10.0), generator).unsqueeze(-1), 30 * noise, noise)


def one_side(true: Tensor, noise: Tensor, generator: torch.Generator) -> Tensor:
    """Ranges without a line of sight, for 20 steps on average, are too long: by 1 m on average, exponentially."""
    late = -torch.rand(true.shape, generator=generator, dtype=true.dtype).log()
    blocked = runs(true.transpose(-1, -2), (60.0, 20.0), generator).transpose(-1, -2)
    return true + noise + torch.where(blocked, late, 0.0)


def lasting(true: Tensor, noise: Tensor, generator: torch.Generator) -> Tensor:
    """An error of 4 times the noise that drifts over 30 s, as of satellites among houses: no outlier at all."""
    error, each = 4 * noise[:, 0], []
    keep = math.exp(-1 / 30)
    for _ in range(true.shape[1]):
        error = keep * error + math.sqrt(1 - keep**2) * 20 * normal(error.shape, generator)
        each.append(error)
    return true + noise + torch.stack(each, 1)


def second_target(true: Tensor, noise: Tensor, generator: torch.Generator) -> Tensor:
    """For twelve fixes on average those of another target, 400 m away."""
    on = runs(true[..., 0], (60.0, 12.0), generator).unsqueeze(-1)
    return true + noise + torch.where(on, 400.0 * torch.tensor([0.6, 0.8], dtype=true.dtype), 0.0)


def quantised(true: Tensor, noise: Tensor, generator: torch.Generator) -> Tensor:
    """Fixes on a grid of 40 m, of a device with 5 m of noise."""
    return STEP * ((true + noise) / STEP).round()


KINDS = {
    "wild": Kind("wild: anywhere, one at a time", GPS, wild, "none: the defaults", lambda: presets.gpb(FLIES, GPS)),
    "bursts": Kind(
        "in bursts: ten in a row, each elsewhere", GPS, bursts, "`outlier_durations=(100, 10)`",
        lambda: presets.gpb(FLIES, GPS, outlier_durations=(100.0, 10.0)),
    ),
    "one side": Kind(
        "on one side: ranges that are too long", ANCHORS, one_side,
        "`outlier_offsets=(10, 10, 10, 10), outlier_durations=(60, 20)`",
        lambda: presets.gpb(WALKS, ANCHORS, outlier_offsets=(10.0,) * 4, outlier_durations=(60.0, 20.0)),
    ),
    "lasting": Kind(
        "lasting: an error that drifts over half a minute", GPS, lasting, "`Correlated(sensor, std=20.0, time=30.0)`",
        lambda: presets.gpb(FLIES, correlated()),
    ),
    "second target": Kind(
        "a second target: a dozen fixes with one offset", GPS, second_target,
        "`same_offset=0.9, outlier_durations=(60, 12)`",
        lambda: presets.gpb(FLIES, GPS, same_offset=0.9, outlier_durations=(60.0, 12.0)),
    ),
    "quantised": Kind(
        "none: values are quantised", GPS, quantised, "the sensor's `std`, `sqrt(5**2 + 40**2 / 12)`",
        lambda: presets.gpb(FLIES, Position(math.sqrt(25 + STEP**2 / 12))),
    ),
}  # fmt: skip


def correlated() -> Sensor:
    """The sensor of lasting errors."""
    from torchfra.sensors import Correlated

    return Correlated(GPS, std=20.0, time=30.0)


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("--tracks", type=int, default=100, help="tracks of each kind (%(default)s)")
    p.add_argument("--steps", type=int, default=150, help="steps of each, of 1 s (%(default)s)")
    p.add_argument("--seed", type=int, default=0, help="of the simulation (%(default)s)")
    add_output_options(p)
    return exit_status("outliers", lambda: compare(p.parse_args(arguments)))


def compare(options: argparse.Namespace) -> None:
    """Simulates, filters and prints."""
    check_least(options, tracks=1, steps=1)
    check_files({"json": options.json})
    results = {name: errors(kind, options.tracks, options.steps, options.seed) for name, kind in KINDS.items()}
    if not options.quiet:
        rows = [
            [
                kind.words,
                kind.argument,
                *(f"{rms:.3g} +- {se:.1g} ({nees:.2g})" for rms, se, nees in results[name].values()),
            ]
            for name, kind in KINDS.items()
        ]
        header = ["my outliers are", "argument", "`srckf`", "`gpb`", "`gpb` with it"]
        print(formed_table("markdown", header, rows))
    write_results(options.json, {"tracks": options.tracks, "steps": options.steps, "seed": options.seed, **results})


def errors(kind: Kind, tracks: int, steps: int, seed: int) -> dict[str, tuple[float, float, float]]:
    """By filter: root mean squared error and its standard error, m, and normalised squared error per dimension."""
    generator = torch.Generator().manual_seed(seed)
    motion = FLIES if kind.sensor is GPS else WALKS
    one = torch.ones((), dtype=torch.float64)
    F, root = motion.transition(one), motion.process_noise(one)
    start = Gaussian.from_std([20.0, 20.0, 0, 0], [5.0, 5.0, 3.0, 3.0] if motion is FLIES else [5.0, 5.0, 0.5, 0.5])
    x = start.mean + normal((tracks, 4), generator) @ start.scale_tril.mT
    truth = []
    for _ in range(steps):
        x = x @ F.mT + normal((tracks, root.shape[-1]), generator) @ root.mT
        truth.append(x)
    states = torch.stack(truth, 1)
    seen = kind.sensor(states)
    std = GPS.std if kind.sensor is GPS else ANCHORS.std
    assert std is not None
    z = kind.errors(seen, std(seen) * normal(seen.shape, generator), generator)
    filters = {
        "srckf": presets.srckf(motion, kind.sensor), "gpb": presets.gpb(motion, kind.sensor), "fitted": kind.fitted(),
    }  # fmt: skip
    found = {}
    for name, f in filters.items():
        with torch.no_grad():
            estimate = f(z, start)
        late = slice(min(FIRST, steps - 1), None)
        gap = (estimate.mean - states)[:, late, :2]
        square = gap.square().sum(-1).mean(-1)
        rms, root = float(square.mean().sqrt()), estimate.scale_tril[:, late, :2, :2]
        nees = torch.linalg.solve_triangular(root, gap.unsqueeze(-1), upper=False).square().sum((-2, -1)).mean() / 2
        found[name] = (rms, float(square.std(correction=0)) / math.sqrt(tracks) / (2 * rms), float(nees))
    return found


if __name__ == "__main__":
    raise SystemExit(main())
