"""A small KalmanNet: a recurrent network says the gain of a filter that has no covariances.

The prediction is that of the stated motion, and the estimate is the prediction plus a gain times the innovation.  The
network sees four differences, each over its norm: of the last two measurements, the innovation, the last update, and
the change of the last estimate.  It learns from tracks with a truth, by the mean squared error.

Source: Revach et al. (2022), section III, architecture 1; here with 64 units, where the paper has hundreds.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from learned.lorenz import DT, Linear, Lorenz, Tracks

UNITS = 64
RATE, DECAY, CLIP = 2e-3, 1e-4, 1.0
"""Of Adam: its rate, which falls to a tenth, the weight decay, and the largest norm of a gradient."""


class KalmanNet(nn.Module):
    """A filter whose gain is the output of a recurrent network.

    Args:
        motion: as it is stated.
        sensor: as it is stated.
    """

    def __init__(self, motion: Lorenz, sensor: Linear) -> None:
        super().__init__()
        m = sensor.size
        self.motion, self.sensor = motion, sensor
        self.first = nn.Sequential(nn.Linear(2 * m + 6, UNITS), nn.ReLU())
        self.memory = nn.GRUCell(UNITS, UNITS)
        self.gain = nn.Linear(UNITS, 3 * m)
        nn.init.zeros_(self.gain.weight)  # it begins as the prediction, which stays on the attractor
        nn.init.zeros_(self.gain.bias)

    def forward(self, z: Tensor, start: Tensor) -> Tensor:
        """Estimates ``(B, T, 3)`` for ``z (B, T, m)`` and the states ``(B, 3)`` before the first measurement."""
        dt = z.new_full((len(z),), DT)
        mean, predicted, hidden, means = start, start, z.new_zeros(len(z), UNITS), []
        before, last = mean, self.sensor(start)
        for measured in z.unbind(1):
            update, change, before = mean - predicted, mean - before, mean
            predicted = self.motion(mean, dt)
            innovation = measured - self.sensor(predicted)
            parts = measured - last, innovation, update, change
            hidden = self.memory(self.first(torch.cat([nn.functional.normalize(x, dim=-1) for x in parts], -1)), hidden)
            gain = self.gain(hidden).unflatten(-1, (3, -1))
            mean, last = predicted + (gain @ innovation.unsqueeze(-1)).squeeze(-1), measured
            means.append(mean)
        return torch.stack(means, 1)

    def estimated(self, tracks: Tracks) -> Tensor:
        """Estimates ``(B, T, 3)`` of what is asked for, in single precision."""
        return tracks.asked(self(tracks.z.float(), tracks.prior.mean.float()), self.motion)


def trained(network: KalmanNet, tracks: Callable[[int], Tracks], iterations: int) -> KalmanNet:
    """The network after so many steps of Adam on new tracks in each, in single precision.

    A batch whose gradient is not finite, as tracks have run off the attractor, changes nothing.

    Args:
        network: that learns.
        tracks: from the number of an iteration to the tracks of its batch.
        iterations: how many.
    """
    optimiser = torch.optim.Adam(network.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations, RATE / 10)
    for number in range(iterations):
        batch = tracks(number)
        loss = (network.estimated(batch) - batch.truth.float()).square().mean()
        optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(network.parameters(), CLIP)
        if norm.isfinite():
            optimiser.step()
        schedule.step()
    return network
