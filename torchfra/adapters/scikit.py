"""An estimator of scikit-learn that smooths points over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from torchfra.adapters.points import noise_and_motion, smoothed
from torchfra.numbers import as_numbers, positive
from torchfra.running.optional import optional
from torchfra.types import Estimate

base: Any = optional("sklearn.base", "torchfra.adapters.scikit", "frames")


class Smoother(base.TransformerMixin, base.BaseEstimator):  # type: ignore[misc]  # of no known type
    """Finds noise and motion of points in ``fit``, and smooths them in ``transform``; outliers are not followed.

    Rows are times, columns the coordinates of one or more points, ``dims`` for each, NaN where missing.

    Args:
        dims: coordinates of each point.
        period: seconds from row to row.
        std: standard deviation of the noise, in units of the columns; None finds that of each point, ``std_``.
        q: density of the process noise, squares of these units per s^3; None finds that of each point, ``q_``.
        smooth: whether later rows count too.
        compile: whether to run compiled; needs the extra ``compiler``.
    """

    def __init__(
        self, dims: int = 2, period: float = 1.0, std: float | None = None, q: float | None = None, smooth: bool = True,
        compile: bool = False,
    ) -> None:  # fmt: skip
        self.dims, self.period, self.std, self.q, self.smooth, self.compile = dims, period, std, q, smooth, compile

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Finds the noise ``std_`` and the motion ``q_`` of each point from rows ``X (T, dims * points)``.

        Raises:
            ValueError: columns that do not fit, or a point that is too short or too still to tell.
        """
        std, q = noise_and_motion(self._points(X), positive("period", self.period))
        for name, given, found in (("std", self.std, std), ("q", self.q, q)):
            if given is None and not bool(found.isfinite().all()):
                raise ValueError(f"X: expected points that move, in some 30 rows or more, to tell {name}, or {name}=")
        self.std_ = std if self.std is None else torch.full_like(std, positive("std", self.std))
        self.q_ = q if self.q is None else torch.full_like(q, positive("q", self.q))
        self.n_features_in_ = self.dims * len(std)
        return self

    def transform(self, X: ArrayLike) -> NDArray[np.float64]:
        """The smoothed rows ``(T, dims * points)``.

        Raises:
            ValueError: columns that do not fit those of ``fit``.
        """
        mean: NDArray[np.float64] = self._estimate(X).mean[..., : self.dims].transpose(0, 1).flatten(1).numpy()
        return mean

    def score(self, X: ArrayLike, y: ArrayLike | None = None) -> float:
        """The mean log likelihood of a row, given those before it, by which values may be chosen."""
        return float(self._estimate(X, smooth=False).log_likelihood.sum(0).mean())

    def _estimate(self, X: ArrayLike, smooth: bool | None = None) -> Estimate:
        z = self._points(X)
        if len(z) != len(self.std_):
            raise ValueError(f"X: expected {self.n_features_in_} columns as in fit, received {self.dims * len(z)}")
        dt, std = z.new_full(z.shape[1:2], self.period), self.std_[:, None, None].expand(-1, z.shape[1], 1)
        return smoothed(z, dt, std, self.q_, smooth=self.smooth if smooth is None else smooth, compile=self.compile)

    def _points(self, X: ArrayLike) -> torch.Tensor:
        """Rows as points ``(points, T, dims)``."""
        z = as_numbers(X, "X").double()
        if z.dim() != 2 or z.shape[1] == 0 or z.shape[1] % self.dims:
            raise ValueError(f"X: expected rows of {self.dims} columns for each point, received {tuple(z.shape)}")
        points: torch.Tensor = z.unflatten(1, (-1, self.dims)).transpose(0, 1)
        return points
