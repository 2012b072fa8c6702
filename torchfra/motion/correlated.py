"""Motions driven by process noise in continuous time: white jerk, Singer's, and the current statistical model.

States ``[position, velocity, acceleration]``, ``da/dt = -alpha (a - level) + process noise``; of the integrated
Ornstein-Uhlenbeck process ``[position, velocity]``, ``dv/dt = -alpha v + process noise``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import tria
from torchfra.motion.base import Adaptation, Motion
from torchfra.motion.blocks import gauss_legendre, per_axis
from torchfra.motion.polynomial import ConstantAcceleration


class WhiteJerk(ConstantAcceleration):
    """Constant acceleration, disturbed by a white jerk in continuous time: two short steps are the same as a long one.

    Args:
        q: its power spectral density, m^2/s^5: variance of the acceleration that a second adds.
        dims: dimensions of space.

    Raises:
        ValueError: a value out of its range.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 6.2.3.
    """

    def __init__(self, q: Value, dims: int = 2) -> None:
        super().__init__(q, dims, continuous=True)


class Singer(Motion):
    """Acceleration of zero mean, correlated over about ``1 / alpha`` seconds.

    Args:
        q: variance of the acceleration itself, m^2/s^4.
        alpha: rate at which the correlation decays, 1/s; towards 0 the acceleration is constant.
        dims: dimensions of space.

    The process noise is exact to rounding, however short or long a step is beside ``1 / alpha``.

    Raises:
        ValueError: a value out of its range.

    Source: Singer (1970), "Estimating Optimal Tracking Filter Performance for Manned Maneuvering Targets".
    """

    linear = usual_layout = True

    def __init__(self, q: Value, alpha: Value, dims: int = 2) -> None:
        super().__init__(dims, 3, q)
        self.alpha = Hyper(alpha, constraints.nonnegative, finite=True, name="alpha")

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        rows = _response(self.alpha(dt), dt)
        one, zero = torch.ones_like(rows[0]), torch.zeros_like(rows[0])
        time = dt.expand_as(one)
        block = torch.stack([one, time, rows[0], zero, one, rows[1], zero, zero, rows[2]], -1)
        return per_axis(block.unflatten(-1, (3, 3)), self.dims)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)`` for ``dt (...)``."""
        return per_axis(self.q(dt).sqrt()[..., None, None] * self._unit_root(dt), self.dims)

    def _unit_root(self, dt: Tensor) -> Tensor:
        """Root of the process noise of one axis, ``(..., 3, 3)``, for an acceleration of variance 1."""
        alpha = self.alpha(dt)
        root: Tensor = (2 * alpha).sqrt()[..., None, None] * white_noise_root(alpha, dt)
        return root


class IntegratedOrnsteinUhlenbeck(Motion):
    """Velocity of zero mean, correlated over about ``1 / alpha`` seconds: how people and ships wander.

    Args:
        q: variance of the velocity itself, m^2/s^2.
        alpha: rate at which the correlation decays, 1/s; towards 0 the velocity is constant.
        dims: dimensions of space.

    The process noise is exact as that of ``Singer``.

    Raises:
        ValueError: a value out of its range.

    Source: Uhlenbeck & Ornstein (1930), "On the Theory of the Brownian Motion"; Stone, Streit, Corwin & Bell (2014),
    "Bayesian Multiple Target Tracking".
    """

    linear = usual_layout = True

    def __init__(self, q: Value, alpha: Value, dims: int = 2) -> None:
        super().__init__(dims, 2, q)
        self.alpha = Hyper(alpha, constraints.nonnegative, finite=True, name="alpha")

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        _, moved, left = _response(self.alpha(dt), dt)
        block = torch.stack([torch.ones_like(moved), moved, torch.zeros_like(moved), left], -1)
        return per_axis(block.unflatten(-1, (2, 2)), self.dims)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)`` for ``dt (...)``."""
        alpha = self.alpha(dt)
        scale = (2 * alpha * self.q(dt)).sqrt()[..., None, None]
        return per_axis(scale * white_noise_root(alpha, dt, 2), self.dims)


class CurrentStatistical(Singer):
    """Singer's motion around the current acceleration, with less process noise near the limit of the acceleration.

    The mean acceleration is the one estimated before the step, as if it were exact; the variance around it is that of a
    Rayleigh density between it and the limit, ``(4 - pi) / pi (limit - |mean|)^2`` per axis, and 0 beyond the limit.

    Args:
        alpha: rate at which the correlation decays, 1/s.
        limit: largest acceleration, m/s^2.
        negative_limit: largest acceleration in the negative direction, m/s^2; ``limit`` if None.
        dims: dimensions of space.

    Raises:
        ValueError: a value out of its range.

    Source: Zhou & Kumar (1984), "A 'Current' Statistical Model and Adaptive Algorithm for Estimating Maneuvering
    Targets".
    """

    def __init__(self, alpha: Value, limit: Value, negative_limit: Value | None = None, dims: int = 2) -> None:
        Motion.__init__(self, dims, 3, None)
        self.alpha = Hyper(alpha, constraints.nonnegative, finite=True, name="alpha")
        self.limit = Hyper(limit, finite=True, name="limit")
        self.negative_limit = (
            None if negative_limit is None else Hyper(negative_limit, finite=True, name="negative_limit")
        )

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)`` for ``dt (...)`` at an acceleration of 0."""
        spread = math.sqrt((4 - math.pi) / math.pi) * self.limit(dt)
        return per_axis(spread[..., None, None] * self._unit_root(dt), self.dims)

    def adaptation(self, dt: Tensor) -> Adaptation:
        """The estimated acceleration shifts the state and scales the process noise, axis by axis."""
        moved = torch.stack(_level_response(self.alpha(dt), dt), -1)
        limits = (limit(dt) for limit in (self.limit, self.negative_limit or self.limit))
        positive, negative, _ = torch.broadcast_tensors(*limits, dt)
        scale = torch.stack([positive / positive, negative / positive], -1)
        decrease = torch.stack([1 / positive, 1 / negative], -1)
        return Adaptation(per_axis(moved.unsqueeze(-1), self.dims), scale, decrease)


class GaussMarkov(Motion):
    """First-order Gauss-Markov process: a time-correlated error of zero mean and constant standard deviation.

    Satellite positions, radio ranges and radars have such errors on top of white noise.  ``Augmented(motion,
    GaussMarkov(...))`` has it beside a motion, ``Biased`` adds it to a sensor's measurement.

    Args:
        std: stationary standard deviation, in the unit of the measurement to which it is added.
        time: correlation time, s, after which the correlation is ``exp(-1)``.
        dims: number of components of kind "bias", independent of each other.

    Raises:
        ValueError: ``std`` below 0, ``time`` not above 0, ``dims`` below 1.

    Source: Brown & Hwang (2012), "Introduction to Random Signals and Applied Kalman Filtering", section 3.6.
    """

    linear = True

    def __init__(self, std: Value, time: Value, dims: int = 1) -> None:
        super().__init__(
            dims, 1, None, size=dims, position=slice(0, 0), velocity=slice(0, 0),
            components=[f"bias {i}" for i in range(dims)] if dims > 1 else ["bias"], kinds=["bias"] * dims,
        )  # fmt: skip
        self.std = Hyper(std, constraints.nonnegative, finite=True, name="std")
        self.time = Hyper(time, name="time")

    def transition(self, dt: Tensor) -> Tensor:
        """``exp(-dt / time) I (..., n, n)``."""
        return per_axis((-dt / self.time(dt)).exp()[..., None, None], self.size)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)``: ``std sqrt(1 - exp(-2 dt / time)) I``, which keeps the standard deviation constant."""
        grown, _, _ = _exponential_quotients(-2 * dt / self.time(dt))
        root = self.std(dt) * (2 / self.time(dt) * grown).sqrt() * dt.sqrt()
        return per_axis(root[..., None, None], self.size)


_FORGETTING = 4.0
"""``alpha dt`` from which on the process noise is in closed form: below it digits would cancel."""


def white_noise_root(alpha: Tensor, dt: Tensor, orders: int = 3) -> Tensor:
    """Root of the process noise of one axis, ``(..., orders, orders)``, for white noise of density 1 on the highest.

    The covariance is the integral over the step of the products of the responses.  Over a step that is short beside the
    memory it is that of Gauss-Legendre quadrature, which has no cancellation.  Over a long one the responses are sums
    of ``1``, ``s`` and ``exp(-alpha s)``, in an orthonormal basis of these three.  Both are exact to rounding.
    """
    alpha, dt = torch.broadcast_tensors(alpha, dt)
    at, weight = gauss_legendre(dt, 13)
    short, x = alpha * dt < _FORGETTING, alpha * dt
    near = torch.stack(_response(torch.where(short, alpha, 0.0).unsqueeze(-1), dt.unsqueeze(-1) * at), -2)
    far = _far_response(torch.where(short, _FORGETTING, x), dt)
    columns = torch.where(short[..., None, None], near * weight.sqrt(), pad(far, (0, len(weight) - 3)))
    return tria(columns[..., -orders:, :] * dt.sqrt()[..., None, None])


def _far_response(x: Tensor, dt: Tensor) -> Tensor:
    """Position, velocity and acceleration as functions of time over a step with ``x = alpha dt`` above 1.

    ``(..., 3, 3)`` coefficients of orthonormal functions on the step: the first two Legendre polynomials, and what is
    left of ``exp(-alpha s)`` beside them.
    """
    forgotten = -torch.expm1(-x)
    mean = forgotten / x  # of exp(-x t) over t from 0 to 1, and then its products with 2 t - 1 and itself
    slope = math.sqrt(3) * (2 * (mean - (-x).exp()) / x - mean)
    rest = (-torch.expm1(-2 * x) / (2 * x) - mean.square() - slope.square()).sqrt()
    position = torch.stack([mean - 1 + x / 2, slope + x / math.sqrt(12), rest], -1)
    velocity, acceleration = torch.stack([1 - mean, -slope, -rest], -1), torch.stack([mean, slope, rest], -1)
    moved = (dt / x).unsqueeze(-1)
    return torch.stack([moved.square() * position, moved * velocity, acceleration], -2)


def _response(alpha: Tensor, dt: Tensor) -> list[Tensor]:
    """Position, velocity and acceleration ``dt`` seconds after an acceleration of 1."""
    x = -alpha * dt
    one, two, _ = _exponential_quotients(x)
    return [dt**2 * two, dt * one, x.exp()]


def _level_response(alpha: Tensor, dt: Tensor) -> list[Tensor]:
    """Position, velocity and acceleration after ``dt`` seconds that were drawn to a level of 1, from 0."""
    x = alpha * dt
    one, two, three = _exponential_quotients(-x)
    return [dt**2 * x * three, dt * x * two, x * one]


def _exponential_quotients(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """``(e^x - 1) / x``, ``(e^x - 1 - x) / x^2`` and ``(e^x - 1 - x - x^2 / 2) / x^3``, smooth at 0."""
    small = x.abs() < 1
    safe = torch.where(small, -1.0, x)
    far = [torch.expm1(safe) / safe]
    for k in (1, 2):
        far.append((far[-1] - 1 / k) / safe)
    series, near = [torch.zeros_like(x)] * 3, torch.where(small, x, 0.0)
    for k in range(17, -1, -1):
        series = [s * near + 1 / math.factorial(k + order) for s, order in zip(series, (1, 2, 3), strict=True)]
    one, two, three = (torch.where(small, a, b) for a, b in zip(series, far, strict=True))
    return one, two, three
