"""Comparison of a measurement with a belief so wide that sigma points show no slope of the sensor.

The slope is that of the statistical linearisation: see ``gaussian.rules``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce

import torch

from torchfra.linalg.tracing import is_traced
from torchfra.types import Gaussian, Whitened

LEAST_SHARE = 0.02
"""Share of a predicted element's variance that its slope must explain; below it the points show no slope."""
NEAR = 0.01
"""Scale of the points around the mean that give the slope there instead."""


def by_points_or_slope(compare: Callable[[Gaussian], Whitened], belief: Gaussian) -> Whitened:
    """Compares the measurement with a predicted belief; elements whose points show no slope by the slope at the mean.

    Args:
        compare: compares the measurement with a belief by the belief's points.
        belief: ``(..., n)`` predicted.
    """
    wide = compare(belief)
    slope, rest = (reduce(torch.add, x.square().unbind(-1), x.new_zeros(())) for x in (wide.slope, wide.rest))
    flat = slope < LEAST_SHARE * (slope + rest)
    some = flat.any()  # rarely true; only then are the points nearby computed, in kernels as well
    if not is_traced(some) and not some:
        return wide
    near = compare(Gaussian(belief.mean, NEAR * belief.scale_tril))
    spread = torch.where(flat.unsqueeze(-1), near.spread / NEAR, wide.spread)
    residual = torch.where(flat, near.residual, wide.residual)
    return Whitened(torch.where(some, residual, wide.residual), torch.where(some, spread, wide.spread), wide.reads)


def elements_of(whitened: Whitened, elements: Sequence[int]) -> Whitened:
    """The comparison of some elements of the measurement."""
    residual, spread = whitened.residual, whitened.spread
    if len(elements) == residual.shape[-1]:
        return whitened
    residual = torch.stack([residual[..., i] for i in elements], -1)
    spread = torch.stack([spread[..., i, :] for i in elements], -2)
    return whitened._replace(residual=residual, spread=spread)
