"""Broadcasting of batch dimensions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """``torch.broadcast_shapes``, without the symbolic algebra that some versions of torch import for it.

    That import takes most of a second.

    Raises:
        RuntimeError: the shapes do not broadcast.
    """
    some = list(filter(None, shapes))
    if some and some.count(some[0]) == len(some):
        return torch.Size(some[0])
    common = [1] * max([0, *map(len, some)])  # ``torch.compile`` knows no default of ``max``
    for shape in some:
        for i in range(-len(shape), 0):
            if shape[i] == 1:
                continue
            if common[i] not in (1, shape[i]):
                raise RuntimeError(f"shapes {', '.join(str(tuple(x)) for x in shapes)} do not broadcast")
            common[i] = shape[i]
    return torch.Size(common)


def joined(parts: Sequence[Tensor]) -> Tensor:
    """Vectors ``(..., n_i)`` as one, ``(..., n)``; their batch dimensions are broadcast."""
    batch = broadcast_shapes(*(part.shape[:-1] for part in parts))
    return torch.cat([part.expand(*batch, -1) for part in parts], -1)
