"""Models, detections and tracks of Stone Soup, in and out.

Stone Soup's states usually list ``[x, vx, y, vy]``, torchfra's ``[x, y, vx, vy]``: ``order`` are the numbers of Stone
Soup's components in torchfra's order, here ``(0, 2, 1, 3)``, which ``order_of`` finds for combined models.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from datetime import datetime, timedelta
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import (
    Cartesian2DToBearing,
    CartesianToBearingRange,
    CartesianToElevationBearingRange,
)
from stonesoup.models.transition.base import TransitionModel
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, LinearGaussianTransitionModel
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from torch import Tensor

from torchfra import sensors
from torchfra.adapters.linear import checked_order, gaussian, of_seconds
from torchfra.linalg import covariance_root
from torchfra.motion import Linear, Motion
from torchfra.numbers import Array
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian

_TRANSITIONS = (LinearGaussianTransitionModel, CombinedLinearGaussianTransitionModel)
_ANGLES = {
    Cartesian2DToBearing: (True,),
    CartesianToBearingRange: (True, False),
    CartesianToElevationBearingRange: (True, True, False),
}


class Timed(NamedTuple):
    """Measurements, or estimates, and when they are."""

    times: list[datetime]
    values: Tensor
    """``(T, m)``."""
    dt: Tensor
    """``(T - 1,)`` seconds from each to the next."""


def order_of(model: TransitionModel) -> list[int]:
    """Numbers of a model's components in torchfra's order: of combined models of one axis each, by derivatives."""
    parts = model.model_list if isinstance(model, CombinedLinearGaussianTransitionModel) else [model]
    sizes = [part.ndim_state for part in parts]
    if len(set(sizes)) > 1:
        raise ValueError(f"model: expected axes of the same size, or an order, received sizes {sizes}")
    return [axis * sizes[0] + derivative for derivative in range(sizes[0]) for axis in range(len(parts))]


def motion(model: TransitionModel, *, order: Sequence[int] | None = None, dims: int | None = None) -> Motion:
    """A transition model as a motion.

    Args:
        model: linear and Gaussian, for any interval of time.
        order: numbers of its components in torchfra's order; None for ``order_of(model)``.
        dims: how many of them are positions; None for the axes of a combined model, or half of the components.

    Raises:
        ValueError: another kind of model, or an order that does not name each component once.
    """
    if not isinstance(model, _TRANSITIONS):
        raise ValueError(f"model: expected a linear Gaussian transition model, received {type(model).__name__}")
    index = checked_order(order_of(model) if order is None else order, model.ndim_state)
    combined = isinstance(model, CombinedLinearGaussianTransitionModel)
    places = dims or (len(model.model_list) if combined else max(model.ndim_state // 2, 1))

    def of(matrix: Callable[..., Any]) -> Callable[[Tensor], Tensor]:
        """A matrix of the model as a function of ``dt (...)``."""
        square = np.ix_(index, index)
        return of_seconds(lambda s: np.asarray(matrix(time_interval=timedelta(seconds=s)), dtype=float)[square])

    return Linear(of(model.matrix), of(model.covar), size=model.ndim_state, dims=places)


class Polar(Sensor):
    """Bearing from x to y, with range, or with elevation before and range after it, as Stone Soup measures them.

    Args:
        places: numbers of the position's components in the state.
        offset: ``(d,)`` where the sensor stands, m.
        rotation: ``(3, 3)`` from the axes of space to those of the sensor.
        angles: for each element whether it is an angle.
        noise: root ``(m, m)`` of the measurement noise.
    """

    offset: Tensor
    rotation: Tensor

    def __init__(
        self, places: Sequence[int], offset: Array, rotation: Array, angles: Sequence[bool], noise: Tensor
    ) -> None:
        super().__init__(max(places) + 1, angles, noise=noise)
        self.places = list(places)
        self.register_buffer("offset", torch.from_numpy(offset), persistent=False)
        self.register_buffer("rotation", torch.from_numpy(rotation), persistent=False)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., m)`` of states."""
        away = torch.stack([x[..., i] for i in self.places], -1) - self.offset.to(x)
        away = torch.nn.functional.pad(away, (0, 3 - len(self.places))) @ self.rotation.to(x).mT
        bearing = torch.atan2(away[..., 1], away[..., 0])
        if self.size == 1:
            return bearing.unsqueeze(-1)
        ground = torch.hypot(away[..., 0], away[..., 1])
        if self.size == 2:
            return torch.stack([bearing, ground], -1)
        return torch.stack([torch.atan2(away[..., 2], ground), bearing, torch.hypot(ground, away[..., 2])], -1)


def sensor(model: MeasurementModel, *, order: Sequence[int] | None = None) -> Sensor:
    """A measurement model as a sensor: linear ones, and those of bearings, ranges and elevations (``Polar``).

    Args:
        model: the measurement model.
        order: numbers of the state's components in torchfra's order; None if they are in that order.

    Raises:
        ValueError: another kind of model, or an order that does not name each component once.
    """
    index = checked_order(order, model.ndim_state)
    if isinstance(model, LinearGaussian):
        return sensors.Linear(np.asarray(model.matrix(), dtype=float)[:, index], np.asarray(model.covar(), dtype=float))
    if type(model) not in _ANGLES:
        known = ", ".join(kind.__name__ for kind in (LinearGaussian, *_ANGLES))
        raise ValueError(f"model: expected one of {known}, received {type(model).__name__}")
    places = [index.index(i) for i in model.mapping]
    offset = np.asarray(model.translation_offset, dtype=float).reshape(-1)[: len(places)]
    noise = covariance_root(torch.as_tensor(model.covar(), dtype=torch.float64), "noise_covar")
    return Polar(places, offset, np.asarray(model.rotation_matrix, dtype=float), _ANGLES[type(model)], noise)


def belief(state: GaussianState, *, order: Sequence[int] | None = None) -> Gaussian:
    """A Gaussian state as a belief, a prior say.

    Raises:
        ValueError: an order that does not name each component once.
    """
    return gaussian(state.mean, state.covar, checked_order(order, state.ndim))


def measurements(detections: Iterable[Detection]) -> Timed:
    """Detections of one target, in order of time, as measurements ``(T, m)``.

    Raises:
        ValueError: no detections, or detections of several sizes.
    """
    found = sorted(detections, key=lambda detection: detection.timestamp)
    if len({detection.ndim for detection in found}) != 1:
        raise ValueError("detections: expected one or more, all of one size, received none or several sizes")
    rows = [np.asarray(detection.state_vector, dtype=float).reshape(-1) for detection in found]
    times = [detection.timestamp for detection in found]
    return Timed(times, torch.from_numpy(np.stack(rows)), _between(times))


def detections(z: Tensor, times: Sequence[datetime], model: MeasurementModel | None = None) -> list[Detection]:
    """Measurements ``(T, m)`` as detections; steps with an element missing have none.

    Raises:
        ValueError: times that are not one for each measurement.
    """
    _check_times(z, times)
    rows = z.detach().double().numpy()
    return [
        Detection(row.reshape(-1, 1), timestamp=time, measurement_model=model)
        for row, time in zip(rows, times, strict=True)
        if not np.isnan(row).any()
    ]


def estimates(track: Iterable[GaussianState], *, order: Sequence[int] | None = None) -> tuple[Timed, Tensor]:
    """A track, or any states in order of time: means ``(T, n)`` with their times, and covariances ``(T, n, n)``."""
    states = list(track)
    times = [state.timestamp for state in states]
    beliefs = [belief(state, order=order) for state in states]
    root = torch.stack([one.scale_tril for one in beliefs])
    return Timed(times, torch.stack([one.mean for one in beliefs]), _between(times)), root @ root.mT


def track(mean: Tensor, covariance: Tensor, times: Sequence[datetime], *, order: Sequence[int] | None = None) -> Track:
    """Estimates ``(T, n)`` and ``(T, n, n)`` of one target as a track, its states in Stone Soup's order.

    Raises:
        ValueError: times that are not one for each estimate, or an order that does not name each component once.
    """
    _check_times(mean, times)
    back = np.argsort(checked_order(order, mean.shape[-1]))
    means, covariances = (x.detach().double().numpy() for x in (mean, covariance))
    return Track([
        GaussianState(m[back].reshape(-1, 1), P[np.ix_(back, back)], timestamp=time)
        for m, P, time in zip(means, covariances, times, strict=True)
    ])  # fmt: skip


def _between(times: Sequence[datetime]) -> Tensor:
    return torch.tensor([(b - a).total_seconds() for a, b in pairwise(times)], dtype=torch.float64)


def _check_times(x: Tensor, times: Sequence[datetime]) -> None:
    if x.dim() != 2 or len(times) != len(x):
        raise ValueError(f"times: expected one for each of {tuple(x.shape[:-1])} steps, received {len(times)}")
