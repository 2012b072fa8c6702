"""A forecast: the predicted state after a time step, and the predicted measurement; and moments of hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.gaussian.mixture import moment_match
from torchfra.types import Gaussian


class Forecast(NamedTuple):
    """The prediction of a filter, with the moments of all its hypotheses: see ``Filter.predict``."""

    belief: Gaussian
    """``(..., n)`` the predicted state."""
    measurement: Gaussian
    """``(..., m)`` the predicted measurement, its noise included; angles are near that of the mean state."""


def moments(beliefs: Gaussian, log_weights: Tensor, angles: Sequence[int] = ()) -> Gaussian:
    """The Gaussian with the moments of hypotheses ``(H, ...)``; ``angles`` are components that are angles."""
    if len(log_weights) > 1:
        return moment_match(beliefs, log_weights, angles)
    return Gaussian(beliefs.mean[0], beliefs.scale_tril[0])


def one_hypothesis(belief: Gaussian) -> tuple[Gaussian, Tensor]:
    """A belief ``(..., n)`` as the only hypothesis ``(1, ..., n)``, and the log of its weight."""
    mean, root = (x.unsqueeze(0) for x in belief)
    return Gaussian(mean, root), torch.zeros_like(mean[..., 0])
