"""A scenario made of your own tracks."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from torchfra.motion.base import Motion
from torchfra.scenarios.base import Scenario, Tracks
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian


def given(tracks: Tracks, motion: Motion, sensor: Sensor, *, dt: float = 1.0, name: str = "tracks") -> Scenario:
    """A scenario whose runs are the given tracks, one after the other.

    Args:
        tracks: a batch, ``z (B, T, m)``; an unknown truth is NaN.
        motion: the motion of filters.
        sensor: the sensor that has measured.
        dt: seconds per step.
        name: name of the scenario.

    Raises:
        ValueError: measurements that are no batch of tracks, a truth of another number of tracks or steps, no prior.
    """
    z, truth = tracks.z, tracks.truth
    if not isinstance(truth, Tensor) or not isinstance(tracks.prior, Gaussian) or not len(z):
        received = f"{type(truth).__name__}, {type(tracks.prior).__name__} and {len(z)} tracks"
        raise ValueError(
            f"tracks: expected a truth (NaN where unknown), a prior and one track or more, received {received}"
        )
    if z.dim() != 3 or truth.dim() != 3 or truth.shape[:2] != z.shape[:2]:
        received = f"{tuple(truth.shape)} and {tuple(z.shape)}"
        raise ValueError(f"tracks: expected truth (B, T, n) and z (B, T, m), received {received}")
    count, n = len(z), tracks.prior.mean.shape[-1]
    mean = tracks.prior.mean.expand(count, n)

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        return Tracks(truth, z, tracks.u, Gaussian(mean, tracks.prior.scale_tril))

    names = tuple(f"track {i + 1}" for i in range(count))
    prior = Gaussian(mean[0], tracks.prior.scale_tril.reshape(-1, n, n)[0])
    return Scenario(name, motion, sensor, prior, dt, z.shape[1], block, {"tracks": count}, recordings=names)
