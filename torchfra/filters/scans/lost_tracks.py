"""Tracks that have been missed so often that they are considered lost, and the inflation of their covariances."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfra.association.clusters import Association
from torchfra.association.gates import Gate
from torchfra.hyper import Hyper
from torchfra.types import Gaussian, Prediction

_MOST_INFLATIONS = 5.0
"""Largest number of times that the covariance of a lost track quadruples."""


def log_miss(detection: Hyper, gate: Gate, like: Tensor) -> Tensor:
    """Log of the probability that a target has no measurement in its gate: a number or ``(..., N)``."""
    detected, inside = detection(like), gate.gate_probability()
    detected = detected if inside is None else detected * inside.to(like)
    # A probability that is 1 up to rounding counts as 1: such a target is never missed.
    some = detected < 1 - 4 * torch.finfo(detected.dtype).eps
    miss = torch.where(some, torch.log1p(-torch.where(some, detected, 0.0)), -torch.inf)
    return miss.squeeze(-1) if miss.dim() else miss


def log_unseen(log_miss: Tensor, visible: Tensor) -> Tensor:
    """Log probability of a miss ``(..., N)`` of targets that are visible to the sensor with probability ``visible``."""
    return torch.log1p(visible * torch.expm1(log_miss))


def missed_scans(before: Tensor, association: Association, measured: Tensor, count_empty: bool) -> Tensor:
    """Expected number ``(..., N)`` of scans since the last measurement.

    Args:
        before: ``(..., N)`` before this scan.
        association: of this scan.
        measured: ``(..., 1, J, m)`` 1 where measured.
        count_empty: whether a scan without any measurement counts as missing all targets.
    """
    some = ((measured.sum((-2, -1)) > 0) | count_empty).expand(before.shape)
    return torch.where(some, association.log_weights[..., 0].exp() * (before + 1), before)


def lost_inflation(missed: Tensor, inflations: Tensor, log_miss: Tensor, lost: float) -> tuple[Tensor, Tensor]:
    """Factor ``(..., N)`` on the covariance root of a lost track, and the number of times it has been quadrupled.

    Args:
        missed: ``(..., N)`` expected number of scans since the last measurement.
        inflations: ``(..., N)`` number of times that the covariance has been quadrupled before.
        log_miss: log of the probability that a target has no measurement in its gate.
        lost: probability of so many misses in a row below which a track is considered lost.
    """
    tolerated = math.log(lost) / log_miss
    wanted = (missed - tolerated).clamp(0.0, _MOST_INFLATIONS)
    return 2.0 ** (wanted - inflations).clamp_min(0.0), wanted


def inflated(prediction: Prediction, factor: Tensor) -> Prediction:
    """A prediction ``(..., N, 1)`` whose covariance root is multiplied by ``factor (..., N)``."""
    factor = factor[..., None, None, None]
    (mean, root), spread, process_noise, repaired = prediction
    return Prediction(Gaussian(mean, factor * root), factor * spread, factor * process_noise, repaired)
