"""Smoothing.

``smooth`` estimates every step from all measurements; with ``lag=3`` from those up to three steps later. Half the
track has no measurements for a while: a filter drifts there, a smoother has measurements on both sides.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

rng = torch.Generator().manual_seed(2)
motion, time = ConstantVelocity(q=0.3, dims=1), torch.arange(1.0, 61.0).double()
kicks = torch.randn(60, generator=rng).double() * 0.55
speed = kicks.cumsum(0)
truth = speed.cumsum(0)
z = (truth + 4 * torch.randn(60, generator=rng).double()).unsqueeze(-1)
z[24:36] = torch.nan
prior = Gaussian(torch.zeros(2).double(), torch.tensor([4.0, 2.0], dtype=torch.float64).diag())
srckf = presets.srckf(motion, Position(std=4.0, dims=1))

figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
for name, estimate, colour in (
    ("filtered", srckf(z, prior), "#D55E00"), ("smoothed", srckf.smooth(z, prior), "#0072B2"),
):  # fmt: skip
    mean, std = estimate.mean[:, 0], estimate.scale_tril[:, 0].norm(dim=-1)
    axes.fill_between(time, mean - 2 * std, mean + 2 * std, color=colour, alpha=0.2, label=f"{name}, 2 std")
    axes.plot(time, mean, color=colour)
axes.plot(time, truth, "k--", lw=1, label="true")
axes.plot(time, z, "k.", ms=4, label="measured")
axes.set(xlabel="time, s", ylabel="position, m")
axes.legend(frameon=False, ncols=2)
