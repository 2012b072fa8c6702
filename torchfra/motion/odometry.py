"""Dead reckoning: a vehicle that measures its own motion by wheels, and by a compass or a gyroscope."""

from __future__ import annotations

import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.distributions import constraints

from torchfra.angles import wrap
from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_sqrt
from torchfra.linalg.tracing import is_traced
from torchfra.motion.base import Motion
from torchfra.motion.blocks import arc
from torchfra.numbers import as_numbers, positive

_ROUNDING = 1e-6
"""Of time steps, relative: float32 rounds them to 1e-7."""


class Odometry(Motion):
    """Dead reckoning of a vehicle in the plane, from the speed that its wheels measure and its heading or turn rate.

    States ``[x, y, heading error, log scale]`` with a measured heading, and ``[x, y, heading, log scale, rate bias]``
    with a gyroscope: the wheels' speed times ``exp(log scale)`` is the true one; the measured heading plus
    ``heading error`` is the true one, and so is the measured turn rate plus ``rate bias``.  Headings count
    counter-clockwise from +x.  With a gyroscope a step is an arc, with a measured heading it is straight.

    The inputs of a step are ``u (..., 2)``: the speed in m/s over the step that leads to the measurement, and the
    heading in rad or the turn rate in rad/s.  A track fails at a step with NaN there.

    Args:
        position: density of the white noise on each axis of the position, by slip of the wheels, m^2/s.
        heading: density of the white noise on the heading or its error, rad^2/s.
        scale: density of the white noise on the logarithm of the scale, 1/s.
        bias: density of the white noise on the bias of the turn rate, rad^2/s^3; for a gyroscope only.

    Raises:
        ValueError: a density below 0; in a step, ``u`` that is missing or has not two entries.

    Source: Thrun, Burgard & Fox (2005), "Probabilistic Robotics", section 5.4, with errors of the sensors as states.
    """

    measures_itself = True

    def __init__(self, position: Value, heading: Value, scale: Value, bias: Value | None = None) -> None:
        own = ("heading error", "log scale") if bias is None else ("heading", "log scale", "rate bias")
        super().__init__(
            2, 1, None, size=2 + len(own), velocity=slice(0, 0), angles=(2,), components=("x", "y", *own),
            kinds=("position", "position", "angle", "parameter", "bias")[: 2 + len(own)],
        )  # fmt: skip
        self.walk_position = Hyper(position, constraints.nonnegative, finite=True, name="position")
        self.walk_heading = Hyper(heading, constraints.nonnegative, finite=True, name="heading")
        self.walk_scale = Hyper(scale, constraints.nonnegative, finite=True, name="scale")
        self.walk_bias = None if bias is None else Hyper(bias, constraints.nonnegative, finite=True, name="bias")

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., n)`` after ``dt (...)`` seconds at the speed and heading or turn rate ``u (..., 2)``."""
        if u is None or u.shape[-1] != 2:
            expected = "(..., 2), speed and " + ("heading" if self.walk_bias is None else "turn rate")
            raise ValueError(f"u: expected {expected}, received {None if u is None else tuple(u.shape)}")
        speed, turned = u.unbind(-1)
        way = speed * x[..., 3].exp() * dt
        if self.walk_bias is None:
            dx, dy = (turned + x[..., 2]).cos() * way, (turned + x[..., 2]).sin() * way
            rest = x[..., 2:]
        else:
            turn = (turned + x[..., 4]) * dt
            along, left = arc(turn)
            cos, sin = x[..., 2].cos(), x[..., 2].sin()
            dx, dy = way * (along * cos - left * sin), way * (along * sin + left * cos)
            rest = torch.cat([(x[..., 2] + turn).unsqueeze(-1), x[..., 3:]], -1)
        return torch.cat([x[..., :2] + torch.stack([dx, dy], -1), rest], -1)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)``: that of an independent random walk of each component."""
        walks = [self.walk_position, self.walk_position, self.walk_heading, self.walk_scale]
        walks += [] if self.walk_bias is None else [self.walk_bias]
        each = torch.broadcast_tensors(*(walk(dt).sqrt() * dt.sqrt() for walk in walks))
        root: Tensor = torch.stack(each, -1).diag_embed()
        return root

    def describe(self) -> str:
        """Odometry, and whether it has a measured heading or a gyroscope."""
        return "odometry with a " + ("measured heading" if self.walk_bias is None else "gyroscope")


class BodyOdometry(Motion):
    """Dead reckoning of a robot in the plane, from its velocities in its own axes, or from its steps in them.

    States ``[x, y, heading]``, the heading counter-clockwise from +x.  The inputs of a step are ``u (..., 3)``, first
    in the filter's ``u``: velocities ahead and to the left, m/s, and turn rate, rad/s, over the step that leads to the
    measurement, which is an arc; or, with ``steps``, what odometry reports from pose to pose: metres ahead and to the
    left in the axes before the step, and radians of turn.  A turn, a way and another turn are
    ``[way * cos(first), way * sin(first), first + second]``.

    Noise grows with the way and with the turn, so that a robot that stands has none, and many short steps are as one
    long one.  It is along the axes of the robot, and a heading that errs on the way leads aside.

    Without ``along``, ``across`` and ``heading`` each step brings its own, ``u (..., 6)``: behind the three inputs the
    standard deviations of its way ahead and to the left, m, and of its turn, rad.

    Args:
        along: variance of the way ahead that grows with each metre, m^2/m.
        across: variance of the way to the left that grows with each metre, m^2/m.
        heading: variance of the heading that grows with each metre, rad^2/m.
        turn: variance of the heading that grows with each radian of turn, rad^2/rad.
        longest: seconds that velocities may hold.  A longer ``dt`` would be bridged by a single arc, which is wrong
            wherever the robot turned in between, so it is an error; in a kernel, which cannot raise one, the track
            fails.  ``stream.merge`` makes steps that are short enough.
        steps: whether inputs are steps; ``dt`` does not matter then, except that after 0 s nothing has moved.

    Raises:
        ValueError: a variance below 0, some of the three without the others, velocities without ``longest`` or steps
            with it; in a step, a ``dt`` above ``longest``, or ``u`` that is missing or too short.

    Source: Chong & Kleeman (1997), "Accurate Odometry and Error Modelling for a Mobile Robot", ICRA, for noise that
    grows with the way; Thrun, Burgard & Fox (2005), "Probabilistic Robotics", chapter 5, for the models.

    Example:
        >>> motion = torchfra.motion.BodyOdometry(along=1e-3, across=1e-4, heading=1e-4, turn=1e-3, longest=2.0)
        >>> motion(torch.zeros(3), torch.tensor(2.0), torch.tensor([1.5, 0.5, 0.0]))
        tensor([3., 1., 0.])
    """

    measures_itself = True
    along: Hyper
    across: Hyper
    heading: Hyper
    turn: Hyper

    def __init__(
        self,
        along: Value | None = None,
        across: Value | None = None,
        heading: Value | None = None,
        turn: Value = 0.0,
        *,
        longest: float | None = None,
        steps: bool = False,
    ) -> None:
        super().__init__(
            2, 1, None, size=3, velocity=slice(0, 0), angles=(2,), components=("x", "y", "heading"),
            kinds=("position", "position", "angle"),
        )  # fmt: skip
        given = {"along": along, "across": across, "heading": heading}
        missing = [name for name, value in given.items() if value is None]
        if 0 < len(missing) < 3:
            raise ValueError(f"along, across, heading: expected all or none, received no {' and no '.join(missing)}")
        for name, value in (given | {"turn": None if missing else turn}).items():
            if value is not None:
                setattr(self, name, Hyper(value, constraints.nonnegative, finite=True, name=name))
        if steps and longest is not None:
            raise ValueError(f"longest: expected None beside steps, which a gap does not change, received {longest!r}")
        self.longest = None if steps else positive("longest", longest, "seconds that velocities may hold")
        self.states_noise = not missing

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., 3)`` after ``dt (...)`` seconds with the inputs ``u (..., 3)`` or longer."""
        ahead, left, turn = self._step(dt, u)
        cos, sin = x[..., 2].cos(), x[..., 2].sin()
        moved = [x[..., 0] + ahead * cos - left * sin, x[..., 1] + ahead * sin + left * cos, x[..., 2] + turn]
        return torch.stack(moved, -1)

    def process_noise(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``S_Q (..., 3, 4)`` in the axes of the robot in the middle of the step, turned back from those at its end."""
        start_ahead, start_left, turn = self._step(dt, u)
        cos, sin = (turn / 2).cos(), (turn / 2).sin()
        ahead, left = cos * start_ahead + sin * start_left, cos * start_left - sin * start_ahead
        if self.states_noise:
            way, turned = safe_sqrt(ahead.square() + left.square()), turn.abs()
            along, across = self.along(dt) * way, self.across(dt) * way
            heading = self.heading(dt) * way + self.turn(dt) * turned
        else:
            assert u is not None
            along, across, heading = u[..., 3:6].square().to(dt).unbind(-1)
        # A heading that walks while the robot goes a way d leads aside by d / 2 of its error at the end, and by
        # d / sqrt(12) of what is independent of that.
        along, across, err, ahead, left = torch.broadcast_tensors(
            safe_sqrt(along), safe_sqrt(across), safe_sqrt(heading), ahead, left
        )
        zero, part = torch.zeros_like(err), 12**-0.5
        rows = [
            torch.stack([along, zero, -left / 2 * err, -left * part * err], -1),
            torch.stack([zero, across, ahead / 2 * err, ahead * part * err], -1),
            torch.stack([zero, zero, err, zero], -1),
        ]
        return torch.stack([*_turned(rows[0], rows[1], -turn / 2), rows[2]], -2)

    def process_noise_at(self, process_noise: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        """``S_Q (..., 3, 4)`` at a predicted mean ``(..., 3)``: turned with the robot."""
        x, y, heading = process_noise.unbind(-2)
        turned = _turned(x, y, mean[..., 2])
        return torch.stack([*turned, heading.expand_as(turned[0])], -2)

    def describe(self) -> str:
        """Odometry in the axes of the robot."""
        return "odometry in the robot's axes"

    def _step(self, dt: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Metres ahead and to the left in the axes before the step, and radians of turn, each ``(...)``."""
        needed = 3 if self.states_noise else 6
        if u is None or u.shape[-1] < needed:
            what = "steps" if self.longest is None else "velocities"
            expected = f"(..., {needed}), {what} ahead and to the left and turn{', and their std' * (needed > 3)}"
            raise ValueError(f"u: expected {expected}, received {None if u is None else tuple(u.shape)}")
        ahead, left, turn = u[..., :3].to(dt).unbind(-1)
        if self.longest is None:
            moves = (dt != 0).to(dt)
            return ahead * moves, left * moves, turn * moves
        gap = dt > self.longest * (1 + _ROUNDING)
        if is_traced(dt):
            dt = torch.where(gap, torch.nan, dt)
        elif bool(gap.any()):
            expected = f"{self.longest:g} s or less (longest), as one arc over a gap is wrong where it turned"
            raise ValueError(f"dt: expected {expected}, received {float(dt.max()):g} s")
        turn = turn * dt
        along, aside = arc(turn)
        return (along * ahead - aside * left) * dt, (aside * ahead + along * left) * dt, turn


def _turned(x: Tensor, y: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    """Rows ``(..., r)`` of a root along two axes, turned counter-clockwise by ``angle (...)``."""
    cos, sin = angle.cos().unsqueeze(-1), angle.sin().unsqueeze(-1)
    return cos * x - sin * y, sin * x + cos * y


def body_velocities(time: ArrayLike, pose: ArrayLike) -> Tensor:
    """Velocities in the axes of a robot, ``(..., T - 1, 3)`` for ``BodyOdometry``, from poses that odometry reports.

    Between two poses the robot goes along an arc; row ``k`` is of the time from pose ``k`` to the next.

    Args:
        time: ``(T,)`` or ``(..., T)`` seconds.
        pose: ``(..., T, 3)`` x and y in m and heading in rad, in any frame that stays.

    Returns:
        Velocities ahead and to the left, m/s, and turn rate, rad/s; a turn is the shorter one.

    Raises:
        ValueError: shapes that do not fit, or times that do not increase.
    """
    pose, time = as_numbers(pose, "pose"), as_numbers(time, "time")
    if pose.dim() < 2 or pose.shape[-1] != 3 or time.shape[-1:] != pose.shape[-2:-1] or pose.shape[-2] < 2:
        raise ValueError(
            f"time, pose: expected (T,) and (..., T, 3), received {tuple(time.shape)}, {tuple(pose.shape)}"
        )
    seconds = time.diff()
    if not bool((seconds > 0).all()):
        raise ValueError("time: expected seconds that increase, received some that do not")
    gap, turn = pose[..., :2].diff(dim=-2), wrap(pose[..., 2].diff())
    cos, sin = pose[..., :-1, 2].cos(), pose[..., :-1, 2].sin()
    ahead, left = gap[..., 0] * cos + gap[..., 1] * sin, gap[..., 1] * cos - gap[..., 0] * sin
    along, aside = arc(turn)
    square = along.square() + aside.square()
    velocity: list[Tensor] = [(along * ahead + aside * left) / square, (along * left - aside * ahead) / square, turn]
    found: Tensor = torch.stack(velocity, -1) / seconds.to(pose).unsqueeze(-1)
    return found
