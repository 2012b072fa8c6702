"""Generalised pseudo-Bayes for recorded positions: levels of process noise and outliers, in closed form.

It is ``filters.GPB`` for what most recordings are, positions of targets at a nearly constant velocity: ``as_module``
makes the module of the same hypotheses.  A step has one of some levels of process noise, from flying straight to
turning as hard as can be, and a fix is an inlier or an outlier.  All axes have one covariance, the mean of theirs where
hypotheses are merged, so that a hypothesis is five numbers and two vectors, and a batch of tracks is some elementwise
operations a step.  On one axis both filters are the same.  The module does not take its place: interpreted it is more
than ten times as slow, and to compile it takes an optional package and, the first time, longer than most files do.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.numbers import as_tensor

_LOG_TWO_PI = math.log(2 * math.pi)
_LEAST = 1e-300
"""Least probability that is distinguished from 0."""
_PAUSE = 5.0, 300.0
"""Periods and seconds without a fix from which on there was a pause."""


class Belief(NamedTuple):
    """Position and velocity of a hypothesis; the axes are alike and independent."""

    position: Tensor
    """``(d, ..., B)`` m."""
    velocity: Tensor
    """``(d, ..., B)`` m/s."""
    pp: Tensor
    """``(..., B)`` variance of the position per axis, m^2."""
    pv: Tensor
    """``(..., B)`` covariance of position and velocity."""
    vv: Tensor
    """``(..., B)`` variance of the velocity."""


class OutlierModel(NamedTuple):
    """How likely outliers are."""

    after_inlier: Tensor | float = 0.015
    """Probability of an outlier after an inlier; one, or ``(B,)``."""
    after_outlier: Tensor | float = 0.35
    """Probability of an outlier after an outlier; one, or ``(B,)``."""
    least_size: float = 100.0
    """Least mean square error per axis of an outlier, in units of the variance of an inlier."""
    least_offset: Tensor | float = 0.0
    """The same as a distance, m: targets are often so far from a constant velocity; one, or ``(B,)``."""
    same_offset: Tensor | float = 0.5
    """Probability that an outlier after another is as far off in the same direction; one, or ``(B,)``."""
    beside_inlier: Tensor | float = 0.001
    """Probability of an outlier where other axes of the fix are inliers; one, or ``(B,)``."""
    beside_outlier: Tensor | float = 0.95
    """Probability of an outlier where other axes of the fix are outliers; one, or ``(B,)``."""

    @property
    def independent_offsets(self) -> OutlierModel:
        """The same model, in which no outlier has the offset of the one before.

        It serves to estimate sigma and the process noise: many outliers of one offset could stand for inliers.
        """
        return self._replace(same_offset=0.0)

    def transition(self, like: Tensor) -> Tensor:
        """Probabilities ``(2, 2, B)``, ``[now, before]``, of inlier and outlier, for tracks ``like (B,)``."""
        outlier = torch.stack([torch.zeros_like(like) + x for x in (self.after_inlier, self.after_outlier)])
        return torch.stack([1 - outlier, outlier])

    def share(self, like: Tensor) -> Tensor:
        """The long-run share of fixes that are outliers, for tracks ``like (B,)``."""
        return torch.zeros_like(like) + self.after_inlier / (self.after_inlier + 1 - self.after_outlier)


DEFAULT = OutlierModel()
"""How likely outliers are by default."""


class Chain(NamedTuple):
    """The Markov chain of the levels over any time."""

    duration: Tensor
    """``(J, B)`` mean time that a level lasts, s."""
    rates: Tensor
    """``(J, B)`` 1/s at which the modes of the chain decay."""
    to_modes: Tensor
    """``(J, J, B)``, ``[was, mode]``."""
    from_modes: Tensor
    """``(J, J, B)``, ``[mode, now]``; the transition over a gap is ``to_modes exp(-rates gap) from_modes``."""

    def shares(self, gap: Tensor) -> tuple[Tensor, Tensor]:
        """Shares ``(n, J, B)`` of levels that end within gaps ``(n, B)``, and of modes that are left after them."""
        gap = gap.unsqueeze(1)
        return -torch.expm1(-gap / self.duration), torch.exp(-gap * self.rates)

    def over(self, ends: Tensor, left: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The transition of levels with weights ``(n, J, B)`` over gaps with these ``shares``.

        Returns:
            Weights ``(n, J, B)`` of levels that last throughout; of levels that end; and of the levels at the end of
            the gap, where those at its beginning have ended.
        """
        ended = weights * ends
        lasted = weights - ended
        modes = _product(weights, self.to_modes) * left
        return lasted, ended.clamp_min(_LEAST), (_product(modes, self.from_modes) - lasted).clamp_min(_LEAST)


class Levels(NamedTuple):
    """The Markov chain of the process noise: a level lasts, then another is drawn from the restart distribution."""

    q: Tensor
    """``(J, B)`` densities, m^2/s^3, ascending where there is no ``walk``."""
    log_share: Tensor
    """``(J, B)`` logs of the shares of the time that levels have in the long run."""
    duration: Tensor
    """``(J, B)`` mean time that a level lasts, s."""
    walk: Tensor
    """``(J, B)`` densities of the random walk of a position, m^2/s, of a target that moves to and fro between fixes."""

    @property
    def log_restart(self) -> Tensor:
        """``(J, B)`` logs of the restart distribution."""
        return (self.log_share - self.duration.log()).log_softmax(0)

    @property
    def chain(self) -> Chain:
        """The chain in continuous time, ``exp(G gap)`` as in ``filters.Regimes``, by the eigenvectors of ``G``.

        ``G = (restart - I) / duration`` is the same with time reversed, so that ``s G / s`` is symmetric, with the
        roots ``s`` of the shares.
        """
        restart, root = self.log_restart.exp().T, (0.5 * self.log_share.log_softmax(0)).exp()
        scaled = (restart / self.duration.T).sqrt()
        generator = scaled.unsqueeze(-1) * scaled.unsqueeze(-2) - (1 / self.duration.T).diag_embed()
        values, vectors = torch.linalg.eigh(generator)
        to_modes, from_modes = vectors.permute(1, 2, 0) / root.unsqueeze(1), vectors.permute(2, 1, 0) * root
        # Tracks are contiguous in memory: with the strides that ``eigh`` leaves, products take three times as long.
        return Chain(self.duration, -values.T.contiguous(), to_modes.contiguous(), from_modes.contiguous())


class Fixes(NamedTuple):
    """The measurements of a batch of tracks, time first."""

    z: Tensor
    """``(T, d, B)`` m; NaN where there is none."""
    gap: Tensor
    """``(T, B)`` seconds since the step before."""
    variance: Tensor
    """``(T, B)`` of an inlier per axis, m^2."""
    log_odds: Tensor
    """``(T, B)`` log of a factor on the odds that the fix is an outlier: the evidence of the other axes."""

    @property
    def missing(self) -> Tensor:
        """``(T, B)`` whether a step has no fix."""
        return self.z.isnan().any(1)

    @property
    def elapsed(self) -> Tensor:
        """``(T, B)`` seconds since the last fix before each step; 0 where there is none before."""
        time = torch.cat([torch.zeros_like(self.gap[:1]), self.gap[1:]]).cumsum(0)
        last = torch.where(self.missing, -math.inf, time).cummax(0).values
        elapsed = (time[1:] - last[:-1]).nan_to_num(posinf=0.0)
        return torch.cat([torch.zeros_like(time[:1]), elapsed])

    @property
    def period(self) -> Tensor:
        """``(B,)`` median time between fixes, s."""
        return torch.where(self.missing, math.nan, self.elapsed).nanmedian(0).values

    @property
    def after_pause(self) -> Tensor:
        """``(T, B)`` whether a fix comes after a pause: much longer than most gaps, and than any manoeuvre lasts."""
        periods, seconds = _PAUSE
        return ~self.missing & (self.elapsed > (periods * self.period).clamp_min(seconds))

    def backwards(self) -> Fixes:
        """The fixes with time reversed."""
        gap = torch.cat([self.gap[:1], self.gap[1:].flip(0)])
        return Fixes(self.z.flip(0), gap, self.variance.flip(0), self.log_odds.flip(0))


class State(NamedTuple):
    """The filter after a fix."""

    belief: Belief
    """``(2, J, B)`` conditional on the fix being an inlier, and an outlier."""
    log_weights: Tensor
    """``(2, J, B)`` logs of the probabilities of these hypotheses."""
    outlier: Tensor
    """``(B,)`` probability that the fix is an outlier."""
    z: Tensor
    """``(d, B)`` the fix; NaN before the first."""


class Predictions(NamedTuple):
    """Predictions of all steps, from the fixes before each."""

    belief: Belief
    """``(T, J, B)`` of each level; the axes come first."""
    log_weights: Tensor
    """``(T, J, B)`` logs of the probabilities of the levels."""
    prior_outlier: Tensor
    """``(T, B)`` prior probability that the fix is an outlier."""
    outlier: Tensor
    """``(T, B)`` posterior probability that the fix is an outlier."""
    log_likelihood: Tensor
    """``(T, B)`` of each fix."""


class Step(NamedTuple):
    """One step of the filter."""

    predicted: State
    """Before the fix, conditional on an inlier and an outlier in the fix before it."""
    updated: State
    """After the fix; without a meaning for tracks that have none."""
    missing: Tensor
    """``(B,)`` whether there is no fix."""
    prior_outlier: Tensor
    """``(B,)``: see ``Predictions``."""
    outlier: Tensor
    """``(B,)``: see ``Predictions``."""
    log_likelihood: Tensor
    """``(B,)``: see ``Predictions``."""

    @property
    def filtered(self) -> State:
        """The state after the fix; the predicted one where there is none."""
        return _where(self.missing, self.predicted, self.updated)


def predictions_of(every: Iterable[Step]) -> Predictions:
    """Predictions of all steps, merged over inlier and outlier in the fix before."""
    beliefs, log_weights, *rest = zip(*((*step.predicted[:2], *step[3:]) for step in every), strict=True)
    both = Belief(*(torch.stack(x, -4) for x in zip(*beliefs, strict=True)))
    inlier, outlier = torch.stack(log_weights).unbind(1)
    merged = _merged_pair((outlier - inlier).sigmoid(), *_entries(both))
    return Predictions(merged, torch.logaddexp(inlier, outlier), *(torch.stack(x) for x in rest))


def steps(fixes: Fixes, levels: Levels, model: OutlierModel = DEFAULT) -> Iterator[Step]:
    """The steps of the filter.

    After each fix hypotheses are merged to one for each level and for inlier and outlier; these two stay separate until
    the next fix has updated their probabilities.  Steps without a fix are predicted from the last one, and leave the
    state unchanged.

    Source: Blom & Bar-Shalom (1988) for interacting models; Harrison & Stevens (1976) for outliers as hypotheses.
    """
    state, chain, log_transition = _start(fixes, levels, model), levels.chain, model.transition(fixes.gap[0]).log()
    missing, repeats = fixes.missing, bool(torch.as_tensor(model.same_offset).any())
    shares, noise = (x.unsqueeze(1) for x in chain.shares(fixes.elapsed)), _process_noise(levels, fixes.elapsed)
    rows = zip(fixes.z, fixes.variance, fixes.log_odds, missing, fixes.elapsed, missing.any(1).tolist(),
               zip(*shares, strict=True), zip(*noise, strict=True), strict=True)  # fmt: skip
    for k, (z, variance, log_odds, missing, elapsed, incomplete, of_chain, of_motion) in enumerate(rows):
        predicted = state
        if k:  # the first fix is of the time of the prior
            mixed, log_weights = switched(state.belief, state.log_weights, chain, *of_chain)
            predicted = state._replace(belief=_propagated(mixed, elapsed, *of_motion), log_weights=log_weights)
        inlier, log_density = corrected(predicted.belief, z, variance, missing, model)
        if repeats:
            log_density[1, 1] = _with_same_offset(
                log_density[1, 1], _entries(predicted.belief)[1], z - state.z, levels, elapsed, variance, model
            )
        joint = log_transition.unsqueeze(2) + predicted.log_weights + log_density  # (2, 2, J, B): now, before
        updated, log_likelihood = _weighed(predicted, z, log_odds, inlier, joint)
        log_likelihood = torch.where(missing, 0.0, log_likelihood)
        # Without a fix the state stays that of the last one, from which ``elapsed`` counts.
        state = _where(missing, state, updated) if incomplete else updated
        prior_outlier = model.after_inlier + predicted.outlier * (model.after_outlier - model.after_inlier)
        outlier = torch.where(missing, predicted.outlier, updated.outlier)
        yield Step(predicted, updated, missing, prior_outlier, outlier, log_likelihood)


def _weighed(predicted: State, z: Tensor, log_odds: Tensor, inlier: Belief, joint: Tensor) -> tuple[State, Tensor]:
    """The state after a fix, merged over inlier and outlier before it, and the log-likelihood ``(B,)`` of the fix.

    Args:
        predicted: before the fix, which an outlier leaves as it is.
        z: ``(d, B)`` the fix.
        log_odds: ``(B,)`` of ``Fixes``.
        inlier: ``(2, J, B)`` beliefs updated by the fix as an inlier.
        joint: ``(2, 2, J, B)`` logs of the joint densities of fix and hypotheses, ``[now, before]``.
    """
    share = (joint[:, 1] - joint[:, 0]).sigmoid()
    log_weights = torch.logaddexp(joint[:, 0], joint[:, 1])
    log_weights[1] += log_odds
    weights, log_likelihood = _normalised(log_weights.flatten(0, 1), 0)
    every = (torch.stack(pair, -3) for pair in zip(inlier, predicted.belief, strict=True))  # (2, 2, J, B): before, now
    belief = _merged_pair(share, *_entries(Belief(*every), -4))
    outlier = weights[log_weights.shape[1] :].sum(0)
    return State(belief, log_weights - log_likelihood, outlier, z), log_likelihood


def merged(log_weights: Tensor, belief: Belief, dim: int) -> tuple[Belief, Tensor]:
    """The Gaussian with the moments of a mixture along a dimension of the weights, and the log of their sum."""
    weight, total = _normalised(log_weights, dim)
    return _mixture(weight, belief, dim), total


def _mixture(weight: Tensor, belief: Belief, dim: int) -> Belief:
    """The Gaussian with the moments of a mixture along a dimension of its weights, which sum to one."""
    position, velocity = ((weight * x).sum(dim + 1) for x in belief[:2])
    dp, dv = belief.position - position.unsqueeze(dim + 1), belief.velocity - velocity.unsqueeze(dim + 1)
    spread = _with_spread([weight * x for x in belief[2:]], weight, dp, dv)
    return Belief(position, velocity, *(x.sum(dim) for x in spread))


def switched(belief: Belief, log_weights: Tensor, chain: Chain, ends: Tensor, left: Tensor) -> tuple[Belief, Tensor]:
    """Levels ``(n, J, B)`` after a transition over gaps with these ``chain.shares``.

    A level that lasts keeps its belief; one that is drawn again has the mixture of all that have ended.
    """
    largest = log_weights.amax(1, keepdim=True)
    lasted, ended, restarted = chain.over(ends, left, (log_weights - largest).exp())
    common = _mixture(ended / ended.sum(1, keepdim=True), belief, 1)
    total = lasted + restarted
    every = Belief(*(x.unsqueeze(-2) for x in common))
    return _merged_pair(restarted / total, belief, every), total.log() + largest


def _start(fixes: Fixes, levels: Levels, model: OutlierModel) -> State:
    """The prior: near the first fixes up to a pause, as far as those are apart, of any speed."""
    z = fixes.z
    order = (~fixes.missing).to(z).cumsum(0)
    soon = (order <= 9) & ~fixes.after_pause.cummax(0).values
    first = torch.where(soon.unsqueeze(1), z, torch.nan)
    middle = first.nanquantile(0.5, dim=0)  # the median of few fixes; of an even number, halfway between two
    apart = (first - middle).abs().nanmean((0, 1)).nan_to_num()
    shape = (2, *levels.q.shape)
    position = middle.nan_to_num()[:, None, None].expand(-1, *shape)
    pp = (1e8 + apart.square() + as_tensor(model.least_offset).square()).expand(shape)
    vv = z.new_full(shape, 1e5)
    share = model.share(fixes.gap[0])
    log_mode = torch.stack([1 - share, share]).log().unsqueeze(1)
    belief = Belief(position, torch.zeros_like(position), pp, torch.zeros_like(pp), vv)
    return State(belief, log_mode + levels.log_share, share, torch.full_like(z[0], torch.nan))


def _process_noise(levels: Levels, gap: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Variances ``pp``, ``pv`` and ``vv (T, J, B)`` after gaps ``(T, B)``: white acceleration and a random walk."""
    q, gap = levels.q, gap.unsqueeze(1)
    return q * (gap**3 / 3) + levels.walk * gap, q * (gap**2 / 2), q * gap


def _propagated(x: Belief, gap: Tensor, pp: Tensor, pv: Tensor, vv: Tensor) -> Belief:
    """Beliefs predicted by ``gap`` seconds at constant velocity, with these variances of ``_process_noise``."""
    moved = torch.addcmul(x.pv, gap, x.vv)
    spread = torch.addcmul(x.pp, gap, x.pv + moved) + pp
    return Belief(torch.addcmul(x.position, gap, x.velocity), x.velocity, spread, moved + pv, x.vv + vv)


def corrected(x: Belief, z: Tensor, variance: Tensor, missing: Tensor, model: OutlierModel) -> tuple[Belief, Tensor]:
    """Beliefs updated by an inlier, and the log densities ``(2, ...)`` of an inlier and of an outlier.

    An outlier does not update the position, and its size has the largest likelihood.
    """
    measured, d = (~missing).to(z), len(z)
    z = z.nan_to_num().reshape(d, *[1] * (x.position.dim() - z.dim()), *z.shape[1:])
    residual = z - x.position  # of a missing fix too, whose gain is 0: much faster than a choice
    squared = residual.square().sum(0)
    least = model.least_size * variance
    wide = x.pp + torch.maximum(least.clamp_min(model.least_offset**2), squared / d)
    total = x.pp + variance
    weight = measured / total
    gain, gain_v = x.pp * weight, x.pv * weight
    left = torch.addcmul(missing.to(z), variance, weight)  # 1 - gain would lose digits of a prior that is far off
    both = torch.stack([total, wide])
    log_density = torch.addcmul(
        -0.5 * d * _LOG_TWO_PI * measured, torch.add(squared / both, both.log(), alpha=d), -0.5 * measured
    )
    after = Belief(
        torch.addcmul(x.position, gain, residual), torch.addcmul(x.velocity, gain_v, residual),
        left * x.pp, left * x.pv, torch.addcmul(x.vv, gain_v, x.pv, value=-1.0),
    )  # fmt: skip
    return after, log_density


def _with_same_offset(
    log_density: Tensor,
    x: Belief,
    moved: Tensor,
    levels: Levels,
    elapsed: Tensor,
    variance: Tensor,
    model: OutlierModel,
) -> Tensor:
    """Log density ``(J, B)`` of an outlier after another, which may have the same offset.

    Then the difference ``moved (d, B)`` of the two fixes is free of the offset: ``moved = elapsed velocity + noise``.
    """
    residual, d = moved.unsqueeze(1) - elapsed * x.velocity, len(moved)
    # With the velocity v now, the way is t v - integral(s dW), with the variance t^2 vv + q t^3 / 3 - 2 t (q t^2 / 2).
    total = 2 * variance + elapsed.square() * x.vv - levels.q * (2 / 3 * elapsed**3)
    total = total + levels.walk * elapsed
    squared = residual.square().sum(0)
    offset = torch.zeros_like(variance) + model.same_offset
    same = offset.log() - 0.5 * (squared / total + d * (total.log() + _LOG_TWO_PI))
    other = log_density + torch.log1p(-offset)
    return torch.where(squared.isnan(), log_density, torch.logaddexp(other, same))


def _where(missing: Tensor, before: State, now: State) -> State:
    """The state ``before`` where there is no fix, else ``now``."""
    measured = (~missing).to(now.outlier)  # much faster than a choice, and exact at either end
    belief = Belief(*(torch.lerp(old, new, measured) for old, new in zip(before.belief, now.belief, strict=True)))
    return State(belief, *(torch.where(missing, *both) for both in zip(before[1:], now[1:], strict=True)))


def _merged_pair(share: Tensor, a: Belief, b: Belief) -> Belief:
    """The Gaussian with the moments of two, the second of weight ``share``."""
    dp, dv = b.position - a.position, b.velocity - a.velocity
    position, velocity, *inside = (torch.lerp(one, other, share) for one, other in zip(a, b, strict=True))
    return Belief(position, velocity, *_with_spread(inside, share * (1 - share), dp, dv))


def _with_spread(inside: list[Tensor], weight: Tensor, dp: Tensor, dv: Tensor) -> list[Tensor]:
    """Variances ``inside`` with ``weight`` times the mean products of offsets added to them, in place.

    Args:
        inside: ``pp``, ``pv`` and ``vv``, each ``(...)``.
        weight: ``(...)``.
        dp: ``(d, ...)`` offsets of the position.
        dv: ``(d, ...)`` of the velocity.
    """
    share = weight / len(dp)
    p_share, v_share = share * dp, share * dv
    for p, v, p_off, v_off in zip(p_share, v_share, dp, dv, strict=True):
        inside[0].addcmul_(p, p_off)
        inside[1].addcmul_(p, v_off)
        inside[2].addcmul_(v, v_off)
    return inside


def _entries(x: Belief, dim: int = -3) -> list[Belief]:
    """Each along a dimension, counted from the last; by default the first of three behind the axes."""
    return [Belief(*of) for of in zip(*(part.unbind(dim) for part in x), strict=True)]


def _product(x: Tensor, matrix: Tensor) -> Tensor:
    """Products of ``(n, J, B)`` and ``(J, K, B)``; far faster than matrices of eight rows for each of many ``B``."""
    return (x.unsqueeze(2) * matrix).sum(1)


def _normalised(log_weights: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Weights that sum to one along a dimension, and the log of what they summed to."""
    largest = log_weights.amax(dim, keepdim=True)
    weight = (log_weights - largest).exp()
    total = weight.sum(dim, keepdim=True)
    return weight / total, (largest + total.log()).squeeze(dim)
