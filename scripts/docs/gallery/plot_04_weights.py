"""How much a measurement counts.

Weights of robust filters: what divides the noise covariance, over the innovation in standard deviations. A weight of
0.01 means that the measurement counts as if its standard deviation were ten times what the sensor states.
"""

import matplotlib.pyplot as plt
import torch

from torchfra.robust import Huber, ThreeSegment

innovation = torch.linspace(0, 12, 400).double().unsqueeze(-1)
nis = innovation.square().sum(-1)

figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
for name, robust in {
    "Huber, threshold 1.345 (rsrckf)": Huber(),
    "Huber, threshold 3": Huber(3.0),
    "three segments, 0 from 10 (mr_ckf)": ThreeSegment(high=100.0),
}.items():
    axes.plot(innovation, robust(innovation, nis), label=name)
axes.set(xlabel="innovation, standard deviations", ylabel="weight", ylim=(0, 1.05))
axes.legend(frameon=False)
