"""Constant gains of alpha-beta(-gamma) filters: their design, and the variances to which they lead.

Per axis, with the residual ``r`` of a position and the time step ``T``:

    position += alpha r,    velocity += beta / T r,    acceleration += gamma / (2 T^2) r.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.hyper import Value
from torchfra.numbers import as_numbers


class Gains(NamedTuple):
    """Gains of one filter, or of several in a last dimension."""

    alpha: Tensor
    beta: Tensor
    gamma: Tensor | None = None


class Variances(NamedTuple):
    """Steady-state variances, in units of that of the measurement noise, for a step ``T`` of 1."""

    position: Tensor
    cross: Tensor
    """Covariance of position and velocity."""
    velocity: Tensor
    prediction: Tensor
    """Variance of the predicted position; that of the residual is larger by 1."""


def kalata(index: Value, orders: int = 2) -> Gains:
    """Steady-state Kalman gains for a random acceleration (with ``orders`` 3: a change of acceleration) in each step.

    Args:
        index: tracking index ``std(acceleration) T^2 / std(measurement)``, above 0.
        orders: 2 for alpha-beta, 3 for alpha-beta-gamma.

    Raises:
        ValueError: an index that is not above 0, or other orders.

    Source: Kalata (1984), "The Tracking Index"; Gray & Murray (1993) for the closed form of three gains.
    """
    index = as_numbers(index, "index").double()
    if not bool((index > 0).all()) or orders not in (2, 3):
        raise ValueError(
            f"index, orders: expected index above 0 and orders 2 or 3, received {index.tolist()}, {orders}"
        )
    if orders == 2:
        root = (4 + index - (8 * index + index.square()).sqrt()) / 4
        return Gains(1 - root.square(), 2 * (1 + root.square()) - 4 * root)
    b, c = index / 2 - 3, index / 2 + 3
    p, q = c - b.square() / 3, 2 * b**3 / 27 - b * c / 3 - 1
    z = -((q + (q.square() + 4 * p**3 / 27).sqrt()) / 2)
    z = z.sign() * z.abs() ** (1 / 3)
    s = z - p / (3 * z) - b / 3
    return Gains(1 - s.square(), 2 * (1 - s).square(), 2 * index * s)


def levels(orders: int = 2) -> Gains:
    """Gains of a bank of three filters: for hard and mild manoeuvres and straight flight.

    The tracking indices are 1.5, 0.5 and 0.1.  With ``orders`` 3 the first two have three gains, of index 0.1 and 0.03.
    """
    two = kalata(torch.tensor([1.5, 0.5, 0.1], dtype=torch.float64))
    if orders == 2:
        return two
    three = kalata(torch.tensor([0.1, 0.03], dtype=torch.float64), 3)
    assert three.gamma is not None
    alpha, beta = torch.cat([three.alpha, two.alpha[-1:]]), torch.cat([three.beta, two.beta[-1:]])
    return Gains(alpha, beta, torch.nn.functional.pad(three.gamma, (0, 1)))


def benedict_bordner(alpha: Value) -> Gains:
    """Gains that minimise a weighted sum of noise and transient errors.  Source: Benedict & Bordner (1962).

    Raises:
        ValueError: ``alpha`` not in (0, 1].
    """
    alpha = _as_share("alpha", alpha)
    return Gains(alpha, alpha.square() / (2 - alpha))


def critically_damped(theta: Value) -> Gains:
    """Gains of fading memory: both poles at ``theta``, in (0, 1).  Source: Morrison (1969).

    Raises:
        ValueError: ``theta`` not in (0, 1).
    """
    theta = _as_share("theta", theta)
    if bool((theta == 1).any()):
        raise ValueError(f"theta: expected a value below 1, which would use no measurement, received {theta.tolist()}")
    return Gains(1 - theta.square(), (1 - theta).square())


def expanding_memory(k: Tensor) -> Gains:
    """Gains for measurement ``k = 1, 2, ...``, by which the estimate is the least-squares line through all so far."""
    return Gains(2 * (2 * k - 1) / (k * (k + 1)), torch.where(k > 1, 6 / (k * (k + 1)), 0.0))


def variances(alpha: Tensor, beta: Tensor) -> Variances:
    """Variances by white measurement noise.  Source: Bar-Shalom, Li & Kirubarajan (2001), section 6.5."""
    scale = alpha * (4 - 2 * alpha - beta)
    square, product = 2 * alpha.square() + 2 * beta, alpha * beta
    return Variances(
        (square - 3 * product) / scale,
        beta * (2 * alpha - beta) / scale,
        2 * beta.square() / scale,
        (square + product) / scale,
    )


def stable(gains: Gains) -> bool:
    """Whether every filter is stable: errors decay."""
    alpha, beta, gamma = gains
    column = [alpha, beta] if gamma is None else [alpha, beta, gamma / 2]
    gain = torch.stack(torch.broadcast_tensors(*column), -1)
    k = gain.shape[-1]
    powers = torch.arange(k).unsqueeze(0) - torch.arange(k).unsqueeze(1)
    factorial = torch.exp(torch.lgamma(powers.clamp_min(0).double() + 1))
    transition = torch.where(powers >= 0, 1 / factorial, 0.0)
    eye = torch.eye(k, dtype=torch.float64)
    step = (eye - gain.double().unsqueeze(-1) * eye[0]) @ transition
    return bool((torch.linalg.eigvals(step).abs().amax(-1) < 1).all()) and bool((gain > 0).all())


def _as_share(name: str, value: Value) -> Tensor:
    """A value above 0 and at most 1, as a tensor."""
    value = as_numbers(value, name).double()
    if not bool(((value > 0) & (value <= 1)).all()):
        raise ValueError(f"{name}: expected a value above 0 and at most 1, received {value.tolist()}")
    return value
