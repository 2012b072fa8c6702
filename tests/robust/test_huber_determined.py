"""Components that others determine leave the Huber regression as continuous as it is without them."""

import torch

from torchfra import Gaussian, presets
from torchfra.motion import CoordinatedTurn
from torchfra.sensors import Correlated, Position


def test_rounding_of_measurements_does_not_move_estimates_where_velocities_determine_accelerations():
    generator = torch.Generator().manual_seed(0)
    z = torch.arange(1, 41).double()[:, None] * torch.tensor([7.0, 8.0]).double()
    z = z + 3 * torch.randn(4, 40, 2, generator=generator, dtype=torch.float64)
    z[:, 10] += 100
    z[:, 20:23] += 60
    prior = Gaussian(torch.tensor([0, 0, 7, 8, 0, 0]).double(), torch.tensor([20, 20, 5, 5, 1, 1]).double().diag())
    f = presets.hghckf1(CoordinatedTurn(0.1, 1.0, orders=3), Correlated(Position(2.0), 3.0, 20.0))
    moved = z + 1e-12 * torch.randn(z.shape, generator=generator, dtype=torch.float64)
    assert (f(moved, prior).mean - f(z, prior).mean).abs().max() < 1e-7
