"""The likelihood of measurements by a filter's values, for samplers and optimisers of other libraries."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import torch
from numpy.typing import ArrayLike

from torchfra.filters import Filter
from torchfra.fitting.data import Source, batch_of
from torchfra.fitting.objective import compiled, objective_of
from torchfra.fitting.vector import Vector, copied
from torchfra.numbers import Array


class LogLikelihood:
    """The log likelihood of measurements and its gradient by the values that a filter learns; numpy in, numpy out.

    Values are unconstrained, logarithms of what is positive and log odds of probabilities, so that samplers such as
    NUTS may go anywhere::

        likelihood = torchfra.fitting.LogLikelihood(f, z, learn=("q", "std"))
        value, gradient = likelihood(likelihood.start)

    A sampler such as BlackJAX, PyMC or emcee adds the log density of its prior and that one's gradient.

    Args:
        filter: any preset of single targets; it stays as it is.
        data: measurements ``z (N, T, m)``, or anything else that ``torchfra.fit`` takes.
        learn: names of hyperparameters; None for those that are learnable already.
        skip: steps at the start of each track that do not count.
        compile: whether the filter runs as compiled kernels; None where it can.

    Raises:
        ValueError: arguments that do not fit each other.
        CompileError, NotImplementedError: the filter cannot be compiled, with ``compile=True``.
    """

    def __init__(
        self, filter: Filter, data: Source, *, learn: Collection[str] | None = None, skip: int = 0,
        compile: bool | None = None,
    ) -> None:  # fmt: skip
        f = copied(filter, learn)
        self._vector, self._tracks = Vector(f), batch_of(f, data, runs=400, seed=0)
        self._objective = objective_of(f, self._vector, data, self._tracks, "likelihood", None, skip)
        self.notes, _ = compiled(self._objective, self._tracks, compile)
        self.names: list[str] = self._vector.names
        """Of the values, ``"motion.q"``."""
        self.start: Array = self._vector.raw().numpy()
        """``(P,)`` the filter's own values."""

    def __call__(self, raw: ArrayLike) -> tuple[Array, Array]:
        """The log likelihood ``(...)`` of all tracks at ``raw (..., P)``, of chains say, and its gradient ``(..., P)``.

        Both are NaN where the filter fails.

        Raises:
            ValueError: another number of values.
        """
        at = torch.as_tensor(np.asarray(raw, dtype=np.float64))
        if at.dim() == 0 or at.shape[-1] != len(self.names):
            raise ValueError(f"raw: expected (..., {len(self.names)}), received {tuple(at.shape)}")
        loss, slope = self._objective.gradients(at.reshape(-1, 1, at.shape[-1]), self._tracks)
        value, gradient = -loss.sum(-1).reshape(at.shape[:-1]), -slope.sum(1).reshape(at.shape)
        return value.numpy(), gradient.numpy()

    def natural(self, raw: ArrayLike) -> Array:
        """Values ``(..., P)`` in the units of the filter."""
        found: Array = self._vector.natural(torch.as_tensor(np.asarray(raw, dtype=np.float64))).numpy()
        return found
