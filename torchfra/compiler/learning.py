"""Whole tracks of one form and their gradient, of which little but addresses differs from call to call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchfra.compiler.boundary import PRIOR, Boundary, after_back
from torchfra.compiler.forms import first_order, guard, savable
from torchfra.compiler.program import Program, Ready, batch_first, strided
from torchfra.compiler.source import Port
from torchfra.compiler.track_kernel import TrackKernel
from torchfra.linalg.autograd import Context

Compiler = Callable[..., Program | None]
"""From ``"after"``, ``"backwards"`` or ``"begin"``, and the arguments of what makes it, to a part of the gradient
pass."""
_PASSES = 8
"""Gradient passes that are remembered for records that have gradients, which may lie in memory in several ways."""


class Learning:
    """Like a ``TrackKernel``, whose results have gradients.

    Args:
        kernel: all steps, which remember the state before each, and what comes before and after them.
        steps: these steps.
        boundary: what comes before and after these steps.
        compiler: see there.
        batch: of the tracks.
        arguments: a prior, and what the steps read besides the state, as calls give them.
        full: what the steps read, with the batch.

    Raises:
        NotImplementedError: an end has a gradient that kernels cannot compute.
    """

    def __init__(
        self, kernel: TrackKernel, steps: Ready, boundary: Boundary, compiler: Compiler, batch: torch.Size,
        arguments: Sequence[Tensor], full: Sequence[Tensor],
    ) -> None:  # fmt: skip
        self.kernel, self.steps, self.boundary, self.compiler, self.batch = kernel, steps, boundary, compiler, batch
        self.made, self.places, self.states = kernel.made, kernel.places, len(boundary.sizes)
        inputs = boundary.step.inputs
        self.prior = [_form(x.expand(batch + x.shape[-event:])) for event, x in enumerate(arguments[:2], 1)]
        self.full, self.values = list(map(_form, full)), [k for k, kind in enumerate(inputs.values()) if kind.value]
        self.names = (*PRIOR, *inputs)
        self.needed = [name for name, x in zip(self.names, arguments, strict=True) if x.requires_grad]
        self.like = steps.like[self.states : len(steps.like) - self.states]
        self.late = [port - 2 * self.states - len(inputs) for port in boundary.late]
        events = [x.shape[len(batch) + 1 :] for x in self.like]
        self._ports = [Port([0] * event.numel(), event, timed=True) for event in events]
        self._passes: dict[tuple[int, ...], list[_BackwardPass]] = {}
        needed = [name for name in self.needed if name in inputs]
        self.needs_of_prior = tuple(name for name in self.needed if name not in inputs)
        self.stay = tuple(name for name in needed if not inputs[name].timed)
        self.timed = tuple(name for name in needed if inputs[name].timed)
        # Now, not in the midst of a gradient pass, is the time to find out what cannot be done.
        compiler("begin", self.stay, self.needs_of_prior)
        after_back(boundary, self.stay, [k for k in self.late if self.like[k].is_floating_point()])

    def __call__(self, tensors: Sequence[Tensor]) -> tuple[list[Tensor], bool]:
        """Filters whole tracks: see ``TrackKernel``."""
        sound, *written = _Learned.apply(self, *map(savable, tensors))  # type: ignore[no-untyped-call]
        return written, sound

    def back(self, saved: Sequence[Tensor], grads: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Gradients of the arguments of a call, from those of the records.

        Args:
            saved: its arguments, the state before each step, and the memory of the state after the last.
            grads: of the records.
        """
        rank, tracks, pairs = len(self.batch), self.steps.tracks, zip(grads, self._ports, strict=True)
        graded = {k: strided(g, port, rank, tracks)[0] for k, (g, port) in enumerate(pairs) if g is not None}
        if not graded:
            return [None] * len(self.names)
        passes = self._passes.setdefault(tuple(graded), [])
        one = next((one for one in passes if one.fit(*graded.values())), None)
        if one is None:
            one = _BackwardPass(self, graded)
            self._passes[tuple(graded)] = [one, *passes[: _PASSES - 1]]
        return one(saved, list(graded.values()))


class _Context(Context):
    learning: Learning


class _Learned(torch.autograd.Function):
    @staticmethod
    def forward(ctx: _Context, learning: Learning, *tensors: Tensor) -> tuple[Any, ...]:
        written, sound, room = learning.kernel.run(tensors)
        first = len(learning.like)
        last = first + learning.states
        records, begun, each = written[:first], written[first:last], written[last:]
        for k in learning.late:
            records[k] = records[k].data  # no view: torch does not let those of a function be changed
        ctx.save_for_backward(*tensors, *begun, room)
        ctx.learning = learning
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(*(x for x in [*records, *each] if not x.is_floating_point()))
        return (sound, *records, *each)

    @staticmethod
    @first_order
    def backward(ctx: _Context, _: None, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        learning = ctx.learning
        return (None, *learning.back(ctx.saved_tensors, grads[: len(learning.like)]))


class _BackwardPass:
    """The gradient pass of one form, of the records ``graded``: through the end, the steps, the beginning."""

    def __init__(self, of: Learning, graded: dict[int, Tensor]) -> None:
        self._of, self.fit, kinds = of, guard([*graded.values()]), of.boundary.step.inputs
        self._late, self._time = [k for k, place in enumerate(graded) if place in of.late], len(of.batch)
        self._count = of.states + len(of.stay)
        grads, values = [*graded.values()], [of.full[k] for k in of.values]
        last, late = self._unknown([(n,) for n in of.boundary.sizes]), tuple([*graded][k] for k in self._late)
        self._after = self._part("after", (of.stay, late), [*values, *last, *self._last_gradients(grads)])
        begun = [*(x.shape for x in of.boundary.step.zero), *(kinds[name].shape for name in of.stay)]
        self._zero = [torch.zeros((), dtype=of.like[0].dtype).expand(of.batch + shape) for shape in begun]
        state = self._zero if self._after is None else self._after.like
        path, has = of.steps.like[len(of.steps.like) - of.states :], tuple(k in graded for k in range(len(of.like)))
        reads = [*state, *of.full, *path, *self._pulls(grads)]
        self._steps = self._part(
            "backwards", (has, tuple(name for name in of.needed if name in kinds)), reads, of.steps.steps
        )
        self._begin = self._part(
            "begin", (of.stay, of.needs_of_prior), [*values, *of.prior, *self._steps.like[: self._count]]
        )

    def _unknown(self, shapes: Sequence[Sequence[int]]) -> list[Tensor]:
        """What lies in memory like what kernels write, without memory."""
        of = self._of
        like = of.like[0].dtype
        return [batch_first(torch.empty((*x, *of.batch), dtype=like, device="meta"), len(of.batch)) for x in shapes]

    def _part(self, kind: str, how: tuple[Any, ...], reads: Sequence[Tensor], steps: int = 1) -> Any:
        """A part of the one for what it reads here, ``Ready``; None if there is nothing to do."""
        program = self._of.compiler(kind, *how)
        ready = program and program.ready(self._of.batch, steps, reads)
        assert program is None or ready is not None  # nothing is copied: all is new, or kernels have read it before
        return ready

    def _last_gradients(self, grads: Sequence[Tensor]) -> list[Tensor]:
        """Gradients of what the last step has left open."""
        return [grads[k].select(self._time, -1) for k in self._late]

    def _pulls(self, grads: Sequence[Tensor]) -> list[Tensor]:
        """Gradients of what each step says: where that is of the step before, one step later."""
        return [_later(g, self._time) if k in self._late else g for k, g in enumerate(grads)]

    def __call__(self, saved: Sequence[Tensor], grads: Sequence[Tensor]) -> list[Tensor | None]:
        """Gradients of the arguments of a call: see ``Learning.back``."""
        of, known = self._of, len(self._of.names)
        prior, inputs, path, room = saved[:2], saved[2:known], saved[known:-1], saved[-1].data_ptr()
        values, state = [inputs[k] for k in of.values], self._zero
        if self._after is not None:
            first, last = map(Tensor.data_ptr, values), map(Tensor.data_ptr, self._last_gradients(grads))
            state = self._after.at([*first, *(room + place for place in of.kernel.after), *last])
        made = self._steps((*state, *inputs, *path, *self._pulls(grads)))
        state, timed = made[: self._count], made[self._count :]
        sums = state[of.states :] if self._begin is None else self._begin((*values, *prior, *state))
        found = dict(zip((*of.needs_of_prior, *of.stay, *of.timed), (*sums, *timed), strict=True))
        pairs = zip(of.names, saved, strict=False)
        return [found[name].sum_to_size(x.shape).to(x.dtype) if name in found else None for name, x in pairs]


def _form(x: Tensor) -> Tensor:
    """How a tensor lies in memory, without holding it."""
    return torch.empty_strided(x.shape, x.stride(), dtype=x.dtype, device="meta")


def _later(x: Tensor, time: int) -> Tensor:
    """The tensor one step later, with 0 at the first step."""
    # Kernels have to be able to read it; what is copied most quickly lies like the original.
    inner = torch.empty((*x.shape[time:], *x.shape[:time]), dtype=x.dtype, device=x.device)
    moved, steps = torch.empty_like(x) if x.is_contiguous() else batch_first(inner, time), x.shape[time]
    moved.select(time, 0).zero_()
    moved.narrow(time, 1, steps - 1).copy_(x.narrow(time, 0, steps - 1))
    return moved
