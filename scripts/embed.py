"""A filter as a layer: a small network reads raw features and says how far to trust each measurement.

    python scripts/embed.py                     about a minute; prints the error of the fixed filter and of this one

A radar measures range and bearing of a target.  At times it glints: its noise is ten times as large.  A detector beside
it gives four raw features of each measurement, two of which have to do with the glint.  The network turns features into
the standard deviations that the filter takes, and learns from the errors of the filtered track alone.
"""

from __future__ import annotations

import argparse
import sys
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra import Gaussian, losses, presets
from torchfra.app.progress import progress_bar
from torchfra.motion import ConstantVelocity
from torchfra.sensors import RangeBearing

STD = torch.tensor([20.0, 0.005], dtype=torch.float64)  # m, rad
MOTION, SENSOR = ConstantVelocity(q=1.0), RangeBearing(STD)
POSITION = slice(0, 2)


class Trusting(nn.Module):
    """A filter whose sensor noise comes from a network."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.network = nn.Sequential(nn.Linear(features, 16), nn.Tanh(), nn.Linear(16, 2)).double()
        self.filter = presets.srckf(MOTION, SENSOR)

    def std(self, features: Tensor) -> Tensor:
        """Standard deviations ``(..., T, 2)``: those of the data sheet times what the network says."""
        return STD * self.network(features).exp()

    def forward(self, z: Tensor, prior: Gaussian, features: Tensor) -> Tensor:
        """Estimates ``(..., T, 4)`` of measurements ``z (..., T, 2)`` with ``features (..., T, 4)``."""
        return self.filter(z, prior, std=self.std(features)).mean


class Data(NamedTuple):
    """Tracks of a radar that glints."""

    truth: Tensor
    z: Tensor
    features: Tensor
    glint: Tensor
    prior: Gaussian


def simulate(tracks: int, steps: int, seed: int) -> Data:
    """Targets some 10 km off at up to 100 m/s; every fifth measurement glints."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=rng)

    step = torch.tensor(1.0, dtype=torch.float64)
    matrix, root = MOTION.transition(step), MOTION.process_noise(step)
    spread = torch.tensor([100.0, 100.0, 10.0, 10.0], dtype=torch.float64)
    mean = torch.tensor([6e3, 8e3, 50.0, -50.0], dtype=torch.float64) + 500 * normal(tracks, 4) / 10
    state, states = mean + spread * normal(tracks, 4), []
    for _ in range(steps):
        state = state @ matrix.mT + normal(tracks, 2) @ root.mT
        states.append(state)
    truth = torch.stack(states, 1)
    glint = torch.rand(tracks, steps, dtype=torch.float64, generator=rng) < 0.2
    size = torch.where(glint, 10.0, 1.0).unsqueeze(-1)
    z = SENSOR(truth) + size * STD * normal(tracks, steps, 2)
    features = normal(tracks, steps, 4)
    features[..., 0] += 4 * glint
    features[..., 2] -= 2 * glint
    return Data(truth, z, features, glint, Gaussian(mean, spread.diag()))


def learn(iterations: int, tracks: int, steps: int, seed: int, progress: bool = False) -> Trusting:
    """Trains the network through the filter."""
    torch.manual_seed(seed)
    model = Trusting(4)
    optimiser = torch.optim.Adam(model.network.parameters(), lr=0.03)
    for i in progress_bar(range(iterations), "iteration", progress):
        data = simulate(tracks, steps, seed + 1 + i)
        mean = model(data.z, data.prior, data.features)
        optimiser.zero_grad()
        losses.robust_mse(mean, data.truth, POSITION, scale=50.0).mean().backward()
        optimiser.step()
    return model


def main(arguments: list[str] | None = None) -> int:
    """Trains, and compares on tracks that the network never saw."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("--iterations", type=int, default=100, help="steps of Adam (default: 100)")
    parser.add_argument("--tracks", type=int, default=32, help="tracks in each (default: 32)")
    parser.add_argument("--steps", type=int, default=40, help="measurements of a track (default: 40)")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default: 0)")
    options = parser.parse_args(arguments)
    model = learn(options.iterations, options.tracks, options.steps, options.seed, progress=True)
    data = simulate(200, options.steps, options.seed + 1_000_000)
    with torch.no_grad():
        std = model.std(data.features)
        results = {
            "fixed std": presets.srckf(MOTION, SENSOR)(data.z, data.prior).mean,
            "Huber weights": presets.rsrckf(MOTION, SENSOR)(data.z, data.prior).mean,
            "std by network": model(data.z, data.prior, data.features),
        }
    for name, mean in results.items():
        print(f"{name:<16} position RMSE {losses.mse(mean, data.truth, POSITION).mean().sqrt():7.1f} m")
    factor = (std / STD).log()
    print(f"the network's std, times the data sheet's: {factor[data.glint].mean().exp():.1f} where it glints, "
          f"{factor[~data.glint].mean().exp():.1f} elsewhere")  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
