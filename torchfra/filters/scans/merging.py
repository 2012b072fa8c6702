"""Merging of filter states: one state with the moments of several, each of which follows from one hypothesis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.base import Filter
from torchfra.filters.gpb import GPB, GPBState
from torchfra.filters.gpb.noise import NoiseScale
from torchfra.filters.imm import IMM
from torchfra.filters.interaction import IMMState
from torchfra.filters.srckf import SRCKF, State
from torchfra.gaussian.mixture import log_sum, moment_match
from torchfra.steps.recursion import HasBelief
from torchfra.types import Gaussian

T = TypeVar("T")  # a tree


def check_merges(inner: Filter) -> None:
    """Checks that states of a filter can be merged, as an inner filter of ``JPDA`` needs.

    Raises:
        ValueError: they cannot.
    """
    around = isinstance(inner, IMM)
    core = inner.inner if isinstance(inner, IMM) else inner
    if isinstance(core, SRCKF):
        if around and core.noise is not None:
            raise ValueError(
                "inner: expected models without an estimate of the measurement noise, which is the sensor's and not "
                f"a model's, received {type(inner).__name__} of one that estimates it"
            )
        if around or not core.motion.stacked:
            return
    elif isinstance(core, GPB):
        return
    what = type(inner).__name__ + (f" of {type(core).__name__}" if around else f" of {core.motion.describe()}")
    why = " (FRA decides about a measurement by the next one, and neither is known to be the target's)"
    raise ValueError(
        f"inner: expected an SRCKF of one motion, IMM of several, or a GPB, received {what}"
        f"{why if type(core).__name__ == 'FRA' else ''}"
    )


def merged(inner: Filter, states: HasBelief, log_weights: Tensor) -> HasBelief:
    """The state with the moments of several states.

    Args:
        inner: the filter; its models or regimes are merged one by one.
        states: its states, with a first dimension of hypotheses, ``(P, ...)``.
        log_weights: ``(P, ...)`` logs of the probabilities of the hypotheses, minus infinity for zero weight.
    """
    if isinstance(inner, GPB) and isinstance(states, GPBState):
        return _of_regimes(inner, states, log_weights)
    if isinstance(inner, IMM) and isinstance(states, IMMState):
        return _of_models(inner, states, log_weights)
    assert isinstance(states, State)
    belief = moment_match(states.belief, log_weights, inner.motion.angles)
    return State(belief, *averaged(states[1:], log_weights))


def averaged(trees: T, log_weights: Tensor, angles: Sequence[int] = ()) -> T:
    """Trees ``(P, ...)`` merged into one: beliefs by their moments, truth values of the first, all else by the mean.

    Args:
        trees: with a first dimension of hypotheses.
        log_weights: see ``merged``.
        angles: components of beliefs that are angles, rad.
    """

    def mean(x: Tensor) -> Tensor:
        if x.dtype == torch.bool:
            return x[0]
        weight = log_weights.exp().reshape(log_weights.shape + (1,) * (x.dim() - log_weights.dim()))
        return (weight * torch.where(weight > 0, x, 0.0)).sum(0)

    def both(x: Gaussian | Tensor) -> Gaussian | Tensor:
        return moment_match(x, log_weights, angles) if isinstance(x, Gaussian) else mean(x)

    return tree.map_parts(both, trees, Gaussian, Tensor)


def _of_models(inner: IMM, states: IMMState, log_weights: Tensor) -> IMMState:
    """Merges each model by its joint probability with each hypothesis."""
    after, shares = _shared(_joint(log_weights.unsqueeze(-1), states.log_weights), log_weights.unsqueeze(-1))
    every = states._replace(
        belief=moment_match(states.belief, log_weights, inner.motion.angles),
        inner=merged(inner.inner, states.inner, shares),
        log_weights=after,
    )
    if every.active is not None:
        return every._replace(active=every.active[0])  # the set was chosen before the measurement
    return every


def _of_regimes(inner: GPB, states: GPBState, log_weights: Tensor) -> GPBState:
    """Merges each motion, without and with an outlier, by its joint probability with each hypothesis."""
    joint = _joint(log_weights[..., None, None], states.log_weights)  # (P, ..., 2, R)
    _, shares = _shared(inner.regimes.log_by_belief(joint, -1), log_weights[..., None, None])  # (P, ..., 2, K)
    _, modes = _shared(log_sum(joint, -1), log_weights[..., None])  # (P, ..., 2)
    angles = inner.motion.angles

    def mean(x: Tensor) -> Tensor:
        return averaged(x.unsqueeze(-1), log_weights).squeeze(-1)

    return GPBState(
        moment_match(states.belief, log_weights, angles),
        moment_match(states.lagged, log_weights, angles),
        moment_match(states.hypotheses, shares, angles),
        log_sum(joint, 0),
        averaged(states.outlier, modes[..., 1]),
        averaged(states.unreliable, modes),
        averaged(states.duration, log_weights),
        mean(states.doubt),
        mean(states.widening),
        mean(states.unmeasured),
        None if states.relaxation is None else mean(states.relaxation),
        tree.map_tensors(lambda x: torch.zeros_like(x[0]), states.last),  # it is not known whose measurement it was
        None if states.noise is None else _of_noise(states.noise, log_weights),
    )


def _of_noise(noise: NoiseScale, log_weights: Tensor) -> NoiseScale:
    """Merges what is known of the noise by its moments."""
    mean, square, last = averaged((noise.log_scale, noise.log_scale.square() + noise.variance, noise.last), log_weights)
    return NoiseScale(mean, square - mean.square(), last)


def _joint(log_weights: Tensor, inside: Tensor) -> Tensor:
    """Logs of the joint weights of hypotheses and models; a model's may be NaN where the hypothesis has weight 0."""
    return torch.where(log_weights > -torch.inf, log_weights + inside, -torch.inf)


def _shared(joint: Tensor, log_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Log sums over hypotheses ``(P, ...)``, and logs of their shares; ``log_weights`` where all weights are 0."""
    total = log_sum(joint, 0)
    nothing = total == -torch.inf
    return total, torch.where(nothing, log_weights, joint - torch.where(nothing, 0.0, total))
