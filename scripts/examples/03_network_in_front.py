"""A filter as a layer: a network reads raw features and says how accurate each measurement is.

A radar measures range and bearing.  At times it glints: its noise is ten times as large.  A detector gives features of
each measurement, two of which depend on the glint.  The network turns them into the standard deviations that the filter
takes.  You learn that gradients flow through a filter: the network sees nothing but the errors of the filtered track.
"""

import argparse
from collections import namedtuple

import torch
from torch import Tensor, nn

from torchfra import Gaussian, losses, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import RangeBearing

STD = torch.tensor([20.0, 0.005], dtype=torch.float64)  # m, rad: those of the data sheet
MOTION, SENSOR, POSITION = ConstantVelocity(q=1.0), RangeBearing(STD), slice(0, 2)
Data = namedtuple("Data", "truth z features glint prior")


class Weighted(nn.Module):
    """A filter whose measurement noise comes from a network."""

    def __init__(self) -> None:
        super().__init__()
        self.network = nn.Sequential(nn.Linear(4, 16), nn.Tanh(), nn.Linear(16, 2)).double()
        self.filter = presets.srckf(MOTION, SENSOR)

    def forward(self, data: Data) -> tuple[Tensor, Tensor]:
        """Means ``(..., T, 4)`` of the states, and the standard deviations ``(..., T, 2)`` of the measurements."""
        std = STD * self.network(data.features).exp()
        return self.filter(data.z, data.prior, std=std).mean, std


def simulate(tracks: int, steps: int, seed: int) -> Data:
    """Targets some 10 km away at up to 100 m/s; every fifth measurement glints."""
    options = {"generator": torch.Generator().manual_seed(seed), "dtype": torch.float64}
    second, spread = torch.ones((), dtype=torch.float64), torch.tensor([100.0, 100.0, 10.0, 10.0], dtype=torch.float64)
    mean = torch.tensor([6e3, 8e3, 50.0, -50.0], dtype=torch.float64) + 50 * torch.randn(tracks, 4, **options)
    states = [mean + spread * torch.randn(tracks, 4, **options)]
    for shock in torch.randn(steps, tracks, 2, **options):
        states.append(states[-1] @ MOTION.transition(second).mT + shock @ MOTION.process_noise(second).mT)
    truth, glint = torch.stack(states[1:], 1), torch.rand(tracks, steps, **options) < 0.2
    z = SENSOR(truth) + torch.where(glint, 10.0, 1.0).unsqueeze(-1) * STD * torch.randn(tracks, steps, 2, **options)
    features = glint.unsqueeze(-1) * torch.tensor([4.0, 0.0, -2.0, 0.0]) + torch.randn(tracks, steps, 4, **options)
    return Data(truth, z, features, glint, Gaussian(mean, spread.diag()))


def learn(iterations: int) -> Weighted:
    """Trains the network through the filter, on new tracks in each iteration."""
    torch.manual_seed(0)  # of the initial weights
    model = Weighted()
    optimiser = torch.optim.Adam(model.parameters(), lr=0.05)
    for seed in range(iterations):
        data = simulate(16, 25, seed)
        loss = losses.robust_mse(model(data)[0], data.truth, POSITION, scale=50.0).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return model


def main(arguments: list[str] | None = None) -> None:
    """Trains, and compares on tracks that the network never saw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=40, help="steps of Adam (default: 40)")
    model, data = learn(parser.parse_args(arguments).iterations), simulate(200, 40, seed=1_000_000)
    with torch.no_grad():
        fixed, robust = (f(MOTION, SENSOR)(data.z, data.prior).mean for f in (presets.srckf, presets.rsrckf))
        learned, std = model(data)
    for name, mean in {"of the data sheet": fixed, "and Huber weights": robust, "by the network": learned}.items():
        print(f"std {name:<17}: position RMSE {losses.mse(mean, data.truth, POSITION).mean().sqrt():6.1f} m")
    glint, other = ((std / STD)[at].median() for at in (data.glint, ~data.glint))
    print(f"std by the network over that of the data sheet: {glint:.1f} where the radar glints, {other:.1f} elsewhere")


if __name__ == "__main__":
    main()
