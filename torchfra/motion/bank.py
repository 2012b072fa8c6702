"""Several motions of the same state side by side, and motions of a smaller state in a larger one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import overload

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfra import tree
from torchfra.hyper import Value
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.triangular import apply
from torchfra.motion.base import Adaptation, Motion
from torchfra.motion.correlated import CurrentStatistical
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.motion.turn import CoordinatedTurn


class Bank(Motion):
    """Motions of the same state for interacting models: its results have a dimension of ``K`` models before the state.

    It is linear if all of them are.

    Args:
        models: motions of the same state: of the same size and angles, and of kinds that do not contradict each other.
        neighbours: for each model the indices of those that become active when it is likely, for filters in which a few
            models are active at a time (``filters.LikelyModels``).
        first: the indices of the models that are active first in such a filter.

    Raises:
        ValueError: no models, or states that differ.
    """

    stacked = 1

    def __init__(
        self,
        models: Sequence[Motion],
        *,
        neighbours: Sequence[Sequence[int]] | None = None,
        first: Sequence[int] | None = None,
    ) -> None:
        states = {(m.dims, m.orders, m.size, tuple(m.angles)) for m in models}
        if len(states) != 1 or not all(_agree(models[0].kinds, m.kinds) for m in models):
            received = "; ".join(f"{type(m).__name__} of [{', '.join(m.components)}]" for m in models) or "none"
            raise ValueError(f"models: expected motions of one state (see orders= and Embedded), received {received}")
        like = models[0]
        super().__init__(
            like.dims, like.orders, None, size=like.size, position=like.position, velocity=like.velocity,
            angles=like.angles, components=like.components, kinds=like.kinds,
        )  # fmt: skip
        self.stated = like.stated
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
    def measures_itself(self) -> bool:  # type: ignore[override]  # of these models, not of the class
        """Whether all models measure themselves."""
        return all(model.measures_itself for model in self._motions)

    @property
    def linear(self) -> bool:  # type: ignore[override]  # of these models, not of the class
        """Whether all models are linear."""
        return all(model.linear for model in self._motions)

    @property
    def names(self) -> list[str]:
        """Names of the models, for tables and pictures."""
        return [model.describe() for model in self._motions]

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """States ``(..., K, n)`` after ``dt (..., K)`` seconds, each by its own model, with inputs ``u (..., K, k)``.

        Raises:
            ValueError: the states have no dimension of models; ``bank[k]`` is the motion of a single one.
        """
        if x.dim() < 2 or x.shape[-2] != len(self):
            raise ValueError(f"x: expected states (..., {len(self)}, {self.size}), received {tuple(x.shape)}")
        dt, u = dt.expand(x.shape[:-1]), u if u is None else u.expand(*x.shape[:-1], -1)
        moved = [
            model(x.select(-2, k), dt.select(-1, k), u if u is None else u.select(-2, k))
            for k, model in enumerate(self._motions)
        ]
        return torch.stack(moved, -2)

    def at_points(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``forward`` for points ``x (p, ..., K, n)`` of one step, with ``dt (..., 1)`` and ``u (..., 1, k)``.

        All models have the same ``dt`` and ``u``, so a linear model computes its transition once for all points.
        """
        dt = dt.select(-1, 0) if dt.dim() else dt
        u = u if u is None or u.dim() < 2 else u.select(-2, 0)
        return torch.stack([model.at_points(x.select(-2, k), dt, u) for k, model in enumerate(self._motions)], -2)

    def transition(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``F (..., K, n, n)`` for ``dt (...)``, if all motions are linear."""
        return _stack([model.transition_by(dt, u) for model in self._motions], 2)

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """Known changes of the state, ``(..., K, n)``; None if no model has any."""
        parts = [model.shift(dt, u) for model in self._motions]
        if all(part is None for part in parts):
            return None
        return _stack([dt.new_zeros(self.size) if part is None else part for part in parts], 1)

    def process_noise(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``S_Q (..., K, n, r)``, padded with zeros to the widest."""
        return _stack(_as_wide([model.process_noise_by(dt, u) for model in self._motions]), 2)

    def process_noise_at(self, process_noise: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        """``S_Q (..., K, n, r)`` at predicted means ``(..., K, n)``, of models that are not linear."""
        if all(m.linear or type(m).process_noise_at is Motion.process_noise_at for m in self._motions):
            return process_noise
        dt = dt.expand(mean.shape[:-1])
        process_noise = process_noise.expand(*mean.shape[:-1], *process_noise.shape[-2:])
        parts = [
            root if m.linear else m.process_noise_at(root, mean.select(-2, k), dt.select(-1, k))
            for k, (m, root) in enumerate(zip(self._motions, process_noise.unbind(-3), strict=True))
        ]
        return _stack(_as_wide(parts), 2)

    def canonical(self, mean: Tensor) -> Tensor:
        """States ``(..., n)`` with their angles in the range that the first model uses."""
        first: Motion = self.models[0]  # type: ignore[assignment]  # a ModuleList does not know what it holds
        return first.canonical(mean)

    def adaptation(self, dt: Tensor) -> Adaptation | None:
        """The adaptation of each model, ``(..., K, ...)``, with zero response for a model without one."""
        parts = [model.adaptation(dt) for model in self._motions]
        if all(part is None for part in parts):
            return None
        one = dt.new_ones(2)
        none = Adaptation(dt.new_zeros(self.size, self.dims), one, 0 * one)
        first, *others = (none if part is None else part for part in parts)
        return tree.map_ranked(lambda rank, *xs: _stack(xs, rank), first, *others)

    @property
    def _motions(self) -> list[Motion]:
        return list(self.models)  # type: ignore[arg-type]  # a ModuleList does not know what it holds


class Embedded(Motion):
    """A linear motion of a smaller state as a motion of a larger state: ``into F out``.

    Args:
        motion: linear, of ``k`` components.
        out: ``(k, n)`` matrix from the larger state to the smaller one.
        into: ``(n, k)`` matrix from the smaller state to the larger one; components outside its range are 0 after a
            step.
        orders: derivatives in the larger state, which has ``n = motion.dims * orders`` components.

    Raises:
        ValueError: shapes that do not fit, or a motion that is not linear or adapts to an estimated acceleration.
    """

    linear = usual_layout = True
    out: Tensor
    into: Tensor

    def __init__(self, motion: Motion, out: Tensor, into: Tensor, orders: int) -> None:
        super().__init__(motion.dims, orders, None)
        k, n = motion.size, self.size
        if out.shape != (k, n) or into.shape != (n, k):
            raise ValueError(
                f"out, into: expected ({k}, {n}) and ({n}, {k}), received {tuple(out.shape)} and {tuple(into.shape)}"
            )
        if not motion.linear:
            raise ValueError(f"motion: expected a linear one, received {type(motion).__name__}")
        if type(motion).adaptation is not Motion.adaptation:
            expected = "one that does not adapt to an estimated acceleration"
            raise ValueError(f"motion: expected {expected}, received {type(motion).__name__}")
        self.inside = motion
        self.register_buffer("out", out)
        self.register_buffer("into", into)

    def transition(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        return self.into.to(dt) @ self.inside.transition_by(dt, u) @ self.out.to(dt)

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """The known change ``(..., n)`` of the larger state: that of the smaller one times ``into``."""
        shift = self.inside.shift(dt, u)
        return None if shift is None else apply(self.into.to(dt), shift)

    def process_noise(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``S_Q (..., n, r)`` for ``dt (...)``."""
        return self.into.to(dt) @ self.inside.process_noise_by(dt, u)


def aircraft(q: Value = 4.0, dims: int = 2, *, continuous: bool = False) -> Bank:
    """Seven motions for aircraft and gliders: straight on, accelerating, turns of 3 and 12 deg/s to both sides.

    The current statistical model, of up to 1 g, covers all manoeuvres that the other motions do not describe.  In
    ``presets.vsimm_srckf`` four of the models are active at a time.

    Args:
        q: variance of the acceleration noise, m^2/s^4; straight flight has a fortieth.
        dims: dimensions of space.
        continuous: whether ``q`` is the density of white noise, m^2/s^3; that of the jerk is a hundredth, m^2/s^5.
    """
    return _manoeuvring((3.0, 12.0), 9.8, q, dims, continuous)


def ships(q: Value = 0.01, dims: int = 2, *, continuous: bool = False) -> Bank:
    """The motions of ``aircraft`` for ships: turns of 0.5 and 2 deg/s, up to 0.5 m/s^2."""
    return _manoeuvring((0.5, 2.0), 0.5, q, dims, continuous)


def vehicles(q: Value = 2.0, dims: int = 2, *, continuous: bool = False) -> Bank:
    """The motions of ``aircraft`` for vehicles and drones: turns of 8 and 25 deg/s, up to 6 m/s^2."""
    return _manoeuvring((8.0, 25.0), 6.0, q, dims, continuous)


def people(q: Value = 0.5, dims: int = 2, *, continuous: bool = False) -> Bank:
    """The motions of ``aircraft`` for people: turns of 20 and 60 deg/s, up to 3 m/s^2."""
    return _manoeuvring((20.0, 60.0), 3.0, q, dims, continuous)


def _manoeuvring(rates: Sequence[float], limit: float, q: Value, dims: int, continuous: bool) -> Bank:
    """Seven motions: turns at two ``rates``, deg/s, to both sides, and accelerations up to a ``limit``, m/s^2."""
    turns = [
        CoordinatedTurn(math.radians(side * rate), q, dims, orders=3, continuous=continuous)
        for rate in rates
        for side in (1, -1)
    ]
    models = [
        ConstantVelocity(q / 40, dims, orders=3, continuous=continuous),
        ConstantAcceleration(q / 100 if continuous else q, dims, continuous=continuous),
        CurrentStatistical(1 / 20, limit, dims=dims),
        *turns,
    ]
    neighbours = ((2, 3, 4), (2, 0), (3, 4, 1), (5, 2, 0), (6, 2, 0), (3, 2), (4, 2))
    return Bank(models, neighbours=neighbours, first=(0, 2, 3, 4))


def _agree(one: Sequence[str], other: Sequence[str]) -> bool:
    """Whether the kinds of components do not contradict each other: equal, or one of them unknown ("other")."""
    return all(a == b or "other" in (a, b) for a, b in zip(one, other, strict=True))


def _as_wide(roots: Sequence[Tensor]) -> list[Tensor]:
    """Roots ``(..., n, r)`` padded with zeros to the widest."""
    wide = max(root.shape[-1] for root in roots)
    return [pad(root, (0, wide - root.shape[-1])) for root in roots]


def _stack(parts: Sequence[Tensor], event: int) -> Tensor:
    """Stacks tensors of all models in front of their last ``event`` dimensions, with broadcast batches."""
    batch = broadcast_shapes(*(part.shape[: part.dim() - event] for part in parts))
    return torch.stack([part.expand(batch + part.shape[part.dim() - event :]) for part in parts], -1 - event)
