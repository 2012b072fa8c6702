"""Kernels of one step: built when first needed, run over time on tensors, differentiable."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Hashable, Iterable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchfra.compiler.boundary import Boundary, after_back, begin_back
from torchfra.compiler.forms import first_order, savable
from torchfra.compiler.learning import Learning
from torchfra.compiler.pieces import Pieces, is_long
from torchfra.compiler.program import Making, Program, Ready, batch_first, building
from torchfra.compiler.source import Scan
from torchfra.compiler.steady import Steady, Track, steady
from torchfra.compiler.step import Step
from torchfra.compiler.track_kernel import TrackKernel, load, track_kernel
from torchfra.linalg.autograd import Context
from torchfra.linalg.tracing import has_tangents
from torchfra.tree import flatten, unflatten

_CPU = torch.device("cpu")
_REMEMBERED = 1 << 26
"""Most bytes of states that wait for the gradient pass where no checkpoints are asked for; others are made anew."""


class Kernels:
    """All programs of one step.

    A track has ``state``, leaves ``(..., entries)``, and ``inputs``, ``(..., T, entries)`` or ``(..., entries)`` for
    what stays; their batches are full.

    ``meanwhile``, if there is any, starts when the source of the next program is there, while LLVM compiles it.
    """

    meanwhile: Making | None = None

    def __init__(self, step: Step) -> None:
        self.step = step
        self._programs: dict[Hashable, Program | None] = {}
        self._boundary: Boundary | None = None
        self._refused = set[bool]()
        self._steady: Steady | Literal[False] | None = False
        self._track_functions: dict[bool, Any] = {}
        self._making, self._making_around = threading.Lock(), threading.Lock()

    @property
    def is_new(self) -> bool:
        """Whether it has no programs yet."""
        return not self._programs

    def forwards(self, batch: torch.Size, device: torch.device, remembers: bool = False) -> Program:
        """What filters a batch of this shape; a single step of one track has a program of its own, for its speed."""
        how = (True,) if remembers else ()
        return self.program(
            "forwards", device, *how, narrow=batch.numel() == 1 and not (self.step.repeated or remembers)
        )

    def program(self, kind: str, device: torch.device, *how: Hashable, narrow: bool = False) -> Program:
        """``"forwards"``, ``"trajectory"``, ``"tangent"`` or ``"backwards"`` of the step, see there."""
        program = self._compiled((kind, device, narrow, *how), partial(getattr(self.step, kind), *how), narrow, device)
        assert program is not None
        return program

    def _compiled(
        self, name: Hashable, make: Callable[[], Scan | None], narrow: bool = False, device: torch.device = _CPU
    ) -> Program | None:
        """What ``make`` gives, compiled once for each name; None if it gives nothing."""
        if name not in self._programs:
            with self._making:
                if name not in self._programs:
                    with building(), torch.inference_mode(False):
                        scan = make()
                    self._programs[name] = None if scan is None else Program(scan, narrow, device, self._written)
        return self._programs[name]

    def _written(self) -> None:
        meanwhile, self.meanwhile = self.meanwhile, None
        if meanwhile is not None:
            meanwhile.start()

    def tracks(
        self, ready: Ready, batch: torch.Size, arguments: Sequence[Tensor], full: Sequence[Tensor]
    ) -> TrackKernel | Learning | None:
        """The steps, and all before and after them, in one call; None where that cannot be.

        Args:
            ready: the steps, which write the state before each where something of the ``arguments`` needs a gradient.
            batch: of the tracks.
            arguments: mean and root of a prior, and what the steps read besides the state.
            full: the same of the steps, with the batch.
        """
        learns = has_gradient(arguments)
        if learns in self._refused or not hasattr(ready.run, "argtypes"):
            return None  # in the latter case it is no function of C but one that starts a GPU
        try:
            made, function = self.around(learns)
            kernel = track_kernel(ready, made, function, batch, arguments[:2], learns)
            if kernel is None or not learns:
                return kernel
            return Learning(kernel, ready, made, self._backward, batch, arguments, full)
        except NotImplementedError:
            self._refused.add(learns)
            return None

    def around(self, learns: bool) -> tuple[Boundary, Any]:
        """What comes before and after the steps, and the function that does it; both are made once.

        Raises:
            NotImplementedError: kernels cannot do it.
        """
        with self._making_around:
            with building(), torch.inference_mode(False):
                made = self._boundary = self._boundary or Boundary(self.step)
            if learns not in self._track_functions:
                self._track_functions[learns] = load(made, len(self.step.zero) if learns else 0)
            return made, self._track_functions[learns]

    def _backward(self, kind: str, *how: Hashable) -> Program | None:
        """A part of the gradient pass of whole tracks on the CPU: see ``Learning``."""
        around: dict[str, Callable[..., Scan | None]] = {"after": after_back, "begin": begin_back}
        make = partial(around[kind], self._boundary) if kind in around else getattr(self.step, kind)
        return self._compiled((kind, _CPU, False, *how), partial(make, *how))

    def remembers(self, batch: torch.Size, steps: int) -> bool:
        """Whether the states before so many steps are few enough to be kept for the gradient pass."""
        size = sum(int((~zero).sum()) for zero in self.step.zero) * self.step.dtype.itemsize
        return size * steps * batch.numel() <= _REMEMBERED

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
            checkpoint: steps between states that wait for the gradient pass, where the others are computed anew; None
                for all if they are few, else for one every sqrt(T) steps.
            truncate: steps after which gradients flow no further back.
        """
        done: Sequence[Tensor]
        if has_tangents():
            done = self._with_tangents(batch, steps, [forward_ad.unpack_dual(x) for x in (*state, *inputs)])
        else:
            whole = None
            plain = self.step.repeated and checkpoint is truncate is None and inputs[0].device == _CPU
            if plain and is_long(batch, steps):
                learns = has_gradient((*state, *inputs))
                whole = None if learns else self._in_steady_state(batch, steps, state, inputs)
                if whole is None and (self.remembers(batch, steps) or not learns):
                    whole = self._in_pieces(batch, steps, state, inputs)
            done = whole or self._done(batch, steps, state, inputs, checkpoint, truncate)
        rest = iter([batch_first(x, len(batch)) for x in done])
        return unflatten(self.step.state, rest), unflatten(self.step.record, rest)

    def _in_pieces(
        self, batch: torch.Size, steps: int, state: Sequence[Tensor], inputs: Sequence[Tensor]
    ) -> list[Tensor] | None:
        """What ``_done`` gives for a single long track, by its pieces; None where these depend on each other."""

        def run(batch: torch.Size, steps: int, state: Sequence[Tensor], inputs: Sequence[Tensor]) -> list[Tensor]:
            return [batch_first(x, len(batch)) for x in self._done(batch, steps, state, inputs)]

        done = Pieces(run, self.step, steps, *(_alone(leaves, batch) for leaves in (state, inputs)))()
        return done and [x.reshape((*x.shape, *batch)) for x in done]

    def _in_steady_state(
        self, batch: torch.Size, steps: int, state: Sequence[Tensor], inputs: Sequence[Tensor]
    ) -> list[Tensor] | None:
        """What ``_done`` gives for a single long track, most of whose steps are steady; None where they are not."""
        made = self._when_steady()
        if made is None:
            return None
        step, one, count = self.step, torch.Size(), len(self.step.zero)
        state, inputs = (_alone(leaves, batch) for leaves in (state, inputs))
        whole = self.forwards(one, _CPU)
        rest = self._compiled(("steady", _CPU, True), lambda: made.scan, narrow=True)
        assert rest is not None
        written = whole.outputs(one, steps, _CPU)[count:]

        def run(kind: str, first: int, last: int, state: Sequence[Tensor]) -> list[Tensor]:
            first, last = (steps - last, steps - first) if step.last_first else (first, last)
            into = [x[first:last] for x in written]
            if kind == "whole":
                return whole(one, last - first, (*state, *_part(step, inputs, first, last, 0)), into)[:count]
            reads = [
                x[first] if name in made.constant else x[first:last] if step.inputs[name].timed else x
                for name, x in zip(step.inputs, inputs, strict=True)
            ]
            done = rest(one, last - first, (*state, *state, *reads), into)[:count]
            return [old.where(mask, new) for mask, old, new in zip(made.masks, state, done, strict=True)]

        end = Track(step, made, steps, inputs, written, run)(state)
        return end and [x.reshape((*x.shape, *batch)) for x in (*end, *written)]

    def _when_steady(self) -> Steady | None:
        """The step after it has converged; None if it never does."""
        with self._making:
            if self._steady is False:
                self._steady = steady(self.step)
        return self._steady or None

    def _done(
        self, batch: torch.Size, steps: int, state: Sequence[Tensor], inputs: Sequence[Tensor],
        checkpoint: int | None = None, truncate: int | None = None,
    ) -> Sequence[Tensor]:  # fmt: skip
        """What the programs write, tracks innermost: see ``run``."""
        if has_gradient((*state, *inputs)):
            remembers = checkpoint is None and self.remembers(batch, steps)
            all_kept = remembers or self.step.last_first
            length = steps if all_kept else checkpoint or math.isqrt((truncate or steps) - 1) + 1
            starts = (*sorted({*range(0, steps, length), *range(0, steps, truncate or steps)}), steps)
            saved = map(savable, (*state, *inputs))
            done = _Run.apply(self, batch, starts, truncate, remembers, *saved)  # type: ignore[no-untyped-call]
            return list(done)
        return self.forwards(batch, inputs[0].device)(batch, steps, (*state, *inputs))

    def _with_tangents(self, batch: torch.Size, steps: int, duals: Sequence[Any]) -> list[Tensor]:
        """What the kernel writes of dual numbers: pairs of a value, and a derivative or None."""
        count, names = len(self.step.zero), list(self.step.inputs)
        values = [x.primal for x in duals]
        along = {name: x.tangent for name, x in zip(names, duals[count:], strict=True) if x.tangent is not None}
        tangents = [torch.zeros_like(x.primal) if x.tangent is None else x.tangent for x in duals[:count]]
        program = self.program("tangent", values[-1].device, tuple(along))
        done = program(batch, steps, (*values[:count], *tangents, *values[count:], *along.values()))
        kept = 2 * count + len(flatten(self.step.record))
        plain, rates = done[:count] + done[2 * count : kept], iter(done[count : 2 * count] + done[kept:])
        return [forward_ad.make_dual(x, next(rates)) if x.is_floating_point() else x for x in plain]


def _alone(leaves: Sequence[Tensor], batch: torch.Size) -> list[Tensor]:
    """Those of the only track of a batch."""
    return [x.reshape(x.shape[len(batch) :]) for x in leaves]


def has_gradient(tensors: Iterable[Tensor]) -> bool:
    """Whether what is made of these has one."""
    return torch.is_grad_enabled() and any(x.requires_grad for x in tensors)


class _Context(Context):
    kernels: Kernels
    batch: torch.Size
    starts: Sequence[int]
    truncate: int | None
    remembers: bool


class _Run(torch.autograd.Function):
    """Runs stretches of steps, from each of ``starts`` to the next.

    The states between wait for the gradient pass if they are remembered, else each stretch is computed anew.
    """

    @staticmethod
    def forward(
        ctx: _Context, kernels: Kernels, batch: torch.Size, starts: Sequence[int], truncate: int | None,
        remembers: bool, *tensors: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        step, rank = kernels.step, len(batch)
        count = len(step.zero)
        state, inputs = tensors[:count], tensors[count:]
        program = kernels.forwards(batch, inputs[0].device, remembers)
        begun: list[Tensor] = []
        kept: list[list[Tensor]] = []
        done: list[Tensor] = []
        for first, last in pairwise(starts):
            done = program(batch, last - first, (*state, *_part(step, inputs, first, last, rank)))
            begun += done[len(done) - count :] if remembers else state
            done = done[: len(done) - count] if remembers else done
            state = tuple(batch_first(x, rank) for x in done[:count])
            done, said = done[:count], done[count:]
            # Room behind the last step, for what comes late, stays of one stretch: ``tree.one_earlier`` writes there.
            several = step.repeated and len(starts) > 2
            kept.append([x[: last - first] for x in said] if several else said)
        ctx.save_for_backward(*inputs, *begun)
        ctx.kernels, ctx.batch, ctx.starts, ctx.truncate, ctx.remembers = kernels, batch, starts, truncate, remembers
        ctx.set_materialize_grads(False)
        records = _joined(kept)
        ctx.mark_non_differentiable(*(x for x in records if not x.is_floating_point()))
        return (*done[:count], *records)

    @staticmethod
    @first_order
    def backward(ctx: _Context, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        kernels, batch, step = ctx.kernels, ctx.batch, ctx.kernels.step
        names, count, rank = list(step.inputs), len(step.zero), len(ctx.batch)
        saved = ctx.saved_tensors  # once: where they are computed anew they are not there twice
        inputs, begun = saved[: len(names)], saved[len(names) :]
        device = inputs[0].device
        needed = tuple(n for n, wanted in zip(names, ctx.needs_input_grad[5 + count :], strict=True) if wanted)
        stay = [n for n in needed if not step.inputs[n].timed]
        program = kernels.program("backwards", device, tuple(g is not None for g in grads[count:]), needed)
        pulls = [batch_first(g, rank) for g in grads[count:] if g is not None]
        zero = [begun[0].new_zeros(()).expand(batch + x.shape) for x in step.zero]
        state = [z if g is None else batch_first(g, rank) for z, g in zip(zero, grads, strict=False)]
        sums = [begun[0].new_zeros(()).expand(batch + step.inputs[n].shape) for n in stay]
        timed: list[list[Tensor]] = []
        for k, (first, last) in reversed(list(enumerate(pairwise(ctx.starts)))):
            if ctx.truncate and last % ctx.truncate == 0 and last < ctx.starts[-1]:
                state = zero
            reads = _part(step, inputs, first, last, rank)
            before: Sequence[Tensor] = begun[k * count : (k + 1) * count]
            if not ctx.remembers:
                before = kernels.program("trajectory", device)(batch, last - first, (*before, *reads))[count:]
            path = [batch_first(x, rank) for x in before]
            local = [g.narrow(rank, first, last - first) for g in pulls] if step.repeated else pulls
            done = program(batch, last - first, (*state, *sums, *reads, *path, *local))
            moved = [batch_first(x, rank) for x in done[: count + len(stay)]]
            state, sums = moved[:count], moved[count:]
            timed.insert(0, done[count + len(stay) :])
        joined = [batch_first(x, rank) for x in _joined(timed)]
        gradients = dict(zip([n for n in needed if step.inputs[n].timed], joined, strict=True))
        gradients |= zip(stay, sums, strict=True)
        return (*[None] * 5, *state, *(gradients.get(n) for n in names))


def _part(step: Step, inputs: Sequence[Tensor], first: int, last: int, rank: int) -> list[Tensor]:
    """Inputs from step ``first`` until before ``last``."""
    return [
        x.narrow(rank, first, last - first) if i.timed else x for x, i in zip(inputs, step.inputs.values(), strict=True)
    ]


def _joined(parts: list[list[Tensor]]) -> list[Tensor]:
    """Stretches behind each other; time is in front."""
    return parts[0] if len(parts) == 1 else [torch.cat(stretches) for stretches in zip(*parts, strict=True)]
