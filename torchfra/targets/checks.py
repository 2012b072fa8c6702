"""Checks of the arguments of a manager of targets, before any work."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import TypeVar

import torch
from torch import Tensor

from torchfra.filters.failures import bad_values
from torchfra.filters.gpb import GPB
from torchfra.filters.scans.jpda import JPDA
from torchfra.filters.scans.lost_tracks import log_miss
from torchfra.gaussian.arguments import check_kinds, check_values
from torchfra.gaussian.inputs import Measurements, Time, batch_rank
from torchfra.targets.places import known_components
from torchfra.targets.scan import SceneScan
from torchfra.targets.state import TargetsState

T = TypeVar("T")
_DTYPES = torch.float32, torch.float64


def check_filter(filter: object, name: str = "filter", *, births: bool = True) -> None:
    """Checks that a filter, the argument of that name, can track a number of targets that changes.

    Args:
        filter: the filter.
        name: of the argument.
        births: whether targets have to begin from its measurements.

    Raises:
        ValueError: it cannot.
    """
    if not isinstance(filter, JPDA):
        raise ValueError(f"{name}: expected a JPDA around a filter of one target, received {type(filter).__name__}")
    if births and not filter.sensor.locates:
        received = filter.sensor.describe()
        raise ValueError(f"{name}: expected a sensor that measures where a target is, received {received}")
    wanted = filter.motion.dims
    if filter.sensor.locates:
        dims = filter.sensor.locate(torch.ones(1, filter.sensor.size)).shape[-1]
        if dims != wanted:
            expected = f"a sensor that locates in {wanted} dimensions, as the motion has"
            raise ValueError(f"{name}: expected {expected}, received {dims}")
    if len(known_components(filter.motion)) != 2 * wanted:
        received = type(filter.motion).__name__
        raise ValueError(f"{name}: expected a motion with position and velocity in its state, received {received}")
    if batch_rank(filter):
        raise ValueError(
            f"{name}: expected hyperparameters that are the same for all targets, received a batch of them"
        )
    _check_missable(filter, name)


def _check_missable(filter: JPDA, name: str = "filter") -> None:
    if not bool(log_miss(filter.detection, filter.gate, torch.zeros(())) > -torch.inf):
        raise ValueError(
            f"{name}: expected a detection below 1 or a gate with a probability, so that targets may be missed"
        )


def check_parts(**parts: tuple[object, type]) -> None:
    """Whether each part is of its kind, or None.

    Raises:
        ValueError: names the first that is not.
    """
    for name, (part, kind) in parts.items():
        if part is not None and not isinstance(part, kind):
            expected = f"a {kind.__name__} of torchfra.targets"
            raise ValueError(f"{name}: expected {expected}, received {type(part).__name__}")


def by_sensor(
    name: str, values: Mapping[str | None, T] | None, sensors: Collection[str], kind: type[T] | None = None
) -> dict[str | None, T]:
    """An argument that has values of a kind for some sensors, by their names, None for the filter's own.

    Raises:
        ValueError: it is no dictionary, or has a name of no sensor or a value of another kind.
    """
    if not isinstance(values, Mapping | None):
        raise ValueError(f"{name}: expected a dict by the name of a sensor, received {values!r}")
    for sensor, value in (values or {}).items():
        if sensor is not None and sensor not in sensors:
            raise ValueError(f"{name}: expected some of {', '.join(['None', *sensors])}, received {sensor!r}")
        if kind is not None and not isinstance(value, kind):
            raise ValueError(f"{name}: expected a {kind.__name__} of {sensor!r}, received {type(value).__name__}")
    return dict(values or {})


def check_scan(
    filter: JPDA, state: TargetsState, measurements: Measurements, window: int, lag: float
) -> SceneScan:  # fmt: skip
    """One scan of each scene, in one form.

    Args:
        filter: of its sensor.
        state: before it.
        measurements: of it.
        window: scans that the confirmation looks at.
        lag: seconds that it may be late: then ``dt`` is below 0.

    Raises:
        ValueError: a shape or a value that does not fit.
    """
    if not isinstance(state, TargetsState):
        raise ValueError(f"state: expected what init or step has returned, received {type(state).__name__}")
    if state.track.hits.shape[-1] != window:
        expected = f"hits of the last {window} scans, as the confirmation looks at"
        raise ValueError(f"state: expected {expected}, received those of {state.track.hits.shape[-1]}")
    z, dt, u, std, noise, _ = measurements
    scenes, like = len(state.next_identity), state.belief.mean
    _check_scans(filter, z, "(J, m) or (R, J, m)", (2, 3))
    _check_noise(filter, measurements)
    if z.dim() == 2:
        z, (std, noise) = z.unsqueeze(0), (None if x is None else x.unsqueeze(0) for x in (std, noise))
    if len(z) != scenes:
        raise ValueError(f"z: expected {scenes} scenes as the state has, received {len(z)}")
    seconds = _seconds(dt, (scenes,), zero_dt=filter.inner.limits.zero_dt, lag=lag).to(like)
    if bool((seconds < 0).any()) and not state.past:
        raise ValueError(f"dt: expected 0 or more before any scan has come, received {seconds.tolist()}")
    own = (x if x is None else x.to(like) for x in (std, noise))
    z = z.to(like)
    _check_finite(z)  # in the dtype of the state
    return SceneScan(z, seconds, _inputs(u, (scenes,), like), *own)


def _check_noise(filter: JPDA, measurements: Measurements) -> None:
    """Whether what is known of the noise of each measurement fits it."""
    z, _, _, std, noise, _ = measurements
    check_kinds(measurements._replace(dt=1.0))
    for name, x, shape in (("std", std, z.shape), ("noise", noise, (*z.shape, z.shape[-1]))):
        if x is not None and x.shape != shape:
            raise ValueError(f"{name}: expected {tuple(shape)}, received {tuple(x.shape)}")
    check_values(measurements._replace(dt=1.0, u=None))
    if isinstance(filter.inner, GPB):
        filter.inner.outliers.check_noise("noise", noise)


def check_scans(filter: JPDA, z: Tensor, dt: Time, u: Tensor | None) -> list[SceneScan]:
    """All scans of sequences ``(..., T, J, m)``, the scenes along one dimension.

    Raises:
        ValueError: a shape or a value that does not fit.
    """
    _check_scans(filter, z, "(..., T, J, m)", range(3, 99))
    if 0 in z.shape[:-2]:
        raise ValueError(f"z: expected one scene and one scan or more, received {tuple(z.shape)}")
    scans = z.reshape(math.prod(z.shape[:-3]), *z.shape[-3:])
    scenes, steps = scans.shape[:2]
    seconds = _seconds(dt, (steps,)).to(z)
    inputs = _inputs(u, (*z.shape[:-3], steps), z)
    inputs = None if inputs is None else inputs.reshape(scenes, steps, -1)
    each = [None] * steps if inputs is None else inputs.unbind(1)
    return [SceneScan(scans[:, t], seconds[t].expand(scenes), each[t]) for t in range(steps)]


def _check_scans(filter: JPDA, z: Tensor, shape: str, ranks: tuple[int, ...] | range) -> None:
    _check_missable(filter)  # values may have been set since
    if names := bad_values(filter):
        raise ValueError(
            f"filter: expected hyperparameters in their range, received NaN or out of it: {', '.join(names)}"
        )
    size = filter.sensor.size
    if not isinstance(z, Tensor) or z.dim() not in ranks or z.shape[-1] != size or z.dtype not in _DTYPES:
        received = f"{tuple(z.shape)}, {z.dtype}" if isinstance(z, Tensor) else type(z).__name__
        raise ValueError(
            f"z: expected floating-point scans {shape} with m of {size}, float32 or float64, received {received}"
        )
    _check_finite(z)


def _check_finite(z: Tensor) -> None:
    if bool(z.isinf().any()):
        largest = f"an infinite one (the largest number of {str(z.dtype)[6:]} is {torch.finfo(z.dtype).max:.1e})"
        raise ValueError(f"z: expected finite measurements, or NaN where there is none, received {largest}")


def _seconds(dt: Time, shape: tuple[int, ...], *, zero_dt: bool = False, lag: float = 0.0) -> Tensor:
    try:  # a number of Python's own would be rounded to torch's default
        seconds = dt if isinstance(dt, Tensor) else torch.as_tensor(dt, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"dt: expected a number or {shape}, received {dt!r}") from None
    if seconds.dim() > 1 or (seconds.dim() and seconds.shape != shape):
        raise ValueError(f"dt: expected a number or {shape}, received {tuple(seconds.shape)}")
    if not all(0 < x < math.inf or (zero_dt and -lag <= x <= 0) for x in seconds.flatten().tolist()):
        least = f" or 0, and -{lag:g} at least of a late scan" if lag else " or 0" * zero_dt
        raise ValueError(f"dt: expected finite seconds above 0{least}, received {seconds.tolist()}")
    return seconds.expand(shape)


def _inputs(u: Tensor | None, shape: tuple[int, ...], like: Tensor) -> Tensor | None:
    if u is None:
        return None
    fits = isinstance(u, Tensor) and 1 <= u.dim() <= len(shape) + 1
    if not fits or any(a not in (1, b) for a, b in zip(u.shape[-2::-1], shape[::-1], strict=False)):
        received = tuple(u.shape) if isinstance(u, Tensor) else type(u).__name__
        raise ValueError(f"u: expected {(*shape, 'k')}, or fewer dimensions, received {received}")
    if not bool(u.isfinite().all()):
        raise ValueError("u: expected finite numbers, received NaN or infinity")
    return u.to(like).expand(*shape, u.shape[-1])
