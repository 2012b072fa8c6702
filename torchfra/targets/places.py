"""Where measurements lie in space, and beliefs in the coordinates of space."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.coordinates import belief_from_cartesian, belief_to_cartesian
from torchfra.linalg.triangular import tria
from torchfra.motion.base import Motion
from torchfra.motion.spherical import Spherical
from torchfra.sensors.base import Sensor
from torchfra.sensors.direction import RangeBearing
from torchfra.types import Gaussian


def place(sensor: Sensor, z: Tensor, u: Tensor | None) -> Gaussian:
    """Positions ``(K, dims)`` that measurements ``(K, m)`` tell, m, by points of third degree of the noise.

    Args:
        sensor: one that ``locates``.
        z: the measurements, without missing elements.
        u: ``(K, k)`` what the sensor needs to know, or None.
    """
    unit = sensor.measurement_noise(z)
    eye = torch.eye(sensor.size, dtype=z.dtype, device=z.device).expand(len(z), -1, -1)
    offsets = (sensor.size**0.5 * unit.colour(eye)).movedim(-1, 0)  # (m, K, m)
    points = sensor.locate(torch.cat([z.unsqueeze(0), z + offsets, z - offsets]))
    if u is not None and isinstance(sensor, RangeBearing):  # it stands there
        points = points + u[..., : sensor.size]
    spread = (points[1:] - points[:1]).movedim(0, -1) / (2 * sensor.size) ** 0.5
    return Gaussian(points[0], tria(spread))


def known_components(motion: Motion) -> Tensor:
    """Numbers ``(2 dims,)`` of the components of a state that are its position and velocity, in space."""
    if isinstance(motion, Spherical):
        return torch.arange(2 * motion.dims)
    whole = torch.arange(motion.size)
    return torch.cat([whole[motion.position], whole[motion.velocity]])


def from_cartesian(motion: Motion, belief: Gaussian) -> Gaussian:
    """Beliefs of ``[position, velocity, ...]`` in the coordinates of a motion."""
    return belief_from_cartesian(belief, motion.azimuth_from) if isinstance(motion, Spherical) else belief


def to_cartesian(motion: Motion, belief: Gaussian) -> Gaussian:
    """The reverse of ``from_cartesian``."""
    return belief_to_cartesian(belief, motion.azimuth_from) if isinstance(motion, Spherical) else belief
