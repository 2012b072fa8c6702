"""A belief through a radar.

A belief in range and bearing bends into a banana when it becomes a position. Rules carry mean and covariance through
by points; the dots are 5000 draws and their own moments.
"""

import math

import matplotlib.pyplot as plt
import torch

from torchfra.gaussian import fifth_degree, first_order, third_degree
from torchfra.types import Gaussian

mean, deviations = torch.tensor([[100.0, 0.5], [2.0, 0.35]], dtype=torch.float64)
belief = Gaussian(mean, deviations.diag())


def place(x):
    """Range and bearing as a position."""
    return torch.stack([x[..., 0] * x[..., 1].cos(), x[..., 0] * x[..., 1].sin()], -1)


def outline(mean, covariance):
    """Two standard deviations around a mean."""
    angle = torch.linspace(0, 2 * math.pi, 100).double()
    return mean[:, None] + 2 * torch.linalg.cholesky(covariance) @ torch.stack([angle.cos(), angle.sin()])


draws = belief.mean + torch.randn(5000, 2, generator=torch.Generator().manual_seed(0)).double() @ belief.scale_tril.mT
cloud = place(draws)

figure, axes = plt.subplots(figsize=(6.5, 5), layout="constrained")
axes.plot(*cloud[:1500].T, ".", ms=2, color="#cccccc")
axes.plot(*outline(cloud.mean(0), cloud.T.cov()), "k", lw=3, alpha=0.5, label="the draws")
rules = {"first order (ekf)": first_order, "third degree (srckf)": third_degree, "fifth degree (ghckf)": fifth_degree}
for name, rule in rules.items():
    carried = rule(2)(place, belief, torch.sub)
    covariance = carried.spread @ carried.spread.mT
    if carried.subtracted is not None:  # of rules with negative weights
        covariance = covariance - carried.subtracted @ carried.subtracted.mT
    axes.plot(*outline(carried.value, covariance), label=name)
axes.set(aspect="equal", xlabel="x, m", ylabel="y, m")
axes.legend(frameon=False)
