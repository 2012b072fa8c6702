"""Ultra-wideband ranges on a vehicle: what steers it, and the delay of its antenna, are in the state.

You learn how a motion gets a bias beside it (``Augmented``), how a sensor adds that to what it measures (``Biased``),
and what it brings that a filter knows how a vehicle rolls.  The ranges are simulated: six anchors around a yard, all
ranges too long by the same delay, and some much too long, where something stands in the way.
"""

import argparse

import torch

from torchfra import Gaussian, check_model, metrics, presets
from torchfra.motion import Augmented, Bicycle, ConstantVelocity, RandomWalk, UnknownTurn
from torchfra.sensors import Biased, Ranges

LIKE = {"dtype": torch.float64}
ANCHORS = torch.tensor([[0, 0, 4], [30, -2, 3], [60, 0, 4], [60, 40, 4], [30, 42, 3], [0, 40, 4]], **LIKE)  # m
DT, STD, DELAY = 0.1, 0.1, 0.6  # s, m, m


def drive(steps: int) -> torch.Tensor:
    """States ``(steps, 5)`` of a vehicle that goes round the yard: ``[x, y, speed, heading, steering]``."""
    rolls, dt = Bicycle(wheelbase=2.0, q=0.0, steer=0.0), torch.tensor(DT, **LIKE)
    x, states = torch.tensor([15.0, 8.0, 4.0, 0.0, 0.0], **LIKE), []
    for k in range(steps):
        x = rolls(x, dt)
        x[4] = 0.3 if k % 70 > 40 else -0.05  # rad: a curve to the left, else slightly to the right
        states.append(x)
    return torch.stack(states)


def measure(truth: torch.Tensor, runs: int) -> torch.Tensor:
    """Ranges ``(runs, steps, 6)`` with noise, delay, gaps and, one in twenty, something in the way."""
    rng = torch.Generator().manual_seed(0)
    exact = Ranges(ANCHORS, STD, height=1.0)(truth).expand(runs, -1, -1)
    kind = torch.rand(exact.shape, generator=rng, **LIKE)
    longer = 3.0 * torch.rand(exact.shape, generator=rng, **LIKE) * (kind < 0.05)
    z = exact + DELAY + longer + STD * torch.randn(exact.shape, generator=rng, **LIKE)
    return torch.where(kind > 0.95, torch.nan, z)


def main(arguments: list[str] | None = None) -> None:
    """Compares what the filter knows of the vehicle and of its antenna."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10, help="drives (default: 10)")
    parser.add_argument("--steps", type=int, default=105, help="ranges of a drive, 10 a second (default: 105)")
    options = parser.parse_args(arguments)
    truth = drive(options.steps)
    z, ranges = measure(truth, options.runs), Ranges(ANCHORS, STD, height=1.0)

    delay = RandomWalk(1e-6, 1, kind="bias")  # it hardly drifts: m^2/s
    motions = {
        "constant velocity, no delay": ConstantVelocity(4.0, continuous=True),
        "constant velocity": Augmented(ConstantVelocity(4.0, continuous=True), delay),
        "turn of unknown rate": Augmented(UnknownTurn(0.3, 1.0, continuous=True), delay),
        "bicycle": Augmented(Bicycle(2.0, 0.3, 0.3, continuous=True), delay),
    }
    start = {"position": 2.0, "velocity": 4.0, "rate": 0.5, "angle": 0.3, "bias": 1.0}  # how uncertain each kind is
    for name, motion in motions.items():
        sensor = Biased(ranges, motion.components.index("bias")) if "bias" in motion.kinds else ranges
        spread = torch.tensor([start[kind] for kind in motion.kinds], **LIKE)
        mean = torch.zeros(motion.size, **LIKE)
        mean[:3] = torch.tensor([15.0, 8.0, 4.0], **LIKE)  # speed or, to the east, its first component
        with torch.no_grad():
            estimate = presets.gpb(motion, sensor)(z, Gaussian(mean, spread.diag()), dt=DT)
        error = metrics.rmse(estimate.mean, truth, motion.position)[options.steps // 4 :].mean()
        found = f", delay {estimate.mean[:, -1, -1].mean():.2f} m" if "bias" in motion.kinds else ""
        print(f"{name:<28} position RMSE {error:.3f} m{found}")
    print(check_model(motion, sensor, dt=DT))  # worth a look before any of this, with models of your own


if __name__ == "__main__":
    main()
