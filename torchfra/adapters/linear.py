"""Models by their matrices, whatever library they come from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian

Array = NDArray[np.float64]
_ROUNDING = 1e-9
"""Largest negative eigenvalue of a covariance that counts as rounding, relative to the largest eigenvalue."""


class Models(NamedTuple):
    """Parts of another library's filter from which ours is made."""

    motion: Motion
    sensor: Sensor
    prior: Gaussian


class LinearMotion(Motion):
    """A linear motion by the matrices of a step, which may be computed by another library.

    Args:
        matrices: the transition ``(n, n)`` and the covariance of the process noise ``(n, n)`` for a number of seconds.
        size: ``n``.
        dims: positions, the first components of the state; velocities follow.
        control: ``(n, k)`` matrix of the shift by ``u (..., k)``; None for none.
    """

    linear = True
    control: Tensor | None

    def __init__(
        self, matrices: Callable[[float], tuple[Array, Array]], size: int, dims: int, control: Array | None = None
    ) -> None:
        super().__init__(dims, max(size // dims, 1), None, size=size)
        self.matrices = matrices
        self.register_buffer("control", None if control is None else torch.from_numpy(control), persistent=False)

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)``."""
        return self._each(dt, lambda seconds: self.matrices(seconds)[0])

    def process_noise(self, dt: Tensor) -> Tensor:
        """Root of the process noise ``(..., n, n)`` for ``dt (...)``."""
        return self._each(dt, lambda seconds: root_of(self.matrices(seconds)[1], "process noise"))

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """The shift of the state by ``u (..., k)``."""
        return None if self.control is None or u is None else u @ self.control.to(u).mT

    def _each(self, dt: Tensor, of: Callable[[float], Array]) -> Tensor:
        """Matrices ``(..., n, n)``, each different step computed once."""
        seconds, where = dt.detach().unique(return_inverse=True)
        found = np.stack([np.asarray(of(float(s)), dtype=float) for s in seconds.tolist()])
        return torch.from_numpy(found).to(dt)[where]


class LinearSensor(Sensor):
    """A measurement that is a matrix times the state.

    Args:
        matrix: ``H (m, n)``.
        covariance: ``R (m, m)`` of the measurement noise.
    """

    matrix: Tensor
    linear = True

    def __init__(self, matrix: Array, covariance: Array) -> None:
        noise = torch.from_numpy(root_of(covariance, "measurement noise"))
        super().__init__(matrix.shape[1], [False] * len(matrix), noise=noise)
        self.register_buffer("matrix", torch.from_numpy(np.array(matrix, dtype=float)), persistent=False)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """``H x`` of states ``(..., n)``."""
        return x[..., : self.reads] @ self.matrix.to(x).mT


def root_of(covariance: Any, what: str) -> Array:
    """A root ``(n, n)`` of a covariance of any rank.

    Raises:
        ValueError: a matrix that is not one.
    """
    matrix = np.asarray(covariance, dtype=float)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.isfinite(matrix).all():
        raise ValueError(f"{what}: expected a covariance (n, n), received {matrix.shape}")
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    largest = max(values.max(initial=0.0), np.finfo(float).tiny)
    if values.min(initial=0.0) < -_ROUNDING * largest or np.abs(matrix - matrix.T).max() > 1e-6 * largest:
        raise ValueError(f"{what}: expected a symmetric positive semidefinite matrix, received {matrix.tolist()}")
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def gaussian(mean: Any, covariance: Any, order: Sequence[int]) -> Gaussian:
    """A belief, its components in another order."""
    index = list(order)
    root = root_of(np.asarray(covariance, dtype=float)[np.ix_(index, index)], "covariance")
    return Gaussian(torch.from_numpy(np.asarray(mean, dtype=float).reshape(-1)[index]), torch.from_numpy(root))


def checked_order(order: Sequence[int] | None, size: int) -> list[int]:
    """The numbers of the components in the order of torchfra; as they are for None.

    Raises:
        ValueError: an order that does not name each component once.
    """
    found = list(range(size)) if order is None else [int(i) for i in order]
    if sorted(found) != list(range(size)):
        raise ValueError(f"order: expected each of the components 0 to {size - 1} once, received {found}")
    return found
