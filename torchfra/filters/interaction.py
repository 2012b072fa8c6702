"""Interaction of models: mixing before a step, and probabilities and fusion after it.

Equation numbers are those of Du & Zhang (2020).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.model_smoothing import ModelsStep
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import (
    largest,
    log_sum,
    matched,
    models_first,
    moment_match,
    nearest,
    repeated,
    share_roots,
    without_failed,
)
from torchfra.gaussian.model import canonical
from torchfra.gaussian.update import density
from torchfra.linalg.safe import safe_log, safe_log1p
from torchfra.linalg.triangular import whiten
from torchfra.motion.base import Motion
from torchfra.steps.records import Record
from torchfra.steps.recursion import HasBelief, Mix, Recursion, S
from torchfra.types import Gaussian

PER_MODEL = ("transition", "shift", "process_noise", "adaptation")
"""Fields of a frame that differ between the models of a ``Bank``."""


class IMMState(NamedTuple):
    """State after a step."""

    belief: Gaussian
    """The Gaussian with the moments of all models."""
    inner: HasBelief
    """State of the inner filter, whose batch ends in the models: ``(..., K)``."""
    log_weights: Tensor
    """``(..., K)`` logs of the models' probabilities."""
    active: Tensor | None = None
    """``(..., A, K)`` with a single 1 in each row: the A active models of the bank; None if all run.  The inner state
    and the log weights are then those of the A models."""


def cycle(inner: Recursion[S], state: S, predicted: Tensor, interact: Mix, frame: Frame) -> tuple[S, Tensor, Record]:
    """One cycle after the interaction: the models' filters, their probabilities and fusion, eqs. (9)-(11).

    Args:
        inner: the filter of all models.
        state: of that filter; its batch ends in the models.
        predicted: ``(..., K)`` logs of the models' probabilities before the measurement.
        interact: mixes their beliefs for the step.
        frame: for each model.

    Returns:
        The filter's state, the logs ``(..., K)`` of the models' posterior probabilities, and the record of the step
        for all models together, with the density of the innovation in units of the measurement noise.
    """
    motion = inner.motion
    state, record = inner.advance(state, frame, interact)  # type: ignore[call-arg]  # one inside of ``IMM`` takes a mix
    assert record.residual is not None
    log_density = without_failed(density(record.root, record.normalised))
    # A robust filter weighs models by its evidence: otherwise one outlier would decide between them.
    log_evidence = log_density if record.evidence is None else without_failed(record.evidence)
    log_weights = predicted + nearest(log_evidence, record.normalised)
    log_weights = log_weights - largest(log_weights, -1, keepdim=True)
    roots, total = share_roots(log_weights.movedim(-1, 0))
    log_weights = log_weights - total.unsqueeze(-1)  # eq. (9)
    belief = canonical(motion, matched(models_first(record.belief), roots, motion.angles))  # eqs. (10), (11)
    innovation = moment_match(models_first(Gaussian(record.residual, record.root)), predicted.movedim(-1, 0))
    normalised = whiten(innovation.scale_tril, innovation.mean)
    log_density = log_sum(predicted + log_density, -1)
    past = ModelsStep(record.belief, record.info, log_weights)
    return state, log_weights, Record(belief, *innovation, normalised, None, log_density, past=past)


def interaction(log_weights: Tensor, matrix: Tensor, motion: Motion) -> tuple[Tensor, Mix]:
    """The interaction of models before a step, eqs. (5)-(8).

    Args:
        log_weights: ``(..., K)`` logs of the models' probabilities before.
        matrix: ``(..., K, K)`` logs of the transition, ``[was, now]``.
        motion: the bank.

    Returns:
        Logs ``(..., K)`` of the models' predicted probabilities, and the function that mixes their beliefs.
    """
    joint = (matrix + log_weights.unsqueeze(-1)).movedim(-2, 0)  # [was, ..., now]
    roots, predicted = share_roots(joint)  # eqs. (6), by square roots, and (5): (..., K) before the measurement

    def interact(belief: Gaussian) -> Gaussian:
        """Eqs. (7), (8)."""
        return matched(repeated(models_first(belief), joint.shape[-1]), roots, motion.angles)

    return predicted, interact


def uniform_interaction(state: IMMState, restart: Tensor, motion: Motion) -> tuple[Tensor, Mix]:
    """``interaction`` for a transition ``(1 - e) I + e / K``: a model stays, or restarts as any of them, uniformly.

    The mixed belief of each model has two components, its own belief and that of all models together, instead of K.
    The moments are the same.  Angles count from the likelier of the two.

    Args:
        state: before the step.
        restart: ``e (...)``, the probability of a restart, from 0 to 1.
        motion: the bank.

    Returns:
        Logs ``(..., K)`` of the models' predicted probabilities, and the function that mixes their beliefs.
    """
    before, count = state.log_weights, len(motion)  # type: ignore[arg-type]  # a Bank
    own = safe_log1p(-restart).to(before).unsqueeze(-1) + before
    restarted = safe_log(restart / count).to(before).unsqueeze(-1)
    roots, predicted = share_roots(torch.stack(torch.broadcast_tensors(own, restarted)))

    def interact(belief: Gaussian) -> Gaussian:
        """Eqs. (7), (8)."""
        together = state.belief
        if belief is not state.inner.belief:  # the inner filter has decided its last step in the meantime
            together = pooled(belief, before, motion)
        pairs = zip(belief, repeated(together, count), strict=True)
        two = Gaussian(*(torch.stack(torch.broadcast_tensors(*pair)) for pair in pairs))
        # Columns that are parallel, as those of one direction in both components, stay so in a product only if they are
        # one: in single precision what rounding parts would be noise beside a wide prior.
        triangular = not motion.linear or two.mean.dtype == torch.float32
        return matched(two, roots, motion.angles, triangular=triangular)

    return predicted, interact


def pooled(belief: Gaussian, log_weights: Tensor, motion: Motion) -> Gaussian:
    """The Gaussian with the moments of all models ``(..., K)``."""
    return matched(models_first(belief), share_roots(log_weights.movedim(-1, 0))[0], motion.angles)


def identity_at_zero_dt(matrix: Tensor, dt: Tensor) -> Tensor:
    """Logs ``(..., K, K)`` of a transition over ``dt (...)`` seconds: the identity where ``dt`` is 0."""
    same = torch.eye(matrix.shape[-1], dtype=torch.bool, device=matrix.device)
    identity = torch.where(same, torch.zeros_like(matrix), -torch.inf)
    return torch.where((dt == 0)[..., None, None], identity, matrix)


def for_each_model(frame: Frame) -> Frame:
    """The frame with a last dimension of models in its batch, which the matrices of a ``Bank`` have already."""
    return tree.insert_batch_dimension(frame, only=[name for name in Frame._fields if name not in PER_MODEL])
