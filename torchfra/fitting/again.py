"""Further fits from the best values: to resampled tracks (bootstrap), and with one value fixed (profile)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.fitting.errors import Certainty
from torchfra.fitting.newton import Sums, minimised
from torchfra.tables import text_table

WITHIN = 3.841458820694124
"""Twice the increase of minus the log likelihood at the ends of a 95 % interval: chi-squared of one degree."""


class Profile(NamedTuple):
    """The profile of the loss: its minimum with one value fixed, for several of its values."""

    name: str
    values: list[float]
    """In natural units, ascending."""
    growth: list[float]
    """Increase of the loss of all tracks together above its minimum."""

    @property
    def inside(self) -> list[float]:
        """The values that a likelihood ratio test does not reject at 5 %; meaningful for likelihoods only."""
        return [v for v, growth in zip(self.values, self.growth, strict=True) if 2 * growth <= WITHIN]

    def __str__(self) -> str:
        rows = [[f"{v:.5g}", f"{growth:.3f}"] for v, growth in zip(self.values, self.growth, strict=True)]
        return text_table([self.name, "loss above its least"], rows, align=">")


class Bootstrap(NamedTuple):
    """Fits to resampled tracks."""

    errors: dict[str, float]
    """Standard errors in natural units: standard deviations over the resamples."""
    intervals: dict[str, tuple[float, float]]
    """95 % intervals: percentiles over the resamples."""

    def __str__(self) -> str:
        rows = [[name, f"{error:.2g}", "[{:.5g}, {:.5g}]".format(*self.intervals[name])]
                for name, error in self.errors.items()]  # fmt: skip
        return text_table(["value", "standard error", "95 %"], rows)


def profile(
    sums: Sums, raw: Tensor, certainty: Certainty, name: str, *, points: int = 9, reach: float = 3.0
) -> Profile:
    """The profile of the loss over one value, by one minimisation for all of its values at once.

    Args:
        sums: the loss of the tracks.
        raw: ``(P,)`` the best values.
        certainty: of the best values.
        name: of the fixed number, ``"motion.q"``.
        points: number of its values.
        reach: standard errors to either side.

    Raises:
        ValueError: an unknown name, one of odds that sum to one, or a value without a standard error; ``points`` or
            ``reach`` out of range.
    """
    vector = sums.objective.vector
    if not isinstance(points, int) or points < 2 or not reach > 0:
        raise ValueError(f"points, reach: expected 2 or more, and a number above 0, received {points!r}, {reach!r}")
    best = vector.natural(raw)[vector.names.index(name)].item() if name in vector.names else 1.0
    vector.unconstrained(name, [best])
    i = vector.names.index(name)
    error = certainty.covariance[i, i].sqrt()
    if not bool(error.isfinite()):
        raise ValueError(f"name: expected a value with a standard error, received {name}")
    fixed = raw.repeat(points, 1, 1)
    fixed[:, 0, i] += error * torch.linspace(-reach, reach, points, dtype=raw.dtype)
    others = sums.directions[:, sums.directions[i] == 0]
    least = sums.losses(raw[None, None])[0, 0]
    if others.shape[1]:
        fixed, curvature = minimised(Sums(sums.objective, sums.batch, others), fixed)
        growth = curvature.loss[:, 0] - least
    else:
        growth = sums.losses(fixed)[:, 0] - least
    return Profile(name, vector.natural(fixed[:, 0])[:, i].tolist(), growth.tolist())


def bootstrap(sums: Sums, raw: Tensor, resamples: int, seed: int) -> Bootstrap:
    """Fits to tracks drawn with replacement, all at once, each from the best values.

    Args:
        sums: the loss of the tracks.
        raw: ``(P,)`` the best values.
        resamples: number of resamples.
        seed: of the draws.

    Raises:
        ValueError: fewer than 10 resamples.

    Source: Efron & Tibshirani (1993), "An Introduction to the Bootstrap", chapter 6.
    """
    if not isinstance(resamples, int) or resamples < 10:
        raise ValueError(f"resamples: expected 10 or more, received {resamples!r}")
    generator, count = torch.Generator().manual_seed(seed), len(sums.batch.z)
    drawn = torch.randint(count, (resamples, count), generator=generator)
    weights = torch.zeros(resamples, count, dtype=torch.float64).scatter_add(1, drawn, torch.ones_like(drawn).double())
    again = Sums(sums.objective, sums.batch, sums.directions, weights=weights)
    found, _ = minimised(again, raw.repeat(resamples, 1, 1))
    vector = sums.objective.vector
    natural = vector.natural(found[:, 0])
    low, high = natural.quantile(torch.tensor([0.025, 0.975], dtype=natural.dtype), dim=0).tolist()
    errors = natural.std(0).tolist()
    return Bootstrap(
        dict(zip(vector.names, errors, strict=True)),
        dict(zip(vector.names, zip(low, high, strict=True), strict=True)),
    )
