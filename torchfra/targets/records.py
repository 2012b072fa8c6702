"""What whole sequences of scans have shown of the targets."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from torchfra.targets.state import TargetsEstimate, TargetsState


def collect(states: Sequence[TargetsState], batch: Sequence[int] = ()) -> TargetsEstimate:
    """The targets that were ever confirmed, each in a place of its own.

    Args:
        states: after each scan of a stream, from the first on.
        batch: of the scenes, their number split up; none for one scene.

    Raises:
        ValueError: no state, or another number of scenes.
    """
    if not states or math.prod(batch) != len(states[0].next_identity):
        received = f"{len(states)} of {len(states[0].next_identity) if states else 0} scenes"
        raise ValueError(f"states: expected one or more, of {math.prod(batch)} scenes, received {received}")
    marks = [s.track.confirmed for s in states]
    belief = [s.confirmed for s in states]
    scene, identity = (torch.cat([x[m] for x, m in zip(xs, marks, strict=True)]) for xs in (
        [s.track.scene for s in states], [s.track.identity for s in states]))  # fmt: skip
    step = torch.cat([torch.full_like(b.mean[:, 0], t, dtype=torch.int64) for t, b in enumerate(belief)])
    R, T, n = len(states[0].next_identity), len(states), states[0].belief.mean.shape[-1]
    pairs, row = torch.unique(torch.stack([scene, identity], -1), dim=0, return_inverse=True)
    count = torch.bincount(pairs[:, 0], minlength=R)
    K = int(count.amax()) if len(pairs) else 0
    slot = (torch.arange(len(pairs), device=row.device) - (count.cumsum(0) - count)[pairs[:, 0]])[row]
    like = states[0].belief.mean
    mean = like.new_full((R, K, T, n), torch.nan).index_put((scene, slot, step), torch.cat([b.mean for b in belief]))
    root = like.new_full((R, K, T, n, n), torch.nan)
    root = root.index_put((scene, slot, step), torch.cat([b.scale_tril for b in belief]))
    names = torch.full((R, K), -1, device=row.device).index_put((scene, slot), identity)
    shape = (*batch, K)
    return TargetsEstimate(
        mean.reshape(*shape, T, n), root.reshape(*shape, T, n, n), names.reshape(shape),
        torch.stack([s.log_likelihood for s in states], -1).reshape(*batch, T),
    )  # fmt: skip
