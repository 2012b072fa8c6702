"""Outliers of a measurement: each block of elements from one device is as stated, or an outlier of some size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce

import torch
from torch import Tensor, nn
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.filters.gpb.hypotheses import Hypotheses
from torchfra.filters.gpb.regimes import in_front
from torchfra.filters.markov import mean_durations
from torchfra.gaussian.mixture import matched, shared, without_failed
from torchfra.hyper import Hyper, Values, one_given
from torchfra.linalg.safe import safe_divide, safe_log, safe_log1p
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import apply, hstack, tria
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Whitened


class Outliers(nn.Module):
    """Whether measurements are outliers: a Markov chain for each block of elements.

    Args:
        blocks: numbers of the elements of each block: those of a device fail together.
        outlier_transition: ``(..., 2, 2)``, ``[i, j] = P(now j | was i)`` of no outlier and outlier, from one
            measurement to the next, whatever the time between them; rows sum to one.
        outlier_durations: ``(..., 2)`` instead of it: mean seconds without outliers, and that a device is wrong then.
        outlier_sizes: ``(..., C)`` by which an outlier's measurement noise is multiplied, as a covariance.
        outlier_shares: ``(..., C)`` of the outliers that have each size, which sum to one.
        outlier_offsets: ``(..., C)`` by which the elements of outliers of each size are too large in the mean, in units
            of their noise, as ranges without a line of sight are; None for 0.
        adaptive_largest_size: whether the last size grows to the mean square error of a block, in units of its noise,
            where that is larger: outliers of any size are then as likely as others of that kind.

    Raises:
        ValueError: shapes that do not go together, values out of their range or that do not sum to one, or not one of
            ``outlier_transition`` and ``outlier_durations``.
    """

    outlier_transition: Hyper | None
    """None if it was made with ``outlier_durations``."""
    outlier_durations: Hyper | None
    """None if it was made with ``outlier_transition``."""
    outlier_offsets: Hyper | None
    """None if it was made without."""

    def __init__(
        self,
        blocks: Sequence[Sequence[int]],
        *,
        outlier_sizes: Values,
        outlier_shares: Values,
        outlier_transition: Values | None = None,
        outlier_durations: Values | None = None,
        outlier_offsets: Values | None = None,
        adaptive_largest_size: bool = True,
    ) -> None:
        super().__init__()
        self.adaptive_largest_size = adaptive_largest_size
        name, chain = one_given(outlier_transition=outlier_transition, outlier_durations=outlier_durations)
        given = chain, outlier_sizes, outlier_shares
        chain, sizes, shares = (torch.as_tensor(x, dtype=torch.float64) for x in given)
        event = (2, 2) if name == "outlier_transition" else (2,)
        if chain.shape[-len(event) :] != event:
            raise ValueError(f"{name}: expected {event}, received {tuple(chain.shape)}")
        if sizes.shape[-1:] != shares.shape[-1:]:
            raise ValueError(f"outlier_shares: expected one for each of outlier_sizes, received {tuple(shares.shape)}")
        offsets = None if outlier_offsets is None else torch.as_tensor(outlier_offsets, dtype=torch.float64)
        if offsets is not None and not bool(offsets.isfinite().all()):
            raise ValueError(f"outlier_offsets: expected finite numbers, received {offsets.tolist()}")
        if offsets is not None and offsets.shape[-1:] != sizes.shape[-1:]:
            raise ValueError(
                f"outlier_offsets: expected one for each of outlier_sizes, received {tuple(offsets.shape)}"
            )
        self.blocks = tuple(tuple(block) for block in blocks)
        self.outlier_transition = self.outlier_durations = None
        if name == "outlier_transition":
            self.outlier_transition = Hyper(chain, constraints.simplex, event_dim=2, name=name)
        else:
            self.outlier_durations = mean_durations(chain, 1, name)
        self.outlier_sizes = Hyper(sizes, constraints.greater_than(1.0), event_dim=1, name="outlier_sizes")
        self.outlier_shares = Hyper(shares, constraints.simplex, event_dim=1, name="outlier_shares")
        self.outlier_offsets = None
        if offsets is not None:
            self.outlier_offsets = Hyper(offsets, constraints.real, event_dim=1, name="outlier_offsets")

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

    def forgotten(self, before: Tensor | None, dt: Tensor) -> Tensor | None:
        """How far ``(...)`` the last measurement says nothing of outliers any more, ``dt (...)`` seconds later.

        Before the first measurement they are as likely as the chain has them in the long run.

        Args:
            before: 0 at a measurement, 1 before the first; None without durations, where it stays so.
            dt: seconds.
        """
        if before is None:
            return None
        rate = (1 / self.outlier_durations(before)).sum(-1)  # type: ignore[misc]
        later: Tensor = before - (1 - before) * torch.expm1(-dt * rate)
        return later

    def now(self, outlier: Tensor, forgotten: Tensor | None) -> Tensor:
        """Probability ``(..., B)`` of each block that it is wrong now, from that at the last measurement.

        Without durations the chain counts measurements, and what was wrong stays so until the next.

        Args:
            outlier: ``(..., B)`` at the last measurement.
            forgotten: ``(...)`` from ``forgotten``, None without durations.
        """
        if forgotten is None:
            return outlier
        begins, lasts = self._chances(outlier, forgotten)
        return begins + outlier * (lasts - begins)

    def ahead(self, outlier: Tensor, forgotten: Tensor | None, measured: Tensor) -> tuple[Tensor, Tensor]:
        """What the outliers of a step say of those of the next; where nothing is measured in that, they stay.

        Args:
            outlier: ``(..., B)`` probability of each block that it was an outlier, if any was.
            forgotten: ``(...)`` from ``forgotten``, None without durations.
            measured: ``(...)`` whether anything is measured in the next step.

        Returns:
            Logs ``(2, 1, 2, ...)`` of the probability that the next step has no outlier or some, after one without and
            with some, and ``(1, 1, 2, ..., B)`` of each block that it is one if any is.
        """
        begins, lasts = self._chances(outlier, forgotten)
        now = torch.stack([begins.expand_as(outlier), begins + outlier * (lasts - begins)])[None, None]
        none = safe_log1p(-now).sum(-1)
        some = -torch.expm1(none)
        share = torch.ones_like(now) if len(self.blocks) == 1 else safe_divide(now, some.unsqueeze(-1))
        same = torch.eye(2, dtype=now.dtype, device=now.device).log().reshape(2, 1, 2, *[1] * measured.dim())
        return torch.where(measured, torch.cat([none, safe_log(some)]), same), share

    def _chances(self, like: Tensor, forgotten: Tensor | None) -> tuple[Tensor, Tensor]:
        """Probabilities ``(..., 1)`` of an outlier after none, and after one."""
        if forgotten is None:
            chain = self.outlier_transition(like)  # type: ignore[misc]
            return chain[..., 0, 1].unsqueeze(-1), chain[..., 1, 1].unsqueeze(-1)
        without, wrong = self.outlier_durations(like).unbind(-1)  # type: ignore[misc]
        begins, lasts = forgotten * wrong / (without + wrong), 1 - forgotten * without / (without + wrong)
        return begins.unsqueeze(-1), lasts.unsqueeze(-1)

    def update(
        self,
        predicted: Hypotheses,
        compare: Callable[[Gaussian, Sequence[int]], Whitened],
        reads: int,
        missing: Tensor,
        before: tuple[Tensor, Tensor],
    ) -> tuple[Hypotheses, Tensor]:
        """The measurement taken as the sensor states it, and with outliers in some blocks.

        Blocks are independent, so they are taken one after the other: what they cost adds up.  Each is taken with its
        noise as stated and with that of outliers of all sizes, and these are merged at once, in the space of what is
        measured: beliefs are kept in units of the root of the prediction, ``N(0, I)`` at first.  What the points of a
        sensor that bends add to its noise is much the same for all blocks, so the first one that is measured alone has
        it: counted for each, as if it were independent, it makes a belief along an arc too sure.

        Args:
            predicted: ``(1, R, 2, ...)``.
            compare: some elements of the measurement against a belief ``(..., d)`` of what the sensor reads.
            reads: ``d``, the leading components of a state that the sensor reads.
            missing: ``(..., m)`` 1 where missing, 0 where measured.
            before: from ``ahead``.

        Returns:
            ``(2, R, 2, ...)`` without and with outliers, and the probability ``(1, R, 2, ..., B)`` of each block that
            it is one if any is.
        """
        log_mode, prior = before
        mean, root = predicted.belief.mean[..., :reads], predicted.belief.scale_tril[..., :reads, :reads]
        rank, eye = mean.dim() - 1, torch.eye(reads, dtype=root.dtype, device=root.device)
        sizes, log_shares = in_front(self.outlier_sizes(mean), rank), in_front(self.outlier_shares(mean).log(), rank)
        sizes = torch.cat([torch.ones_like(sizes[:1]), sizes])  # of no outlier, and of outliers
        offsets = None
        if self.outlier_offsets is not None:
            offsets = in_front(self.outlier_offsets(mean), rank)
            offsets = torch.cat([torch.zeros_like(offsets[:1]), offsets])
        belief, log_density, outliers = (
            Gaussian(torch.zeros_like(mean), eye.expand_as(root)),
            torch.zeros_like(mean[..., 0]),
            [],
        )
        only, first_one = len(self.blocks) == 1, torch.ones_like(missing[..., :1, None])
        for b, block in enumerate(self.blocks):
            share, gone = prior[..., b], missing[..., list(block)]
            so_far = Gaussian(mean + apply(root, belief.mean), root @ belief.scale_tril) if b else Gaussian(mean, root)
            whitened = compare(so_far, block)
            if b and whitened.rest.shape[-1]:
                whitened = whitened._replace(spread=hstack(first_one * tria(whitened.rest), whitened.slope))
            first_one = first_one * gone.amin(-1)[..., None, None]
            rows, cross, left, residual = _in_space_of(whitened, belief)
            adapted = self.adapted(sizes, residual[-1:], gone, offsets)
            updated, log_updated = sequential(rows[-1:], residual[-1:], adapted, gone, offsets)
            none, log_none = _entry(updated, 0), log_updated[0]
            if b:  # with and without outliers have the first block's prediction in common alone
                first, log_first = sequential(rows[:1], residual[:1], sizes[:1], gone)
                none, log_none = _entry(first, 0), log_first[0]
            joint = torch.cat(
                [(log_updated[0] + torch.log1p(-share)).unsqueeze(0), log_updated[1:] + share.log() + log_shares]
            )
            first_size = int(only)  # if some block is an outlier and there is no other, this one is
            roots, log_some = shared(joint[first_size:])
            some = matched(Gaussian(updated.mean[first_size:], updated.scale_tril[first_size:]), roots)
            both = Gaussian(*(torch.cat(x) for x in zip(none, some, strict=True)))
            spread = cross @ both.scale_tril
            spread = spread if left is None else hstack(spread, left)
            belief = Gaussian(belief.mean + apply(cross, both.mean), tria(spread))
            log_density = log_density + torch.cat([log_none, log_some])
            outliers.append(torch.ones_like(log_some) if only else roots[1:].square().sum(0))
        log_weight = without_failed(log_mode + predicted.log_weight + log_density)
        return Hypotheses(_lifted(predicted.belief, belief), log_weight), torch.stack(outliers, -1)

    def adapted(self, sizes: Tensor, residual: Tensor, missing: Tensor, offsets: Tensor | None = None) -> Tensor:
        """Sizes ``(C, ...)`` of the noise, the last one as large as a residual ``(..., m)`` asks for, if it grows."""
        if not self.adaptive_largest_size:
            return sizes
        if offsets is not None:
            residual = residual - offsets[-1:].unsqueeze(-1) * (1 - missing)
        asked = residual.square().sum(-1) / (1 - missing).sum(-1).clamp_min(1.0)
        last = torch.maximum(sizes[-1:], asked)
        return torch.cat([sizes[:-1].expand(-1, *last.shape[1:]), last])


def sequential(
    rows: Tensor, residual: Tensor, sizes: Tensor, missing: Tensor, offsets: Tensor | None = None
) -> tuple[Gaussian, Tensor]:
    """A measurement's unknowns ``(C, ..., k)`` after it, any root, and its log density, for ``C`` sizes of its noise.

    Elements are taken one after the other, as their noise is independent.

    Args:
        rows: ``(..., m, k)``: measured are these times the unknowns, which are ``N(0, I)`` before.
        residual: ``(..., m)``.
        sizes: ``(C, ...)`` of the noise's covariance, in units of what the sensor states.
        missing: ``(..., m)`` 1 where missing, 0 where measured.
        offsets: ``(C, ...)`` mean of the noise, in the same units; None for 0.

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
        off = residual[..., i] if offsets is None else residual[..., i] - offsets * (1 - missing[..., i])
        normalised = (off - (mean * rows[i]).sum(0)) * inverse
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


def _in_space_of(whitened: Whitened, belief: Gaussian) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    """What is measured, and the belief, by the same independent unknowns of variance 1.

    Returns:
        ``rows (..., m, k)``: measured, without its noise, are these times ``k`` unknowns; ``cross (..., d, k)`` by
        which the belief follows those; a root ``(..., d, d)`` of what no measurement can tell of it, None for nothing;
        and the residual ``(..., m)``.
    """
    residual, spread, _, _ = whitened
    m, d = residual.shape[-1], belief.mean.shape[-1]
    if spread.shape[-1] == d:  # the belief's own unknowns suffice
        return spread, belief.scale_tril, None, residual
    own = pad(belief.scale_tril, (spread.shape[-1] - d, 0))
    lower = tria(torch.cat([spread, own], -2))
    return lower[..., :m, :m], lower[..., m:, :m], lower[..., m:, m:], residual


def _lifted(predicted: Gaussian, belief: Gaussian) -> Gaussian:
    """Beliefs of states, any root, from those of the components that a sensor reads, in units of the predicted root."""
    mean, root = predicted
    gain = root[..., : belief.mean.shape[-1]]
    own = gain @ belief.scale_tril
    return Gaussian(mean + apply(gain, belief.mean), hstack(own, root[..., gain.shape[-1] :]))


def _entry(belief: Gaussian, i: int) -> Gaussian:
    return Gaussian(belief.mean[i], belief.scale_tril[i])
