"""Large pages for what kernels write, where the system has them to give."""

from __future__ import annotations

import ctypes
import mmap
from functools import lru_cache
from typing import Any

from torch import Tensor

LEAST = 1 << 22
"""Bytes of a tensor for which it is worth asking."""


def in_large_pages(x: Tensor) -> Tensor:
    """The same new tensor, for whose memory the system has been asked to take large pages.

    Without them a third of the time of a filter over 10,000 tracks goes into 4 kB pages that are touched for the first
    time.  Linux has to be asked, unless it is set up to give them to all; other systems are not.
    """
    size = x.numel() * x.element_size()
    advise = _advise() if size >= LEAST else None
    if advise is not None:
        first = -(-x.data_ptr() // mmap.PAGESIZE) * mmap.PAGESIZE
        advise(first, x.data_ptr() + size - first, mmap.MADV_HUGEPAGE)  # a request: that it fails is no error
    return x


@lru_cache(maxsize=1)
def _advise() -> Any:
    """``madvise`` of the C library; None where it knows no large pages."""
    if not hasattr(mmap, "MADV_HUGEPAGE"):
        return None
    try:
        advise = ctypes.CDLL(None).madvise
    except (OSError, AttributeError):
        return None
    advise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    return advise
