"""Several targets and scans with false measurements: joint probabilistic data association around a filter."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

from typing_extensions import Unpack

from torchfra.association.clutter import Clutter
from torchfra.association.gates import ChiSquare, Euclidean
from torchfra.filters.base import Filter
from torchfra.filters.scans.jpda import JPDA
from torchfra.motion.base import Motion
from torchfra.presets.options import NoiseOptions, NoiseScansOptions, ScansOptions, picked
from torchfra.presets.preset import preset
from torchfra.presets.single import iaukf, srckf, ukf
from torchfra.sensors.base import Sensor


@preset("jpda", ScansOptions, words="joint probabilistic data association", scans=True, listed=False)
def jpda(
    motion: Motion | Sequence[Motion], sensor: Sensor, *, clutter: Clutter,
    inner: Callable[[Any, Sensor], Filter] = srckf, learn: Collection[str] = (), **options: Unpack[ScansOptions],
) -> JPDA:  # fmt: skip
    """Joint probabilistic data association.  Source: Fortmann, Bar-Shalom & Scheffe (1983).

    The gate is ``ChiSquare(0.999)`` and ``lost`` is 0 if not given.

    Args:
        motion: how targets move; several where the inner filter takes them.
        sensor: what is measured.
        clutter: density of false measurements: ``association.Clutter``.
        inner: the filter of each target, ``(motion, sensor) -> Filter``: a preset (one of ``srckf``'s kind, ``gpb``, or
            an interacting one), or a ``functools.partial`` of one.
        **options
    """
    scans: dict[str, Any] = {**options}
    scans["gate"] = scans.get("gate") or ChiSquare()
    return JPDA(inner(motion, sensor), clutter=clutter, **scans)


@preset("ukf_jpda", ScansOptions, words="ukf with data association", scans=True)
def ukf_jpda(
    motion: Motion, sensor: Sensor, *, clutter: Clutter, learn: Collection[str] = (), **options: Unpack[ScansOptions]
) -> JPDA:
    """``jpda`` with the unscented filter of ``iaukf`` under constant measurement noise.

    The gate is ``Euclidean(100.0)``, in m, and ``lost`` is 0 if not given.  ``gate=Euclidean(100.0,
    probability=0.9999), lost=1e-3`` are the safeguards of ``iaukf_jpda``.

    Args:
        **options

    Source: the filter with which Chen, Zou & Wu compare theirs.
    """
    options["gate"] = options.get("gate") or Euclidean(100.0)
    return jpda(motion, sensor, clutter=clutter, inner=partial(ukf, alpha=1.0, beta=2.0, kappa=0.0), **options)


@preset("iaukf_jpda", NoiseOptions, ScansOptions, words="iaukf with data association", scans=True)
def iaukf_jpda(
    motion: Motion, sensor: Sensor, *, clutter: Clutter, values: str | None = None, learn: Collection[str] = (),
    **options: Unpack[NoiseScansOptions],
) -> JPDA:  # fmt: skip
    """``jpda`` with ``iaukf`` for each target.

    The gate is ``Euclidean(100.0, probability=0.9999)``, in m, and ``lost`` is 1e-3 if not given.

    Args:
        **options

    Source: Chen, Zou & Wu.  Differs: the gate is never smaller than the uncertainty of the prediction requires, and the
    covariance of a track that misses many scans in a row grows.  ``gate=Euclidean(100.0), lost=0.0`` is the paper's:
    then 1 to 5 % of the runs lose a track for good, if the initial state is off by more than the gate or a false
    measurement takes the place of a missed target.
    """
    scans = {"lost": 1e-3} | picked(options, ScansOptions)
    scans["gate"] = scans.get("gate") or Euclidean(100.0, probability=0.9999)
    inner = partial(iaukf, **picked(options, NoiseOptions))
    return jpda(motion, sensor, clutter=clutter, inner=inner, **scans)
