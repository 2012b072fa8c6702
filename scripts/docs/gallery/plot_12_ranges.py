"""Ranges with walls in the way.

Four anchors measure ranges to someone who walks; now and then a wall makes one of them metres too long. ``gpb`` says
which.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import presets, scenarios

walks = scenarios.ranges_outliers("both")
tracks = walks.simulate(runs=1, seed=0)
with torch.no_grad():
    estimate = presets.gpb(walks.motion, walks.sensor, lag=1)(tracks.z[:, :300], tracks.prior, dt=walks.dt)
truth = tracks.truth[0, :300]
error = tracks.z[0, :300] - walks.sensor(truth)

figure, (course, below) = plt.subplots(2, 1, figsize=(8, 7), layout="constrained", height_ratios=(3, 2))
course.plot(*walks.sensor.anchors[:, :2].T, "^", color="k", ms=9, label="anchors")
course.plot(*truth[:, walks.position].T, color="grey", lw=4, alpha=0.4, label="true")
course.plot(*estimate.mean[0][:, walks.position].T, color="#0072B2", label="estimated")
course.set(aspect="equal", adjustable="datalim", xlabel="x, m", ylabel="y, m")
course.legend(frameon=False)
time = walks.dt * torch.arange(1, 301)
for i in range(error.shape[-1]):
    points = below.scatter(time, error[:, i], c=estimate.info.outlier[0, :, i], s=8, cmap="coolwarm", vmin=0, vmax=1)
figure.colorbar(points, ax=below, label="probability of an outlier")
below.set(xlabel="time, s", ylabel="error of a range, m")
