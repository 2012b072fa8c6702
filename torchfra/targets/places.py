"""Positions of measurements, and beliefs in Cartesian coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.coordinates import belief_from_cartesian, belief_to_cartesian
from torchfra.linalg.triangular import tria
from torchfra.motion.base import Motion
from torchfra.motion.spherical import Spherical
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian

_PROBES = (300.0, -700.0, 500.0), (-600.0, 200.0, 900.0)
"""Two positions of a trial target, m, from which the sensor's position is found."""


def place(
    motion: Motion, sensor: Sensor, z: Tensor, u: Tensor | None, std: Tensor | None = None, noise: Tensor | None = None
) -> Gaussian:
    """Positions ``(K, dims)`` of measurements ``(K, m)`` and their covariances, m, by third-degree points of the noise.

    Args:
        motion: of the targets.
        sensor: one that ``locates``.
        z: the measurements, without missing elements.
        u: ``(K, k)`` inputs of the sensor, or None.
        std: ``(K, m)`` standard deviations of the noise, instead of the sensor's.
        noise: ``(K, m, m)`` roots of its covariance, instead of the sensor's.

    Raises:
        ValueError: ``u`` tells the sensor more than where it stands, so that it does not locate in the motion's axes.
    """
    unit = sensor.measurement_noise(z, std, noise)
    eye = torch.eye(sensor.size, dtype=z.dtype, device=z.device)
    offsets = (sensor.size**0.5 * unit.colour(eye)).movedim(-1, 0)  # (m, K, m), before K what batch the noise has
    points = sensor.locate(torch.cat([z.expand_as(offsets[:1]), z + offsets, z - offsets]))
    if u is not None and len(z):
        points = points + _stands(motion, sensor, u)
    spread = (points[1:] - points[:1]).movedim(0, -1) / (2 * sensor.size) ** 0.5
    return Gaussian(points[0], tria(spread))


def _stands(motion: Motion, sensor: Sensor, u: Tensor) -> Tensor:
    """Positions ``(K, dims)`` of sensors, m: a target's position minus its position relative to the sensor."""
    position = u.new_tensor(_PROBES)[:, : motion.dims]
    mean = u.new_zeros(2, motion.size).index_copy(-1, known_components(motion)[: motion.dims].to(u.device), position)
    root = torch.eye(motion.size, dtype=u.dtype, device=u.device).expand(2, -1, -1)
    x = from_cartesian(motion, Gaussian(mean, root)).mean.unsqueeze(1).expand(-1, len(u), -1)
    off: Tensor = position.unsqueeze(1) - sensor.locate(sensor.at_points(x, u))
    one, other = off.unbind()
    rounding = torch.finfo(u.dtype).eps ** 0.5 * (1e3 + one.abs().amax())
    if not bool((one - other).abs().amax() <= rounding):
        expected = "to tell no more than where the sensor stands, as births need"
        raise ValueError(f"u: expected {expected}, received one that changes more of {sensor.describe()}")
    return one


def known_components(motion: Motion) -> Tensor:
    """Indices ``(2 dims,)`` of the components of a state that are position and velocity; ``(dims,)`` without one."""
    if isinstance(motion, Spherical):
        return torch.arange(2 * motion.dims)
    components = torch.arange(motion.size)
    return torch.cat([components[motion.position], components[motion.velocity]])


def from_cartesian(motion: Motion, belief: Gaussian) -> Gaussian:
    """Beliefs of Cartesian ``[position, velocity, ...]``, in the coordinates of a motion."""
    return belief_from_cartesian(belief) if isinstance(motion, Spherical) else belief


def positions(motion: Motion, belief: Gaussian) -> Gaussian:
    """Cartesian positions ``(..., dims)`` of beliefs in the coordinates of a motion; roots are ``(..., dims, n)``."""
    mean, root = belief_to_cartesian(belief) if isinstance(motion, Spherical) else belief
    at = known_components(motion)[: motion.dims]
    return Gaussian(mean[..., at], root[..., at, :])


def velocities(motion: Motion, belief: Gaussian) -> Tensor:
    """Cartesian velocities ``(..., dims)``, m/s, of the means of beliefs in the coordinates of a motion."""
    mean = belief_to_cartesian(belief).mean if isinstance(motion, Spherical) else belief.mean
    return mean[..., known_components(motion)[motion.dims :].to(mean.device)]
