"""Markov chains in continuous time: from mean durations in seconds to probabilities over a step."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_divide

DOUBLINGS = 20
"""A step is halved so many times; one of more than two million of the shortest mean durations counts as that long."""


def mean_durations(value: Value, event_dim: int, name: str) -> Hyper:
    """Mean seconds until states end.

    Raises:
        ValueError: one that is not above 0, or infinite: a chain with such a state has no long run to start from.
    """
    value = torch.as_tensor(value, dtype=torch.float64)
    if bool(value.isinf().any()):
        raise ValueError(f"{name}: expected finite numbers of seconds, received {value.tolist()}")
    return Hyper(value, event_dim=event_dim, name=name)


def rates(durations: Tensor, follows: Tensor) -> Tensor:
    """The generator ``(..., K, K)`` in 1/s, ``[was, now]``, whose rows sum to zero.

    Args:
        durations: ``(..., K)`` mean seconds until each state ends.
        follows: ``(..., K, K)`` or ``(..., 1, K)`` probabilities of what follows it then; the state itself may.
    """
    eye = torch.eye(durations.shape[-1], dtype=durations.dtype, device=durations.device)
    return (follows - eye) / durations.unsqueeze(-1)


def over_seconds(generator: Tensor, dt: Tensor) -> Tensor:
    """Probabilities ``exp(G dt) (..., K, K)``, ``[was, now]``, over ``dt (...)`` seconds.

    Two steps give what one of their sum gives, and a step of 0 s changes nothing.  It is squared from a step that is
    short beside all durations, without its identity, so that small probabilities keep their digits.  All of it is
    elementary arithmetic, and the gradients are exact.

    Source: Moler & Van Loan (2003), "Nineteen dubious ways to compute the exponential of a matrix", method 3.
    """
    fastest = (-generator.diagonal(dim1=-2, dim2=-1)).amax(-1)
    stable = torch.minimum(fastest * dt, torch.as_tensor(2.0 ** (DOUBLINGS + 1)).to(fastest))  # where the series is
    first = generator * (safe_divide(stable, fastest) / 2**DOUBLINGS)[..., None, None]
    square = first @ first
    change = first + square / 2 + square @ (first / 6 + square / 24)
    for _ in range(DOUBLINGS):
        change = 2 * change + change @ change
    eye = torch.eye(generator.shape[-1], dtype=generator.dtype, device=generator.device)
    probabilities: Tensor = (eye + change).clamp_min(0.0)
    return probabilities
