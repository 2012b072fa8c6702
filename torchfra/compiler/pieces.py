"""One long track on all lanes of the processor: its pieces run at once, each begun some steps early.

A filter forgets where it began.  So a piece begins from the state before the first step of all, as many steps early as
forgetting takes, and is compared with where the piece before it ended: one that did not begin there runs again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from torchfra.compiler.pages import in_large_pages
from torchfra.compiler.step import Step
from torchfra.types import Gaussian

_LANES, _FEWEST = 64, 16
"""Pieces at most, several vectors for each thread; and at least, so that the early steps are worth it."""
_EARLY = 64
"""Steps early at first; four times as many where these are too few."""
_SHARE = 8
"""A piece is at least so many times as long as it begins early, so that trying costs little."""
_APART = {torch.float64: 1e-9, torch.float32: 1e-5}
"""Largest difference of equal states: of beliefs in standard deviations, else as a share of the value or of 1."""
_ROUNDING = 16
"""Times the rounding of a mean, by which two of them may differ as well."""
_ENOUGH = 0.8
"""Share of the pieces that must have forgotten where they began."""

_AT_ONCE = 1 << 14
"""Steps of all pieces together that run at a time."""

Run = Callable[[torch.Size, int, Sequence[Tensor], Sequence[Tensor]], Sequence[Tensor]]
"""Runs steps of a batch: leaves of the state after them, and of what is kept of each, with the batch in front."""


def is_long(batch: torch.Size, steps: int) -> bool:
    """Whether a batch of tracks is a single one that is long enough for pieces."""
    return batch.numel() == 1 and steps >= _FEWEST * _SHARE * _EARLY


class Pieces:
    """A track in pieces of ``length`` steps; ``rest`` are those that run last, the very first ones of a backward pass.

    Args:
        run: runs a batch.
        step: what it runs.
        steps: how many.
        state: leaves before the first step that runs.
        inputs: of the track, without a batch, in the order of the step's own.
    """

    def __init__(self, run: Run, step: Step, steps: int, state: Sequence[Tensor], inputs: Sequence[Tensor]) -> None:
        self.run, self.step, self.steps, self.state, self.inputs = run, step, steps, state, inputs
        self.backwards = step.last_first
        self._cut(_EARLY)

    def _cut(self, early: int) -> None:
        """Chooses the pieces: as many as are long beside the steps that they begin ``early``."""
        self.early, self.lanes = early, min(_LANES, self.steps // (_SHARE * early))
        self.length, self.rest = divmod(self.steps, max(self.lanes, 1))
        self.first = self.rest if self.backwards else 0

    def __call__(self) -> list[Tensor] | None:
        """Leaves of the state after all steps, and of what is kept; None if the filter never forgets."""
        while self.lanes >= _FEWEST:
            states = self._begun(self.early // 2), self._begun(self.early)
            # What half of the steps leave of the beginning is squared by all of them.
            if self._same(*states, apart=_APART[self.step.dtype] ** 0.5).double().mean() >= _ENOUGH:
                return self._done(states[1])
            self._cut(4 * self.early)
        return None

    def _begun(self, early: int) -> list[Tensor]:
        """States in which all pieces but the first to run begin, after so many steps from the state before all."""
        others = self.lanes - 1
        state = [s.detach().expand(others, *s.shape) for s in self.state]
        at = self.first + self.length - (0 if self.backwards else early)
        return self._split(self.run(torch.Size([others]), early, state, self._stretches(at, early, others)))[0]

    def _done(self, begun: Sequence[Tensor]) -> list[Tensor]:
        """All steps, from these states."""
        pairs = zip(begun, self.state, strict=True)
        states = [torch.cat([x, s[None]] if self.backwards else [s[None], x]) for x, s in pairs]
        ends, parts = self._at_once(states)
        order = range(self.lanes)[:: -1 if self.backwards else 1]
        joined = self._same([x.roll(order.step, 0) for x in ends], states).tolist()
        last, again = [x[order[0]] for x in ends], False
        for k in order[1:]:
            if self._same(last, [x[k] for x in states]) if again else joined[k]:
                last, again = [x[k] for x in ends], False
            else:
                last, again = self._alone(parts, last, self.first + k * self.length, self.length), True
        if self.rest:
            last = self._alone(parts, last, 0 if self.backwards else self.steps - self.rest, self.rest)
        return [*last, *parts]

    def _alone(self, parts: Sequence[Tensor], state: Sequence[Tensor], first: int, size: int) -> list[Tensor]:
        """The state after a stretch that runs on its own, of which what is kept is written to where it belongs."""
        inputs = [x.narrow(0, first, size) if timed else x for x, timed in self._timed()]
        last, kept = self._split(self.run(torch.Size(), size, state, inputs))
        for part, x in zip(parts, kept, strict=True):
            part[first : first + size] = x[:size]
        return last

    def _at_once(self, states: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """The states after all pieces, and what is kept of all steps; it has room for the rest.

        They run some steps at a time, so that what a kernel writes, the lanes innermost, is moved from the cache.
        """
        size = min(_AT_ONCE // self.lanes, self.length)
        starts = range(0, self.length, size)[:: -1 if self.backwards else 1]
        parts: list[Tensor] = []
        for at in starts:
            now = min(size, self.length - at)
            inputs = self._stretches(self.first + at, now, self.lanes)
            states, kept = self._split(self.run(torch.Size([self.lanes]), now, states, inputs))
            parts = parts or [in_large_pages(x.new_empty(self.steps, *x.shape[2:])) for x in kept]
            for part, x in zip(parts, kept, strict=True):
                inside = part[self.first : self.first + self.lanes * self.length].unflatten(0, (self.lanes, -1))
                # In two dimensions torch goes by blocks.
                inside[:, at : at + now] = x[:, :now].flatten(1).contiguous().view(self.lanes, now, *x.shape[2:])
        return states, parts

    def _split(self, done: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Leaves of the state, and of what is kept."""
        return [*done[: len(self.state)]], [*done[len(self.state) :]]

    def _stretches(self, first: int, size: int, number: int) -> list[Tensor]:
        """Inputs of so many stretches, one every ``length`` steps."""
        reach = (number - 1) * self.length + size

        def cut(x: Tensor) -> Tensor:
            return x.narrow(0, first, reach).unfold(0, size, self.length).movedim(-1, 1)

        return [cut(x) if timed else x.expand(number, *x.shape) for x, timed in self._timed()]

    def _timed(self) -> Iterator[tuple[Tensor, bool]]:
        """The inputs, and whether they differ from step to step."""
        return zip(self.inputs, (x.timed for x in self.step.inputs.values()), strict=True)

    @torch.no_grad()
    def _same(self, one: Sequence[Tensor], other: Sequence[Tensor], apart: float | None = None) -> Tensor:
        """``(...)`` whether leaves of states are those of one state."""
        apart = _APART[self.step.dtype] if apart is None else apart
        rounding = _ROUNDING * torch.finfo(self.step.dtype).eps
        rounded, close, others = [torch.zeros(())], list[Tensor](), list[tuple[Tensor, Tensor, Any]]()
        a, b = iter(one), iter(other)
        for like in _parts(self.step.state):
            if not isinstance(like, Gaussian):
                others.append((next(a), next(b), like))
                continue
            (m, s), (n, r) = [(next(x), next(x)) for x in (a, b)]
            std = s.norm(dim=-1)
            unit = rounding * n.abs().amax(-1, keepdim=True)
            close.append(_every((m - n).abs() <= apart * std + unit, like.mean))
            close.append(_every((s - r).abs().amax(-1) <= apart * std, like.mean))
            # What is measured in standard deviations has the rounding of means in these.
            most = (unit / std.where(std > 0, torch.inf)).flatten(std.dim() - like.mean.dim()).amax(-1)
            rounded.append(most.where(most.isfinite(), 0.0))
        most = torch.stack(torch.broadcast_tensors(*rounded)).amax(0)
        for x, y, like in others:
            scale = (apart + most.reshape(*most.shape, *(1,) * like.dim())) * y.abs().clamp(min=1.0)
            close.append(_every((x == y) | ((x - y).abs() <= scale), like))
        return torch.stack(torch.broadcast_tensors(*close)).all(0)


def _parts(tree: object) -> Iterator[Any]:
    """The Gaussians of a tree, and its other tensors."""
    if isinstance(tree, Gaussian | Tensor):
        yield tree
    elif isinstance(tree, tuple):
        for part in tree:
            yield from _parts(part)


def _every(close: Tensor, like: Tensor) -> Tensor:
    """Whether all entries are close, of each track."""
    return close.flatten(close.dim() - like.dim()).all(-1) if like.dim() else close
