"""Checks of a motion or of a sensor by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.testing.expectations import expect
from torchfra.testing.lines import line_of_method
from torchfra.types import Gaussian

BATCH = 3


@dataclass(frozen=True)
class Part:
    """A motion or a sensor, as a function of states, seconds and ``u``, with some of these."""

    model: Motion | Sensor
    name: str
    """``Drag.forward``, say."""
    line: str
    """Where that is written."""
    function: Callable[[Tensor, Tensor, Tensor | None], Tensor]
    size: int
    """Components of what it gives."""
    x: Tensor
    """``(3, n)``."""
    dt: Tensor
    """``(3,)``."""
    u: Tensor | None
    """``(3, k)``."""

    def __call__(self, *shape: int) -> Tensor:
        """What it gives for a batch of this shape, of which the last dimension is 3, or for a single state."""
        x, dt = (self.x, self.dt) if shape else (self.x[0], self.dt[0])
        u = self.u if self.u is None or shape else self.u[0]
        return self.function(x.expand(*shape, -1), dt.expand(shape), u if u is None else u.expand(*shape, -1))


def parts_of(
    motion: Motion, sensor: Sensor, belief: Gaussian, dt: float, u: Tensor | None, seed: int
) -> Iterator[Part]:
    """The motion, or all of a bank, and the sensor, near a belief."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(BATCH, motion.size, dtype=torch.float64, generator=generator)
    x = belief.mean + 0.3 * noise @ belief.scale_tril.mT
    seconds = dt * torch.tensor([1.0, 0.5, 1.5], dtype=torch.float64)
    known = None if u is None else u.double().expand(BATCH, -1)
    motions = list(motion) if motion.stacked else [motion]  # type: ignore[call-overload]  # a bank
    for one in motions:
        method = type(one).transition if one.linear else type(one).forward
        name = f"{type(one).__name__}.{method.__name__}"
        yield Part(one, name, line_of_method(method), one.forward, one.size, x, seconds, known)
    method = type(sensor).forward
    name, line = f"{type(sensor).__name__}.forward", line_of_method(method)
    yield Part(sensor, name, line, lambda x, dt, u: sensor.forward(x, u), sensor.size, x, seconds, known)


def shapes(part: Part) -> None:
    """One state, a batch and a batch of batches; and nothing is written into them."""
    before = part.x.clone()
    for shape in ((), (BATCH,), (2, BATCH)):
        given = f"for states {(*shape, part.x.shape[-1])} and dt {shape}"
        try:
            found = part(*shape)
        except Exception as error:
            raise type(error)(f"{given}: {error}") from error
        expected = (*shape, part.size)
        expect(tuple(found.shape) == expected, given, f"what has the shape {expected}", tuple(found.shape))
        expect(bool(found.isfinite().all()), given, "finite numbers", found.tolist())
    expect(torch.equal(before, part.x), "the states that it was given", "as they were", "others, written in place")


def batches(part: Part) -> None:
    """Each entry of a batch, with its own ``dt`` and ``u``, gives what it gives alone."""
    together = part(BATCH)
    for i in range(BATCH):
        u = None if part.u is None else part.u[i]
        alone = part.function(part.x[i], part.dt[i], u)
        same = torch.allclose(alone, together[i], rtol=1e-9, atol=1e-9)
        what = f"state {i} of a batch, with a dt of its own"
        expect(same, what, f"what it gives alone, {_rounded(alone)}", _rounded(together[i]))


def precision(part: Part) -> None:
    """float32 stays float32."""
    u = None if part.u is None else part.u.float()
    found = part.function(part.x.float(), part.dt.float(), u).dtype
    hint = "make tensors in dtype and on the device of x, and read values as self.value(x)"
    expect(found == torch.float32, f"dtype for states in float32 ({hint})", torch.float32, found)


def gradients(part: Part) -> None:
    """Of what it gives, with respect to the state: finite, and those of small differences."""
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
        ends = (part.function(part.x + sign * step, part.dt, part.u) for sign in (1, -1))
        high, low = ends
        gap = (high - low) @ weight / (2 * step[:, i])
        near = torch.allclose(slope[:, i], gap, rtol=1e-4, atol=1e-5 * float(slope.abs().max().clamp_min(1.0)))
        expect(
            near,
            f"gradient with respect to component {i}",
            f"{_rounded(gap)} by small differences",
            _rounded(slope[:, i]),
        )


def vmap(part: Part) -> None:
    """``torch.func.vmap`` gives what the batch gives."""
    mapped = torch.func.vmap(part.function, in_dims=(0, 0, None if part.u is None else 0))(part.x, part.dt, part.u)
    same = torch.allclose(mapped, part(BATCH), rtol=1e-9, atol=1e-9)
    expect(same, "vmap over a batch", "what the batch gives", "something else")


def process_noise(part: Part) -> None:
    """Of a motion: a root ``(..., n, r)`` for a ``dt`` without dimensions, for steps and for steps of tracks."""
    motion, n = part.model, part.x.shape[-1]
    assert isinstance(motion, Motion)
    for shape in ((), (5,), (5, BATCH)):
        dt = part.dt[0].expand(shape)
        root = motion.process_noise(dt)
        what = f"{type(motion).__name__}.process_noise for dt {shape}"
        fits = root.dim() >= 2 and root.shape[-2] == n and root.shape[:-2] in (shape, ())
        expect(fits, what, f"a root {(*shape, n, 'r')}", tuple(root.shape))
        expect(bool(root.isfinite().all()), what, "finite numbers", _rounded(root))
    if not motion.linear:
        root = motion.process_noise_at(motion.process_noise(part.dt), part.x, part.dt)
        what, fits = f"{type(motion).__name__}.process_noise_at", root.dim() >= 2 and root.shape[-2] == n
        expect(fits and bool(root.isfinite().all()), what, f"finite roots ({BATCH}, {n}, r)", tuple(root.shape))


def linearity(part: Part) -> None:
    """What is declared linear is."""
    if not part.model.linear:
        return
    still = 0 * part.x
    offset = part.function(still, part.dt, part.u)
    if isinstance(part.model, Sensor):
        expect(
            not bool(offset.any()), "measurement of the state 0, of a sensor with linear = True", 0, _rounded(offset)
        )
    double = part.function(2 * part.x, part.dt, part.u) - offset
    same = torch.allclose(double, 2 * (part(BATCH) - offset), rtol=1e-9, atol=1e-9)
    expect(same, "twice a state, as linear is True", "twice what it gives", "something else")


def angles(part: Part) -> None:
    """Of a sensor: elements that jump by a turn where the target goes round are declared as angles, in rad."""
    sensor, x = part.model, part.x[:1]
    assert isinstance(sensor, Sensor)
    if sensor.reads < 2:
        return
    turn = torch.linspace(0, 2 * math.pi, 721, dtype=torch.float64)
    circle = 1e4 * torch.stack([turn.cos(), turn.sin()], -1)
    round_about = torch.cat([circle, x[:, 2:].expand(len(turn), -1)], -1)
    u = None if part.u is None else part.u[:1].expand(len(turn), -1)
    jumps = part.function(round_about, part.dt[:1].expand(len(turn)), u).diff(dim=0).abs()
    for i, declared in enumerate(sensor.angles.tolist()):
        what = f"element {i} of a measurement, of a target that goes round"
        for size, unit in ((2 * math.pi, "rad"), (360.0, "degrees")):
            jumped = bool(((jumps[:, i] - size).abs() < 0.01 * size).any()) and jumps[:, i].median() < 0.01 * size
            right = not jumped or (declared and unit == "rad")
            expect(right, what, "an angle in rad, declared in angles=", f"a jump by a turn in {unit}")


CHECKS_OF_BOTH: tuple[Callable[[Part], None], ...] = (shapes, batches, precision, linearity, gradients, vmap)
CHECKS_OF_MOTIONS: tuple[Callable[[Part], None], ...] = (process_noise,)
CHECKS_OF_SENSORS: tuple[Callable[[Part], None], ...] = (angles,)


def _rounded(x: Tensor) -> str:
    """Numbers in a few digits."""
    return "[" + ", ".join(f"{v:.4g}" for v in x.detach().flatten()[:8].tolist()) + ", ..." * (x.numel() > 8) + "]"
