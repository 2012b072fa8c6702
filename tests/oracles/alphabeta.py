"""The bank of alpha-beta filters with switched gains, one axis; Xu et al.; gains: Kalata (1984)."""

from __future__ import annotations

from typing import Any

import numpy as np

from oracles.basics import Array


def alphabeta_bank(
    z: Array,
    T: float,
    gains: list[tuple[float, float]],
    sigma: float,
    man: float,
    out: float,
    q: list[float],
    a_max: float,
    n_sigma: float,
    hyst: float = 0.5,
    dwell: int = 3,
    n: int = 2,
    patience: int = 5,
    warmup: int = 5,
    confirm: bool = False,
    speed: float = 1.0,
) -> dict[str, list[Any]]:
    """One axis, thresholds in metres: two-point initiation, vote, gate, switched gains, restart.

    With ``confirm`` (not of the paper) a start or restart waits until three measurements are within reach of a line;
    a track that has not started is at its newest measurement, at rest with this std of the speed.

    From the third measurement on, one entry per step: x, v, level, vote, state (manoeuvre), out (rejected), restart,
    and P, the covariance of the errors that measurement noise leaves.
    """
    two_points = sigma**2 * np.array([[1, 1 / T], [1 / T, 2 / T**2]])
    x, v, P = z[1], (z[1] - z[0]) / T, two_points
    count, rej, hist, state, quiet, last = 2, 0, [], False, 0, 0
    if confirm:
        x, v, count = z[1], 0.0, 1
    decided: dict[str, list[Any]] = {key: [] for key in ("x", "v", "level", "vote", "state", "out", "restart", "P")}
    for k in range(2, len(z)):
        bend = abs(z[k] - 2 * z[k - 1] + z[k - 2])
        in_line = bend < a_max * T**2 + n_sigma * sigma * np.sqrt(6)
        if count < 2:
            x, v, count = (z[k], (z[k] - z[k - 1]) / T, 2) if in_line else (z[k], 0.0, 1)
            P = two_points if in_line else np.diag([sigma**2, speed**2])
            for key, value in zip(decided, (x, v, 0, False, False, False, False, P), strict=True):
                decided[key].append(value)
            continue
        xp = x + T * v
        r = z[k] - xp
        conv = count >= warmup
        raw = abs(r) > (hyst if state else 1.0) * man
        vote = False
        if conv and len(hist) >= n:
            vote = sum([raw, *hist[-n:]]) > (n + 1) / 2
        if vote:
            quiet, new = 0, True
        else:
            quiet += 1
            new = state and quiet < dwell
        run = 0
        for flag in reversed(hist[-n:]):
            if not flag:
                break
            run += 1
        reach = 1 + rej + (run if rej == 0 else 0)
        outside = abs(r) > (0.5 * a_max * (reach * T) ** 2 + n_sigma * sigma if new else out)
        restart = False
        F = np.array([[1, T], [0, 1]])
        P = F @ P @ F.T
        if outside:
            rej += 1
            if rej > patience and (in_line or not confirm):
                x, v, restart, P = z[k], (z[k] - z[k - 1]) / T, True, two_points
                count, rej, hist, quiet, last, new = 2, 0, [], 0, 0, False
            else:
                x = xp
                hist.append(raw)
        else:
            level = 0
            if conv:
                level = len(gains) - 1
                if new:
                    level = next((i for i, limit in enumerate(q) if abs(r) > limit), len(gains) - 2)
            alpha, beta = gains[level]
            K = np.array([[alpha], [beta / (T * (1 + rej))]])
            x, v = xp + K[0, 0] * r, v + K[1, 0] * r
            P = (np.eye(2) - K @ [[1, 0]]) @ P @ (np.eye(2) - K @ [[1, 0]]).T + K @ K.T * sigma**2
            count, rej, last = count + 1, 0, level
            hist.append(raw)
        state = new
        for key, value in zip(decided, (x, v, last, vote, state, outside, restart, P), strict=True):
            decided[key].append(value)
    return decided
