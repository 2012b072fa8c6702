"""A scan for filters of several models or regimes: one state for each measurement in a gate, then merged."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchfra import tree
from torchfra.association.clusters import Association
from torchfra.filters.base import Filter
from torchfra.filters.imm import IMM
from torchfra.filters.interaction import IMMState, pooled
from torchfra.filters.scans.merging import averaged, merged
from torchfra.filters.scans.scan import chosen, gated_first
from torchfra.gaussian.inputs import Frame
from torchfra.sensors.base import Sensor
from torchfra.steps.records import Record, scores
from torchfra.steps.recursion import HasBelief, S
from torchfra.types import Gaussian

T = TypeVar("T")  # a tree


class Pairs(NamedTuple):
    """Targets ``(..., N)``, each with the measurements in its gate: at most ``K`` of them."""

    states: HasBelief
    """States ``(K, ..., N)`` of the filter."""
    info: object
    """Info ``(K, ..., N)`` of the filter."""
    order: Tensor
    """``(..., N, K)`` index of each measurement in the scan."""
    log_density: Tensor
    """``(..., N, J)`` of each measurement of the scan if it is the target's; minus infinity outside the gate."""


def core(inner: Filter) -> Any:
    """The filter that compares measurements with a Gaussian: the filter itself, or the models' filter of an ``IMM``."""
    return inner.inner if isinstance(inner, IMM) else inner


def step_missed(inner: Filter, state: HasBelief, frame: Frame, sensor: Sensor) -> tuple[Any, Record]:
    """State and info ``(1, ..., N)`` of targets that are missed, and the record ``(..., N, 1)`` of the step."""
    z = torch.zeros_like(frame.z[..., :1, :])
    nothing = sensor.measurement_noise(torch.full_like(z, torch.nan))
    rank = state.belief.mean.dim() - 1
    frame = frame._replace(z=z, measured=z, measurement_noise=nothing)
    state, record = inner.advance(_with_rows(state, rank, 1), frame)
    return _rows_first((state, record.info), rank, 1), record


def step_measured(inner: Filter, state: HasBelief, frame: Frame, inside: Tensor) -> Pairs:
    """The states after each measurement that is ``inside (..., N, J)`` a target's gate."""
    order, rank = gated_first(inside), state.belief.mean.dim() - 1
    frame = chosen(frame, order, inside.shape, only=("z", "measured", "measurement_noise"))
    state, record = inner.advance(_with_rows(state, rank, order.shape[-1]), frame)
    _, log_density = scores(record, frame.measurement_noise.log_norm)
    nowhere = torch.full(inside.shape, -torch.inf, dtype=log_density.dtype, device=log_density.device)
    states, info = _rows_first((state, record.info), rank, order.shape[-1])
    return Pairs(states, info, order, nowhere.scatter(-1, order, log_density))


def merge_hypotheses(inner: Filter, none: tuple[Any, Any], each: Pairs, association: Association) -> tuple[Any, Any]:
    """One state and one info for each target, merged from a miss (``none``) and from ``each`` measurement."""
    missed, associated = association.log_weights[..., 0], association.log_weights[..., 1:]
    log_weights = torch.cat([missed.unsqueeze(0), associated.gather(-1, each.order).movedim(-1, 0)])
    state, info = tree.map_tensors(lambda *xs: torch.cat(xs), none, (each.states, each.info))
    return merged(inner, state, log_weights), averaged(info, log_weights, inner.motion.angles)


def inflated_state(inner: Filter, state: S, factor: Tensor) -> S:
    """A state of the filter with all covariance roots multiplied by ``factor (...)``; models are pooled again."""

    def inflate(x: Gaussian) -> Gaussian:
        each = factor.reshape(factor.shape + (1,) * (x.scale_tril.dim() - factor.dim()))
        return Gaussian(x.mean, each * x.scale_tril)

    state = tree.map_parts(inflate, state, Gaussian)
    if isinstance(state, IMMState) and state.active is None:
        state = state._replace(belief=pooled(state.inner.belief, state.log_weights, inner.motion))
    return state


def _with_rows(state: T, rank: int, count: int) -> T:
    """The state, repeated ``count`` times along a new last dimension of the batch."""
    return tree.map_tensors(lambda x: x.unsqueeze(rank).expand(*x.shape[:rank], count, *x.shape[rank:]), state)


def _rows_first(trees: T, rank: int, count: int) -> T:
    """Trees with the dimension of ``_with_rows`` moved to the front; tensors with a single entry are repeated."""

    def first(x: Tensor) -> Tensor:
        return x.expand(*x.shape[:rank], count, *x.shape[rank + 1 :]).movedim(rank, 0)

    return tree.map_tensors(first, trees)
