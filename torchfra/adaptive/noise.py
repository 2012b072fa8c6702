"""Estimates of the measurement noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.gaussian.update import down_weight
from torchfra.hyper import Hyper, Part, Value, one_of
from torchfra.numbers import as_number, as_numbers, is_integer
from torchfra.tree import event_ranks
from torchfra.types import Whitened


@event_ranks(scale=1, total=1, updates=1)
class NoiseMemory(NamedTuple):
    """Estimate of the measurement noise, element by element."""

    scale: Tensor
    """``(..., m)`` estimated variance, as a multiple of the nominal one."""
    total: Tensor
    """``(..., m)`` sum of the forgetting weights of all innovations so far: ``1 / d``."""
    updates: Tensor
    """``(..., m)`` number of innovations so far."""


class SageHusa(Part):
    """Estimates the variance of the measurement noise on line, with forgetting, sensor by sensor.

    The part of the innovations' second moment that the predicted covariance does not explain is the measurement noise:

        R <- (1 - g d) R + g d (e e^T - H P H^T),   d = (1 - b) / (1 - b^(k + 2)),

    on the diagonal and in units of the nominal noise; ``g`` is ``1 - confidence`` of the sensor.

    Args:
        blocks: elements of a measurement that belong to one sensor, ``Sensor.blocks``.
        forgetting: b; the memory is that of 1 / (1 - b) innovations.
        confidence: in the current estimate, which a high confidence changes slowly; one for each block, ``(...,
            blocks)``, or one for all.
        lowest: lower bound of the estimate, as a share of the nominal variance.
        highest: upper bound of the estimate, as a multiple of the nominal variance.
        warmup: number of first innovations that do not change the estimate: after a prior that is far off they reflect
            the prior more than the noise.
        adapt: ``"innovation"``: before the update, as above; ``"residual"``: after it, by ``r r^T + H P H^T`` of the
            residual and the posterior, which is always positive.

    Raises:
        ValueError: a value out of its range, or not one confidence for each block.

    Source: Sage & Husa (1969); Chen, Zou & Wu, eq. (19), whose form is lost: the weight ``g`` is our reading.
    Differs: diagonal, the bounds and the warm-up are additions.
    """

    block_of: Tensor
    """``(m,)`` index of each element's block."""

    def __init__(
        self,
        blocks: Sequence[Sequence[int]],
        *,
        forgetting: Value = 0.96,
        confidence: Value | Sequence[float] = 0.5,
        lowest: float = 0.25,
        highest: float = 1e4,
        warmup: int = 5,
        adapt: str = "innovation",
    ) -> None:
        super().__init__()
        one_of(adapt=(adapt, ("innovation", "residual")))
        if not (0 < as_number(lowest) <= 1 <= as_number(highest) and is_integer(warmup, 0)):
            raise ValueError(
                "lowest, highest, warmup: expected 0 < lowest <= 1 <= highest, and warmup of 0 or more, received "
                f"{lowest!r}, {highest!r}, {warmup!r}"
            )
        confidence = as_numbers(confidence, "confidence").double()
        confidence = confidence.expand(len(blocks)) if confidence.dim() == 0 else confidence
        if confidence.shape[-1:] != (len(blocks),):
            raise ValueError(f"confidence: expected (..., {len(blocks)}), received {tuple(confidence.shape)}")
        self.forgetting = Hyper(forgetting, constraints.interval(0.0, 1.0), name="forgetting")
        self.confidence = Hyper(confidence, constraints.interval(0.0, 1.0), event_dim=1, name="confidence")
        self.warmup, self.adapt = warmup, adapt
        self.lowest, self.highest = lowest, highest
        number_of = {i: number for number, block in enumerate(blocks) for i in block}
        numbers = torch.tensor([number_of[i] for i in sorted(number_of)])
        self.register_buffer("block_of", numbers, persistent=False)

    def begin(self, mean: Tensor) -> NoiseMemory:
        """The memory of nominal noise, for tracks of state ``mean (..., n)``."""
        one = mean.new_ones((*mean.shape[:-1], len(self.block_of)))
        return NoiseMemory(one, one, 0 * one)

    def learn(self, memory: NoiseMemory, whitened: Whitened, measured: Tensor, when: str) -> NoiseMemory:
        """The memory after one more measurement if ``when`` equals ``adapt``, eq. (19); else the memory as it is.

        Args:
            memory: before the measurement.
            whitened: the measurement, in units of the nominal noise, compared with the prediction (``"innovation"``) or
                with the belief after the update (``"residual"``).
            measured: ``(..., m)`` 1 where measured.
            when: ``"innovation"`` or ``"residual"``.
        """
        return self.forward(memory, self.excess(whitened), measured) if when == self.adapt else memory

    def excess(self, whitened: Whitened) -> Tensor:
        """The estimate ``(..., m)`` of the variances by one measurement: ``e^2 - H P H^T``, or ``r^2 + H P H^T``."""
        predicted = whitened.spread.square().sum(-1)
        predicted = predicted if whitened.subtracted is None else predicted - whitened.subtracted.square().sum(-1)
        # Finite: at the bound of the estimate the gradient would otherwise be 0 times infinity, which is NaN.
        squared = whitened.residual.square().clamp_max(torch.finfo(predicted.dtype).max)
        return squared + (predicted if self.adapt == "residual" else -predicted)

    def forward(self, memory: NoiseMemory, excess: Tensor, weight: Tensor) -> NoiseMemory:
        """The memory after one more ``excess (..., m)``.

        ``weight (..., m)`` is the probability that it is the target's, 0 where missing; below a half it is not used.
        """
        used = (weight >= 0.5).to(excess)
        total = memory.total * self.forgetting.elements(excess) + 1
        gain = 1 - self.confidence(excess).index_select(-1, self.block_of)
        rate = gain * weight / total
        scale = (memory.scale + rate * (excess - memory.scale)).clamp(self.lowest, self.highest)
        changed = used * (memory.updates >= self.warmup)
        return NoiseMemory(
            torch.where(changed > 0, scale, memory.scale),
            torch.where(used > 0, total, memory.total),
            memory.updates + used,
        )

    def rescale(self, whitened: Whitened, memory: NoiseMemory) -> Whitened:
        """The measurement in units of the estimated noise."""
        return down_weight(whitened, 1 / memory.scale)

    def nominal(self, root: Tensor, memory: NoiseMemory, measured: Tensor) -> Tensor:
        """A root ``(..., m, m)`` in units of the estimated noise, converted to units of the nominal noise."""
        return torch.where(measured > 0, memory.scale, 1.0).sqrt().unsqueeze(-1) * root

    def scale(self, memory: NoiseMemory) -> Tensor:
        """``(..., m)`` estimated variances as multiples of the nominal ones."""
        scale: Tensor = memory.scale
        return scale
