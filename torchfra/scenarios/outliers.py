"""Outliers of simulated measurements: independent, or in bursts."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from torchfra.hyper import one_of

LENGTH, SIZE, SHARE = 4, 10.0, 0.05
"""Steps of a burst, factor on the standard deviation in it, and the share of steps in bursts."""


def burst_factors(
    rng: np.random.Generator, runs: int, steps: int, *, share: float = SHARE, size: float = SIZE
) -> Tensor:
    """Draws the factors on the standard deviation of the measurements ``(runs, steps, 1)``: 1 outside of bursts.

    A burst starts at any step with probability ``share / LENGTH``, lasts ``LENGTH`` steps and holds for all elements of
    a measurement alike.  Two that overlap are one longer burst, so that slightly less than ``share`` of the steps are
    in one.

    Args:
        rng: the generator.
        runs: number of runs.
        steps: measurements of a run.
        share: approximate share of the steps in a burst.
        size: the factor in a burst.
    """
    starts = rng.random((runs, steps)) < share / LENGTH
    inside = np.zeros_like(starts)
    for age in range(min(LENGTH, steps)):
        inside[:, age:] |= starts[:, : steps - age]
    return torch.from_numpy(np.where(inside, size, 1.0)).unsqueeze(-1)


def outlier_factors(
    outliers: str, size: float | None, share: float
) -> Callable[[np.random.Generator, Sequence[int]], Tensor]:
    """A function ``(rng, shape)`` that draws the factor on the standard deviation of each measurement: 1 for most.

    Args:
        outliers: what is ``size`` times larger in an outlier: ``"covariance"`` or ``"std"``, or ``"none"``.
        size: the factor; None for an integer from 1 to 20, drawn each time.
        share: of the measurements that are outliers.

    Raises:
        ValueError: an argument out of its range.
    """
    one_of(outliers=(outliers, ("covariance", "std", "none")))
    if not (size is None or 1 <= size < float("inf")) or not 0 <= share <= 1:
        raise ValueError(f"size, share: expected a size of 1 or more and a share in [0, 1], received {size}, {share}")

    def draw(rng: np.random.Generator, shape: Sequence[int]) -> Tensor:
        outlying, drawn = torch.from_numpy(rng.random(shape)) < share, torch.from_numpy(rng.integers(1, 21, shape))
        times = drawn.double() if size is None else torch.full(tuple(shape), float(size), dtype=torch.float64)
        factor = {"covariance": times.sqrt(), "std": times, "none": torch.ones_like(times)}[outliers]
        return torch.where(outlying, factor, 1.0)

    return draw
