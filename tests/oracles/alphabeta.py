"""The bank of alpha-beta filters with switched gains, one axis; Xu et al.; gains: Kalata (1984)."""

from __future__ import annotations

from typing import Any

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
    converged: int = 5,
    flag_on_reject: str = "raw",
) -> dict[str, list[Any]]:
    """One axis, thresholds in metres: two-point initiation, vote, gate, switched gains, restart.

    From the third measurement on, one entry per step: x, v, level, vote, state (manoeuvre), out (rejected), restart.
    """
    x, v = z[1], (z[1] - z[0]) / T
    count, rej, hist, state, quiet, last = 2, 0, [], False, 0, 0
    decided: dict[str, list[Any]] = {key: [] for key in ("x", "v", "level", "vote", "state", "out", "restart")}
    for k in range(2, len(z)):
        xp = x + T * v
        r = z[k] - xp
        conv = count >= converged
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
        if outside:
            rej += 1
            if rej > patience:
                x, v, restart = z[k], (z[k] - z[k - 1]) / T, True
                count, rej, hist, quiet, last, new = 2, 0, [], 0, 0, False
            else:
                x = xp
                hist.append(raw if flag_on_reject == "raw" else vote)
        else:
            level = 0
            if conv:
                level = len(gains) - 1
                if new:
                    level = next((i for i, limit in enumerate(q) if abs(r) > limit), len(gains) - 2)
            alpha, beta = gains[level]
            x, v = xp + alpha * r, v + beta / (T * (1 + rej)) * r
            count, rej, last = count + 1, 0, level
            hist.append(raw)
        state = new
        for key, value in zip(decided, (x, v, last, vote, state, outside, restart), strict=True):
            decided[key].append(value)
    return decided
