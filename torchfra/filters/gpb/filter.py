"""GPB: every step is a mixture of hypotheses, which is merged by generalised pseudo-Bayes."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import tree
from torchfra.filters.alarms import faulty_seconds
from torchfra.filters.base import Filter
from torchfra.filters.forecast import Forecast, as_expected, measurement
from torchfra.filters.gpb import smoothing
from torchfra.filters.gpb.hypotheses import (
    BEFORE,
    MOTION,
    OUTLIER,
    Hypotheses,
    Posterior,
    estimate,
    from_state,
    merge,
    moments,
    propagate_motions,
    to_state,
    values_first,
)
from torchfra.filters.gpb.noise import LearnedNoise, NoiseScale, factors, measured_blocks
from torchfra.filters.gpb.outliers import Modes, Outliers
from torchfra.filters.gpb.regimes import (
    LARGEST_FACTORS,
    PRIOR_BURST,
    Fit,
    Regime,
    Regimes,
    Surprise,
    Switching,
    most_given,
)
from torchfra.filters.gpb.slopes import (
    Line,
    along,
    bend,
    by_points_or_line,
    by_points_or_slope,
    elements_of,
    line_at_place,
)
from torchfra.filters.gpb.states import GPBInfo, GPBPast, GPBState, LastMeasurement, Step
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import BackwardStep, Frame
from torchfra.gaussian.mixture import matched, moment_match
from torchfra.gaussian.model import canonical
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import innovation
from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_divide, safe_log, safe_sqrt
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import hstack, tria
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.steps.checks import check_weights
from torchfra.steps.records import Record, Smoothed
from torchfra.steps.recursion import Limits
from torchfra.types import Alarm, Gaussian, Whitened

PRIOR_MARGIN = 4.0
"""Factor on the covariance of an outlying prior beyond what the residual of the first measurement asks for."""
FIRST, THIRD, SIXTH = 0.7, 0.2, 0.02
"""Values of ``doubt`` above which a measurement is the first, or one of the first three or six: between powers of 1/2,
so that no rounding of a mean over hypotheses decides."""
PRIOR_SOONER = 0.6
"""By how many outliers a prior that is off is likelier than one more than ``PRIOR_BURST``, as ``regimes.SOONER``.  By
the rest of one it is less likely than ``PRIOR_BURST`` of them, which has to outweigh how far off it is: a thousandth of
1e5 standard deviations would be 100."""
PRIOR_STEEP = 3.0
"""Power of the widening by which a prior that is off is rarer at most: nothing jumps where it begins to be off."""


class Mixing(NamedTuple):
    """Weights ``(1, S, 2, ...)`` of the two components of each mixed belief."""

    own: Tensor
    """Weight of the belief itself."""
    common: Tensor
    """Weight of the common belief, from which a regime that begins starts."""
    origin: Tensor
    """Weight of each belief in that common one."""

    def smoothed(self, weight: Tensor) -> Tensor:
        """Smoothed weights of the beliefs before a step, from those of the beliefs after it, ``(1, S, 2, ...)``."""
        return weight * self.own + (weight * self.common).sum(MOTION, keepdim=True) * self.origin


class GPB(Filter[GPBState]):
    """Generalised pseudo-Bayes over regimes of the motion and outliers of the measurement.

    The regime of a step is a Markov chain: a level of process noise, a manoeuvre or a jump of the first motion, or
    another motion of a bank.  For each block of the sensor's elements, whether its measurement is an outlier is a
    Markov chain too; an outlier has one of several sizes.  Every combination is a hypothesis with a prediction, an
    update and a likelihood.  After a step the hypotheses are merged into one Gaussian for each motion (and each level
    that ``Regimes.separate_levels`` keeps separate) without an outlier in the step and one with an outlier in some
    block, whose probabilities the next measurement updates.  So no gate decides whether a large innovation is an
    outlier or a manoeuvre, and the filter is smooth in its inputs.  Over regimes it is IMM, which mixes before a step;
    over the two outlier modes GPB2, which merges them after the next measurement.  Over steps without any measurement,
    however many, both modes are propagated, and the first motion keeps its regime if regimes have no ``durations``.

    With ``o`` for an outlier in the step, ``r`` for its regime, ``k`` for the regime's belief, and a prime for the step
    before, a step is:

    1. ``c(r, o') = sum over r' of P(r | r') P(r', o')``: the Markov chain of the regimes.
    2. ``x(k, o')``: all beliefs, mixed by the probabilities that they switch to ``k``.
    3. ``x-(r, o')``: the prediction by the regime; manoeuvres and jumps scale with the normalised innovation squared.
    4. ``x(o, r, o')``, ``L(o, r, o')``: the update, and the likelihood of the measurement.
    5. ``P(o, r, o' | z) = L(o, r, o') P(o | o') c(r, o') / L``, with ``L`` the sum over all hypotheses.
    6. ``x(o, k)``, ``P(r, o | z)``: merged over the regimes of a belief and over ``o'``.
    7. ``x``: merged over all, the estimate.
    8. ``x'``: the beliefs of the step before with smoothed weights, the one-step smoothed estimate.

    ``Estimate.nis`` and the innovation are those of the Gaussian with the moments of all predictions, under the stated
    noise or the noise as learned before the step; ``log_likelihood`` is that of the mixture.  Before the first step
    there are two beliefs as well: the prior, and the prior with an inflated covariance.

    Args:
        motion: how targets move; one motion, or a ``Bank`` of several.
        sensor: what is measured; ``Sensor.blocks`` says which elements come from the same device.
        regimes: the Markov chain of the motion, of as many motions as the bank has.
        outliers: the Markov chain of outliers, of the sensor's blocks.
        noise: how the scale of each block's measurement noise is learned; None to take it as the sensor states it.
        prior_outlier: probability that the prior is an outlier: that its mean is far off.
        prior_inflation: factor on the prior's covariance in that case, except for components of kind ``"parameter"``;
            it is larger where the first measurement shows it, and 1 is for a prior that is never in doubt.
        lag: 0 for the filtered estimate, 1 for the one-step smoothed estimate; the other is in ``info``.
        rule: from a dimension to the rule that carries a Gaussian through a function.

    Raises:
        ValueError: regimes for another number of motions, blocks that do not hold each element once, noise that is
            correlated between blocks, or a rule with negative weights.

    Source: Harrison & Stevens (1976), Kirkendall (1992) for regimes and outliers as hypotheses; Bar-Shalom, Li &
    Kirubarajan (2001), section 11.6, for GPB2 and IMM; Daeipour & Bar-Shalom (1995) for modes of the noise.
    """

    limits = Limits(
        smoothing_several="GPB: hypotheses of outliers are of one sensor in the backward pass; smooth several as one, "
        "sensors.Stacked(first, second), with NaN for what was not measured"
    )

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        regimes: Regimes,
        outliers: Outliers,
        noise: LearnedNoise | None = None,
        prior_outlier: Value = 0.25,
        prior_inflation: Value = 340.0,
        lag: int = 0,
        rule: Callable[[int], Rule] = third_degree,
    ) -> None:
        super().__init__(motion if isinstance(motion, Bank) else Bank([motion]), sensor, rule)
        if lag not in (0, 1):
            raise ValueError(f"lag: expected 0 or 1 steps, received {lag!r}")
        check_weights(self)
        if regimes.motions != len(self.bank):
            raise ValueError(f"regimes: expected those of {len(self.bank)} motions, received of {regimes.motions}")
        outliers.check(sensor)
        if outliers.same_offset is not None and not sensor.linear:
            raise ValueError(f"same_offset: expected None or a linear sensor, received {type(sensor).__name__}")
        self.regimes, self.outliers, self.noise, self.lag = regimes, outliers, noise, lag
        self.prior_outlier = Hyper(prior_outlier, constraints.unit_interval, name="prior_outlier")
        self.prior_inflation = Hyper(
            prior_inflation, constraints.greater_than_eq(1.0), finite=True, name="prior_inflation"
        )

    @property
    def regime_names(self) -> tuple[str, ...]:
        """What each regime is, in the order of ``info.probabilities``; of a batch of values by its first levels."""
        regimes, motions = self.regimes, self.bank.names
        levels = [*regimes.noise_levels().flatten()[: regimes.kinds.count("level")].tolist(), 1.0]

        def name(regime: Regime) -> str:
            if regime.kind == "motion":
                return motions[regime.belief]
            named = {"level": f"{motions[0]}, ", "settled": "settled, "}.get(regime.kind)
            return regime.kind if named is None else f"{named}noise x {levels[regime.level]:.3g}"

        return tuple(map(name, regimes.each))

    @property
    def bank(self) -> Bank:
        """The motions."""
        return self.motion  # type: ignore[return-value]

    # ------------------------------------------------------------ a step

    def begin(self, belief: Gaussian) -> GPBState:
        """The state of a prior: for every belief the prior as it is, and inflated except for parameters."""
        mean, root = belief
        outlying = self.prior_outlier(mean)
        log_prior = values_first(torch.stack([torch.log1p(-outlying), outlying.log()], -1), mean.dim() + 1)
        log_weight = log_prior + safe_log(self.regimes.initial_distribution(mean[None, ..., 0]))[None, :, None]
        inflated = torch.tensor([kind != "parameter" for kind in self.motion.kinds], device=mean.device)
        factor = torch.where(inflated, self.prior_inflation(mean).sqrt()[..., None], 1.0)[..., None]
        both = tree.stack([belief, Gaussian(mean, factor * root)], OUTLIER)
        every = Hypotheses(
            Gaussian(*(x[:, None, None].expand(2, self.regimes.beliefs, 1, *x.shape[1:]) for x in both)),
            log_weight.expand(*log_weight.shape[:3], *mean.shape[:-1]),
        )
        outlier = mean.new_zeros(*mean.shape[:-1], len(self.outliers.blocks))
        relaxation = None if self.outliers.outlier_durations is None else torch.ones_like(mean[..., 0])
        last = None if self.outliers.same_offset is None else _unmeasured(mean, self.sensor)
        doubt = torch.ones_like(mean[..., 0])
        noise = None if self.noise is None else self.noise.begin(outlier, self.sensor.size)
        kept = *to_state(every, (OUTLIER, MOTION)), outlier, self.outliers.unreliable_next(outlier)
        since = torch.ones_like(doubt), torch.zeros_like(doubt), relaxation
        return GPBState(belief, belief, *kept, outlier, doubt, *since, last, noise)

    def advance(self, state: GPBState, frame: Frame) -> tuple[GPBState, Record]:
        """One step."""
        if frame.sensor is self.sensor:
            return self.update(state, frame)
        after, record = self.update(self.forget(state, frame.sensor), frame)
        return self.remember(after, state), record

    def update(self, state: GPBState, frame: Frame) -> tuple[GPBState, Record]:
        """A step by a measurement of the sensor whose outliers the state knows; numbers are the class's docstring's."""
        regimes, outliers, measured = self.regimes, self.outliers_of(frame.sensor), frame.measured.sum(-1) > 0
        before, stated = from_state(state.hypotheses, state.log_weights, (BEFORE, MOTION)), frame
        noise, frame = self.noise_of(state, frame)
        seconds = regimes.counted(state.unmeasured, frame.dt)
        switching = regimes.switch(before.log_weight, seconds, measured)  # (1)
        mixed, mixing = self.mix(before.belief, switching)  # (2)
        relaxation = outliers.relaxation(state.relaxation, frame.dt)
        predicted, surprise, widening = self.predict_regimes(
            mixed, switching.log_weight, frame, state.doubt, relaxation, state.unmeasured + frame.dt
        )  # (3)
        unreliable = outliers.unreliable_next(state.outlier, state.unreliable)
        log_mode, modes = outliers.predict(state.outlier, unreliable, relaxation, measured)
        rarity = self.outlying_rarity(state, predicted, surprise.cost, widening, frame)
        log_mode = log_mode + regimes.given_back(rarity, surprise.given)
        change = self.compare_change(state, modes, relaxation, mixed, surprise.nis, frame)
        compare = self.comparison(predicted.of([regimes.widest]).belief, frame)
        updates = outliers.update(
            predicted, compare, frame, (log_mode, modes), change, learn_noise=noise is not None
        )  # (4)
        updated = updates.every
        after, of_hypotheses = regimes.merged(updated, self.motion.angles)  # (6)
        of_beliefs, log_mode = after.share_roots(MOTION)
        posterior = Posterior.of(regimes.per_merged(of_beliefs) * of_hypotheses, log_mode)  # (5)
        belief = estimate(after.belief, of_beliefs * posterior.mode, self.motion)  # (7)
        smoothed = mixing.smoothed(regimes.by_source(posterior.probability.sum(OUTLIER, keepdim=True)))
        lagged = estimate(before.belief, safe_sqrt(smoothed), self.motion)  # (8)

        # The next state; its probabilities of outliers are those of the last step with a measurement.
        share = posterior.share[1:].unsqueeze(-1)  # a hypothesis of no weight may have failed
        blocks = (share * torch.where(share > 0, updates.outlier, 0.0)).sum((OUTLIER, MOTION, BEFORE))
        blocks = torch.where(measured.unsqueeze(-1), blocks, state.outlier)
        unreliable = outliers.unreliable_after(modes, updates, posterior.share)
        unreliable = torch.where(measured[..., None, None], unreliable, state.unreliable)
        kept = *to_state(Hypotheses(after.belief, posterior.log_regimes), (OUTLIER, MOTION)), blocks, unreliable
        relaxation = None if relaxation is None else torch.where(measured, 0.0, relaxation)
        last = (
            None
            if state.last is None
            else LastMeasurement(*[x.expand_as(state.last.z) for x in (frame.z, frame.measured)])
        )
        expected = self.compare(self.expected(predicted, frame), frame)
        root, normalised = innovation(expected)
        some_outlier = torch.where(measured, posterior.some_outlier, 0.0).unsqueeze(-1) * blocks
        if self.noise is not None and noise is not None and updates.inliers is not None:
            innovated = Gaussian(expected.residual, root)
            noise = self.noise.update(
                noise, frame, innovated, updates.inliers, posterior.probability, some_outlier, outliers.blocks
            )
        doubt = torch.where(measured, 0.5 * state.doubt, state.doubt)
        widened = torch.where(state.doubt > FIRST, widening, torch.where(state.doubt > THIRD, state.widening, 1.0))
        widened = torch.where(measured, widened, state.widening)
        unmeasured = torch.where(measured, 0.0, (state.unmeasured + frame.dt).to(doubt))
        now = GPBState(belief, lagged, *kept, state.duration, doubt, widened, unmeasured, relaxation, last, noise)
        alarm = self.alarm(state, now, posterior.some_outlier, frame)
        now = now._replace(duration=alarm.duration)  # the alarm has counted this step

        # The record: for the estimate, and for the backward pass.
        by_regime = posterior.probability.sum((OUTLIER, BEFORE)).movedim(0, -1)
        variances = torch.ones_like(state.outlier) if noise is None else noise.log_scale.exp()
        info = Step(tree.Late(lagged), by_regime, some_outlier, alarm, variances)
        ratio = None if updates.log_ratio is None else updates.log_ratio[0, :, 1].movedim(0, -1)
        by_belief = Surprise(*[x[0, 0].movedim(0, -1) for x in surprise])
        seen = measured.to(widening).expand_as(widening)
        rarity = rarity.squeeze(MOTION).movedim((0, 1), (-2, -1))
        hypotheses = (updated.log_weight - posterior.log_likelihood).movedim((0, 1, 2), (-3, -2, -1))
        past = GPBPast(*kept, by_belief, widening, rarity, seen, hypotheses, unmeasured, relaxation, ratio)
        residual, density = expected.residual, posterior.log_likelihood + frame.measurement_noise.log_norm
        if noise is not None:  # a record is in units of the stated noise
            std = frame.measurement_noise.std / stated.measurement_noise.std
            residual, root = std * residual, std.unsqueeze(-1) * root
        return now, Record(belief, residual, root, normalised, info, density, past=past)

    def noise_of(self, state: GPBState, frame: Frame) -> tuple[NoiseScale | None, Frame]:
        """What is known of the noise before a step, and the frame with noise of that scale."""
        if self.noise is None or state.noise is None:
            return None, frame
        blocks = self.outliers_of(frame.sensor).blocks
        noise = self.noise.predict(state.noise, measured_blocks(frame.measured, blocks))
        variances = factors(noise, blocks, frame.measured)
        return noise, frame._replace(measurement_noise=frame.measurement_noise.scaled(variances))

    def mix(self, before: Gaussian, switching: Switching) -> tuple[Gaussian, Mixing]:
        """The mixed beliefs ``(1, S, 2, ...)``: each of itself, and of the common one of ended regimes."""
        switches = torch.stack(torch.broadcast_tensors(*switching[:3]))
        stayed, ended, restarted = self.regimes.by_belief(switches, MOTION + 1)
        total = stayed + restarted
        total = torch.where(total < torch.finfo(total.dtype).tiny, 0.0, total)  # derivatives of a quotient overflow
        origin = safe_divide(ended, ended.sum(MOTION, keepdim=True))
        own = torch.where(total > 0, safe_divide(stayed, total), 1.0)  # without any weight a belief stays as it is
        mixing = Mixing(own, safe_divide(restarted, total), origin)
        if self.regimes.beliefs == 1:
            return before, mixing
        common = merge(before, safe_sqrt(origin), [MOTION], self.motion.angles)
        mean, root = [torch.stack(torch.broadcast_tensors(*pair)) for pair in zip(before, common, strict=True)]
        roots = safe_sqrt(torch.stack([mixing.own, mixing.common]))
        return matched(Gaussian(mean, root), roots, self.motion.angles), mixing

    def predict_regimes(
        self, mixed: Gaussian, log_weight: Tensor, frame: Frame, doubt: Tensor, relaxation: Tensor | None,
        since: Tensor,
    ) -> tuple[Hypotheses, Surprise, Tensor]:  # fmt: skip
        """Predictions of all regimes, and what they take from the measurement.

        Args:
            mixed: ``(1, S, 2, ...)`` beliefs, of each motion and of separate levels.
            log_weight: ``(1, R, 2, ...)`` of the regimes by their Markov chain.
            frame: of the step.
            doubt: ``(...)`` as in ``GPBState``.
            relaxation: from ``Outliers.relaxation``.
            since: ``(...)`` seconds since the last measurement.

        Returns:
            Hypotheses ``(1, R, 2, ...)``; how far the measurement is from the prediction as stated; and the factor
            ``(...)`` on the covariance of an outlying prior, for ``outlying_rows``.
        """
        propagated = propagate_motions(self.bank, self.motion_rule, mixed, frame)
        # Columns may be of any scale; beside a triangle the noise leaves them so.
        propagated = propagated._replace(spread=tria(propagated.spread))
        any_root = self.regimes.as_stated(propagated)
        stated = any_root._replace(scale_tril=tria(any_root.scale_tril, graded=False))
        compared = self.compare(read(stated, frame), frame)
        fit, count, first = Fit.of(compared), frame.measured.sum(-1), doubt > FIRST
        # Over 0 seconds nothing manoeuvres or jumps.
        nis = torch.where((frame.dt == 0) & ~first, 0.0, fit.squares / count.clamp_min(1.0))
        jumped = self.regimes.jumped(compared, nis, count, self.motion.dims, first)
        cost, least = self.outliers_of(frame.sensor).cost(
            compared.residual, frame.measured, relaxation, self.motion.dims, jumped.expected
        )
        rarer = self.outliers.first_rarer(frame.measured, relaxation)
        rarity = self.regimes.rarity(cost, cost - least, rarer, jumped, first)
        mean, root = self.regimes.predictions(propagated, nis, self.regimes.jump_roots(stated, nis, self.motion, since))
        given = torch.zeros_like(nis)
        if "settled" in self.regimes.kinds:
            at = self.regimes.kinds.index("settled")
            settled = Gaussian(mean[:, at : at + 1], root[:, at : at + 1])
            found = Fit.of(self.compare(read(settled, frame), frame))
            given = self.regimes.unknown(found, fit, jumped.expected, least, log_weight, count)
            given = given.clamp_max(most_given(self.motion))
            # Where half of all measurements are outliers from the beginning, the first of them would be a path.
            given = torch.where(doubt > SIXTH, 0.0, given)
        surprise = Surprise(nis, rarity, cost, given)
        widening = self.widening(Gaussian(mean[0, 0, -1], root[0, 0, -1]), frame, doubt)
        predicted = Gaussian(mean, self.outlying_rows(widening) * root)
        return Hypotheses(predicted, self.regimes.penalised(log_weight, surprise)), surprise, widening

    def widening(self, predicted: Gaussian, frame: Frame, doubt: Tensor) -> Tensor:
        """Factor ``(...)`` on the covariance of an outlying prior at the first measurement, beside ``prior_inflation``.

        It is 1 unless the residual is larger than the inflated prior explains.  Beyond that the covariance scales with
        the residual, so that priors that are off by any distance are equally likely, as outliers of the largest size
        are.  What is not measured, such as the velocity, may be off by more standard deviations than what is: a factor
        of ``PRIOR_MARGIN`` is for that.

        Args:
            predicted: ``(..., n)`` from the inflated prior, by the lowest level.
            frame: of the step.
            doubt: ``(...)`` as in ``GPBState``.
        """
        doubtful = (doubt > FIRST) & (self.prior_inflation(predicted.mean[..., 0]) > 1)
        some = doubtful.any()  # only at the first measurement; kernels too compare no belief later
        if not is_traced(some) and not some:
            return torch.ones_like(predicted.mean[..., 0])
        residual, spread, _, _ = self.compare(read(predicted, frame), frame)
        excess, size = residual.square().sum(-1) - frame.measured.sum(-1), spread.square().sum((-2, -1))
        # Bounded before it is divided: beyond the range of numbers the gradient of a quotient is NaN.
        largest = LARGEST_FACTORS[size.dtype]
        factor = PRIOR_MARGIN * safe_divide(torch.minimum(excess, largest * size), size)
        return torch.where(doubtful, factor.clamp(1.0, largest), 1.0)

    def outlying_rarity(
        self, state: GPBState, predicted: Hypotheses, cost: Tensor, widening: Tensor, frame: Frame
    ) -> Tensor:
        """Logs ``(2, 1, 2, ...)`` of factors on the probabilities of modes at the first three measurements, else 1.

        A prior that is off and outliers are the same at first.  As a jump, a prior that is off is as rare as outliers,
        ``PRIOR_BURST`` of them: so one is taken for an outlier whatever its size, and so are two; and what it loses at
        the next two measurements as it knows no velocity and no acceleration, it is given back; of a motion that has
        none no more than for a heading.  That both are wrong is rarer still: merged with an outlier after a good prior,
        it would take away what that one knows.

        Args:
            state: before the step.
            predicted: ``(1, R, 2, ...)``.
            cost: ``(1, 1, 2, ...)`` as in ``Surprise``.
            widening: ``(...)`` from ``widening``.
            frame: of the step.
        """
        off, rarer = PRIOR_STEEP * widening.log(), cost[0, 0, -1]
        count = PRIOR_BURST - PRIOR_SOONER  # of outliers; one more where there is an outlier now, too
        rarity = torch.stack([torch.minimum((1 + k) * off, (count + k) * rarer) for k in (0, 1)])
        later = (state.doubt <= FIRST) & (state.doubt > THIRD) & (frame.measured.sum(-1) > 0)
        taken = PRIOR_STEEP * state.widening.log()  # at most as much is given back: nothing for a prior that is right
        begun = torch.zeros_like(off)
        some = later.any()
        if is_traced(some) or some:
            first = Gaussian(*(x[0, 0, 0] for x in predicted.belief))
            unknown, _ = innovation(self.compare(read(first, frame), frame))
            given = torch.minimum(unknown.diagonal(dim1=-2, dim2=-1).log().sum(-1), taken)
            begun = torch.where(later, given.clamp_max(most_given(self.motion)), 0.0)
        return torch.stack([torch.stack([begun, torch.zeros_like(begun)]), -rarity], 1).unsqueeze(1)

    def outlying_rows(self, widening: Tensor) -> Tensor:
        """Factors ``(1, R, 2, ..., n, 1)`` on the rows of predicted roots: of an outlying prior.

        Parameters, biases and angles keep theirs: a heading that is off by more than a turn means nothing.  So do
        accelerations: with them any three measurements would agree.  So do jumps, which are as wide as the measurement
        asks for by themselves.
        """
        kept = ("angle", "rate", "bias", "parameter", "acceleration")
        inflated = torch.tensor([kind not in kept for kind in self.motion.kinds], device=widening.device)
        rows = torch.where(inflated, widening.sqrt().unsqueeze(-1), 1.0)
        both = torch.stack([torch.ones_like(rows), rows])[None, None].unsqueeze(-1)
        every = both.expand(1, len(self.regimes.each), *both.shape[2:])
        return self.regimes.among("jump", torch.ones_like(both), every)

    def comparison(self, widest: Gaussian, frame: Frame) -> Callable[[Gaussian, Sequence[int]], Whitened]:
        """What compares a block of the measurement with predicted beliefs.

        If points of a belief are far off a line, as after a jump, it is compared by the line where the measurement
        places the target, of the ``widest`` belief.
        """
        if frame.sensor.linear:
            return lambda belief, block: self.compare(belief, frame, block)
        known: list[Line] = []  # for all blocks; of a cache torch.compile would make a graph of its own
        widest = read(widest, frame)
        bent = bend(lambda x: self.compare(x, frame), widest)

        def line() -> Line:
            if not known:
                known.append(line_at_place(lambda x: super(GPB, self).compare(x, frame), widest))
            return known[0]

        def compare(belief: Gaussian, block: Sequence[int]) -> Whitened:
            points = self.compare(belief, frame, block)
            of_block = torch.stack([bent[..., i] for i in block], -1)
            return by_points_or_line(points, of_block, lambda: elements_of(along(line(), belief), block))

        return compare

    def compare_change(
        self, state: GPBState, modes: Modes, relaxation: Tensor | None, mixed: Gaussian, nis: Tensor, frame: Frame
    ) -> tuple[Tensor, Whitened] | None:
        """Probabilities that outliers have the offset of the step before, and the change of the measurement since.

        In that case the change of the measurement is that of the target, whatever the offset.  The change is compared
        with its prediction by each regime, ``(1, R, 2, ..., m)``.  None without ``same_offset``.
        """
        if state.last is None or not frame.sensor.linear:
            return None
        regimes, d, n = self.regimes, frame.sensor.reads, self.motion.size
        propagated, since = propagate_motions(self.bank, self.motion_rule, mixed, frame), state.unmeasured + frame.dt
        predicted = regimes.predicted_parts(propagated, nis, self.motion, since)
        mean, root = (regimes.per_regime(x) for x in mixed)
        # With x = m + S u before the step, x' - x = (m' - m) + (F S - S) u + rest + process noise.
        rest, slope = predicted.spread[..., :-n], predicted.spread[..., -n:]
        change = hstack(rest, slope - root, predicted.process_noise)[..., :d, :]
        expected = Gaussian(self.motion.difference(predicted.mean, mean)[..., :d], tria(change))
        probability = self.outliers_of(frame.sensor).same_offset_probability(
            state.outlier, modes.unreliable, relaxation, state.last.measured, frame.measured
        )
        z = frame.sensor.difference(frame.z, state.last.z)
        return probability, self.compare(expected, frame._replace(z=z))

    def expected(self, predicted: Hypotheses, frame: Frame) -> Gaussian:
        """The Gaussian ``(..., d)`` with the moments of all predictions, of the components that the sensor reads."""
        roots, _ = predicted.share_roots(OUTLIER, MOTION, BEFORE)
        return moments(read(predicted.belief, frame), roots, self.motion.angles)

    def finish(self, state: GPBState, belief: Gaussian, info: Step) -> tuple[Gaussian, GPBInfo]:
        """The estimates of all steps; the one-step smoothed estimate of a step is that of the next step's info."""
        time = info.probabilities.dim() - 2
        lagged = tree.one_earlier(info.lagged, state.belief, time, info.probabilities.shape[time])
        every = GPBInfo(belief, lagged, info.probabilities, info.outlier, info.alarm, info.noise)
        return lagged if self.lag else belief, every

    # ------------------------------------------------------------ whether the sensor is faulty

    def faulty(self, state: GPBState) -> Tensor:
        """Probability ``(..., B)`` that each block of the sensor's elements is faulty now: measures an outlier."""
        return self._faulty(state, state.log_weights[..., 1, :].exp().sum(-1))

    def _faulty(self, state: GPBState, some_outlier: Tensor) -> Tensor:
        return self.outliers.now(some_outlier.unsqueeze(-1) * state.outlier, state.relaxation)

    def alarm(self, before: GPBState, now: GPBState, some_outlier: Tensor, frame: Frame) -> Alarm:
        """Which blocks are faulty after a step, of ``some_outlier`` in probability, since when, and by how much."""
        was, faulty, sensor = self.faulty(before), self._faulty(now, some_outlier), frame.sensor
        estimated = sensor.at_points(now.belief.mean[None, ..., : sensor.reads], frame.u)[0]
        offset = torch.where(frame.measured > 0, sensor.difference(frame.z, estimated), 0.0)
        return Alarm(faulty, faulty_seconds(before.duration, was, faulty, frame.dt), offset)

    # ------------------------------------------------------------ what is expected later

    def hypotheses(self, source: GPBState | GPBPast) -> tuple[Gaussian, Tensor]:
        """Hypotheses ``(..., 2 S, n)``, each belief without and with an outlier, and logs of their weights."""
        log_weights = self.regimes.log_by_belief(source.log_weights, -1)
        mean, root = source.hypotheses
        return Gaussian(mean.flatten(-3, -2), root.flatten(-4, -3)), log_weights.flatten(-2)

    def forecast(self, state: GPBState, frame: Frame) -> Forecast:  # type: ignore[override]  # no mix
        """The prediction with the moments of all hypotheses, manoeuvres that may begin included."""
        state = state if frame.sensor is self.sensor else self.forget(state, frame.sensor)
        beliefs, log_weights = self.predict_hypotheses(state, frame)
        belief = canonical(self.motion, moment_match(beliefs, log_weights, self.motion.angles))
        seen = as_expected(frame, belief.mean)
        _, log_weights = self.predict_hypotheses(state, seen)  # a measurement that is as expected shows no jump
        _, learned = self.noise_of(state, seen)
        whitened = self.compare(read(beliefs, seen), learned)
        innovated = moment_match(Gaussian(whitened.residual, innovation(whitened)[0]), log_weights)
        return Forecast(belief, measurement(learned, innovated))

    def predict_hypotheses(self, state: GPBState, frame: Frame) -> tuple[Gaussian, Tensor]:
        """Hypotheses ``(2 R, ..., n)`` of the state after a step, and logs of their weights."""
        before = from_state(state.hypotheses, state.log_weights, (BEFORE, MOTION))
        seconds = self.regimes.counted(state.unmeasured, frame.dt)
        switching = self.regimes.switch(before.log_weight, seconds, torch.ones_like(seconds, dtype=torch.bool))
        mixed, _ = self.mix(before.belief, switching)
        relaxation = self.outliers.relaxation(state.relaxation, frame.dt)
        predicted, _, _ = self.predict_regimes(
            mixed, switching.log_weight, frame, state.doubt, relaxation, state.unmeasured + frame.dt
        )
        flat: Hypotheses = tree.map_tensors(lambda x: x.flatten(0, 2), predicted)
        return flat.belief, flat.log_weight - flat.log_weight.logsumexp(0)

    # ------------------------------------------------------------ the sensor

    def compare(self, belief: Gaussian, frame: Frame, elements: Sequence[int] | None = None) -> Whitened:
        """Compares the measurement, or some elements of it, with a predicted belief.

        Where the points of the rule show no slope, the sensor's slope at the mean stands for them.

        If the points of a wide belief lie on all sides of an anchor, their ranges do not depend on the state to first
        order: a range would not update the belief, which would keep growing.
        """
        compare = super().compare
        if frame.sensor.linear:
            whitened = compare(belief, frame)
            return whitened if elements is None else elements_of(whitened, elements)
        every = range(frame.sensor.size) if elements is None else elements
        return by_points_or_slope(lambda x: elements_of(compare(x, frame), every), belief)

    def check_noise(self, sensor: Sensor, noise: Tensor | None) -> None:
        """Checks that noise is independent between the blocks of a sensor."""
        outliers = self.outliers_of(sensor)
        if noise is None:
            outliers.check(sensor)
        else:
            outliers.check_noise("noise", noise)

    def outliers_of(self, sensor: Sensor) -> Outliers:
        """The outliers of a sensor: of another than the filter's own with its blocks."""
        if sensor is self.sensor:
            return self.outliers
        outliers = copy.copy(self.outliers)
        outliers.blocks = tuple(map(tuple, sensor.blocks))
        return outliers

    def forget(self, state: GPBState, sensor: Sensor) -> GPBState:
        """A state for a measurement of another sensor: without outliers in the last one, so that none continues."""
        outlier = state.belief.mean.new_zeros((*state.belief.mean.shape[:-1], len(sensor.blocks)))
        last = None if state.last is None else _unmeasured(state.belief.mean, sensor)
        noise = None if self.noise is None else self.noise.begin(outlier, sensor.size)
        unreliable = self.outliers.unreliable_next(outlier)
        return self.remember(state, state._replace(outlier=outlier, unreliable=unreliable, last=last, noise=noise))

    def remember(self, state: GPBState, before: GPBState) -> GPBState:
        """A state after that measurement, without outliers either, with what was known ``before`` of the own sensor."""
        relaxation = None if state.relaxation is None else torch.ones_like(state.relaxation)
        none = torch.zeros_like(before.outlier)
        last: LastMeasurement | None = tree.map_tensors(torch.zeros_like, before.last)
        return state._replace(
            outlier=none, unreliable=before.unreliable, duration=none, relaxation=relaxation, last=last,
            noise=before.noise,
        )  # fmt: skip

    # ------------------------------------------------------------ smoothing

    def past(self, belief: Gaussian, info: object, state: object, steps: GPBPast) -> GPBPast:
        """The hypotheses after each step."""
        return steps

    def last(self, past: GPBPast) -> tuple[GPBPast, Smoothed]:
        """Where the backward pass begins: the filtered hypotheses of the last step."""
        return past, smoothing.smoothed(self, past)

    def retreat(self, step: BackwardStep, after: GPBPast) -> tuple[GPBPast, Smoothed]:
        """One step of the backward pass: see ``gpb.smoothing``."""
        if after.outlier.dim() > step.past.outlier.dim():
            several: tuple[GPBPast, Smoothed] = tree.stack(
                [self.retreat(step, x) for x in tree.unbind(after, len(after.outlier))], 0
            )
            return several
        before = smoothing.retreat(self, step, after)
        return before, smoothing.smoothed(self, before)


def read(belief: Gaussian, frame: Frame) -> Gaussian:
    """The belief of the leading components ``(..., d)`` of states that the sensor of a step reads."""
    d = frame.sensor.reads
    return Gaussian(belief.mean[..., :d], belief.scale_tril[..., :d, :d])


def _unmeasured(like: Tensor, sensor: Sensor) -> LastMeasurement:
    """The measurement of a step without any, for states ``like (..., n)``."""
    none = like.new_zeros(*like.shape[:-1], sensor.size)
    return LastMeasurement(none, none)
