"""Matrices that motions are built from: powers of the time step, and one axis repeated for all of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad


def taylor(dt: Tensor, power: Tensor) -> Tensor:
    """``dt^k / k!`` for every k in ``power``, in a new last dimension (or, for a square of powers, the last of dt)."""
    factorial = torch.exp(torch.lgamma(power.to(dt) + 1)).round()
    return dt.unsqueeze(-1) ** power / factorial


def per_axis(block: Tensor, dims: int) -> Tensor:
    """Kronecker product with the identity over the axes: ``(..., a, b) -> (..., a dims, b dims)``."""
    eye = torch.eye(dims, dtype=block.dtype, device=block.device)
    product = block.unsqueeze(-2).unsqueeze(-1) * eye.unsqueeze(-2)
    return product.flatten(-2).flatten(-3, -2)


def scaled_per_axis(scale: Tensor, block: Tensor, dims: int) -> Tensor:
    """``per_axis`` of ``scale (...)`` times ``block (..., a, b)``."""
    return per_axis(scale[..., None, None] * block, dims)


def zero_padded(matrix: Tensor, size: int) -> Tensor:
    """``(..., a, b)`` filled up with zeros to ``(..., size, size)``."""
    return pad(matrix, (0, size - matrix.shape[-1], 0, size - matrix.shape[-2]))


def acceleration_gain(dt: Tensor, variance: Tensor, powers: Sequence[int], dims: int) -> Tensor:
    """``sqrt(variance) dt^k / k!`` for every k in ``powers``, per axis: ``(..., len(powers) dims, dims)``.

    The root of the process noise that one acceleration (or change of it) per step, constant over the step, leaves in
    the state.
    """
    gain = taylor(dt, torch.tensor(powers, device=dt.device))
    return per_axis((variance.sqrt().unsqueeze(-1) * gain).unsqueeze(-1), dims)
