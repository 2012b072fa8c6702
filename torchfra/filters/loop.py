"""The loop over time of a filter that runs interpreted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

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
    past: bool = False,
) -> tuple[Any, Record]:
    """The state after all steps, and their records stacked over time behind ``rank`` batch dimensions.

    Arguments as in ``scan``, of which a frame is the input of each step; ``past`` is whether there will be a way back.
    """
    state, records = scan(advance, state, frames, checkpoint, truncate)
    needed = [r._replace(residual=None, evidence=None, past=r.past if past else None) for r in records]
    stacked: Record = tree.stack(needed, rank)
    return state, stacked


def scan(
    step: Callable[[Any, Any], tuple[Any, Any]],
    state: Any,
    inputs: Sequence[Any],
    checkpoint: int | None,
    truncate: int | None = None,
) -> tuple[Any, list[Any]]:
    """The state after all steps, and what each has left behind.

    Args:
        step: from the state before it and its input.
        state: before the first.
        inputs: one for each step.
        checkpoint: steps between states that are kept for the way back, where the steps between are computed anew.
        truncate: steps after which gradients flow no further back.
    """

    def stretch(state: Any, first: int, last: int) -> tuple[Any, list[Any]]:
        records = []
        for k in range(first, last):
            if truncate is not None and k and k % truncate == 0:
                state = tree.detach(state)
            state, record = step(state, inputs[k])
            records.append(record)
        return state, records

    if checkpoint is None or not torch.is_grad_enabled():
        return stretch(state, 0, len(inputs))
    from torch.utils.checkpoint import checkpoint as recompute  # before torch 2.11 it imports half of torch's compiler

    records: list[Any] = []
    for first in range(0, len(inputs), checkpoint):
        last = min(first + checkpoint, len(inputs))
        state, more = recompute(stretch, state, first, last, use_reentrant=False)
        records += more
    return state, records
