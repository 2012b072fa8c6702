"""The estimate of a sequence of scans, from the states after each."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchfra.targets.state import TargetsEstimate, TargetsState, Track, joined, rows
from torchfra.types import Gaussian


def collect(states: Sequence[TargetsState], batch: Sequence[int] = ()) -> TargetsEstimate:
    """The estimate of a sequence of scans: all targets that were confirmed, each with its own index in a dimension.

    Args:
        states: after each scan of a stream, from the first on.
        batch: of the scenes, their number split up; none for one scene.

    Raises:
        ValueError: no state, or another number of scenes.
    """
    if not all(isinstance(state, TargetsState) for state in states):
        received = ", ".join(sorted({type(state).__name__ for state in states}))
        raise ValueError(f"states: expected what step has returned, received {received}")
    if not states or math.prod(batch) != len(states[0].next_identity):
        received = f"{len(states)} of {len(states[0].next_identity) if states else 0} scenes"
        raise ValueError(f"states: expected one or more, of {math.prod(batch)} scenes, received {received}")
    track: Track = joined(*(rows(s.track, s.track.confirmed) for s in states))
    belief: Gaussian = joined(*(s.confirmed for s in states))
    number = torch.arange(len(states), device=track.scene.device)
    step = number.repeat_interleave(torch.stack([s.track.confirmed.sum() for s in states]))
    R, T = len(states[0].next_identity), len(states)
    pairs, row = torch.unique(torch.stack([track.scene, track.identity], -1), dim=0, return_inverse=True)
    count = torch.bincount(pairs[:, 0], minlength=R)
    K, rank = int(count.amax()), torch.arange(len(pairs), device=row.device) - (count.cumsum(0) - count)[pairs[:, 0]]
    place = track.scene, rank[row], step

    def placed(values: Tensor, empty: float) -> Tensor:
        whole = values.new_full((R, K, T, *values.shape[1:]), empty)
        return whole.index_put(place, values).reshape(*batch, K, T, *values.shape[1:])

    identity = torch.full((R, K), -1, device=row.device).index_put(place[:2], track.identity)
    mean, root = placed(belief.mean, torch.nan), placed(belief.scale_tril, torch.nan)
    gone = _deleted(placed((track.misses == 0).to(belief.mean), 0.0) > 0, ~mean[..., 0].isnan())
    density = torch.where(gone, 0.0, placed(track.density, 0.0))
    return TargetsEstimate(mean, root, identity.reshape(*batch, K), density)


def _deleted(measured: Tensor, there: Tensor) -> Tensor:
    """Which scans ``(..., K, T)`` come after the last measurement of a target that was deleted."""
    later = measured.flip(-1).cumsum(-1).flip(-1) > 0
    return ~later & ~there[..., -1:]
