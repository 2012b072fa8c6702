"""Which of two filters is believed where they contradict each other: every choice of every stretch is tried."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from oracles.basics import Array


def believed(gain: Array, lost: Array, rare: float, least: int) -> Array:
    """Where the first is, of ``(T,)``: all of a stretch, none of it, or up to a step inside, at ``-rare``.

    Inside both sides have ``least`` steps of the stretch, or one has one less where the stretch is as short as that.
    """
    first = np.zeros(len(gain), bool)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]])))
    for begin, end in ends.reshape(-1, 2):
        inside = [k for k in range(begin, end) if min(k - begin, end - k) >= least - (end - begin < 2 * least)]
        inside = inside if end - begin >= 2 * least - 1 else []
        worth = [
            gain[begin:k].sum() + (0.0 if k in {begin, end} else rare if k in inside else -np.inf)
            for k in range(begin, end + 1)
        ]
        first[begin : begin + int(np.argmax(worth))] = True
    return first


def jumps(gain: Array, lost: Array, may: Array, rare: float) -> tuple[Array, Array]:
    """Where of ``(T,)`` the second is lost, before jumps, and where the first is, from them on."""
    until, since = np.zeros(len(gain), bool), np.zeros(len(gain), bool)
    worth = np.array([-gain[k:].sum() for k in range(len(gain))])
    ends = np.flatnonzero(np.diff(np.concatenate([[False], worth > 0, [False]])))
    for begin, end in ends.reshape(-1, 2):
        steps = [k for k in range(begin, end) if may[k]]
        if lost[begin:end].any() or not steps:
            continue
        jump = max(steps, key=lambda k: worth[k])
        if worth[jump] > -rare:
            until[begin:jump] = since[jump:end] = True
    return until, since


def joined(contrary: Array, fixes: Array, fewer: int) -> Array:
    """Stretches with fewer fixes than that between them as one."""
    whole, at = contrary.copy(), np.flatnonzero(contrary)
    for one, other in pairwise(at):
        if fixes[one + 1 : other].sum() < fewer:
            whole[one:other] = True
    return whole
