"""What the filter says of its steps.

A target flies straight, turns from 160 to 240 s and flies on; three measurements are outliers. ``gpb`` says of each
step how probable an outlier is, and which regime it thinks the motion is in: probabilities smoothed by one step.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

dt, rng = 4.0, torch.Generator().manual_seed(1)
time = dt * torch.arange(1, 101).double()
heading = 0.03 * (time - 160).clamp(0, 80)
truth = 120 * dt * torch.stack([heading.cos(), heading.sin()], -1).cumsum(0)
z = truth + 30 * torch.randn(100, 2, generator=rng).double()
z[[14, 47, 79]] += torch.tensor([[400.0, -250], [-300, 300], [0, 600]], dtype=torch.float64)

mean, deviations = torch.tensor([[0.0, 0, 120, 0], [50.0, 50, 5, 5]], dtype=torch.float64)
prior = Gaussian(mean, deviations.diag())
estimate = presets.gpb(ConstantVelocity(q=9.0), Position(std=30.0)).smooth(z, prior, dt=dt, lag=1)
info = estimate.info

figure, (course, above, below) = plt.subplots(3, 1, figsize=(8, 7), layout="constrained", height_ratios=(2, 1, 1))
course.plot(*truth.T / 1000, color="grey", lw=4, alpha=0.4, label="true")
course.plot(*z.T / 1000, "k.", ms=4, label="measured")
course.plot(*estimate.mean[:, :2].T / 1000, color="#0072B2", label="estimated")
course.set(aspect="equal", adjustable="datalim", xlabel="x, km", ylabel="y, km")
course.legend(frameon=False)
above.bar(time, info.outlier[:, 0], color="#D55E00", width=dt)
above.set(ylabel="outlier", ylim=(0, 1))
below.stackplot(
    time, info.probabilities.T, labels=["calm", "agile", "a jump"], colors=["#dddddd", "#56B4E9", "#CC79A7"]
)
below.set(ylabel="regime", xlabel="time, s", ylim=(0, 1))
below.legend(loc="upper right")
