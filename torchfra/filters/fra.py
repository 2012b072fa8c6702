"""FRA: a robust and an adaptive branch where a step is abnormal, and the next measurement decides between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import logsigmoid

from torchfra.adaptive.fading import Fading, Memory
from torchfra.filters.base import Filter, Mix, Record
from torchfra.filters.soft import Soft
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.model import compare, predict
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.select import select, where_needed
from torchfra.gaussian.update import correct, innovation, trust, trusted_density
from torchfra.hyper import Hyper, Value, hypers, one_of
from torchfra.linalg.tracing import is_traced
from torchfra.motion.base import Motion
from torchfra.robust.weights import Weights
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Prediction, Whitened


class FRAState(NamedTuple):
    """What FRA knows after a step."""

    belief: Gaussian
    """Provisional estimate of this step: the robust branch where it was abnormal."""
    robust: Gaussian
    """That branch; equal to ``plain`` where the step was normal (but for a soft decision)."""
    adaptive: Gaussian
    """The other branch, likewise."""
    plain: Gaussian
    """The estimate with neither remedy."""
    settled: Gaussian
    """Final estimate of the step before, now that its branches have met a measurement."""
    excess: Tensor
    """``(...)`` how far the normalised innovation squared is above the gate."""
    memory: Memory

    @property
    def abnormal(self) -> Tensor:
        """``(...)`` bool: this step waits for the next measurement."""
        return self.excess > 0  # eq. (36)


class FRAInfo(NamedTuple):
    """Per step and track."""

    abnormal: Tensor
    """``(..., T)`` bool: the innovation failed the gate and the filter forked."""
    adaptive: Tensor
    """``(..., T)`` bool: the adaptive branch was kept (with a soft decision: had the larger weight)."""
    fading: Tensor
    """``(..., T)`` fading factor of the adaptive branch, 1 at normal steps (but for a soft decision)."""
    weights: Tensor
    """``(..., T, m)`` Huber weights of the robust branch, 1 at normal steps."""
    provisional: Gaussian
    """``mean (..., T, n)`` and ``scale_tril``: what was known at the step itself."""


class FRA(Soft, Filter):
    """Feedback-decision robust adaptive filter.

    A step whose normalised innovation squared is above the gate is abnormal, be it an outlier or a manoeuvre.  There
    the filter forks: one branch trusts the measurement less (robust), one the prediction less (adaptive).  Both predict
    the next measurement, and the better branch is kept.  So the estimate of an abnormal step is final only with the
    next measurement: ``Estimate.mean`` holds the final ones and ``info.provisional`` what was known at each step;
    ``step`` hands out the provisional one as ``state.belief`` and the final one of the step before as
    ``state.settled``.

    Both choices are hard and pass no gradient to what they rest on.  With a ``temperature`` they are soft, to train by:
    a step is abnormal by the weight ``sigmoid((nis - gate) / temperature)``, the branches share that weight by the
    softmax of their scores over the temperature, and the estimate has the moments of the mixture of plain, robust and
    adaptive.  Towards 0 it becomes the hard decision; ``f.temperature = 0`` makes a trained filter hard.

    Args:
        motion: how targets move.
        sensor: what is measured.
        robust: weights of the robust branch (``torchfra.robust``).
        adaptive: fading factors of the adaptive branch (``torchfra.adaptive``).
        rule: see ``SRCKF``.
        gate: normalised innovation squared above which a step is abnormal.
        preference: log odds of the robust branch before the next measurement has spoken; 0 favours none.
        decision: how the branches' predictions are compared: ``"normalised"`` by the normalised innovation (the
            paper's; it favours the branch that expects more error), ``"likelihood"`` by the predictive likelihood.
        temperature: 0 for hard decisions, above for soft ones; an attribute that may be changed at any time.
        memory: innovations that fading remembers: ``"plain"`` as they are (the paper's), ``"weighted"`` by the robust
            weights from the step after on.
        final: the branch of an abnormal last step, which nothing can decide: ``"robust"``, ``"adaptive"``, ``"plain"``.

    Raises:
        ValueError: an argument that is none of those, or a rule with negative weights.

    Source: Wang et al. (2021), section 2.2 and fig. 1.  ``preference``, ``temperature``, ``"likelihood"`` and
    ``"weighted"`` are ours.
    """

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        robust: Weights,
        adaptive: Fading,
        rule: Callable[[int], Rule] = third_degree,
        gate: Value = 5.991,
        preference: Value = 0.0,
        decision: str = "normalised",
        temperature: float = 0.0,
        memory: str = "plain",
        final: str = "robust",
    ) -> None:
        super().__init__(motion, sensor)
        one_of(
            decision=(decision, ("normalised", "likelihood")),
            memory=(memory, ("plain", "weighted")),
            final=(final, ("robust", "adaptive", "plain")),
        )
        whole = rule(motion.size)
        self.motion_rule, self.sensor_rule = whole, whole.marginal(sensor.reads)
        if self.motion_rule.signed or self.sensor_rule.signed or not isinstance(robust, Weights):
            raise ValueError("rule, robust: expected one without negative weights, and one that weighs measurements")
        self.robust, self.adaptive = robust, adaptive
        self.gate = Hyper(gate, name="gate")
        self.preference = Hyper(preference, constraints.real, name="preference")
        self.decision, self.memory, self.final = decision, memory, final
        self.temperature = temperature
        parts = (robust, adaptive, self.gate, self.preference)
        self._decisive = [hyper for part in parts for hyper in hypers(part).values()]

    def begin(self, belief: Gaussian) -> FRAState:
        """See ``Filter``."""
        normal = torch.full_like(belief.mean[..., 0], -torch.inf)
        memory = self.adaptive.begin(belief.mean, self.sensor.size)
        return FRAState(belief, belief, belief, belief, belief, normal, memory)

    def advance(self, state: FRAState, frame: Frame, mix: Mix | None = None) -> tuple[FRAState, Record]:
        """See ``Filter``."""
        settled, kept = self.settle(state, frame)
        prediction, whitened = self.look(settled if mix is None else mix(settled), frame)
        plain, root, normalised = correct(prediction.belief, whitened)
        residual, nis = whitened.residual, normalised.square().sum(-1)  # eq. (35)
        excess = nis - self.gate(nis)
        weights = self.robust(residual, nis)
        memory = self.adaptive.remember(state.memory, residual, frame.seen)
        robust, adaptive, factor = self._where(
            excess > 0, self.fork, (prediction, whitened, weights, memory, frame), (plain, plain, torch.ones_like(nis))
        )
        belief = self.mix(excess, plain, robust)
        if self.memory == "weighted":
            memory = self.adaptive.remember(state.memory, weights * residual, frame.seen)
        state = FRAState(belief, robust, adaptive, plain, settled, excess, memory)
        weights = select(state.abnormal, weights, torch.ones_like(weights))
        info = _Step(settled, kept, state.abnormal, factor, weights)
        evidence = None if mix is None else trusted_density(*innovation(trust(whitened, weights)), weights)
        return state, Record(belief, residual, root, normalised, info, evidence=evidence)

    def look(self, belief: Gaussian, frame: Frame) -> tuple[Prediction, Whitened]:
        """The prediction of a step, and the measurement against it."""
        prediction = predict(self.motion, self.motion_rule, belief, frame)
        return prediction, compare(self.sensor, self.sensor_rule, prediction.belief, frame)

    def settle(self, state: FRAState, frame: Frame) -> tuple[Gaussian, Tensor]:
        """The step before, decided by this measurement, and ``(...)`` bool: its adaptive branch was kept."""
        if self.soft:
            scores = self.score(state.robust, state.adaptive, frame) / self.heat
            shares = torch.log_softmax(scores, 0)
            settled = self.mix(state.excess, state.plain, state.robust, state.adaptive, shares=shares)
            return settled, state.abnormal & (scores[1] > scores[0])
        kept = self._where(state.abnormal, self.prefer, (state.robust, state.adaptive, frame), state.abnormal)
        return select(kept, state.adaptive, state.belief), kept

    def prefer(self, robust: Gaussian, adaptive: Gaussian, frame: Frame) -> Tensor:
        """``(...)`` bool: the adaptive branch predicts this measurement better; a tie goes to the robust one."""
        scores = self.score(robust, adaptive, frame)
        return scores[1] > scores[0]

    def score(self, robust: Gaussian, adaptive: Gaussian, frame: Frame) -> Tensor:
        """``(2, ...)`` how well each branch predicts this measurement, minus infinity for one that lost its numbers."""
        both = Gaussian(*(torch.stack(torch.broadcast_tensors(*pair)) for pair in zip(robust, adaptive, strict=True)))
        _, whitened = self.look(both, frame)
        root, normalised = innovation(whitened)
        score = -0.5 * normalised.square().sum(-1)
        if self.decision == "likelihood":
            score = score - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        preference = self.preference(score)
        score = torch.stack([score[0] + preference, score[1]])
        return torch.where(score.isfinite(), score, -torch.inf)

    def mix(self, excess: Tensor, plain: Gaussian, *branches: Gaussian, shares: Tensor | None = None) -> Gaussian:
        """Plain and abnormal together: a choice, or their moments where the decision is soft.

        Args:
            excess: ``(...)`` of the normalised innovation squared over the gate.
            plain: for normal steps.
            branches: for abnormal ones; with a hard decision exactly one, equal to ``plain`` where the step is normal.
            shares: ``(branches, ...)`` logs of their weights, if there are several.
        """
        if not self.soft:
            return branches[0]
        normal, abnormal = (logsigmoid(sign * excess / self.heat).unsqueeze(0) for sign in (-1, 1))
        log_weights = torch.cat([normal, abnormal if shares is None else abnormal + shares])
        beliefs = Gaussian(*(torch.stack(parts) for parts in zip(plain, *branches, strict=True)))
        return moment_match(beliefs, log_weights)

    def fork(
        self, prediction: Prediction, whitened: Whitened, weights: Tensor, memory: Memory, frame: Frame
    ) -> tuple[Gaussian, Gaussian, Tensor]:
        """Both branches' beliefs, and the fading factor ``(...)``."""
        robust, _, _ = correct(prediction.belief, trust(whitened, weights))  # eqs. (25)-(26)
        factor = self.adaptive(prediction, whitened, memory, torch.ones_like(weights))
        faded = self.adaptive.inflate(prediction, factor).belief  # eqs. (29)-(34)
        adaptive, _, _ = correct(faded, compare(self.sensor, self.sensor_rule, faded, frame))
        return robust, adaptive, factor

    def finish(self, state: FRAState, belief: Gaussian, info: _Step) -> tuple[Gaussian, FRAInfo]:
        """See ``Filter``: each step's estimate is settled in the next, the last by ``final``."""
        last = {"robust": state.robust, "adaptive": state.adaptive, "plain": state.plain}[self.final]
        last = self.mix(state.excess, state.plain, last)
        kept = state.abnormal & torch.full_like(state.abnormal, self.final == "adaptive")
        rank = kept.dim()

        def late(steps: Tensor, end: Tensor) -> Tensor:
            """Of each step what the next one says of it."""
            return torch.cat([steps.narrow(rank, 1, steps.shape[rank] - 1), end.unsqueeze(rank)], rank)

        settled = Gaussian(*(late(*pair) for pair in zip(info.settled, last, strict=True)))
        return settled, FRAInfo(info.abnormal, late(info.kept, kept), info.fading, info.weights, belief)

    def _where(self, mask: Tensor, function: Callable[..., Any], arguments: tuple[Any, ...], default: Any) -> Any:
        """``function`` for the tracks in ``mask``: alone if that can be told now, else for all and then chosen."""
        if self.soft:
            return function(*arguments)
        batched = any(h.batch_rank for h in self._decisive)
        if batched or is_traced(mask):
            return select(mask, function(*arguments), default)
        return where_needed(mask, function, arguments, default)


class _Step(NamedTuple):
    """What one step knows: about itself, and now for good about the one before."""

    settled: Gaussian
    kept: Tensor
    abnormal: Tensor
    fading: Tensor
    weights: Tensor
