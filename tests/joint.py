"""What the tests of joint association share: filters around a scenario, targets in a plane."""

import torch

from torchfra import presets
from torchfra.association import ChiSquare, Clutter, Euclidean
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.types import Gaussian

PAPER = {"gate": Euclidean(150.0), "lost": 0.0}
STEPS = 20


def make(name, scenario, **options):
    return getattr(presets, name)(
        scenario.motion, scenario.sensor, **{"clutter": scenario.clutter, "detection": scenario.detection} | options
    )


def plane(clutter=None, detection=0.9, gate=None, **options):
    """Two dimensions, positions, linear: closed forms hold."""
    return presets.jpda(
        ConstantVelocity(0.5, 2), Position(2.0), clutter=clutter or Clutter(1e4, rate=2.0), detection=detection,
        gate=gate or ChiSquare(0.9999), **options,
    )  # fmt: skip


def flat_prior(*positions):
    mean = torch.tensor([[*p, 1.0, 0.0] for p in positions], dtype=torch.float64)
    return Gaussian(mean, torch.diag(torch.tensor([3.0, 3.0, 1.0, 1.0], dtype=torch.float64)).expand(len(mean), 4, 4))
