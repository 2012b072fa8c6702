"""Comparison of a measurement with a belief so wide that sigma points show no slope of the sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce

import torch

from torchfra.gaussian.inputs import Frame
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Whitened

BLIND = 0.02
"""Share of a predicted element's variance that its slope must explain; below it the points show no slope."""
NEAR = 0.01
"""Scale of the points around the mean that give the slope there instead."""


def by_points_or_slope(compare: Callable[[Gaussian], Whitened], belief: Gaussian) -> Whitened:
    """Compares the measurement with a predicted belief; elements whose points show no slope by the slope at the mean.

    Args:
        compare: compares the measurement with a belief by the belief's points.
        belief: ``(..., n)`` predicted.
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


def compare_linear(sensor: Sensor, belief: Gaussian, frame: Frame) -> Whitened:
    """Compares the measurement of a linear sensor with a predicted belief ``(..., n)``, without points."""
    d, noise = sensor.reads, frame.measurement_noise
    mean, root = belief.mean[..., :d], belief.scale_tril[..., :d, :d]
    residual = noise.whiten(sensor.difference(frame.z, sensor(mean)).unsqueeze(-1)).squeeze(-1)
    return Whitened(residual, noise.whiten(sensor(root.mT).mT), d)


def elements_of(whitened: Whitened, elements: Sequence[int]) -> Whitened:
    """The comparison of some elements of the measurement."""
    residual, spread = whitened.residual, whitened.spread
    if len(elements) == residual.shape[-1]:
        return whitened
    residual = torch.stack([residual[..., i] for i in elements], -1)
    spread = torch.stack([spread[..., i, :] for i in elements], -2)
    return whitened._replace(residual=residual, spread=spread)
