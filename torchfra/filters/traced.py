"""What kernels take down of a filter: its first state and its step, of one track."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra import tree
from torchfra.gaussian.inputs import Frame, Measurements, make_frames
from torchfra.kernel.entries import Entries
from torchfra.kernel.expressions import Expressions
from torchfra.linalg.triangular import tria
from torchfra.types import Gaussian


def begin(f: Any) -> Any:
    """The state before the first measurement."""
    n, dtype, book = f.motion.size, torch.float64, Expressions()
    root = Entries.inputs(book, (n, n), dtype).ids.tril()
    state = f.begin(Gaussian(Entries.inputs(book, (n,), dtype), Entries(book, root, dtype)))
    if f.home is f:
        return state
    # What a view keeps of a measurement is not nothing, as it seems to be from the view's own steps.
    return f.remembering(state, tree.map_tensors(lambda x: Entries.inputs(book, x.shape, dtype), state))


def start(f: Any, nothing: Any, data: dict[str, Tensor]) -> Any:
    """All tensors of the state that a prior makes, each once; and which of them is which leaf of the state."""
    leaves = tree.flatten(f.begin(Gaussian(data["mean"], tria(data["root"]))))
    once = {id(x): x for x in leaves}
    return nothing, (tuple(once.values()), tuple(list(once).index(id(x)) for x in leaves))


def _frame(f: Any, data: dict[str, Tensor]) -> Frame:
    """The frame of one step of one track."""
    (frame,), _ = make_frames(Measurements(**data).as_track(), f.motion, f.sensor, 0)
    return frame


def keep(f: Any, state: Any, data: dict[str, Tensor]) -> Any:
    """One step of ``forward``."""
    return f.keep(state, _frame(f, data))


def keep_past(f: Any, state: Any, data: dict[str, Tensor]) -> Any:
    """The same, with what the way back needs."""
    return f.keep(state, _frame(f, data), past=True)


def observe(f: Any, state: Any, data: dict[str, Tensor]) -> Any:
    """One step of ``step``."""
    return f.observe(state, _frame(f, data))
