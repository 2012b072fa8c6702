"""Which motion it is.

An aircraft flies straight, makes a slow turn and a fast one. Interacting models carry five motions; their
probabilities, mean of 100 runs.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import presets, scenarios

scenario = scenarios.adsb_turns()
tracks = scenario.simulate(runs=100, seed=0)
with torch.no_grad():
    estimate = presets.imm_srckf(scenario.bank, scenario.sensor)(tracks.z, tracks.prior, dt=scenario.dt)
probabilities = estimate.info.probabilities.mean(0)

figure, (course, share) = plt.subplots(2, 1, figsize=(8, 6), layout="constrained", height_ratios=(3, 2))
course.plot(*tracks.z[0].T / 1000, ".", ms=2, color="#999999", label="measured, one run")
course.plot(*(tracks.truth[0, :, scenario.truth_position].T / 1000), color="#0072B2", label="true")
course.set(xlabel="x, km", ylabel="y, km")
course.legend(frameon=False)
time = scenario.dt * torch.arange(1, len(probabilities) + 1)
names = [motion.describe() for motion in scenario.bank]
share.stackplot(time, probabilities.T, labels=names)
share.set(xlabel="time, s", ylabel="probability", ylim=(0, 1), xlim=(0, time[-1]))
figure.legend(*share.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=8)
