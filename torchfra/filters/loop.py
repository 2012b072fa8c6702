"""The loop over time of a filter that runs interpreted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.utils.checkpoint import checkpoint as recompute

from torchfra import tree
from torchfra.filters.records import Record
from torchfra.gaussian.inputs import Frame


def run(
    advance: Callable[[Any, Frame], tuple[Any, Record]],
    state: Any,
    frames: Sequence[Frame],
    rank: int,
    checkpoint: int | None,
    truncate: int | None,
) -> tuple[Any, Record]:
    """The state after all steps, and their records stacked over time behind ``rank`` batch dimensions.

    Args:
        advance: one step.
        state: before the first.
        frames: one for each step.
        rank: batch dimensions.
        checkpoint: steps between states that are kept for the way back, where the steps between are computed anew.
        truncate: steps after which gradients flow no further back.
    """

    def stretch(state: Any, first: int, last: int) -> tuple[Any, list[Record]]:
        records = []
        for k in range(first, last):
            if truncate is not None and k and k % truncate == 0:
                state = tree.detach(state)
            state, record = advance(state, frames[k])
            records.append(record)
        return state, records

    if checkpoint is None or not torch.is_grad_enabled():
        state, records = stretch(state, 0, len(frames))
    else:
        records = []
        for first in range(0, len(frames), checkpoint):
            last = min(first + checkpoint, len(frames))
            state, more = recompute(stretch, state, first, last, use_reentrant=False)
            records += more
    needed = [(r.belief, r.root, r.normalised, r.info, r.density) for r in records]
    belief, root, normalised, info, density = tree.stack(needed, rank)
    return state, Record(belief, None, root, normalised, info, density)
