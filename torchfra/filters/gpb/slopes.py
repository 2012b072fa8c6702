"""Comparison of a measurement with a belief so wide that sigma points show no slope of the sensor, or not that nearby.

The slope is that of the statistical linearisation: see ``gaussian.rules``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.gaussian.update import correct
from torchfra.linalg.safe import safe_divide
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import apply, hstack
from torchfra.types import Gaussian, Whitened

LEAST_SHARE = 0.02
"""Share of a predicted element's variance that its slope must explain; below it the points show no slope."""
NEAR = 0.01
"""Scale of the points around the mean that give the slope there instead."""

LARGEST_REST = 3.0
"""Standard deviations of its noise by which a measured element may be off a line, so that points of the belief itself
give that line."""
ITERATIONS = 4
"""Gauss-Newton steps to the place of a measurement: enough for one as far away as the sensor."""


class Line(NamedTuple):
    """A measurement as a linear function of the state, near the place where it was measured."""

    point: Tensor
    """``(..., d)`` that place."""
    residual: Tensor
    """``(..., m)`` of it, in units of the noise."""
    rows: Tensor
    """``(..., m, d)`` slope."""
    rest: Tensor
    """``(..., m, r)`` root of the covariance of what a line leaves out."""


def line_at_place(compare: Callable[[Gaussian], Whitened], belief: Gaussian) -> Line:
    """The line at the place that a belief and a measurement have in common, by Gauss-Newton steps.

    It leaves out what the measurement is off a line as far away as it was still off before the last step.

    Args:
        compare: compares the measurement with a belief by the belief's points.
        belief: ``(..., d)`` predicted.

    Source: Bell & Cathey (1993) for the update as Gauss-Newton steps; Garcia-Fernandez et al. (2015) for the points of
    the belief afterwards.
    """
    mean, root = belief
    point, std = mean, NEAR * root.square().sum(-1).sqrt()
    for _ in range(ITERATIONS):
        line = _line(compare, point, std)
        # Damped: with noise as large as what is left, a step goes no farther than the line is good for.
        left = line.residual.square().mean(-1, keepdim=True).clamp_min(1.0).sqrt()
        residual = (line.residual + apply(line.rows, point - mean)) / left
        slope = line.rows @ root / left.unsqueeze(-1)
        (point, lower), _, _ = correct(belief, Whitened(residual, slope, slope.shape[-1]))
    return _line(compare, point, lower.square().sum(-1).sqrt())


def _line(compare: Callable[[Gaussian], Whitened], point: Tensor, std: Tensor) -> Line:
    """The line by points around one, with standard deviations ``(..., d)``."""
    seen = compare(Gaussian(point, torch.diag_embed(std)))
    return Line(point, seen.residual, safe_divide(seen.slope, std.unsqueeze(-2)), seen.rest)


def along(line: Line, belief: Gaussian) -> Whitened:
    """A measurement compared with a belief ``(..., d)`` by a line."""
    residual = line.residual + apply(line.rows, line.point - belief.mean)
    return Whitened(residual, hstack(line.rest, line.rows @ belief.scale_tril), belief.mean.shape[-1])


def bend(compare: Callable[[Gaussian], Whitened], belief: Gaussian) -> Tensor:
    """By how much each element ``(..., m)`` is off the line of a belief's points where the update by them arrives.

    In units of the noise, per unit of the variance that the line gives the element: half as wide a belief is off by a
    quarter.  It is 0 where even the line leaves more than ``LARGEST_REST`` of the measurement.  Points on the axes of a
    belief do not show it where an element depends on a product of two components, as a bearing does on those along and
    across.
    """
    seen, d = compare(belief), belief.mean.shape[-1]
    eye = torch.eye(d, dtype=belief.mean.dtype, device=belief.mean.device)
    (unknown, lower), _, _ = correct(Gaussian(torch.zeros_like(belief.mean), eye.expand_as(belief.scale_tril)), seen)
    mean, root = belief
    there = compare(Gaussian(mean + apply(root, unknown), NEAR * (root @ lower)))
    left = seen.residual - apply(seen.slope, unknown)
    reached = (left.abs() <= LARGEST_REST).all(-1, keepdim=True)
    off = torch.where(reached, (there.residual - left).abs(), 0.0)
    return safe_divide(off, seen.slope.square().sum(-1)).detach()  # for a choice alone


def by_points_or_line(wide: Whitened, bent: Tensor, near: Callable[[], Whitened]) -> Whitened:
    """``wide``, by points of a belief, where they are on a line to ``LARGEST_REST``; elsewhere ``near`` the place.

    Args:
        wide: the comparison by points.
        bent: ``(..., m)`` from ``bend``.
        near: makes the comparison by the line where the measurement places the target.
    """
    off = wide.rest.square().sum(-1).amax(-1) > LARGEST_REST**2
    off = off | ((bent * wide.slope.square().sum(-1)).amax(-1) > LARGEST_REST)
    some = off.any()  # rarely true; only then is the line computed, in kernels as well
    if not is_traced(some) and not some:
        return wide
    there = near()
    spread = torch.where(off[..., None, None], there.spread, wide.spread)
    residual = torch.where(off.unsqueeze(-1), there.residual, wide.residual)
    return Whitened(torch.where(some, residual, wide.residual), torch.where(some, spread, wide.spread), wide.reads)


def by_points_or_slope(compare: Callable[[Gaussian], Whitened], belief: Gaussian) -> Whitened:
    """Compares the measurement with a predicted belief; elements whose points show no slope by the slope at the mean.

    Args:
        compare: compares the measurement with a belief by the belief's points.
        belief: ``(..., n)`` predicted.
    """
    wide = compare(belief)
    slope, rest = wide.slope, wide.rest
    slope = reduce(torch.add, slope.square().unbind(-1), slope.new_zeros(()))
    rest = reduce(torch.add, rest.square().unbind(-1), rest.new_zeros(()))
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
