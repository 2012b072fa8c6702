"""Checks of what is refused: a ``ValueError`` before any work that names the argument, eager and compiled alike."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.testing.case import STEPS, Case, check
from torchfra.testing.expectations import expect, refusal
from torchfra.types import Gaussian


class _Own(NamedTuple):
    """The state of a filter that nobody knows."""

    belief: Gaussian


@check("eager", "compiled")
def shapes_that_do_not_fit_are_named(case: Case) -> None:
    """One element, step or state too many or too few, in every argument."""
    z, (mean, root), std = case.z, case.prior, case.std
    _refuse(case, "z", lambda c: c(torch.cat([z, z], -1)), lambda c: c(z[:, :0]), lambda c: c(z[0, 0, ..., 0]))
    _refuse(case, "prior.mean", lambda c: c(prior=Gaussian(mean[..., :-1], root)))
    _refuse(case, "prior.scale_tril", lambda c: c(prior=Gaussian(mean, root[..., :-1])))
    _refuse(case, "std", lambda c: c(std=std[:, :-1]), lambda c: c(std=std[..., :-1]))
    _refuse(case, "noise", lambda c: c(noise=std))
    _refuse(case, "dt", lambda c: c(dt=torch.ones(STEPS + 1)))
    _refuse(case, "batch", lambda c: c(prior=Gaussian(torch.cat([mean, mean]), torch.cat([root, root]))))
    if case.u is not None:
        _refuse(case, "u", lambda c: c(u=c.u[..., :-1, :]), lambda c: c(u=c.u[..., :1]))


@check("eager", "compiled")
def time_steps_must_be_seconds_above_zero(case: Case) -> None:
    """Zero, negative, NaN, infinite, complex and nothing, as a number and at one step among others."""
    seconds = [0.0, -1.0, math.nan, math.inf, 1j, None, "1"]
    z, one = case.z[:, 0], torch.ones(STEPS)
    for bad in (0.0, -1.0, math.nan, math.inf):
        seconds.append(torch.where(torch.arange(STEPS) == 2, bad, one))
    for dt in [*seconds, one.to(torch.complex128)]:
        _refuse(case, "dt", lambda c, dt=dt: c(dt=dt))
    for dt in seconds[:7]:
        _refuse(case, "dt", lambda c, dt=dt: c.step(z, dt=dt))
    _refuse(case, "dt", lambda c: c(z.unsqueeze(1).float().expand(case.z.shape), dt=1e-300))


@check("eager", "compiled")
def noise_must_be_positive_and_finite(case: Case) -> None:
    """``std=`` and ``noise=`` that are zero, negative, NaN, infinite, singular or complex where something is seen."""
    std, seen, z = case.std, case.z[:, 0], case.z
    for bad in (0.0, -1.0, math.nan, math.inf):
        x = std.clone()
        x[-1, 1].select(-1, 0)[...] = bad
        _refuse(case, "std", lambda c, x=x: c(std=x), lambda c, x=x: c.step(z[:, 1], std=x[:, 1]))
        _refuse(case, "std", lambda c, x=x: c(std=x.float(), z=z.float()))
    root = torch.diag_embed(std)
    for bad in (0.0, math.nan, math.inf):
        x = root.clone()
        x[-1, 1].select(-1, 0)[...] = bad
        _refuse(case, "noise", lambda c, x=x: c(noise=x), lambda c, x=x: c.step(z[:, 1], noise=x[:, 1]))
    _refuse(case, "std", lambda c: c(std=std.to(torch.complex128)))
    _refuse(case, "noise", lambda c: c(noise=root.to(torch.complex128)))
    _refuse(
        case, "std, noise", lambda c: c(std=std, noise=root), lambda c: c.step(seen, std=std[:, 0], noise=root[:, 0])
    )


@check("eager", "compiled")
def noise_may_be_anything_where_nothing_is_seen(case: Case) -> None:
    """The std of a missing element does not count."""
    std = torch.where(case.z.isnan(), math.nan, case.std)
    estimate = case(std=std)
    expect(not bool(estimate.failed.any()), "estimate with a NaN std of missing elements", "numbers", "NaN")


@check("eager", "compiled")
def what_is_no_tensor_is_named_with_what_to_hand_in(case: Case) -> None:
    """NumPy arrays, lists and nothing; whole numbers, complex ones and half precision."""
    z, prior = case.z, case.prior
    bad: list[Any] = [z.numpy(), z.tolist(), (1j * z).nan_to_num(), z.half(), z.bfloat16(), z.nan_to_num().long()]
    for x in bad:
        _refuse(case, "z", lambda c, x=x: c.filter(x, prior, u=c.u))
        _refuse(case, "z", lambda c, x=x: c.step(x[:, 0] if isinstance(x, Tensor) else x))
    _refuse(case, "z", lambda c: c.filter(None, prior, u=c.u), lambda c: c.step(None))
    for x in (tuple(prior), None, prior.mean):
        _refuse(case, "prior", lambda c, x=x: c.filter(z, x, u=c.u), lambda c, x=x: c.filter.init(x))
    numpy, halves = Gaussian(*(x.numpy() for x in prior)), Gaussian(*(x.half() for x in prior))  # type: ignore[arg-type]
    _refuse(case, "prior.mean", lambda c: c(prior=numpy), lambda c: c(prior=halves), lambda c: c.filter.init(numpy))
    for name in ("u", "std", "noise"):
        _refuse(case, name, lambda c, name=name: c(**{name: case.std.tolist()}))


@check("eager", "compiled")
def lengths_must_be_whole_numbers_of_steps(case: Case) -> None:
    """``truncate=`` and ``checkpoint=`` of 0, negative, broken and of another kind."""
    for bad in (0, -1, 1.5, "2"):
        _refuse(case, "truncate", lambda c, bad=bad: c(truncate=bad))
        _refuse(case, "checkpoint", lambda c, bad=bad: c(checkpoint=bad))


@check("eager", "compiled")
def a_state_must_be_of_this_filter_and_these_tracks(case: Case) -> None:
    """No prior, no state of another filter or of other tracks; a second time too, when kernels are there."""
    z, u = case.z[:, 0], case.u if case.u is None else case.u[..., 0, :]
    one = torch.ones_like(case.prior.mean)
    case.step(z)
    for state in (case.prior, None, _Own(case.prior), _Own(Gaussian(one[..., :-1], case.prior.scale_tril))):
        _refuse(case, "state", *[lambda c, state=state: c.filter.step(state, z, dt=c.dt, u=u)] * 2)
    few = case.filter.init(Gaussian(*(x[:2] for x in case.prior)))
    _refuse(case, "batch", *[lambda c: c.filter.step(few, z, dt=c.dt, u=u)] * 2)


@check("eager")
def models_keep_the_shapes_that_they_promise(case: Case) -> None:
    """Motion and sensor give ``(p, ..., n)`` and ``(p, ..., m)`` for points ``(p, ..., n)``, in the dtype of these."""
    motion, sensor = case.filter.motion, case.filter.sensor
    mean = case.prior.mean if not case.filter.scans else case.prior.mean[:, 0]
    points, dt = mean.expand(2, *mean.shape), torch.full(mean.shape[:-1], case.dt, dtype=torch.float64)
    u = case.u if case.u is None else case.u[..., 0, :]
    if not motion.stacked:
        _expect_shape(motion.at_points(points, dt, u), points.shape, points, type(motion).__name__, "states")
        noise = motion.process_noise(dt)
        expect(noise.shape[-2:-1] == (motion.size,), f"{type(motion).__name__}.process_noise",
               f"(..., {motion.size}, r)", tuple(noise.shape))  # fmt: skip
    expected = (*points.shape[:-1], sensor.size)
    _expect_shape(sensor.at_points(points, u), expected, points, type(sensor).__name__, "measurements")


def _expect_shape(found: Tensor, shape: tuple[int, ...], like: Tensor, name: str, what: str) -> None:
    expect(tuple(found.shape) == tuple(shape), f"{name}.forward", f"{what} {tuple(shape)}", tuple(found.shape))
    expect(found.dtype == like.dtype, f"{name}.forward", f"{what} of {like.dtype}", found.dtype)


def _refuse(case: Case, argument: str, *calls: Callable[[Case], Any]) -> None:
    """Each call is refused by a ``ValueError`` about the argument, in the same words as without ``compile``."""
    for call in calls:
        message = refusal(lambda call=call: call(case), argument)  # type: ignore[misc]
        if case.eager is not None:
            expected = refusal(lambda call=call: call(case.eager), argument)  # type: ignore[misc]
            expect(message == expected, f"{argument}, compiled", repr(expected), repr(message))
