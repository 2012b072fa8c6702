"""Coordinated turns, of known rate and of a rate in the state."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.hyper import Hyper, Value
from torchfra.linalg.batches import broadcast_shapes
from torchfra.motion.base import Motion, axis_name
from torchfra.motion.blocks import (
    acceleration_gain,
    arc,
    arc_and_chord,
    arc_of_rate,
    driven,
    white_root,
    zero_padded,
)
from torchfra.motion.polynomial import check_orders


class CoordinatedTurn(Motion):
    """A turn of known rate in the plane of the first two axes; along other axes the velocity is constant.

    States ``[position, velocity]``.  A rate of 0 is ``ConstantVelocity``, with the right gradients.

    Args:
        rate: turn rate, rad/s, counter-clockwise from x to y; a tensor broadcasts with the batch.
        q: variance of the acceleration noise, m^2/s^4; with ``continuous`` its density, m^2/s^3.
        dims: dimensions of space, 2 or more.
        orders: 3 for states with an acceleration, which after each step is that of the turn.
        continuous: whether the acceleration is white noise in time, so that two short steps are the same as a long one;
            the process noise is exact to rounding, however many turns a step has.

    Raises:
        ValueError: ``dims`` below 2, ``rate`` NaN or infinite, ``q`` below 0, ``orders`` neither 2 nor 3.

    Source: Li & Jilkov (2003), "Survey of Maneuvering Target Tracking. Part I", eq. (61).
    """

    linear = usual_layout = True

    def __init__(self, rate: Value, q: Value, dims: int = 2, *, orders: int = 2, continuous: bool = False) -> None:
        if dims < 2:
            raise ValueError(f"dims: expected 2 or more dimensions for a turn, received {dims}")
        super().__init__(dims, check_orders(orders), q)
        self.rate = Hyper(rate, constraints.real, finite=True, name="rate")
        self.continuous = continuous

    def describe(self) -> str:
        """The turn, with its rate if that is a single number."""
        rates = self.rate().detach()
        return f"turn {math.degrees(rates):+.3g} deg/s" if rates.dim() == 0 else "turn"

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        return zero_padded(self._with_acceleration(self._moved(dt, self.rate(dt))), self.size)

    def _moved(self, dt: Tensor, rate: Tensor) -> Tensor:
        """The transition of position and velocity."""
        dt, angle = torch.broadcast_tensors(dt, rate * dt)
        moved, turned = _plane(self.dims, *arc(angle)), _plane(self.dims, angle.cos(), angle.sin())
        still = torch.eye(self.dims, dtype=dt.dtype, device=dt.device).expand_as(turned)
        top, bottom = torch.cat([still, dt[..., None, None] * moved], -1), torch.cat([still * 0, turned], -1)
        return torch.cat([top, bottom], -2)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, r)``: ``sqrt(q) [dt^2/2; dt]`` with ``r = dims``; with ``continuous`` along the turn."""
        if self.continuous:
            return self._with_acceleration(self._white_root(dt, self.q(dt).sqrt() * dt.sqrt()))
        return self._with_acceleration(acceleration_gain(dt, self.q(dt), (2, 1), self.dims))

    def _white_root(self, dt: Tensor, scale: Tensor) -> Tensor:
        """Lower root of the process noise of white accelerations whose integral over the step has this deviation.

        With places and velocities of the plane as complex numbers, ``(exp(i a) - 1) / (i rate)`` and ``exp(i a)``
        answer to a unit of velocity before a turn by ``a``; the covariance is the integral of their products.
        """
        dt, angle, scale = torch.broadcast_tensors(dt, self.rate(dt) * dt, scale)
        along, across = arc_of_rate(angle)
        place = (2 * arc_and_chord(angle)).sqrt()  # 1 / sqrt(3) in a straight step
        velocity = (1 - (along / place).square() - (across / place).square()).sqrt()

        def axes(turned: Tensor, straight: float) -> Tensor:
            others = [torch.full_like(turned, straight)] * (self.dims - 2)
            return torch.diag_embed(torch.stack([turned, turned, *others], -1))

        places, velocities = dt[..., None, None] * axes(place, 3**-0.5), axes(velocity, 0.5)
        shared = axes(torch.ones_like(place), 3**0.5 / 2) @ _plane(self.dims, across / place, along / place)
        top, bottom = torch.cat([places, torch.zeros_like(shared)], -1), torch.cat([shared, velocities], -1)
        return scale[..., None, None] * torch.cat([top, bottom], -2)

    def _with_acceleration(self, matrix: Tensor) -> Tensor:
        """The rows of position and velocity, and below them those of the acceleration if the state has it."""
        if self.orders == 2:
            return matrix
        rate = self.rate(matrix)
        zero = torch.zeros_like(rate)
        # The acceleration is the rate times the velocity turned by 90 degrees, and 0 on axes outside of the turn.
        across = _plane(self.dims, zero, rate)
        across = across * torch.ones(self.dims, dtype=rate.dtype, device=rate.device).index_fill_(
            0, torch.arange(2, self.dims, device=rate.device), 0.0
        )
        velocity = matrix[..., self.dims :, :]
        batch = broadcast_shapes(across.shape[:-2], velocity.shape[:-2])
        return torch.cat([matrix.expand(batch + matrix.shape[-2:]), across @ velocity], -2)


class UnknownTurn(Motion):
    """A turn in the plane of the first two axes whose rate is in the state; along other axes the velocity is constant.

    States ``[position, velocity, rate]``; the rate counts counter-clockwise from x to y, rad/s, and drifts.

    Args:
        q: variance of the acceleration noise, m^2/s^4; with ``continuous`` its density, m^2/s^3.
        drift: variance of the change of the rate per second, rad^2/s^4; with ``continuous`` its density, rad^2/s^3.
        dims: dimensions of space, 2 or more.
        continuous: whether both are white noise in time, so that two short steps are the same as a long one, and not
            constant over each step.  The process noise then follows the turn at the predicted mean, exact to first
            order and to rounding for steps of up to half a turn.  Otherwise it is that of a straight step, without the
            effect of the rate's change on position and velocity within the step; so take ``continuous`` for long steps.

    Raises:
        ValueError: ``dims`` below 2, a value below 0.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 11.7.  The continuous-time noise is derived here.
    """

    def __init__(self, q: Value, drift: Value, dims: int = 2, *, continuous: bool = False) -> None:
        if dims < 2:
            raise ValueError(f"dims: expected 2 or more dimensions for a turn, received {dims}")
        names = [letter + axis_name(axis, dims) for letter in ("", "v") for axis in range(dims)]
        kinds = ["position"] * dims + ["velocity"] * dims + ["rate"]
        super().__init__(dims, 2, q, size=2 * dims + 1, components=[*names, "rate"], kinds=kinds)
        self.drift = Hyper(drift, constraints.nonnegative, finite=True, name="drift")
        self.continuous = continuous

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., n)`` after ``dt (...)`` seconds, without process noise."""
        position, velocity, rate = x.split([self.dims, self.dims, 1], -1)
        dt, angle = dt.unsqueeze(-1), rate * dt.unsqueeze(-1)
        moved = position + dt * _turned(velocity, *arc(angle), rest=1.0)
        return torch.cat([moved, _turned(velocity, angle.cos(), angle.sin(), rest=1.0), rate + 0 * dt], -1)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, dims + 1)``: ``sqrt(q) [dt^2/2; dt]`` and ``sqrt(drift) dt``.

        With ``continuous`` it is ``(..., n, n)``, at a velocity and a rate of 0.
        """
        if self.continuous:
            moved, rate = white_root(dt, self.q(dt), 2, self.dims), self.drift(dt).sqrt() * dt.sqrt()
        else:
            moved, rate = acceleration_gain(dt, self.q(dt), (2, 1), self.dims), self.drift(dt).sqrt() * dt
        batch = broadcast_shapes(moved.shape[:-2], rate.shape)
        corner = pad(rate.expand(batch)[..., None, None], (moved.shape[-1], 0))
        return torch.cat([pad(moved.expand(*batch, -1, -1), (0, 1)), corner], -2)

    def process_noise_at(self, process_noise: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        """``S_Q`` at a predicted mean ``(..., n)``: with ``continuous`` ``(..., n, n)`` along the turn."""
        if not self.continuous:
            return process_noise
        velocity, rate = mean[..., None, self.dims : 2 * self.dims], mean[..., -1:]

        def response(ago: Tensor) -> Tensor:
            """Change of the state by a unit of each velocity, and by a unit of rate, added ``ago`` seconds before."""
            ago, angle = torch.broadcast_tensors(ago, rate * ago)
            moved, turned = _plane(self.dims, *arc(angle)), _plane(self.dims, angle.cos(), angle.sin())
            by_velocity = pad(torch.cat([ago[..., None, None] * moved, turned], -2), (0, 0, 0, 1))
            along, across = (x.unsqueeze(-1) for x in arc_of_rate(angle))
            ago = ago.unsqueeze(-1)
            position = ago.square() * _turned(velocity, along, across)
            turned_velocity = ago * _turned(velocity, 0 * along, 1 + 0 * across)
            by_rate = torch.cat([position, turned_velocity, torch.ones_like(ago)], -1)
            return torch.cat([by_velocity, by_rate.unsqueeze(-1)], -1)

        q, drift = torch.broadcast_tensors(self.q(mean), self.drift(mean))
        return driven(response, dt, torch.stack([q] * self.dims + [drift], -1), continuous=True)


def _turned(velocity: Tensor, c: Tensor, s: Tensor, rest: float = 0.0) -> Tensor:
    """Velocities ``(..., dims)`` times ``[[c, -s], [s, c]]`` in the plane of the turn, the others times ``rest``."""
    vx, vy, others = velocity[..., :1], velocity[..., 1:2], velocity[..., 2:]
    batch = broadcast_shapes(velocity.shape[:-1], c.shape[:-1])
    return torch.cat([c * vx - s * vy, s * vx + c * vy, (rest * others).expand(*batch, -1)], -1)


def _plane(dims: int, c: Tensor, s: Tensor) -> Tensor:
    """``(..., dims, dims)``: ``[[c, -s], [s, c]]`` in the plane of the turn, 1 on the other axes."""
    rows = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    rest = torch.eye(dims, dtype=c.dtype, device=c.device)[2:]
    rows = pad(rows, (0, dims - 2))
    return torch.cat([rows, rest.expand(c.shape + rest.shape)], -2)
