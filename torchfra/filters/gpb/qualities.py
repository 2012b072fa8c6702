"""Qualities of a measurement: each block of elements from one device is as stated, or an outlier of some size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.filters.gpb.regimes import in_front
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.update import density
from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import apply, hstack, tria, whiten
from torchfra.types import Gaussian, Whitened

Compare = Callable[[Gaussian], Whitened]


class Corrected(NamedTuple):
    """What a measurement makes of predictions ``(..., d)``."""

    belief: Gaussian
    """``(..., d)`` in units of the prediction's root: ``N(0, I)`` where the measurement says nothing."""
    log_density: Tensor
    """``(...)`` of the measurement."""
    outlier: Tensor
    """``(..., B)`` probability of each block that it is an outlier."""


class Inside(NamedTuple):
    """``tria`` of what is measured, without its noise, and of the belief: ``[[root, 0], [cross, left]]``."""

    root: Tensor
    """``(..., m, m)``."""
    cross: Tensor
    """``(..., d, m)``."""
    left: Tensor
    """``(..., d, d)``, what no measurement of this block can tell."""


class Qualities(nn.Module):
    """Whether measurements are outliers: a Markov chain for each block of elements.

    Args:
        blocks: numbers of the elements of each block: those of a device fail together.
        chain: ``(..., 2, 2)``, ``chain[i, j] = P(now j | was i)`` of clean and outlier, rows that sum to one.
        sizes: ``(..., C)`` by which an outlier's measurement noise is multiplied, as a covariance.
        shares: ``(..., C)`` of the outliers that have each size, which sum to one.

    Raises:
        ValueError: shapes that do not go together, values out of their range or that do not sum to one.
    """

    def __init__(self, blocks: Sequence[Sequence[int]], *, chain: Value, sizes: Value, shares: Value) -> None:
        super().__init__()
        chain, sizes, shares = (torch.as_tensor(x, dtype=torch.float64) for x in (chain, sizes, shares))
        if chain.shape[-2:] != (2, 2):
            raise ValueError(f"qualities: expected (2, 2), received {tuple(chain.shape)}")
        if sizes.shape[-1:] != shares.shape[-1:]:
            raise ValueError(f"shares: expected one for each of the sizes, received {tuple(shares.shape)}")
        self.blocks = tuple(tuple(block) for block in blocks)
        self.chain = Hyper(chain, constraints.simplex, event_dim=2, name="qualities")
        self.sizes = Hyper(sizes, constraints.greater_than(1.0), event_dim=1, name="sizes")
        self.shares = Hyper(shares, constraints.simplex, event_dim=1, name="shares")

    def ahead(self, outlier: Tensor) -> tuple[Tensor, Tensor]:
        """What the qualities of a step say of the next.

        Args:
            outlier: ``(..., B)`` of each block that it was an outlier, if the step was dirty.

        Returns:
            Logs ``(2, 2, ...)`` of the probability that the next step is clean or dirty, ``[next, this]``, and
            ``(2, ..., B)`` of each block that it is an outlier if the next step is dirty.
        """
        chain = self.chain(outlier)
        new, still = chain[..., 0, 1].unsqueeze(-1), chain[..., 1, 1].unsqueeze(-1)
        now = torch.stack([new.expand_as(outlier), new + outlier * (still - new)])
        clean = torch.log1p(-now).sum(-1)
        dirty = -torch.expm1(clean)
        return torch.stack([clean, dirty.log()]), now / dirty.unsqueeze(-1)

    def forward(self, seen: Gaussian, compare: Compare, prior: Tensor, missing: Tensor) -> tuple[Corrected, Corrected]:
        """The measurement taken as the sensor states it, and with outliers in some blocks; one block after the other.

        Args:
            seen: predictions ``(..., d)`` of what the sensor reads.
            compare: the measurement against such.
            prior: ``(..., B)`` of each block that it is an outlier if the step is dirty.
            missing: ``(..., m)`` 1 where missing, 0 where measured.
        """
        rank, only = seen.mean.dim() - 1, len(self.blocks) == 1
        one = torch.ones_like(seen.mean[..., 0])
        sizes, log_shares = in_front(self.sizes(one), rank), in_front(self.shares(one).log(), rank)
        scales = torch.cat([torch.ones_like(sizes[:1]), sizes])
        clean = dirty = unit(seen)
        clean_density = dirty_density = torch.zeros_like(one)
        outliers = []
        for b, block in enumerate(self.blocks):
            gone = sum(missing[..., i] for i in block)
            inside, residual = measured(seen, dirty, compare, block)
            answers, log_density = answer(inside, residual, scales, gone)
            if b == 0:
                inside_clean, answer_clean, log_clean = inside, tuple(x[0] for x in answers), log_density[0]
            else:
                inside_clean, residual = measured(seen, clean, compare, block)
                answer_clean, log_clean = answer(inside_clean, residual, scales[:1], gone)
                answer_clean, log_clean = tuple(x[0] for x in answer_clean), log_clean[0]
            clean = inward(clean, inside_clean, Gaussian(*answer_clean))
            clean_density = clean_density + log_clean
            share = prior[..., b]
            if only:
                joint = log_shares + log_density[1:]
                answers = Gaussian(*(x[1:] for x in answers))
            else:
                log_share = torch.cat([torch.log1p(-share).expand_as(log_density[:1]), share.log() + log_shares.expand_as(log_density[1:])])
                joint = log_share + log_density
            total = joint.logsumexp(0)
            dirty = inward(dirty, inside, moment_match(answers, joint - total))
            dirty_density = dirty_density + total
            outliers.append(one if only else (joint[1:].logsumexp(0) - total).exp())
        outlier = torch.stack(outliers, -1)
        return Corrected(clean, clean_density, torch.zeros_like(outlier)), Corrected(dirty, dirty_density, outlier)


def unit(seen: Gaussian) -> Gaussian:
    """``N(0, I)`` for each belief."""
    root = seen.scale_tril
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    return Gaussian(torch.zeros_like(seen.mean), eye.expand_as(root))


def measured(seen: Gaussian, belief: Gaussian, compare: Compare, block: Sequence[int]) -> tuple[Inside, Tensor]:
    """What one block measures of a belief in units of ``seen``'s root, and its residual ``(..., m)``."""
    (mean, root), (m, d) = seen, (len(block), seen.mean.shape[-1])
    whitened = compare(Gaussian(mean + apply(root, belief.mean), root @ belief.scale_tril))
    residual, spread = whitened.residual, whitened.spread
    if m < residual.shape[-1]:
        residual = torch.stack([residual[..., i] for i in block], -1)
        spread = torch.stack([spread[..., i, :] for i in block], -2)
    own = pad(belief.scale_tril, (spread.shape[-1] - d, 0))
    lower = tria(torch.cat([spread, own.expand(*spread.shape[:-2], *own.shape[-2:])], -2))
    return Inside(lower[..., :m, :m], lower[..., m:, :m], lower[..., m:, m:]), residual


def answer(inside: Inside, residual: Tensor, scales: Tensor, gone: Tensor) -> tuple[Gaussian, Tensor]:
    """What a measurement says of itself without noise, ``(C, ..., m)``, and its log density, for ``C`` noises.

    Args:
        inside: of the measurement.
        residual: ``(..., m)``.
        scales: ``(C, ...)`` of the noise's covariance.
        gone: ``(...)`` number of missing elements.
    """
    m = residual.shape[-1]
    eye = torch.eye(m, dtype=residual.dtype, device=residual.device)
    noise = scales.sqrt()[..., None, None] * eye
    top = hstack(noise, inside.root.unsqueeze(0))
    bottom = hstack(torch.zeros_like(eye), eye).expand_as(top)
    lower = tria(torch.cat([top, bottom], -2))
    root, cross, left = lower[..., :m, :m], lower[..., m:, :m], lower[..., m:, m:]
    normalised = whiten(root, residual.expand(root.shape[:-1]))
    return Gaussian(apply(cross, normalised), left), density(root, normalised) + 0.5 * gone * scales.log()


def inward(belief: Gaussian, inside: Inside, told: Gaussian) -> Gaussian:
    """The belief after what a measurement has told of itself."""
    root = tria(hstack(inside.cross @ told.scale_tril, inside.left))
    return Gaussian(belief.mean + apply(inside.cross, told.mean), root)
