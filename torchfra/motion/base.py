"""The base of all motions: how a state evolves over a time step, and the process noise of the step."""

from __future__ import annotations

import re
from collections.abc import Sequence
from inspect import signature
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.angles import wrap
from torchfra.hyper import Hyper, Part, Value
from torchfra.linalg.triangular import apply
from torchfra.motion.blocks import acceleration_gain
from torchfra.tree import event_ranks

KINDS = ("position", "velocity", "acceleration", "angle", "rate", "bias", "clock", "parameter", "other")
"""Kinds of components; a rate is that of an angle, rad/s; a parameter is a property of the target, such as its drag."""
AXES = ("x", "y", "z")


@event_ranks(response=2, scale=1, decrease=1)
class Adaptation(NamedTuple):
    """How a step of a linear motion depends on the acceleration estimated before it, as if that were exact.

    States begin with ``[position, velocity, acceleration]``.
    """

    response: Tensor
    """``(..., n, dims)`` change of the state over the step by an acceleration of 1 m/s^2."""
    scale: Tensor
    """``(..., 2)`` factor on the root of the process noise near 0, for positive and for negative accelerations."""
    decrease: Tensor
    """``(..., 2)`` relative decrease of that factor per m/s^2, down to 0, for positive and negative accelerations."""

    def __call__(self, mean: Tensor, shift: Tensor | None, process_noise: Tensor) -> tuple[Tensor, Tensor]:
        """Shift ``(..., n)`` and root of the process noise ``(..., n, r)`` of a step from ``mean (..., n)``."""
        dims = self.response.shape[-1]
        acceleration = mean[..., 2 * dims : 3 * dims]
        scale, decrease = (torch.where(acceleration < 0, x[..., 1:], x[..., :1]) for x in (self.scale, self.decrease))
        factor = scale * (1 - decrease * acceleration.abs()).clamp_min(0.0)
        one = torch.ones_like(mean[..., 3 * dims :])
        factor = torch.cat([factor] * 3 + [one.expand(*factor.shape[:-1], -1)], -1)
        added = apply(self.response, acceleration)
        return added if shift is None else shift + added, process_noise * factor.unsqueeze(-1)


class Motion(Part):
    """Abstract: how a state evolves over ``dt`` seconds, and with what process noise.

    To write your own motion, subclass this and define

    - if it is linear, ``linear = True`` and ``transition(dt)``, with ``shift(dt, u)`` for a known change on top:
      filters then carry means and covariances exactly, without sigma points;
    - if it is not, ``forward(x, dt, u)``;
    - ``process_noise(dt)``, unless the default below is right;
    - ``transition(dt, u)`` or ``process_noise(dt, u)`` instead, where the matrix or the noise depends on the inputs of
      a step, as that of wheels does on how far they turned;
    - ``angles``, ``process_noise_at``, ``canonical`` and ``describe`` where the defaults are not right.

    Shapes: filters call ``forward`` with ``x (..., n)``, ``dt (...)`` and ``u (..., k)`` (or None) that all have the
    same ``...``, sigma points first and then the batch: it must treat every entry of ``...`` alike and return
    ``(..., n)``.  ``transition``, ``shift`` and ``process_noise`` are called once for all steps of a sequence: ``dt``
    has no dimensions, or is ``(T, ...)`` or ``(...)``, ``u`` is ``(T, ..., k)``, and the results broadcast with the
    batch.  Values that may be learned are ``Hyper``; ``self.q(dt)`` reads one in the dtype and on the device of dt.

    States list positions first, then velocities, then accelerations, ``[x, y, vx, vy, ax, ay]`` in m, m/s, m/s^2,
    unless ``position`` and ``velocity`` say otherwise.

    Args:
        dims: dimensions of space, the number of position components.
        orders: derivatives in the state, the position included: 2 up to velocity, 3 up to acceleration.
        q: variance of the acceleration noise, m^2/s^4, constant over a step and independent between steps and axes
            (so that two short steps are not the same as a long one).  A tensor broadcasts with the batch.  None for a
            motion with a ``process_noise`` of another kind.
        size: components of the state, ``n``; by default ``dims * orders``.
        position: components that are the position; by default the first ``dims``.
        velocity: components that are the velocity; by default the next ``dims``, as far as there are any.
        angles: components that are angles, which differences of states wrap; by default those of the class.
        components: names of the components, ``("x", "y", "vx", "vy")``; by default from their places.
        kinds: kind of each component, one of ``torchfra.motion.KINDS``; by default from their places.

    Raises:
        ValueError: ``dims`` or ``size`` below 1, ``q`` below 0, not one name or kind for each component, ``angles``
            that are no components, kinds of angles without ``angles``.
        TypeError: (where the class is defined) ``linear = True`` without a ``transition``, or the other way round, or
            with a ``process_noise_at``.
    """

    linear: bool = False
    """Whether the motion is linear and ``transition`` gives its matrix; a property where it depends on the instance."""
    size: int
    """Components of the state, ``n``."""
    position: slice
    """Components that are the position, in Cartesian or other coordinates."""
    velocity: slice
    """Components that are the velocity, or the rates of other coordinates; empty if the state has none."""
    angles: tuple[int, ...] = ()
    """Components of the state that are angles, rad, which differences and mixtures of states wrap."""
    components: tuple[str, ...]
    """Names of the components of the state."""
    kinds: tuple[str, ...]
    """Kind of each component, one of ``torchfra.motion.KINDS``."""
    stated: tuple[str, ...]
    """The kinds that class or user have stated, otherwise "other": a sensor is refused for stated kinds only."""
    usual_layout = False
    """Whether states are laid out as above, so that the kinds count as stated."""
    measures_itself: bool = False
    """Whether the inputs measure the motion, as odometry does, so that the target has no unknown manoeuvres."""
    stacked = 0
    """Number of dimensions between batch and state: 1 for a ``Bank``, that of its models, else 0."""
    by_inputs: frozenset[str] = frozenset()
    """Which of ``transition`` and ``process_noise`` have an argument ``u``, the inputs of a step."""

    def __init_subclass__(cls, **keywords: object) -> None:
        super().__init_subclass__(**keywords)
        methods = {"transition": cls.transition, "process_noise": cls.process_noise}
        cls.by_inputs = frozenset(name for name, method in methods.items() if "u" in signature(method).parameters)
        has_transition = cls.transition is not Motion.transition
        if isinstance(cls.linear, bool) and cls.linear != has_transition:
            expected = "a transition, received none" if cls.linear else "linear = True beside its transition"
            raise TypeError(f"{cls.__name__}: linear is {cls.linear}: expected {expected}")
        if cls.linear is True and cls.process_noise_at is not Motion.process_noise_at:
            expected = "no process_noise_at, as the steps of a linear motion do not depend on the state"
            hint = "take linear = False and a forward"
            raise TypeError(f"{cls.__name__}: linear is True: expected {expected}: {hint}")

    def __init__(
        self,
        dims: int,
        orders: int,
        q: Value | None,
        *,
        size: int | None = None,
        position: slice | None = None,
        velocity: slice | None = None,
        angles: Sequence[int] | None = None,
        components: Sequence[str] | None = None,
        kinds: Sequence[str] | None = None,
    ) -> None:
        super().__init__()
        if dims < 1:
            raise ValueError(f"dims: expected 1 or more dimensions of space, received {dims}")
        self.dims, self.orders = dims, orders
        self.size = dims * orders if size is None else size
        if self.size < 1:
            raise ValueError(f"size: expected 1 or more components of the state, received {self.size}")
        self.position = slice(0, dims) if position is None else position
        self.velocity = slice(dims, 2 * dims) if velocity is None else velocity
        self.angles = self.angles if angles is None else tuple(angles)
        if not set(self.angles) <= set(range(self.size)):
            expected = f"indices of components, 0 to {self.size - 1}"
            raise ValueError(f"angles: expected {expected}, received {self.angles}")
        names, usual_kinds = _usual(self.size, dims, orders, self.position, self.velocity, self.angles)
        self.components, self.kinds = tuple(components or names), tuple(kinds or usual_kinds)
        _check_components(self.size, self.components, self.kinds)
        self.stated = self.kinds if kinds or self.usual_layout else ("other",) * self.size
        if "angle" in self.stated and not self.angles:
            raise ValueError("angles: expected the indices of the components of kind 'angle', received none")
        if q is not None:
            self.q = Hyper(q, constraints.nonnegative, finite=True, name="q")

    @property
    def vertical(self) -> tuple[int, ...]:
        """Components along the third axis, ``z``, ``vz`` and ``az``; none if the state has no ``z`` and ``vz``."""
        kinds = self.kinds[self.position] + self.kinds[self.velocity]
        if kinds != ("position",) * 3 + ("velocity",) * 3:
            return ()
        accelerations = [i for i, kind in enumerate(self.kinds) if kind == "acceleration"]
        return (*range(self.size)[self.position][2:], *range(self.size)[self.velocity][2:], *accelerations[2:3])

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., n)`` that ``x (..., n)`` becomes after ``dt (...)`` seconds, without process noise.

        ``u (..., k)`` are the inputs of the step.  A linear motion need not define this method, which by default uses
        ``transition`` and ``shift``, for any ``dt`` and ``u`` that broadcast with ``x``.
        """
        if not self.linear:
            raise TypeError(f"{type(self).__name__}: expected a forward, or linear = True and a transition")
        matrix, shift = self.transition_by(dt, u), self.shift(dt, u)
        return apply(matrix, x) if shift is None else apply(matrix, x) + shift

    def at_points(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``forward`` for points ``x (p, ..., n)`` of one step ``dt (...)``, ``u (..., k)``: ``(p, ..., n)``.

        Rules call this.  It expands ``dt`` and ``u`` to the points, so that ``forward`` gets three tensors of the same
        ``...``.  A motion may override it to compute once what is equal for all points.
        """
        if self.linear:
            return self.forward(x, dt, u)
        u = u if u is None else u.expand(*x.shape[:-1], -1)
        try:
            after = self.forward(x, dt.expand(x.shape[:-1]), u)
        except NotImplementedError:  # raised by a kernel, with a message of its own
            raise
        except (RuntimeError, IndexError) as error:
            inputs = f"states {tuple(x.shape)} in {x.dtype}, u {None if u is None else tuple(u.shape)}"
            raise type(error)(f"{type(self).__name__}.forward: {inputs}: {error}") from error
        if after.dim() < x.dim() or after.shape[-1] != self.size:
            expected, received = tuple(x.shape), tuple(after.shape)
            raise ValueError(f"{type(self).__name__}.forward: expected states {expected}, received {received}")
        return after

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``, of linear motions."""
        raise TypeError(f"{type(self).__name__}: expected a linear motion, received one without a transition")

    def transition_by(self, dt: Tensor, u: Tensor | None) -> Tensor:
        """``transition`` for ``dt (...)``, and for the inputs ``u (..., k)`` where it depends on them."""
        if "transition" in self.by_inputs:
            return self.transition(dt, u)  # type: ignore[call-arg]  # it has the argument
        return self.transition(dt)

    def process_noise_by(self, dt: Tensor, u: Tensor | None) -> Tensor:
        """``process_noise`` for ``dt (...)``, and for the inputs ``u (..., k)`` where it depends on them."""
        if "process_noise" in self.by_inputs:
            return self.process_noise(dt, u)  # type: ignore[call-arg]  # it has the argument
        return self.process_noise(dt)

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """A known change of the state, ``(..., n)``, on top of a linear transition: control, or a moving frame."""
        return None

    def adaptation(self, dt: Tensor) -> Adaptation | None:
        """How shift and process noise depend on the state before a step, for linear motions; None if they do not."""
        return None

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims)`` for ``dt (...)``: a root of the process noise covariance, ``sqrt(q) [dt^2/2; dt; 1]``.

        A subclass may return any root ``(..., n, r)`` of the covariance.

        Source: Wang et al. (2021), eqs. (4)-(5).
        """
        return acceleration_gain(dt, self.q(dt), range(2, 2 - self.orders, -1), self.dims)

    def process_noise_at(self, process_noise: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        """The root ``(..., n, r)`` of ``process_noise`` at a predicted mean ``(..., n)``, if it depends on that.

        It is called for nonlinear motions, after a step of ``dt (...)`` seconds; a linear one may not have it.
        """
        return process_noise

    def difference(self, a: Tensor, b: Tensor) -> Tensor:
        """``a - b`` of states ``(..., n)``, angles within half a turn."""
        gap = a - b
        if not self.angles:
            return gap
        is_angle = torch.tensor([i in self.angles for i in range(self.size)], device=gap.device)
        return torch.where(is_angle, wrap(gap), gap)

    def canonical(self, mean: Tensor) -> Tensor:
        """The state ``(..., n)`` with its angles in the range that this motion uses."""
        return mean

    def describe(self) -> str:
        """The motion in a few words, for tables and messages: by default the words of the class's name."""
        return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(self).__name__).lower()

    def extra_repr(self) -> str:
        """Dimensions of space and of the state, and the state's components."""
        return f"dims={self.dims}, size={self.size}, state=[{', '.join(self.components)}]"


def _usual(
    size: int, dims: int, orders: int, position: slice, velocity: slice, angles: Sequence[int]
) -> tuple[list[str], list[str]]:
    """Names and kinds by the layout of a state: ``x y vx vy ax ay``, and the index of any other component."""
    names, kinds = [f"state {i}" for i in range(size)], ["other"] * size
    parts = [("position", "", position), ("velocity", "v", velocity)]
    if orders > 2 and (position, velocity) == (slice(0, dims), slice(dims, 2 * dims)):
        parts.append(("acceleration", "a", slice(2 * dims, 3 * dims)))
    for kind, letter, where in parts:
        for axis, i in enumerate(range(size)[where]):
            names[i], kinds[i] = letter + axis_name(axis, dims), kind
    for i in angles:
        names[i], kinds[i] = names[i] if kinds[i] != "other" else f"angle {i}", "angle"
    return names, kinds


def axis_name(axis: int, dims: int) -> str:
    """``x``, ``y`` or ``z``; a number in a space of more dimensions."""
    return AXES[axis] if dims <= len(AXES) else f"x{axis}"


def _check_components(size: int, names: Sequence[str], kinds: Sequence[str]) -> None:
    """Checks the names and kinds of a state's components.

    Raises:
        ValueError: not one for each component, a name twice, or an unknown kind.
    """
    for argument, values in (("components", names), ("kinds", kinds)):
        if len(values) != size:
            raise ValueError(f"{argument}: expected one for each of {size} components, received {list(values)}")
    if len(set(names)) < size:
        raise ValueError(f"components: expected different names, received {list(names)}")
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise ValueError(f"kinds: expected some of {', '.join(KINDS)}, received {unknown[0]!r}")
