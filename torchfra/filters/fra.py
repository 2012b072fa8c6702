"""FRA: an abnormal step forks into robust, adaptive and plain branches, and the next measurement chooses one.

Equation numbers are those of Wang et al. (2021).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import logsigmoid

from torchfra import tree
from torchfra.adaptive.fading import Fading, Memory
from torchfra.filters.base import Filter
from torchfra.filters.forecast import Forecast, forecast_by
from torchfra.filters.soft import Soft
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import Frame, batch_rank, value_batches
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import correct, down_weight, down_weighted_density, innovation
from torchfra.hyper import Hyper, Value, once, one_of
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import whiten
from torchfra.motion.base import Motion
from torchfra.numbers import as_number
from torchfra.robust.weights import Huber, Weights
from torchfra.sensors.base import Sensor
from torchfra.steps.checks import check_parts, check_weights
from torchfra.steps.records import Past, Record
from torchfra.steps.recursion import Mix
from torchfra.types import Gaussian, Prediction, Whitened

T = TypeVar("T")  # a tree
Branches = tuple[Gaussian, Gaussian, Gaussian]
"""The robust, the adaptive and the plain branch, in this order everywhere."""
UNDECIDED = ("robust", "adaptive", "plain", "likeliest")
"""Which branch may be the estimate of an abnormal step that no measurement has decided."""
_ROUNDING = 1e-9
"""Relative difference of two scores that are equal up to rounding, in double precision."""
_FAR = 3.2
"""Standard deviations of a normal variable above which an innovation is far off: noise hardly reaches it."""
_GROWTH = 1 / 3
"""Share of an innovation by which the next one is longer, if the target manoeuvres: at constant velocity the second is
longer by all of the first, and the fourth still by a third of the third."""


@tree.event_ranks(excess=0, residual=1, repeated=0)
class FRAState(NamedTuple):
    """State after a step."""

    belief: Gaussian
    """Provisional estimate of this step: of an abnormal one the branch that ``FRA.provisional`` names."""
    robust: Gaussian
    """The robust branch; equal to ``plain`` where the step was normal (except with a soft decision)."""
    adaptive: Gaussian
    """The adaptive branch; equal to ``plain`` where the step was normal (except with a soft decision)."""
    plain: Gaussian
    """The estimate of the plain update."""
    lagged: Gaussian
    """Final estimate of the step before: this measurement has chosen among its branches."""
    excess: Tensor
    """``(...)`` normalised innovation squared less the gate."""
    memory: Memory
    residual: Tensor
    """``(..., m)`` innovation of this step, in units of the noise."""
    repeated: Tensor
    """``(...)`` measurements in a row that were no farther off than an outlier before them."""

    @property
    def abnormal(self) -> Tensor:
        """``(...)`` bool: the next measurement will choose a branch of this step."""
        return self.excess > 0  # eq. (37)

    @property
    def branches(self) -> Branches:
        """The branches of this step."""
        return self.robust, self.adaptive, self.plain


class FRAInfo(NamedTuple):
    """Per step and track."""

    abnormal: Tensor
    """``(..., T)`` bool: the innovation failed the gate and the filter forked."""
    adaptive: Tensor
    """``(..., T)`` bool: the adaptive branch was kept (with a soft decision: had the largest weight)."""
    plain: Tensor
    """``(..., T)`` bool: the plain branch was kept (with a soft decision: had the largest weight)."""
    fading: Tensor
    """``(..., T)`` fading factor of the adaptive branch, 1 at normal steps (except with a soft decision)."""
    weights: Tensor
    """``(..., T, m)`` Huber weights of the robust branch, 1 at normal steps."""
    provisional: Gaussian
    """``mean (..., T, n)`` and ``scale_tril``: the estimate before the next measurement has chosen a branch."""

    @property
    def outlier(self) -> Tensor:
        """``(..., T, 1)`` probability of an outlier: 1 if the robust branch was kept at an abnormal step, else 0."""
        return (self.abnormal & ~self.adaptive & ~self.plain).to(self.fading).unsqueeze(-1)


class Choice(NamedTuple):
    """Which branch of an abnormal step was kept, ``(...)`` bool each; the robust one if neither."""

    adaptive: Tensor
    plain: Tensor


class FRAStep(NamedTuple):
    """The info of one step, and the decision about the step before."""

    before: tree.Late
    """The final estimate of the step before, and its ``Choice``."""
    abnormal: Tensor
    fading: Tensor
    weights: Tensor


class FRA(Soft, Filter[FRAState]):
    """Feedback-decision robust adaptive filter.

    A step whose normalised innovation squared is above the gate is abnormal: its measurement is an outlier, or the
    target manoeuvres.  There the filter forks: the robust branch down-weights the measurement, the adaptive branch
    widens the prediction, and a plain branch may do neither, for false alarms.  All predict the next measurement, and
    the best branch is kept.  So the estimate of an abnormal step is final only with the next step: ``Estimate.mean``
    holds the final estimates and ``info.provisional`` those before the decision; ``step`` returns the provisional one
    as ``state.belief`` and the final one of the step before as ``state.lagged``.  If the next step has no measurement,
    the estimate stays provisional, and the filter carries its branches on until a measurement comes.

    Two outliers in a row look like a manoeuvre, whose branch, with its larger covariance, predicts the second one.  But
    a target that manoeuvres gets farther off from step to step, as its velocity has changed.  So with ``patience`` the
    robust branch is kept where an innovation is farther off than noise brings it (the gate has no part in that) and the
    next one is not longer by a third: until the row is longer than outliers last.  The first row of a track is followed
    at once: a prior may be wrong.

    Hard choices have no gradient with respect to the gate and the scores.  With a ``temperature`` they are soft, for
    training: a step is abnormal with the weight ``sigmoid((nis - gate) / temperature)``, the softmax of the scores over
    the temperature divides that weight among the branches, and the estimate has the moments of all.  Set the
    temperature to 0 when the filter is trained.

    Args:
        motion: how targets move.
        sensor: what is measured.
        robust: weights of the robust branch (``torchfra.robust``); None for Huber's.
        fading: fading factors of the adaptive branch (``torchfra.adaptive``); None for the paper's, bounded.
        rule: from a dimension to the rule that carries a Gaussian through a function.
        gate: normalised innovation squared above which a step is abnormal.
        preference: log odds of the robust branch over the adaptive one before the next measurement; 0 favours neither.
        plain: log odds of a plain branch over the adaptive one; None for no such branch (the paper's).
        patience: largest number of outliers in a row that are not to be followed; with the next one a target that has
            jumped is.  0 for decisions by the next measurement alone (the paper's).
        decision: how the branches' predictions are compared: ``"normalised"`` by the normalised innovation (the
            paper's; it favours the branch with the larger covariance), ``"likelihood"`` by the predictive likelihood.
        temperature: 0 for hard decisions, above for soft ones; an attribute that may be changed at any time.
        memory: innovations in the fading factors' memory: ``"plain"`` as they are (the paper's), ``"weighted"`` by the
            robust weights once their step is over.
        provisional: the branch of an abnormal step before the next measurement: ``"robust"`` (the paper's),
            ``"adaptive"``, ``"plain"``, or ``"likeliest"``, the one of the largest odds.
        final: the branch of an abnormal last step, which no measurement follows: one of those of ``provisional``.

    Raises:
        ValueError: an argument out of its range, or a rule with negative weights.

    Source: Wang et al. (2021), section 2.2 and fig. 1; Chang (2014) for the plain branch.  ``preference``,
    ``patience``, ``provisional``, ``temperature``, ``"likelihood"`` and ``"weighted"`` are additions.
    """

    fading: Fading

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        robust: Weights | None = None,
        fading: Fading | None = None,
        rule: Callable[[int], Rule] = third_degree,
        gate: Value = 5.991,
        preference: Value = 0.0,
        plain: Value | None = None,
        patience: float = 0.0,
        decision: str = "normalised",
        temperature: float = 0.0,
        memory: str = "plain",
        provisional: str = "robust",
        final: str = "robust",
    ) -> None:
        super().__init__(motion, sensor, rule)
        one_of(decision=(decision, ("normalised", "likelihood")), memory=(memory, ("plain", "weighted")))
        one_of(provisional=(provisional, UNDECIDED), final=(final, UNDECIDED))
        check_weights(self)
        if patience != 0 and not 1 <= as_number(patience) < math.inf:
            raise ValueError(f"patience: expected 0, or a finite number of 1 or more, received {patience!r}")
        robust, fading = Huber() if robust is None else robust, Fading() if fading is None else fading
        check_parts(robust=(robust, Weights), fading=(fading, Fading))
        self.robust, self.fading = robust, fading.for_motion(motion)
        self.gate = Hyper(gate, name="gate")
        self.preference = Hyper(preference, constraints.real, name="preference")
        self.plain = None if plain is None else Hyper(plain, constraints.real, name="plain")
        self.decision, self.memory, self.provisional, self.final = decision, memory, provisional, final
        self.temperature, self.patience = temperature, patience

    def begin(self, belief: Gaussian) -> FRAState:
        """The state of a belief: after a normal step, with an empty memory."""
        normal = torch.full_like(belief.mean[..., 0], -torch.inf)
        memory, residual = self.begun(belief.mean, self.sensor)
        repeated = torch.full_like(normal, self.patience)
        return FRAState(belief, belief, belief, belief, belief, normal, memory, residual, repeated)

    def begun(self, mean: Tensor, sensor: Sensor) -> tuple[Memory, Tensor]:
        """The empty memory of a sensor's innovations, and zeros ``(..., m)`` in place of the last, for such means."""
        return self.fading.begin(mean, sensor.size), mean.new_zeros(*mean.shape[:-1], sensor.size)

    def forecast(self, state: FRAState, frame: Frame, *mix: Mix) -> Forecast:
        """The prediction of state and measurement, from the provisional estimate."""
        before = mix[0](state.belief) if mix else state.belief
        return forecast_by(self, self.predicted(before, frame).belief, frame)

    def advance(self, state: FRAState, frame: Frame, mix: Mix | None = None) -> tuple[FRAState, Record]:
        """One step: the step before is decided, then this one is normal or forks."""
        if frame.sensor is self.sensor:
            return self.decide_and_fork(state, frame, mix)
        empty, nothing = self.begun(state.belief.mean, frame.sensor)  # no innovations, and no row of outliers
        after, record = self.decide_and_fork(state._replace(memory=empty, residual=nothing), frame, mix)
        return after._replace(memory=state.memory, residual=torch.zeros_like(state.residual)), record

    def decide_and_fork(self, state: FRAState, frame: Frame, mix: Mix | None) -> tuple[FRAState, Record]:
        """A step by a measurement of the sensor of which the state remembers innovations."""
        lagged, kept, repeated = self.decide_before(state, frame)
        prediction = self.predicted(lagged if mix is None else mix(lagged), frame)
        whitened = self.compare(prediction.belief, frame)
        plain, root, normalised = correct(prediction.belief, whitened)
        nis = normalised.square().sum(-1)  # eq. (35)
        weights = self.robust(whitened.residual, nis)
        excess, memory = nis - self.gate(nis), self.fading.remember(state.memory, whitened.residual, frame.measured)
        abnormal, normal = excess > 0, (plain, plain, torch.ones_like(nis))
        forked = prediction, whitened, weights, memory, frame
        robust, adaptive, factor = self.where_abnormal(abnormal, self.fork, forked, normal)  # eq. (37)
        if self.memory == "weighted":
            memory = self.fading.remember(state.memory, weights * whitened.residual, frame.measured)
        goes_on = self.is_far(excess, frame.sensor.size) | (nis == 0)  # any other measurement ends a row
        repeated = torch.where(goes_on, repeated, 0.0)
        belief = self.undecided(self.provisional, excess, (robust, adaptive, plain))
        state = FRAState(belief, robust, adaptive, plain, lagged, excess, memory, whitened.residual, repeated)
        weights = torch.where(abnormal.unsqueeze(-1), weights, 1.0)
        info = FRAStep(tree.Late((lagged, kept)), abnormal, factor, weights)
        # Only interacting models, which give a ``mix``, weigh their models by this evidence.
        density = None if mix is None else down_weighted_density(*innovation(down_weight(whitened, weights)), weights)
        return state, Record(belief, whitened.residual, root, normalised, info, evidence=density)

    def decide_before(self, state: FRAState, frame: Frame) -> tuple[Gaussian, Choice, Tensor]:
        """The final estimate of the step before, by this measurement, which branch was kept, and ``repeated`` now."""
        if self.soft:
            scores, repeated = self.score(state, frame)
            return *self.choose(scores, state.excess, state.branches), repeated
        abnormal = state.abnormal
        no, none = torch.zeros_like(abnormal), {"belief": None, "lagged": None, "memory": None}
        needed = state._replace(**none)  # type: ignore[arg-type]  # ``score`` reads no others
        kept, repeated = self.where_abnormal(abnormal, self.decide, (needed, frame), (Choice(no, no), state.repeated))
        return chosen(kept, state.branches), kept, repeated

    def decide(self, state: FRAState, frame: Frame) -> tuple[Choice, Tensor]:
        """The branch of the largest score, a tie goes to the robust one; and ``repeated`` with this measurement."""
        scores, repeated = self.score(state, frame)
        return best(scores), repeated

    def score(self, state: FRAState, frame: Frame) -> tuple[Tensor, Tensor]:
        """Scores ``(branches, ...)`` of the branches by this measurement, and ``repeated`` with it.

        A score is minus infinity if the branch has failed, or is not to be followed yet.
        """
        branches = state.branches[: 2 if self.plain is None else 3]
        root, normalised = innovation(self.compare(self.predicted(tree.stack(branches, 0), frame).belief, frame))
        score = -0.5 * normalised.square().sum(-1)
        if self.decision == "likelihood":
            score = score - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        score, repeated = torch.where(score.isfinite(), score, -torch.inf), state.repeated
        if self.patience:
            waits, repeated = self.judge_row(root[0], normalised[0], state, frame.measured)
            followed = torch.where(waits, -torch.inf, score[1:2])
            others = torch.where(waits, torch.minimum(score[2:], score[:1]), score[2:])  # by its odds alone
            score = torch.cat([score[:1], followed, others])
        return score + self.odds(score[0]), repeated

    def judge_row(self, root: Tensor, normalised: Tensor, before: FRAState, measured: Tensor) -> tuple[Tensor, Tensor]:
        """``(...)`` bool, whether a row of outliers is not to be followed yet, and ``repeated`` then.

        Args:
            root: ``(..., m, m)`` of this innovation's covariance in the robust branch.
            normalised: ``(..., m)`` that innovation divided by it.
            before: of the step that is decided.
            measured: ``(..., m)`` 1 for the elements of this measurement that are not missing, else 0.
        """
        first, nis = whiten(root, measured * before.residual), normalised.square().sum(-1)
        change, size = normalised - first, first.square().sum(-1)
        grows = (change * first).sum(-1) > _GROWTH * size
        far = self.is_far(before.excess, measured.shape[-1]) & (nis > 0)
        far = far & (size > 0)  # no size: that step was of another sensor
        repeats = far & ~grows
        another = far & (change.square().sum(-1) > size)  # row begins with this measurement
        repeated = torch.where(another, 0.0, before.repeated + repeats.to(nis))
        return repeats & (repeated < self.patience), repeated

    def is_far(self, excess: Tensor, size: int) -> Tensor:
        """``(...)`` bool, whether a step with a measurement of this ``size`` was far off, and abnormal."""
        part = 2 / (9 * size)
        least = size * (1 - part + _FAR * math.sqrt(part)) ** 3  # chi squared, Wilson and Hilferty (1931)
        far: Tensor = excess > (least - self.gate(excess)).clamp_min(0.0)
        return far

    def odds(self, like: Tensor) -> Tensor:
        """``(branches, ...)`` log odds over the adaptive branch before the next measurement, for tracks ``(...)``."""
        even = torch.zeros_like(like)
        odds = [self.preference(like), even] if self.plain is None else [self.preference(like), even, self.plain(like)]
        return torch.stack(torch.broadcast_tensors(*odds))

    def choose(self, scores: Tensor, excess: Tensor, branches: Branches) -> tuple[Gaussian, Choice]:
        """The estimate by ``scores (branches, ...)``, and the branch of the largest in abnormal steps.

        The estimate is that branch, with a soft decision the moments of all.
        """
        kept = Choice(*((excess > 0) & x for x in best(scores)))
        if not self.soft:
            return chosen(kept, branches), kept
        return moments(scores / self.temperature, excess / self.temperature, branches[-1], branches), kept

    def undecided(self, branch: str, excess: Tensor, branches: Branches) -> Gaussian:
        """The estimate of a step before the next measurement: the named ``branch``, or the likeliest."""
        if branch == "likeliest":
            return self.choose(self.odds(excess), excess, branches)[0]
        named = branches[UNDECIDED.index(branch)]
        if not self.soft:
            return named
        return moments(torch.zeros_like(excess).unsqueeze(0), excess / self.temperature, branches[-1], [named])

    def fork(
        self, prediction: Prediction, whitened: Whitened, weights: Tensor, memory: Memory, frame: Frame
    ) -> tuple[Gaussian, Gaussian, Tensor]:
        """The beliefs of the robust and the adaptive branch, and the fading factor ``(...)``."""
        robust, _, _ = correct(prediction.belief, down_weight(whitened, weights))  # eqs. (25)-(26)
        factor = self.fading(prediction, whitened, memory, torch.ones_like(weights))
        faded = self.fading.inflate(prediction, factor).belief  # eqs. (29)-(34)
        adaptive, _, _ = correct(faded, self.compare(faded, frame))
        return robust, adaptive, factor

    def finish(self, state: FRAState, belief: Gaussian, info: FRAStep) -> tuple[Gaussian, FRAInfo]:
        """The estimates of all steps: each is decided by the next step, that of the last step by ``final``."""
        last = self.undecided(self.final, state.excess, state.branches)
        kept = Choice(*(state.abnormal & x for x in self.favoured(self.final, state.excess)))
        lagged, kept = tree.one_earlier(info.before, (last, kept), state.excess.dim(), info.abnormal.shape[-1])
        return lagged, FRAInfo(info.abnormal, kept.adaptive, kept.plain, info.fading, info.weights, belief)

    def favoured(self, branch: str, like: Tensor) -> Choice:
        """The branch that ``undecided`` takes in abnormal steps of tracks ``(...)``."""
        if branch == "likeliest":
            return best(self.odds(like))
        return Choice(*(torch.full_like(like, branch == name, dtype=torch.bool) for name in Choice._fields))

    def past(self, belief: Gaussian, info: FRAInfo, state: object, steps: object) -> Past:
        """Final and provisional beliefs, each with the fading factor where it is that of the adaptive branch."""
        adaptive = info.abnormal & self.favoured(self.provisional, info.fading[..., 0]).adaptive.unsqueeze(-1)
        factor, early = (torch.where(kept, info.fading, 1.0) for kept in (info.adaptive, adaptive))
        return Past(belief, factor, (info.provisional, early))

    def where_abnormal(self, mask: Tensor, function: Callable[..., T], arguments: tuple[Any, ...], default: T) -> T:
        """``function`` for the tracks in ``mask``, else ``default``.

        Traced code computes it for all tracks.  Unless ``mask`` is empty, so does a filter whose hyperparameters have a
        batch, or whose models are functions of their own: these do not fit a choice of tracks.
        """
        if self.soft:
            return function(*arguments)
        if is_traced(mask):
            return tree.where(mask, function(*arguments), default)
        if not mask.any():
            return default
        sensor = arguments[-1].sensor  # of the frame
        if self.of_one_batch() or (sensor is not self.sensor and batch_rank(sensor)):
            return tree.where(mask, function(*arguments), default)
        return tree.where_needed(mask, function, arguments, default)

    @once
    def of_one_batch(self, like: Tensor | None = None) -> bool:
        """Whether hyperparameters have a batch, or a motion works on those of its models."""
        if not self.motion.linear:
            return bool(self.motion.stacked or value_batches(self))
        # A linear motion has given its matrices for each track.
        return any(not path.startswith("motion.") for path in value_batches(self))


def best(scores: Tensor) -> Choice:
    """The branch of the largest score; of scores that differ by rounding alone the first.

    (With robust weights of 1 and a fading factor of 1 all branches are equal up to rounding.)

    Args:
        scores: ``(branches, ...)`` of robust, adaptive and, if there is one, plain.
    """

    def exceeds(a: Tensor, b: Tensor) -> Tensor:
        """Whether ``a`` is larger than ``b`` by more than rounding; either may be minus infinity."""
        return a > b + _ROUNDING * (1 + torch.minimum(a.abs(), b.abs()))

    robust, adaptive = scores[0], scores[1]
    better = exceeds(adaptive, robust)
    if len(scores) == 2:
        return Choice(better, torch.zeros_like(better))
    plain = exceeds(scores[2], torch.maximum(robust, adaptive))
    return Choice(better & ~plain, plain)


def moments(scores: Tensor, excess: Tensor, plain: Gaussian, branches: Sequence[Gaussian]) -> Gaussian:
    """The moments of a step that is normal, with the ``plain`` estimate, or abnormal, with one of several branches.

    Args:
        scores: ``(branches, ...)``, whose softmax are the shares of the branches of an abnormal step.
        excess: ``(...)``, whose sigmoid is the probability that the step is abnormal.
        plain: for a normal step.
        branches: as many as have scores, or more.
    """
    normal, abnormal = (logsigmoid(sign * excess).unsqueeze(0) for sign in (-1, 1))
    abnormal = abnormal + torch.log_softmax(scores, 0)
    log_weights = torch.cat([normal.expand_as(abnormal[:1]), abnormal])
    return moment_match(tree.stack([plain, *branches[: len(scores)]], 0), log_weights)


def chosen(kept: Choice, branches: Branches) -> Gaussian:
    """The branch that was kept."""
    robust, adaptive, plain = branches
    to_adaptive, to_plain = (x.unsqueeze(-1) for x in kept)
    mean = torch.where(to_adaptive, adaptive.mean, torch.where(to_plain, plain.mean, robust.mean))
    to_adaptive, to_plain = (x.unsqueeze(-1) for x in (to_adaptive, to_plain))
    root = torch.where(to_adaptive, adaptive.scale_tril, torch.where(to_plain, plain.scale_tril, robust.scale_tril))
    return Gaussian(mean, root)
