"""How often the 95 % intervals of torchfra.fit hold the true value.

    python scripts/certainty.py --fits 200 --jobs 2 --json out/certainty.json

Each fit has tracks of its own, of constant velocity with known noise of motion and measurement, and starts at three
times both.  It goes the whole way: split, Adam, Newton's method, standard errors by the Hessian.  A line for each
value: how many intervals hold it, and the root mean square of its errors in standard errors, which is 1 if these are
right.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch
from torch import Tensor

import torchfra
from torchfra import Gaussian, presets
from torchfra.cli.command import add_output_options, check_files, check_least, exit_status, make_parser
from torchfra.motion import ConstantVelocity
from torchfra.running.jobs import add_jobs_option, finished
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.sensors import Position
from torchfra.tables import text_table

TRUE = {"motion.q": 0.5, "sensor.std": 2.0}
SPREAD = torch.tensor([20.0, 20.0, 10.0, 10.0], dtype=torch.float64)
"""Standard deviations of the start."""
OFF = 3.0
"""By what factor both values are off at the start of a fit."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("--fits", type=int, default=200, metavar="N", help="(default: 200)")
    p.add_argument("--tracks", type=int, default=36, metavar="N", help="of each fit, 30 %% held out (default: 36)")
    p.add_argument("--steps", type=int, default=15, metavar="N", help="of each track (default: 15)")
    p.add_argument("--iterations", type=int, default=40, metavar="N", help="of Adam (default: 40)")
    p.add_argument("--no-compile", action="store_true", help="run interpreted, without a C++ compiler")
    p.add_argument("--seed", type=int, default=13, metavar="S", help="of the first fit (default: 13)")
    add_jobs_option(p)
    add_output_options(p)
    return exit_status("certainty", lambda: certainty(p.parse_args(arguments)))


def certainty(options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """All fits, and the table when the last one is done.

    Raises:
        ValueError: fewer than 2 fits, or another number out of its range.
    """
    check_least(options, jobs=1, fits=2)
    check_files({"json": options.json})
    sizes = (options.tracks, options.steps, options.iterations, not options.no_compile)
    parts = [(options.seed + k, *sizes) for k in range(options.fits)]
    done = progress_bar(finished(one_fit, parts, options.jobs), "fit", not options.quiet)
    every = torch.tensor([errors for _, errors in sorted(done)], dtype=torch.float64)  # (fits, values, 2)
    found = {
        name: {"inside": every[:, k, 0].mean().item(), "rms": every[:, k, 1].square().mean().sqrt().item()}
        for k, name in enumerate(TRUE)
    }
    if not options.quiet:
        rows = [[name, f"{of['inside']:.1%}", f"{of['rms']:.2f}"] for name, of in found.items()]
        print(text_table([f"value, {options.fits} fits", "in the interval", "RMS error / standard error"], rows))
    settings = {name: value for name, value in vars(options).items() if not isinstance(value, Path)}
    write_results(options.json, {"settings": settings, "values": found})
    return found


def one_fit(seed: int, tracks: int, steps: int, iterations: int, compile: bool) -> list[tuple[bool, float]]:
    """Of each value whether its interval holds the true one, and its error in standard errors."""
    prior = Gaussian(torch.zeros(4, dtype=torch.float64), SPREAD.diag())
    f = presets.srckf(ConstantVelocity(OFF * TRUE["motion.q"]), Position(OFF * TRUE["sensor.std"]))
    found = torchfra.fit(
        f, {"z": walks(seed, tracks, steps), "prior": prior}, learn=("q", "std"), iterations=iterations, seed=seed,
        compile=compile, quiet=True,
    )  # fmt: skip
    return [
        (low <= TRUE[name] <= high, (found.learned[name] - TRUE[name]) / found.errors[name])
        for name, (low, high) in found.intervals.items()
    ]


def walks(seed: int, runs: int, steps: int) -> Tensor:
    """Measurements ``(runs, steps, 2)`` of targets of constant velocity with the true noise."""
    rng, like = torch.Generator().manual_seed(seed), {"dtype": torch.float64}
    motion, one = ConstantVelocity(TRUE["motion.q"]), torch.tensor(1.0, **like)
    step, noise = motion.transition(one), motion.process_noise(one)
    x, places = torch.randn(runs, 4, generator=rng, **like) * SPREAD, []
    for _ in range(steps):
        x = x @ step.mT + torch.randn(runs, noise.shape[-1], generator=rng, **like) @ noise.mT
        places.append(x[:, :2])
    return torch.stack(places, 1) + TRUE["sensor.std"] * torch.randn(runs, steps, 2, generator=rng, **like)


if __name__ == "__main__":
    sys.exit(main())
