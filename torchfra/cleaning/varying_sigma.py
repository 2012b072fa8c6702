"""A standard deviation of fixes that varies slowly along a track, as with the range of a radar."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from torchfra.cleaning.batches import Steps
from torchfra.cleaning.positions import Answer, Settings, answers
from torchfra.readers.columns import Array

_WINDOW, _FEWEST = 60, 4
"""Fixes by which one standard deviation is estimated, and the fewest such windows of a track."""
_VARIES = 0.15
"""Least gain in log-likelihood per fix, by the variances of the windows, from which on a track is cleaned again."""
_CLEAR = 10.0
"""Log-likelihood by which a track must be likelier with a standard deviation that varies."""
_ROUNDS = 3
"""Most times that a track is cleaned again: too large or too small a sigma hides a part of the variation."""
_MEDIAN = 2 * math.log(2)
"""Median of chi-squared with two degrees of freedom."""


def with_varying_sigma(
    tracks: Sequence[Steps], settings: Settings, found: Sequence[Answer], asked: Sequence[bool]
) -> tuple[list[Steps], list[Answer]]:
    """Steps and answers of tracks, cleaned again where their sigma clearly varies: then ``std`` is relative to sigma.

    Args:
        tracks: steps of each; where the file states accuracies, these are taken.
        settings: of cleaning; a given sigma is taken.
        found: the answers with one sigma for all of a track.
        asked: whether the sigma of a track may vary.
    """
    tracks, found = list(tracks), list(found)
    open_ = [i for i, steps in enumerate(tracks) if asked[i] and settings.sigma is None and (steps.std == 1).all()]
    for least in (_VARIES, *[0.0] * (_ROUNDS - 1)):
        varying = {i: std for i in open_ if (std := _std(tracks[i], found[i], least)) is not None}
        open_, tried = [], [tracks[i]._replace(std=std) for i, std in varying.items()]
        again = answers(tried, settings) if tried else []
        for i, steps, answer in zip(varying, tried, again, strict=True):
            if answer.log_likelihood > found[i].log_likelihood + _CLEAR:
                tracks[i], found[i] = steps, answer
                open_.append(i)
    return tracks, found


def _std(steps: Steps, answer: Answer, least: float) -> Array | None:
    """Relative standard deviations ``(T, d)`` by the residuals in each window; None where the gain is below ``least``.

    The median of a window has as many outliers as there are.  Where noise and motion cannot be distinguished, residuals
    are no noise.
    """
    at = np.flatnonzero(steps.measured)
    windows = len(at) // _WINDOW
    if windows < _FEWEST or not math.isnan(answer.lowest):
        return None
    variance = np.square(answer.sigma * steps.std[at, 0])
    of_estimate = np.trace(answer.covariance[at, :2, :2], axis1=1, axis2=2) / 2
    inlier = answer.outlier[at] <= 0.5  # of which the estimate knows
    expected = np.where(inlier, variance - of_estimate.clip(max=0.9 * variance), variance + of_estimate)
    residual = np.square(steps.raw[at, :2] - answer.mean[at, :2]).sum(1)
    parts = np.array_split(np.arange(len(at)), windows)
    ratio = np.array([np.median(residual[part] / expected[part]) for part in parts]) / _MEDIAN
    if not ratio.all() or math.log(ratio.mean()) - np.log(ratio).mean() < least:
        return None
    middle = [steps.time[at[part]].mean() for part in parts]
    factor = np.exp(0.5 * np.interp(steps.time, middle, np.log(ratio)))
    std = steps.std.copy()
    std[:, :2] *= factor[:, None]
    std[:, :2] /= np.median(std[at, 0])
    return std
