"""One compiled loop over time, run on tensors."""

from __future__ import annotations

import gc
import os
import threading
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from torchfra.compiler import cuda, jit
from torchfra.compiler.pages import PAST, maker, rows_of_tracks
from torchfra.compiler.source import Port, Scan

_LOCK = threading.RLock()


@contextmanager
def building() -> Iterator[None]:
    """Holds a lock while caches of kernels are looked up and filled: threads that need the same kernels make them once.

    Meanwhile Python looks for no unreachable cycles: of the millions of objects that tracing makes nearly all stay, and
    to look at them again and again takes a fifth of it.  Tracing itself needs no lock: every trace has its own copy of
    the module.
    """
    with _LOCK:
        collects = gc.isenabled()
        gc.disable()
        try:
            yield
        finally:
            if collects:
                gc.enable()


class Making(threading.Thread):
    """A thread that makes kernels while others go on.  A process waits for it when it ends, and when it forks.

    Torch aborts a process that ends in the midst of its work; a child would wait for ever for the locks of a thread
    that it does not have.
    """


def _wait() -> None:
    """Waits for all that make kernels, and for those that these have started."""
    while making := [x for x in threading.enumerate() if isinstance(x, Making) and x.ident is not None]:
        for thread in making:
            thread.join()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(before=_wait)

_CPU = torch.device("cpu")
_TRACKS_PER_THREAD = 16
"""Tracks at least for each thread."""


Strided = tuple[Tensor, int, int, int]
"""A tensor, and its strides from track to track, step to step, entry to entry."""


class Program:
    """A scan, compiled.

    Args:
        scan: the scan.
        narrow: whether it will run on one track alone.
        device: where it will run: the CPU, or a GPU on which each thread has one track.
        written: called when the source is there, before it is compiled.
    """

    def __init__(
        self, scan: Scan, narrow: bool = False, device: torch.device = _CPU,
        written: Callable[[], object] = lambda: None,
    ) -> None:  # fmt: skip
        self._dtype, self._device = scan.dtype, device
        self._reads, self._timed, self._writes = scan.carry + scan.reads, scan.writes, scan.after + scan.writes
        with building():
            source = scan.cuda() if device.type == "cuda" else scan.source(narrow)
        written()
        # Outside: several filters compile at the same time.
        self._run = cuda.load(source, device) if device.type == "cuda" else jit.load(source)

    def __call__(
        self, batch: torch.Size, steps: int, tensors: Sequence[Tensor], into: Sequence[Tensor] | None = None
    ) -> list[Tensor]:
        """Runs it.

        Args:
            batch: shape of the batch of tracks.
            steps: of time.
            tensors: what it reads: ``(..., entries)`` or ``(..., T, entries)`` where ``...`` is the batch, whose
                entries have any shape.
            into: where it writes what it writes at each step; None for new tensors.

        Returns:
            What it wrote, with tracks innermost: ``batch_first`` moves them to the front.
        """
        tracks = batch.numel()
        ports = [strided(x, port, len(batch), tracks) for x, port in zip(tensors, self._reads, strict=True)]
        written = self.outputs(batch, steps if into is None else 0, self._device)
        written[len(written) - len(into or ()) :] = into or ()
        table = array("q", [number for x, *strides in ports for number in (x.data_ptr(), *strides)])
        table.extend(number for x, *strides in self._packed(written, len(batch)) for number in (x.data_ptr(), *strides))
        address = table.buffer_info()[0]
        self._run(tracks, steps, threads(tracks), address, address + 32 * len(tensors))
        return written

    def outputs(self, batch: torch.Size, steps: int, device: torch.device) -> list[Tensor]:
        """What it will write, with tracks innermost; on ``"meta"`` its form alone."""
        written = sum(len(port.ids) for port in self._timed)
        past = batch.numel() * steps * written * self._dtype.itemsize >= PAST
        return [
            rows_of_tracks(
                ((steps + port.late,) if port.timed else ()) + tuple(port.shape),
                batch,
                torch.bool if port.truth else self._dtype,
                device,
                past,
            )
            for port in self._writes
        ]

    def _packed(self, written: Sequence[Tensor], rank: int) -> list[Strided]:
        rows = [x.stride(-1 - rank) if x.dim() > rank else 0 for x in written]
        return [(x, 1, len(port.ids) * row, row) for x, port, row in zip(written, self._writes, rows, strict=True)]

    def ready(self, batch: torch.Size, steps: int, tensors: Sequence[Tensor]) -> Ready | None:
        """All of a call but addresses, for tensors that lie in memory like these; None if some must be copied."""
        tracks = batch.numel()
        ports = [strided(x, port, len(batch), tracks) for x, port in zip(tensors, self._reads, strict=True)]
        if any(x is not y for (x, *_), y in zip(ports, tensors, strict=True)):
            return None
        written = self.outputs(batch, steps, torch.device("meta"))
        table = array("q", [n for _, *strides in [*ports, *self._packed(written, len(batch))] for n in (0, *strides)])
        like = [batch_first(x, len(batch)) for x in written]
        return Ready(self._run, tracks, steps, table, like, self._device)


class Ready:
    """A program for tensors of one form, of which nothing but addresses differs from call to call.

    ``like`` are what it writes, without memory.
    """

    def __init__(
        self, run: Any, tracks: int, steps: int, table: array[int], like: list[Tensor], device: torch.device
    ) -> None:
        self.run, self.tracks, self.steps, self.table, self.like = run, tracks, steps, table, like
        self.device, self._new = device, maker(like, device)
        self._outputs = 32 * (len(table) // 4 - len(like))

    def __call__(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """What it writes, new, with the batch in front."""
        return self.at(map(Tensor.data_ptr, tensors))

    def at(self, addresses: Iterable[int]) -> list[Tensor]:
        """Runs on tensors at these addresses."""
        written = self._new()
        table = self.table[:]  # each thread its own
        table[::4] = array("q", [*addresses, *map(Tensor.data_ptr, written)])
        address = table.buffer_info()[0]
        self.run(self.tracks, self.steps, threads(self.tracks), address, address + self._outputs)
        return written


def threads(tracks: int) -> int:
    """How many share so many tracks."""
    return 1 if tracks <= _TRACKS_PER_THREAD else min(torch.get_num_threads(), -(-tracks // _TRACKS_PER_THREAD))


def batch_first(x: Tensor, rank: int) -> Tensor:
    """What a program wrote, with its ``rank`` batch dimensions moved to the front."""
    inner = x.dim() - rank
    return x.permute([*range(inner, x.dim()), *range(inner)]) if rank else x


def strided(x: Tensor, port: Port, rank: int, tracks: int) -> Strided:
    """The tensor, copied if it must be, and its strides from track to track, step to step, entry to entry."""
    x = x.resolve_neg()  # a sign may be put off, and memory does not tell; a real tensor is its own conjugate
    x = torch.zeros(x.shape, dtype=x.dtype, device=x.device) if x._is_zerotensor() else x  # which has no memory
    count = len(port.ids)
    if x.is_contiguous():
        return x, count * (x.shape[rank] if port.timed else 1) if tracks > 1 else 0, count, 1
    sizes, strides, split = x.shape, x.stride(), rank + port.timed
    track, entry = _stride(sizes[:rank], strides[:rank]), _stride(sizes[split:], strides[split:])
    if track is None or entry is None:
        return strided(x.contiguous(), port, rank, tracks)
    return x, track, strides[rank] if port.timed else 0, entry


def _stride(sizes: Sequence[int], strides: Sequence[int]) -> int | None:
    """From one entry to the next over several dimensions; None if that is not the same everywhere."""
    first = reach = None
    for size, stride in zip(reversed(sizes), reversed(strides), strict=True):
        if size == 1:
            continue
        if first is None:
            first = stride
        elif stride != reach:
            return None
        reach = stride * size
    return first or 0
