"""Memory: the peak of a process, and a setting of the C library that makes large batches faster."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # names of mallopt(3)


def keep_memory() -> bool:
    """Let this process keep the memory of freed tensors for the next ones, instead of giving it back each time.

    By default glibc maps every block above some 100 kB afresh and returns it when freed: a filter over 10,000 tracks
    then spends much of its time on page faults.  Call this once, before large tensors are made; the process holds on
    to its peak of memory from then on.  The ``torchfra`` command calls it.

    Returns:
        Whether it took effect: False where there is no glibc.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        libc = ctypes.CDLL(None)
        libc.gnu_get_libc_version  # noqa: B018  # only glibc has it
        return bool(libc.mallopt(_MMAP_THRESHOLD, 1 << 30)) and bool(libc.mallopt(_TRIM_THRESHOLD, 2**31 - 1))
    except (OSError, AttributeError):
        return False


def peak_memory() -> int:
    """Peak memory of this process, bytes; 0 where the system does not say."""
    try:
        import resource
    except ImportError:
        return 0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
