"""Tracks that are missed so often that they seem lost: how often, and how wide they then search."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfra.association.clusters import Association
from torchfra.association.gates import Gate
from torchfra.hyper import Hyper
from torchfra.types import Gaussian, Prediction

_SEARCH = 5.0
"""Times that the covariance of a track that seems lost quadruples."""


def log_miss(detection: Hyper, gate: Gate, like: Tensor) -> Tensor:
    """Log of the probability that a target has no measurement in its gate: a number or ``(..., N)``."""
    chance, inside = detection(like), gate.gate_probability()
    chance = chance if inside is None else chance * inside.to(like)
    some = chance < 1 - 4 * torch.finfo(chance.dtype).eps
    miss = torch.where(some, torch.log1p(-torch.where(some, chance, 0.0)), -torch.inf)
    return miss.squeeze(-1) if miss.dim() else miss


def log_unseen(log_miss: Tensor, visible: Tensor) -> Tensor:
    """The same ``(..., N)`` of targets that the sensor sees with a probability ``visible (..., N)`` only."""
    return torch.log1p(visible * torch.expm1(log_miss))


def missed_scans(before: Tensor, association: Association, measured: Tensor, count_empty: bool) -> Tensor:
    """Expected scans ``(..., N)`` since the last measurement.

    Args:
        before: ``(..., N)``.
        association: of this scan.
        measured: ``(..., 1, J, m)`` 1 where measured.
        count_empty: whether all targets are missed in a scan without any measurement; else it changes nothing.
    """
    some = ((measured.sum((-2, -1)) > 0) | count_empty).expand(before.shape)
    return torch.where(some, association.log_weights[..., 0].exp() * (before + 1), before)


def search(missed: Tensor, searched: Tensor, log_miss: Tensor, lost: float) -> tuple[Tensor, Tensor]:
    """Factor ``(..., N)`` on the root of the covariance of a track that seems lost, and how often it has been widened.

    Args:
        missed: ``(..., N)`` scans since the last measurement.
        searched: ``(..., N)`` how often the covariance has been quadrupled.
        log_miss: see above.
        lost: probability to be missed so often by chance, below which a track seems lost.
    """
    patience = math.log(lost) / log_miss
    wanted = (missed - patience).clamp(0.0, _SEARCH)
    return 2.0 ** (wanted - searched).clamp_min(0.0), wanted


def wider(prediction: Prediction, times: Tensor) -> Prediction:
    """A prediction ``(..., N, 1)`` whose covariance has a root ``times (..., N)`` as large."""
    factor = times[..., None, None, None]
    (mean, root), spread, process_noise, repaired = prediction
    return Prediction(Gaussian(mean, factor * root), factor * spread, factor * process_noise, repaired)
