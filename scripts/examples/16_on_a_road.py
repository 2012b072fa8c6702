"""A car that keeps to a known road: the road is a pseudo-measurement, which is 0 at every step.

You learn how to state an equality constraint (a road, a wall, an altitude): a sensor of the state's violation of it,
``Stacked`` behind the real one, whose measurement is always 0.  Its standard deviation is that of cars across the
road, here twice, as each keeps to its side for long.  An inequality (a speed limit, a region) is no such measurement: a
filter would count the same information again at every step.
"""

import argparse

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra import Gaussian, metrics, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position, Sensor, Stacked

LIKE = {"dtype": torch.float64}
BENDS = torch.tensor([[0, 0], [300, 0], [450, 150], [450, 450], [700, 600], [1200, 600]], **LIKE)
"""Of the road, m."""
SPEED, LANE, STD = 15.0, 2.0, 15.0
"""Of cars, m/s; how far from the middle of the road they are, and standard deviation of a position, m."""


class Road(Sensor):
    """How far left of the road, through points ``(k, 2)``, a position is, m."""

    def __init__(self, bends: Tensor, std: float) -> None:
        super().__init__(reads=2, angles=[False], std=torch.tensor([std], **LIKE))
        self.register_buffer("bends", bends)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """Distances ``(..., 1)`` of states ``(..., 2 or more)`` from the nearest part."""
        begin, along = self.bends[:-1], self.bends.diff(dim=0)
        to = x[..., None, :2] - begin
        share = ((to * along).sum(-1) / along.square().sum(-1)).clamp(0, 1)
        off = to - share.unsqueeze(-1) * along
        nearest = off.square().sum(-1).argmin(-1, keepdim=True)
        left = (along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0]) / along.norm(dim=-1)
        return left.gather(-1, nearest)


def drives(runs: int, seed: int) -> tuple[Tensor, Tensor]:
    """Truths ``(runs, T, 2)`` once a second from end to end, and measured positions, one in twenty an outlier."""
    rng = torch.Generator().manual_seed(seed)
    length = BENDS.diff(dim=0).norm(dim=-1)
    way = torch.arange(0, float(length.sum()), SPEED, **LIKE)
    part = torch.searchsorted(length.cumsum(0), way)
    along = (BENDS.diff(dim=0) / length.unsqueeze(-1))[part]
    middle = BENDS[part] + (way - (length.cumsum(0) - length)[part]).unsqueeze(-1) * along
    left = torch.stack([-along[:, 1], along[:, 0]], -1)
    truth = middle + LANE * torch.randn(runs, 1, 1, generator=rng, **LIKE) * left
    wild = torch.rand(truth.shape[:2], generator=rng).unsqueeze(-1) < 0.05
    return truth, truth + STD * torch.randn(truth.shape, generator=rng, **LIKE) * torch.where(wild, 10.0, 1.0)


def main(arguments: list[str] | None = None) -> None:
    """Compares filters that know the road with filters that do not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=50, help="drives (default: 50)")
    parser.add_argument("--seed", type=int, default=0, help="of the drives (default: 0)")
    options = parser.parse_args(arguments)
    truth, z = drives(options.runs, options.seed)
    motion, gps = ConstantVelocity(2.0, continuous=True), Position(STD)
    on_road = Stacked(gps, Road(BENDS, 2 * LANE))
    spread = torch.tensor([STD, STD, SPEED, SPEED], **LIKE)
    prior = Gaussian(torch.cat([z[:, 0], torch.zeros_like(z[:, 0])], -1), spread.diag())
    for name in ("srckf", "gpb"):
        make = getattr(presets, name)
        for what, sensor, measured in (("position alone", gps, z), ("and the road", on_road, pad(z, (0, 1)))):
            with torch.no_grad():
                estimate = make(motion, sensor)(measured[:, 1:], prior)
            error = metrics.rmse(estimate.mean, truth[:, 1:], slice(0, 2)).square().mean().sqrt()
            nees = metrics.nees(estimate, truth[:, 1:], slice(0, 2)).mean() / 2
            print(f"{name:<6} {what:<15} position RMSE {error:5.1f} m, NEES per dimension {nees:4.1f}")


if __name__ == "__main__":
    main()
