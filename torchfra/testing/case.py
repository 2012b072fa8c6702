"""A filter with tracks to try it on, and the registry of checks."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchfra.association.clutter import Clutter
from torchfra.filters.base import Filter
from torchfra.hyper import learnable
from torchfra.linalg.triangular import apply
from torchfra.motion.bank import aircraft
from torchfra.motion.base import Motion
from torchfra.motion.polynomial import ConstantAcceleration
from torchfra.register import filters, made
from torchfra.sensors.base import Sensor
from torchfra.sensors.position import Position
from torchfra.steps.recursion import HasBelief
from torchfra.types import CompileError, Estimate, Gaussian, Innovation

F = TypeVar("F", bound=Callable[..., None])
Argument = Tensor | Gaussian | float | None
TRACKS, STEPS = 3, 6


class Check(NamedTuple):
    """A check and the ways to run a filter in which it is tried."""

    function: Callable[[Case], None]
    ways: tuple[str, ...]
    """``"eager"``, ``"compiled"`` or both."""


CHECKS: dict[str, Check] = {}
"""All checks by name, in their order."""


def check(*ways: str) -> Callable[[F], F]:
    """Decorates a check: ``@check("eager", "compiled")``; a compiled case has an eager twin to compare with."""

    def register(function: F) -> F:
        CHECKS[function.__name__] = Check(function, ways)
        return function

    return register


class SkipCheck(Exception):  # noqa: N818  it is no error
    """Raised by a check that does not apply to a filter, with the reason."""


@dataclass(frozen=True)
class Case:
    """The argument of a check: a filter, and tracks: one misses an element, one a step, one has an outlier."""

    filter: Filter
    """Every value of it that can be learned is a parameter."""
    z: Tensor
    """``(3, 6, m)``, of scans ``(3, 6, J, m)``; float64, as are all tensors."""
    prior: Gaussian
    """``(3, n)`` and ``(3, n, n)``, of several targets ``(3, N, n)`` and ``(3, N, n, n)``."""
    dt: float = 1.0
    u: Tensor | None = None
    """``(6, k)`` or ``(3, 6, k)``."""
    eager: Case | None = None
    """For a compiled filter, the case of the eager one."""
    thorough: bool = False
    """Whether checks try all combinations of options."""
    _kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __call__(self, **given: Argument) -> Estimate:
        """The estimate of these tracks, with some arguments replaced: ``case(z=z, truncate=2)``."""
        arguments: dict[str, Any] = {"z": self.z, "prior": self.prior, "dt": self.dt, "u": self.u}
        arguments.update(given)
        return self.filter(**arguments)

    @property
    def estimate(self) -> Estimate:
        """The estimate of these tracks; made once, without gradients."""
        if "estimate" not in self._kept:
            with torch.no_grad():
                self._kept["estimate"] = self()
        found: Estimate = self._kept["estimate"]
        return found

    @cached_property
    def as_compiled(self) -> Case:
        """The case with a compiled copy of the filter.

        Raises:
            SkipCheck: there is no compiler.
        """
        from torchfra.compiler.llvm import binding  # only where it is needed

        try:
            binding()
        except CompileError as error:
            raise SkipCheck(f"not compiled: {error}") from None
        compiled = replace(self, filter=copy.deepcopy(self.filter).compile(), eager=self, _kept={})
        try:
            compiled.estimate  # noqa: B018  the first call compiles
        except CompileError as error:
            raise SkipCheck(f"not compiled: {error}") from None
        except Exception:
            pass  # a check reports it
        return compiled

    def step(self, **given: Argument | HasBelief) -> tuple[HasBelief, Innovation]:
        """State and innovation after the first measurement of each track, with some arguments replaced."""
        arguments: dict[str, Any] = {"z": self.z[:, 0], "dt": self.dt, "u": self.u_at(0)}
        if "state" not in given:
            arguments["state"] = self.filter.init(self.prior)
        arguments.update(given)
        after: tuple[HasBelief, Innovation] = self.filter.step(**arguments)
        return after

    def u_at(self, step: int) -> Tensor | None:
        """``u`` of one step."""
        return None if self.u is None else self.u[..., step, :]

    def alone(self, track: int) -> tuple[Tensor, Gaussian, Tensor | None]:
        """Measurements, prior and ``u`` of one track, without a batch."""
        u = self.u if self.u is None or self.u.dim() == 2 else self.u[track]
        return self.z[track], Gaussian(self.prior.mean[track], self.prior.scale_tril[track]), u

    @property
    def std(self) -> Tensor:
        """``(3, 6, m)`` standard deviations of the measurement noise, 0.9 to 1.2 times those of the sensor."""
        noise = self.filter.sensor.measurement_noise(torch.zeros_like(self.z))
        return noise.std.detach().expand(self.z.shape) * torch.linspace(0.9, 1.2, self.z.shape[-1]).to(self.z)


def make_case(
    f: Filter, z: Tensor | None, prior: Gaussian | None, dt: float, u: Tensor | None, seed: int, thorough: bool
) -> Case:
    """The case of a copy of a filter, with the tracks of the user or with simulated ones.

    Raises:
        ValueError: only one of ``z`` and ``prior``, or tracks that are too few or too short.
    """
    if (z is None) != (prior is None):
        raise ValueError("z, prior: expected both or neither, received one of them")
    f = learnable(copy.deepcopy(f), "all")
    if z is None or prior is None:
        z, prior = simulate(f, dt, seed)
    event = 1 + f.scans
    if z.dim() != 2 + event or z.shape[0] < TRACKS or z.shape[1] < STEPS:
        raise ValueError(f"z: expected {TRACKS} tracks or more of {STEPS} steps or more, received {tuple(z.shape)}")
    z, event_shape = z[:TRACKS, :STEPS].detach().double().clone(), prior.mean.shape[prior.mean.dim() - event :]
    mean, root = (x.detach().double() for x in prior)
    mean = (mean[:TRACKS] if mean.dim() > event else mean).expand(TRACKS, *event_shape)
    root = (root[:TRACKS] if root.dim() > event + 1 else root).expand(*mean.shape, mean.shape[-1])
    with torch.no_grad():
        z[2, 4] += 20 * f.sensor.measurement_noise(z[2, 4]).std  # an outlier
    z[0, 2].select(-1, 0)[...] = torch.nan
    z[1, 3] = torch.nan
    if u is not None:
        u = (u[:TRACKS] if u.dim() > 2 else u)[..., :STEPS, :].detach().double()
    return Case(f, z, Gaussian(mean, root), dt, u, thorough=thorough)


def registered(name: str) -> Filter:
    """The filter of this name around constant acceleration, or the motions of aircraft, and positions.

    Raises:
        ValueError: no such name, or its function returns something else.
    """
    known = filters()
    if name not in known:
        raise ValueError(f"filter: expected a Filter or one of {', '.join(known)}, received {name!r}")
    entry, sensor = known[name], Position(10.0)
    motion = aircraft(1.0) if entry.bank else ConstantAcceleration(1.0)
    clutter = {"clutter": Clutter(volume=1e8), "detection": 0.95} if entry.scans else {}
    return made(name, entry.preset(motion, sensor, **clutter), Filter, "(motion, sensor)")


def simulate(f: Filter, dt: float, seed: int) -> tuple[Tensor, Gaussian]:
    """Measurements of targets that follow the filter's own motion, or the first of its bank, and their prior.

    Raises:
        ValueError: of the sensor, where it needs a ``u``.
    """
    motion = f.motion[0] if f.motion.stacked else f.motion  # type: ignore[index]  # a bank
    targets = (2,) if f.scans else ()
    mean, std = torch.ones(TRACKS, *targets, motion.size, dtype=torch.float64), torch.ones(motion.size).double()
    mean[..., motion.position], std[motion.position] = 100.0, 10.0
    if f.scans:
        mean[:, 1] += 200.0
    generator, seconds = torch.Generator().manual_seed(seed), torch.tensor(dt, dtype=torch.float64)
    _, z = drawn(motion, f.sensor, mean, seconds, None, STEPS, generator)
    return z, Gaussian(mean, std.diag())


@torch.no_grad()
def drawn(
    motion: Motion, sensor: Sensor, x: Tensor, seconds: Tensor, u: Tensor | None, steps: int,
    generator: torch.Generator, *, process_noise: bool = False,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """States ``(B, steps, ..., n)`` after ``x (B, ..., n)``, and noisy measurements ``(B, steps, ..., m)`` of them.

    Args:
        motion: without process noise, unless it is asked for.
        sensor: what is measured.
        x: states before the first step.
        seconds: of each step, no dimensions.
        u: ``(..., k)`` inputs of every step.
        steps: their number.
        generator: of the random numbers.
        process_noise: whether states are disturbed.
    """
    states, measured, dt = [], [], seconds.expand(x.shape[:-1])
    for _ in range(steps):
        x = motion(x, dt, u)
        if process_noise:
            root = motion.process_noise_at(motion.process_noise_by(seconds, u), x, seconds)
            push = torch.randn(*x.shape[:-1], root.shape[-1], dtype=torch.float64, generator=generator)
            x = motion.canonical(x + apply(root, push))
        z = sensor(x, u)
        noise = torch.randn(*z.shape, 1, dtype=torch.float64, generator=generator)
        states.append(x)
        measured.append(z + sensor.measurement_noise(z).colour(noise).squeeze(-1))
    return torch.stack(states, 1), torch.stack(measured, 1)


def gradients(case: Case, dtype: torch.dtype = torch.float64, **options: int) -> dict[str, Tensor]:
    """Gradients of one number that depends on all of an estimate, by the data and every learnable value."""
    leaves: dict[str, Tensor] = {
        name: x.detach().to(dtype, copy=True).requires_grad_()
        for name, x in (("z", case.z), ("prior.mean", case.prior.mean), ("prior.scale_tril", case.prior.scale_tril))
    }
    prior = Gaussian(leaves["prior.mean"], leaves["prior.scale_tril"])
    y = one_number(case(z=leaves["z"], prior=prior, **options), case.prior)
    leaves |= case.filter.named_parameters()
    found = torch.autograd.grad(y, list(leaves.values()), allow_unused=True)
    zeros = (torch.zeros_like(x) if g is None else g for x, g in zip(leaves.values(), found, strict=True))
    return dict(zip(leaves, zeros, strict=True))


def own_gradients(case: Case) -> dict[str, Tensor]:
    """``gradients(case)``; made once."""
    if "gradients" not in case._kept:
        case._kept["gradients"] = gradients(case)
    found: dict[str, Tensor] = case._kept["gradients"]
    return found


def one_number(estimate: Estimate, prior: Gaussian) -> Tensor:
    """One number to which everything in an estimate contributes, in units of the prior."""
    mean, root, scores = estimate.mean, estimate.scale_tril, estimate.log_likelihood
    unit = prior.covariance.diagonal(dim1=-2, dim2=-1).sqrt().unsqueeze(-2).to(mean)
    total: Tensor = ((mean - prior.mean.unsqueeze(-2).to(mean)) / unit).square().sum() + scores.sum()
    return total + (root / unit.unsqueeze(-1)).square().sum()
