"""The feedback-decision robust adaptive filters."""

from __future__ import annotations

from collections.abc import Callable, Collection

from torchfra import register
from torchfra.adaptive.fading import Fading
from torchfra.filters.fra import FRA
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value
from torchfra.motion.base import Motion
from torchfra.presets.learning import with_learning
from torchfra.presets.single import Share, States, robust_update
from torchfra.presets.values import with_values
from torchfra.robust.weights import Weights
from torchfra.sensors.base import Sensor

__all__ = ["fra", "fra_srckf"]


@register.filter("fra_srckf", words="robust or adaptive, as published", gated=True, emphasised=True)
def fra_srckf(
    motion: Motion, sensor: Sensor, *, threshold: Value | None = None, per_element: bool = False,
    robust: Weights | None = None, weakening: Value = 2.0, forgetting: Value = 0.95, fading_max: Value = 1e3,
    rcond: float = 0.1, states: States = None, share: Share = None, trace: str = "full", gate: Value = 5.991,
    preference: Value = 0.0, plain: Value | None = None, patience: float = 0.0, decision: str = "normalised",
    temperature: float = 0.0, memory: str = "plain", provisional: str = "robust", final: str = "robust",
    rule: Callable[[int], Rule] = third_degree, learn: Collection[str] = (),
) -> FRA:  # fmt: skip
    """Robust or adaptive at abnormal steps, as the next measurement decides.  Source: Wang et al. (2021), section 2.2.

    Args:
        motion: how targets move.
        sensor: what is measured.
        threshold: in standard deviations of the measurement noise, 1.345 if None: ``robust.Huber``.
        per_element: whether each element of a measurement has its own threshold.
        robust: other weights instead of Huber's; not together with ``threshold`` or ``per_element``.
        weakening: above 1 the fading factors react less: ``adaptive.Fading``.
        forgetting: memory of the innovations, in [0, 1]: ``adaptive.Fading``.
        fading_max: largest factor; with infinity, the paper's formula, the filter may diverge.
        rcond: smallest singular value that is inverted, as a share of the largest; with 0, the paper's, it may diverge.
        states: components that fade, one slice or several groups; the position if None.
        share: of the factor for each group; if given, the groups are position, velocity, acceleration.
        trace: ``"full"``, or ``"position"`` to compare traces of the faded components only.
        gate: normalised innovation squared above which a step is abnormal: ``filters.FRA``.
        preference: log odds of the robust branch before the next measurement: ``filters.FRA``.
        plain: log odds of a plain branch, None for no such branch: ``filters.FRA``.
        patience: outliers in a row of one offset that are not followed: ``filters.FRA``.
        decision: branches are compared by the ``"normalised"`` innovation or the ``"likelihood"``.
        temperature: 0 for hard decisions, above for soft ones, to train by: ``filters.FRA``.
        memory: innovations count ``"plain"``, or ``"weighted"`` by the robust weights: ``filters.FRA``.
        provisional: branch of an abnormal step until it is decided, ``"robust"`` or ``"likeliest"``: ``filters.FRA``.
        final: branch of an abnormal last step: ``"robust"``, ``"adaptive"``, ``"plain"`` or ``"likeliest"``.
        rule: from a dimension to the points: ``torchfra.gaussian.cubature``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    update = robust_update(sensor, robust, threshold, per_element, learn)
    fading = Fading(weakening, forgetting, fading_max, rcond=rcond, states=states, share=share, trace=trace)
    f = FRA(motion, sensor, robust=update, fading=fading, rule=rule, gate=gate, preference=preference,
            plain=plain, patience=patience, decision=decision, temperature=temperature, memory=memory,
            provisional=provisional, final=final)  # fmt: skip
    return with_learning(f, learn)


@register.filter("fra", words="robust or adaptive, as the next decides", gated=True, emphasised=True)
@with_values
def fra(
    motion: Motion, sensor: Sensor, *, threshold: Value | None = None, per_element: bool = False,
    robust: Weights | None = None, weakening: Value = 2.0, forgetting: Value = 0.95, fading_max: Value = 1e3,
    rcond: float = 0.2, states: States = None, share: Share = None, trace: str = "full", gate: Value = 5.991,
    preference: Value = 0.0, plain: Value | None = None, patience: float = 4.0, decision: str = "likelihood",
    temperature: float = 0.0, memory: str = "weighted", provisional: str = "robust", final: str = "robust",
    rule: Callable[[int], Rule] = third_degree, values: str | None = None, learn: Collection[str] = (),
) -> FRA:  # fmt: skip
    """This package's filter: ``fra_srckf`` with other defaults for ``decision``, ``memory``, ``patience``, ``rcond``.

    Args:
        motion: how targets move.
        sensor: what is measured.
        threshold: in standard deviations of the measurement noise, 1.345 if None: ``robust.Huber``.
        per_element: whether each element of a measurement has its own threshold.
        robust: other weights instead of Huber's; not together with ``threshold`` or ``per_element``.
        weakening: above 1 the fading factors react less: ``adaptive.Fading``.
        forgetting: memory of the innovations, in [0, 1]: ``adaptive.Fading``.
        fading_max: largest factor: ``adaptive.Fading``.
        rcond: smallest singular value that is inverted, as a share of the largest: ``adaptive.Fading``.
        states: components that fade, one slice or several groups; the position if None.
        share: of the factor for each group; if given, the groups are position, velocity, acceleration.
        trace: ``"full"``, or ``"position"`` to compare traces of the faded components only.
        gate: normalised innovation squared above which a step is abnormal: ``filters.FRA``.
        preference: log odds of the robust branch before the next measurement: ``filters.FRA``.
        plain: log odds of a plain branch, None for no such branch: ``filters.FRA``.
        patience: outliers in a row of one offset that are not followed: ``filters.FRA``.
        decision: branches are compared by the predictive ``"likelihood"`` or the ``"normalised"`` innovation.
        temperature: 0 for hard decisions, above for soft ones, to train by: ``filters.FRA``.
        memory: innovations count ``"weighted"`` by the robust weights, or ``"plain"``: ``filters.FRA``.
        provisional: branch of an abnormal step until it is decided, ``"robust"`` or ``"likeliest"``: ``filters.FRA``.
        final: branch of an abnormal last step: ``"robust"``, ``"adaptive"``, ``"plain"`` or ``"likeliest"``.
        rule: from a dimension to the points: ``torchfra.gaussian.cubature``.
        values: name of a set of learned values for what is not given: ``torchfra.values()``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    return fra_srckf(
        motion, sensor, threshold=threshold, per_element=per_element, robust=robust, weakening=weakening,
        forgetting=forgetting, fading_max=fading_max, rcond=rcond, states=states, share=share, trace=trace, gate=gate,
        preference=preference, plain=plain, patience=patience, decision=decision, temperature=temperature,
        memory=memory, provisional=provisional, final=final, rule=rule, learn=learn,
    )  # fmt: skip
