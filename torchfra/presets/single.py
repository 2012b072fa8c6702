"""Filters of one motion, arguments to ``SRCKF``: plain filters by several rules, robust ones and adaptive ones."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeVar

from typing_extensions import Unpack

from torchfra.adaptive.fading import Fading
from torchfra.adaptive.noise import SageHusa
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.cubature import fifth_degree, first_order, unscented
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value
from torchfra.motion.base import Motion
from torchfra.presets.options import (
    FadingOptions,
    HuberOptions,
    NoiseOptions,
    RobustAdaptiveOptions,
    ScoreOptions,
    picked,
)
from torchfra.presets.preset import preset
from torchfra.robust.base import Robust
from torchfra.robust.regression import HuberRegression
from torchfra.robust.score import HuberScore
from torchfra.robust.weights import Huber, ThreeSegment
from torchfra.sensors.base import Sensor

R = TypeVar("R", bound=Robust)


def robust_update(
    sensor: Sensor, *, robust: R | None = None, threshold: Value | None = None, per_element: bool = False
) -> R | Huber:
    """The robust update of the argument, or Huber weights with a threshold.

    Raises:
        ValueError: a robust update together with options of Huber weights.
    """
    if robust is None:
        return Huber(1.345 if threshold is None else threshold, elements=sensor.size if per_element else None)
    if threshold is not None or per_element:
        raise ValueError("robust, threshold, per_element: expected robust or options of Huber weights, received both")
    return robust


def robust_and_fading(sensor: Sensor, options: Mapping[str, Any]) -> dict[str, Any]:
    """The robust update and the fading factors of a preset's options."""
    robust = robust_update(sensor, **picked(options, HuberOptions))
    return {"robust": robust, "fading": Fading(**picked(options, FadingOptions))}


@preset("ukf", words="unscented Kalman filter")
def ukf(
    motion: Motion, sensor: Sensor, *, alpha: float = 1.0, beta: float = 0.0, kappa: float = 1.0,
    redraw: bool = True, learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Unscented Kalman filter, by default with points at ``sqrt(n + 1)``.  Source: Julier & Uhlmann (2004).

    Args:
        alpha: spread of the points: ``cubature.unscented``; textbooks often take 0.001, with ``beta=2, kappa=0``.
        beta: added to the centre's weight in the covariance: ``cubature.unscented``.
        kappa: moves points from the centre outwards: ``cubature.unscented``.
        redraw: whether the measurement has points of its own: ``filters.SRCKF``.
        **options
    """
    return SRCKF(motion, sensor, rule=unscented(alpha, beta, kappa), redraw=redraw)


@preset("ekf", words="extended Kalman filter")
def ekf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = ()) -> SRCKF:
    """Extended Kalman filter.  Source: Jazwinski (1970), ch. 8.

    Args:
        **options
    """
    return SRCKF(motion, sensor, rule=first_order)


@preset("srckf", words="square-root cubature Kalman filter")
def srckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = ()) -> SRCKF:
    """Square-root cubature Kalman filter.  Source: Arasaratnam & Haykin (2009).

    Args:
        **options

    Example:
        >>> motion, sensor = torchfra.motion.ConstantVelocity(q=1.0, dims=1), torchfra.sensors.Position(std=1.0, dims=1)
        >>> prior = torchfra.Gaussian(torch.zeros(2).double(), torch.eye(2).double())
        >>> torchfra.presets.srckf(motion, sensor)(torch.tensor([[1.0], [2.0]], dtype=torch.float64), prior).mean
        tensor([[0.6923, 0.4615],
                [1.7972, 0.9217]], dtype=torch.float64)
    """
    return SRCKF(motion, sensor)


@preset("rsrckf", HuberOptions, words="srckf with Huber weights")
def rsrckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[HuberOptions]) -> SRCKF:
    """Robust square-root cubature Kalman filter: Huber weights at every step.

    Args:
        **options

    Raises:
        ValueError: ``robust`` together with ``threshold`` or ``per_element``.

    Source: Wang et al. (2021), eqs. (25)-(26).
    """
    return SRCKF(motion, sensor, robust=robust_update(sensor, **options))


@preset("mr_ckf", words="srckf with weights in three segments")
def mr_ckf(
    motion: Motion, sensor: Sensor, *, low: Value = 5.991, high: Value = 10000.0, learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Robust: one weight in three segments for the whole measurement, at every step.

    Args:
        low: normalised innovation squared up to which the weight is 1: ``robust.ThreeSegment``.
        high: normalised innovation squared from which on the weight is 0: ``robust.ThreeSegment``.
        **options

    Source: Wu et al. (2015), in the reading of ``robust.ThreeSegment``.
    """
    return SRCKF(motion, sensor, robust=ThreeSegment(low, high))


@preset("ghckf", words="fifth-degree cubature Kalman filter")
def ghckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = ()) -> SRCKF:
    """Fifth-degree cubature Kalman filter.  Source: Zhang (2014); Qin et al. (2018), eqs. (48)-(52).

    Args:
        **options
    """
    return SRCKF(motion, sensor, rule=fifth_degree)


@preset("hghckf1", words="ghckf, robust by Huber regression")
def hghckf1(
    motion: Motion, sensor: Sensor, *, rule: Callable[[int], Rule] = fifth_degree, threshold: Value = 1.345,
    max_iter: int = 10, tol: float = 1e-6, compensate: bool = False,
    learn: Collection[str] = (),
) -> SRCKF:  # fmt: skip
    """Robust by an iterated Huber regression on measurement and prediction.

    Args:
        rule: from a dimension to the points: ``torchfra.gaussian.cubature``.
        threshold: of the weights, in standard deviations: ``robust.HuberRegression``.
        max_iter: iterations at most.
        tol: relative change at which a track has converged.
        compensate: whether the error of the linearisation is added to the measurement noise.
        **options

    Source: Zhang et al. (2016), with which Qin et al. (2018) compare their filter.
    """
    robust = HuberRegression(threshold, max_iter=max_iter, tol=tol, compensate=compensate)
    return SRCKF(motion, sensor, rule=rule, robust=robust)


@preset("hghckf2", ScoreOptions, words="ghckf, robust by the innovation")
def hghckf2(
    motion: Motion, sensor: Sensor, *, cov_mode: str = "constant", values: str | None = None,
    learn: Collection[str] = (), **options: Unpack[ScoreOptions],
) -> SRCKF:  # fmt: skip
    """Robust by the Huber score of the normalised innovation.

    A measurement moves the estimate by no more than ``threshold`` standard deviations of the innovation, but with the
    paper's ``cov_mode="constant"`` the covariance shrinks as after a full update.  So a filter whose estimate is far
    off, after a bad prior or a manoeuvre, keeps a small covariance and may never recover; ``hghckf`` does.

    Args:
        cov_mode: factor of the covariance, ``"constant"`` or ``"indicator"``: ``robust.HuberScore``.
        **options

    Source: Qin et al. (2018), eqs. (53)-(59).
    """
    score: dict[str, Any] = {**options}
    rule = score.pop("rule", fifth_degree)
    return SRCKF(motion, sensor, rule=rule, robust=HuberScore(cov_mode=cov_mode, **score))


@preset("hghckf", ScoreOptions, words="hghckf2 that recovers")
def hghckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[ScoreOptions]) -> SRCKF:
    """``hghckf2`` with ``cov_mode="indicator"``: prefer it, as it recovers where ``hghckf2`` loses the target.

    Where the score limits an innovation, the covariance does not shrink.  So the covariance of a filter whose estimate
    is far off grows until the filter follows the target again.

    Args:
        **options

    Source: Qin et al. (2018), eqs. (53)-(59), with the derivative of the score itself, at the innovation, in place of
    its mean.
    """
    return hghckf2(motion, sensor, cov_mode="indicator", **options)


@preset("asrckf", FadingOptions, words="srckf with fading factors")
def asrckf(motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[FadingOptions]) -> SRCKF:
    """Adaptive: fading factors at every step.  Source: Wang et al. (2021), eqs. (29)-(34).

    Args:
        **options
    """
    return SRCKF(motion, sensor, fading=Fading(**options))


@preset("rmckf", HuberOptions, FadingOptions, words="Huber weights and fading factors")
def rmckf(
    motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[RobustAdaptiveOptions]
) -> SRCKF:
    """Robust and adaptive at every step.  Source: Qiu, Qian & Wang (2018), as Wang et al. (2021) describe it.

    Args:
        **options

    Raises:
        ValueError: ``robust`` together with ``threshold`` or ``per_element``.
    """
    return SRCKF(motion, sensor, **robust_and_fading(sensor, options))


@preset("iaukf", NoiseOptions, words="ukf that estimates the noise")
def iaukf(
    motion: Motion, sensor: Sensor, *, redraw: bool = True, learn: Collection[str] = (),
    **options: Unpack[NoiseOptions],
) -> SRCKF:  # fmt: skip
    """Unscented filter that estimates the variance of the measurement noise, sensor by sensor.

    Args:
        redraw: whether the measurement has points of its own: ``filters.SRCKF``; False is the paper's.
        **options

    Source: Chen, Zou & Wu, eqs. (10)-(24), with ``alpha=1, kappa=0`` and their psi of 2.  Differs: the
    measurement has points of its own, with the process noise in them.
    """
    estimator = SageHusa(sensor.blocks, **options)
    return SRCKF(motion, sensor, rule=unscented(1.0, 2.0, 0.0), noise=estimator, redraw=redraw)
