"""What a measurement says of beliefs that are wider than the sensor's points can tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce

import torch

from torchfra.gaussian.inputs import Frame
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Whitened

BLIND = 0.02
"""Share of a predicted element's variance below which the slope of its points counts for nothing."""
NEAR = 0.01
"""Scale of the points that then stand for the slope at the mean."""


def by_points_or_slope(compare: Callable[[Gaussian], Whitened], belief: Gaussian) -> Whitened:
    """The measurement against a predicted belief; elements whose points show no slope, by that at the mean.

    Args:
        compare: the measurement against a belief, by its points.
        belief: ``(..., n)``.
    """
    mean, root = belief
    both = compare(Gaussian(mean.expand(2, *mean.shape), torch.stack([root, NEAR * root])))
    slope, rest = (reduce(torch.add, x[0].square().unbind(-1), x.new_zeros(())) for x in (both.slope, both.rest))
    blind = slope < BLIND * (slope + rest)
    some = blind.any()  # hardly ever: in kernels the points nearby are then not computed
    (wide, near), spread = both.residual, both.spread
    steep = torch.where(blind.unsqueeze(-1), spread[1] / NEAR, spread[0])
    return Whitened(
        torch.where(some, torch.where(blind, near, wide), wide), torch.where(some, steep, spread[0]), both.reads
    )


def exactly(sensor: Sensor, belief: Gaussian, frame: Frame) -> Whitened:
    """The measurement against a predicted belief ``(..., n)``, of a sensor that is linear: no points are needed."""
    d, noise = sensor.reads, frame.measurement_noise
    mean, root = belief.mean[..., :d], belief.scale_tril[..., :d, :d]
    residual = noise.whiten(sensor.difference(frame.z, sensor(mean)).unsqueeze(-1)).squeeze(-1)
    return Whitened(residual, noise.whiten(sensor(root.mT).mT), d)


def of_elements(whitened: Whitened, elements: Sequence[int]) -> Whitened:
    """What some elements measure."""
    residual, spread = whitened.residual, whitened.spread
    if len(elements) == residual.shape[-1]:
        return whitened
    residual = torch.stack([residual[..., i] for i in elements], -1)
    spread = torch.stack([spread[..., i, :] for i in elements], -2)
    return whitened._replace(residual=residual, spread=spread)
