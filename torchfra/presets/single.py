"""Filters of one motion, arguments to ``SRCKF``: plain filters by several rules, robust ones and adaptive ones."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Sequence
from typing import TypeVar

from torchfra import register
from torchfra.adaptive.fading import Fading
from torchfra.adaptive.noise import SageHusa
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.cubature import fifth_degree, first_order, unscented
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value
from torchfra.motion.base import Motion
from torchfra.presets.learning import with_learning
from torchfra.presets.values import with_values
from torchfra.robust.base import Robust
from torchfra.robust.regression import HuberRegression
from torchfra.robust.score import HuberScore
from torchfra.robust.weights import Huber, ThreeSegment
from torchfra.sensors.base import Sensor

__all__ = [
    "asrckf",
    "ekf",
    "ghckf",
    "hghckf",
    "hghckf1",
    "hghckf2",
    "iaukf",
    "mr_ckf",
    "rmckf",
    "rsrckf",
    "srckf",
    "ukf",
]

States = slice | Sequence[slice] | None
"""State components that fade: one group, or several; None for the default of ``Fading``."""
Share = Value | Sequence[float] | None
"""Share of the fading factor of each group; None for 1."""
R = TypeVar("R", bound=Robust)


def robust_update(
    sensor: Sensor, robust: R | None, threshold: Value | None, per_element: bool, learn: Collection[str]
) -> R | Huber:
    """The robust update of the argument (a copy, if anything learns), or Huber weights with a threshold.

    Raises:
        ValueError: a robust update together with options of Huber weights.
    """
    if robust is None:
        return Huber(1.345 if threshold is None else threshold, elements=sensor.size if per_element else None)
    if threshold is not None or per_element:
        raise ValueError("robust, threshold, per_element: expected robust or options of Huber weights, received both")
    return copy.deepcopy(robust) if learn else robust


@register.filter("ukf", words="unscented Kalman filter")
def ukf(
    motion: Motion, sensor: Sensor, *, alpha: float = 1.0, beta: float = 0.0, kappa: float = 1.0,
    learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Unscented Kalman filter.  Source: Julier & Uhlmann (2004).

    Args:
        motion: how targets move.
        sensor: what is measured.
        alpha: spread of the points: ``cubature.unscented``.
        beta: added to the centre's weight in the covariance: ``cubature.unscented``.
        kappa: moves points from the centre outwards: ``cubature.unscented``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    return with_learning(SRCKF(motion, sensor, rule=unscented(alpha, beta, kappa)), learn)


@register.filter("ekf", words="extended Kalman filter")
def ekf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = ()) -> SRCKF:
    """Extended Kalman filter.  Source: Jazwinski (1970), ch. 8.

    Args:
        motion: how targets move.
        sensor: what is measured.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    return with_learning(SRCKF(motion, sensor, rule=first_order), learn)


@register.filter("srckf", words="square-root cubature Kalman filter")
def srckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = ()) -> SRCKF:
    """Square-root cubature Kalman filter.  Source: Arasaratnam & Haykin (2009).

    Args:
        motion: how targets move.
        sensor: what is measured.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Example:
        >>> motion, sensor = torchfra.motion.ConstantVelocity(q=1.0, dims=1), torchfra.sensors.Position(std=1.0, dims=1)
        >>> prior = torchfra.Gaussian(torch.zeros(2).double(), torch.eye(2).double())
        >>> torchfra.presets.srckf(motion, sensor)(torch.tensor([[1.0], [2.0]], dtype=torch.float64), prior).mean
        tensor([[0.6923, 0.4615],
                [1.7972, 0.9217]], dtype=torch.float64)
    """
    return with_learning(SRCKF(motion, sensor), learn)


@register.filter("rsrckf", words="srckf with Huber weights")
def rsrckf(
    motion: Motion, sensor: Sensor, *, threshold: Value | None = None, per_element: bool = False,
    robust: Robust | None = None, learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Robust square-root cubature Kalman filter: Huber weights at every step.

    Args:
        motion: how targets move.
        sensor: what is measured.
        threshold: in standard deviations of the measurement noise, 1.345 if None: ``robust.Huber``.
        per_element: whether each element of a measurement has its own threshold.
        robust: another robust update instead of Huber weights: ``torchfra.robust``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Raises:
        ValueError: ``robust`` together with ``threshold`` or ``per_element``.

    Source: Wang et al. (2021), eqs. (25)-(26).
    """
    update = robust_update(sensor, robust, threshold, per_element, learn)
    return with_learning(SRCKF(motion, sensor, robust=update), learn)


@register.filter("mr_ckf", words="srckf with weights in three segments")
def mr_ckf(
    motion: Motion, sensor: Sensor, *, low: Value = 5.991, high: Value = 10000.0, learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Robust: one weight in three segments for the whole measurement, at every step.

    Args:
        motion: how targets move.
        sensor: what is measured.
        low: normalised innovation squared up to which the weight is 1: ``robust.ThreeSegment``.
        high: normalised innovation squared from which on the weight is 0: ``robust.ThreeSegment``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Source: Wu et al. (2015), in the reading of ``robust.ThreeSegment``.
    """
    return with_learning(SRCKF(motion, sensor, robust=ThreeSegment(low, high)), learn)


@register.filter("ghckf", words="fifth-degree cubature Kalman filter")
def ghckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = ()) -> SRCKF:
    """Fifth-degree cubature Kalman filter.  Source: Zhang (2014); Qin et al. (2018), eqs. (48)-(52).

    Args:
        motion: how targets move.
        sensor: what is measured.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    return with_learning(SRCKF(motion, sensor, rule=fifth_degree), learn)


@register.filter("hghckf1", words="ghckf, robust by Huber regression")
def hghckf1(
    motion: Motion, sensor: Sensor, *, rule: Callable[[int], Rule] = fifth_degree, threshold: Value = 1.345,
    max_iter: int = 10, tol: float = 1e-6, first_iterate: str = "posterior", compensate: bool = False,
    learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Robust by an iterated Huber regression on measurement and prediction.

    Args:
        motion: how targets move.
        sensor: what is measured.
        rule: from a dimension to the points: ``torchfra.gaussian.cubature``.
        threshold: of the weights, in standard deviations: ``robust.HuberRegression``.
        max_iter: iterations at most.
        tol: relative change at which a track has converged.
        first_iterate: ``"posterior"`` of the plain update, or ``"prior"``.
        compensate: whether the error of the linearisation is added to the measurement noise.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Source: Zhang et al. (2016), with which Qin et al. (2018) compare their filter.
    """
    robust = HuberRegression(threshold, max_iter=max_iter, tol=tol, first_iterate=first_iterate, compensate=compensate)
    return with_learning(SRCKF(motion, sensor, rule=rule, robust=robust), learn)


@register.filter("hghckf2", words="ghckf, robust by the innovation")
@with_values
def hghckf2(
    motion: Motion, sensor: Sensor, *, rule: Callable[[int], Rule] = fifth_degree, threshold: Value = 1.345,
    eps: Value | str = "minimax", cov_mode: str = "constant", whitening: str = "cholesky", zeta_scale: bool = False,
    values: str | None = None, learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Robust by the Huber score of the normalised innovation.

    A measurement moves the estimate by no more than ``threshold`` standard deviations of the innovation, but with the
    paper's ``cov_mode="constant"`` the covariance shrinks as after a full update.  So a filter whose estimate is far
    off, after a bad prior or a manoeuvre, keeps a small covariance and may never recover; ``hghckf`` does.

    Args:
        motion: how targets move.
        sensor: what is measured.
        rule: from a dimension to the points: ``torchfra.gaussian.cubature``.
        threshold: in standard deviations of the innovation: ``robust.HuberScore``.
        eps: assumed share of outliers, or ``"minimax"``: ``robust.HuberScore``.
        cov_mode: factor of the covariance, ``"constant"`` or ``"indicator"``: ``robust.HuberScore``.
        whitening: root of the innovation covariance, ``"cholesky"`` or ``"symmetric"``.
        zeta_scale: whether the density behind the score is scaled to variance 1: ``robust.HuberScore``.
        values: name of a set of learned values for what is not given: ``torchfra.values()``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Source: Qin et al. (2018), eqs. (53)-(59).
    """
    robust = HuberScore(threshold, eps=eps, cov_mode=cov_mode, whitening=whitening, zeta_scale=zeta_scale)
    return with_learning(SRCKF(motion, sensor, rule=rule, robust=robust), learn)


@register.filter("hghckf", words="hghckf2 that recovers")
def hghckf(
    motion: Motion, sensor: Sensor, *, rule: Callable[[int], Rule] = fifth_degree, threshold: Value = 1.345,
    eps: Value | str = "minimax", whitening: str = "cholesky", zeta_scale: bool = False, learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """``hghckf2`` with ``cov_mode="indicator"``: prefer it, as it recovers where ``hghckf2`` loses the target.

    Where the score limits an innovation, the covariance does not shrink.  So the covariance of a filter whose estimate
    is far off grows until the filter follows the target again.

    Args:
        motion: how targets move.
        sensor: what is measured.
        rule: from a dimension to the points: ``torchfra.gaussian.cubature``.
        threshold: in standard deviations of the innovation: ``robust.HuberScore``.
        eps: assumed share of outliers, or ``"minimax"``: ``robust.HuberScore``.
        whitening: root of the innovation covariance, ``"cholesky"`` or ``"symmetric"``.
        zeta_scale: whether the density behind the score is scaled to variance 1: ``robust.HuberScore``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Source: Qin et al. (2018), eqs. (53)-(59), with the derivative of the score itself, at the innovation, in place of
    its mean.
    """
    return hghckf2(
        motion, sensor, rule=rule, threshold=threshold, eps=eps, cov_mode="indicator", whitening=whitening,
        zeta_scale=zeta_scale, learn=learn,
    )  # fmt: skip


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
    update = robust_update(sensor, robust, threshold, per_element, learn)
    fading = Fading(weakening, forgetting, fading_max, rcond=rcond, states=states, share=share, trace=trace)
    return with_learning(SRCKF(motion, sensor, robust=update, fading=fading), learn)


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
