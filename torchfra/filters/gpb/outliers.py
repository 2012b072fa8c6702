"""Outliers of a measurement: each block of elements from one device is an inlier, or an outlier of some size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.filters.gpb.hypotheses import BEFORE, MOTION, OUTLIER, Hypotheses, values_first
from torchfra.filters.gpb.noise import by_block, of_inlier
from torchfra.filters.gpb.slopes import elements_of
from torchfra.filters.gpb.updates import small_power, update
from torchfra.filters.markov import sojourn_times
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import log_sum, share_roots, without_failed
from torchfra.hyper import Hyper, Part, Value, Values, once, one_given
from torchfra.linalg.safe import in_range, safe_divide, safe_log, safe_log1p
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import apply, hstack, tria
from torchfra.numbers import as_numbers
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Whitened

LEAST_OUTLIER = 30.0
"""Mean square in units of the noise of the smallest outliers beside which a jump is seen."""

NEVER = 1e-12
"""Probability of an outlier below which it counts as that rare beside a jump."""

HALF = 0.5
"""Probability that an unreliable device measures an outlier after an inlier."""

TROUBLE = 200.0
"""For how many measurements a device stays unreliable in the mean."""

EXPECTED = 0.7
"""How much less likely an element is as predicted than with its noise alone, at most: twice the log, where they vary
alike."""


class Noise(NamedTuple):
    """The noise of a block, by the sizes of outliers, in units of what the sensor states."""

    sizes: Tensor
    """``(1 + C, ...)`` factors on its covariance, the first of no outlier."""
    shares: Tensor
    """``(C, ...)`` of outliers."""
    large: Tensor
    """``(C, ...)`` of outliers that begin while a device is unreliable: those of the larger half of the sizes."""
    offsets: Tensor | None
    """``(1 + C, ...)`` its mean; None for 0."""


class Modes(NamedTuple):
    """What is expected of blocks, after a step without an outlier and after one with some: ``(1, 1, 2, ..., B)``."""

    outlier: Tensor
    """Probability that each block is an outlier, given that some block is."""
    unreliable: Tensor
    """Probability that its device is unreliable."""
    inlier: Tensor
    """The same, if it is an inlier."""
    begun: Tensor
    """Probability of an outlier that it begins, as the device is unreliable."""
    lasted: Tensor
    """Probability of an outlier that it goes on while the device is unreliable."""


class Weighed(NamedTuple):
    """What a block says; the first dimension is whether the blocks so far, this one included, have an outlier."""

    unknowns: Gaussian
    """``(2, R, 2, ..., k)`` after the block, of ``_in_space_of``."""
    log_density: Tensor
    """``(2, R, 2, ...)`` of the block."""
    outlier: Tensor
    """``(1, R, 2, ...)`` probability that it is an outlier, given that some block is."""
    unreliable: Tensor
    """``(1, R, 2, ...)`` probability that it is one of an unreliable device, given that some block is."""
    log_ratio: Tensor | None
    """``(1, R, 2, ...)`` log likelihood ratio of outliers with and without the same offset; None without that."""
    inlier: Gaussian | None
    """``(1, R, 2, ..., k)`` if another block is an outlier and this one is not; None of a single block."""


class Updates(NamedTuple):
    """The update of all hypotheses by a measurement."""

    every: Hypotheses
    """``(2, R, 2, ...)`` without and with outliers."""
    outlier: Tensor
    """``(1, R, 2, ..., B)`` probability that each block is an outlier, given that some block is."""
    unreliable: Tensor
    """``(1, R, 2, ..., B)`` probability that it is one of an unreliable device, given that some block is."""
    log_ratio: Tensor | None
    """``(1, R, 2, ...)`` log likelihood ratio of outliers with and without the same offset; None without that."""
    inliers: Tensor | None
    """``(3, 2, R, 2, ..., m)`` of ``noise.of_inlier`` without and with outliers; None where noise is as stated."""


class Outliers(Part):
    """Whether measurements are outliers: a Markov chain for each block of elements.

    The device of a block may be unreliable, for ``TROUBLE`` measurements in the mean.  While it is, an outlier follows
    an inlier with a probability of ``HALF``, of the larger half of the sizes alone: smaller ones look like noise or
    process noise that is stated too small.  So what is half outliers is filtered as such after few of them, and a
    single outlier does not make the next one likely.  How long outliers last says nothing of it: they may be a target
    that has jumped.

    Args:
        blocks: indices of the elements of each block: those of a device fail together.
        outlier_transition: ``(..., 2, 2)``, ``[i, j] = P(now j | was i)`` of no outlier and outlier, from one
            measurement to the next, whatever the time between them; rows sum to one.
        outlier_durations: ``(..., 2)`` instead of it: mean sojourn times, s, without outliers and in a fault.
        outlier_sizes: ``(..., C)`` factors on the covariance of the measurement noise of outliers.
        outlier_shares: ``(..., C)`` share of the outliers that have each size; they sum to one.
        outlier_offsets: ``(..., C)`` mean of the noise of outliers of each size, in units of the nominal noise, as of
            ranges without a line of sight, which are too large; None for 0.
        adaptive_largest_size: whether the last size is at least the mean squared residual of a block in units of its
            noise, so that outliers of any size beyond it are equally likely.
        outliers_update: whether outliers update the belief, as measurements with larger noise; if not, it stays as
            predicted.
        unreliable: ``(...)`` probability that a device is unreliable before its first measurement.
        same_offset: ``(...)`` probability that an outlier of a block that was one in the step before has the same
            offset, as the fixes of a second target have; it does not update the belief.  Both steps are assumed to have
            the noise of the later one.  For linear sensors; None for 0.

    Raises:
        ValueError: shapes that do not go together, values out of their range or that do not sum to one, or not one of
            ``outlier_transition`` and ``outlier_durations``.
    """

    outlier_transition: Hyper | None
    """None if ``outlier_durations`` were given."""
    outlier_durations: Hyper | None
    """None if ``outlier_transition`` was given."""
    outlier_offsets: Hyper | None
    """None if none were given."""
    same_offset: Hyper | None
    """None if none was given."""

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
        outliers_update: bool = True,
        unreliable: Value = 0.0,
        same_offset: Value | None = None,
    ) -> None:
        super().__init__()
        self.adaptive_largest_size, self.outliers_update = adaptive_largest_size, outliers_update
        name, modes = one_given(outlier_transition=outlier_transition, outlier_durations=outlier_durations)
        arguments = {name: modes, "outlier_sizes": outlier_sizes, "outlier_shares": outlier_shares}
        modes, sizes, shares = (as_numbers(x, argument).double() for argument, x in arguments.items())
        event = (2, 2) if name == "outlier_transition" else (2,)
        if modes.shape[-len(event) :] != event:
            raise ValueError(f"{name}: expected {event}, received {tuple(modes.shape)}")
        if sizes.shape[-1:] != shares.shape[-1:]:
            raise ValueError(f"outlier_shares: expected one for each of outlier_sizes, received {tuple(shares.shape)}")
        offsets = None if outlier_offsets is None else as_numbers(outlier_offsets, "outlier_offsets").double()
        if offsets is not None and not bool(offsets.isfinite().all()):
            raise ValueError(f"outlier_offsets: expected finite numbers, received {offsets.tolist()}")
        if offsets is not None and offsets.shape[-1:] != sizes.shape[-1:]:
            raise ValueError(
                f"outlier_offsets: expected one for each of outlier_sizes, received {tuple(offsets.shape)}"
            )
        self.blocks = tuple(tuple(block) for block in blocks)
        self.outlier_transition = self.outlier_durations = None
        if name == "outlier_transition":
            self.outlier_transition = Hyper(modes, constraints.simplex, event_dim=2, name=name)
        else:
            self.outlier_durations = sojourn_times(modes, 1, name)
        self.outlier_sizes = Hyper(sizes, constraints.greater_than(1.0), event_dim=1, name="outlier_sizes")
        self.outlier_shares = Hyper(shares, constraints.simplex, event_dim=1, name="outlier_shares")
        self.outlier_offsets = None
        if offsets is not None:
            self.outlier_offsets = Hyper(offsets, constraints.real, event_dim=1, name="outlier_offsets")
        self.unreliable = Hyper(unreliable, constraints.unit_interval, name="unreliable")
        self.same_offset = None
        if same_offset is not None:
            self.same_offset = Hyper(same_offset, constraints.unit_interval, name="same_offset")

    def check(self, sensor: Sensor) -> None:
        """Checks that the blocks are those of a sensor.

        Raises:
            ValueError: an element in no block or in several, or noise that is correlated between blocks.
        """
        if not all(self.blocks) or sorted(i for block in self.blocks for i in block) != list(range(sensor.size)):
            raise ValueError(f"blocks: expected each of {sensor.size} elements once, received {self.blocks}")
        self.check_noise("sensor", sensor.root)

    def check_noise(self, name: str, root: Tensor | None) -> None:
        """Checks that noise with a root ``(..., m, m)`` of its covariance, if there is one, fits the blocks.

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
        # A correlation of less is rounding, in float32 too.
        correlated = covariance.abs() > 1e-6 * std.unsqueeze(-1) * std.unsqueeze(-2)
        if bool((correlated & ~within).any()):
            raise ValueError(f"{name}: expected noise that is independent between blocks, received a correlation")

    def relaxation(self, before: Tensor | None, dt: Tensor) -> Tensor | None:
        """How far ``(...)`` the Markov chain has returned to its stationary distribution, ``dt (...)`` seconds later.

        It is ``1 - exp(-t (1 / without + 1 / faulty))``, ``t`` seconds after a measurement.  Before the first
        measurement the chain is in its stationary distribution.

        Args:
            before: the relaxation ``dt`` seconds earlier: 0 at a measurement, 1 before the first.  None without
                durations; then it stays None.
            dt: seconds.
        """
        if before is None:
            return None
        rate = (1 / self.outlier_durations(before)).sum(-1)  # type: ignore[misc]
        later: Tensor = before - (1 - before) * torch.expm1(-dt * rate)
        return later

    def unreliable_next(self, like: Tensor, unreliable: Tensor | None = None) -> Tensor:
        """Probability ``(..., 2, B)`` that each device is unreliable at its next measurement.

        Args:
            like: ``(..., B)``.
            unreliable: ``(..., 2, B)`` the same at the last one, if it had no outlier and if some; None before the
                first.
        """
        usual: Tensor = self.unreliable(like[..., 0])[..., None, None].expand(*like.shape[:-1], 2, like.shape[-1])
        return usual if unreliable is None else unreliable + (usual - unreliable) / TROUBLE

    def now(self, outlier: Tensor, relaxation: Tensor | None) -> Tensor:
        """Probability ``(..., B)`` that each block is faulty now, from that at the last measurement.

        Without durations the chain counts measurements, and the probability stays until the next one.

        Args:
            outlier: ``(..., B)`` probability of an outlier at the last measurement.
            relaxation: ``(...)`` from ``relaxation``, None without durations.
        """
        if relaxation is None:
            return outlier
        begins, lasts = self._probabilities(outlier, relaxation)
        return begins + outlier * (lasts - begins)

    def predict(
        self, outlier: Tensor, unreliable: Tensor, relaxation: Tensor | None, measured: Tensor
    ) -> tuple[Tensor, Modes]:
        """Logs ``(2, 1, 2, ...)`` of the probabilities that the next step has no outlier or some, and of its blocks.

        Without a measurement in it, the modes stay.

        Args:
            outlier: ``(..., B)`` probability that each block was an outlier, given that some block was.
            unreliable: ``(..., 2, B)`` from ``unreliable_next``.
            relaxation: ``(...)`` from ``relaxation``, None without durations.
            measured: ``(...)`` bool, whether the next step has a measurement.
        """
        begins, lasts = self._probabilities(outlier, relaxation)
        unreliable = unreliable.movedim(-2, 0)[None, None]
        begins = begins + unreliable * (HALF - begins)
        was = torch.stack([torch.zeros_like(outlier), outlier])[None, None]
        now = begins + was * (lasts - begins)
        none = safe_log1p(-now).sum(-1)
        some = -torch.expm1(none)
        share = torch.ones_like(now) if len(self.blocks) == 1 else safe_divide(now, some.unsqueeze(-1))
        same = torch.eye(2, dtype=now.dtype, device=now.device).log().reshape(2, 1, 2, *[1] * measured.dim())
        log_mode = torch.where(measured, torch.cat([none, safe_log(some)]), same)
        inlier = unreliable * safe_divide((1 - was) * (1 - HALF) + was * (1 - lasts), 1 - now)
        begun, lasted = (unreliable * safe_divide(x, now) for x in ((1 - was) * HALF, was * lasts))
        return log_mode, Modes(share, unreliable, inlier, begun, lasted)

    def same_offset_probability(
        self, outlier: Tensor, unreliable: Tensor, relaxation: Tensor | None, before: Tensor, now: Tensor
    ) -> Tensor:
        """Probability ``(1, 1, 2, ..., B)`` that an outlier of a block has the offset of the step before.

        It is 0 after a step without outliers, and where an element is measured now that was missing then.

        Args:
            outlier: ``(..., B)`` as in ``predict``.
            unreliable: ``(1, 1, 2, ..., B)`` as in ``Modes``.
            relaxation: ``(...)`` from ``relaxation``, None without durations.
            before: ``(..., m)`` 1 where the step before was measured, 0 where missing.
            now: ``(..., m)`` the same of this step.
        """
        begins, lasts = self._probabilities(outlier, relaxation)
        begins = begins + unreliable[0, 0, 1] * (HALF - begins)
        lasted = safe_divide(outlier * lasts, begins + outlier * (lasts - begins))
        unknown = torch.stack([(now * (1 - before))[..., list(block)].amax(-1) for block in self.blocks], -1)
        after_some = (1 - unknown) * lasted * self.same_offset(outlier[..., 0]).unsqueeze(-1)  # type: ignore[misc]
        return torch.stack([torch.zeros_like(after_some), after_some])[None, None]

    def _probabilities(self, like: Tensor, relaxation: Tensor | None) -> tuple[Tensor, Tensor]:
        """Probabilities ``(..., 1)`` of an outlier of a reliable device after none, and after one."""
        if relaxation is None:
            transition = self.outlier_transition(like)  # type: ignore[misc]
            return transition[..., 0, 1].unsqueeze(-1), transition[..., 1, 1].unsqueeze(-1)
        without, faulty = self.outlier_durations(like).unbind(-1)  # type: ignore[misc]
        begins, lasts = relaxation * faulty / (without + faulty), 1 - relaxation * without / (without + faulty)
        return begins.unsqueeze(-1), lasts.unsqueeze(-1)

    def first_rarer(self, like: Tensor, relaxation: Tensor | None) -> Tensor:
        """Log ``(...)`` of how much rarer the first of several outliers is than each later one; ``like (..., m)``."""
        begins, lasts = self._probabilities(like, relaxation)
        return (lasts / begins.clamp_min(NEVER)).clamp_min(1.0).log()[..., 0]

    def cost(
        self, residual: Tensor, measured: Tensor, relaxation: Tensor | None, dims: int, expected: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Log ``(...)`` of how much less likely a measurement is as outliers in bursts than as stated, and its least.

        Each block is whichever is likelier.  Of more elements than tell a place it is the share of so many.  It is at
        least that of outliers of ``LEAST_OUTLIER`` in all elements, 0 without a measurement, and infinite where no
        number holds the square of a residual.

        Args:
            residual: ``(..., m)`` of a prediction, in units of the noise.
            measured: ``(..., m)`` 1 where measured, 0 where missing.
            relaxation: ``(...)`` from ``relaxation``, None without durations.
            dims: of space.
            expected: ``(...)`` how much less likely an element is as predicted than with its noise alone: twice the
                log.
        """
        begins, lasts = self._probabilities(measured, relaxation)
        rare = -torch.maximum(begins, lasts).clamp_min(NEVER).log()
        squares, counts = by_block(residual.square(), self.blocks), by_block(measured, self.blocks)
        held = (squares < torch.inf).all(-1)
        squares = squares.clamp(max=torch.finfo(squares.dtype).max)
        log_density = self._log_outlying(squares, counts) + 0.5 * (1 + expected).unsqueeze(-1) * counts
        total = torch.minimum(0.5 * squares, rare - log_density).sum(-1)
        least = (rare - self.outlier_shares(measured)[..., -1:].log()).squeeze(-1) * len(self.blocks)
        least = least + 0.5 * measured.shape[-1] * (math.log(LEAST_OUTLIER) - EXPECTED)
        elements, least = measured.sum(-1), least * min(1.0, dims / measured.shape[-1])
        total = torch.maximum(total * (dims / elements.clamp_min(dims)), least)
        return torch.where(elements > 0, torch.where(held, total, torch.inf), 0.0), least

    def _log_outlying(self, squares: Tensor, counts: Tensor) -> Tensor:
        """Log densities ``(..., B)`` of blocks as outliers, from sums of squares in units of the noise and counts."""
        rank = squares.dim()
        sizes = values_first(self.outlier_sizes(squares[..., 0]).unsqueeze(-2), rank)
        log_shares = values_first(self.outlier_shares(squares[..., 0]).unsqueeze(-2), rank).log()
        if self.adaptive_largest_size:
            largest = torch.maximum(sizes[-1:], squares / counts.clamp_min(1.0))
            sizes = torch.cat([sizes[:-1].expand(-1, *largest.shape[1:]), largest])
        return log_sum(log_shares - 0.5 * (counts * sizes.log() + squares / sizes), 0)

    def update(
        self,
        predicted: Hypotheses,
        compare: Callable[[Gaussian, Sequence[int]], Whitened],
        frame: Frame,
        modes: tuple[Tensor, Modes],
        change: tuple[Tensor, Whitened] | None = None,
        *,
        learn_noise: bool = False,
    ) -> Updates:
        """The update of all hypotheses, without outliers and with outliers in some blocks.

        Blocks are independent, so the update takes one after the other, and its cost is linear in their number.  For
        each block the updates under the nominal noise and under that of outliers of all sizes are merged at once, in
        the space of the measurement: beliefs are in units of the root of the prediction, ``N(0, I)`` at first.  The
        error of the statistical linearisation is nearly the same for all blocks, so only the first block that is
        measured has it as noise: if each block had it as independent noise, a belief along an arc would be too small.

        Args:
            predicted: ``(1, R, 2, ...)``.
            compare: compares some elements of the measurement with a belief ``(..., d)`` of the components that
                the sensor reads.
            frame: of the step.
            modes: from ``predict``.
            change: from ``same_offset_probability``, and the change of the measurement compared with its prediction.
            learn_noise: whether to return what inliers say about the noise.
        """
        (log_mode, of_blocks), reads, missing = modes, frame.sensor.reads, 1 - frame.measured
        mean, root = predicted.belief.mean[..., :reads], predicted.belief.scale_tril[..., :reads, :reads]
        eye, noise = torch.eye(reads, dtype=root.dtype, device=root.device), self._noise(mean)
        belief, log_density = Gaussian(torch.zeros_like(mean), eye.expand_as(root)), torch.zeros_like(mean[..., 0])
        none_measured = torch.ones_like(missing[..., :1, None])
        weighed: list[Weighed] = []
        learned: list[Tensor] = []
        for b, block in enumerate(self.blocks):
            so_far = Gaussian(mean + apply(root, belief.mean), root @ belief.scale_tril) if b else Gaussian(mean, root)
            whitened, block_missing = compare(so_far, block), missing[..., list(block)]
            if b and whitened.rest.shape[-1]:
                whitened = whitened._replace(spread=hstack(none_measured * tria(whitened.rest), whitened.slope))
            none_measured = none_measured * block_missing.amin(-1)[..., None, None]
            rows, cross, independent, residual = _in_space_of(whitened, belief)
            since = None if change is None else (change[0][..., b], elements_of(change[1], block))
            expected = Modes(*[x[..., b] for x in of_blocks])
            found = self._weigh_modes(rows, residual, block_missing, expected, noise, since)
            weighed.append(found)
            if learn_noise:
                learned.append(_of_inliers(found, rows, residual, block_missing))
            spread = cross @ found.unknowns.scale_tril
            spread = spread if independent is None else hstack(spread, independent)
            belief = Gaussian(belief.mean + apply(cross, found.unknowns.mean), tria(spread))
            log_density = log_density + found.log_density
        log_weight = without_failed(log_mode + predicted.log_weight + log_density)
        ratios = [found.log_ratio for found in weighed if found.log_ratio is not None]
        elements = [i for block in self.blocks for i in block]
        return Updates(
            Hypotheses(_lifted(predicted.belief, belief), log_weight),
            torch.stack([found.outlier for found in weighed], -1),
            torch.stack([found.unreliable for found in weighed], -1),
            reduce(torch.add, ratios) if ratios else None,
            torch.cat(learned, -1)[..., sorted(range(len(elements)), key=elements.__getitem__)] if learned else None,
        )

    def unreliable_after(self, modes: Modes, updates: Updates, share: Tensor) -> Tensor:
        """Probability ``(..., 2, B)`` that each device is unreliable, if a measurement is no outlier and if some is.

        Args:
            modes: from ``predict``.
            updates: from ``update``.
            share: ``(2, R, 2, ...)`` probabilities of the hypotheses without and with outliers, given these.
        """
        none, some = share.unsqueeze(-1).split(1, OUTLIER)
        # A hypothesis of no weight may have failed.
        outlier, unreliable = (torch.where(some > 0, x, 0.0) for x in (updates.outlier, updates.unreliable))
        each = torch.cat([none * modes.inlier, some * (unreliable + (1 - outlier) * modes.inlier)])
        return each.sum((MOTION, BEFORE)).movedim(0, -2)

    @once
    def _noise(self, mean: Tensor) -> Noise:
        """The noise of a block, by the sizes of outliers, for ``mean (..., n)``."""
        rank = mean.dim() - 1
        sizes, shares = (values_first(x(mean), rank) for x in (self.outlier_sizes, self.outlier_shares))
        half = len(sizes) // 2
        large = torch.cat([torch.zeros_like(shares[:half]), shares[half:]])
        large = safe_divide(large, large.sum(0), 1 / (len(sizes) - half))
        sizes = torch.cat([torch.ones_like(sizes[:1]), sizes])
        if self.outlier_offsets is None:
            return Noise(sizes, shares, large, None)
        offsets = values_first(self.outlier_offsets(mean), rank)
        return Noise(sizes, shares, large, torch.cat([torch.zeros_like(offsets[:1]), offsets]))

    def _weigh_modes(
        self, rows: Tensor, residual: Tensor, missing: Tensor, modes: Modes, noise: Noise,
        change: tuple[Tensor, Whitened] | None,
    ) -> Weighed:  # fmt: skip
        """The update of the unknowns of ``_in_space_of`` by one block.

        Args:
            rows: ``(1 or 2, R, 2, ..., m, k)`` measurement matrix of the unknowns, ``N(0, I)`` before; its first
                dimension is that of the blocks before this one, 1 for the first block.
            residual: ``(1 or 2, R, 2, ..., m)``.
            missing: ``(..., m)`` 1 where missing, 0 where measured.
            modes: of the block, each ``(1, 1, 2, ...)``.
            noise: of the block.
            change: probability that an outlier has the offset of the step before, and the measurement's change since.
        """
        # After blocks of which some is an outlier: this one is none, or one of some size.
        stds = self.adapted(noise.sizes, residual[-1:], missing, noise.offsets)
        updated, density = update(rows[-1:], residual[-1:], stds, missing, noise.offsets)
        inlier = none = updated.of(0)
        log_none = density.log(0)
        if len(rows) > 1:  # after blocks of which none is an outlier, nor is this one
            first, of_first = update(rows[:1], residual[:1], noise.sizes[:1].sqrt(), missing)
            none, log_none = first.of(0), of_first.log(0)
        if not self.outliers_update:
            updated = updated.before_prior(1, len(stds) - 1)
        # Given that some block is an outlier, a single one is: no inlier among its modes.
        single = len(self.blocks) == 1
        shares = noise.shares + modes.begun * (noise.large - noise.shares)
        unreliable = safe_divide(modes.begun * noise.large + modes.lasted * noise.shares, shares)
        prior = modes.outlier * shares
        if not single:
            prior = torch.cat([1 - modes.outlier.unsqueeze(0), prior])
        joint = density.exponent[single:] + torch.where(prior > 0, 0.0, -torch.inf)
        factor, log_ratio = torch.where(prior > 0, prior, 1.0) * density.factor[single:], None
        if change is not None:  # one more mode, which the noise of two steps explains
            probability, whitened = change
            _, same = update(whitened.spread, whitened.residual, (2 * noise.sizes[:1]).sqrt(), missing)
            log_without = log_sum(joint + factor.log(), 0)
            inliers, outliers = joint.split([len(joint) - len(shares), len(shares)])
            log_same = (same.exponent + modes.outlier.log() + safe_log(probability)).expand_as(joint[:1])
            joint = torch.cat([inliers, outliers + safe_log1p(-probability), log_same])
            factor = torch.cat([factor, same.factor.expand_as(factor[:1])])
            updated = updated.before_prior(len(stds), 1)
            unreliable = torch.cat([unreliable, modes.unreliable.expand_as(unreliable[:1])])
            log_ratio = _log_ratio(log_sum(joint + factor.log(), 0), log_without)

        roots, log_some = share_roots(joint, factor)
        some = updated.merged(roots)
        more = some.scale_tril.shape[-1] - none.scale_tril.shape[-1]
        none = none._replace(scale_tril=pad(none.scale_tril, (0, more)))
        both = Gaussian(*[torch.cat(x) for x in zip(none, some, strict=True)])
        each = roots[-len(unreliable) :].square()
        outlier = torch.ones_like(log_some) if single else each.sum(0)
        unreliable = (each * unreliable).sum(0)
        return Weighed(
            both, torch.cat([log_none, log_some]), outlier, unreliable, log_ratio, None if single else inlier
        )

    def adapted(self, sizes: Tensor, residual: Tensor, missing: Tensor, offsets: Tensor | None = None) -> Tensor:
        """Roots ``(C, ...)`` of the sizes, the last at least the root mean square of a residual if adaptive.

        Args:
            sizes: ``(C, ...)`` of the noise's covariance.
            residual: ``(..., m)``; its square may overflow.
            missing: ``(..., m)`` 1 where missing, 0 where measured.
            offsets: ``(C, ...)`` mean of the noise; None for 0.
        """
        if not self.adaptive_largest_size:
            return sizes.sqrt()
        if offsets is not None:
            residual = residual - offsets[-1:].unsqueeze(-1) * (1 - missing)
        fits, small = in_range(4 * residual).all(-1), small_power(residual.dtype)
        scaled = torch.where(fits.unsqueeze(-1), residual, small * residual)
        mean_square = scaled.square().sum(-1) / (1 - missing).sum(-1).clamp_min(1.0)
        last = torch.maximum(torch.where(fits, sizes[-1:], 0.0), mean_square).sqrt()
        last = torch.where(fits, last, last / small)
        return torch.cat([sizes[:-1].sqrt().expand(-1, *last.shape[1:]), last])


def _in_space_of(whitened: Whitened, belief: Gaussian) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    """Measurement and belief as functions of the same ``k`` independent unknowns of variance 1.

    Returns:
        The measurement matrix ``rows (..., m, k)`` of the unknowns; the matrix ``cross (..., d, k)`` from the unknowns
        to the belief; a root ``(..., d, d)`` of the part of the belief that is independent of the unknowns, None if
        there is none; and the residual ``(..., m)``.
    """
    residual, spread, _, _ = whitened
    m, d = residual.shape[-1], belief.mean.shape[-1]
    if spread.shape[-1] == d == m:  # the belief's own unknowns suffice
        return spread, belief.scale_tril, None, residual
    own = pad(belief.scale_tril, (spread.shape[-1] - d, 0))
    lower = tria(torch.cat([spread, own], -2))
    return lower[..., :m, :m], lower[..., m:, :m], lower[..., m:, m:], residual


def _lifted(predicted: Gaussian, belief: Gaussian) -> Gaussian:
    """Beliefs of whole states, any root, from those of the components that a sensor reads, in units of the root."""
    mean, root = predicted
    gain = root[..., : belief.mean.shape[-1]]
    own = gain @ belief.scale_tril
    return Gaussian(mean + apply(gain, belief.mean), hstack(own, root[..., gain.shape[-1] :]))


def _of_inliers(found: Weighed, rows: Tensor, residual: Tensor, missing: Tensor) -> Tensor:
    """``noise.of_inlier`` of a block, ``(3, 2, R, 2, ..., m)``, without an outlier so far and with some.

    Args:
        found: what it says.
        rows: ``(1 or 2, R, 2, ..., m, k)`` as in ``_weigh_modes``.
        residual: ``(1 or 2, R, 2, ..., m)``.
        missing: ``(..., m)`` 1 where missing, 0 where measured.
    """
    none = of_inlier(Gaussian(*[x[:1] for x in found.unknowns]), rows[:1], residual[:1], missing)
    if found.inlier is None:
        return torch.cat([none, torch.zeros_like(none)], 1)
    # An inlier of no weight may be far beyond the range of numbers.
    some, outlier = of_inlier(found.inlier, rows[-1:], residual[-1:], missing), found.outlier.unsqueeze(-1)
    return torch.cat([none, torch.where(outlier < 1, some, 0.0) * (1 - outlier)], 1)


def _log_ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    """The log of a ratio from two logs; 0 where the denominator is 0."""
    nothing = denominator == -torch.inf
    return torch.where(nothing, 0.0, numerator - torch.where(nothing, 0.0, denominator))
