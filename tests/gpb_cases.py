"""Targets, sensors and values that tests of gpb share."""

import torch

from torchfra.motion import ConstantAcceleration
from torchfra.sensors import Bearings, Position, Ranges
from torchfra.types import Gaussian

STEPS = 15


def tensor(x):
    return torch.as_tensor(x, dtype=torch.float64)


MOTION = ConstantAcceleration(0.05)
PRIOR = Gaussian(tensor([0.0, 100, 9, 0, 0, 0]), torch.diag(tensor([20, 20, 8, 8, 0.5, 0.5])))
ANCHORS = tensor([[-200, -100], [300, -150], [250, 400], [-150, 350]])
SENSORS = {
    "position": Position(5.0),
    "bearings": Bearings(0.01, stations=tensor([[-800, -500], [900, -600]])),
    "ranges": Ranges(ANCHORS, 2.0),
}
VALUES = {
    "noise_levels": (0.1, 30.0),
    "outlier_transition": ((0.95, 0.05), (0.6, 0.4)),
    "outlier_sizes": (9.0, 400.0, 1e6),
    "outlier_shares": (0.6, 0.3, 0.1),
    "prior_outlier": 0.3,
    "unreliable": 0.05,
    "prior_inflation": 50.0,
    "self_transition": (0.9, 0.8, 0.7, 0.1),
    "jump_factors": (200.0,),
    "restart": (0.5, 0.3, 0.15, 0.05),
    "burst": 4.0,
    "noise": "stated",
}
FEWER = {
    "noise_levels": (0.1, 10.0), "jump_factors": (), "self_transition": (0.95, 0.8, 0.5), "restart": (0.5, 0.4, 0.1),
    "outlier_sizes": (100.0,), "outlier_shares": (1.0,), "adaptive_largest_size": False,
}  # fmt: skip
"""Regimes and outliers, for the compiler's time."""
TINY = 1e-13
ALMOST_NONE = {
    "outlier_transition": ((1 - TINY, TINY), (1 - TINY, TINY)),
    "outlier_sizes": (10.0,),
    "outlier_shares": (1.0,),
    "unreliable": 0.0,
    "prior_outlier": TINY,
    "prior_inflation": 10.0,
    "noise_levels": (1.0,),
    "jump_factors": (10.0,),
    "self_transition": (0.6, 0.8, TINY),
    "restart": (0.5, 0.5 - TINY, TINY),
    "noise": "stated",
}
"""Outliers, jumps and bad priors hardly ever happen."""


def measured(name="position", batch=2, seed=0, outliers=True):
    """A target that turns hard, seen by a sensor, with outliers and missing data."""
    sensor, rng = SENSORS[name], torch.Generator().manual_seed(seed)
    t = torch.arange(1, STEPS + 1, dtype=torch.float64)
    x = torch.stack([9 * t, 100 + 1.5 * (t - 6).clamp_min(0) ** 2], -1)
    z = sensor(torch.cat([x, torch.zeros(STEPS, 4).double()], -1))
    z = z + sensor.std() * torch.randn(batch, *z.shape, dtype=torch.float64, generator=rng)
    if outliers:
        z[0, 4] += 30 * sensor.std()
        z[-1, 7, 0] += 100 * sensor.std()
        z[0, 2, 1] = torch.nan
        z[-1, 9:11] = torch.nan
    return z


def close(a, b, tolerance=1e-9):
    torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance * b.detach().abs().max().item())


def same(one, other, tolerance=1e-9):
    """Two estimates with all that they tell."""
    for a, b in ((one, other), *((getattr(one.info, k), getattr(other.info, k)) for k in ("filtered", "lagged"))):
        close(a.mean, b.mean, tolerance)
        close(a.scale_tril @ a.scale_tril.mT, b.scale_tril @ b.scale_tril.mT, tolerance)
    for name in ("probabilities", "outlier"):
        close(getattr(one.info, name), getattr(other.info, name), tolerance)
    close(one.nis, other.nis, tolerance)
    close(one.log_likelihood, other.log_likelihood, tolerance)
