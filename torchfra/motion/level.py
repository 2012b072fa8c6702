"""Motions in the plane at a nearly constant height, such as those of cars and ships that satellites locate."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.hyper import Value
from torchfra.motion.augmented import Augmented
from torchfra.motion.base import Motion
from torchfra.motion.walks import RandomWalk


class Level(Motion):
    """A motion in the plane, and a height that is a random walk: states ``[x, y, height, ...]``.

    The other components of the motion follow the height.  So sensors in space, such as ``Pseudoranges``, can measure a
    target that does not climb.

    Args:
        motion: in the plane, with ``x`` and ``y`` as its first components.
        height: density of the random walk, its variance per second, m^2/s.

    Raises:
        ValueError: a bank (take a bank of these instead), a motion that is not in the plane or adapts to an estimated
            acceleration, ``height`` below 0.
    """

    def __init__(self, motion: Motion, height: Value) -> None:
        if motion.stacked or motion.dims != 2 or motion.position != slice(0, 2):
            expected = "a motion in the plane, with its position in front"
            raise ValueError(f"motion: expected {expected}, received {type(motion).__name__}")
        if type(motion).adaptation is not Motion.adaptation:
            expected = "one that does not adapt to an estimated acceleration"
            raise ValueError(f"motion: expected {expected}, received {type(motion).__name__}")
        inside = Augmented(motion, RandomWalk(height, 1, components=("height",)))
        self.order = (0, 1, motion.size, *range(2, motion.size))
        """The index of each component in ``inside``."""
        super().__init__(
            3, 1, None, size=inside.size, velocity=slice(0, 0),
            angles=[self.order.index(i) for i in inside.angles],
            components=[inside.components[i] for i in self.order], kinds=[inside.kinds[i] for i in self.order],
        )  # fmt: skip
        self.stated = tuple(inside.stated[i] for i in self.order)
        self.inside = inside
        self.back = tuple(self.order.index(i) for i in range(self.size))

    @property
    def linear(self) -> bool:  # type: ignore[override]  # of this motion, not of the class
        """Whether the motion in the plane is linear."""
        return self.inside.linear

    @property
    def measures_itself(self) -> bool:  # type: ignore[override]  # of this motion, not of the class
        """Whether the motion in the plane measures itself."""
        return self.inside.measures_itself

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., n)`` after ``dt (...)`` seconds, without process noise."""
        return _chosen(self.inside(_chosen(x, self.back), dt, u), self.order)

    def transition(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``F (..., n, n)``, if the motion in the plane is linear."""
        return _chosen(_chosen(self.inside.transition_by(dt, u), self.order, -2), self.order)

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """Known changes of the state ``(..., n)``; None if there are none."""
        shift = self.inside.shift(dt, u)
        return None if shift is None else _chosen(shift, self.order)

    def process_noise(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``S_Q (..., n, r)``."""
        return _chosen(self.inside.process_noise_by(dt, u), self.order, -2)

    def process_noise_at(self, process_noise: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        """``S_Q (..., n, r)`` at a predicted mean ``(..., n)``."""
        inside = _chosen(process_noise, self.back, -2)
        return _chosen(self.inside.process_noise_at(inside, _chosen(mean, self.back), dt), self.order, -2)

    def canonical(self, mean: Tensor) -> Tensor:
        """The state ``(..., n)`` with its angles in the range that the motion in the plane uses."""
        return _chosen(self.inside.canonical(_chosen(mean, self.back)), self.order)

    def describe(self) -> str:
        """The description of the motion in the plane, "at a level"."""
        return f"{self.inside.parts[0].describe()} at a level"  # type: ignore[operator]


def _chosen(x: Tensor, order: tuple[int, ...], axis: int = -1) -> Tensor:
    """The entries of ``x`` along an axis in another order."""
    return torch.stack([x.select(axis, i) for i in order], axis)
