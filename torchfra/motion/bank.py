"""Several motions of one state side by side, and motions of a smaller state in a larger one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import overload

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfra.hyper import Value
from torchfra.motion.base import Adaptation, Motion
from torchfra.motion.correlated import CurrentStatistical
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.motion.turn import CoordinatedTurn


class Bank(Motion):
    """Motions that interacting models share out among them: matrices have an axis for the model, ``(..., K, n, n)``.

    Args:
        models: motions of the same state, linear all or none.
        neighbours: for each model those that its success calls, by number, where only a few run at a time
            (``filters.VSIMM``).
        first: the models that run first there.

    Raises:
        ValueError: none at all, states that differ, or states with angles.
    """

    stacked = 1

    def __init__(
        self,
        models: Sequence[Motion],
        *,
        neighbours: Sequence[Sequence[int]] | None = None,
        first: Sequence[int] | None = None,
    ) -> None:
        sizes = {(m.dims, m.orders) for m in models}
        if len(sizes) != 1:
            said = ", ".join(f"{type(m).__name__} of {m.size}" for m in models) or "none"
            raise ValueError(f"models: expected motions of one state (see orders= and Embedded), received {said}")
        if any(m.angles for m in models):
            raise ValueError("models: expected motions whose states mix, received one whose state has angles")
        super().__init__(*sizes.pop(), None)
        self.models = nn.ModuleList(models)
        self.neighbours, self.first = neighbours, first

    def __len__(self) -> int:
        return len(self.models)

    @overload
    def __getitem__(self, index: int) -> Motion: ...
    @overload
    def __getitem__(self, index: slice) -> list[Motion]: ...
    def __getitem__(self, index: int | slice) -> Motion | list[Motion]:
        return self._motions[index]

    @property
    def names(self) -> list[str]:
        """Of the models, for people."""
        return [model.describe() for model in self._motions]

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """States ``(..., K, p, n)``, each with the model of its place, after ``dt (..., 1, 1)`` or ``(1,)`` seconds."""
        dt = dt.select(-2, 0) if dt.dim() > 1 else dt
        u = u if u is None or u.dim() < 3 else u.select(-3, 0)
        return torch.stack([model(x.select(-3, k), dt, u) for k, model in enumerate(self._motions)], -3)

    def transition(self, dt: Tensor) -> Tensor | None:
        """``F (..., K, n, n)`` for ``dt (...)`` if all motions are linear."""
        parts = [model.transition(dt) for model in self._motions]
        known = [part for part in parts if part is not None]
        return _stacked(known, -3) if len(known) == len(parts) else None

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """Known changes of the state, ``(..., K, n)``."""
        parts = [model.shift(dt, u) for model in self._motions]
        if all(part is None for part in parts):
            return None
        return _stacked([dt.new_zeros(self.size) if part is None else part for part in parts], -2)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., K, n, q)``, filled up with zeros to the widest."""
        parts = [model.process_noise(dt) for model in self._motions]
        wide = max(part.shape[-1] for part in parts)
        return _stacked([pad(part, (0, wide - part.shape[-1])) for part in parts], -3)

    def adaptation(self, dt: Tensor) -> Adaptation | None:
        """See ``Motion``, ``(..., K, ...)``; nothing for those that do not follow."""
        parts = [model.adaptation(dt) for model in self._motions]
        if all(part is None for part in parts):
            return None
        one = dt.new_ones(2)
        nothing = Adaptation(dt.new_zeros(self.size, self.dims), one, 0 * one)
        columns = zip(*(nothing if part is None else part for part in parts), strict=True)
        return Adaptation(*(_stacked(column, place) for column, place in zip(columns, (-3, -2, -2), strict=True)))

    @property
    def _motions(self) -> list[Motion]:
        return list(self.models)  # type: ignore[arg-type]  # a ModuleList does not know what it holds


class Embedded(Motion):
    """A motion of a smaller state as one of a larger: taken out, moved on, and put back.

    Args:
        motion: linear.
        out: ``(k, n)`` from the larger state to the motion's own.
        into: ``(n, k)`` back; what it does not reach is 0 after a step.
        orders: of the larger state.

    Raises:
        ValueError: shapes that do not fit, or a motion that is not linear.
    """

    out: Tensor
    into: Tensor

    def __init__(self, motion: Motion, out: Tensor, into: Tensor, orders: int) -> None:
        super().__init__(motion.dims, orders, None)
        k, n = motion.size, self.size
        if out.shape != (k, n) or into.shape != (n, k):
            raise ValueError(
                f"out, into: expected ({k}, {n}) and ({n}, {k}), received {tuple(out.shape)} and {tuple(into.shape)}"
            )
        if motion.transition(torch.ones((), dtype=torch.float64)) is None:
            raise ValueError(f"motion: expected a linear one, received {type(motion).__name__}")
        self.inside = motion
        self.register_buffer("out", out)
        self.register_buffer("into", into)

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        matrix = self.inside.transition(dt)
        assert matrix is not None
        return self.into.to(dt) @ matrix @ self.out.to(dt)

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """See ``Motion``."""
        own = self.inside.shift(dt, u)
        return None if own is None else (self.into.to(dt) @ own.unsqueeze(-1)).squeeze(-1)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, q)`` for ``dt (...)``."""
        return self.into.to(dt) @ self.inside.process_noise(dt)


def aircraft(q: Value = 4.0, dims: int = 2) -> Bank:
    """Seven motions for aircraft and gliders: straight on, accelerating, turns of 3 and 12 deg/s to both sides.

    The current statistical model, of up to 1 g, stands for all that the others are not.  Four run at a time where only
    some do (``presets.vsimm_srckf``).

    Args:
        q: variance of the noise acceleration, m^2/s^4; straight flight has a fortieth.
        dims: dimensions of space.
    """
    turns = [CoordinatedTurn(math.radians(side * rate), q, dims, orders=3) for rate in (3.0, 12.0) for side in (1, -1)]
    models = [
        ConstantVelocity(q / 40, dims, orders=3),
        ConstantAcceleration(q, dims),
        CurrentStatistical(1 / 20, 9.8, dims=dims),
        *turns,
    ]
    neighbours = ((2, 3, 4), (2, 0), (3, 4, 1), (5, 2, 0), (6, 2, 0), (3, 2), (4, 2))
    return Bank(models, neighbours=neighbours, first=(0, 2, 3, 4))


def _stacked(parts: Sequence[Tensor], place: int) -> Tensor:
    """Side by side at ``place``, batches broadcast."""
    event = -place - 1
    batch = torch.broadcast_shapes(*(part.shape[: part.dim() - event] for part in parts))
    return torch.stack([part.expand(batch + part.shape[part.dim() - event :]) for part in parts], place)
