"""Motions in the plane at a nearly constant height, such as those of cars and ships that satellites locate."""

from __future__ import annotations

from torchfra.hyper import Value
from torchfra.motion.augmented import Augmented
from torchfra.motion.base import Motion
from torchfra.motion.walks import RandomWalk


class Level(Augmented):
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
        super().__init__(motion, RandomWalk(height, 1, components=("height",)))
        self.order = order = (0, 1, motion.size, *range(2, motion.size))
        self.dims, self.orders, self.position, self.velocity = 3, 1, slice(0, 3), slice(0, 0)
        self.angles = tuple(order.index(i) for i in self.angles)
        self.components, self.kinds, self.stated = (
            tuple(names[i] for i in order) for names in (self.components, self.kinds, self.stated)
        )

    def describe(self) -> str:
        """The description of the motion in the plane, "at a level"."""
        return f"{self._parts[0].describe()} at a level"
