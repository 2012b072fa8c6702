"""Several targets and scans with false measurements: joint probabilistic data association around a filter."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

from torchfra import register
from torchfra.association.clutter import Clutter
from torchfra.association.gates import ChiSquare, Euclidean, Gate
from torchfra.filters.base import Filter
from torchfra.filters.scans.jpda import JPDA
from torchfra.hyper import Value
from torchfra.motion.base import Motion
from torchfra.presets.learning import with_learning
from torchfra.presets.single import iaukf, srckf, ukf
from torchfra.presets.values import with_values
from torchfra.sensors.base import Sensor

__all__ = ["iaukf_jpda", "jpda", "ukf_jpda"]


@register.filter("jpda", words="joint probabilistic data association", scans=True, listed=False)
def jpda(
    motion: Motion | Sequence[Motion], sensor: Sensor, *, clutter: Clutter,
    inner: Callable[[Any, Sensor], Filter] = srckf, gate: Gate | None = None, detection: Value = 0.95,
    lost: float = 0.0, share_noise: bool = False,
    exact: tuple[int, int] = (4, 10), temperature: float = 0.0, learn: Collection[str] = (),
) -> JPDA:  # fmt: skip
    """Joint probabilistic data association.  Source: Fortmann, Bar-Shalom & Scheffe (1983).

    Args:
        motion: how targets move; several where the inner filter takes them.
        sensor: what is measured.
        clutter: density of false measurements: ``association.Clutter``.
        inner: the filter of each target, ``(motion, sensor) -> Filter``: a preset (one of ``srckf``'s kind, ``gpb``, or
            an interacting one), or a ``functools.partial`` of one.
        gate: measurements that may be a target's; ``ChiSquare(0.999)`` if None: ``torchfra.association``.
        detection: probability that a target is measured: ``filters.JPDA``.
        lost: probability of so many misses in a row below which a track is lost; 0 for never: ``filters.JPDA``.
        share_noise: whether targets share their estimates of the measurement noise: ``filters.JPDA``.
        exact: targets and measurements of a cluster up to which association is exact: ``filters.JPDA``.
        temperature: 0 for gates with a hard edge, above for a soft one, to train by: ``filters.JPDA``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
    """
    f = JPDA(
        inner(motion, sensor), gate=ChiSquare() if gate is None else gate, clutter=clutter, detection=detection,
        lost=lost, share_noise=share_noise, exact=exact, temperature=temperature,
    )  # fmt: skip
    return with_learning(f, learn)


@register.filter("ukf_jpda", words="ukf with data association", scans=True)
def ukf_jpda(
    motion: Motion, sensor: Sensor, *, clutter: Clutter, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0,
    gate: Gate | None = None, detection: Value = 0.95, lost: float = 0.0,
    exact: tuple[int, int] = (4, 10), temperature: float = 0.0, learn: Collection[str] = (),
) -> JPDA:  # fmt: skip
    """``jpda`` with the unscented filter of ``iaukf`` under constant measurement noise.

    ``gate=Euclidean(100.0, probability=0.9999), lost=1e-3`` are the safeguards of ``iaukf_jpda``.

    Args:
        motion: how targets move.
        sensor: what is measured.
        clutter: density of false measurements: ``association.Clutter``.
        alpha: spread of the points: ``cubature.unscented``.
        beta: added to the centre's weight in the covariance: ``cubature.unscented``.
        kappa: moves points from the centre outwards: ``cubature.unscented``.
        gate: measurements that may be a target's; ``Euclidean(100.0)``, in m, if None: ``torchfra.association``.
        detection: probability that a target is measured: ``filters.JPDA``.
        lost: probability of so many misses in a row below which a track is lost; 0 for never: ``filters.JPDA``.
        exact: targets and measurements of a cluster up to which association is exact: ``filters.JPDA``.
        temperature: 0 for gates with a hard edge, above for a soft one, to train by: ``filters.JPDA``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Source: the filter with which Chen, Zou & Wu compare theirs.
    """
    return jpda(
        motion, sensor, clutter=clutter, inner=partial(ukf, alpha=alpha, beta=beta, kappa=kappa),
        gate=Euclidean(100.0) if gate is None else gate, detection=detection, lost=lost,
        exact=exact, temperature=temperature, learn=learn,
    )  # fmt: skip


@register.filter("iaukf_jpda", words="iaukf with data association", scans=True)
@with_values
def iaukf_jpda(
    motion: Motion, sensor: Sensor, *, clutter: Clutter, forgetting: Value = 0.96,
    confidence: Value | Sequence[float] = 0.5, confidence_in: str = "nominal", lowest: float = 0.25,
    highest: float = 1e4, warmup: int = 5, adapt: str = "innovation", gate: Gate | None = None,
    detection: Value = 0.95, lost: float = 1e-3, share_noise: bool = False, exact: tuple[int, int] = (4, 10),
    temperature: float = 0.0, values: str | None = None, learn: Collection[str] = (),
) -> JPDA:  # fmt: skip
    """``jpda`` with ``iaukf`` for each target.

    Args:
        motion: how targets move.
        sensor: what is measured.
        clutter: density of false measurements: ``association.Clutter``.
        forgetting: memory of the innovations, in [0, 1]: see ``iaukf``, as for all arguments up to ``adapt``.
        confidence: in [0, 1], one for each block of the sensor or one for all.
        confidence_in: ``"nominal"`` or ``"measured"`` measurement noise.
        lowest: share of the nominal variance below which the estimate does not fall.
        highest: multiple of the nominal variance above which the estimate does not rise.
        warmup: first innovations, which change nothing.
        adapt: by the ``"innovation"``, before the update, or the ``"residual"``, after it.
        gate: measurements that may be a target's; ``Euclidean(100.0, probability=0.9999)``, in m, if None.
        detection: probability that a target is measured: ``filters.JPDA``.
        lost: probability of so many misses in a row below which a track is lost; 0 for never: ``filters.JPDA``.
        share_noise: whether targets share their estimates of the measurement noise: ``filters.JPDA``.
        exact: targets and measurements of a cluster up to which association is exact: ``filters.JPDA``.
        temperature: 0 for gates with a hard edge, above for a soft one, to train by: ``filters.JPDA``.
        values: name of a set of learned values for what is not given: ``torchfra.values()``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Source: Chen, Zou & Wu.  Differs: the gate is never smaller than the uncertainty of the prediction requires, and the
    covariance of a track that misses many scans in a row grows.  ``gate=Euclidean(100.0), lost=0.0`` is the paper's:
    then 1 to 5 % of the runs lose a track for good, if the initial state is off by more than the gate or a false
    measurement takes the place of a missed target.
    """
    inner = partial(iaukf, forgetting=forgetting, confidence=confidence, confidence_in=confidence_in, lowest=lowest,
                    highest=highest, warmup=warmup, adapt=adapt)  # fmt: skip
    return jpda(
        motion, sensor, clutter=clutter, inner=inner,
        gate=Euclidean(100.0, probability=0.9999) if gate is None else gate,
        detection=detection, lost=lost, share_noise=share_noise, exact=exact, temperature=temperature, learn=learn,
    )  # fmt: skip
