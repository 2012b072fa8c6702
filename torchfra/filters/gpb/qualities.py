"""Qualities of a measurement: each block of elements from one device is as stated, or an outlier of some size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra import tree
from torchfra.filters.gpb.regimes import in_front
from torchfra.gaussian.mixture import matched, shared
from torchfra.hyper import Hyper, Values
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import apply, hstack, tria
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Whitened

Compare = Callable[[Gaussian], Whitened]
C = TypeVar("C", bound=tuple)  # type: ignore[type-arg]


class Corrected(NamedTuple):
    """What a measurement makes of predictions ``(..., d)``, in a clean step and in a dirty one."""

    belief: Gaussian
    """``(2, ..., d)`` in units of the prediction's root, any root: ``N(0, I)`` where the measurement says nothing."""
    log_density: Tensor
    """``(2, ...)`` of the measurement."""
    outlier: Tensor
    """``(..., B)`` probability of each block that it is an outlier, if the step is dirty."""


class Inside(NamedTuple):
    """What is measured, without its noise, and the belief, by the same independent unknowns of variance 1.

    Measured is ``rows`` times ``k`` unknowns; the belief follows those by ``cross``, and others by ``left``.
    """

    rows: Tensor
    """``(..., m, k)``."""
    cross: Tensor
    """``(..., d, k)``."""
    left: Tensor | None
    """``(..., d, d)``, what no measurement of this block can tell; None for nothing."""


class Qualities(nn.Module):
    """Whether measurements are outliers: a Markov chain for each block of elements.

    Args:
        blocks: numbers of the elements of each block: those of a device fail together.
        chain: ``(..., 2, 2)``, ``chain[i, j] = P(now j | was i)`` of clean and outlier, rows that sum to one.
        sizes: ``(..., C)`` by which an outlier's measurement noise is multiplied, as a covariance.
        shares: ``(..., C)`` of the outliers that have each size, which sum to one.
        grows: whether the last size grows to the mean square error of a block, in units of its noise, where that is
            larger: outliers of any size are then as likely as others of that kind.

    Raises:
        ValueError: shapes that do not go together, values out of their range or that do not sum to one.
    """

    def __init__(
        self, blocks: Sequence[Sequence[int]], *, chain: Values, sizes: Values, shares: Values, grows: bool = True
    ) -> None:
        super().__init__()
        self.grows = grows
        chain, sizes, shares = (torch.as_tensor(x, dtype=torch.float64) for x in (chain, sizes, shares))
        if chain.shape[-2:] != (2, 2):
            raise ValueError(f"qualities: expected (2, 2), received {tuple(chain.shape)}")
        if sizes.shape[-1:] != shares.shape[-1:]:
            raise ValueError(f"shares: expected one for each of the sizes, received {tuple(shares.shape)}")
        self.blocks = tuple(tuple(block) for block in blocks)
        self.chain = Hyper(chain, constraints.simplex, event_dim=2, name="qualities")
        self.sizes = Hyper(sizes, constraints.greater_than(1.0), event_dim=1, name="sizes")
        self.shares = Hyper(shares, constraints.simplex, event_dim=1, name="shares")

    def check(self, sensor: Sensor) -> None:
        """Checks that the blocks are those of a sensor.

        Raises:
            ValueError: an element in no block or in several, or noise that is correlated between blocks.
        """
        if not all(self.blocks) or sorted(i for block in self.blocks for i in block) != list(range(sensor.size)):
            raise ValueError(f"blocks: expected each of {sensor.size} elements once, received {self.blocks}")
        self.check_noise("sensor", sensor.root)

    def check_noise(self, name: str, root: Tensor | None) -> None:
        """Checks that the noise of a root ``(..., m, m)`` of its covariance, if there is one, fits the blocks.

        Raises:
            ValueError: it is correlated between blocks.
        """
        if root is None or len(self.blocks) == 1 or is_traced(root):
            return
        covariance = root @ root.mT
        std = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        within = torch.zeros(covariance.shape[-2:], dtype=torch.bool, device=root.device)
        for block in self.blocks:
            within[torch.tensor(block).unsqueeze(-1), torch.tensor(block)] = True
        correlated = covariance.abs() > 1e-6 * std.unsqueeze(-1) * std.unsqueeze(-2)
        if bool((correlated & ~within).any()):
            raise ValueError(f"{name}: expected noise that is independent between blocks, received a correlation")

    def ahead(self, outlier: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """What the qualities of a step say of the next; where nothing is measured in that, they stay.

        Args:
            outlier: ``(..., B)`` of each block that it was an outlier, if the step was dirty.
            measured: ``(...)`` whether anything is measured in the next step.

        Returns:
            Logs ``(2, 2, ...)`` of the probability that the next step is clean or dirty, ``[next, this]``, and
            ``(2, ..., B)`` of each block that it is an outlier if the next step is dirty.
        """
        chain = self.chain(outlier)
        new, still = chain[..., 0, 1].unsqueeze(-1), chain[..., 1, 1].unsqueeze(-1)
        now = torch.stack([new.expand_as(outlier), new + outlier * (still - new)])
        clean = torch.log1p(-now).sum(-1)
        dirty = -torch.expm1(clean)
        share = torch.ones_like(now) if len(self.blocks) == 1 else now / dirty.unsqueeze(-1)
        same = torch.eye(2, dtype=now.dtype, device=now.device).log().reshape(2, 2, *[1] * measured.dim())
        return torch.where(measured, torch.stack([clean, dirty.log()]), same), share

    def forward(
        self, seen: Gaussian, whitened: Whitened, compare: Compare, prior: Tensor, missing: Tensor
    ) -> Corrected:
        """The measurement, ``(2, ...)``: taken as the sensor states it, and with outliers in some blocks.

        Blocks are independent, so they are taken one after the other: what they cost adds up.

        Args:
            seen: predictions ``(..., d)`` of what the sensor reads.
            whitened: the measurement against them, ``(1, ...)``.
            compare: the measurement against others.
            prior: ``(..., B)`` of each block that it is an outlier if the step is dirty.
            missing: ``(..., m)`` 1 where missing, 0 where measured.
        """
        (mean, root), rank = seen, seen.mean.dim() - 1
        sizes, log_shares = in_front(self.sizes(seen.mean), rank), in_front(self.shares(seen.mean).log(), rank)
        sizes = torch.cat([torch.ones_like(sizes[:1]), sizes])  # of a clean block, and of an outlier
        belief, log_density, outliers = unit(seen), torch.zeros_like(seen.mean[..., 0]), []
        for b, block in enumerate(self.blocks):
            share, gone = prior[..., b], missing[..., list(block)]
            if b:
                whitened = compare(Gaussian(mean + apply(root, belief.mean), root @ belief.scale_tril))
            inside, residual = measured(whitened, belief, block)
            told, log_told = told_by(inside.rows[-1], residual[-1], self.grown(sizes, residual[-1], gone), gone)
            clean, log_clean = told, log_told[:1]
            if b:  # clean and dirty have the first block in common alone
                clean, log_clean = told_by(inside.rows[0], residual[0], sizes[:1], gone)
            joint = torch.cat([log_told[:1] + torch.log1p(-share), log_told[1:] + share.log() + log_shares])
            none = int(len(self.blocks) == 1)  # a step is dirty by this block alone: it is not clean then
            roots, total = shared(joint[none:])
            dirty = matched(Gaussian(told.mean[none:], told.scale_tril[none:]), roots)
            belief = inward(belief, inside, tree.stack([entry(clean, 0), dirty], 0))
            log_density = log_density + torch.cat([log_clean, total.unsqueeze(0)])
            outliers.append(torch.ones_like(total) if none else roots[1:].square().sum(0))
        return Corrected(belief, log_density, torch.stack(outliers, -1))

    def grown(self, sizes: Tensor, residual: Tensor, missing: Tensor) -> Tensor:
        """Sizes ``(C, ...)`` of the noise, the last one as large as a residual ``(..., m)`` asks for, if it grows."""
        if not self.grows:
            return sizes
        asked = residual.square().sum(-1) / (1 - missing).sum(-1).clamp_min(1.0)
        last = torch.maximum(sizes[-1:], asked)
        return torch.cat([sizes[:-1].expand(-1, *last.shape[1:]), last])


def unit(seen: Gaussian) -> Gaussian:
    """``N(0, I) (1, ..., d)`` for each belief ``(..., d)``."""
    root = seen.scale_tril
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    return Gaussian(torch.zeros_like(seen.mean).unsqueeze(0), eye.expand_as(root).unsqueeze(0))


def entry(tuples: C, i: int) -> C:
    """One entry along the first dimension of all tensors."""
    chosen: C = tree.map_tensors(lambda x: x[i], tuples)
    return chosen


def measured(whitened: Whitened, belief: Gaussian, block: Sequence[int]) -> tuple[Inside, Tensor]:
    """What one block measures of a belief in units of the prediction's root, and its residual ``(1 or 2, ..., m)``."""
    residual, spread, m, d = whitened.residual, whitened.spread, len(block), belief.mean.shape[-1]
    if m < residual.shape[-1]:
        residual = torch.stack([residual[..., i] for i in block], -1)
        spread = torch.stack([spread[..., i, :] for i in block], -2)
    if spread.shape[-1] == d:
        return Inside(spread, belief.scale_tril, None), residual
    own = pad(belief.scale_tril, (spread.shape[-1] - d, 0))
    lower = tria(torch.cat([spread, own], -2))
    return Inside(lower[..., :m, :m], lower[..., m:, :m], lower[..., m:, m:]), residual


def told_by(rows: Tensor, residual: Tensor, sizes: Tensor, missing: Tensor) -> tuple[Gaussian, Tensor]:
    """What a measurement tells of its unknowns, ``(C, ..., k)``, any root, and its log density, for ``C`` noises.

    Elements are taken one after the other, as their noise is independent.

    Args:
        rows: ``(..., m, k)`` of ``Inside``.
        residual: ``(..., m)``.
        sizes: ``(C, ...)`` of the noise's covariance.
        missing: ``(..., m)`` 1 where missing, 0 where measured.

    Source: Potter's square-root update, in Bierman (1977), chapter II.
    """
    rows = rows.movedim((-2, -1), (0, 1)).contiguous().unsqueeze(2)  # sums over short first dimensions are fast
    m, k, rank = rows.shape[0], rows.shape[1], rows.dim() - 2
    root = torch.eye(k, dtype=rows.dtype, device=rows.device).reshape(k, k, *(1,) * rank)
    mean, noise, squares, stds = torch.zeros_like(rows[0]), sizes.sqrt(), torch.zeros_like(residual[..., 0]), []
    for i in range(m):
        follows = (root * rows[i].unsqueeze(1)).sum(0)
        std = (follows.square().sum(0) + sizes).sqrt()
        once = 1 / (std * (std + noise))
        inverse = (std + noise) * once  # of std, by the same division
        normalised = (residual[..., i] - (mean * rows[i]).sum(0)) * inverse
        covariance = (root * follows).sum(1)
        mean = mean + covariance * (normalised * inverse)
        root = root - covariance.unsqueeze(1) * (follows * once)
        squares = squares + normalised.square()
        stds.append(torch.where(missing[..., i] > 0, 1.0, std))
    # Two at a time: their product does not overflow where their squares do not.
    log_density = -0.5 * squares
    for i in range(0, m, 2):
        log_density = log_density - reduce(torch.mul, stds[i : i + 2]).log()
    return Gaussian(mean.movedim(0, -1), root.movedim((0, 1), (-2, -1))), log_density


def inward(belief: Gaussian, inside: Inside, told: Gaussian) -> Gaussian:
    """The belief after what a measurement has told of itself."""
    root = inside.cross @ told.scale_tril
    root = root if inside.left is None else hstack(root, inside.left)
    return Gaussian(belief.mean + apply(inside.cross, told.mean), tria(root))
