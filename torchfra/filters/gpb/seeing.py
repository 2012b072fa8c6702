"""What a measurement says of beliefs that are wider than the sensor's points can tell."""

from __future__ import annotations

from collections.abc import Callable

import torch

from torchfra.types import Gaussian, Whitened

BLIND, NEAR = 0.02, 0.01
"""Share of a predicted element's variance below which its slope counts for nothing; how wide points are then."""


def by_points_or_slope(compare: Callable[[Gaussian], Whitened], belief: Gaussian) -> Whitened:
    """The measurement against a predicted belief; elements whose points show no slope, by that at the mean.

    Args:
        compare: the measurement against a belief, by its points.
        belief: ``(..., n)``.
    """
    wide, near = compare(belief), compare(belief._replace(scale_tril=NEAR * belief.scale_tril))
    slope, rest = (x.square().sum(-1) for x in (wide.slope, wide.rest))
    blind = slope < BLIND * (slope + rest)
    spread = torch.where(blind.unsqueeze(-1), near.spread / NEAR, wide.spread)
    return Whitened(torch.where(blind, near.residual, wide.residual), spread, wide.reads)
