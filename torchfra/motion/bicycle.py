"""A vehicle that steers."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.motion.base import Motion
from torchfra.motion.blocks import arc, arc_of_rate, driven, sinc
from torchfra.numbers import as_number


class Bicycle(Motion):
    """A vehicle in the plane that rolls without slip: the kinematic bicycle.

    States ``[x, y, speed, heading, steering]``: m, m, m/s, rad, rad.  The heading counts counter-clockwise from +x, the
    steering angle of the front wheel to the left.  Speed and steering are constant plus noise, so a step is an arc.
    The process noise is that of the acceleration and of the steering rate, carried along the arc at the predicted mean,
    exact to first order in both.

    The model assumes a steering angle well below a quarter of a turn, where the curvature is unbounded, but does not
    enforce it.  So keep ``steer`` small and steps short: to first order the sideways noise of a step of many seconds is
    far too large.

    Args:
        wheelbase: distance between the axles, m.
        q: variance of the acceleration along the path, m^2/s^4; with ``continuous`` its density, m^2/s^3.
        steer: variance of the steering rate, rad^2/s^2; with ``continuous`` its density, rad^2/s.
        rear: distance of the state's position in front of the rear axle, m.
        continuous: whether both are white noise in time, so that two short steps are the same as a long one, and not
            constant over each step.

    Raises:
        ValueError: ``wheelbase`` not above 0, ``rear`` below 0 or not finite, a variance below 0.

    Source: Kong, Pfeiffer, Schildbach & Borrelli (2015), "Kinematic and Dynamic Vehicle Models for Autonomous Driving
    Control Design", eq. (1).  The noise is derived here.
    """

    def __init__(
        self, wheelbase: Value, q: Value, steer: Value, *, rear: float = 0.0, continuous: bool = False
    ) -> None:
        if not 0 <= as_number(rear) < math.inf:
            raise ValueError(f"rear: expected finite metres, 0 or more, received {rear!r}")
        super().__init__(
            2, 2, q, size=5, velocity=slice(0, 0), angles=(3,),
            components=("x", "y", "speed", "heading", "steering"),
            kinds=("position", "position", "velocity", "angle", "angle"),
        )  # fmt: skip
        self.wheelbase = Hyper(wheelbase, name="wheelbase")
        self.steer = Hyper(steer, constraints.nonnegative, finite=True, name="steer")
        self.rear, self.continuous = float(rear), continuous

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., 5)`` after ``dt (...)`` seconds, without process noise."""
        px, py, speed, heading, steering = x.unbind(-1)
        curvature, slip, _, _ = self._rolls(steering, self.wheelbase(x))
        turn = dt * speed * curvature
        chord = dt * speed * sinc(turn / 2)
        course = heading + slip + turn / 2
        moved = [px + chord * course.cos(), py + chord * course.sin()]
        return torch.stack(torch.broadcast_tensors(*moved, speed, heading + turn, steering), -1)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., 5, r)`` for a straight path along x at a speed of 1 m/s."""
        return self.process_noise_at(dt, dt.new_tensor([0.0, 0.0, 1.0, 0.0, 0.0]), dt)

    def process_noise_at(self, process_noise: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        """``S_Q (..., 5, r)`` at a predicted mean ``(..., 5)``."""
        _, _, speed, heading, steering = (x.unsqueeze(-1) for x in mean.unbind(-1))
        curvature, slip, curvature_rate, slip_rate = self._rolls(steering, self.wheelbase(mean).unsqueeze(-1))
        course = heading + slip
        forward = torch.stack([course.cos(), course.sin()], -1)
        left = torch.stack([-course.sin(), course.cos()], -1)

        def response(ago: Tensor) -> Tensor:
            """Change of the state by a unit of speed, and by a unit of steering angle, added ``ago`` seconds before."""
            ago, turn = torch.broadcast_tensors(ago, speed * curvature * ago)
            (along, across), (along_rate, across_rate) = arc(turn), arc_of_rate(turn)
            heading_change = speed * curvature_rate * ago
            shift = (
                slip_rate * across + heading_change * along_rate,
                slip_rate * along + heading_change * across_rate,
            )
            moved = (speed * ago).unsqueeze(-1) * (shift[0].unsqueeze(-1) * forward + shift[1].unsqueeze(-1) * left)
            one, zero = torch.ones_like(ago), torch.zeros_like(ago)
            by_speed = [ago.unsqueeze(-1) * forward, torch.stack([one, curvature * ago, zero], -1)]
            by_steering = [moved, torch.stack([zero, heading_change, one], -1)]
            return torch.stack([torch.cat(by_speed, -1), torch.cat(by_steering, -1)], -1)

        variances = torch.stack(torch.broadcast_tensors(self.q(mean), self.steer(mean)), -1)
        return driven(response, dt, variances, continuous=self.continuous)

    def _rolls(self, steering: Tensor, wheelbase: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Curvature of the path, 1/m, its slip angle to the heading, rad, and their derivatives by the steering."""
        t, share = steering.tan(), self.rear / wheelbase
        slope = 1 + t.square()
        long = 1 + (share * t).square()
        curvature, slip = t / (wheelbase * long.sqrt()), (share * t).atan()
        return curvature, slip, slope / (wheelbase * long**1.5), share * slope / long
