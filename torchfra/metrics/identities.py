"""How well tracks keep to their targets over a whole sequence: HOTA and IDF1."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.metrics.lives import least_cost, tracks_and_targets

THRESHOLDS = np.arange(1, 20) / 20
"""Least similarities of a pair, over which HOTA is a mean."""
_TINY = 1e-4
"""What the similarity of a pair counts beside its association, and that beside one more pair."""
_Floats = NDArray[np.float64]


class HOTA(NamedTuple):
    """Higher order tracking accuracy and its parts, from 0 to 1: means over the thresholds of similarity.

    NaN where there are neither targets nor estimates.
    """

    score: Tensor
    """``(...)`` the mean of the geometric mean of detection and association."""
    detection: Tensor
    """``(...)`` pairs over pairs, missed targets and false estimates together."""
    association: Tensor
    """``(...)`` mean over the pairs: scans in which this track and this target are a pair, over the scans in which
    either is there; 0 where there is no pair."""
    localisation: Tensor
    """``(...)`` mean similarity of the pairs; 0 where there is no pair."""


class IDF1(NamedTuple):
    """Identity scores, from 0 to 1, where each target is of one track at most and each track of one target.

    NaN where what they divide by is 0.
    """

    score: Tensor
    """``(...)`` the harmonic mean of precision and recall."""
    precision: Tensor
    """``(...)`` share of the estimates that are of the target of their track."""
    recall: Tensor
    """``(...)`` share of the scans of targets in which their track is within the cutoff."""


def hota(mean: Tensor, truth: Tensor, states: slice, *, cutoff: float = 100.0) -> HOTA:
    """Higher order tracking accuracy: detection and association weigh alike.

    The similarity of an estimate and a target is ``1 - distance / cutoff``.  For each threshold 0.05, 0.1, ... 0.95
    estimates and targets of a scan are paired where it is not below that: as many pairs as possible, among those the
    ones whose track and target could be a pair most often, and then the most similar.

    Args:
        mean: ``(..., N, T, n)`` estimates, each of one identity; NaN where it does not exist.
        truth: ``(..., M, T, n)``; NaN where the target does not exist.
        states: the components to compare, ``scenario.position`` say; where that raises, ``scenario.truth_position``
            after ``scenario.cartesian``.
        cutoff: distance at which the similarity is 0, m.

    Raises:
        ImportError: scipy is not installed.
        ValueError: a cutoff that is not above 0, an infinite one, or shapes that do not match.

    Source: Luiten, Osep, Dendorfer, Torr, Geiger, Leal-Taixe & Leibe (2021), "HOTA: A Higher Order Metric for
    Evaluating Multi-Object Tracking", equations 4 to 13.  Differs: the similarity is of distances.
    """
    tracks, targets, batch = tracks_and_targets(mean, truth, states, cutoff)
    found = np.zeros((len(tracks), len(HOTA._fields)))
    for i, (e, t) in enumerate(zip(tracks, targets, strict=True)):
        similar = np.maximum(0.0, 1 - _distances(t, e) / cutoff)
        lengths = ((~np.isnan(x).any(-1)).sum(-1) for x in (t, e))
        found[i] = _hota(similar, *lengths)
    return HOTA(*torch.from_numpy(found).to(mean.device).reshape(*batch, -1).unbind(-1))


def idf1(mean: Tensor, truth: Tensor, states: slice, *, cutoff: float = 100.0) -> IDF1:
    """The share of scans in which targets are followed by the one track that is taken to be theirs.

    Tracks are assigned to targets for the whole sequence, such that estimates are within the cutoff of the target of
    their track in as many scans as possible.

    Args:
        mean: ``(..., N, T, n)`` estimates, each of one identity; NaN where it does not exist.
        truth: ``(..., M, T, n)``; NaN where the target does not exist.
        states: the components to compare, as for ``hota``.
        cutoff: distance from which on a track does not follow a target, m.

    Raises:
        ImportError: scipy is not installed.
        ValueError: a cutoff that is not above 0, an infinite one, or shapes that do not match.

    Source: Ristani, Solera, Zou, Cucchiara & Tomasi (2016), "Performance Measures and a Data Set for Multi-Target,
    Multi-Camera Tracking".
    """
    tracks, targets, batch = tracks_and_targets(mean, truth, states, cutoff)
    shared = np.zeros(len(tracks))
    for i, (e, t) in enumerate(zip(tracks, targets, strict=True)):
        together = (_distances(t, e) < cutoff).sum(-1)
        shared[i] = together[least_cost(-together)].sum()
    estimates, there = ((~np.isnan(x).any(-1)).sum((-2, -1)) for x in (tracks, targets))
    own, all_estimates, all_targets = (
        torch.from_numpy(np.asarray(x, dtype=np.float64)).to(mean.device).reshape(batch)
        for x in (shared, estimates, there)
    )
    return IDF1(2 * own / (all_estimates + all_targets), own / all_estimates, own / all_targets)


def _distances(targets: _Floats, tracks: _Floats) -> _Floats:
    """Distances ``(M, N, T)``, infinite where one of both is not there."""
    gap: _Floats = np.linalg.norm(targets[:, None] - tracks[None], axis=-1)
    return np.where(np.isnan(gap), np.inf, gap)


def _hota(similar: _Floats, targets: NDArray[np.int64], tracks: NDArray[np.int64]) -> _Floats:
    """The fields of ``HOTA`` from similarities ``(M, N, T)`` and lengths ``(M,)`` and ``(N,)``."""
    whole = targets.sum() + tracks.sum()
    if not whole:
        return np.full(len(HOTA._fields), np.nan)
    parts = np.zeros((len(THRESHOLDS), len(HOTA._fields)))
    for k, least in enumerate(THRESHOLDS):
        near = similar >= least
        most = near.sum(-1)
        association = most / np.maximum(1, targets[:, None] + tracks - most)
        gain = np.where(near, 1 / _TINY + association[..., None] + _TINY * similar, 0.0)
        pairs = np.zeros_like(near)
        for t in np.flatnonzero(near.any((0, 1))):
            pairs[(*least_cost(-gain[..., t]), t)] = True
        pairs &= near
        together, count = pairs.sum(-1), pairs.sum()
        detection = count / (whole - count)
        shared = (together**2 / np.maximum(1, targets[:, None] + tracks - together)).sum() / max(1, count)
        parts[k] = np.sqrt(detection * shared), detection, shared, similar[pairs].sum() / max(1, count)
    mean: _Floats = parts.mean(0)
    return mean
