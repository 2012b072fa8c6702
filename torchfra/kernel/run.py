"""Kernels of one step: built when first needed, run over time on tensors, differentiable."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchfra.kernel.program import BUILDING, Program, batch_first
from torchfra.kernel.step import Step
from torchfra.tree import unflatten


class Kernels:
    """All programs of one step.

    A track has ``state``, leaves ``(..., entries)``, and ``inputs``, ``(..., T, entries)`` or ``(..., entries)`` for
    what stays; their batches are full.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        self._programs: dict[tuple[Any, ...], Program] = {}
        self._making = threading.Lock()

    def forwards(self, batch: torch.Size) -> Program:
        """What filters a batch of this shape; one track has a program of its own, for its speed."""
        return self.program("forwards", narrow=batch.numel() == 1)

    def program(self, kind: str, *how: Any, narrow: bool = False) -> Program:
        """``"forwards"``, ``"trajectory"`` or ``"backwards"`` of the step, see there."""
        key = (kind, narrow, *how)
        if key not in self._programs:
            with self._making:
                if key not in self._programs:
                    with BUILDING, torch.inference_mode(False):
                        scan = getattr(self.step, kind)(*how)
                    self._programs[key] = Program(scan, narrow)
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
            done = self.forwards(batch)(batch, steps, (*state, *inputs))
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
            done = kernels.forwards(batch)(batch, last - first, (*state, *_part(step, inputs, first, last, rank)))
            state = tuple(batch_first(x, rank) for x in done[:count])
            kept.append([x[: last - first] for x in done[count:]] if step.repeated else done[count:])
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
