"""The true models of a scenario's targets and measurements, for bounds on errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfra.metrics.bounds import outlier_information
from torchfra.motion.base import Motion
from torchfra.scenarios.outliers import LENGTH, SHARE, SIZE
from torchfra.sensors.base import Sensor

Measured = Callable[[Tensor, Tensor | None], Tensor]


@dataclass(frozen=True)
class Law:
    """The law of the truth, which filters need not know, in the coordinates of the truth (``n`` components).

    Args:
        start: ``(n, p)`` root of the covariance of the error of the initial beliefs.
        motion: the transition of states, except for ``process_noise`` and for known inputs, on which no bound depends;
            linear ones may be given for each step.
        sensor: what is measured of a state, given ``u``.
        std: ``(m,)`` or ``(T, m)`` standard deviation of a measurement without outliers; a tensor or a number.
        process_noise: ``(n, q)`` root of that of a step; None for paths that are fixed, or known except their start.
        information: ``(T,)`` or a number: Fisher information of a measurement with outliers, relative to one without
            (``metrics.outlier_information``).
        known: the quantities that the bound takes as known although filters do not know them, in words.
    """

    start: Tensor
    motion: Motion | Sequence[Motion]
    sensor: Sensor | Measured
    std: Tensor | float
    process_noise: Tensor | None = None
    information: Tensor | float = 1.0
    known: tuple[str, ...] = ()


def burst_information(steps: int, share: float = SHARE, size: float = SIZE) -> Tensor:
    """``(T,)`` Fisher information of measurements with outliers in known bursts (``burst_factors``).

    As bursts persist, a measurement is informative about whether the next one is an outlier, so the information of an
    independent mixture at each step would be too small.
    """
    age = torch.arange(1, steps + 1, dtype=torch.float64).clamp(max=LENGTH)
    inside = 1 - (1 - share / LENGTH) ** age
    return 1 - inside + inside / size**2


def mixed_information(outliers: str, size: float | None, share: float, elements: int) -> float:
    """Fisher information of measurements with the outliers of ``outlier_factors``, whose arguments it takes.

    ``elements`` of a measurement are outliers together.
    """
    sizes = [float(i) for i in range(1, 21)] if size is None else [size]
    factors = [{"covariance": s**0.5, "std": s, "none": 1.0}[outliers] for s in sizes]
    return outlier_information([1 - share, *[share / len(sizes)] * len(sizes)], [1.0, *factors], elements)
