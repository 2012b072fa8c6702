"""How models exchange what they know before a step, and share a measurement after it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.base import Filter, Mix
from torchfra.filters.hindsight import ModelsStep
from torchfra.filters.records import Record
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import matched, models_first, moment_match, repeated, shared, without_failed
from torchfra.gaussian.update import density
from torchfra.linalg.triangular import whiten
from torchfra.motion.base import Motion
from torchfra.types import Gaussian

PER_MODEL = ("transition", "shift", "process_noise", "adaptation")
"""Of a frame, what a ``Bank`` gives for each model."""


def cycle(inner: Filter, state: Any, log_weights: Tensor, matrix: Tensor, frame: Frame) -> tuple[Any, Tensor, Record]:
    """Interaction, filtering, probabilities and fusion: eqs. (5)-(11).

    Args:
        inner: the filter of all models.
        state: of that filter; its batch ends in the models.
        log_weights: ``(..., K)`` before.
        matrix: ``(..., K, K)`` logs of the transition, ``[was, now]``.
        frame: for each model.

    Returns:
        The filter's state, the log weights after, and what all models together keep of the step.
    """
    motion = inner.motion
    predicted, interact = interaction(log_weights, matrix, motion)
    state, record = inner.advance(state, frame, interact)
    assert record.residual is not None
    log_density = without_failed(density(record.root, record.normalised))
    log_weights = predicted + (log_density if record.evidence is None else without_failed(record.evidence))
    roots, total = shared(log_weights.movedim(-1, 0))
    log_weights = log_weights - total.unsqueeze(-1)  # eq. (9)
    belief = matched(models_first(record.belief), roots, motion.angles)  # eqs. (10), (11)
    belief = belief._replace(mean=motion.canonical(belief.mean))
    innovation = moment_match(models_first(Gaussian(record.residual, record.root)), predicted.movedim(-1, 0))
    normalised = whiten(innovation.scale_tril, innovation.mean)
    log_density = (predicted + log_density).logsumexp(-1)
    past = ModelsStep(record.belief, record.info, log_weights)
    return state, log_weights, Record(belief, *innovation, normalised, None, log_density, past=past)


def interaction(log_weights: Tensor, matrix: Tensor, motion: Motion) -> tuple[Tensor, Mix]:
    """Logs ``(..., K)`` of the models' probabilities after a transition, and what mixes their beliefs for it."""
    joint = (matrix + log_weights.unsqueeze(-1)).movedim(-2, 0)  # [was, ..., now]
    roots, predicted = shared(joint)  # eqs. (6), by square roots, and (5): (..., K) before the measurement

    def interact(belief: Gaussian) -> Gaussian:
        """Eqs. (7), (8)."""
        return matched(repeated(models_first(belief), joint.shape[-1]), roots, motion.angles)

    return predicted, interact


def held(matrix: Tensor, dt: Tensor) -> Tensor:
    """Logs ``(..., K, K)`` of a transition over ``dt (...)`` seconds: over none, no model gives way to another."""
    same = torch.eye(matrix.shape[-1], dtype=torch.bool, device=matrix.device)
    still = torch.where(same, torch.zeros_like(matrix), -torch.inf)
    return torch.where((dt == 0)[..., None, None], still, matrix)


def for_each_model(frame: Frame) -> Frame:
    """The same for every model: a batch that ends in the models, which matrices of a ``Bank`` have already."""
    wide: Frame = tree.insert_batch_dimension(frame, only=[name for name in Frame._fields if name not in PER_MODEL])
    return wide
