"""The scale of each block's measurement noise, learned on line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_divide, safe_sqrt
from torchfra.numbers import as_number
from torchfra.types import Gaussian

FARTHEST = 5.0
"""Residual of an inlier, root mean square of a block, in its standard deviations, beyond which it tells no more: one
that is farther off is none, or has no digits left, as where a jump goes to an outlier."""
FAR = 1e6
"""Innovation or residual in units of the noise beyond which its square is not needed and may not be a number."""


class LastResidual(NamedTuple):
    """What the last measurement of each element says about its noise once the next one has come.

    By hypotheses in which it is an inlier, each with its probability; before the first inlier they have a small sum.
    """

    residual: Tensor
    """``(..., m)`` after the update, in units of the noise."""
    excess: Tensor
    """``(..., m)`` its square, and the variance of what is measured, in those units, minus 1."""
    share: Tensor
    """``(..., m)`` 1 minus that variance: the share of the noise that a residual shows."""
    scale: Tensor
    """``(..., m)`` 1 over the standard deviation of the noise, in the units of the measurement."""
    weight: Tensor
    """``(..., m)`` the sum of these probabilities."""


class NoiseScale(NamedTuple):
    """What is known of the scale of each block's noise."""

    log_scale: Tensor
    """``(..., B)`` mean of the log of the factor on the variance that the sensor states."""
    variance: Tensor
    """``(..., B)`` variance of that log."""
    last: LastResidual
    """Of each element, which the next measurement judges."""


class LearnedNoise(nn.Module):
    """The factor on the variance of each block's measurement noise, learned from the inliers.

    Its log ``m`` is a first-order autoregressive process around 0, the noise as stated, which is known with variance
    ``v``.  Before a measurement of the block,

        m <- a m,          v <- a^2 v + (1 - a^2) d^2,      a = exp(-1 / memory).

    What a measurement says waits for the next one.  Of an inlier, let ``r`` be the residual after the update and ``h``
    the variance of what is measured, both in units of the noise, and ``e`` the innovation of the next measurement.  If
    the noise is as large as believed,

        x = r (r - e) + h - 1

    has mean 0, as innovations are white.  An estimate that lags behind the target by ``b``, as the process noise is
    stated too small, adds ``b`` to both ``r`` and ``e``, so that ``x`` keeps its mean, nearly; in ``r^2`` alone the lag
    would be noise, and more of it would let the estimate lag more.  The mean of ``x`` grows with ``m`` by about
    ``1 - h``, and its variance is ``(1 - h) c`` with ``c = 2 (1 - h) + s``, where ``s`` is the variance of ``e``, or
    its square where that is larger, as where a manoeuvre begins; an ``r`` of a block beyond ``FARTHEST`` of its own
    standard deviations counts as that far.  So after a measurement, with sums over the block's elements, and means of
    ``h`` and ``s`` in ``c``,

        v <- 1 / (1 / v + sum (1 - h) / c),      m <- m + v sum x / c.

    Args:
        doubt: standard deviation ``d`` of the log of that factor.
        memory: number of measurements after which what was learned has fallen to 37 %.
        least: factor on the stated variance below which the noise is not taken to be.  Errors that last, as of a
            receiver that smooths, look like motion: by ``x`` the noise is what is left of them, where it is stated
            large enough for them.

    Raises:
        ValueError: ``least`` is no number from 0 to 1.

    Source: Mehra (1970) for the noise from the correlation of innovations; Creal, Koopman & Lucas (2013) for values
    that follow a score, scaled by its information; Sarkka & Nummenmaa (2009) for learning the noise with forgetting.
    """

    def __init__(self, doubt: Value = 0.7, memory: Value = 400.0, least: float = 0.5) -> None:
        super().__init__()
        self.noise_least = as_number(least)
        if not 0 <= self.noise_least <= 1:
            raise ValueError(f"noise_least: expected a number from 0 to 1, received {least!r}")
        self.noise_doubt = Hyper(doubt, finite=True, name="noise_doubt")
        self.noise_memory = Hyper(memory, name="noise_memory")

    def begin(self, like: Tensor, size: int) -> NoiseScale:
        """The noise as stated, for ``like (..., B)`` and ``size`` elements."""
        none, empty = torch.zeros_like(like), like.new_zeros(*like.shape[:-1], size)
        return NoiseScale(none, none + self._doubt(like).square(), LastResidual(*[empty] * 5))

    def predict(self, noise: NoiseScale, measured: Tensor) -> NoiseScale:
        """What is known before a step.

        Args:
            noise: what was known after the step before.
            measured: ``(..., B)`` 1 where the step has a measurement of a block, else 0.
        """
        lasts = torch.exp(-measured / self.noise_memory(noise.log_scale).unsqueeze(-1))
        doubt = self._doubt(noise.log_scale)
        variance = lasts.square() * noise.variance + (1 - lasts.square()) * doubt.square()
        return noise._replace(log_scale=lasts * noise.log_scale, variance=variance)

    def update(
        self, noise: NoiseScale, frame: Frame, expected: Gaussian, inliers: Tensor, probability: Tensor,
        outlier: Tensor, blocks: Sequence[Sequence[int]],
    ) -> NoiseScale:  # fmt: skip
        """What is known after a step.

        Args:
            noise: from ``predict``.
            frame: of the step, with the noise as believed before it.
            expected: ``(..., m)`` the innovation, and a root of its covariance, in units of that noise.
            inliers: ``(3, 2, R, 2, ..., m)`` from ``of_inlier``, of each hypothesis.
            probability: ``(2, R, 2, ...)`` of the hypotheses.
            outlier: ``(..., B)`` probability that each block is an outlier.
            blocks: indices of the elements of each block.
        """
        last, std = noise.last, frame.measurement_noise.std
        inlier = frame.measured * (1 - by_element(outlier, blocks)).clamp_min(0.0)  # not below 0 but for rounding
        probability = probability.unsqueeze(-1)
        # A hypothesis of no weight may have failed.
        residuals = (torch.where(probability > 0, inliers, 0.0) * probability).sum((1, 2, 3))
        unit = std * last.scale
        ahead = (unit * expected.mean).clamp(-FAR, FAR)
        variance = (unit.square() * expected.scale_tril.square().sum(-1)).clamp_max(FAR**2)
        of_elements = last.share, last.weight, last.excess - last.residual * ahead, variance, ahead.square()
        shown, weight, score, *spreads = by_block(inlier * torch.stack(of_elements), blocks)
        rate = safe_divide(weight, 2 * shown + torch.maximum(*spreads))
        known = noise.variance / (1 + noise.variance * rate * shown)
        log_scale = noise.log_scale + known * rate * score
        # What an outlier does not judge waits for the next inlier.
        now = *residuals, inlier / std, inlier
        waiting = LastResidual(*[x + (1 - inlier) * before for x, before in zip(now, last, strict=True)])
        if self.noise_least > 0:
            log_scale = log_scale.clamp_min(math.log(self.noise_least))
        return NoiseScale(log_scale, known, waiting)

    def _doubt(self, like: Tensor) -> Tensor:
        doubt: Tensor = self.noise_doubt(like).unsqueeze(-1)
        return doubt


def by_block(elements: Tensor, blocks: Sequence[Sequence[int]]) -> Tensor:
    """Sums ``(..., B)`` over the elements ``(..., m)`` of each block."""
    return torch.stack([elements[..., list(block)].sum(-1) for block in blocks], -1)


def by_element(of_blocks: Tensor, blocks: Sequence[Sequence[int]]) -> Tensor:
    """Of each element ``(..., m)`` what its block has ``(..., B)``."""
    block_of = {i: b for b, block in enumerate(blocks) for i in block}
    return torch.stack([of_blocks[..., block_of[i]] for i in range(len(block_of))], -1)


def factors(noise: NoiseScale, blocks: Sequence[Sequence[int]], measured: Tensor) -> Tensor:
    """Factors ``(..., m)`` on the variances of the elements of all blocks; 1 where missing."""
    return torch.where(measured > 0, by_element(noise.log_scale, blocks), 0.0).exp()


def measured_blocks(measured: Tensor, blocks: Sequence[Sequence[int]]) -> Tensor:
    """``(..., B)`` 1 where some element ``(..., m)`` of a block is measured, else 0."""
    return torch.stack([measured[..., list(block)].amax(-1) for block in blocks], -1)


def of_inlier(updated: Gaussian, rows: Tensor, residual: Tensor, missing: Tensor) -> Tensor:
    """What ``LastResidual`` has of a block that is an inlier, ``(3, ..., m)``: ``r``, ``r^2 + h - 1`` and ``1 - h``.

    Args:
        updated: ``(..., k)`` unknowns after the measurement, any root.
        rows: ``(..., m, k)`` measurement matrix of the unknowns, in units of the noise.
        residual: ``(..., m)`` before the measurement.
        missing: ``(..., m)`` 1 where missing, 0 where measured; there it is 0.
    """
    left = residual - (rows * updated.mean.unsqueeze(-2)).sum(-1)
    share = (1 - (rows @ updated.scale_tril).square().sum(-1)).clamp_min(0.0)  # it is not below 0 but for rounding
    left, share = (1 - missing) * left.clamp(-FAR, FAR), (1 - missing) * share
    size, farthest = [x.sum(-1, keepdim=True) for x in (left.square(), FARTHEST**2 * share)]
    left = left * safe_sqrt(safe_divide(farthest, torch.maximum(size, farthest)))
    return torch.stack([left, left.square() - share, share.expand_as(left)])
