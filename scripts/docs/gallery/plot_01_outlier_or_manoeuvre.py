"""Outlier or manoeuvre.

Two aircraft fly straight and are measured every four seconds. At 80 s one is measured 96 m beside its place, the
other has begun to turn and is 96 m beside its course. The normalised innovation squared (NIS) of a plain filter is
the same for both, and so are all measurements until then.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

dt, std = 4.0, 10.0
time = dt * torch.arange(1, 26).double()
course = torch.stack([120 * time, 40 * time], -1)
aside = torch.tensor([-0.32, 0.95], dtype=torch.float64)
turn = aside * (6 * (time - 76).clamp_min(0) ** 2).unsqueeze(-1)  # 12 m/s^2
truth = {"outlier": course, "manoeuvre": course + turn}
jump = torch.where((time == 80).unsqueeze(-1), turn, 0.0)
noise = std * torch.randn(25, 2, generator=torch.Generator().manual_seed(3)).double()
z = {"outlier": course + jump + noise, "manoeuvre": course + turn + noise}

mean, deviations = torch.tensor([[0.0, 0, 120, 40], [20.0, 20, 5, 5]], dtype=torch.float64)
prior = Gaussian(mean, deviations.diag())
srckf = presets.srckf(ConstantVelocity(q=1.0), Position(std=std))

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for name, marker, colour in (("outlier", "s", "#D55E00"), ("manoeuvre", "o", "#0072B2")):
    nis = srckf(z[name], prior, dt=dt).nis
    left.plot(*truth[name][14:22].T / 1000, color=colour, lw=1)
    left.plot(*z[name][14:22].T / 1000, marker, color=colour, mfc="none", label=name)
    right.semilogy(time[14:22], nis[14:22], marker + "-", color=colour, mfc="none", label=name)
right.axvline(80, color="grey", lw=1, ls=":")
right.axhline(5.991, color="grey", lw=1, ls="--")
right.text(60, 6.6, "95 % of the steps that are as stated", fontsize=8, color="grey")
left.set(xlabel="x, km", ylabel="y, km", title="Measured and true, until two steps later")
right.set(xlabel="time, s", title="NIS of a plain filter")
left.legend(frameon=False, loc="upper left")
right.legend(frameon=False, loc="upper left")
