"""The hypotheses of one step.

The beliefs of ``gpb`` after the large innovation, the same for both aircraft: one if the measurement is an inlier, so
that the target has moved, and one if it is an outlier, so that it has not. The next measurement decides, and
smooths the step.
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
turn = aside * (6 * (time - 76).clamp_min(0) ** 2).unsqueeze(-1)
jump = torch.where((time == 80).unsqueeze(-1), turn, 0.0)
noise = std * torch.randn(25, 2, generator=torch.Generator().manual_seed(3)).double()
mean, deviations = torch.tensor([[0.0, 0, 120, 40], [20.0, 20, 5, 5]], dtype=torch.float64)
prior = Gaussian(mean, deviations.diag())
gpb = presets.gpb(ConstantVelocity(q=25.0), Position(std=std))


def ellipse(mean, root):
    """Two standard deviations around a position."""
    angle = torch.linspace(0, 2 * torch.pi, 100).double()
    return mean[:2, None] + 2 * root[:2, :2] @ torch.stack([angle.cos(), angle.sin()])


figure, panels = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained", sharey=True)
for panel, z, title in zip(
    panels, (course + jump + noise, course + turn + noise), ("Then: back on course", "Then: further off"), strict=True
):
    state = gpb.init(prior)
    for k in range(20):
        state, _ = gpb.step(state, z[k], dt=dt)
    after, _ = gpb.step(state, z[20], dt=dt)
    before = state.log_weights.exp()[1].sum()
    likeliest = gpb.hypotheses(state)[1].unflatten(0, (2, -1)).argmax(-1)  # a belief for calm flight, one for all else
    smoothed = gpb.smooth(z[:21], prior, dt=dt, lag=1).info.outlier[19, 0]
    for hypothesis, now, later, name, colour in (
        (0, 1 - before, 1 - smoothed, "as stated", "#0072B2"),
        (1, before, smoothed, "an outlier", "#D55E00"),
    ):
        label = f"if it was {name}: {now:.0%}, then {later:.0%}"
        mean, root = (x[hypothesis, likeliest[hypothesis]] for x in state.hypotheses)
        panel.fill(*ellipse(mean, root), color=colour, alpha=0.35, lw=0, label=label)
    panel.plot(*z[19], "ko", ms=5, label="measured")
    panel.plot(*torch.stack([after.lagged.mean[:2], z[20]]).T, "k:", lw=1, label="towards what is measured next")
    panel.plot(*state.belief.mean[:2], "P", color="#009E73", ms=9, label="estimate at the step")
    panel.plot(*after.lagged.mean[:2], "X", color="#CC79A7", ms=9, label="estimate, given the next")
    panel.set(xlabel="x, m", title=title, xlim=(9520, 9720))
    panel.legend(frameon=False, fontsize=8, loc="upper left")
panels[0].set(ylabel="y, m", ylim=(3120, 3420))
