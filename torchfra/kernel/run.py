"""Kernels of one step: built when first needed, run over time on tensors, differentiable."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchfra.kernel import build
from torchfra.kernel.source import Port, Scan
from torchfra.kernel.step import Step
from torchfra.types import unflatten

_SHARE = 16
"""Tracks that are worth a thread of their own."""


class Program:
    """A scan, compiled."""

    def __init__(self, scan: Scan) -> None:
        self._dtype = scan.dtype
        self._reads, self._writes = scan.carry + scan.reads, scan.after + scan.writes
        self._run = build.load(scan.source())

    def __call__(self, batch: torch.Size, steps: int, given: Sequence[Tensor]) -> list[Tensor]:
        """Runs it.

        Args:
            batch: shape of the batch of tracks.
            steps: of time.
            given: what it reads: tensors ``(..., entries)`` or ``(..., T, entries)`` where ``...`` is the batch, whose
                entries have any shape.

        Returns:
            What it wrote, of the same form.  Tracks lie side by side in memory.
        """
        tracks = batch.numel()
        held = [_laid_out(x, port, len(batch), tracks) for x, port in zip(given, self._reads, strict=True)]
        written = [_empty(batch, steps, port, self._dtype, tracks) for port in self._writes]
        held += [(x, 1, len(port.ids) * tracks, tracks) for x, port in zip(written, self._writes, strict=True)]
        table = array("q", [number for x, *strides in held for number in (x.data_ptr(), *strides)])
        address = table.buffer_info()[0]
        threads = min(torch.get_num_threads(), -(-tracks // _SHARE))
        self._run(tracks, steps, threads, address, address + 32 * len(given))
        return written


def _empty(batch: torch.Size, steps: int, port: Port, dtype: torch.dtype, tracks: int) -> Tensor:
    """``(..., entries)`` or ``(..., T, entries)``, tracks innermost in memory."""
    dtype = torch.bool if port.truth else dtype
    outer = (steps, *port.shape) if port.timed else port.shape
    if tracks == 1:
        return torch.empty(batch + outer, dtype=dtype)
    x = torch.empty((*outer, *batch), dtype=dtype)
    return x.permute([*range(len(outer), x.dim()), *range(len(outer))])


def _laid_out(x: Tensor, port: Port, rank: int, tracks: int) -> tuple[Tensor, int, int, int]:
    """The tensor, copied if it must be, and its strides from track to track, step to step, entry to entry."""
    count = len(port.ids)
    if x.is_contiguous():
        return x, count * (x.shape[rank] if port.timed else 1) if tracks > 1 else 0, count, 1
    sizes, strides, split = x.shape, x.stride(), rank + port.timed
    track, entry = _stride(sizes[:rank], strides[:rank]), _stride(sizes[split:], strides[split:])
    if track is None or entry is None:
        return _laid_out(x.contiguous(), port, rank, tracks)
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
        self._backwards: dict[tuple[Any, ...], Program] = {}

    @cached_property
    def forwards(self) -> Program:
        """See ``Step``."""
        return Program(self.step.forwards())

    @cached_property
    def trajectory(self) -> Program:
        """See ``Step``."""
        return Program(self.step.trajectory())

    def backwards(self, graded: tuple[bool, ...], needed: tuple[str, ...]) -> Program:
        """See ``Step``."""
        if (graded, needed) not in self._backwards:
            self._backwards[graded, needed] = Program(self.step.backwards(graded, needed))
        return self._backwards[graded, needed]

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
            length = truncate or checkpoint or math.isqrt(steps - 1) + 1
            done = _Run.apply(self, batch, steps, length, truncate is not None, *state, *inputs)  # type: ignore[no-untyped-call]
        else:
            done = self.forwards(batch, steps, (*state, *inputs))
        rest = iter(done)
        return unflatten(self.step.state, rest), unflatten(self.step.form, rest)


class _Run(torch.autograd.Function):
    """Runs stretches of ``length`` steps; on the way back each is computed anew from the state it began with."""

    @staticmethod
    def forward(
        ctx: Any, kernels: Kernels, batch: torch.Size, steps: int, length: int, cut: bool, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        count = len(kernels.step.before)
        state, inputs = tensors[:count], tensors[count:]
        begun: list[Tensor] = []
        kept: list[list[Tensor]] = []
        for first in range(0, steps, length):
            begun += state
            done = kernels.forwards(
                batch, min(length, steps - first), (*state, *_from(kernels.step, inputs, first, len(batch)))
            )
            state = tuple(done[:count])
            kept.append(done[count:])
        ctx.save_for_backward(*inputs, *begun)
        ctx.kernels, ctx.batch, ctx.steps, ctx.length, ctx.cut = kernels, batch, steps, length, cut
        ctx.set_materialize_grads(False)
        joined = _joined(kept, len(batch))
        ctx.mark_non_differentiable(*(x for x in joined if not x.is_floating_point()))
        return (*state, *joined)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        kernels, batch, steps, length = ctx.kernels, ctx.batch, ctx.steps, ctx.length
        step: Step = kernels.step
        names, count = list(step.inputs), len(step.before)
        inputs, begun = ctx.saved_tensors[: len(names)], ctx.saved_tensors[len(names) :]
        needed = tuple(n for n, wanted in zip(names, ctx.needs_input_grad[5 + count :], strict=True) if wanted)
        given = [g for g in grads[count:] if g is not None]
        program = kernels.backwards(tuple(g is not None for g in grads[count:]), needed)
        zero = [begun[0].new_zeros(()).expand(batch + x.shape) for x in step.before]
        state = [z if g is None else g for z, g in zip(zero, grads, strict=False)]
        stay = [n for n in needed if not step.inputs[n].timed]
        sums = [begun[0].new_zeros(()).expand(batch + step.inputs[n].shape) for n in stay]
        timed: list[list[Tensor]] = []
        for first in reversed(range(0, steps, length)):
            if ctx.cut and first + length < steps:
                state = zero
            here, stretch = min(length, steps - first), first // length
            reads = _from(step, inputs, first, len(batch))
            path = kernels.trajectory(batch, here, (*begun[stretch * count : (stretch + 1) * count], *reads))[count:]
            local = [g.narrow(len(batch), first, here) for g in given] if step.repeated else given
            done = program(batch, here, (*state, *sums, *reads, *path, *local))
            state, sums = done[:count], done[count : count + len(stay)]
            timed.insert(0, done[count + len(stay) :])
        found = dict(zip([n for n in needed if step.inputs[n].timed], _joined(timed, len(batch)), strict=True))
        found |= zip(stay, sums, strict=True)
        return (*[None] * 5, *state, *(found.get(n) for n in names))


def _from(step: Step, inputs: Sequence[Tensor], first: int, rank: int) -> list[Tensor]:
    """Inputs from step ``first`` on."""
    return [
        x.narrow(rank, first, x.shape[rank] - first) if i.timed else x
        for x, i in zip(inputs, step.inputs.values(), strict=True)
    ]


def _joined(parts: list[list[Tensor]], rank: int) -> list[Tensor]:
    """Stretches behind each other, time behind ``rank`` batch dimensions, in the memory layout of kernels."""
    if len(parts) == 1:
        return parts[0]
    return [
        torch.cat([x.movedim(rank, 0) for x in stretches]).movedim(0, rank) for stretches in zip(*parts, strict=True)
    ]
