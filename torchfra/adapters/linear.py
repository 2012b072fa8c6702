"""What the adapters of libraries with matrices share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian


class Models(NamedTuple):
    """Parts of another library's filter from which ours is made."""

    motion: Motion
    sensor: Sensor
    prior: Gaussian


def of_seconds(matrix: Callable[[float], Any]) -> Callable[[Tensor], Tensor]:
    """A function of a number that gives an array as one of ``dt (...)``: each different step is computed once."""

    def each(dt: Tensor) -> Tensor:
        seconds, where = dt.detach().unique(return_inverse=True)
        found = np.stack([np.asarray(matrix(float(s)), dtype=float) for s in seconds.tolist()])
        return torch.from_numpy(found).to(dt)[where]

    return each


def gaussian(mean: ArrayLike, covariance: ArrayLike, order: Sequence[int]) -> Gaussian:
    """A belief, its components in another order."""
    index = list(order)
    return Gaussian.from_covariance(
        np.asarray(mean, dtype=float).reshape(-1)[index], np.asarray(covariance, dtype=float)[np.ix_(index, index)]
    )


def checked_order(order: Sequence[int] | None, size: int) -> list[int]:
    """The numbers of the components in the order of torchfra; as they are for None.

    Raises:
        ValueError: an order that does not name each component once.
    """
    found = list(range(size)) if order is None else [int(i) for i in order]
    if sorted(found) != list(range(size)):
        raise ValueError(f"order: expected each of the components 0 to {size - 1} once, received {found}")
    return found
