"""How one pass is timed.  Without torch: the processes of the peers time themselves in the same way."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

PASS = 0.02
"""Seconds that a pass lasts at least."""


def once(call: Callable[[], Any]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def one_pass(call: Callable[[], Any]) -> float:
    """Seconds that a call takes: the median of as many as fit into a pass, and of one if it is longer."""
    seconds: list[float] = []
    while sum(seconds) < PASS:
        seconds.append(once(call))
    return statistics.median(seconds)
