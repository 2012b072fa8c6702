"""Checks of invalid arguments: a ``ValueError`` before any work that names the argument, eager and compiled.

No filter of one's own decides them, so ``check_filter`` asks them only of the filters of the package: ``asked``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from torchfra.testing.case import CHECKS, STEPS, Case, Check
from torchfra.testing.expectations import expect, expect_same
from torchfra.types import Gaussian

REFUSALS: dict[str, Check] = {}


def check(*ways):
    """As ``testing.case.check``, but for these alone."""

    def register(function):
        REFUSALS[function.__name__] = Check(function, ways)
        return function

    return register


@pytest.fixture
def asked(monkeypatch):
    """The battery has these checks too."""
    for name, of in REFUSALS.items():
        monkeypatch.setitem(CHECKS, name, of)


class _Own(NamedTuple):
    """The state of an unknown filter."""

    belief: Gaussian


@check("eager", "compiled")
def shapes_that_do_not_fit_are_named(case: Case) -> None:
    """An element, step or state too many or too few is refused, in every argument."""
    z, (mean, root), std = case.z, case.prior, case.std
    for x in (torch.cat([z, z], -1), z[:, :0], z[0, 0, ..., 0]):
        _refuse(case, "z", z=x)
    for x in (std[:, :-1], std[..., :-1]):
        _refuse(case, "std", std=x)
    _refuse(case, "noise", noise=std)
    _refuse(case, "dt", dt=torch.ones(STEPS + 1))
    _refuse(case, "prior.mean", prior=Gaussian(mean[..., :-1], root))
    _refuse(case, "prior.scale_tril", prior=Gaussian(mean, root[..., :-1]))
    _refuse(case, "batch", prior=Gaussian(torch.cat([mean, mean]), torch.cat([root, root])))
    if case.u is not None:
        _refuse(case, "u", u=case.u[..., :-1, :])
        _refuse(case, "u", u=case.u[..., :1])


@check("eager", "compiled")
def time_steps_must_be_seconds_above_zero(case: Case) -> None:
    """A ``dt`` that is negative, NaN, infinite, complex or None is refused, as a number and at one of several steps.

    Zero is allowed for filters with ``zero_dt``: a second measurement at the same instant.
    """
    numbers = (-1.0, math.nan, math.inf) if case.filter.limits.zero_dt else (0.0, -1.0, math.nan, math.inf)
    for dt in (*numbers, 1j, None, "1"):
        _refuse(case, "dt", dt=dt)
        _refuse_step(case, "dt", dt=dt)
    for number in numbers:
        _refuse(case, "dt", dt=torch.where(torch.arange(STEPS) == 2, number, torch.ones(STEPS)))
        _refuse_step(case, "dt", dt=torch.tensor(number))
    _refuse(case, "dt", dt=torch.ones(STEPS, dtype=torch.complex128))
    _refuse(case, "dt", z=case.z.float(), dt=1e-300)


@check("eager", "compiled")
def noise_must_be_positive_and_finite(case: Case) -> None:
    """``std=`` and ``noise=`` that are zero, negative, NaN, infinite, singular or complex are refused.

    For missing elements, see ``noise_may_be_anything_where_nothing_is_seen``.
    """
    std, root, z = case.std, torch.diag_embed(case.std), case.z
    for bad in (0.0, -1.0, math.nan, math.inf):
        x = std.clone()
        x[-1, 1].select(-1, 0)[...] = bad
        _refuse(case, "std", std=x)
        _refuse(case, "std", std=x.float(), z=z.float())
        _refuse_step(case, "std", std=x[:, 1], z=z[:, 1])
    for bad in (0.0, math.nan, math.inf):
        x = root.clone()
        x[-1, 1].select(-1, 0)[...] = bad
        _refuse(case, "noise", noise=x)
        _refuse_step(case, "noise", noise=x[:, 1], z=z[:, 1])
    _refuse(case, "std", std=std.to(torch.complex128))
    _refuse(case, "noise", noise=root.to(torch.complex128))
    _refuse(case, "std, noise", std=std, noise=root)
    _refuse_step(case, "std, noise", std=std[:, 0], noise=root[:, 0])


@check("eager")
def noise_may_be_anything_where_nothing_is_seen(case: Case) -> None:
    """The std of a missing element does not count."""
    estimate = case(std=torch.where(case.z.isnan(), math.nan, case.std))
    expect(not bool(estimate.failed.any()), "estimate with a NaN std of missing elements", "numbers", "NaN")


@check("eager", "compiled")
def numbers_of_any_kind_are_taken_alike(case: Case) -> None:
    """Lists and arrays of NumPy give what tensors give, and tensors of integers what those of their values give."""
    z, prior = case.z, case.prior
    numpy: Any = [x.numpy() for x in prior]
    ways: tuple[Callable[[Tensor], Any], ...] = (Tensor.numpy, Tensor.tolist)
    for way in ways:
        found = case(z=way(z), prior=Gaussian(*numpy), std=way(case.std), dt=way(torch.ones(STEPS).double()))
        expect_same(found.mean, case(std=case.std, dt=torch.ones(STEPS).double()).mean, "estimates")
    whole = z.nan_to_num().round()
    expect_same(case(z=whole.long()).mean, case(z=whole).mean, "estimates of integers")


@check("eager", "compiled")
def what_is_no_number_is_named(case: Case) -> None:
    """None, words, and tensors of complex numbers or half precision are refused."""
    z, prior = case.z, case.prior
    kinds: list[Any] = [None, "north", [z, None]]
    for x in (*kinds, (1j * z).nan_to_num(), z.half(), z.bfloat16()):
        _refuse(case, "z", z=x)
        _refuse_step(case, "z", z=x[:, 0] if isinstance(x, Tensor) else x)
    for x in (tuple(prior), None, prior.mean):
        _refuse(case, "prior", prior=x)
        _refuse_call(case, "prior", lambda case, x=x: case.filter.init(x))  # type: ignore[misc]
    _refuse(case, "prior.mean", prior=Gaussian(*(x.half() for x in prior)))
    for name in ("u", "std", "noise"):
        _refuse(case, name, **{name: "small"})


@check("eager", "compiled")
def lengths_must_be_whole_numbers_of_steps(case: Case) -> None:
    """``truncate=`` and ``checkpoint=`` that are 0, negative, fractional or of another type are refused."""
    for bad in (0, -1, 1.5, "2"):
        _refuse(case, "truncate", truncate=bad)
        _refuse(case, "checkpoint", checkpoint=bad)


@check("eager", "compiled")
def a_state_must_be_of_this_filter_and_these_tracks(case: Case) -> None:
    """A prior, or the state of another filter or of other tracks, is refused as state, also once kernels exist."""
    case.step()
    small = Gaussian(case.prior.mean[..., :-1], case.prior.scale_tril)
    for _ in range(2):
        for state in (case.prior, None, _Own(case.prior), _Own(small)):
            _refuse_step(case, "state", state=state)
        _refuse_step(case, "batch", state=case.filter.init(Gaussian(*(x[:2] for x in case.prior))))


@check("eager")
def models_keep_the_shapes_that_they_promise(case: Case) -> None:
    """Motion and sensor give ``(p, ..., n)`` and ``(p, ..., m)`` for points ``(p, ..., n)``, in the dtype of these."""
    motion, sensor = case.filter.motion, case.filter.sensor
    mean = case.prior.mean if not case.filter.scans else case.prior.mean[:, 0]
    points, dt = mean.expand(2, *mean.shape), torch.full(mean.shape[:-1], case.dt, dtype=torch.float64)
    u = case.u_at(0)
    if not motion.stacked:
        _expect_shape(motion.at_points(points, dt, u), points.shape, points, type(motion).__name__, "states")
        noise = motion.process_noise_by(dt, u)
        expect(noise.shape[-2:-1] == (motion.size,), f"{type(motion).__name__}.process_noise",
               f"(..., {motion.size}, r)", tuple(noise.shape))  # fmt: skip
    expected = (*points.shape[:-1], sensor.size)
    _expect_shape(sensor.at_points(points, u), expected, points, type(sensor).__name__, "measurements")


@check("eager", "compiled")
def lazily_negated_tensors_are_negative(case: Case) -> None:
    """A tensor whose negation PyTorch has deferred, such as ``x.conj().imag``, is read with its sign."""
    z = torch.complex(torch.zeros_like(case.z), -case.z).conj().imag
    mean, root = (torch._neg_view(-x) for x in case.prior)
    expect_same(case(z=z), case.estimate, "estimate of a lazily negated z")
    expect_same(case(prior=Gaussian(mean, root)), case.estimate, "estimate from a lazily negated prior")
    if case.eager is None or case.thorough:
        expect_same(case(std=torch._neg_view(-case.std)), case(std=case.std), "estimate with a lazily negated std")


def _refuse(case: Case, argument: str, **given: Any) -> None:
    """Whole tracks with this are refused by a ``ValueError`` about the argument."""
    _refuse_call(case, argument, lambda case: case(**given))


def _refuse_step(case: Case, argument: str, **given: Any) -> None:
    """A single step with this is refused by a ``ValueError`` about the argument."""
    _refuse_call(case, argument, lambda case: case.step(**given))


def _refuse_call(case: Case, argument: str, call: Callable[[Case], Any]) -> None:
    """A call is refused by a ``ValueError`` about the argument; a compiled filter gives the eager one's message."""
    message, eager = refusal(lambda: call(case), argument), case.eager
    if eager is not None:
        expected = refusal(lambda: call(eager), argument)
        expect(message == expected, f"{argument}, compiled", repr(expected), repr(message))


def refusal(call: Callable[[], Any], argument: str) -> str:
    """The message of the ``ValueError`` that a call is expected to raise about an argument."""
    try:
        call()
    except ValueError as error:
        message = str(error)
        form = rf"(^|, ){re.escape(argument)}.*: expected .*received|^{re.escape(argument)}: "
        expect(re.search(form, message, re.S) is not None, argument, "an error that names it", repr(message))
        return message
    except Exception as error:
        expect(False, argument, "a ValueError that names it", f"{type(error).__name__}: {error}")
    expect(False, argument, "a ValueError that names it", "a result")
    return ""


def _expect_shape(found: Tensor, shape: tuple[int, ...], like: Tensor, name: str, what: str) -> None:
    expect(tuple(found.shape) == tuple(shape), f"{name}.forward", f"{what} {tuple(shape)}", tuple(found.shape))
    expect(found.dtype == like.dtype, f"{name}.forward", f"{what} of {like.dtype}", found.dtype)
