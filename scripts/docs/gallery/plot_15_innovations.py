"""Is the model right?

The normalised innovation squared of a filter whose motion and noise are as stated follows a chi-square distribution.
Three filters that differ in the standard deviation that they assume: the right one, half of it, and twice as much.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

rng = torch.Generator().manual_seed(0)
motion = ConstantVelocity(q=0.5)
time = torch.arange(1.0, 101.0).double()
x = torch.zeros(200, 4).double()
z = []
for _ in time:
    kick = torch.randn(200, 2, generator=rng).double() * 0.5**0.5
    x = x @ motion.transition(torch.tensor(1.0, dtype=torch.float64)).mT + torch.cat([kick / 2, kick], -1)
    z.append(x[:, :2] + 3 * torch.randn(200, 2, generator=rng).double())
z = torch.stack(z, 1)
prior = Gaussian(torch.zeros(4).double(), torch.eye(4).double())

figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
bins = torch.linspace(0, 14, 57)
for name, std in {"std as it is": 3.0, "half of it": 1.5, "twice as much": 6.0}.items():
    with torch.no_grad():
        nis = presets.srckf(motion, Position(std=std))(z, prior).nis[:, 10:]
    axes.hist(nis.flatten(), bins, density=True, histtype="step", lw=1.5, label=f"{name}: mean {nis.mean():.1f}")
axes.plot(bins, 0.5 * (-bins / 2).exp(), "k--", lw=1, label="chi-square of 2: mean 2")
axes.set(xlabel="normalised innovation squared", ylabel="density")
axes.legend(frameon=False)
