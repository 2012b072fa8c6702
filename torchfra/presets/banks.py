"""Interacting models: a filter around a bank of motions."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

import torch

from torchfra import register
from torchfra.filters.base import Filter
from torchfra.filters.imm import IMM
from torchfra.filters.likely_models import LikelyModels
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.numbers import as_number, fraction
from torchfra.presets.feedback import fra
from torchfra.presets.learning import with_learning
from torchfra.presets.single import Share, States, srckf
from torchfra.presets.values import with_values
from torchfra.robust.weights import Weights
from torchfra.sensors.base import Sensor

__all__ = ["imm", "imm_ckf", "imm_fra", "imm_srckf", "vsimm_srckf"]

Models = Sequence[Motion] | Bank
Inner = Callable[[Motion, Sensor], Filter]


@register.filter("imm", words="interacting motions", bank=True, listed=False)
def imm(
    models: Models, sensor: Sensor, *, inner: Inner = srckf, self_transition: float = 0.95,
    transition: Value | None = None, durations: Value | None = None, initial: Value | None = None,
    learn: Collection[str] = (),
) -> IMM:  # fmt: skip
    """Interacting multiple models.

    Args:
        models: motions of one state, or a ``Bank`` of them.
        sensor: what is measured.
        inner: the filter of each model, ``(motion, sensor) -> Filter``: a preset, or a ``functools.partial`` of one.
        self_transition: self-transition probability of every model, which switches to the others with equal
            probability.  It learns as one number.
        transition: ``(K, K)`` probabilities instead of ``self_transition``, ``[i, j] = P(now j | was i)``:
            ``filters.IMM``.
        durations: mean sojourn times of the models, s, one number or ``(K,)``, instead of ``self_transition``; then
            probabilities follow from ``dt``, and a ``transition`` is that at the end of a sojourn time:
            ``filters.IMM``.
        initial: ``(K,)`` probabilities of the models before the first step; uniform if None.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.  With ``"transition"`` among them
            the filter has a transition matrix, which starts as that of ``self_transition`` and takes more time.

    Raises:
        ValueError: a single motion, or ``self_transition`` that is no probability between 0 and 1.

    Source: Blom & Bar-Shalom (1988); Du & Zhang (2020) for the square-root cubature form.
    """
    bank = _bank(models)
    uniform = transition is None and len(bank) > 1 and 1 / len(bank) <= as_number(self_transition) < 1
    if durations is not None:
        chain: dict[str, Any] = {"transition": transition, "durations": durations}
    elif uniform:
        chain = {"self_transition": self_transition}
    else:
        chain = {"transition": _transition(len(bank), self_transition, transition)}
    return with_learning(IMM(inner(bank, sensor), **chain, initial=initial), learn)


@register.filter("imm_srckf", words="interacting motions", bank=True)
def imm_srckf(
    models: Models, sensor: Sensor, *, self_transition: float = 0.95, transition: Value | None = None,
    durations: Value | None = None, initial: Value | None = None, learn: Collection[str] = (),
) -> IMM:  # fmt: skip
    """``imm`` with ``srckf`` for each model.  Source: Du & Zhang (2020).

    Args:
        models: motions of one state, or a ``Bank`` of them.
        sensor: what is measured.
        self_transition: probability that a model stays active; it switches to the others with equal probability.
        transition: ``(K, K)`` probabilities instead of ``self_transition``: ``filters.IMM``.
        durations: mean sojourn times of the models, s, instead of ``self_transition``, as of ``imm``.
        initial: ``(K,)`` probabilities of the models before the first step; uniform if None.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    return imm(models, sensor, self_transition=self_transition, transition=transition, durations=durations,
               initial=initial, learn=learn)  # fmt: skip


imm_ckf = register.filter("imm_ckf", words="imm_srckf", bank=True, listed=False)(imm_srckf)
"""``imm_srckf`` under the name of the filter with which Du & Zhang (2020) compare theirs.

Covariances and their roots have the same estimates up to rounding, so they cannot explain the difference in accuracy
that the paper reports.  This filter computes with roots too.
"""


@register.filter("imm_fra", words="interacting motions, each with fra", bank=True, gated=True)
def imm_fra(
    models: Models, sensor: Sensor, *, self_transition: float = 0.99, transition: Value | None = None,
    durations: Value | None = None, initial: Value | None = None, threshold: Value | None = None,
    per_element: bool = False,
    robust: Weights | None = None, weakening: Value = 2.0, forgetting: Value = 0.95, fading_max: Value = 1e3,
    rcond: float = 0.2, states: States = None, share: Share = None, trace: str = "full", gate: Value = 5.991,
    preference: Value = 5.0, plain: Value | None = None, decision: str = "likelihood", temperature: float = 0.0,
    memory: str = "weighted", provisional: str = "robust", final: str = "robust",
    rule: Callable[[int], Rule] = third_degree, learn: Collection[str] = (),
) -> IMM:  # fmt: skip
    """``imm`` with ``fra`` for each model: for manoeuvring targets and sensors with outliers.

    Args:
        models: motions of one state, or a ``Bank`` of them.
        sensor: what is measured.
        self_transition: probability that a model stays active; high, so that one outlier does not change the model.
        transition: ``(K, K)`` probabilities instead of ``self_transition``: ``filters.IMM``.
        durations: mean sojourn times of the models, s, instead of ``self_transition``, as of ``imm``.
        initial: ``(K,)`` probabilities of the models before the first step; uniform if None.
        threshold: see ``fra``, as for all arguments up to ``rule``.
        per_element: whether each element of a measurement has its own threshold.
        robust: other weights instead of Huber's; not together with ``threshold`` or ``per_element``.
        weakening: above 1 the fading factors react less.
        forgetting: memory of the innovations, in [0, 1].
        fading_max: largest factor.
        rcond: smallest singular value that is inverted, as a share of the largest.
        states: components that fade, one slice or several groups; the position if None.
        share: of the factor for each group; if given, the groups are position, velocity, acceleration.
        trace: ``"full"``, or ``"position"`` to compare traces of the faded components only.
        gate: normalised innovation squared above which a step is abnormal.
        preference: log odds of the robust branch; high, as the bank explains manoeuvres, so the rest are outliers.
        plain: log odds of a plain branch, None for no such branch.
        decision: branches are compared by the predictive ``"likelihood"`` or the ``"normalised"`` innovation.
        temperature: 0 for hard decisions, above for soft ones, to train by.
        memory: innovations count ``"weighted"`` by the robust weights, or ``"plain"``.
        provisional: branch of an abnormal step until it is decided, ``"robust"`` or ``"likeliest"``.
        final: branch of an abnormal last step: ``"robust"``, ``"adaptive"``, ``"plain"`` or ``"likeliest"``.
        rule: from a dimension to the points: ``torchfra.gaussian.cubature``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    inner = partial(
        fra, threshold=threshold, per_element=per_element, robust=robust, weakening=weakening, forgetting=forgetting,
        fading_max=fading_max, rcond=rcond, states=states, share=share, trace=trace, gate=gate, preference=preference,
        plain=plain, decision=decision, temperature=temperature, memory=memory, provisional=provisional, final=final,
        rule=rule,
    )  # fmt: skip
    return imm(models, sensor, inner=inner, self_transition=self_transition, transition=transition,
               durations=durations, initial=initial, learn=learn)  # fmt: skip


@register.filter("vsimm_srckf", words="interacting motions, a few at a time", bank=True, neighbours=True)
@with_values
def vsimm_srckf(
    models: Models, sensor: Sensor, *, inner: Inner = srckf, neighbours: Sequence[Sequence[int]] | None = None,
    first: Sequence[int] | None = None, self_transition: float = 0.95, transition: Value | None = None,
    durations: Value | None = None, unlikely: Value = 0.05, principal: Value = 0.5, values: str | None = None,
    learn: Collection[str] = (),
) -> IMM:  # fmt: skip
    """Interacting models of which a few are active at a time, in the paper three of five.  Source: Du & Zhang (2020).

    Args:
        models: motions of one state, or a ``Bank`` of them.
        sensor: what is measured.
        inner: the filter of each model, ``(motion, sensor) -> Filter``: a preset, or a ``functools.partial`` of one.
        neighbours: of each model, those that it may activate, see ``filters.LikelyModels``; the bank's if None.
        first: models that are active first; the bank's if None: ``filters.LikelyModels``.
        self_transition: probability that a model stays active; it switches to the others with equal probability.
        transition: ``(K, K)`` probabilities instead of ``self_transition``: ``filters.IMM``.
        durations: mean sojourn times of the models, s, instead of ``self_transition``, as of ``imm``.
        unlikely: probability below which a model is unlikely: ``filters.LikelyModels``.
        principal: probability above which a model activates its neighbours: ``filters.LikelyModels``.
        values: name of a set of learned values for what is not given: ``torchfra.values()``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Raises:
        ValueError: a single motion, neither ``neighbours`` and ``first`` nor a bank that has them, or
            ``self_transition`` that is no probability between 0 and 1.
    """
    bank = _bank(models)
    neighbours = bank.neighbours if neighbours is None else neighbours
    first = bank.first if first is None else first
    if neighbours is None or first is None:
        raise ValueError("neighbours, first: expected both, or a Bank that has them, received none")
    matrix = _transition(len(bank), self_transition, transition) if durations is None else transition
    subset = LikelyModels(neighbours, first, unlikely=unlikely, principal=principal)
    return with_learning(IMM(inner(bank, sensor), transition=matrix, durations=durations, subset=subset), learn)


def _bank(models: Models) -> Bank:
    if isinstance(models, Motion) and not isinstance(models, Bank):
        raise ValueError(f"models: expected several motions or a Bank, received {type(models).__name__}")
    return models if isinstance(models, Bank) else Bank(models)


def _transition(count: int, self_transition: float, transition: Value | None) -> Value:
    """The matrix ``(count, count)`` of the argument, or one with the same self-transition probability for all."""
    fraction("self_transition", self_transition)
    if transition is not None:
        return transition
    eye = torch.eye(count, dtype=torch.float64)
    return self_transition * eye + (1 - self_transition) / (count - 1) * (1 - eye) if count > 1 else eye
