"""Memory for what kernels write: large pages, where the system has them to give, and rows on lines of the cache."""

from __future__ import annotations

import ctypes
import importlib
import mmap
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

LEAST = 1 << 22
"""Bytes of a tensor for which it is worth asking."""
PAST = 1 << 21
"""Bytes that a call writes from which on kernels write past the caches: no second cache keeps as much."""
_LINE = 64
"""Bytes of a line of the cache."""


def rows_of_tracks(
    shape: Sequence[int], batch: torch.Size, dtype: torch.dtype, device: torch.device, past: bool
) -> Tensor:
    """A new tensor ``(*shape, *batch)``, in large pages if it is large.

    Rows of many tracks that are written ``past`` the caches begin on lines of the cache each, as they must; there is
    room between them where they are no multiple of a line.
    """
    tracks, lanes = batch.numel(), _LINE // dtype.itemsize
    width = -(-tracks // lanes) * lanes
    if not past or width == tracks or tracks < 8 * lanes:
        return in_large_pages(torch.empty((*shape, *batch), dtype=dtype, device=device))
    padded = in_large_pages(torch.empty((*shape, width), dtype=dtype, device=device))
    across = torch.empty(batch, device="meta").stride()
    # Not by ``view``, which makes up strides of dimensions of size 1: kernels go by them.  And no view for autograd,
    # which does not let one of several results be changed in place.
    return padded.as_strided((*shape, *batch), (*padded.stride()[:-1], *across)).data


def in_large_pages(x: Tensor) -> Tensor:
    """The same new tensor, for whose memory the system has been asked to take large pages.

    Without them a third of the time of a filter over 10,000 tracks goes into 4 kB pages that are touched for the first
    time.  Linux has to be asked, unless it is set up to give them to all; other systems are not.
    """
    size = _bytes(x)
    advise = _advise() if size >= LEAST and x.is_cpu else None
    if advise is not None:
        first = -(-x.data_ptr() // mmap.PAGESIZE) * mmap.PAGESIZE
        advise(first, x.data_ptr() + size - first, mmap.MADV_HUGEPAGE)  # a request: that it fails is no error
    return x


def _bytes(x: Tensor) -> int:
    return x.numel() * x.element_size()


def maker(like: Sequence[Tensor], device: torch.device) -> Callable[[], list[Tensor]]:
    """What makes new tensors of these forms, in half the time of ``torch.empty_strided`` where torch has such a way.

    Args:
        like: tensors, of ``device="meta"`` say: their memory is not needed.
        device: of those to come.
    """
    forms = [(tuple(x.shape), x.stride(), x.dtype) for x in like]
    large = [k for k, x in enumerate(like) if device.type == "cpu" and _bytes(x) >= LEAST]
    try:
        new = importlib.import_module("torch._C._dynamo.guards")._empty_strided_cpu
    except (ImportError, AttributeError):  # it is private: versions may differ
        new = None
    if new is None or device.type != "cpu":
        new = partial(_empty, device)
    columns = list(zip(*forms, strict=True))

    def make() -> list[Tensor]:
        return list(map(new, *columns))

    def make_large() -> list[Tensor]:
        made = make()
        for k in large:
            in_large_pages(made[k])
        return made

    return make_large if large else make


def _empty(device: torch.device, size: Sequence[int], stride: Sequence[int], dtype: torch.dtype) -> Tensor:
    return torch.empty_strided(size, stride, dtype=dtype, device=device)


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
