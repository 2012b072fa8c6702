"""Fading factors: they widen a prediction whose motion model no longer holds."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper, Part, Value, one_of
from torchfra.linalg.gram import gram_pinv
from torchfra.linalg.safe import in_range, safe_divide
from torchfra.linalg.triangular import dependent, hstack, tria
from torchfra.motion.base import Motion
from torchfra.numbers import as_number, as_numbers
from torchfra.tree import event_ranks
from torchfra.types import Prediction, Whitened


@event_ranks(moment=2, measured=2)
class Memory(NamedTuple):
    """Running second moment of the innovations, in units of the measurement noise."""

    moment: Tensor
    """``V (..., m, m)``."""
    measured: Tensor
    """``(..., m, m)`` 1 where an entry has been measured at least once, else 0."""


class Fading(Part):
    """Multiple fading factors: recent innovations compared with the covariance that the model predicts for them.

    One factor per track, 1 or more, multiplies the propagated covariance ``F P F^T`` of the faded states, before
    process noise is added.  Groups of states may have different shares: then the part of the factor above 1 is
    multiplied by the group's share.

    Args:
        weakening: beta, factor on the measurement noise that is subtracted from the innovations: the larger, the
            weaker the reaction.
        forgetting: rho, memory of the innovations.
        fading_max: largest factor; infinity for the paper's own formula.
        rcond: singular values of the measurement matrix below this share of the largest are left out of its inverse; 0
            for the paper's own formula, which is unbounded where lines of sight become parallel.
        states: state components that fade: a slice, or several slices as groups.  By default the position of the
            filter's motion; with a ``share`` position, velocity and so on, as groups.
        share: share of each group, ``(..., groups)``, 0 or more; by default 1 for all.
        trace: ``"full"`` compares full traces, ``"position"`` those of the faded components.

    If a trace is zero or NaN the factor is 1.

    Raises:
        ValueError: a value out of its range.

    Source: Wang et al. (2021), eqs. (29)-(34); Zhou, Xi & Zhang (1990) for the strong tracking filter.
    Differs: singular values are compared in units of the measurement noise, so that elements in metres and in radians
    can be compared; with equal noise on all elements, as in the paper, that changes nothing.  ``fading_max``,
    ``rcond`` and ``share`` are additions.
    """

    def __init__(
        self,
        weakening: Value = 2.0,
        forgetting: Value = 0.95,
        fading_max: Value = 1e3,
        *,
        rcond: float = 0.1,
        states: slice | Sequence[slice] | None = None,
        share: Value | Sequence[float] | None = None,
        trace: str = "full",
    ) -> None:
        super().__init__()
        if not 0 <= as_number(rcond) < 1:
            raise ValueError(f"rcond: expected a value in [0, 1), received {rcond!r}")
        one_of(trace=(trace, ("full", "position")))
        self.weakening = Hyper(weakening, constraints.greater_than_eq(1.0), name="weakening")
        self.forgetting = Hyper(forgetting, constraints.interval(0.0, 1.0), name="forgetting")
        self.fading_max = Hyper(fading_max, constraints.greater_than_eq(1.0), name="fading_max")
        self.share: Hyper | None = None
        if share is not None:
            share = as_numbers(share, "share").double()
            self.share = Hyper(share, constraints.nonnegative, event_dim=1, name="share")
        self.rcond, self.trace, self._states_given = rcond, trace, states is not None
        states = slice(0, 2) if states is None else states  # until ``for_motion`` knows it
        self.states = (states,) if isinstance(states, slice) else tuple(states)
        if self._states_given:
            self._check_share()

    def for_motion(self, motion: Motion) -> Fading:
        """A copy for the states of a motion, which shares the values; this module itself if ``states`` were given.

        Raises:
            ValueError: not one share for each group.
        """
        if self._states_given:
            return self
        own, higher = copy.copy(self), range(2, motion.orders)
        own.states = (motion.position,)
        if self.share is not None:
            groups = (
                motion.position,
                motion.velocity,
                *(slice(i * motion.dims, (i + 1) * motion.dims) for i in higher),
            )
            own.states = groups[: motion.orders]
        own._check_share()
        return own

    def _check_share(self) -> None:
        if self.share is not None and self.share.raw.shape[-1:] != (len(self.states),):
            raise ValueError(f"share: expected (..., {len(self.states)}), received {tuple(self.share.raw.shape)}")

    def begin(self, mean: Tensor, m: int) -> Memory:
        """The empty memory for ``m`` measured elements and tracks of state ``mean (..., n)``."""
        nothing = mean.new_zeros((*mean.shape[:-1], m, m))
        return Memory(nothing, nothing)

    def remember(self, memory: Memory, residual: Tensor, measured: Tensor) -> Memory:
        """The memory after one more ``residual (..., m)``; entries that are not ``measured (..., m)`` do not change.

        A residual whose square overflows counts as missing: otherwise the moment and its gradients would be infinite
        from then on.
        """
        moment, before = memory
        used = in_range(residual)
        residual, measured = torch.where(used, residual, 0.0), measured * used
        square = residual.unsqueeze(-1) * residual.unsqueeze(-2)
        pair = measured.unsqueeze(-1) * measured.unsqueeze(-2)
        rho = self.forgetting(residual)[..., None, None]
        moment = moment + pair * (square - moment) / (1 + rho * before)  # eq. (31)
        return Memory(moment, torch.maximum(before, pair))

    def forward(self, prediction: Prediction, whitened: Whitened, memory: Memory, weights: Tensor) -> Tensor:
        """The fading factor ``(...)``.

        Args:
            prediction: without a fading factor.
            whitened: the measurement compared with that prediction.
            memory: of innovations, that of this step included.
            weights: ``(..., m)`` robust weights that divide the noise covariance; ones for the nominal noise.
        """
        d = whitened.reads
        root = prediction.belief.scale_tril[..., :d, :d]
        # A prediction with a component of zero variance, or one that others determine, cannot fade.  Its zero pivots
        # are ones here, and its factor is 1 below (``undefined``).
        certain = dependent(root, 4 * d)
        h = torch.linalg.solve_triangular(
            root + torch.diag_embed(certain.to(root)), whitened.slope, upper=False, left=False
        )
        # Both traces in units of the largest entry: in metres their gradients overflow in float32.
        unit = h.detach().abs().amax((-2, -1))[..., None, None]
        unit = torch.where((unit > 0) & unit.isfinite(), unit, 1.0)
        noise = h @ prediction.process_noise[..., :d, :]
        excess = memory.moment - noise @ noise.mT
        excess = excess - self.weakening(excess)[..., None, None] * torch.diag_embed(1 / weights)
        trace_n = (gram_pinv(h / unit, self.rcond) * excess).sum((-2, -1))  # eq. (32)
        spread = prediction.spread
        if self.trace == "position":
            spread = torch.cat([spread[..., group, :] for group in self.states], -2)
        trace_j = (unit * spread).square().sum((-2, -1))  # eq. (33)
        undefined = certain.any(-1) | ~(trace_n / trace_j).isfinite()
        ratio = safe_divide(torch.where(undefined, 0.0, trace_n), torch.where(undefined, 0.0, trace_j), fill=1.0)
        return torch.minimum(ratio.clamp_min(1.0), self.fading_max(ratio))  # eq. (34)

    def inflate(self, prediction: Prediction, factor: Tensor) -> Prediction:
        """The prediction with ``factor (...)``, or each group's share of it, on the covariance of the faded states.

        The mean stays.

        Source: Wang et al. (2021), eq. (29).
        """
        spread, noise = self.stretch(prediction.spread, factor), prediction.process_noise
        root = tria(hstack(spread, noise))
        return Prediction(prediction.belief._replace(scale_tril=root), spread, noise)

    def stretch(self, spread: Tensor, factor: Tensor) -> Tensor:
        """``Prediction.spread (..., n, p)`` with ``factor (...)``, or each group's share of it."""
        excess = factor.unsqueeze(-1) - 1
        if self.share is not None:
            excess = self.share(factor) * excess
        # One column per state, with a 1 in the row of its group, if it has one.
        group = torch.zeros(len(self.states), spread.shape[-2], dtype=factor.dtype, device=factor.device)
        for row, states in zip(group, self.states, strict=True):
            row[states] = 1
        excess = excess.expand((*factor.shape, len(self.states))).unsqueeze(-2)
        scale = (1 + (excess @ group).squeeze(-2)).sqrt()
        return scale.unsqueeze(-1) * spread
