"""Checks of a motion or of a sensor by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchfra.hyper import Hyper
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.testing.expectations import expect, line_of_method
from torchfra.types import Gaussian

BATCH = 3
CIRCLES = (1e2, 1e4, 1e6, 1e8)
"""Radii, m, of circles around the origin: the bearing from a station inside jumps, wherever the station is."""
UNITS = ((2 * math.pi, "rad"), (360.0, "degrees"))


@dataclass(frozen=True)
class Part:
    """A motion or a sensor as a function of states, seconds and ``u``, with arguments to try it on."""

    model: Motion | Sensor
    name: str
    """The method under test, such as ``Drag.forward``."""
    line: str
    """File and line of its definition."""
    function: Callable[[Tensor, Tensor, Tensor | None], Tensor]
    size: int
    """Number of components of its result."""
    x: Tensor
    """``(3, n)`` states."""
    dt: Tensor
    """``(3,)`` seconds."""
    u: Tensor | None
    """``(3, k)`` inputs."""

    def method(self, name: str) -> Part:
        """The part with another method under test."""
        kind = type(self.model)
        return replace(self, name=f"{kind.__name__}.{name}", line=line_of_method(getattr(kind, name)))

    def together(self) -> Tensor:
        """The result of the function for all states at once."""
        return self.function(self.x, self.dt, self.u)


def parts_of(
    motion: Motion, sensor: Sensor, belief: Gaussian, dt: float, u: Tensor | None, seed: int
) -> Iterator[Part]:
    """The motion, or all of a bank, and the sensor, near a belief."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(BATCH, motion.size, dtype=torch.float64, generator=generator)
    x = belief.mean + 0.3 * noise @ belief.scale_tril.mT
    seconds = dt * torch.tensor([1.0, 0.5, 1.5], dtype=torch.float64)
    known = None if u is None else u.double().expand(BATCH, -1)
    motions = motion[:] if isinstance(motion, Bank) else [motion]
    for one in motions:
        part = Part(one, "", "", one.forward, one.size, x, seconds, known)
        yield part.method("transition" if one.linear else "forward")
    part = Part(sensor, "", "", lambda x, dt, u: sensor.forward(x, u), sensor.size, x, seconds, known)
    yield part.method("forward")


def shapes(part: Part) -> None:
    """One state, a batch and a batch of batches; and nothing is written into them."""
    for shape in ((), (BATCH,), (2, BATCH)):
        given = f"for states {(*shape, part.x.shape[-1])} and dt {shape}"
        x = (part.x if shape else part.x[0]).expand(*shape, -1).clone()
        dt = (part.dt if shape else part.dt[0]).expand(shape)
        u = part.u if part.u is None else (part.u if shape else part.u[0]).expand(*shape, -1)
        before = x.clone()
        try:
            found = part.function(x, dt, u)
        except Exception as error:
            raise type(error)(f"{given}: {error}") from error
        expect(torch.equal(before, x), "the states that it was given", "as they were", "others, written in place")
        expected = (*shape, part.size)
        expect(isinstance(found, Tensor), given, f"a tensor {expected}", type(found).__name__)
        expect(tuple(found.shape) == expected, given, f"what has the shape {expected}", tuple(found.shape))
        expect(bool(found.isfinite().all()), given, "finite numbers", _rounded(found))


def what_it_reads(part: Part) -> None:
    """A sensor needs only the components that it declares in ``reads``."""
    assert isinstance(part.model, Sensor)
    alone = replace(part, x=part.x[:, : part.model.reads])
    shapes(alone)
    same = torch.allclose(alone.together(), part.together(), rtol=1e-9, atol=1e-9)
    what = f"measurement of the {part.model.reads} components that it reads alone (reads)"
    expect(same, what, f"that of the whole state, {_rounded(part.together())}", _rounded(alone.together()))


def batches(part: Part) -> None:
    """Each entry of a batch, with its own ``dt`` and ``u``, has the result that it has alone."""
    together = part.together()
    for i in range(BATCH):
        u = None if part.u is None else part.u[i]
        alone = part.function(part.x[i], part.dt[i], u)
        same = torch.allclose(alone, together[i], rtol=1e-9, atol=1e-9)
        what = f"state {i} of a batch, with a dt of its own"
        received = f"{_rounded(together[i])}, a difference of {_rounded(together[i] - alone)}"
        expect(same, what, f"what it gives alone, {_rounded(alone)}", received)


def no_time(part: Part) -> None:
    """A ``dt`` of 0, for a second measurement at the same instant.

    Positions stay where they are.  The values of a series, as those of an autoregressive model, are of another kind.
    """
    given = f"for states {tuple(part.x.shape)} and a dt of 0"
    found = part.function(part.x, 0 * part.dt, part.u)
    expect(bool(found.isfinite().all()), given, "finite numbers", _rounded(found))
    if isinstance(part.model, Motion) and part.u is None:
        places = [i for i, kind in enumerate(part.model.kinds) if kind == "position"]
        before, after = part.x[:, places], found[:, places]
        same = torch.allclose(after, before, rtol=1e-9, atol=1e-9)
        hint = f"for a series of values that are no positions, hand kinds={('other',) * part.model.size} to Motion"
        expect(same, f"the position {given} ({hint})", f"as it was, {_rounded(before)}", _rounded(after))


def precision(part: Part) -> None:
    """float32 stays float32, and float64 goes through a network of either."""
    u = None if part.u is None else part.u.float()
    try:
        found = part.function(part.x.float(), part.dt.float(), u).dtype
    except RuntimeError as error:
        weights = any(not isinstance(module, Hyper | Motion | Sensor) for module in part.model.modules())
        how = (
            " (take both: self.network(x.to(weights)).to(x), where weights is one of the network's)" if weights else ""
        )
        raise RuntimeError(f"for states in float32: {error}{how}") from error
    hint = "make tensors in dtype and on the device of x, and read values as self.value(x)"
    expect(found == torch.float32, f"dtype for states in float32 ({hint})", torch.float32, found)


def gradients(part: Part) -> None:
    """Derivatives by the state are finite and agree with finite differences."""
    x = part.x.clone().requires_grad_()
    found = part.function(x, part.dt, part.u)
    detached = "gradients that flow back to the state"
    expect(found.requires_grad, "gradient", detached, "none: something is detached, or made of numbers")
    weight = torch.linspace(1.0, 2.0, part.size, dtype=torch.float64)
    (slope,) = torch.autograd.grad((found * weight).sum(), x)
    expect(bool(slope.isfinite().all()), "gradient", "finite numbers", _rounded(slope))
    for i in range(part.x.shape[-1]):
        step = torch.zeros_like(part.x)
        step[:, i] = 1e-5 * part.x[:, i].abs().clamp_min(1.0)
        high, low = (part.function(part.x + sign * step, part.dt, part.u) for sign in (1, -1))
        gap, received = (high - low) @ weight / (2 * step[:, i]), slope[:, i]
        rounding = 1e-15 * (high.abs() @ weight) / step[:, i]
        near = (gap - received).abs() <= 1e-4 * gap.abs() + 1e-5 * slope.abs().max().clamp_min(1.0) + rounding
        what, expected = f"gradient with respect to component {i}", f"{_rounded(gap)} by small differences"
        expect(bool(near.all()), what, expected, _rounded(received))


def vmap(part: Part) -> None:
    """``torch.func.vmap`` gives what the batch gives."""
    mapped = torch.func.vmap(part.function, in_dims=(0, 0, None if part.u is None else 0))(part.x, part.dt, part.u)
    same = torch.allclose(mapped, part.together(), rtol=1e-9, atol=1e-9)
    expect(same, "vmap over a batch", "what the batch gives", "something else")


def process_noise(part: Part) -> None:
    """A motion's process noise is a root ``(..., n, r)`` for a scalar ``dt``, for steps and for steps of tracks."""
    motion, n = part.model, part.x.shape[-1]
    assert isinstance(motion, Motion)
    for seconds, shape in ((part.dt[0], ()), (part.dt[0], (5,)), (part.dt[0], (5, BATCH)), (0 * part.dt[0], ())):
        given = f"for dt {shape}" if seconds else "for a dt of 0"
        try:
            u = None if part.u is None else part.u[0].expand(*shape, -1)
            root = motion.process_noise_by(seconds.expand(shape), u)
        except Exception as error:
            raise type(error)(f"{given}: {error}") from error
        fits = root.dim() >= 2 and root.shape[-2] == n and root.shape[:-2] in (shape, ())
        expect(fits, given, f"a root {(*shape, n, 'r')}", tuple(root.shape))
        expect(bool(root.isfinite().all()), given, "finite numbers", _rounded(root))


def process_noise_at(part: Part) -> None:
    """The process noise of a nonlinear motion at predicted means is such a root as well."""
    motion, n = part.model, part.x.shape[-1]
    assert isinstance(motion, Motion)
    if not motion.linear:
        root = motion.process_noise_at(motion.process_noise_by(part.dt, part.u), part.x, part.dt)
        fits = root.dim() >= 2 and root.shape[-2] == n
        expect(fits, f"for means {tuple(part.x.shape)}", f"roots ({BATCH}, {n}, r)", tuple(root.shape))
        expect(bool(root.isfinite().all()), f"for means {tuple(part.x.shape)}", "finite numbers", _rounded(root))


def linearity(part: Part) -> None:
    """A model that is declared linear is linear."""
    if not part.model.linear:
        return
    still = 0 * part.x
    offset = part.function(still, part.dt, part.u)
    if isinstance(part.model, Sensor):
        expect(
            not bool(offset.any()), "measurement of the state 0, of a sensor with linear = True", 0, _rounded(offset)
        )
    double = part.function(2 * part.x, part.dt, part.u) - offset
    same = torch.allclose(double, 2 * (part.together() - offset), rtol=1e-9, atol=1e-9)
    expect(same, "twice a state, as linear is True", "twice what it gives", "something else")


def checks_of(part: Part) -> Iterator[tuple[Callable[[Part], None], Part]]:
    """Checks in their order, each with the part on which it runs."""
    for check in (shapes, batches, precision, linearity, gradients, vmap):
        yield check, part
    if isinstance(part.model, Sensor):
        yield what_it_reads, part
        yield angles, part
    else:
        yield angles_of_states, part
        yield process_noise, part.method("process_noise")
        yield process_noise_at, part.method("process_noise_at")
    yield no_time, part


def _rounded(x: Tensor) -> str:
    """Numbers in a few digits."""
    return "[" + ", ".join(f"{v:.4g}" for v in x.detach().flatten()[:8].tolist()) + ", ..." * (x.numel() > 8) + "]"


def angles(part: Part) -> None:
    """Elements of a sensor that jump by a turn while the target circles are declared as angles, in rad."""
    sensor, x = part.model, part.x[:1]
    assert isinstance(sensor, Sensor)
    if sensor.reads < 2:
        return
    turn = torch.linspace(0, 2 * math.pi, 721, dtype=torch.float64)
    u = None if part.u is None else part.u[:1].expand(len(turn), -1)
    for radius in CIRCLES:
        circle = radius * torch.stack([turn.cos(), turn.sin()], -1)
        round_about = torch.cat([circle, x[:, 2:].expand(len(turn), -1)], -1)
        measured = part.function(round_about, part.dt[:1].expand(len(turn)), u)
        for i, declared in enumerate(sensor.angles.tolist()):
            what = f"element {i} of a measurement, of a target that goes round"
            for size, unit in UNITS:
                right = not _jumps(measured[:, i], size) or (declared and unit == "rad")
                expect(right, what, "an angle in rad, declared in angles=", f"a jump by a turn in {unit}")


def angles_of_states(part: Part) -> None:
    """Components of a motion that it keeps within one turn are declared as angles, in rad."""
    motion = part.model
    assert isinstance(motion, Motion)
    u = None if part.u is None else part.u[:1]
    for i in range(motion.size):
        for size, unit in UNITS:
            x = part.x[:1].repeat(721, 1)
            x[:, i] = torch.linspace(-size, size, 721, dtype=torch.float64)
            moved = part.function(x, part.dt[:1].expand(721), None if u is None else u.expand(721, -1))[:, i]
            right = not _jumps(moved, size) or (i in motion.angles and unit == "rad")
            what = f"component {i}, {motion.components[i]!r}, of a state that goes round"
            expect(right, what, "an angle in rad, declared in angles=", f"a jump by a turn in {unit}")


def _jumps(values: Tensor, size: float) -> bool:
    """Whether successive values are near each other except for jumps by a turn."""
    gaps = values.diff().abs()
    jumps = (gaps - size).abs() < 0.01 * size
    return bool(jumps.any()) and bool((gaps[~jumps] < 0.2 * size).all())
