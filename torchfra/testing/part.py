"""A motion or a sensor by itself, and where to try it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.testing.lines import line_of_method
from torchfra.types import Gaussian

BATCH = 3


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
