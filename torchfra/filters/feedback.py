"""FRA: a robust and an adaptive branch where a step is abnormal, and the next measurement decides between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import Module

from torchfra.adaptive import Fading, Memory
from torchfra.cubature import Rule, third_degree
from torchfra.filters.base import Filter, Record
from torchfra.filters.frames import Frame
from torchfra.filters.select import select, where_needed
from torchfra.filters.srckf import compare, correct, innovation, predict, trust
from torchfra.hyper import Hyper, Value
from torchfra.linalg import is_traced
from torchfra.motion import Motion
from torchfra.sensors import Sensor
from torchfra.types import Gaussian, Prediction, Whitened


class FRAState(NamedTuple):
    """What FRA knows after a step."""

    belief: Gaussian
    """Provisional estimate of this step: the robust branch where it was abnormal."""
    adaptive: Gaussian
    """The other branch; equal to ``belief`` where the step was normal."""
    plain: Gaussian
    """The estimate with neither remedy."""
    settled: Gaussian
    """Final estimate of the step before, now that its branches have met a measurement."""
    abnormal: Tensor
    """``(...)`` bool: this step waits for the next measurement."""
    memory: Memory


class FRAInfo(NamedTuple):
    """Per step and track."""

    abnormal: Tensor
    """``(..., T)`` bool: the innovation failed the gate and the filter forked."""
    adaptive: Tensor
    """``(..., T)`` bool: the adaptive branch was kept."""
    fading: Tensor
    """``(..., T)`` fading factor of the adaptive branch, 1 at normal steps."""
    weights: Tensor
    """``(..., T, m)`` Huber weights of the robust branch, 1 at normal steps."""
    provisional: Gaussian
    """``mean (..., T, n)`` and ``scale_tril``: what was known at the step itself."""


class FRA(Filter):
    """Feedback-decision robust adaptive filter.

    A step whose normalised innovation squared is above the gate is abnormal, be it an outlier or a manoeuvre.  There
    the filter forks: one branch trusts the measurement less (robust), one the prediction less (adaptive).  Both predict
    the next measurement, and the better branch is kept.  So the estimate of an abnormal step is final only with the
    next measurement: ``Estimate.mean`` holds the final ones and ``info.provisional`` what was known at each step;
    ``step`` hands out the provisional one as ``state.belief`` and the final one of the step before as
    ``state.settled``.

    Args:
        motion: how targets move.
        sensor: what is measured.
        robust: weights of the robust branch (``torchfra.robust``).
        adaptive: fading factors of the adaptive branch (``torchfra.adaptive``).
        rule: see ``SRCKF``.
        gate: normalised innovation squared above which a step is abnormal.
        decision: how the branches' predictions are compared: ``"normalised"`` by the normalised innovation (the
            paper's; it favours the branch that expects more error), ``"likelihood"`` by the predictive likelihood.
        memory: innovations that fading remembers: ``"plain"`` as they are (the paper's), ``"weighted"`` by the robust
            weights from the step after on.
        final: the branch of an abnormal last step, which nothing can decide: ``"robust"``, ``"adaptive"``, ``"plain"``.

    Raises:
        ValueError: an argument that is none of those.

    Source: Wang et al. (2021), section 2.2 and fig. 1.
    """

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        robust: Module,
        adaptive: Fading,
        rule: Callable[[int], Rule] = third_degree,
        gate: Value = 5.991,
        decision: str = "normalised",
        memory: str = "plain",
        final: str = "robust",
    ) -> None:
        super().__init__(motion, sensor)
        for name, value, known in (
            ("decision", decision, ("normalised", "likelihood")),
            ("memory", memory, ("plain", "weighted")),
            ("final", final, ("robust", "adaptive", "plain")),
        ):
            if value not in known:
                raise ValueError(f"{name}: expected one of {known}, received {value!r}")
        whole = rule(motion.size)
        self.motion_rule, self.sensor_rule = whole, whole.marginal(sensor.reads)
        self.robust, self.adaptive = robust, adaptive
        self.gate = Hyper(gate, name="gate")
        self.decision, self.memory, self.final = decision, memory, final
        self._decisive = [h for part in (robust, adaptive, self.gate) for h in part.modules() if isinstance(h, Hyper)]

    def begin(self, belief: Gaussian) -> FRAState:
        """See ``Filter``."""
        normal = torch.zeros(belief.mean.shape[:-1], dtype=torch.bool, device=belief.mean.device)
        return FRAState(belief, belief, belief, belief, normal, self.adaptive.begin(belief.mean, self.sensor.size))

    def advance(self, state: FRAState, frame: Frame) -> tuple[FRAState, Record]:
        """See ``Filter``."""
        chosen = self._where(state.abnormal, self.prefer, (state.belief, state.adaptive, frame), state.abnormal)
        settled = select(chosen, state.adaptive, state.belief)
        prediction, whitened = self.look(settled, frame)
        plain, root, normalised = correct(prediction.belief, whitened)
        residual, nis = whitened.residual, normalised.square().sum(-1)  # eq. (35)
        abnormal = nis > self.gate().to(nis)  # eq. (36)
        weights = self.robust(residual, nis)
        memory = self.adaptive.remember(state.memory, residual, frame.seen)
        robust, adaptive, factor = self._where(
            abnormal, self.fork, (prediction, whitened, weights, memory, frame), (plain, plain, torch.ones_like(nis))
        )
        if self.memory == "weighted":
            memory = self.adaptive.remember(state.memory, weights * residual, frame.seen)
        weights = select(abnormal, weights, torch.ones_like(weights))
        info = _Step(settled, chosen, abnormal, factor, weights)
        state = FRAState(robust, adaptive, plain, settled, abnormal, memory)
        return state, Record(robust, residual, root, normalised, info)

    def look(self, belief: Gaussian, frame: Frame) -> tuple[Prediction, Whitened]:
        """The prediction of a step, and the measurement against it."""
        prediction = predict(self.motion, self.motion_rule, belief, frame)
        return prediction, compare(self.sensor, self.sensor_rule, prediction.belief, frame)

    def prefer(self, robust: Gaussian, adaptive: Gaussian, frame: Frame) -> Tensor:
        """``(...)`` bool: the adaptive branch predicts this measurement better; a tie goes to the robust one."""
        both = Gaussian(*(torch.stack(torch.broadcast_tensors(*pair)) for pair in zip(robust, adaptive, strict=True)))
        _, whitened = self.look(both, frame)
        root, normalised = innovation(whitened)
        score = -normalised.square().sum(-1)
        if self.decision == "likelihood":
            score = 0.5 * score - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return (score[1] > score[0]) | ~score[0].isfinite()

    def fork(
        self, prediction: Prediction, whitened: Whitened, weights: Tensor, memory: Memory, frame: Frame
    ) -> tuple[Gaussian, Gaussian, Tensor]:
        """Both branches' beliefs, and the fading factor ``(...)``."""
        robust, _, _ = correct(prediction.belief, trust(whitened, weights))  # eqs. (25)-(26)
        factor = self.adaptive(prediction, whitened, memory, torch.ones_like(weights))
        faded = self.adaptive.inflate(prediction, factor).belief  # eqs. (29)-(34)
        adaptive, _, _ = correct(faded, compare(self.sensor, self.sensor_rule, faded, frame))
        return robust, adaptive, factor

    def finish(self, state: FRAState, records: list[Record]) -> tuple[list[Gaussian], list[FRAInfo]]:
        """See ``Filter``: each step's estimate is settled in the next, the last by ``final``."""
        last = {"robust": state.belief, "adaptive": state.adaptive, "plain": state.plain}[self.final]
        kept = state.abnormal & torch.full_like(state.abnormal, self.final == "adaptive")
        steps: list[_Step] = [r.info for r in records]
        beliefs = [s.settled for s in steps[1:]] + [select(state.abnormal, last, state.plain)]
        chosen = [s.chosen for s in steps[1:]] + [kept]
        info = [FRAInfo(s.abnormal, c, s.fading, s.weights, r.belief)
                for s, c, r in zip(steps, chosen, records, strict=True)]  # fmt: skip
        return beliefs, info

    def _where(self, mask: Tensor, function: Callable[..., Any], arguments: tuple[Any, ...], default: Any) -> Any:
        """``function`` for the tracks in ``mask``: alone if that can be told now, else for all and then chosen."""
        batched = any(h.raw.dim() for h in self._decisive)
        if batched or is_traced(mask):
            return select(mask, function(*arguments), default)
        return where_needed(mask, function, arguments, default)


class _Step(NamedTuple):
    """What one step knows: about itself, and now for good about the one before."""

    settled: Gaussian
    chosen: Tensor
    abnormal: Tensor
    fading: Tensor
    weights: Tensor
