"""Filters of one motion that adapt: by fading factors, or by an estimate of the measurement noise."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from torchfra import register
from torchfra.adaptive.fading import Fading
from torchfra.adaptive.noise import SageHusa
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.cubature import unscented
from torchfra.hyper import Value
from torchfra.motion.base import Motion
from torchfra.presets.learning import with_learning
from torchfra.presets.single import Share, States, robust_side
from torchfra.robust.base import Robust
from torchfra.sensors.base import Sensor

__all__ = ["asrckf", "iaukf", "rmckf"]


@register.filter("asrckf", words="srckf with fading factors")
def asrckf(
    motion: Motion, sensor: Sensor, *, weakening: Value = 2.0, forgetting: Value = 0.95, fading_max: Value = 1e3,
    rcond: float = 0.1, states: States = None, share: Share = None, trace: str = "full", learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Adaptive: fading factors at every step.  Source: Wang et al. (2021), eqs. (29)-(34).

    Args:
        motion: how targets move.
        sensor: what is measured.
        weakening: above 1 the factors react less: ``adaptive.Fading``.
        forgetting: memory of the innovations, in [0, 1]: ``adaptive.Fading``.
        fading_max: largest factor: ``adaptive.Fading``.
        rcond: smallest singular value that is inverted, as a share of the largest: ``adaptive.Fading``.
        states: components that fade, one slice or several groups; the position if None.
        share: of the factor for each group; if given, the groups are position, velocity, acceleration.
        trace: ``"full"``, or ``"position"`` to compare traces of the faded components only.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    fading = Fading(weakening, forgetting, fading_max, rcond=rcond, states=states, share=share, trace=trace)
    return with_learning(SRCKF(motion, sensor, fading=fading), learn)


@register.filter("rmckf", words="Huber weights and fading factors")
def rmckf(
    motion: Motion, sensor: Sensor, *, threshold: Value | None = None, per_element: bool = False,
    robust: Robust | None = None, weakening: Value = 2.0, forgetting: Value = 0.95, fading_max: Value = 1e3,
    rcond: float = 0.1, states: States = None, share: Share = None, trace: str = "full", learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Robust and adaptive at every step.  Source: Qiu, Qian & Wang (2018), as Wang et al. (2021) describe it.

    Args:
        motion: how targets move.
        sensor: what is measured.
        threshold: in standard deviations of the measurement noise, 1.345 if None: ``robust.Huber``.
        per_element: whether each element of a measurement has its own threshold.
        robust: another robust update instead of Huber weights: ``torchfra.robust``.
        weakening: above 1 the fading factors react less: ``adaptive.Fading``.
        forgetting: memory of the innovations, in [0, 1]: ``adaptive.Fading``.
        fading_max: largest factor: ``adaptive.Fading``.
        rcond: smallest singular value that is inverted, as a share of the largest: ``adaptive.Fading``.
        states: components that fade, one slice or several groups; the position if None.
        share: of the factor for each group; if given, the groups are position, velocity, acceleration.
        trace: ``"full"``, or ``"position"`` to compare traces of the faded components only.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Raises:
        ValueError: ``robust`` together with ``threshold`` or ``per_element``.
    """
    side = robust_side(sensor, robust, threshold, per_element, learn)
    fading = Fading(weakening, forgetting, fading_max, rcond=rcond, states=states, share=share, trace=trace)
    return with_learning(SRCKF(motion, sensor, robust=side, fading=fading), learn)


@register.filter("iaukf", words="ukf that estimates the noise")
def iaukf(
    motion: Motion, sensor: Sensor, *, forgetting: Value = 0.96, confidence: Value | Sequence[float] = 0.5,
    confidence_in: str = "nominal", lowest: float = 0.25, highest: float = 1e4, warmup: int = 5,
    adapt: str = "innovation", learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Unscented filter that estimates the variance of the measurement noise, sensor by sensor.

    Args:
        motion: how targets move.
        sensor: what is measured.
        forgetting: memory of the innovations, in [0, 1]: ``adaptive.SageHusa``.
        confidence: in [0, 1], one for each block of the sensor or one for all: ``adaptive.SageHusa``.
        confidence_in: ``"nominal"`` or ``"measured"`` measurement noise: ``adaptive.SageHusa``.
        lowest: share of the nominal variance below which the estimate does not fall.
        highest: multiple of the nominal variance above which the estimate does not rise.
        warmup: first innovations, which change nothing.
        adapt: by the ``"innovation"``, before the update, or the ``"residual"``, after it.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Source: Chen, Zou & Wu, eqs. (10)-(24), with ``alpha=1, kappa=0`` and their psi of 2.  Differs: the points of the
    measurement are those of the prediction, process noise included (errors 0.1 to 0.9 % smaller).
    """
    estimator = SageHusa(
        sensor.blocks, forgetting=forgetting, confidence=confidence, confidence_in=confidence_in, lowest=lowest,
        highest=highest, warmup=warmup, adapt=adapt,
    )  # fmt: skip
    return with_learning(SRCKF(motion, sensor, rule=unscented(1.0, 2.0, 0.0), noise=estimator), learn)
