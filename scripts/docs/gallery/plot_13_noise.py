"""Noise that is not as stated.

At second 60 the noise of the sensor becomes three times what it states. ``iaukf`` finds out; its estimate of the
standard deviation over time, of 50 runs.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

rng = torch.Generator().manual_seed(0)
time = torch.arange(1.0, 181.0).double()
truth = 10 * time[:, None] * torch.tensor([0.8, 0.6], dtype=torch.float64)
scale = torch.where(time > 60, 3.0, 1.0).unsqueeze(-1)
z = truth + 2 * scale * torch.randn(50, 180, 2, generator=rng).double()
mean, deviations = torch.tensor([[0.0, 0, 8, 6], [5.0, 5, 2, 2]], dtype=torch.float64)
prior = Gaussian(mean, deviations.diag())
with torch.no_grad():
    estimate = presets.iaukf(ConstantVelocity(q=0.01), Position(std=2.0), confidence=0.0)(z, prior)
found = 2 * estimate.info.noise.mean(-1).sqrt()

figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
low, middle, high = found.quantile(torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64), 0)
axes.fill_between(time, low, high, alpha=0.25, color="#0072B2", label="eight runs of ten")
axes.plot(time, middle, color="#0072B2", label="median estimate")
axes.plot(time, 2 * scale, "k--", lw=1, label="true")
axes.set(xlabel="time, s", ylabel="standard deviation, m", ylim=(0, None))
axes.legend(frameon=False)
