"""The filters that papers name, ready made: each is a choice of arguments.

``learn`` names the hyperparameters that gradient descent may change, wherever in the filter they are: ``threshold``,
``low``, ``high``, ``weakening``, ``forgetting``, ``fading_max``, ``gate``, and of the models ``q``, ``std``, ``rate``.
Further keywords go to ``Fading`` (``weakening``, ``forgetting``, ``fading_max``, ``rcond``, ``trace``) or, for the FRA
filters, ``gate``, ``decision``, ``memory``, ``final`` and ``rule`` to ``FRA``.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from torchfra.adaptive import Fading
from torchfra.cubature import tangent, unscented
from torchfra.filters.feedback import FRA
from torchfra.filters.srckf import SRCKF
from torchfra.hyper import Value, learnable
from torchfra.motion import Motion
from torchfra.robust import Huber, ThreeSegment
from torchfra.sensors import Sensor

Names = Collection[str]


def ekf(motion: Motion, sensor: Sensor, *, learn: Names = ()) -> SRCKF:
    """Extended Kalman filter.  Source: Jazwinski (1970), ch. 8."""
    return learnable(SRCKF(motion, sensor, rule=tangent), learn)


def ukf(motion: Motion, sensor: Sensor, *, learn: Names = (), **scaling: float) -> SRCKF:
    """Unscented Kalman filter; ``scaling``: ``alpha=1, beta=0, kappa=1``.  Source: Julier & Uhlmann (2004)."""
    return learnable(SRCKF(motion, sensor, rule=unscented(**scaling)), learn)


def srckf(motion: Motion, sensor: Sensor, *, learn: Names = ()) -> SRCKF:
    """Square-root cubature Kalman filter.  Source: Arasaratnam & Haykin (2009)."""
    return learnable(SRCKF(motion, sensor), learn)


def rsrckf(motion: Motion, sensor: Sensor, *, threshold: Value = 1.345, learn: Names = ()) -> SRCKF:
    """Robust: Huber weights at every step.  Source: Wang et al. (2021), eqs. (25)-(26)."""
    return learnable(SRCKF(motion, sensor, robust=Huber(threshold)), learn)


def mr_ckf(motion: Motion, sensor: Sensor, *, learn: Names = (), **segments: Any) -> SRCKF:
    """Robust: one three-segment weight at every step.  Source: Wu et al. (2015), as read in ``ThreeSegment``."""
    return learnable(SRCKF(motion, sensor, robust=ThreeSegment(**segments)), learn)


def asrckf(motion: Motion, sensor: Sensor, *, learn: Names = (), **fading: Any) -> SRCKF:
    """Adaptive: fading factors at every step.  Source: Wang et al. (2021), eqs. (29)-(34)."""
    return learnable(SRCKF(motion, sensor, adaptive=Fading(states=motion.position, **fading)), learn)


def rmckf(motion: Motion, sensor: Sensor, *, threshold: Value = 1.345, learn: Names = (), **fading: Any) -> SRCKF:
    """Robust and adaptive at every step.  Source: Qiu, Qian & Wang (2018), as Wang et al. (2021) describe it."""
    adaptive = Fading(states=motion.position, **fading)
    return learnable(SRCKF(motion, sensor, robust=Huber(threshold), adaptive=adaptive), learn)


def fra_srckf(motion: Motion, sensor: Sensor, *, threshold: Value = 1.345, learn: Names = (), **options: Any) -> FRA:
    """Robust or adaptive at abnormal steps, as the next measurement decides.  Source: Wang et al. (2021), section 2.2.

    ``rcond=0, fading_max=inf`` are the paper's own formulas, which may diverge; the defaults 0.1 and 1000 do not.
    """
    fading = {
        name: options.pop(name)
        for name in ("weakening", "forgetting", "fading_max", "rcond", "trace")
        if name in options
    }
    adaptive = Fading(states=motion.position, **fading)
    return learnable(FRA(motion, sensor, robust=Huber(threshold), adaptive=adaptive, **options), learn)


def fra(motion: Motion, sensor: Sensor, **options: Any) -> FRA:
    """Ours: ``fra_srckf`` that decides by predictive likelihood, and remembers innovations by their robust weights."""
    ours: dict[str, Any] = {"decision": "likelihood", "memory": "weighted", "rcond": 0.2}
    return fra_srckf(motion, sensor, **ours | options)
