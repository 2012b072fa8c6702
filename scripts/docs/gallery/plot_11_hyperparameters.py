"""A value for every track, and a gradient.

Hyperparameters broadcast with the batch, so that a sweep of 40 thresholds is one call; and they learn by gradient
descent: the crosses are 15 steps of Adam from a bad prior.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import presets, scenarios

scenario = scenarios.bearings_outliers("std", initial="truth")
tracks = scenario.simulate(runs=30, seed=0)


def loss(f):
    """Mean position error, m, for each value."""
    error = f(tracks.z, tracks.prior, u=tracks.u).mean - tracks.truth
    return error[..., scenario.position].square().sum(-1).sqrt().mean((-2, -1))


thresholds = torch.logspace(-0.5, 1.5, 40).double()
with torch.no_grad():
    sweep = loss(presets.rsrckf(scenario.motion, scenario.sensor, threshold=thresholds.unsqueeze(-1)))

f = presets.rsrckf(scenario.motion, scenario.sensor, threshold=20.0, learn=("threshold",))
optimiser, way = torch.optim.Adam(f.parameters(), lr=0.4), []
for _ in range(15):
    optimiser.zero_grad()
    now = loss(f)
    now.backward()
    way.append((f.robust.threshold().item(), now.item()))
    optimiser.step()

figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
axes.semilogx(thresholds, sweep, label="a sweep in one call")
axes.plot(*zip(*way, strict=True), "x", color="#D55E00", label="gradient descent")
axes.set(xlabel="threshold, standard deviations", ylabel="mean position error, m")
axes.legend(frameon=False)
