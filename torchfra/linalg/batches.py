"""What batches of tensors broadcast to."""

from __future__ import annotations

from collections.abc import Sequence

import torch


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """As ``torch.broadcast_shapes``, of which some versions import symbolic algebra first: it takes most of a second.

    Raises:
        RuntimeError: they do not fit.
    """
    some = [shape for shape in shapes if shape]
    if some and all(shape == some[0] for shape in some):
        return torch.Size(some[0])
    whole = [1] * max([0, *(len(shape) for shape in some)])
    for shape in some:
        for i in range(-len(shape), 0):
            if shape[i] == 1:
                continue
            if whole[i] not in (1, shape[i]):
                raise RuntimeError(f"shapes {', '.join(str(tuple(x)) for x in shapes)} do not broadcast")
            whole[i] = shape[i]
    return torch.Size(whole)
