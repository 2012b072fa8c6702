"""Whole tracks of one form in one call, from a prior to all that a filter returns."""

from __future__ import annotations

import ctypes
import threading
from array import array
from collections.abc import Sequence
from struct import Struct
from typing import Any

import torch
from torch import Tensor

from torchfra.compiler import jit
from torchfra.compiler.boundary import Boundary
from torchfra.compiler.pages import maker
from torchfra.compiler.program import Ready, Strided, strided, threads
from torchfra.compiler.source import Port
from torchfra.linalg.batches import broadcast_shapes
from torchfra.tree import flatten


class TrackKernel:
    """A kernel and what comes before and after its steps, of which nothing but addresses differs from call to call.

    Args:
        ready: the steps.
        boundary: what comes before and after them.
        function: of these, as compiled by ``load``.
        prior: mean and root, of all tracks or of one that stands for all.
        rank: batch dimensions of what is written.
        remembers: whether ``states``, the first and the last, are kept for a gradient pass.
    """

    made: Any
    """The tree that is made."""
    after: list[int]
    """Where leaves of the state after the last step begin, in bytes of the memory of states."""

    def __init__(
        self, ready: Ready, boundary: Boundary, function: Any, prior: Sequence[Strided], rank: int,
        remembers: bool = False,
    ) -> None:  # fmt: skip
        self._ready, self._function, self._rank = ready, function, rank
        self.made, self.places = boundary.made, boundary.places
        self._run = ctypes.cast(ready.run, ctypes.c_void_p).value
        count, reads = len(boundary.sizes), len(ready.table) // 4 - len(ready.like)
        like, late = ready.like[count:], [port - reads - count for port in boundary.late]
        differ = [*(track for _, track, _, _ in prior), *(ready.table[4 * row + 1] for row in boundary.values)]
        self._begun = ready.tracks if any(differ) else 1
        self._table, end = ready.table[:], 0
        for first, tracks in ((0, self._begun), (reads, ready.tracks)):
            for row, size in enumerate(boundary.sizes, first):
                self._table[4 * row : 4 * row + 4] = array("q", [end, int(tracks > 1), 0, tracks])
                end += size * tracks * like[0].element_size()
        for row, same in enumerate(boundary.same):  # what is the same at first lies in one place
            self._table[4 * row] = self._table[4 * same]
        self.after = list(self._table[4 * reads : 4 * (reads + count) : 4])
        self._table.extend(number for _, *strides in prior for number in (0, *strides))
        for port in boundary.late:
            self._table.extend([0, 1, 0, ready.table[4 * port + 3]])
        self._table.extend([0, 1, 0, ready.tracks] * len(boundary.each))
        if ready.steps == 1:  # no step is before it: the end of what comes late overwrites that
            for k in late:
                like[k], self._table[4 * (reads + count + k) + 2] = like[k].narrow(rank, 0, 1), 0
        self._late = late if ready.steps > 1 else []
        records = enumerate(flatten(boundary.step.record))
        self._counts = [(k, x.dtype) for k, x in records if not (x.is_floating_point() or x.dtype == torch.bool)]
        each = torch.empty(like[0].shape[:rank], dtype=torch.int64, device="meta")
        self._new = maker([*like, *[each] * len(boundary.each)], ready.device)
        self._room, self._remembers = end, remembers
        self._addresses = Struct(f"{2 + reads - count + len(like) + len(boundary.each)}q").pack

    def __call__(self, tensors: Sequence[Tensor]) -> tuple[list[Tensor], bool]:
        """What is written, new, with the batch in front; and whether what ends each track is finite.

        Of that the tensors of what is made are at ``places``, and numbers that are the same for all tracks at the end.

        Args:
            tensors: the prior's, and what the steps read besides the state.
        """
        return self.run(tensors)[:2]

    def run(self, tensors: Sequence[Tensor]) -> tuple[list[Tensor], bool, Tensor]:
        """The same with the memory where the first and the last state lie."""
        ready, written, room = self._ready, self._new(), _room(self._room, self._remembers)
        addresses = self._addresses(*map(Tensor.data_ptr, (*tensors, *written)))
        count, (ports, _) = threads(ready.tracks), self._table.buffer_info()
        sound = self._function(
            self._run, ready.tracks, ready.steps, count, ports, addresses, room.data_ptr(), self._begun
        )
        for k in self._late:
            written[k] = written[k].narrow(self._rank, 1, ready.steps)
        for k, dtype in self._counts:
            written[k] = written[k].to(dtype)
        return written, bool(sound), room


def load(boundary: Boundary, remembered: int = 0) -> Any:
    """The function of a boundary, compiled, for steps that write so many more tensors than their records.

    Raises:
        CompileError: see ``jit.load``.
    """
    return jit.load_tracks(boundary.source(remembered))


_ROOMS = threading.local()
"""Where states lie between the kernels of a call; each thread has its own, as large as it has needed."""
_HELD = 1 << 20
"""Bytes at most that are held from call to call."""


def _room(size: int, new: bool) -> Tensor:
    """Memory of so many bytes; of the caller alone if it is to be ``new``."""
    if size > _HELD or new:
        return torch.empty(size, dtype=torch.uint8, device="cpu")
    if size > getattr(_ROOMS, "size", -1):
        _ROOMS.memory, _ROOMS.size = torch.empty(size, dtype=torch.uint8, device="cpu"), size
    room: Tensor = _ROOMS.memory
    return room


def track_kernel(
    ready: Ready, boundary: Boundary, function: Any, batch: torch.Size, prior: Sequence[Tensor], remembers: bool
) -> TrackKernel | None:
    """Whole tracks of this batch from priors that lie in memory like this; None if one must be copied."""
    shared = broadcast_shapes(prior[0].shape[:-1], prior[1].shape[:-2])
    shared = shared if shared.numel() == 1 else batch
    ports = [Port([0] * x.shape[-1] ** event, x.shape[-event:]) for event, x in enumerate(prior, 1)]
    full = [x.expand(shared + port.shape) for x, port in zip(prior, ports, strict=True)]
    places = [strided(x, port, len(shared), shared.numel()) for x, port in zip(full, ports, strict=True)]
    if any(x.data_ptr() != y.data_ptr() for (x, *_), y in zip(places, prior, strict=True)):
        return None
    return TrackKernel(ready, boundary, function, places, len(batch), remembers)
