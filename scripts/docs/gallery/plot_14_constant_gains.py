"""Gains that switch.

An aircraft flies level for 73 s and then weaves at up to 30 m/s^2; two measurements are 2 km off. ``alphabeta`` picks
the gains by votes, and rejects what no aircraft could have flown.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import metrics, presets, scenarios

scenario = scenarios.level_then_weave()
tracks = scenario.simulate(runs=100, seed=0)
with torch.no_grad():
    bank = presets.alphabeta(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, dt=scenario.dt)
    plain = presets.srckf(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, dt=scenario.dt)
time = scenario.dt * torch.arange(1, scenario.steps + 1)

figure, (error, level) = plt.subplots(2, 1, figsize=(8, 6), layout="constrained", sharex=True)
for name, estimate in {"alphabeta": bank, "srckf": plain}.items():
    error.semilogy(time, metrics.rmse(estimate.mean, tracks.truth, scenario.position), label=name)
error.set(ylabel="position RMSE, m")
error.legend(frameon=False)
used, rejected = bank.info.level[0].double().mean(-1), bank.info.rejected[0].any(-1)
level.step(time, used, where="mid", label="gains of run 0, mean of the axes; 0 the fastest")
level.plot(time[rejected], used[rejected], "rx", label="rejected")
level.set(xlabel="time, s", ylabel="level")
level.legend(frameon=False)
