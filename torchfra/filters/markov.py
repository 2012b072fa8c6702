"""Markov chains in continuous time: from mean sojourn times in seconds to transition probabilities over a step."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_divide
from torchfra.linalg.tracing import batchwise
from torchfra.numbers import as_numbers

DOUBLINGS = 20
"""Number of times that a step is halved.  A step counts as two million of the shortest mean sojourn times at most."""


def sojourn_times(value: Value, event_dim: int, name: str) -> Hyper:
    """Mean sojourn times of states, s, as a hyperparameter.

    Raises:
        ValueError: one is not above 0, or infinite: such a chain has no stationary distribution to start from.
    """
    value = as_numbers(value, name).double()
    if bool(value.isinf().any()):
        raise ValueError(f"{name}: expected finite numbers of seconds, received {value.tolist()}")
    return Hyper(value, event_dim=event_dim, finite=True, name=name)


def generator(durations: Tensor, follows: Tensor) -> Tensor:
    """The generator ``(..., K, K)`` in 1/s, ``[was, now]``, whose rows sum to zero.

    Args:
        durations: ``(..., K)`` mean sojourn times, s.
        follows: ``(..., K, K)`` or ``(..., 1, K)`` probabilities of the next state; it may be the same state.
    """
    eye = torch.eye(durations.shape[-1], dtype=durations.dtype, device=durations.device)
    return (follows - eye) / durations.unsqueeze(-1)


def transition_over(generator: Tensor, dt: Tensor) -> Tensor:
    """Transition probabilities ``exp(G dt) (..., K, K)``, ``[was, now]``, over ``dt (...)`` seconds.

    Two steps have the same probabilities as one step of their sum, and over 0 s they are the identity.  The
    exponential of a step that is short beside all sojourn times is squared again and again; its difference to the
    identity is what is squared, so that small probabilities keep their digits; what rounding leaves below 0 is 0.
    All of it is elementary arithmetic with exact gradients.

    Source: Moler & Van Loan (2003), "Nineteen dubious ways to compute the exponential of a matrix", method 3.
    """
    fastest = (-generator.diagonal(dim1=-2, dim2=-1)).amax(-1)
    # A longer step is cut: its series would not converge after the halvings.
    ends = (fastest * dt).clamp_max(2.0 ** (DOUBLINGS + 1))
    small = generator * (safe_divide(ends, fastest) / 2**DOUBLINGS)[..., None, None]
    square = small @ small
    change = small + square / 2 + square @ (small / 6 + square / 24)  # exp(small) - I to fourth order
    for _ in range(DOUBLINGS // _TOGETHER):
        change = _doubled(change)
    eye = torch.eye(generator.shape[-1], dtype=generator.dtype, device=generator.device)
    probabilities: Tensor = (eye + change).clamp_min(0.0)
    return probabilities


_TOGETHER = 5
"""Doublings by one call of a function of a large step."""


@batchwise(2)
def _doubled(change: Tensor) -> Tensor:
    """``(I + change)^2 - I``, ``_TOGETHER`` times."""
    for _ in range(_TOGETHER):
        change = 2 * change + change @ change
    return change
