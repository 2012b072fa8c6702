"""Track initiation and deletion.

Aircraft among false measurements, found and followed by ``targets.Targets`` around ``jpda``.  False measurements fall
around each aircraft's path also before it appears and after it has left: their places do not show which are there.
"""

import matplotlib.pyplot as plt
import torch

from torchfra import presets, scenarios
from torchfra.association import ChiSquare
from torchfra.targets import SPRT, Deletion, Merging, Targets, TwoPoint, collect

scenario = scenarios.clutter_many(count=6, clutter=20)
tracks = scenario.simulate(1, seed=0)
jpda = presets.jpda(scenario.motion, scenario.sensor, clutter=scenario.clutter, detection=scenario.detection,
                    gate=ChiSquare(0.99999))  # fmt: skip
targets = Targets(
    jpda, birth=TwoPoint(speed=80.0), confirmation=SPRT(false=1e-4, missed=1e-2), deletion=Deletion(misses=4),
    merging=Merging(),
)  # fmt: skip
states = [targets.init()]
with torch.no_grad():
    for scan in tracks.z[0, :60]:
        states.append(targets.step(states[-1], scan, dt=scenario.dt))
estimate = scenario.cartesian(collect(states[1:]))

figure, axes = plt.subplots(figsize=(7, 6), layout="constrained")
azimuth, elevation, reach = tracks.z[0, :60].flatten(0, 1).T
level = reach * elevation.cos() / 1000
axes.plot(level * azimuth.sin(), level * azimuth.cos(), ".", ms=2, color="#bbbbbb", label="measured, false ones too")
for i, path in enumerate(tracks.truth[0, :, :60, :2] / 1000):
    axes.plot(*path.T, color="k", lw=4, alpha=0.2, label="true" if i == 0 else None)
for path in estimate.mean[..., :2] / 1000:
    axes.plot(*path.T, lw=1.5)
axes.set(xlabel="east, km", ylabel="north, km")
axes.legend(frameon=False)
