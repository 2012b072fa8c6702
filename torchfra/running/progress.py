"""Progress bars."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TypeVar

T = TypeVar("T")


def progress_bar(items: Iterable[T], unit: str, show: bool, *, total: int | None = None, done: int = 0) -> Iterable[T]:
    """The items, with a progress bar on standard error where that is a terminal and tqdm is installed.

    Args:
        items: what is iterated over.
        unit: what the bar calls one of them.
        show: whether to show a bar at all.
        total: how many there are with those that are done, where ``items`` do not tell.
        done: how many have been done before.
    """
    if not (show and sys.stderr.isatty()):
        return items
    try:
        from tqdm import tqdm
    except ImportError:
        return items
    bar: Iterable[T] = tqdm(items, unit=unit, leave=False, total=total, initial=done)
    return bar
