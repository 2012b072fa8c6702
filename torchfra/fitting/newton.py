"""Newton's method for many sets of values at once, by differences of gradients: all are one call of the filter."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.fitting.data import Batch
from torchfra.fitting.objective import Objective

STEP = 1e-4
"""Difference of the unconstrained values, in float64: errors near 1e-8 of the curvature."""
LENGTHS = (1.0, 0.5, 0.2, 0.05, 0.01)
"""Lengths of a step that are tried at once."""
LONGEST = 2.0
"""Longest step, in unconstrained values: a factor of 7 for what is above 0."""
ITERATIONS = 30
"""Largest number of iterations."""
CONVERGED = 1e-4
"""Size of the gradient, in its standard errors, below which it counts as 0."""
CHAOTIC = 30.0
"""Ratio to the median over tracks above which the curvature of a track's loss counts as chaotic."""


class Curvature(NamedTuple):
    """The sums over tracks of each of R problems, in Q directions."""

    loss: Tensor
    """``(R,)``."""
    gradient: Tensor
    """``(R, Q)``."""
    scores: Tensor
    """``(R, Q, Q)`` of the outer products of tracks' gradients."""
    hessian: Tensor
    """``(R, Q, Q)``."""
    scattered: bool
    """Whether there are more tracks than directions, so that their gradients show how much the sum of these varies."""
    likelihood: bool
    """Whether the loss is minus a log likelihood, whose gradients vary as the Hessian says where the model holds."""

    @property
    def gradient_size(self) -> Tensor:
        """``(R,)`` size of the gradient in units of its standard errors, 0 at a minimum.

        Of too few tracks they are those that the Hessian of a likelihood says; of another loss nobody knows them, and
        any gradient but 0 is infinitely large.
        """
        if not self.scattered and not self.likelihood:
            return torch.where((self.gradient != 0).any(-1), torch.inf, 0.0).to(self.gradient)
        variance = self.scores if self.scattered else _upwards(self.hessian)
        solved = torch.linalg.pinv(variance, hermitian=True) @ self.gradient.unsqueeze(-1)
        square: Tensor = (self.gradient * solved.squeeze(-1)).sum(-1)
        return square.clamp_min(0).sqrt()


class Sums:
    """Sums of the losses of tracks.

    Args:
        objective: the loss of each track.
        batch: the tracks, in float64.
        directions: ``(P, Q)`` in which values may change.
        weights: ``(R, N)`` how often each track counts in each problem; once if None.
    """

    def __init__(self, objective: Objective, batch: Batch, directions: Tensor, weights: Tensor | None = None) -> None:
        self.objective, self.batch, self.directions, self.weights = objective, batch, directions, weights

    def losses(self, raw: Tensor) -> Tensor:
        """``(R,)`` at ``raw (R, P)``; infinite where they are NaN."""
        return self._summed(self.objective.losses(raw.unsqueeze(1), self.batch)).nan_to_num(nan=torch.inf)

    def curvature(self, raw: Tensor) -> Curvature:
        """At ``raw (R, P)``, by central differences along the directions."""
        loss, gradient, hessians = self.of_tracks(raw)
        scores = self._summed(gradient.unsqueeze(-1) * gradient.unsqueeze(-2), squared=True)
        scattered, likelihood = len(self.batch.z) > self.directions.shape[1], self.objective.loss == "likelihood"
        return Curvature(
            self._summed(loss), self._summed(gradient), scores, self._summed(hessians), scattered, likelihood
        )

    def of_tracks(self, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Losses ``(R, N)`` of single tracks, gradients ``(R, N, Q)`` and Hessians ``(R, N, Q, Q)``.

        All from one call of the filter: one step of the differences is enough in float64.  ``filters.hessian`` takes
        two, one after the other, and estimates their error.
        """
        offsets = STEP * torch.cat([torch.zeros_like(self.directions[:, :1]), self.directions, -self.directions], 1).mT
        points = (raw.unsqueeze(1) + offsets).flatten(0, 1)  # (R (1 + 2 Q), P)
        loss, gradient = self.objective.gradients(points.unsqueeze(1), self.batch)
        count = self.directions.shape[1]
        gradient = (gradient @ self.directions).unflatten(0, (len(raw), -1))  # (R, 1 + 2 Q, N, Q)
        change = (gradient[:, 1 : count + 1] - gradient[:, count + 1 :]).movedim(1, 2) / (2 * STEP)
        return loss.unflatten(0, (len(raw), -1))[:, 0], gradient[:, 0], (change + change.mT) / 2

    def not_chaotic(self, raw: Tensor) -> Tensor:
        """``(N,)`` bool: whether the curvature of each track's loss is near that of the others, at ``raw (1, P)``.

        The loss of a track on which the filter nearly diverges can change by any amount over a tiny change of the
        values.  A few such tracks would dominate the minimum of the sum and its curvature.
        """
        hessians = self.of_tracks(raw)[2][0]
        scale = median_of_nonzero(hessians.diagonal(dim1=-2, dim2=-1).abs(), 0).clamp_min(1e-300).sqrt()
        size = torch.linalg.matrix_norm(hessians / scale / scale.unsqueeze(-1))
        regular: Tensor = size <= CHAOTIC * median_of_nonzero(size, 0)
        return regular

    def _summed(self, x: Tensor, squared: bool = False) -> Tensor:
        """``(R, ...)`` of ``x (R, N, ...)``."""
        if self.weights is not None:
            many = len(x) // len(self.weights)  # line searches try several values for each problem
            weights = self.weights.repeat_interleave(many, 0).reshape(*x.shape[:2], *(1,) * (x.dim() - 2))
            x = torch.where(weights > 0, x, 0.0) * (weights.square() if squared else weights)
        return x.sum(1)


def median_of_nonzero(x: Tensor, dim: int) -> Tensor:
    """Median along a dimension of the entries that are neither 0 nor NaN; 1 where there are none.

    What a filter decides reaches few tracks: the losses of all others do not depend on its threshold.
    """
    median: Tensor = torch.where(x != 0, x, torch.nan).nanmedian(dim).values
    return median.nan_to_num(nan=1.0)


def minimised(sums: Sums, raw: Tensor) -> tuple[Tensor, Curvature]:
    """The values ``(R, P)`` of the least sums nearby, and the curvature there.

    Directions of negative curvature are followed downhill.  A problem stays where no step lowers its sum.

    Args:
        sums: the losses.
        raw: ``(R, P)`` where the minimisation begins.
    """
    curvature = sums.curvature(raw)
    for _ in range(ITERATIONS):
        going = curvature.gradient_size > CONVERGED
        if not bool(going.any()):
            break
        steps = _steps(curvature) @ sums.directions.mT
        tried = raw.unsqueeze(1) + raw.new_tensor(LENGTHS).unsqueeze(-1) * steps.unsqueeze(1)  # (R, 5, P)
        losses = sums.losses(tried.flatten(0, 1)).unflatten(0, (len(raw), -1))  # (R, 5)
        best, which = losses.min(1)
        better = going & (best < curvature.loss)
        if not bool(better.any()):
            break
        raw = torch.where(better.unsqueeze(-1), tried[torch.arange(len(raw)), which], raw)
        curvature = sums.curvature(raw)
    return raw, curvature


def _upwards(hessian: Tensor) -> Tensor:
    """``(R, Q, Q)`` with the same axes, and the sizes of the curvatures."""
    curvatures, axes = torch.linalg.eigh(hessian.nan_to_num())
    upwards: Tensor = axes @ (curvatures.abs().unsqueeze(-1) * axes.mT)
    return upwards


def _steps(curvature: Curvature) -> Tensor:
    """``(R, Q)`` downhill: Newton's with the sizes of the curvatures."""
    hessian, gradient = curvature.hessian.nan_to_num(), curvature.gradient.nan_to_num()
    curvatures, axes = torch.linalg.eigh(hessian)
    curvatures = curvatures.abs()
    curvatures = torch.maximum(curvatures, 1e-10 * curvatures.amax(-1, keepdim=True)).clamp_min(1e-300)
    steps: Tensor = -(axes @ ((axes.mT @ gradient.unsqueeze(-1)) / curvatures.unsqueeze(-1))).squeeze(-1)
    longest: Tensor = torch.linalg.vector_norm(steps, dim=-1, keepdim=True).clamp_min(LONGEST)
    return LONGEST * steps / longest
