"""Standard errors of fitted values, and which values the tracks identify: by Hessian, bootstrap and profiles."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.fitting.newton import Curvature, Sums, minimised
from torchfra.fitting.vector import NORMAL_95, Vector
from torchfra.numbers import as_number, is_integer
from torchfra.tables import text_table

KINDS = ("hessian", "sandwich")
WIDEST = math.log(10.0)
"""Widest 95 % interval of an identified value, in unconstrained units: a factor of 10 for a value above 0."""
LARGEST_GRADIENT = 0.5
"""Size of the gradient at the fitted values, in its standard errors, above which they are not at a minimum."""
LARGEST_RATIO = 1.6
"""Ratio of scatter (``Certainty.ratio``) above which the two kinds of standard errors differ by a quarter."""
WITHIN = 3.841458820694124
"""Twice the increase of minus the log likelihood at the ends of a 95 % interval: chi-squared of one degree."""


class Certainty(NamedTuple):
    """Standard errors and identifiability of the values at the end of a fit."""

    covariance: Tensor
    """``(P, P)`` of the unconstrained values; NaN where the loss has no minimum here."""
    errors: Tensor
    """``(P,)`` standard errors in natural units."""
    low: Tensor
    """``(P,)`` lower ends of the 95 % intervals, in natural units."""
    high: Tensor
    """``(P,)`` upper ends of the 95 % intervals, in natural units."""
    identified: list[bool]
    """For each value, whether its interval is narrower than ``WIDEST``."""
    condition: float
    """Condition number of the Hessian scaled to a unit diagonal: 1 if values do not depend on each other, infinite if
    the tracks do not identify some direction at all."""
    weakest: str
    """The direction that the tracks identify least, in words."""
    gradient_size: float
    """Size of the gradient in units of its standard errors, 0 at a minimum."""
    ratio: float
    """Scatter of the tracks' gradients over its expectation by the Hessian: 1 if the loss is the likelihood of a model
    that holds, and only then are standard errors by the Hessian right (White's information matrix)."""
    kind: str
    """``"hessian"`` or ``"sandwich"``."""
    scattered: bool
    """Whether there are more tracks than values, so that their gradients have a scatter: ``ratio`` is NaN otherwise."""

    @property
    def notes(self) -> list[str]:
        """Warnings, one line each."""
        lines = []
        if self.kind == "sandwich" and not self.scattered:
            lines.append("no more tracks than values: there is no scatter that would give standard errors")
        elif bool(self.covariance.isnan().any()):
            lines.append("the loss has no minimum here: there are no standard errors")
        elif not self.gradient_size <= LARGEST_GRADIENT:
            lines.append(
                f"the gradient is {self.gradient_size:.2g} of its standard errors from 0: standard errors are rough"
            )
        elif self.kind == "hessian" and self.scattered and not 1 / LARGEST_RATIO < self.ratio < LARGEST_RATIO:
            scatter = f"gradients of tracks scatter {self.ratio:.2g} times as the Hessian says"
            lines.append(f"{scatter}, so the model does not hold: take errors='sandwich'")
        return lines


def certainty(vector: Vector, raw: Tensor, curvature: Curvature, kind: str) -> Certainty:
    """Standard errors of the values ``raw (P,)``, and which of them are identified.

    Args:
        vector: of the values.
        raw: values at the minimum of the loss.
        curvature: of the loss at these values, of one problem.
        kind: ``"hessian"``, right if the loss is minus the log likelihood of a model that holds; or ``"sandwich"``,
            right for any loss of many independent tracks.

    Source: van der Vaart (1998), "Asymptotic Statistics", theorem 5.23; White (1982), Econometrica 50.
    """
    hessian, scores = curvature.hessian[0], curvature.scores[0]
    eigenvalues, axes = torch.linalg.eigh(hessian.nan_to_num())
    known = kind == "hessian" or curvature.scattered
    if known and bool(hessian.isfinite().all()) and bool(eigenvalues[0] > 1e-12 * eigenvalues[-1].clamp_min(1e-300)):
        inverse = torch.linalg.inv(hessian)
        inner = inverse if kind == "hessian" else inverse @ scores @ inverse
    else:
        inner = torch.full_like(hessian, torch.nan)
    covariance = vector.directions @ inner @ vector.directions.mT
    reach = NORMAL_95 * covariance.diagonal().sqrt()
    scale = hessian.diagonal().clamp_min(0).sqrt()
    scaled = torch.linalg.eigvalsh((hessian / scale / scale.unsqueeze(-1)).nan_to_num())
    condition = float(scaled[-1] / scaled[0]) if scaled[0] > 0 else math.inf
    low, high = vector.intervals(raw, covariance)
    ratio = torch.linalg.lstsq(hessian.nan_to_num(), scores.nan_to_num()).solution.diagonal().mean()
    return Certainty(
        covariance, vector.errors(raw, covariance), low, high, (2 * reach < WIDEST).tolist(), condition,
        _words(vector, axes[:, 0], inner), float(curvature.gradient_size[0]),
        float(ratio) if curvature.scattered else math.nan, kind, curvature.scattered,
    )  # fmt: skip


def _words(vector: Vector, axis: Tensor, covariance: Tensor) -> str:
    """A direction ``axis (Q,)`` in words: the values that change, in the vector's order, and its standard error.

    The sign of an eigenvector is arbitrary, and equal shares have no order: the first value that changes goes up.
    """
    change = vector.directions @ axis
    shares = change / change.abs().max()
    main = [(share, name) for share, name in zip(shares.tolist(), vector.names, strict=True) if abs(share) > 0.3]
    words = ", ".join(f"{name} {'up' if share * main[0][0] > 0 else 'down'}" for share, name in main)
    error = float((axis @ covariance @ axis).clamp_min(0).sqrt())
    return f"{words}: standard error {error:.2g} in unconstrained values"


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
        ValueError: an unknown name, a probability of several that sum to one, or a value without a standard error;
            ``points`` or ``reach`` out of range.
    """
    vector = sums.objective.vector
    if not is_integer(points, 2) or not as_number(reach) > 0:
        raise ValueError(f"points, reach: expected 2 or more, and a number above 0, received {points!r}, {reach!r}")
    best = vector.natural(raw)[vector.names.index(name)].item() if name in vector.names else 1.0
    vector.unconstrained(name, [best])
    i = vector.names.index(name)
    error = certainty.covariance[i, i].sqrt()
    if not bool(error.isfinite()):
        raise ValueError(f"name: expected a value with a standard error, received {name}")
    fixed = raw.repeat(points, 1)
    fixed[:, i] += error * torch.linspace(-reach, reach, points, dtype=raw.dtype)
    others = sums.directions[:, sums.directions[i] == 0]
    least = sums.losses(raw[None])
    if others.shape[1]:
        fixed, curvature = minimised(Sums(sums.objective, sums.batch, others), fixed)
        growth = curvature.loss - least
    else:
        growth = sums.losses(fixed) - least
    return Profile(name, vector.natural(fixed)[:, i].tolist(), growth.tolist())


def bootstrap(sums: Sums, raw: Tensor, resamples: int, seed: int) -> Bootstrap:
    """Fits to tracks drawn with replacement, all at once, each from the best values.

    Args:
        sums: the loss of the tracks.
        raw: ``(P,)`` the best values.
        resamples: number of resamples.
        seed: of the draws.

    Raises:
        ValueError: fewer than 10 resamples, or no more tracks than values.

    Source: Efron & Tibshirani (1993), "An Introduction to the Bootstrap", chapter 6.
    """
    if not is_integer(resamples, 10):
        raise ValueError(f"resamples: expected 10 or more, received {resamples!r}")
    generator, count = torch.Generator().manual_seed(seed), len(sums.batch.z)
    if count <= sums.directions.shape[1]:
        expected = "more tracks than values to draw from (the Hessian gives the standard errors of a single series)"
        raise ValueError(f"bootstrap: expected {expected}, received {count}")
    drawn = torch.randint(count, (resamples, count), generator=generator)
    weights = torch.zeros(resamples, count, dtype=torch.float64).scatter_add(1, drawn, torch.ones_like(drawn).double())
    again = Sums(sums.objective, sums.batch, sums.directions, weights=weights)
    found, _ = minimised(again, raw.repeat(resamples, 1))
    vector = sums.objective.vector
    natural = vector.natural(found)
    low, high = natural.quantile(torch.tensor([0.025, 0.975], dtype=natural.dtype), dim=0).tolist()
    errors = natural.std(0).tolist()
    return Bootstrap(
        dict(zip(vector.names, errors, strict=True)),
        dict(zip(vector.names, zip(low, high, strict=True), strict=True)),
    )
