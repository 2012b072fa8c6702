"""A scan for filters of several models or regimes: each measurement in a gate gives a state, and these are merged."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra import tree
from torchfra.association.clusters import Association
from torchfra.filters.base import Filter
from torchfra.filters.imm import IMM, IMMState
from torchfra.filters.interaction import pooled
from torchfra.filters.records import Record
from torchfra.filters.scans.hypotheses import chosen, gated_first
from torchfra.filters.scans.merging import averaged, merged, on_beliefs
from torchfra.gaussian.inputs import Frame
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian


class Pairs(NamedTuple):
    """Targets ``(..., N)``, each with the measurements in its gate: at most ``K`` of them."""

    states: Any
    """Of the filter, ``(K, ..., N)``."""
    info: Any
    """Of the filter, ``(K, ..., N)``."""
    number: Tensor
    """``(..., N, K)`` of each measurement in the scan."""
    log_density: Tensor
    """``(..., N, J)`` of each measurement of the scan if it is the target's; minus infinity of all others."""


def core(inner: Filter) -> Any:
    """The filter that holds measurements against a Gaussian: that of the models, where there are several."""
    return inner.inner if isinstance(inner, IMM) else inner


def missed(inner: Filter, state: Any, frame: Frame, sensor: Sensor) -> tuple[Any, Record]:
    """The state ``(1, ..., N)`` of targets that are not measured, and what the filter keeps of it, ``(..., N, 1)``."""
    z = torch.zeros_like(frame.z[..., :1, :])
    nothing = sensor.measurement_noise(torch.full_like(z, torch.nan))
    rank = state.belief.mean.dim() - 1
    frame = frame._replace(z=z, measured=z, measurement_noise=nothing)
    state, record = inner.advance(_with_rows(state, rank, 1), frame)
    return _rows_first((state, record.info), rank, 1), record


def measured(inner: Filter, state: Any, frame: Frame, inside: Tensor) -> Pairs:
    """The states that each measurement ``inside (..., N, J)`` a target's gate would lead to."""
    number, rank = gated_first(inside), state.belief.mean.dim() - 1
    frame = chosen(frame, number, inside.shape, only=("z", "measured", "measurement_noise"))
    state, record = inner.advance(_with_rows(state, rank, number.shape[-1]), frame)
    _, log_density = inner._scores(record, frame.measurement_noise.log_norm)
    nowhere = torch.full(inside.shape, -torch.inf, dtype=log_density.dtype, device=log_density.device)
    states, info = _rows_first((state, record.info), rank, number.shape[-1])
    return Pairs(states, info, number, nowhere.scatter(-1, number, log_density))


def together(inner: Filter, none: tuple[Any, Any], each: Pairs, association: Association) -> tuple[Any, Any]:
    """One state for each target, and one info: of being missed (``none``) and of ``each`` measurement."""
    chances = association.log_weights
    own = chances[..., 1:].gather(-1, each.number).movedim(-1, 0)
    log_weights = torch.cat([chances[..., 0].unsqueeze(0), own])
    state, info = tree.map_tensors(lambda *xs: torch.cat(xs), none, (each.states, each.info))
    return merged(inner, state, log_weights), averaged(info, log_weights, inner.motion.angles)


def widened(inner: Filter, state: Any, times: Tensor) -> Any:
    """A state of the filter whose beliefs have roots ``times (...)`` as large; what models know together follows."""

    def wider(x: Any) -> Any:
        if not isinstance(x, Gaussian):
            return x
        factor = times.reshape(times.shape + (1,) * (x.scale_tril.dim() - times.dim()))
        return Gaussian(x.mean, factor * x.scale_tril)

    state = on_beliefs(wider, state)
    if isinstance(state, IMMState) and state.active is None:
        state = state._replace(belief=pooled(state.inner.belief, state.log_weights, inner.motion))
    return state


def _with_rows(state: Any, rank: int, count: int) -> Any:
    """The state ``count`` times, along one more dimension at the end of the batch."""
    return tree.map_tensors(lambda x: x.unsqueeze(rank).expand(*x.shape[:rank], count, *x.shape[rank:]), state)


def _rows_first(trees: Any, rank: int, count: int) -> Any:
    """The ``count`` entries along that dimension in front; what is the same for all is repeated."""

    def first(x: Tensor) -> Tensor:
        return x.expand(*x.shape[:rank], count, *x.shape[rank + 1 :]).movedim(rank, 0)

    return tree.map_tensors(first, trees)
