"""Qualities of a measurement: each block of elements from one device is as stated, or an outlier of some size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.filters.gpb.regimes import in_front
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.update import correct, density, down_weight
from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_log
from torchfra.linalg.triangular import apply
from torchfra.types import Gaussian, Whitened

Compare = Callable[[Gaussian], Whitened]


class Corrected(NamedTuple):
    """A measurement's verdict on a prediction ``(..., d)``."""

    belief: Gaussian
    """``(..., d)`` in units of the prediction's root: ``N(0, I)`` if the measurement said nothing."""
    log_density: Tensor
    """``(...)`` of the measurement."""
    outlier: Tensor
    """``(..., B)`` probability of each block that it is an outlier."""


class Qualities(nn.Module):
    """Whether measurements are outliers: a Markov chain for each block of elements.

    Args:
        blocks: numbers of the elements of each block: those of a device fail together.
        chain: ``(..., 2, 2)``, ``chain[i, j] = P(now j | was i)`` of clean and outlier, rows that sum to one.
        sizes: ``(..., C)`` by which an outlier's measurement noise is multiplied, as a covariance.
        shares: ``(..., C)`` of the outliers that have each size, which sum to one.
    """

    def __init__(self, blocks: Sequence[Sequence[int]], *, chain: Value, sizes: Value, shares: Value) -> None:
        super().__init__()
        self.blocks = tuple(tuple(block) for block in blocks)
        chain, sizes, shares = (torch.as_tensor(x, dtype=torch.float64) for x in (chain, sizes, shares))
        if chain.shape[-2:] != (2, 2):
            raise ValueError(f"qualities: expected (2, 2), received {tuple(chain.shape)}")
        if sizes.shape[-1:] != shares.shape[-1:]:
            raise ValueError(f"shares: expected one for each of the sizes, received {tuple(shares.shape)}")
        self.chain = Hyper(chain, constraints.simplex, event_dim=2, name="qualities")
        self.sizes = Hyper(sizes, constraints.greater_than(1.0), event_dim=1, name="sizes")
        self.shares = Hyper(shares, constraints.simplex, event_dim=1, name="shares")

    def prior(self, outlier: Tensor) -> tuple[Tensor, Tensor]:
        """What the qualities before a step say of it.

        Args:
            outlier: ``(..., B)`` of each block that it was an outlier, if the step before was dirty.

        Returns:
            Logs ``(2, 2, ..., 1)`` of the probability that the step is clean or dirty ``[now, before]``, and
            ``(2, ..., 1, B)`` of each block that it is an outlier if the step is dirty.
        """
        chain = self.chain(outlier)
        new, still = chain[..., 0, 1].unsqueeze(-1), chain[..., 1, 1].unsqueeze(-1)
        now = torch.stack([new.expand_as(outlier), new + outlier * (still - new)]).unsqueeze(-2)
        clean = torch.log1p(-now).sum(-1)
        dirty = -torch.expm1(clean)
        return torch.stack([clean, dirty.log()]), now / dirty.unsqueeze(-1)

    def clean(self, seen: Gaussian, compare: Compare) -> Corrected:
        """The measurement taken as the sensor states it."""
        belief, log_density = unit(seen), 0.0
        for block in self.blocks:
            belief, root, normalised = correct(belief, part(compare(placed(seen, belief)), block))
            log_density = log_density + density(root, normalised)
        return Corrected(belief, log_density, seen.mean.new_zeros(*seen.mean.shape[:-1], len(self.blocks)))

    def dirty(self, seen: Gaussian, compare: Compare, prior: Tensor, present: Tensor) -> Corrected:
        """The measurement with outliers in some blocks.

        Args:
            seen: predictions ``(..., d)`` of what the sensor reads.
            compare: the measurement against such.
            prior: ``(..., B)`` of each block that it is an outlier.
            present: ``(..., m)`` 1 where measured, 0 where missing.
        """
        belief, log_density, outliers = unit(seen), 0.0, []
        rank = seen.mean.dim() - 1
        sizes, log_shares = (in_front(x, rank) for x in (self.sizes(seen.mean), self.shares(seen.mean).log()))
        single = len(self.blocks) == 1
        for b, block in enumerate(self.blocks):
            whitened = part(compare(placed(seen, belief)), block)
            share = prior[..., b]
            log_prior = log_shares + share.log()
            scales = sizes
            if not single:
                log_prior = torch.cat([torch.log1p(-share).expand_as(log_prior[:1]), log_prior])
                scales = torch.cat([torch.ones_like(sizes[:1]), sizes])
            weights = (1 / scales).unsqueeze(-1)
            after, root, normalised = correct(belief, down_weight(whitened, weights.expand(*weights.shape[:-1], len(block))))
            there = sum(present[..., i] for i in block)
            joint = log_prior + density(root, normalised) - 0.5 * there * scales.log()
            total = joint.logsumexp(0)
            log_density = log_density + total
            belief = moment_match(after, joint - total)
            outliers.append(torch.ones_like(total) if single else (joint[1:].logsumexp(0) - total).exp())
        return Corrected(belief, log_density, torch.stack(outliers, -1))


def unit(seen: Gaussian) -> Gaussian:
    """``N(0, I)`` for each belief."""
    root = seen.scale_tril
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    return Gaussian(torch.zeros_like(seen.mean), eye.expand_as(root))


def placed(seen: Gaussian, belief: Gaussian) -> Gaussian:
    """A belief in units of ``seen``'s root as one of states."""
    mean, root = seen
    return Gaussian(mean + apply(root, belief.mean), root @ belief.scale_tril)


def part(whitened: Whitened, block: Sequence[int]) -> Whitened:
    """The elements of one block."""
    if len(block) == whitened.residual.shape[-1]:
        return whitened
    residual = torch.stack([whitened.residual[..., i] for i in block], -1)
    spread = torch.stack([whitened.spread[..., i, :] for i in block], -2)
    return whitened._replace(residual=residual, spread=spread)
