"""The scale of each block's measurement noise, learned on line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchfra.filters.gpb.hypotheses import Posterior
from torchfra.hyper import Hyper, Value
from torchfra.types import Gaussian


class NoiseScale(NamedTuple):
    """What is known of the scale of each block's noise."""

    log_scale: Tensor
    """``(..., B)`` mean of the log of the factor on the variance that the sensor states."""
    variance: Tensor
    """``(..., B)`` variance of that log."""


class LearnedNoise(nn.Module):
    """The factor on the variance of each block's measurement noise, learned from the inliers.

    Its log ``m`` is a first-order autoregressive process around 0, the noise as stated, which is known with variance
    ``v``.  Before and after a measurement of the block,

        m <- a m,          v <- a^2 v + (1 - a^2) d^2,      a = exp(-1 / memory),
        v <- 1 / (1 / v + I),   m <- m + v S.

    The score ``S``, the derivative of the log likelihood of the measurement, is by Fisher's identity an expectation
    over states and hypotheses after the measurement: with the residual ``e`` of an element in units of the noise,
    ``S = E sum (e^2 - 1) / 2`` over inliers.  In the information ``I = E sum (1 - h)^2 / 2``, ``h`` is the variance of
    the measured quantity after the measurement, in units of the noise's: where a belief follows the measurement, the
    residual says little about the noise.

    Args:
        doubt: standard deviation ``d`` of the log of that factor.
        memory: number of measurements after which what was learned has fallen to 37 %.

    Source: Creal, Koopman & Lucas (2013) for values that follow their score, scaled by the information; Sarkka &
    Nummenmaa (2009) for learning the noise from the updated belief, with forgetting.
    """

    def __init__(self, doubt: Value = 0.7, memory: Value = 200.0) -> None:
        super().__init__()
        self.noise_doubt = Hyper(doubt, name="noise_doubt")
        self.noise_memory = Hyper(memory, name="noise_memory")

    def begin(self, like: Tensor) -> NoiseScale:
        """The noise as stated, for ``like (..., B)``."""
        none = torch.zeros_like(like)
        return NoiseScale(none, none + self._doubt(like).square())

    def predict(self, noise: NoiseScale, measured: Tensor) -> NoiseScale:
        """What is known before a step.

        Args:
            noise: what was known after the step before.
            measured: ``(..., B)`` 1 where the step has a measurement of a block, else 0.
        """
        lasts = torch.exp(-measured / self.noise_memory(noise.log_scale).unsqueeze(-1))
        doubt = self._doubt(noise.log_scale)
        return NoiseScale(
            lasts * noise.log_scale, lasts.square() * noise.variance + (1 - lasts.square()) * doubt.square()
        )

    def update(self, noise: NoiseScale, evidence: Tensor, posterior: Posterior) -> NoiseScale:
        """What is known after a step.

        Args:
            noise: from ``predict``.
            evidence: ``(2, 2, R, 2, ..., B)`` score and information of each hypothesis: see ``evidence``.
            posterior: probabilities of the hypotheses.
        """
        probability = posterior.probability[None, ..., None]
        # A hypothesis of no weight may have failed.
        score, information = (torch.where(probability > 0, evidence, 0.0) * probability).sum((1, 2, 3))
        variance = noise.variance / (1 + noise.variance * information)
        return NoiseScale(noise.log_scale + variance * score, variance)

    def _doubt(self, like: Tensor) -> Tensor:
        doubt: Tensor = self.noise_doubt(like).unsqueeze(-1)
        return doubt


def factors(noise: NoiseScale, blocks: Sequence[Sequence[int]], measured: Tensor) -> Tensor:
    """Factors ``(..., m)`` on the variances of the elements of all blocks; 1 where missing."""
    block_of = {i: b for b, block in enumerate(blocks) for i in block}
    log_scale = torch.stack([noise.log_scale[..., block_of[i]] for i in range(len(block_of))], -1)
    return torch.where(measured > 0, log_scale, 0.0).exp()


def measured_blocks(measured: Tensor, blocks: Sequence[Sequence[int]]) -> Tensor:
    """``(..., B)`` 1 where some element ``(..., m)`` of a block is measured, else 0."""
    return torch.stack([measured[..., list(block)].amax(-1) for block in blocks], -1)


def evidence(updated: Gaussian, rows: Tensor, residual: Tensor, missing: Tensor) -> Tensor:
    """Score and information ``(2, ...)`` of the log of the noise's variance, of a block that is an inlier.

    Args:
        updated: ``(..., k)`` unknowns after the measurement, any root.
        rows: ``(..., m, k)`` measurement matrix of the unknowns, in units of the noise.
        residual: ``(..., m)`` before the measurement.
        missing: ``(..., m)`` 1 where missing, 0 where measured.
    """
    left = residual - (rows * updated.mean.unsqueeze(-2)).sum(-1)
    share = (rows @ updated.scale_tril).square().sum(-1)
    score = ((left.square() + share - 1) * (1 - missing)).sum(-1)
    information = ((1 - share).square() * (1 - missing)).sum(-1)
    return 0.5 * torch.stack([score, information.expand_as(score)])
