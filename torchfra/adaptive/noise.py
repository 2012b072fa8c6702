"""The noise side: estimates of the measurement noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.gaussian.update import down_weight
from torchfra.hyper import Hyper, Value, one_of
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


class NominalNoise(nn.Module):
    """Nothing is estimated: the measurement noise is what the sensor says."""

    adapt = "never"
    """When it learns: ``"innovation"``, before the update, ``"residual"``, after it, or never."""

    @property
    def plain(self) -> bool:
        """Whether it does nothing."""
        return type(self) is NominalNoise

    def excess(self, whitened: Whitened) -> Tensor:
        """``(..., m)`` one measurement's estimate of the variances; zeros here."""
        return torch.zeros_like(whitened.residual)

    def forward(self, memory: Any, excess: Tensor, weight: Tensor) -> Any:
        """The memory after one more ``excess (..., m)``, of which ``weight (..., m)`` is the target's probability."""
        return memory

    def begin(self, mean: Tensor) -> NoiseMemory | None:
        """What is remembered before the first step."""
        return None

    def learn(self, memory: Any, whitened: Whitened, measured: Tensor, when: str) -> Any:
        """The memory after one more measurement, if ``when`` is when this side learns; else the memory before.

        Args:
            memory: before.
            whitened: the measurement, in units of the nominal noise, against the prediction (``"innovation"``) or
                against the belief after the update (``"residual"``).
            measured: ``(..., m)`` 1 where measured.
            when: which of the two.
        """
        return memory

    def known(self, whitened: Whitened, memory: Any) -> Whitened:
        """The measurement in units of the estimated noise, here the nominal one."""
        return whitened

    def nominal(self, root: Tensor, memory: Any, measured: Tensor) -> Tensor:
        """A root ``(..., m, m)`` from units of the known noise back in those of the nominal noise."""
        return root

    def scale(self, memory: Any) -> Tensor | None:
        """``(..., m)`` estimated variances as multiples of the nominal ones; None where nothing is estimated."""
        return None


class SageHusa(NominalNoise):
    """Estimates the variance of the measurement noise on line, with forgetting, sensor by sensor.

    Scatter of the innovations beyond what the prediction's uncertainty explains is taken for measurement noise:

        R <- (1 - g d) R + g d (e e^T - H P H^T),   d = (1 - b) / (1 - b^(k + 2)),

    on the diagonal and in units of the nominal noise; ``g`` is ``1 - confidence`` of the sensor, or ``confidence``.

    Args:
        blocks: elements of a measurement that belong to one sensor, ``Sensor.blocks``.
        forgetting: b; 1 / (1 - b) innovations are remembered.
        confidence: one for each block, ``(..., blocks)``, or one for all.
        confidence_in: ``"nominal"``: in the current estimate, so that a high confidence changes it slowly;
            ``"measured"``: in the new innovation.  At 0.5 both give the same.
        lowest: share of the nominal variance that the estimate does not fall below.
        highest: multiple of it that the estimate does not rise above.
        warmup: number of first innovations that do not change the estimate: after a poor prior they reflect the prior
            more than the noise.
        adapt: ``"innovation"``, before the update, as above; ``"residual"``: after it, by ``r r^T + H P H^T`` of what
            is left, which is always positive.

    Raises:
        ValueError: a value out of its range, or not one confidence for each block.

    Source: Sage & Husa (1969); Chen, Zou & Wu, eq. (19), whose form is lost: the weight ``g`` is our reading.
    Differs: diagonal, the bounds and the warm-up are additions.
    """

    element: Tensor

    def __init__(
        self,
        blocks: Sequence[Sequence[int]],
        *,
        forgetting: Value = 0.96,
        confidence: Value | Sequence[float] = 0.5,
        confidence_in: str = "nominal",
        lowest: float = 0.25,
        highest: float = 1e4,
        warmup: int = 5,
        adapt: str = "innovation",
    ) -> None:
        super().__init__()
        one_of(
            confidence_in=(confidence_in, ("nominal", "measured")),
            adapt=(adapt, ("innovation", "residual")),
        )
        if not 0 < lowest <= 1 <= highest or warmup < 0:
            raise ValueError(
                "lowest, highest, warmup: expected shares up to 1, from 1 on, and 0 or more, received "
                f"{lowest}, {highest}, {warmup}"
            )
        confidence = torch.as_tensor(confidence, dtype=torch.float64)
        confidence = confidence.expand(len(blocks)) if confidence.dim() == 0 else confidence
        if confidence.shape[-1:] != (len(blocks),):
            raise ValueError(f"confidence: expected (..., {len(blocks)}), received {tuple(confidence.shape)}")
        self.forgetting = Hyper(forgetting, constraints.interval(0.0, 1.0), name="forgetting")
        self.confidence = Hyper(confidence, constraints.interval(0.0, 1.0), event_dim=1, name="confidence")
        self.confidence_in, self.warmup, self.adapt = confidence_in, warmup, adapt
        self.lowest, self.highest = lowest, highest
        element = {i: number for number, block in enumerate(blocks) for i in block}
        self.register_buffer("element", torch.tensor([element[i] for i in sorted(element)]), persistent=False)

    def begin(self, mean: Tensor) -> NoiseMemory:
        """Nominal noise remembered, for tracks of state ``mean (..., n)``."""
        one = mean.new_ones((*mean.shape[:-1], len(self.element)))
        return NoiseMemory(one, one, 0 * one)

    def learn(self, memory: Any, whitened: Whitened, measured: Tensor, when: str) -> Any:
        """The memory after one more measurement: eq. (19)."""
        return self(memory, self.excess(whitened), measured) if when == self.adapt else memory

    def excess(self, whitened: Whitened) -> Tensor:
        """One measurement's estimate ``(..., m)`` of the variances, such as ``e^2 - H P H^T``.

        For ``"residual"`` it is what was measured against the belief after the update.
        """
        predicted = whitened.spread.square().sum(-1)
        predicted = predicted if whitened.subtracted is None else predicted - whitened.subtracted.square().sum(-1)
        # A finite number, however large: the estimate has a bound, and where it stands there 0 times infinity is NaN.
        squared = whitened.residual.square().clamp_max(torch.finfo(predicted.dtype).max)
        return squared + (predicted if self.adapt == "residual" else -predicted)

    def forward(self, memory: Any, excess: Tensor, weight: Tensor) -> Any:
        """The memory after one more ``excess (..., m)``.

        ``weight (..., m)`` is how probably it was the target's: below a half it is not used.  0 where missing.
        """
        used = (weight >= 0.5).to(excess)
        total = memory.total * self.forgetting.elements(excess) + 1
        confidence = self.confidence(excess).index_select(-1, self.element)
        gain = confidence if self.confidence_in == "measured" else 1 - confidence
        rate = gain * weight / total
        scale = (memory.scale + rate * (excess - memory.scale)).clamp(self.lowest, self.highest)
        changed = used * (memory.updates >= self.warmup)
        return NoiseMemory(
            torch.where(changed > 0, scale, memory.scale),
            torch.where(used > 0, total, memory.total),
            memory.updates + used,
        )

    def known(self, whitened: Whitened, memory: Any) -> Whitened:
        """The measurement in units of the estimated noise."""
        return down_weight(whitened, 1 / memory.scale)

    def nominal(self, root: Tensor, memory: Any, measured: Tensor) -> Tensor:
        """A root ``(..., m, m)`` from units of the estimated noise back in those of the nominal noise."""
        return torch.where(measured > 0, memory.scale, 1.0).sqrt().unsqueeze(-1) * root

    def scale(self, memory: Any) -> Tensor | None:
        """``(..., m)`` estimated variances as multiples of the nominal ones."""
        scale: Tensor = memory.scale
        return scale
