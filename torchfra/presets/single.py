"""Filters of one motion, arguments to ``SRCKF``: plain filters by several rules, robust ones and adaptive ones."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeVar

from typing_extensions import Unpack

from torchfra import register
from torchfra.adaptive.fading import Fading
from torchfra.adaptive.noise import SageHusa
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.cubature import fifth_degree, first_order, unscented
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value
from torchfra.motion.base import Motion
from torchfra.presets.learning import with_learning
from torchfra.presets.options import (
    FadingOptions,
    HuberOptions,
    NoiseOptions,
    RobustAdaptiveOptions,
    ScoreOptions,
    picked,
    with_options,
)
from torchfra.presets.values import with_values
from torchfra.robust.base import Robust
from torchfra.robust.regression import HuberRegression
from torchfra.robust.score import HuberScore
from torchfra.robust.weights import Huber, ThreeSegment
from torchfra.sensors.base import Sensor

R = TypeVar("R", bound=Robust)


def robust_update(
    sensor: Sensor, learn: Collection[str], *, robust: R | None = None, threshold: Value | None = None,
    per_element: bool = False,
) -> R | Huber:  # fmt: skip
    """The robust update of the argument (a copy, if anything learns), or Huber weights with a threshold.

    Raises:
        ValueError: a robust update together with options of Huber weights.
    """
    if robust is None:
        return Huber(1.345 if threshold is None else threshold, elements=sensor.size if per_element else None)
    if threshold is not None or per_element:
        raise ValueError("robust, threshold, per_element: expected robust or options of Huber weights, received both")
    return copy.deepcopy(robust) if learn else robust


def robust_and_fading(sensor: Sensor, learn: Collection[str], options: Mapping[str, Any]) -> tuple[Any, Fading]:
    """The robust update and the fading factors of a preset's options."""
    return robust_update(sensor, learn, **picked(options, HuberOptions)), Fading(**picked(options, FadingOptions))


@register.filter("ukf", words="unscented Kalman filter")
def ukf(
    motion: Motion, sensor: Sensor, *, alpha: float = 1.0, beta: float = 0.0, kappa: float = 1.0,
    redraw: bool = True, learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Unscented Kalman filter, by default with points at ``sqrt(n + 1)``.  Source: Julier & Uhlmann (2004).

    Args:
        motion: how targets move.
        sensor: what is measured.
        alpha: spread of the points: ``cubature.unscented``; textbooks often take 0.001, with ``beta=2, kappa=0``.
        beta: added to the centre's weight in the covariance: ``cubature.unscented``.
        kappa: moves points from the centre outwards: ``cubature.unscented``.
        redraw: whether the measurement has points of its own: ``filters.SRCKF``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    return with_learning(SRCKF(motion, sensor, rule=unscented(alpha, beta, kappa), redraw=redraw), learn)


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
@with_options(HuberOptions)
def rsrckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[HuberOptions]) -> SRCKF:
    """Robust square-root cubature Kalman filter: Huber weights at every step.

    Args:
        motion: how targets move.
        sensor: what is measured.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
        **options

    Raises:
        ValueError: ``robust`` together with ``threshold`` or ``per_element``.

    Source: Wang et al. (2021), eqs. (25)-(26).
    """
    return with_learning(SRCKF(motion, sensor, robust=robust_update(sensor, learn, **options)), learn)


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
@with_options(ScoreOptions)
def hghckf2(
    motion: Motion, sensor: Sensor, *, cov_mode: str = "constant", values: str | None = None,
    learn: Collection[str] = (), **options: Unpack[ScoreOptions],
) -> SRCKF:  # fmt: skip
    """Robust by the Huber score of the normalised innovation.

    A measurement moves the estimate by no more than ``threshold`` standard deviations of the innovation, but with the
    paper's ``cov_mode="constant"`` the covariance shrinks as after a full update.  So a filter whose estimate is far
    off, after a bad prior or a manoeuvre, keeps a small covariance and may never recover; ``hghckf`` does.

    Args:
        motion: how targets move.
        sensor: what is measured.
        cov_mode: factor of the covariance, ``"constant"`` or ``"indicator"``: ``robust.HuberScore``.
        values: name of a set of learned values for what is not given: ``torchfra.values()``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
        **options

    Source: Qin et al. (2018), eqs. (53)-(59).
    """
    score: dict[str, Any] = {**options}
    rule = score.pop("rule", fifth_degree)
    return with_learning(SRCKF(motion, sensor, rule=rule, robust=HuberScore(cov_mode=cov_mode, **score)), learn)


@register.filter("hghckf", words="hghckf2 that recovers")
@with_options(ScoreOptions)
def hghckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[ScoreOptions]) -> SRCKF:
    """``hghckf2`` with ``cov_mode="indicator"``: prefer it, as it recovers where ``hghckf2`` loses the target.

    Where the score limits an innovation, the covariance does not shrink.  So the covariance of a filter whose estimate
    is far off grows until the filter follows the target again.

    Args:
        motion: how targets move.
        sensor: what is measured.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
        **options

    Source: Qin et al. (2018), eqs. (53)-(59), with the derivative of the score itself, at the innovation, in place of
    its mean.
    """
    return hghckf2(motion, sensor, cov_mode="indicator", learn=learn, **options)


@register.filter("asrckf", words="srckf with fading factors")
@with_options(FadingOptions)
def asrckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[FadingOptions]) -> SRCKF:
    """Adaptive: fading factors at every step.  Source: Wang et al. (2021), eqs. (29)-(34).

    Args:
        motion: how targets move.
        sensor: what is measured.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
        **options
    """
    return with_learning(SRCKF(motion, sensor, fading=Fading(**options)), learn)


@register.filter("rmckf", words="Huber weights and fading factors")
@with_options(HuberOptions, FadingOptions)
def rmckf(
    motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[RobustAdaptiveOptions]
) -> SRCKF:
    """Robust and adaptive at every step.  Source: Qiu, Qian & Wang (2018), as Wang et al. (2021) describe it.

    Args:
        motion: how targets move.
        sensor: what is measured.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
        **options

    Raises:
        ValueError: ``robust`` together with ``threshold`` or ``per_element``.
    """
    update, fading = robust_and_fading(sensor, learn, options)
    return with_learning(SRCKF(motion, sensor, robust=update, fading=fading), learn)


@register.filter("iaukf", words="ukf that estimates the noise")
@with_options(NoiseOptions)
def iaukf(
    motion: Motion, sensor: Sensor, *, redraw: bool = True, learn: Collection[str] = (),
    **options: Unpack[NoiseOptions],
) -> SRCKF:  # fmt: skip
    """Unscented filter that estimates the variance of the measurement noise, sensor by sensor.

    Args:
        motion: how targets move.
        sensor: what is measured.
        redraw: whether the measurement has points of its own: ``filters.SRCKF``; False is the paper's.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
        **options

    Source: Chen, Zou & Wu, eqs. (10)-(24), with ``alpha=1, kappa=0`` and their psi of 2.  Differs: the
    measurement has points of its own, with the process noise in them.
    """
    estimator = SageHusa(sensor.blocks, **options)
    return with_learning(SRCKF(motion, sensor, rule=unscented(1.0, 2.0, 0.0), noise=estimator, redraw=redraw), learn)
