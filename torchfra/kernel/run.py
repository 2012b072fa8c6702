"""Kernels of one step: built when first needed, run over time on tensors, differentiable."""

from __future__ import annotations

import ctypes
import math
from array import array
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchfra.kernel import build
from torchfra.kernel.source import Port, Scan
from torchfra.kernel.step import Step

BLOCK = 16
"""What the number of tracks is filled up to in tensors that kernels write; no register holds more."""


class Program:
    """A scan, compiled."""

    def __init__(self, scan: Scan) -> None:
        self.dtype = scan.dtype
        self.written = scan.after + scan.writes
        self._once = [p for p in scan.after]
        self._run = build.load(scan.source())

    def __call__(self, tracks: int, steps: int, reads: Sequence[tuple[Tensor, int, int, int]]) -> list[Tensor]:
        """Runs it.

        Args:
            tracks: how many.
            steps: of time.
            reads: carry and inputs: tensors and their strides from track to track, step to step, entry to entry.

        Returns:
            What it wrote: ``(entries, tracks)`` for the carry, ``(steps, entries, tracks)`` for the others; the last
            dimension filled up to whole blocks.
        """
        wide = -(-tracks // BLOCK) * BLOCK
        results, ports = [], []
        for x, track, step, entry in reads:
            ports += [x.data_ptr(), track, step, entry]
        for k, port in enumerate(self.written):
            count = len(port.ids)
            shape = (count, wide) if k < len(self._once) else (steps, count, wide)
            x = torch.empty(shape, dtype=torch.bool if port.truth else self.dtype)
            results.append(x)
            ports += [x.data_ptr(), 1, count * wide, wide]
        table = array("q", ports)
        address = table.buffer_info()[0]
        self._run(tracks, steps, min(torch.get_num_threads(), -(-tracks // BLOCK)), address, address + 32 * len(reads))
        return results


class Kernels:
    """All programs of one step."""

    def __init__(self, step: Step, checkpoint: int | None) -> None:
        self.step, self.checkpoint = step, checkpoint
        self._backwards: dict[tuple[Any, ...], Program] = {}

    @cached_property
    def forwards(self) -> Program:
        """Filters."""
        return Program(self.step.forwards())

    @cached_property
    def trajectory(self) -> Program:
        """States before each step."""
        return Program(self.step.trajectory())

    def backwards(self, graded: tuple[bool, ...], needed: tuple[str, ...]) -> Program:
        """The adjoint, see ``Step``."""
        if (graded, needed) not in self._backwards:
            self._backwards[graded, needed] = Program(self.step.backwards(graded, needed))
        return self._backwards[graded, needed]

    def run(
        self, tracks: int, steps: int, state: Sequence[Tensor], inputs: Sequence[Tensor], cut: int | None = None
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Filters.

        Args:
            tracks: how many, B.
            steps: how many, T.
            state: leaves ``(B, entries)``.
            inputs: ``(B, T, entries)``, or ``(B, entries)`` for what stays.
            cut: steps after which gradients flow no further back.

        Returns:
            Leaves of the state after it all, ``(B, entries)``, and of what is kept of each step, ``(B, T, entries)``.
        """
        if torch.is_grad_enabled() and any(x.requires_grad for x in (*state, *inputs)):
            flat = _Run.apply(self, tracks, steps, cut, *state, *inputs)  # type: ignore[no-untyped-call]
            return list(flat[: len(state)]), list(flat[len(state) :])
        return self.filter(tracks, steps, state, inputs)

    def filter(
        self, tracks: int, steps: int, state: Sequence[Tensor], inputs: Sequence[Tensor]
    ) -> tuple[list[Tensor], list[Tensor]]:
        """See ``run``; without a gradient."""
        done = self.forwards(tracks, steps, [_fixed(x) for x in state] + self._reads(inputs, 0))
        after, kept = done[: len(state)], done[len(state) :]
        return [x[:, :tracks].mT for x in after], [x[..., :tracks].permute(2, 0, 1) for x in kept]

    def _reads(self, inputs: Sequence[Tensor], first: int) -> list[tuple[Tensor, int, int, int]]:
        """Inputs from step ``first`` on."""
        return [_timed(x, first) if i.timed else _fixed(x) for x, i in zip(inputs, self.step.inputs.values(), strict=True)]


def _fixed(x: Tensor) -> tuple[Tensor, int, int, int]:
    return x, x.stride(0), 0, x.stride(1)


def _timed(x: Tensor, first: int = 0) -> tuple[Tensor, int, int, int]:
    if first:
        x = x[:, first:]
    return x, x.stride(0), x.stride(1), x.stride(2)


class _Run(torch.autograd.Function):
    """Checkpointed: states are kept at the beginning of each stretch of steps, and computed anew on the way back."""

    @staticmethod
    def forward(ctx: Any, kernels: Kernels, tracks: int, steps: int, cut: int | None, *tensors: Tensor) -> Any:
        ctx.set_materialize_grads(False)
        count = len(kernels.step.before)
        state, inputs = list(tensors[:count]), tensors[count:]
        length = cut or kernels.checkpoint or math.isqrt(steps - 1) + 1
        parts, kept = [], []
        for first in range(0, steps, length):
            parts.append(state)
            reads = [_fixed(x) for x in state] + kernels._reads(inputs, first)
            done = kernels.forwards(tracks, min(length, steps - first), reads)
            state = [x[:, :tracks].mT for x in done[:count]]
            kept.append(done[count:])
        ctx.save_for_backward(*inputs, *(x for part in parts for x in part))
        ctx.kernels, ctx.tracks, ctx.steps, ctx.length, ctx.cut = kernels, tracks, steps, length, cut
        joined = [torch.cat(x)[..., :tracks].permute(2, 0, 1) for x in zip(*kept, strict=True)]
        ctx.mark_non_differentiable(*(x for x in joined if not x.is_floating_point()))
        return (*state, *joined)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *grads: Tensor | None) -> Any:
        kernels, tracks, steps, length = ctx.kernels, ctx.tracks, ctx.steps, ctx.length
        step: Step = kernels.step
        count, names = len(step.before), list(step.inputs)
        inputs, saved = ctx.saved_tensors[: len(names)], ctx.saved_tensors[len(names) :]
        needed = tuple(n for n, need in zip(names, ctx.needs_input_grad[4 + count :], strict=True) if need)
        given = [g for g in grads[count:] if g is not None]
        program = kernels.backwards(tuple(g is not None for g in grads[count:]), needed)
        like = inputs[0]
        zero = [like.new_zeros(1).expand(tracks, x.numel()) for x in step.zero]
        state = [z if g is None else g for z, g in zip(zero, grads[:count], strict=True)]
        fixed = [n for n in needed if not step.inputs[n].timed]
        sums = [like.new_zeros(1).expand(tracks, step.inputs[n].shape.numel()) for n in fixed]
        timed: list[list[Tensor]] = []
        for first in reversed(range(0, steps, length)):
            if ctx.cut and first + length < steps:
                state = zero
            here, last = min(length, steps - first), first // length * count
            reads = kernels._reads(inputs, first)
            path = kernels.trajectory(tracks, here, [_fixed(x) for x in saved[last : last + count]] + reads)[count:]
            packed = [(x, 1, x.stride(0), x.stride(1)) for x in path]
            carry = [_fixed(x) for x in state + sums]
            done = program(tracks, here, carry + reads + packed + [_timed(g, first) for g in given])
            views = [x[:, :tracks].mT for x in done[: count + len(sums)]]
            state, sums = views[:count], views[count:]
            timed.insert(0, done[count + len(fixed) :])
        whole = [torch.cat(x)[..., :tracks].permute(2, 0, 1) for x in zip(*timed, strict=True)]
        found = dict(zip(fixed, sums, strict=True)) | dict(zip([n for n in needed if n not in fixed], whole, strict=True))
        return (None, None, None, None, *state, *(found.get(n) for n in names))
