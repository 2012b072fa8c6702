"""A single step of a compiled filter, made ready once for each form of call, so that a call does little but run it."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from torchfra.compiler.guards import guard
from torchfra.compiler.program import Ready
from torchfra.compiler.trees import flattener, unflattener
from torchfra.gaussian.arguments import PRECISIONS, check_values
from torchfra.gaussian.inputs import Measurements, Time
from torchfra.tree import flatten

Data = tuple[Tensor, Tensor, Tensor | None, Tensor | None, Tensor | None]
"""``z``, ``dt``, ``u``, ``std``, ``noise`` of a step."""
_FORMS = 64
"""How many forms are remembered."""
_RANGES = {dtype: (torch.finfo(dtype).tiny, torch.finfo(dtype).max) for dtype in PRECISIONS}
"""From the least normal number on to the largest, in each precision."""


class ReadyStep:
    """A step for tensors of one form.

    Args:
        ready: the kernel.
        inputs: a state, data and values like those to come.
        made: the state and the record that the kernel writes, of one track.
    """

    def __init__(self, ready: Ready, inputs: tuple[Any, Data, tuple[Tensor, ...]], made: Any) -> None:
        self.run, self.made = ready, unflattener(made)
        self._leaves = flattener(inputs)
        self._fit = guard(flatten(inputs))

    def tensors(self, *inputs: Any) -> tuple[Tensor, ...] | None:
        """What the kernel reads; None for tensors of another form."""
        try:
            leaves = self._leaves(inputs)
        except (IndexError, TypeError):  # another structure
            return None
        return leaves if leaves is not None and self._fit(*leaves) else None


class ReadySteps:
    """All that have been made ready."""

    def __init__(self) -> None:
        self._known: dict[Hashable, list[ReadyStep]] = {}

    def __call__(
        self, state: Any, data: Data, values: Sequence[Tensor], zero_dt: bool | None
    ) -> tuple[Any, Any] | None:
        """The next state and the record of the step; None where no step is ready.

        Args:
            state: before the step.
            data: of the step.
            values: what the filter holds.
            zero_dt: whether ``dt`` may be 0, to check what comes with the measurement; None where that is good.

        Raises:
            ValueError: the time step or the noise has a bad value.
        """
        for step in self._known.get(_kind(state, data), ()):
            tensors = step.tensors(state, data, values)
            if tensors is not None:
                if zero_dt is not None:
                    check_changing(data, zero_dt)
                made: tuple[Any, Any] = step.made(step.run(tensors))
                return made
        return None

    def add(self, step: ReadyStep, state: Any, data: Data) -> None:
        """Remembers a step; all others are forgotten when there are too many."""
        if sum(map(len, self._known.values())) >= _FORMS:
            self._known = {}
        kind = _kind(state, data)
        self._known[kind] = [step, *self._known.get(kind, ())]


def _kind(state: Any, data: Data) -> Hashable:
    _, _, u, std, noise = data
    return type(state), u is None, std is None, noise is None, torch.is_grad_enabled()


@lru_cache(maxsize=64)
def number(value: float, dtype: torch.dtype = torch.float64) -> Tensor:
    """A number as a tensor that nobody changes, and that may be saved for a gradient wherever it was first needed."""
    with torch.inference_mode(False):
        return torch.tensor(value, dtype=dtype)


def check_changing(data: Data, zero_dt: bool) -> None:
    """Checks the values that come with each measurement.

    Raises:
        ValueError: one is bad.
    """
    z, dt, _, std, noise = data
    if noise is not None or not all(x is None or is_ordinary(x, z.dtype) for x in (dt, std)):
        check_values(Measurements(*data).as_track(), zero_dt)


def is_ordinary(x: Time, dtype: torch.dtype) -> bool:
    """Whether a few time steps or deviations are good beyond doubt, seen without arithmetic on tensors."""
    least, most = _RANGES[dtype]
    if not isinstance(x, Tensor):
        return least <= x <= most
    if x.dim() > 1 or x.numel() > 16:
        return False
    return all(least <= value <= most for value in x.reshape(-1).tolist())
