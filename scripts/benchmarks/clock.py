"""How one pass is timed.  Without torch: the processes of the peers time themselves in the same way."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

PASS = 0.02
"""Seconds that a pass lasts at least."""
WARM = 2.0
"""Seconds after which no more calls are made before the first pass."""


def once(call: Callable[[], Any]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def first_call(call: Callable[[], Any], more: int = 10, limit: float = WARM) -> float:
    """Seconds of the first call; up to so many ``more`` follow, after which all is warm and ready that gets so."""
    first, seconds = once(call), [once(call)]
    while sum(seconds) < limit and len(seconds) < more:
        seconds.append(once(call))
    return first


def one_pass(call: Callable[[], Any], at_least: float = PASS) -> float:
    """Seconds that a call takes: the median of as many as fit into a pass, and of one if it is longer."""
    seconds: list[float] = []
    while sum(seconds) < at_least:
        seconds.append(once(call))
    return statistics.median(seconds)
