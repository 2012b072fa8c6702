"""Several motions in one state: that of a target, and of biases or clocks that drift beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfra.linalg.batches import joined
from torchfra.linalg.triangular import block_diagonal
from torchfra.motion.base import Adaptation, Motion


class Augmented(Motion):
    """Several independent motions with their states one behind the other.

    ``Augmented(ConstantVelocity(1.0), RandomWalk(0.01, 1, kind="bias"))`` has the state ``[x, y, vx, vy, bias]``.
    Position, velocity and dimensions of space are those of the first motion.  It is linear if all motions are; all get
    the same ``dt`` and ``u``.

    Args:
        motion: of the target.
        others: motions of biases, clocks and the like.

    Raises:
        ValueError: no other motions, a bank (take a bank of augmented motions instead), or a motion other than the
            first that adapts to an estimated acceleration.
    """

    def __init__(self, motion: Motion, *others: Motion) -> None:
        parts = [motion, *others]
        if not others or not all(isinstance(part, Motion) and not part.stacked for part in parts):
            received = ", ".join(type(part).__name__ for part in parts)
            raise ValueError(f"others: expected motions beside the first, none of them a Bank, received {received}")
        if any(type(part).adaptation is not Motion.adaptation for part in others):
            raise ValueError("others: expected none that adapts to an estimated acceleration: put such a motion first")
        starts = [sum(part.size for part in parts[:i]) for i in range(len(parts) + 1)]
        super().__init__(
            motion.dims, motion.orders, None, size=starts[-1], position=motion.position, velocity=motion.velocity,
            angles=[start + i for start, part in zip(starts, parts, strict=False) for i in part.angles],
            components=_different([name for part in parts for name in part.components]),
            kinds=[kind for part in parts for kind in part.kinds],
        )  # fmt: skip
        self.stated = tuple(kind for part in parts for kind in part.stated)
        self.parts, self._sizes = nn.ModuleList(parts), [part.size for part in parts]
        self.order: tuple[int, ...] | None = None
        """Which component of the motions, one behind the other, each component of the state is; None if the same."""

    @property
    def linear(self) -> bool:  # type: ignore[override]  # of these motions, not of the class
        """Whether all motions are linear."""
        return all(part.linear for part in self._parts)

    @property
    def measures_itself(self) -> bool:  # type: ignore[override]  # of these motions, not of the class
        """Whether the first motion measures itself."""
        return self._parts[0].measures_itself

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., n)`` after ``dt (...)`` seconds, without process noise."""
        return self._each(lambda part, own: part(own, dt, u), x)

    def at_points(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``forward`` for points ``(p, ..., n)`` of one step: linear motions compute their transition once."""
        return self._each(lambda part, own: part.at_points(own, dt, u), x)

    def transition(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``F (..., n, n)``, a block for each motion, if all are linear."""
        blocks = block_diagonal([part.transition_by(dt, u) for part in self._parts])
        return self._ordered(self._ordered(blocks, -2))

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """Known changes of the state ``(..., n)``; None if no motion has any."""
        parts = [part.shift(dt, u) for part in self._parts]
        if all(part is None for part in parts):
            return None
        shifts = [dt.new_zeros(n) if part is None else part for n, part in zip(self._sizes, parts, strict=True)]
        return self._ordered(joined(shifts))

    def adaptation(self, dt: Tensor) -> Adaptation | None:
        """The adaptation of the first motion; the other motions have none."""
        own = self._parts[0].adaptation(dt)
        return own and own._replace(response=pad(own.response, (0, 0, 0, self.size - self._sizes[0])))

    def process_noise(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``S_Q (..., n, r)``, a block for each motion."""
        return self._ordered(block_diagonal([part.process_noise_by(dt, u) for part in self._parts]), -2)

    def process_noise_at(self, process_noise: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        """``S_Q (..., n, r)`` at a predicted mean ``(..., n)``."""
        given = self._apart(process_noise, -2)  # of noise that depends on u, which is not known here
        roots = [
            own if "process_noise" in part.by_inputs else part.process_noise(dt)
            for part, own in zip(self._parts, given, strict=True)
        ]
        parts = zip(self._parts, roots, self._apart(mean), strict=True)
        each = [root if part.linear else part.process_noise_at(root, own, dt) for part, root, own in parts]
        return self._ordered(block_diagonal(each), -2)

    def canonical(self, mean: Tensor) -> Tensor:
        """The state ``(..., n)`` with its angles in the range that each motion uses."""
        return self._each(lambda part, own: part.canonical(own), mean)

    def describe(self) -> str:
        """The descriptions of all motions."""
        return " with ".join(part.describe() for part in self._parts)

    def _each(self, function: Callable[[Motion, Tensor], Tensor], x: Tensor) -> Tensor:
        """Values ``(..., n)`` of a function of each motion and its components of states ``x (..., n)``."""
        return self._ordered(joined([function(*own) for own in zip(self._parts, self._apart(x), strict=True)]))

    def _apart(self, x: Tensor, axis: int = -1) -> tuple[Tensor, ...]:
        """The entries of each motion along an axis of the state's components."""
        if self.order is not None:
            x = torch.stack([x.select(axis, self.order.index(i)) for i in range(self.size)], axis)
        parts: tuple[Tensor, ...] = x.split(self._sizes, axis)
        return parts

    def _ordered(self, x: Tensor, axis: int = -1) -> Tensor:
        """The entries of all motions, one behind the other, in the order of the state's components."""
        return x if self.order is None else torch.stack([x.select(axis, i) for i in self.order], axis)

    @property
    def _parts(self) -> list[Motion]:
        return list(self.parts)  # type: ignore[arg-type]  # a ModuleList does not know what it holds


def _different(names: Sequence[str]) -> list[str]:
    """The names, with numbers behind repeated ones."""
    return [name if name not in names[:i] else f"{name} ({names[:i].count(name) + 1})" for i, name in enumerate(names)]
