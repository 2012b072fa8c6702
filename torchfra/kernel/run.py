"""Kernels of one step: built when first needed, run over time on tensors, differentiable."""

from __future__ import annotations

import math
import threading
from array import array
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchfra.kernel import build
from torchfra.kernel.source import Port, Scan
from torchfra.kernel.step import Step
from torchfra.tree import unflatten

BUILDING = threading.RLock()
"""Held while caches of kernels are looked up and filled: threads that need the same kernels make them once.

Tracing itself needs no lock: every trace has its own copy of the module.
"""

_TRACKS_PER_THREAD = 16
"""Tracks at least for each thread."""


class Program:
    """A scan, compiled."""

    def __init__(self, scan: Scan) -> None:
        self._dtype = scan.dtype
        self._reads, self._writes = scan.carry + scan.reads, scan.after + scan.writes
        with BUILDING:
            source = scan.source()
        self._run = build.load(source)  # outside: several filters compile at the same time

    def __call__(self, batch: torch.Size, steps: int, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Runs it.

        Args:
            batch: shape of the batch of tracks.
            steps: of time.
            tensors: what it reads: ``(..., entries)`` or ``(..., T, entries)`` where ``...`` is the batch, whose
                entries have any shape.

        Returns:
            What it wrote, with tracks innermost: ``batch_first`` moves them to the front.
        """
        tracks = batch.numel()
        ports = [_strided(x, port, len(batch), tracks) for x, port in zip(tensors, self._reads, strict=True)]
        written = []
        for port in self._writes:
            shape = ((steps,) if port.timed else ()) + tuple(port.shape) + tuple(batch)
            written.append(torch.empty(shape, dtype=torch.bool if port.truth else self._dtype))
        ports += [(x, 1, len(port.ids) * tracks, tracks) for x, port in zip(written, self._writes, strict=True)]
        table = array("q", [number for x, *strides in ports for number in (x.data_ptr(), *strides)])
        address = table.buffer_info()[0]
        threads = max(1, min(torch.get_num_threads(), -(-tracks // _TRACKS_PER_THREAD)))
        self._run(tracks, steps, threads, address, address + 32 * len(tensors))
        return written


def batch_first(x: Tensor, rank: int) -> Tensor:
    """What a program wrote, with its ``rank`` batch dimensions moved to the front."""
    inner = x.dim() - rank
    return x.permute([*range(inner, x.dim()), *range(inner)]) if rank else x


def _strided(x: Tensor, port: Port, rank: int, tracks: int) -> tuple[Tensor, int, int, int]:
    """The tensor, copied if it must be, and its strides from track to track, step to step, entry to entry."""
    x = x.resolve_neg()  # a sign may be put off, and memory does not tell; a real tensor is its own conjugate
    x = torch.zeros(x.shape, dtype=x.dtype) if x._is_zerotensor() else x  # which has no memory
    count = len(port.ids)
    if x.is_contiguous():
        return x, count * (x.shape[rank] if port.timed else 1) if tracks > 1 else 0, count, 1
    sizes, strides, split = x.shape, x.stride(), rank + port.timed
    track, entry = _stride(sizes[:rank], strides[:rank]), _stride(sizes[split:], strides[split:])
    if track is None or entry is None:
        return _strided(x.contiguous(), port, rank, tracks)
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


class Kernels:
    """All programs of one step.

    A track has ``state``, leaves ``(..., entries)``, and ``inputs``, ``(..., T, entries)`` or ``(..., entries)`` for
    what stays; their batches are full.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        self._programs: dict[tuple[Any, ...], Program] = {}
        self._making = threading.Lock()

    def program(self, kind: str, *how: Any) -> Program:
        """``"forwards"``, ``"trajectory"`` or ``"backwards"`` of the step, see there."""
        key = (kind, *how)
        if key not in self._programs:
            with self._making:
                if key not in self._programs:
                    with BUILDING:
                        scan = getattr(self.step, kind)(*how)
                    self._programs[key] = Program(scan)
        return self._programs[key]

    def run(
        self,
        batch: torch.Size,
        steps: int,
        state: Sequence[Tensor],
        inputs: Sequence[Tensor],
        checkpoint: int | None = None,
        truncate: int | None = None,
    ) -> tuple[Any, Any]:
        """The state after all steps, and what is kept of each.

        Args:
            batch: of all tensors.
            steps: how many.
            state: before the first.
            inputs: in the order of the step's own.
            checkpoint: steps between states that wait for the way back, where the others are computed anew.
            truncate: steps after which gradients flow no further back.
        """
        if torch.is_grad_enabled() and any(x.requires_grad for x in (*state, *inputs)):
            length = steps if self.step.last_first else checkpoint or math.isqrt((truncate or steps) - 1) + 1
            starts = sorted({*range(0, steps, length), *range(0, steps, truncate or steps)})
            done = _Run.apply(self, batch, (*starts, steps), truncate, *state, *inputs)  # type: ignore[no-untyped-call]
        else:
            done = self.program("forwards")(batch, steps, (*state, *inputs))
        rest = iter([batch_first(x, len(batch)) for x in done])
        return unflatten(self.step.state, rest), unflatten(self.step.record, rest)


class _Run(torch.autograd.Function):
    """Runs stretches of steps, from each of ``starts`` to the next; on the way back each is computed anew."""

    @staticmethod
    def forward(
        ctx: Any, kernels: Kernels, batch: torch.Size, starts: Sequence[int], truncate: int | None, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        step, rank = kernels.step, len(batch)
        count = len(step.zero)
        state, inputs = tensors[:count], tensors[count:]
        begun: list[Tensor] = []
        kept: list[list[Tensor]] = []
        done: list[Tensor] = []
        for first, last in pairwise(starts):
            begun += state
            done = kernels.program("forwards")(batch, last - first, (*state, *_part(step, inputs, first, last, rank)))
            state = tuple(batch_first(x, rank) for x in done[:count])
            kept.append(done[count:])
        ctx.save_for_backward(*inputs, *begun)
        ctx.kernels, ctx.batch, ctx.starts, ctx.truncate = kernels, batch, starts, truncate
        ctx.set_materialize_grads(False)
        joined = _joined(kept)
        ctx.mark_non_differentiable(*(x for x in joined if not x.is_floating_point()))
        return (*done[:count], *joined)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        kernels, batch, step = ctx.kernels, ctx.batch, ctx.kernels.step
        names, count, rank = list(step.inputs), len(step.zero), len(ctx.batch)
        inputs, begun = ctx.saved_tensors[: len(names)], ctx.saved_tensors[len(names) :]
        needed = tuple(n for n, wanted in zip(names, ctx.needs_input_grad[4 + count :], strict=True) if wanted)
        stay = [n for n in needed if not step.inputs[n].timed]
        program = kernels.program("backwards", tuple(g is not None for g in grads[count:]), needed)
        pulls = [batch_first(g, rank) for g in grads[count:] if g is not None]
        zero = [begun[0].new_zeros(()).expand(batch + x.shape) for x in step.zero]
        state = [z if g is None else batch_first(g, rank) for z, g in zip(zero, grads, strict=False)]
        sums = [begun[0].new_zeros(()).expand(batch + step.inputs[n].shape) for n in stay]
        timed: list[list[Tensor]] = []
        for k, (first, last) in reversed(list(enumerate(pairwise(ctx.starts)))):
            if ctx.truncate and last % ctx.truncate == 0 and last < ctx.starts[-1]:
                state = zero
            reads = _part(step, inputs, first, last, rank)
            before = (*begun[k * count : (k + 1) * count], *reads)
            path = [batch_first(x, rank) for x in kernels.program("trajectory")(batch, last - first, before)[count:]]
            local = [g.narrow(rank, first, last - first) for g in pulls] if step.repeated else pulls
            done = program(batch, last - first, (*state, *sums, *reads, *path, *local))
            moved = [batch_first(x, rank) for x in done[: count + len(stay)]]
            state, sums = moved[:count], moved[count:]
            timed.insert(0, done[count + len(stay) :])
        joined = [batch_first(x, rank) for x in _joined(timed)]
        gradients = dict(zip([n for n in needed if step.inputs[n].timed], joined, strict=True))
        gradients |= zip(stay, sums, strict=True)
        return (*[None] * 4, *state, *(gradients.get(n) for n in names))


def _part(step: Step, inputs: Sequence[Tensor], first: int, last: int, rank: int) -> list[Tensor]:
    """Inputs from step ``first`` until before ``last``."""
    return [
        x.narrow(rank, first, last - first) if i.timed else x for x, i in zip(inputs, step.inputs.values(), strict=True)
    ]


def _joined(parts: list[list[Tensor]]) -> list[Tensor]:
    """Stretches behind each other; time is in front."""
    return parts[0] if len(parts) == 1 else [torch.cat(stretches) for stretches in zip(*parts, strict=True)]
