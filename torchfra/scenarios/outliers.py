"""Outliers that come in bursts."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

LENGTH, SIZE, SHARE = 4, 10.0, 0.05
"""Steps of a burst, how many times larger the standard deviation is in it, and its share of all steps."""


def burst_factors(
    rng: np.random.Generator, runs: int, steps: int, *, share: float = SHARE, size: float = SIZE
) -> Tensor:
    """Draws the factors on the standard deviation of the measurements ``(runs, steps, 1)``: 1 outside of bursts.

    A burst starts at any step with probability ``share / LENGTH``, lasts ``LENGTH`` steps and holds for all elements of
    a measurement alike.  Two that overlap are one longer burst, so that slightly less than ``share`` of the steps are
    in one.

    Args:
        rng: where random numbers come from.
        runs: how many runs.
        steps: measurements of a run.
        share: of the steps that are in a burst, about.
        size: the factor in a burst.
    """
    starts = rng.random((runs, steps)) < share / LENGTH
    inside = np.zeros_like(starts)
    for age in range(min(LENGTH, steps)):
        inside[:, age:] |= starts[:, : steps - age]
    return torch.from_numpy(np.where(inside, size, 1.0)).unsqueeze(-1)
