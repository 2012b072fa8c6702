"""Checks of a user's arguments, before any work."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from torchfra.gaussian.inputs import Measurements, Time
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.tracing import is_traced
from torchfra.linalg.triangular import hstack, tria
from torchfra.motion.base import Motion
from torchfra.numbers import NUMBERS, as_numbers, as_tensor
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian

T = TypeVar("T")
PRECISIONS = (torch.float32, torch.float64)
_TIMES = float, Tensor, *NUMBERS
"""Types of time steps that stay as they are, the most frequent first."""
_PAD = ": take torch.nn.utils.rnn.pad_sequence([torch.as_tensor(track) for track in tracks], True, torch.nan)"


def check(
    measurements: Measurements,
    prior: Gaussian,
    motion: Motion,
    size: int,
    *,
    scans: bool = False,
    name: str,
    zero_dt: bool,
) -> torch.Size:
    """Checks kinds, shapes and values of a user's arguments, and returns their batch.

    Args:
        measurements: of whole tracks.
        prior: ``(..., n)`` and ``(..., n, n)``.
        motion: the motion, of ``n`` components.
        size: elements of a measurement, ``m``.
        scans: whether measurements are ``(..., T, J, m)`` and priors ``(..., N, n)``; targets are no part of the batch.
        name: name of the prior in error messages.
        zero_dt: whether ``dt`` may be 0.

    Raises:
        ValueError: names the argument, what was expected and what came.
    """
    check_belief(prior, name, from_filter=name != "prior")
    check_kinds(measurements)
    batch = _batches(measurements, prior, motion.size, size, scans, name)
    z, dt = measurements.z, measurements.dt
    if scans and prior.scale_tril.dim() > 2 and prior.scale_tril.shape[-3] != prior.mean.shape[-2]:
        count, shape = prior.mean.shape[-2], tuple(prior.scale_tril.shape)
        raise ValueError(f"{name}.scale_tril: expected one for each of {count} targets, received {shape}")
    if isinstance(dt, Tensor):
        steps = z.shape[-2 - scans]
        if dt.dim() and dt.shape[-1] not in (1, steps):
            raise ValueError(f"dt: expected a number or (..., {steps}) or (..., 1), received {tuple(dt.shape)}")
        batch["dt"] = dt.shape[:-1]
    try:
        common = broadcast_shapes(*batch.values())
    except RuntimeError:
        received = ", ".join(f"{name} {tuple(shape)}" for name, shape in batch.items())
        raise ValueError(f"batch: expected shapes that broadcast, received {received}") from None
    check_values(measurements, zero_dt)
    return common


def measurements_of(
    z: object, dt: object = 1.0, u: object = None, std: object = None, noise: object = None,
    sensor: Sensor | None = None,
) -> Measurements:  # fmt: skip
    """A user's arguments as tensors: see ``as_numbers``.

    Raises:
        ValueError: no numbers, or rows of different lengths.
    """
    return Measurements(
        z if type(z) is Tensor and z.is_floating_point() else as_numbers(z, "z", _PAD),
        dt if isinstance(dt, _TIMES) else as_numbers(dt, "dt"),  # type: ignore[arg-type]  # some are numpy's
        u if u is None else as_numbers(u, "u"),
        std if std is None else as_numbers(std, "std"),
        noise if noise is None else as_numbers(noise, "noise"),
        sensor,
    )


def belief_of(belief: T) -> T:
    """A Gaussian of a user with tensors, see ``as_numbers``; anything else as it is.

    Raises:
        ValueError: no numbers.
    """
    if not isinstance(belief, Gaussian):
        return belief
    mean, root = as_numbers(belief.mean, "prior.mean"), as_numbers(belief.scale_tril, "prior.scale_tril")
    return Gaussian(mean, root)  # type: ignore[return-value]  # as it came


def check_belief(
    belief: object, name: str = "prior", *, size: int | None = None, from_filter: bool = False
) -> Gaussian:
    """Checks that ``belief`` is a Gaussian in single or double precision, of ``size`` components if that is not None.

    One that does not come ``from_filter`` must not have a covariance in the place of its root.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(belief, Gaussian):
        hint = "take torchfra.Gaussian(mean, scale_tril), a mean and a root of the covariance"
        raise ValueError(f"{name}: expected a Gaussian, received {type(belief).__name__}: {hint}")
    for part, x in (("mean", belief.mean), ("scale_tril", belief.scale_tril)):
        _check_tensor(f"{name}.{part}", x, PRECISIONS)
    if size is not None and (belief.mean.shape[-1:] != (size,) or belief.scale_tril.shape[-2:] != (size, size)):
        expected, received = f"(..., {size}) and (..., {size}, {size})", [tuple(x.shape) for x in belief]
        raise ValueError(f"{name}: expected {expected}, received {received[0]} and {received[1]}")
    if not from_filter:
        _check_root(belief.scale_tril, name)
    return belief


def _check_root(root: Tensor, name: str) -> None:
    """Checks that a root is none that can only be a covariance: symmetric, with entries beside its diagonal.

    Raises:
        ValueError: it is one.
    """
    if root.dim() < 2 or root.shape[-1] != root.shape[-2] or is_traced(root):
        return
    above = root.triu(1)
    bad = ((above != 0) & (above == root.tril(-1).mT)).flatten(-2).any(-1) & (root == root.mT).flatten(-2).all(-1)
    if bool(bad.any()):
        hint = f"take torchfra.Gaussian.from_covariance(mean, covariance), or torchfra.linalg.tria({name}.scale_tril)"
        expected = "a triangular root of the covariance"
        received = "a symmetric matrix with entries beside its diagonal, as a covariance is"
        raise ValueError(f"{name}.scale_tril: expected {expected}, received {received}: {hint}")


def check_kinds(measurements: Measurements) -> None:
    """Checks that all tensors are of real numbers.

    Raises:
        ValueError: names the first that is not; or both ``std`` and ``noise`` are given.
    """
    z, dt, u, std, noise, _ = measurements
    _check_tensor("z", z, PRECISIONS)
    for name, x in (("u", u), ("std", std), ("noise", noise)):
        if x is not None:
            _check_tensor(name, x)
    if isinstance(dt, Tensor):
        _check_tensor("dt", dt)
    if std is not None and noise is not None:
        raise ValueError("std, noise: expected at most one of the two, received both")


def _check_tensor(name: str, x: object, precisions: Sequence[torch.dtype] = ()) -> None:
    """Checks that ``x`` is a tensor of one of these precisions; if there are none, of real numbers."""
    if not isinstance(x, Tensor):
        raise ValueError(f"{name}: expected a tensor, received {type(x).__name__}")
    if x.is_nested:
        pad = f"torch.nested.to_padded_tensor({name}, torch.nan)"
        raise ValueError(f"{name}: expected a tensor of tracks of one length, received a nested one: take {pad}")
    if x.is_meta:
        raise ValueError(f"{name}: expected a tensor with numbers, received one on the meta device, which has none")
    if precisions and x.dtype not in precisions:
        take = f": take {name}.float()" if x.is_floating_point() else ""
        raise ValueError(f"{name}: expected floating point numbers, float32 or float64, received {x.dtype}{take}")
    if x.is_complex():
        raise ValueError(f"{name}: expected real numbers, received {x.dtype}")


def check_values(measurements: Measurements, zero_dt: bool = True) -> None:
    """Checks that time steps are finite and not negative, and noise positive, in the precision of ``z``.

    Noise is checked where something is measured.  Without ``zero_dt`` a ``dt`` of 0 is refused.  Nothing is checked
    while code is traced.

    Raises:
        ValueError: names the argument and the first value that does not fit.
    """
    z, dt, _, std, noise, _ = measurements
    if is_traced(*(x for x in measurements if isinstance(x, Tensor))):
        return
    check_seconds(dt, z.dtype, zero_dt)
    if std is not None:
        std = std.to(z)
        bad = ~((std > 0) & (std < torch.inf) | z.isnan())
        if bool(bad.any()):
            _refuse("std", "finite numbers above 0 where something is measured", std, bad)
    if noise is not None:
        singular = _singular(noise.detach().to(z), ~z.isnan())
        if bool(singular.any()):
            expected = "roots of finite covariances that have an inverse, where something is measured"
            _refuse("noise", expected, noise, singular, event=2)


def check_seconds(dt: Time, dtype: torch.dtype, zero_dt: bool = True) -> None:
    """Checks that time steps are finite and not negative in this precision, and without ``zero_dt`` not 0.

    Raises:
        ValueError: one is not.
    """
    exact = as_tensor(dt)
    seconds = exact.to(dtype)
    bad = ~((seconds > 0) & (seconds < torch.inf))
    if zero_dt:
        bad = bad & (exact != 0)
    if bool(bad.any()):
        _refuse("dt", f"seconds above 0 {'(or just 0) ' * zero_dt}and finite in {dtype}", exact, bad)


class LostDigits(RuntimeWarning):
    """Single precision has rounded away digits that a filter needs."""


def warn_of_lost_digits(measurements: Measurements, sensor: Sensor, rank: int, *, scans: bool = False) -> None:
    """Warns of what single precision has rounded away before it came: nobody sees that in an estimate.

    That are time steps that are all 0, as differences of Unix times are, and an element whose numbers half of the time
    lie further apart than the standard deviation of its noise.  Nothing is checked while code is traced.

    ``rank`` is the number of batch dimensions, those of the hyperparameters and that of scans included.
    """
    z, dt, _, std, noise, _ = measurements
    if is_traced(*(x for x in measurements if isinstance(x, Tensor))):
        return
    if isinstance(dt, Tensor) and dt.dtype is torch.float32 and dt.numel() > 1 and not bool(dt.any()):
        hint = "take the differences of times in float64 (float32 holds Unix times in steps of 128 s)"
        warnings.warn(f"dt: all time steps are 0 in float32: {hint}", LostDigits, stacklevel=2)
    if z.dtype is torch.float32:

        def time_first(x: Tensor, event: int) -> Tensor:
            # Hyperparameters have a batch and no time, so that both align.
            x = x.movedim(-1 - event - scans, 0)
            return x.reshape(x.shape[:1] + (1,) * (rank + 1 + event - x.dim()) + x.shape[1:])

        with torch.no_grad():
            z = time_first(z, 1)
            std, noise = (x if x is None else time_first(x, event) for x, event in ((std, 1), (noise, 2)))
            step = torch.nextafter(z.abs(), z.new_tensor(torch.inf)) - z.abs()
            step, deviation = torch.broadcast_tensors(step, sensor.measurement_noise(z, std, noise).std)
            coarse = (step / deviation).reshape(-1, z.shape[-1]).nanmedian(0).values > 1
        if bool(coarse.any()):
            i = int(coarse.int().argmax())
            apart, noise_of = (f"{float(x[..., i].nanmedian()):.2g}" for x in (step, deviation))
            held = f"element {i} in steps of {apart}, and its noise has a standard deviation of {noise_of}"
            hint = "take float64, or subtract an origin there"
            warnings.warn(f"z: float32 holds {held}: {hint}", LostDigits, stacklevel=2)


def warn_of_degrees(z: Tensor, sensor: Sensor) -> None:
    """Warns of angles that are rather degrees: half of the first 1000 are more than two turns off 0.

    Nothing is checked while code is traced.
    """
    if is_traced(z) or not z.numel() or not bool(sensor.angles.any()):
        return
    large = z.detach().reshape(-1, z.shape[-1])[:1000].abs().nanmedian(0).values > 4 * math.pi
    wrong = (large & sensor.angles.to(large.device)).nonzero().flatten().tolist()
    if wrong:
        expected = f"angles in rad in elements {wrong}, received half of them beyond two turns"
        warnings.warn(f"z: expected {expected}: degrees (torch.deg2rad), or unwrapped?", RuntimeWarning, stacklevel=2)


_WIDEST = 1e12
"""Widest prior, in standard deviations of the measurement noise, beside which reflections keep the digits of the noise.

Products and sums of columns keep those of each, but a reflection in double precision leaves 2e-16 of a row's largest.
"""
_WIDEST_MIXED = 1e7
"""The same where moments are matched in single precision before measurements have told all components.

What is not known yet is a column of the root in each belief, and where these differ by rounding, 6e-8 of their length
is taken for spread.
"""


def warn_of_width(prior: Gaussian, measurements: Measurements, sensor: Sensor, *, mixture: bool) -> None:
    """Warns of a prior so wide that no number holds it beside what a linear sensor measures.

    With ``mixture`` the filter matches the moments of several beliefs at each step.  Those after two measurements are
    narrow where two tell the state.
    """
    root, (z, _, _, std, noise, _) = prior.scale_tril.detach(), measurements
    mixed = mixture and root.dtype is torch.float32 and root.shape[-1] > 2 * sensor.size
    widest = _WIDEST_MIXED if mixed else _WIDEST
    if not sensor.linear or is_traced(root, z) or not bool((root.abs() > 1e-6 * widest).any()):
        return  # no sensor is that precise: the usual case costs one comparison
    with torch.no_grad():
        spread = sensor(root.mT)
        largest = spread.abs().amax(-2, keepdim=True).clamp_min(torch.finfo(spread.dtype).tiny)  # squares may overflow
        wide = torch.linalg.vector_norm(spread / largest, dim=-2) * largest.squeeze(-2)
        wide = wide.reshape(-1, sensor.size).amax(0)
        ratio = wide * sensor.measurement_noise(z.to(root), std, noise).scale.reshape(-1, sensor.size).amax(0)
    if bool((ratio > widest).any()):
        expected = f"standard deviations below {widest:.0e} times those of the measurement noise"
        received = f"{float(ratio.max()):.1e} times that of element {int(ratio.argmax())}"
        warnings.warn(f"prior: expected {expected}, received {received}: digits are lost", LostDigits, stacklevel=2)


def _singular(noise: Tensor, measured: Tensor) -> Tensor:
    """``(...)`` bool, where a root ``noise (..., m, m)`` of the measured elements is not finite or singular."""
    root = torch.where(measured.unsqueeze(-1), noise, 0.0)
    broken: Tensor = ~root.isfinite().flatten(-2).all(-1)
    least = 10 * torch.finfo(noise.dtype).eps * torch.linalg.vector_norm(root, dim=-1)
    pivots = root.diagonal(dim1=-2, dim2=-1).abs()
    if not bool(root.triu(1).any()) and bool(((pivots > least) | ~measured).all()):
        return broken
    lower = tria(hstack(torch.where(broken[..., None, None], 0.0, root), torch.diag_embed(1.0 - measured.to(root))))
    singular: Tensor = ~(lower.diagonal(dim1=-2, dim2=-1) > least).all(-1)
    return broken | singular


def _refuse(name: str, expected: str, x: Tensor, bad: Tensor, event: int = 0) -> None:
    """Raises the error about the first bad entry of a tensor whose entries have ``event`` dimensions."""
    place, split = tuple(bad.nonzero()[0].tolist()), x.dim() - event
    entry = x.expand(broadcast_shapes(x.shape[:split], bad.shape) + x.shape[split:])[place]
    raise ValueError(f"{name}: expected {expected}, received {entry.tolist()}{f' at {place}' if place else ''}")


def _batches(
    measurements: Measurements, prior: Gaussian, n: int, m: int, scans: bool, name: str
) -> dict[str, torch.Size]:
    """Checks the event of each argument, and returns its batch."""
    z, _, u, std, noise, _ = measurements
    rank = 2 + scans
    if z.dim() >= rank and z.shape[-rank] == 0:
        received = f"none, {tuple(z.shape)}: without a measurement the estimate is the prior"
        raise ValueError(f"z: expected 1 step or more in (..., T, {'J, ' if scans else ''}{m}), received {received}")
    if z.dim() < rank or z.shape[-1] != m or 0 in z.shape[-rank:]:
        raise ValueError(f"z: expected (..., T, {'J, ' if scans else ''}{m}), received {tuple(z.shape)}")
    steps, per_scan = z.shape[-rank], tuple(z.shape[-2:-1]) if scans else ()
    targets = (None,) if scans else ()
    root = (*targets, n, n) if prior.scale_tril.dim() > 2 else (n, n)
    batch = {"z": z.shape[:-rank]}
    for argument, x, shape in (
        (f"{name}.mean", prior.mean, (*targets, n)),
        (f"{name}.scale_tril", prior.scale_tril, root),
        ("u", u, (steps, None)),
        ("std", std, (steps, *per_scan, m)),
        ("noise", noise, (steps, *per_scan, m, m)),
    ):
        if x is None:
            continue
        fits = x.dim() >= len(shape) and all(
            wanted is None or size == wanted for size, wanted in zip(x.shape[-len(shape) :], shape, strict=True)
        )
        if not fits:
            unknown = "N" if x is prior.mean or x is prior.scale_tril else "k"
            wanted = ", ".join(unknown if size is None else str(size) for size in shape)
            raise ValueError(f"{argument}: expected (..., {wanted}), received {tuple(x.shape)}")
        batch[argument] = x.shape[: x.dim() - len(shape)]
    return batch
