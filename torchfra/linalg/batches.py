"""What batches of tensors broadcast to."""

from __future__ import annotations

from collections.abc import Iterable

import torch


def common_batch(batches: Iterable[torch.Size]) -> torch.Size:
    """As ``torch.broadcast_shapes``, which takes its time where there is only one, as there mostly is."""
    some = [batch for batch in batches if batch]
    if some and all(batch == some[0] for batch in some):
        return some[0]
    return torch.Size(torch.broadcast_shapes(*some))
