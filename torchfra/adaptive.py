"""The prediction side: how much to widen a prediction whose motion model has stopped to hold.

And the noise side: how large the measurement noise really is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value, one_of
from torchfra.linalg import gram_pinv, hstack, tria
from torchfra.types import Prediction, Whitened
from torchfra.update import trust


class Memory(NamedTuple):
    """Running second moment of the innovations, in units of the measurement noise."""

    moment: Tensor
    """``V (..., m, m)``."""
    begun: Tensor
    """``(..., m, m)`` 1 where an entry has been seen at least once, else 0."""


class Fading(nn.Module):
    """Multiple fading factors: the innovations of late against what the model expects of them.

    One factor per track, 1 or more, multiplies the covariance of the faded states that was carried over from the last
    step, before process noise is added.  Groups of states may take different shares of it: what is above 1 is then
    multiplied by the group's share.

    Args:
        weakening: beta, share of the measurement noise that is taken off the innovations: above 1 reacts less.
        forgetting: rho, memory of the innovations.
        fading_max: no factor above this; infinity for the paper's own formula.
        rcond: singular values of the measurement matrix below this share of the largest are left out of its inverse; 0
            for the paper's own formula, which explodes where lines of sight become parallel.
        states: which state components fade: a slice, or several, which are groups.
        share: of each group, ``(..., groups)``, 0 or more; by default all have the whole factor.
        trace: ``"full"`` compares whole traces, ``"position"`` those of the faded components.

    A trace that is zero or not a number gives a factor of 1.

    Raises:
        ValueError: a value out of its range.

    Source: Wang et al. (2021), eqs. (29)-(34); Zhou, Xi & Zhang (1990) for the strong tracking filter.
    Differs: singular values are compared in units of the measurement noise, so that metres and radians mix; with equal
    noise on all elements, as in the paper, that changes nothing.  ``fading_max``, ``rcond`` and ``share`` are ours.
    """

    def __init__(
        self,
        weakening: Value = 2.0,
        forgetting: Value = 0.95,
        fading_max: Value = 1e3,
        *,
        rcond: float = 0.1,
        states: slice | Sequence[slice] = slice(0, 2),
        share: Value | Sequence[float] | None = None,
        trace: str = "full",
    ) -> None:
        super().__init__()
        if not 0 <= rcond < 1:
            raise ValueError(f"rcond: expected a value in [0, 1), received {rcond}")
        if trace not in ("full", "position"):
            raise ValueError(f"trace: expected 'full' or 'position', received {trace!r}")
        self.weakening = Hyper(weakening, constraints.greater_than_eq(1.0), name="weakening")
        self.forgetting = Hyper(forgetting, constraints.interval(0.0, 1.0), name="forgetting")
        self.fading_max = Hyper(fading_max, constraints.greater_than_eq(1.0), name="fading_max")
        self.states = (states,) if isinstance(states, slice) else tuple(states)
        self.share: Hyper | None = None
        if share is not None:
            share = torch.as_tensor(share, dtype=torch.float64)
            if share.shape[-1:] != (len(self.states),):
                raise ValueError(f"share: expected (..., {len(self.states)}), received {tuple(share.shape)}")
            self.share = Hyper(share, constraints.nonnegative, event=1, name="share")
        self.rcond, self.trace = rcond, trace

    def begin(self, mean: Tensor, m: int) -> Memory:
        """Nothing remembered yet of ``m`` measured elements, for tracks of state ``mean (..., n)``."""
        nothing = mean.new_zeros((*mean.shape[:-1], m, m))
        return Memory(nothing, nothing)

    def remember(self, memory: Memory, residual: Tensor, seen: Tensor) -> Memory:
        """The memory after one more ``residual (..., m)``; entries not ``seen (..., m)`` stay as they were."""
        moment, begun = memory
        square = residual.unsqueeze(-1) * residual.unsqueeze(-2)
        pair = seen.unsqueeze(-1) * seen.unsqueeze(-2)
        rho = self.forgetting().to(residual)[..., None, None]
        moment = moment + pair * (square - moment) / (1 + rho * begun)  # eq. (31)
        return Memory(moment, torch.maximum(begun, pair))

    def forward(self, prediction: Prediction, whitened: Whitened, memory: Memory, weights: Tensor) -> Tensor:
        """The fading factor ``(...)``.

        Args:
            prediction: not faded.
            whitened: the measurement against that prediction.
            memory: with this step's innovation in it.
            weights: ``(..., m)`` robust weights that divide the measurement noise; ones if it is trusted.
        """
        d = whitened.reads
        root = prediction.belief.scale_tril[..., :d, :d]
        # A prediction that is certain of something, or came from nothing uncertain, has nothing to fade: it is divided
        # by ones instead, and gets a factor of 1 in the end.
        certain = root.diagonal(dim1=-2, dim2=-1) == 0
        h = torch.linalg.solve_triangular(
            root + torch.diag_embed(certain.to(root)), whitened.slope, upper=False, left=False
        )
        noise = h @ prediction.noise[..., :d, :]
        excess = memory.moment - noise @ noise.mT
        excess = excess - self.weakening().to(excess)[..., None, None] * torch.diag_embed(1 / weights)
        trace_n = (gram_pinv(h, self.rcond) * excess).sum((-2, -1))  # eq. (32)
        spread = prediction.spread
        if self.trace == "position":
            spread = torch.cat([spread[..., group, :] for group in self.states], -2)
        trace_j = spread.square().sum((-2, -1))  # eq. (33)
        nothing = certain.any(-1) | (trace_j == 0)
        ratio = trace_n / torch.where(nothing, 1.0, trace_j)
        ratio = torch.where(nothing | ~ratio.isfinite(), 1.0, ratio)
        return torch.minimum(ratio.clamp_min(1.0), self.fading_max().to(ratio))  # eq. (34)

    def inflate(self, prediction: Prediction, factor: Tensor) -> Prediction:
        """The prediction with ``factor (...)``, or each group's share of it, on the covariance of the faded states.

        The mean stays.

        Source: Wang et al. (2021), eq. (29).
        """
        excess = factor.unsqueeze(-1) - 1
        if self.share is not None:
            excess = self.share().to(factor) * excess
        # One column per state: the group it belongs to, if any.
        group = torch.zeros(len(self.states), prediction.spread.shape[-2], dtype=factor.dtype, device=factor.device)
        for row, states in zip(group, self.states, strict=True):
            row[states] = 1
        excess = excess.expand((*factor.shape, len(self.states))).unsqueeze(-2)
        scale = (1 + (excess @ group).squeeze(-2)).sqrt()
        spread, noise = scale.unsqueeze(-1) * prediction.spread, prediction.noise
        root = tria(hstack(spread, noise))
        return Prediction(prediction.belief._replace(scale_tril=root), spread, noise)


class NoiseMemory(NamedTuple):
    """What is known of the measurement noise, element by element."""

    scale: Tensor
    """``(..., m)`` estimated variance, as a multiple of the nominal one."""
    total: Tensor
    """``(..., m)`` sum of the weights of all innovations so far: ``1 / d``."""
    updates: Tensor
    """``(..., m)`` of them."""


class SageHusa(nn.Module):
    """Estimates the variance of the measurement noise on line, with forgetting, sensor by sensor.

    What the innovations scatter beyond the prediction's own uncertainty is noise:

        R <- (1 - g d) R + g d (e e^T - H P H^T),   d = (1 - b) / (1 - b^(k + 2)),

    on the diagonal and in units of the nominal noise; ``g`` is ``1 - confidence`` of the sensor, or ``confidence``.

    Args:
        blocks: elements of a measurement that belong to one sensor, ``Sensor.blocks``.
        forgetting: b; 1 / (1 - b) innovations are remembered.
        confidence: one for each block, ``(..., blocks)``, or one for all.
        confidence_in: ``"nominal"``: in the noise as it is known, so that a high one changes it slowly; ``"measured"``:
            in the noise as it is newly measured.  At 0.5 they are the same.
        lowest: share of the nominal variance that the estimate does not fall below.
        highest: multiple of it that the estimate does not rise above.
        warmup: first innovations that change nothing: those of a poor start say little about the noise.
        adapt: ``"innovation"``, before the update, as above; ``"residual"``: after it, by ``r r^T + H P H^T`` of what
            is left, which is always positive.

    Raises:
        ValueError: a value out of its range, or not one confidence for each block.

    Source: Sage & Husa (1969); Chen, Zou & Wu, eq. (19), whose form is lost: the weight ``g`` is our reading.
    Differs: diagonal, the bounds and the warm-up are ours.
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
        self.confidence = Hyper(confidence, constraints.interval(0.0, 1.0), event=1, name="confidence")
        self.confidence_in, self.warmup, self.adapt = confidence_in, warmup, adapt
        self.lowest, self.highest = lowest, highest
        element = {i: number for number, block in enumerate(blocks) for i in block}
        self.register_buffer("element", torch.tensor([element[i] for i in sorted(element)]), persistent=False)

    def begin(self, mean: Tensor) -> NoiseMemory:
        """Nominal noise, for tracks of state ``mean (..., n)``."""
        one = mean.new_ones((*mean.shape[:-1], len(self.element)))
        return NoiseMemory(one, one, 0 * one)

    def excess(self, whitened: Whitened) -> Tensor:
        """``(..., m)`` what one measurement against its prediction says of the variances, ``e^2 - H P H^T`` say.

        For ``"residual"`` it is what was measured against the belief after the update.
        """
        own = whitened.spread.square().sum(-1)
        own = own if whitened.lost is None else own - whitened.lost.square().sum(-1)
        return whitened.residual.square() + (own if self.adapt == "residual" else -own)

    def forward(self, memory: NoiseMemory, excess: Tensor, weight: Tensor) -> NoiseMemory:
        """The memory after one more ``excess (..., m)``.

        ``weight (..., m)`` is how probably it was the target's: below a half it is not used.  0 where missing.
        """
        used = (weight >= 0.5).to(excess)
        total = memory.total * self.forgetting.elements().to(excess) + 1
        own = self.confidence().to(excess).index_select(-1, self.element)
        gain = own if self.confidence_in == "measured" else 1 - own
        rate = gain * weight / total
        scale = (memory.scale + rate * (excess - memory.scale)).clamp(self.lowest, self.highest)
        changed = used * (memory.updates >= self.warmup)
        return NoiseMemory(
            torch.where(changed > 0, scale, memory.scale),
            torch.where(used > 0, total, memory.total),
            memory.updates + used,
        )

    def known(self, whitened: Whitened, memory: NoiseMemory, seen: Tensor) -> tuple[Whitened, Tensor]:
        """The measurement in units of the noise as it is known, and those units ``(..., m, 1)``, 1 where missing."""
        size = torch.where(seen > 0, memory.scale, 1.0).sqrt().unsqueeze(-1)
        return trust(whitened, 1 / memory.scale), size
