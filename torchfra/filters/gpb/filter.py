"""GPB: every step as a mixture of hypotheses, merged by generalised pseudo-Bayes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra import tree
from torchfra.filters.alarms import lasting
from torchfra.filters.base import Filter, Mix
from torchfra.filters.gpb import smoothing
from torchfra.filters.gpb.hypotheses import (
    BEFORE,
    MOTION,
    OUTLIER,
    Hypotheses,
    batch_first,
    carry,
    estimate,
    from_state,
    merge,
    to_state,
)
from torchfra.filters.gpb.outliers import Outliers
from torchfra.filters.gpb.regimes import Moves, Regimes, in_front
from torchfra.filters.gpb.slopes import by_points_or_slope, exactly, of_elements
from torchfra.filters.gpb.states import GPBInfo, GPBPast, GPBState, Step
from torchfra.filters.interaction import for_each_model
from torchfra.filters.other_sensors import sharing
from torchfra.filters.records import Record, Smoothed
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import BackwardStep, Frame, Measurements
from torchfra.gaussian.mixture import matched
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import innovation
from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_divide, safe_log, safe_sqrt
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Alarm, Gaussian, Whitened


class Mixing(NamedTuple):
    """What the mixed belief of each motion is made of, ``(1, K, 2, ...)``."""

    own: Tensor
    """The share of its own."""
    common: Tensor
    """The share of the one that regimes which begin have in common."""
    origin: Tensor
    """The share that each motion has in that one."""

    def smoothed(self, weight: Tensor) -> Tensor:
        """Probabilities of the motions before a step, from those of what they became, by motion."""
        return weight * self.own + (weight * self.common).sum(MOTION, keepdim=True) * self.origin


class GPB(Filter[GPBState]):
    """Generalised pseudo-Bayes over regimes of the motion and outliers of the measurement.

    A step's regime is a Markov chain: a level of the process noise, a manoeuvre or a jump of a motion, and the other
    motions of a bank.  Whether what each block of the sensor's elements measures is an outlier, of one of some sizes,
    is a Markov chain too.  Every combination is a hypothesis with a prediction, an update and a likelihood.  After a
    step they are merged into one Gaussian for each motion and for whether the step had an outlier in any block; these
    two are kept apart until the next measurement has said which of them was right.  So nothing is decided by a gate,
    and all is smooth: the next measurement weighs an outlier against a manoeuvre.  Over steps without any measurement,
    however many, both are carried on, and the first motion keeps its regime, if regimes have no ``durations``.

    With ``o`` for an outlier in the step, ``r`` for its regime, ``k`` for the regime's motion, and a prime for the step
    before, a step is:

    1. ``c(r, o') = sum over r' of P(r | r') P(r', o')``: regimes go on or begin.
    2. ``x(k, o')``: the beliefs of all motions, mixed by the probabilities that they switch to ``k``.
    3. ``x-(r, o')``: predicted by the regime, of a manoeuvre or a jump as wide as the measurement asks for.
    4. ``x(o, r, o')``, ``L(o, r, o')``: updated, and how likely the measurement is.
    5. ``P(o, r, o' | z) = L(o, r, o') P(o | o') c(r, o') / L``, with ``L`` the sum of all.
    6. ``x(o, k)``: merged over the regimes of a motion and what was before; ``P(r, o)`` their sum.
    7. ``x``: merged over all, the estimate.
    8. ``x'``: the beliefs before, with smoothed weights: the step before, smoothed by this one.

    ``Estimate.nis`` and the innovation are those of the Gaussian with the moments of all predictions, with the noise as
    the sensor states it; ``log_likelihood`` is that of the mixture.  Before the first step there are two beliefs too:
    the prior as given, and the same widened, should it be far off.

    Args:
        motion: how targets move; a ``Bank`` of several.
        sensor: what is measured; ``Sensor.blocks`` says which elements come from the same device.
        regimes: the Markov chain of the motion, of as many motions as the bank has.
        outliers: the Markov chain of outliers, of the sensor's blocks.
        prior_outlier: probability that the prior is far off.
        prior_inflation: factor on the prior's covariance then, but for parameters (``kinds`` of the motion).
        lag: 0 for the filtered estimate, 1 for the one-step smoothed estimate; the other is in ``info``.
        rule: from a number of states to the rule that carries a Gaussian through a function.

    Raises:
        ValueError: regimes of other motions, blocks that do not cover the measurement once, correlated noise between
            blocks, or a rule with negative weights.

    Source: Harrison & Stevens (1976), Kirkendall (1992) for regimes and outliers as hypotheses; Bar-Shalom, Li &
    Kirubarajan (2001), section 11.6, for GPB2 and IMM; Daeipour & Bar-Shalom (1995) for modes of the noise.
    """

    keeps_past = alarms = True

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        regimes: Regimes,
        outliers: Outliers,
        prior_outlier: Value = 0.25,
        prior_inflation: Value = 340.0,
        lag: int = 0,
        rule: Callable[[int], Rule] = third_degree,
    ) -> None:
        super().__init__(motion if isinstance(motion, Bank) else Bank([motion]), sensor, rule)
        if lag not in (0, 1):
            raise ValueError(f"lag: expected 0 or 1 steps, received {lag!r}")
        if self.signed:
            raise ValueError("rule: expected one without negative weights, received one with some")
        if regimes.motions != len(self.bank):
            raise ValueError(f"regimes: expected those of {len(self.bank)} motions, received of {regimes.motions}")
        outliers.check(sensor)
        self.regimes, self.outliers, self.lag = regimes, outliers, lag
        self.prior_outlier = Hyper(prior_outlier, constraints.unit_interval, name="prior_outlier")
        self.prior_inflation = Hyper(prior_inflation, constraints.greater_than_eq(1.0), name="prior_inflation")

    @property
    def bank(self) -> Bank:
        """The motions."""
        return self.motion  # type: ignore[return-value]

    # ------------------------------------------------------------ a step

    def begin(self, belief: Gaussian) -> GPBState:
        """The state of a belief: as it is, and widened, for every motion; what is known of parameters stays."""
        mean, root = belief
        far_off = self.prior_outlier(mean)
        log_prior = in_front(torch.stack([torch.log1p(-far_off), far_off.log()], -1), mean.dim() + 1)
        log_weight = log_prior + safe_log(self.regimes.initial_distribution(mean[None, ..., 0]))[None, :, None]
        widened = torch.tensor([kind != "parameter" for kind in self.motion.kinds], device=mean.device)
        factor = torch.where(widened, self.prior_inflation(mean).sqrt()[..., None], 1.0)[..., None]
        both = tree.stack([belief, Gaussian(mean, factor * root)], OUTLIER)
        every = Hypotheses(
            Gaussian(*(x[:, None, None].expand(2, len(self.bank), 1, *x.shape[1:]) for x in both)),
            log_weight.expand(*log_weight.shape[:3], *mean.shape[:-1]),
        )
        outlier = mean.new_zeros(*mean.shape[:-1], len(self.outliers.blocks))
        forgotten = None if self.outliers.outlier_durations is None else torch.ones_like(mean[..., 0])
        return GPBState(belief, belief, *to_state(every, (OUTLIER, MOTION)), outlier, outlier, forgotten)

    def advance(self, state: GPBState, frame: Frame, mix: Mix | None = None) -> tuple[GPBState, Record]:
        """One step; ``mix`` is not looked at, as this filter mixes itself."""
        regimes, angles, measured = self.regimes, self.motion.angles, frame.measured.sum(-1) > 0
        before = from_state(state.hypotheses, state.log_weights, (BEFORE, MOTION))
        moves = regimes.moves(before.log_weight, frame.dt, measured)  # (1)
        mixed, mixing = self.mix(before.belief, moves)  # (2)
        predicted, nis = self.predict_regimes(mixed, moves.log_weight, frame)  # (3)
        forgotten = self.outliers.forgotten(state.forgotten, frame.dt)
        chances = self.outliers.ahead(state.outlier, forgotten, measured)
        updated, outlier = self.update(predicted, frame, chances)  # (4)
        found = updated.posterior()  # (5)
        after = regimes.merged(updated, angles)  # (6)
        belief = estimate(after.belief, after.shares(MOTION)[0] * found.mode, self.motion)  # (7)
        origin = mixing.smoothed(regimes.by_motion(found.probability.sum(OUTLIER, keepdim=True)))
        lagged = estimate(before.belief, safe_sqrt(origin), self.motion)  # (8)

        if_any = (found.share[1:].unsqueeze(-1) * outlier).sum((OUTLIER, MOTION, BEFORE))
        if_any = torch.where(measured.unsqueeze(-1), if_any, state.outlier)
        any_outlier = torch.where(measured, found.mode[1, 0, 0].square(), 0.0).unsqueeze(-1)
        of_regimes = batch_first(found.probability.sum((OUTLIER, BEFORE), keepdim=True), MOTION)
        carried = *to_state(Hypotheses(after.belief, found.log_regimes), (OUTLIER, MOTION)), if_any
        expected = self.compare(self.expected(predicted), frame)
        forgotten = None if forgotten is None else torch.where(measured, 0.0, forgotten)
        now = GPBState(belief, lagged, *carried, state.lasted, forgotten)
        alarm = self.alarm(state, now, frame)
        info = Step(tree.Late(lagged), of_regimes, any_outlier * if_any, alarm)
        past = GPBPast(*carried, batch_first(nis, BEFORE), measured.to(nis).expand(nis.shape[3:]), forgotten)
        record = Record(belief, expected.residual, *innovation(expected), info, found.log_likelihood, past=past)
        return now._replace(lasted=alarm.lasted), record

    def mix(self, before: Gaussian, moves: Moves) -> tuple[Gaussian, Mixing]:
        """What each motion starts from, ``(1, K, 2, ...)``: its own belief, or what is known where others end."""
        stayed, left, restarted = (self.regimes.by_motion(x) for x in moves[:3])
        ahead = stayed + restarted
        origin = safe_divide(left, left.sum(MOTION, keepdim=True))
        mixing = Mixing(safe_divide(stayed, ahead), safe_divide(restarted, ahead), origin)
        if len(self.bank) == 1:
            return before, mixing
        common = merge(before, safe_sqrt(origin), [MOTION], self.motion.angles)
        two = tree.stack([before, common], 0)
        return matched(two, safe_sqrt(torch.stack([mixing.own, mixing.common])), self.motion.angles), mixing

    def predict_regimes(self, mixed: Gaussian, log_weight: Tensor, frame: Frame) -> tuple[Hypotheses, Tensor]:
        """Predictions of all regimes, and the NIS per element ``(1, 1, 2, ...)`` of the agile level.

        Args:
            mixed: ``(1, K, 2, ...)`` of each motion.
            log_weight: ``(1, R, 2, ...)`` of the regimes, before it is known how far off the measurement is.
            frame: of the step.
        """
        ahead = carry(self.bank, self.motion_rule, mixed, for_each_model(frame))
        agile = self.regimes.agile_prediction(ahead)
        _, normalised = innovation(self.compare(self.read(agile), frame))
        nis = normalised.square().sum(-1) / frame.measured.sum(-1).clamp_min(1.0)
        nis = torch.where(frame.dt == 0, 0.0, nis)  # over no time nothing jumps
        predicted = self.regimes.predictions(ahead, nis, self.motion.position)
        return Hypotheses(predicted, self.regimes.rarer(log_weight, nis)), nis

    def update(self, predicted: Hypotheses, frame: Frame, before: tuple[Tensor, Tensor]) -> tuple[Hypotheses, Tensor]:
        """Hypotheses after the measurement: see ``Outliers.update``."""
        missing = 1 - frame.measured
        return self.outliers.update(
            predicted, lambda x, block: self.compare(x, frame, block), self.sensor.reads, missing, before
        )

    def expected(self, predicted: Hypotheses) -> Gaussian:
        """What the sensor reads of all predictions together, ``(..., d)``."""
        seen = predicted._replace(belief=self.read(predicted.belief))
        one = seen.merged(OUTLIER, MOTION, BEFORE, angles=self.motion.angles).belief
        return Gaussian(one.mean[0, 0, 0], one.scale_tril[0, 0, 0])

    def finish(self, state: GPBState, belief: Gaussian, info: Step) -> tuple[Gaussian, GPBInfo]:
        """The one-step smoothed estimate of each step comes with the next."""
        time = info.regimes.dim() - 2
        lagged = tree.one_earlier(info.lagged, state.belief, time, info.regimes.shape[time])
        return lagged if self.lag else belief, GPBInfo(belief, lagged, info.regimes, info.outlier, info.alarm)

    # ------------------------------------------------------------ whether the sensor is faulty

    def faulty(self, state: GPBState) -> Tensor:
        """Probability ``(..., B)`` of each block of the sensor's elements that what it measures is wrong now."""
        any_outlier = state.log_weights[..., 1, :].exp().sum(-1, keepdim=True)
        return self.outliers.now(any_outlier * state.outlier, state.forgotten)

    def alarm(self, before: GPBState, now: GPBState, frame: Frame) -> Alarm:
        """Which blocks are wrong after a step, since when, and by how much."""
        was, wrong = self.faulty(before), self.faulty(now)
        seen = self.sensor.at_points(now.belief.mean[None, ..., : self.sensor.reads], frame.u)[0]
        offset = torch.where(frame.measured > 0, self.sensor.difference(frame.z, seen), 0.0)
        return Alarm(wrong, lasting(before.lasted, was, wrong, frame.dt), offset)

    # ------------------------------------------------------------ what is expected later

    def hypotheses(self, known: GPBState | GPBPast) -> tuple[Gaussian, Tensor]:
        """With and without outliers, each motion ``(..., 2 K, n)``, and logs of their weights."""
        log_weights = self.regimes.log_by_motion(known.log_weights, -1)
        mean, root = known.hypotheses
        return Gaussian(mean.flatten(-3, -2), root.flatten(-4, -3)), log_weights.flatten(-2)

    def predict_hypotheses(self, state: GPBState, frame: Frame) -> tuple[Gaussian, Tensor]:
        """Hypotheses ``(2 R, ..., n)`` of the state after a step, and logs of their weights."""
        before = from_state(state.hypotheses, state.log_weights, (BEFORE, MOTION))
        moves = self.regimes.moves(before.log_weight, frame.dt, torch.ones_like(frame.dt, dtype=torch.bool))
        predicted, _ = self.predict_regimes(self.mix(before.belief, moves)[0], moves.log_weight, frame)
        flat: Hypotheses = tree.map_tensors(lambda x: x.flatten(0, 2), predicted)
        return flat.belief, flat.log_weight - flat.log_weight.logsumexp(0)

    def predict_innovation(self, state: GPBState, beliefs: Gaussian, frame: Frame) -> Gaussian:
        """What is measured, less what hypotheses ``(K, ..., n)`` expect: ``(K, ..., m)`` in units of the noise."""
        return super().predict_innovation(state, self.read(beliefs), frame)

    # ------------------------------------------------------------ the sensor

    def read(self, belief: Gaussian) -> Gaussian:
        """Of states, what the sensor reads."""
        d = self.sensor.reads
        return Gaussian(belief.mean[..., :d], belief.scale_tril[..., :d, :d])

    def compare(self, belief: Gaussian, frame: Frame, elements: Sequence[int] | None = None) -> Whitened:
        """The measurement, or some elements of it, against a predicted belief; by the slope where points show none.

        From points on all sides of an anchor ranges do not tell where the target is: a belief that wide would learn
        nothing, and widen on.
        """
        elements = range(self.sensor.size) if elements is None else elements
        if self.sensor.linear:
            return of_elements(exactly(self.sensor, belief, frame), elements)
        compare = super().compare
        return by_points_or_slope(lambda x: of_elements(compare(x, frame), elements), belief)

    def _batch(self, measurements: Measurements, prior: Gaussian, name: str = "prior") -> torch.Size:
        """The batch of all that was handed in, checked."""
        batch = super()._batch(measurements, prior, name)
        self.outliers.check_noise("noise", measurements.noise)
        return batch

    def parts_for(self, sensor: Sensor) -> dict[str, nn.Module]:
        """Its parts, by name, that are others around another sensor."""
        outliers = sharing(self.outliers, Outliers, blocks=tuple(map(tuple, sensor.blocks)))
        outliers.check(sensor)
        return super().parts_for(sensor) | {"outliers": outliers}

    def unremembered(self, state: GPBState) -> GPBState:
        """A state whose last measurement says nothing of outliers in the next."""
        outlier = state.belief.mean.new_zeros((*state.belief.mean.shape[:-1], len(self.outliers.blocks)))
        return self.remembering(state, state._replace(outlier=outlier))

    def remembering(self, state: GPBState, before: GPBState) -> GPBState:
        """A state without outliers before it: another sensor, of one ``before``, had the last measurement."""
        forgotten = None if state.forgotten is None else torch.ones_like(state.forgotten)
        none = torch.zeros_like(before.outlier)
        return state._replace(outlier=none, lasted=none, forgotten=forgotten)

    # ------------------------------------------------------------ smoothing

    def check_smooths_several(self) -> None:
        """Raises a ``NotImplementedError``: there is no smoother over several sensors."""
        raise NotImplementedError(
            f"{type(self).__name__}: hypotheses of outliers are of one sensor in the backward pass; smooth several "
            "with presets.srckf or fra, or a bank of motions around them"
        )

    def past(self, belief: Gaussian, info: Any, state: Any, steps: GPBPast) -> GPBPast:
        """The hypotheses after each step."""
        return steps

    def fresh(self, past: GPBPast) -> GPBPast:
        """The same: nothing is decided later."""
        return past

    decided = fresh

    def needed_of_next(self, past: GPBPast) -> GPBPast:
        """The NIS of the step after, and whether anything was measured in it."""
        return GPBPast(None, None, None, past.nis, past.measured)  # type: ignore[arg-type]  # nothing reads the others

    def last(self, past: GPBPast) -> tuple[GPBPast, Smoothed]:
        """Where the backward pass begins: the last step, as it was filtered."""
        return past, smoothing.smoothed(self, past)

    def retreat(self, step: BackwardStep, after: GPBPast) -> tuple[GPBPast, Smoothed]:
        """One step back, of all hypotheses."""
        if after.outlier.dim() > step.past.outlier.dim():
            several: tuple[GPBPast, Smoothed] = tree.stack(
                [self.retreat(step, x) for x in tree.unbind(after, len(after.outlier))], 0
            )
            return several
        before = smoothing.retreat(self, step, after)
        return before, smoothing.smoothed(self, before)
