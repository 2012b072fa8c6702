"""Satellite positions that are wrong for minutes: the error is in the state, and a fault is one of its models.

You learn how time-correlated errors are modelled (``GaussMarkov`` beside the motion, ``Biased`` around the sensor) and
how interacting models detect that the sensor is faulty.  A robot with odometry is simulated: its satellite positions
have errors of a few metres, correlated over a minute, and once, for some minutes, of tens of metres.
"""

import argparse
import math

import torch

from torchfra import Gaussian, metrics, presets
from torchfra.filters import Filter
from torchfra.motion import Augmented, Bank, GaussMarkov, Odometry
from torchfra.sensors import Biased, Position

LIKE = {"dtype": torch.float64}
WALKS = 0.05, 1e-6, 1e-7  # of position, heading error and scale: m^2/s, rad^2/s, 1/s
STD, ERROR, TIME = 1.0, 3.0, 60.0  # of positions: white, m; time-correlated, m, and their time constant, s
FAULT, WANDER = 40.0, 0.8  # how far off a faulty position is, and how far that wanders in a second, m
START = 1.0, 1.0, 0.05, 0.05  # standard deviations at the start: m, m, rad, 1
# P(now | was), of a step of 1 s: no fault, one begins, lasts, ends
NEXT = [0.999, 0.001, 0.0, 0.0], [0.0, 0.2, 0.7, 0.1], [0.0, 0.01, 0.98, 0.01], [0.999, 0.001, 0.0, 0.0]


def drives(runs: int, steps: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Truths and positions ``(runs, steps, 2)``, speeds and headings, and whether a fault is on."""
    rng = torch.Generator().manual_seed(0)
    turns = 0.3 * torch.randn(runs, steps // 20 + 1, generator=rng, **LIKE).repeat_interleave(20, -1)[:, :steps]
    u = torch.stack([torch.full((runs, steps), 1.5, **LIKE), turns.cumsum(-1) / 20], -1)
    moves = Augmented(Odometry(*WALKS), GaussMarkov(ERROR, TIME, dims=2))
    spread = torch.tensor([*START, ERROR, ERROR], **LIKE)
    x, dt, states = spread * torch.randn(runs, 6, generator=rng, **LIKE), torch.tensor(1.0, **LIKE), []
    for k in range(steps):
        x = moves(x, dt, u[:, k]) + torch.randn(runs, 6, generator=rng, **LIKE) @ moves.process_noise(dt).mT
        states.append(x)
    truth = torch.stack(states, 1)
    wrong = torch.zeros(runs, steps, dtype=torch.bool)
    wrong[:, steps // 3 : steps // 2] = True
    off = FAULT * torch.randn(runs, 1, 2, generator=rng, **LIKE) * wrong.unsqueeze(-1)
    z = truth[..., :2] + torch.where(wrong.unsqueeze(-1), off, truth[..., 4:])
    return truth[..., :2], z + STD * torch.randn(z.shape, generator=rng, **LIKE), u, wrong


def with_faults() -> Filter:
    """The filter: four models of what positions are off by."""
    at_once = 1e-3  # s over which an error is forgotten that a new one replaces
    errors = (ERROR, TIME), (FAULT, at_once), (FAULT, 2 * (FAULT / WANDER) ** 2), (ERROR, at_once)
    bank = Bank([Augmented(Odometry(*WALKS), GaussMarkov(std, time, dims=2)) for std, time in errors])
    return presets.imm(bank, Biased(Position(STD), [4, 5]), transition=torch.tensor(NEXT, **LIKE))


def main(arguments: list[str] | None = None) -> None:
    """Compares filters that take errors for white with one that knows how they last."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20, help="drives (default: 20)")
    parser.add_argument("--steps", type=int, default=600, help="seconds of a drive (default: 600)")
    options = parser.parse_args(arguments)
    truth, z, u, wrong = drives(options.runs, options.steps)
    white, spread = math.hypot(STD, ERROR), torch.tensor([*START, ERROR, ERROR], **LIKE)
    filters = {
        "srckf, white errors": presets.srckf(Odometry(*WALKS), Position(white)),
        "rsrckf, white errors": presets.rsrckf(Odometry(*WALKS), Position(white)),
        "imm, time-correlated errors": with_faults(),
    }
    for name, f in filters.items():
        start = Gaussian(torch.zeros(f.motion.size, **LIKE), spread[: f.motion.size].diag())
        with torch.no_grad():
            estimate = f(z, start, u=u)
        error = metrics.rmse(estimate.mean, truth, slice(0, 2)).square().mean().sqrt()
        nees = metrics.nees(estimate, truth, slice(0, 2)).mean() / 2
        print(f"{name:<27} position RMSE {error:5.1f} m, NEES per dimension {nees:6.1f} (1 is consistent)")
    faulty = estimate.info.probabilities[..., 1:3].sum(-1) > 0.5
    print(f"faulty, it says, in {faulty[wrong].double().mean():.0%} of the steps of a fault, "
          f"and in {faulty[~wrong].double().mean():.1%} of the others")  # fmt: skip


if __name__ == "__main__":
    main()
