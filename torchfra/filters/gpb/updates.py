"""The update of unknowns, ``N(0, I)`` before, by a block of a measurement, for several sizes of its noise at once."""

from __future__ import annotations

import math
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.gaussian.mixture import matched
from torchfra.types import Gaussian


class Density(NamedTuple):
    """Of a measurement, constants left out, for ``C`` sizes of its noise: ``factor exp(exponent)``.

    So what shares weights among the sizes takes no logarithm of each.
    """

    exponent: Tensor
    """``(C, ...)``"""
    factor: Tensor
    """``(C, ...)`` above 0."""

    def log(self, i: int) -> Tensor:
        """Its log ``(...)`` for one size."""
        return self.exponent[i] + self.factor[i].log()


class Updated(NamedTuple):
    """The unknowns after a block of a measurement, for ``C`` sizes of its noise."""

    mean: Tensor
    """``(C, ..., k)``"""
    roots: Tensor
    """``(C, ..., k, k)`` any roots of the covariances; with ``shares``, ``(J, ..., k, k)`` of parts of all of them."""
    shares: Tensor | None
    """``(J, C, ...)`` factors on these parts in each covariance, which is their sum."""

    def of(self, i: int) -> Gaussian:
        """The unknowns by one size, with any root."""
        if self.shares is None:
            return Gaussian(self.mean[i], self.roots[i])
        columns = self.shares[:, i].sqrt()[..., None, None] * self.roots
        return Gaussian(self.mean[i], columns.movedim(0, -2).flatten(-2))

    def merged(self, roots: Tensor) -> Gaussian:
        """The unknowns by the last sizes merged into one, by square ``roots (C or less, ...)`` of probabilities."""
        last = slice(-len(roots), None)
        if self.shares is None:
            return matched(Gaussian(self.mean[last], self.roots[last]), roots)
        no_columns = self.mean[last].unsqueeze(-1)[..., :0]
        mean, of_means = matched(Gaussian(self.mean[last], no_columns), roots, triangular=False)
        columns = (roots.square() * self.shares[:, last]).sum(1).sqrt()[..., None, None] * self.roots
        return Gaussian(mean, torch.cat([columns.movedim(0, -2).flatten(-2), of_means], -1))

    def before_prior(self, first: int, count: int) -> Updated:
        """The ``first`` sizes, and behind them ``count`` that leave the unknowns as they were."""
        mean = torch.cat([self.mean[:first], torch.zeros_like(self.mean[:1]).expand(count, *self.mean.shape[1:])])
        if self.shares is None:
            eye = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)
            return Updated(mean, torch.cat([self.roots[:first], eye.expand(count, *self.roots.shape[1:])]), None)
        whole = self.roots[0, ..., 0, 0].square().reciprocal()  # the first part is a multiple of the identity
        prior = torch.stack([whole, *[torch.zeros_like(whole)] * (len(self.roots) - 1)]).unsqueeze(1)
        prior = prior.expand(-1, count, *self.shares.shape[2:])
        return Updated(mean, self.roots, torch.cat([self.shares[:, :first], prior], 1))


def update(
    rows: Tensor, residual: Tensor, noise: Tensor, missing: Tensor, offsets: Tensor | None = None
) -> tuple[Updated, Density]:
    """The update of unknowns by the elements of a measurement of independent noise, for ``C`` sizes of noise.

    Args:
        rows: ``(..., m, k)`` measurement matrix of the unknowns, which are ``N(0, I)`` before.
        residual: ``(..., m)``.
        noise: ``(C, ...)`` standard deviations of the noise, in units of what the sensor states; their squares may
            overflow, and that of a residual only beside a last one of its size.
        missing: ``(..., m)`` 1 where missing, 0 where measured.
        offsets: ``(C, ...)`` mean of the noise, in units of what the sensor states; None for 0.

    Returns:
        The posterior, and the density of the measurement.
    """
    m, k = rows.shape[-2:]
    if offsets is not None:
        residual = residual - offsets.unsqueeze(-1) * (1 - missing)
    noise = noise.clamp_max(torch.finfo(noise.dtype).max / 4)  # infinite noise tells nothing, and no quotient is NaN
    return (_together if m == k <= 2 else _sequential)(rows, residual, noise, missing)


def _together(rows: Tensor, residual: Tensor, noise: Tensor, missing: Tensor) -> tuple[Updated, Density]:
    """``update`` by one element or two, as many as there are unknowns, without a root for each size.

    Let ``N`` be the adjugate of the rows ``L``, ``T`` the sum of the squares of their entries, and ``1/s`` the variance
    of the noise.  The covariance of the residual, times ``s``, has the determinant ``F = 1 + s T + s^2 det(L)^2``, and
    the posterior has the covariance ``(I + s N N^T) / F``.  No difference loses digits, and of all sizes together a
    root has the columns of ``I`` and ``N`` alone, besides those of their means.  Everything is divided by ``1 + T``,
    and residuals by the last noise, so that nothing overflows that single precision holds.
    """
    squares, k = rows.square().sum((-2, -1)), rows.shape[-1]
    width = (1 + squares).sqrt()[..., None]  # of the prior in some direction, in units of the noise
    narrow = 1 / width
    scaled, share = rows * narrow[..., None], narrow[..., 0].square()
    inverse, largest = 1 / noise, noise[-1:]
    # Less, of noise whose square overflows, is nothing beside 1 either, and the root of that has a derivative.
    s, times = inverse.square().clamp_min(torch.finfo(noise.dtype).tiny), largest * inverse
    residual = residual / largest[..., None]
    mean = (scaled.mT @ residual[..., None])[..., 0] * narrow
    distance, across = share * residual.square().sum(-1), s * (1 - share)
    roots = (torch.eye(k, dtype=rows.dtype, device=rows.device) * narrow[..., None]).unsqueeze(0)
    if k == 2:
        a, b, c, d = scaled.flatten(-2).unbind(-1)
        area = (a * d - b * c)[..., None] * width
        adjugate = torch.stack([d, -b, -c, a], -1).unflatten(-1, (2, 2))
        turned = (adjugate @ residual[..., None])[..., 0]
        distance = distance + s * turned.square().sum(-1)
        mean = mean + s[..., None] * (area * turned)
        across = across + (s * area[..., 0]).square()
        roots = torch.cat([roots, adjugate.unsqueeze(0)])
    factor = 1 / (share + across)
    shares = torch.stack([factor, s * factor][:k])
    distance = times * (times * (factor * distance))
    density = Density(-0.5 * distance - (1 - missing).sum(-1) * noise.log(), factor.sqrt() * narrow[..., 0])
    return Updated((times * inverse * factor)[..., None] * mean, roots, shares), density


def _sequential(rows: Tensor, residual: Tensor, noise: Tensor, missing: Tensor) -> tuple[Updated, Density]:
    """``update`` by one element after the other.

    Each row is one more column of the joint root, of length ``noise`` at first, which plane rotations with one column
    of the unknowns after another make longer until it holds what the row says of all of them.  Each rotation keeps the
    digits of its two columns, whatever their scales: where little is known beside the noise, the difference of the
    identity and what a row says would lose them.

    Source: Carlson (1973), "Fast Triangular Formulation of the Square Root Filter".
    """
    rows = rows.movedim((-2, -1), (0, 1)).contiguous().unsqueeze(2)  # sums over short first dimensions are fast
    m, k, rank = rows.shape[0], rows.shape[1], rows.dim() - 2
    columns = list(torch.eye(k, dtype=rows.dtype, device=rows.device).reshape(k, k, *(1,) * rank).unbind(1))
    mean, squares, stds = torch.zeros_like(rows[0]), torch.zeros_like(residual[..., 0]), []
    sizes, small = noise.square(), small_power(noise.dtype)
    far = sizes == torch.inf  # the unknowns vary little beside such noise
    log_scale = torch.where(far, torch.full_like(noise, math.log(small)), 0.0)
    for i in range(m):
        square, std, cross = sizes, noise, torch.zeros_like(mean)
        for j, column in enumerate(columns):
            f = (column * rows[i]).sum(0)
            square = square + f.square()
            longer = torch.where(far, noise, square.sqrt())
            cosine, sine = std / longer, f / longer
            columns[j], cross, std = cosine * column - sine * cross, cosine * cross + sine * column, longer
        normalised = (residual[..., i] - (mean * rows[i]).sum(0)) / std
        mean = mean + cross * normalised
        squares = squares + normalised.square()
        stds.append(torch.where(missing[..., i] > 0, 1.0, torch.where(far, small * std, std)))
    # The log of two factors at a time: their product does not overflow where their squares do not.
    log_density = -0.5 * squares + (1 - missing).sum(-1) * log_scale
    for i in range(0, m, 2):
        log_density = log_density - reduce(torch.mul, stds[i : i + 2]).log()
    root = torch.stack(torch.broadcast_tensors(*columns), -1)
    return Updated(mean.movedim(0, -1), root.movedim(0, -2), None), Density(log_density, torch.ones_like(log_density))


def small_power(dtype: torch.dtype) -> float:
    """A power of two by which numbers whose squares overflow are multiplied, so that they do not."""
    return 0.25 * math.sqrt(torch.finfo(dtype).tiny)
