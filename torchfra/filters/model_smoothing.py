"""Smoothing by interacting models: all later measurements together act as one measurement of every model before."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

from torch import Tensor

from torchfra import tree
from torchfra.gaussian.future import future
from torchfra.gaussian.inputs import BackwardStep
from torchfra.gaussian.mixture import models_first, moment_match, repeated, without_failed
from torchfra.gaussian.model import adapted, canonical
from torchfra.linalg.triangular import apply
from torchfra.motion.base import Motion
from torchfra.steps.records import Past, Smoothed
from torchfra.steps.recursion import HasBelief, Recursion
from torchfra.types import Gaussian

T = TypeVar("T")  # a tree


class ModelsStep(NamedTuple):
    """The parts of a step that ``IMM`` keeps for the backward pass, before its inner filter has decided the step."""

    belief: Gaussian
    """``(..., K)`` of each model."""
    info: object
    """The info of the models' filters."""
    log_weights: Tensor
    """``(..., K)`` logs of the models' probabilities."""
    active: Tensor | None = None
    """``(..., A, K)``, as in ``IMMState``; None if all run."""


class ModelsPast(NamedTuple):
    """The past of a step for the backward pass; ``(..., T, K)`` for a whole track."""

    inner: Past
    """Of the models' filters."""
    log_weights: Tensor
    """``(..., K)`` logs of the models' probabilities."""
    active: Tensor | None = None
    """``(..., A, K)``, as in ``IMMState``; None if all run."""

    def of_next(self) -> ModelsPast:
        """As in ``Past``: that of the models' filters."""
        inner = self.inner.of_next()
        return self._replace(inner=inner, log_weights=None)  # type: ignore[arg-type]  # ``retreat`` does not read it


class Models(NamedTuple):
    """Smoothed models of a step."""

    belief: Gaussian
    """``(..., K)`` of each model."""
    log_weights: Tensor
    """``(..., K)`` logs of the models' smoothed probabilities."""


def past_of_models(inner: Recursion, state: HasBelief, steps: ModelsStep) -> ModelsPast:
    """The past of all models, from the kept parts of all steps.

    Args:
        inner: the models' filter.
        state: its state after the last step.
        steps: ``(..., T, K)``.
    """
    time = steps.log_weights.dim() - 2

    def swapped(several: T) -> T:
        """Exchanges the dimensions of time and models: filters have time last in the batch."""
        return tree.map_tensors(lambda x: x.transpose(time, time + 1), several)

    belief, info = inner.finish(state, *swapped((steps.belief, steps.info)))
    return ModelsPast(swapped(inner.past(belief, info, None, None)), steps.log_weights, steps.active)


def estimate_of_models(models: Models, active: Tensor | None, motion: Motion) -> Smoothed:
    """The estimate of all models, and their probabilities, 0 for those that are not ``active``."""
    belief = moment_match(models_first(models.belief), models.log_weights.movedim(-1, 0), motion.angles)
    belief = canonical(motion, belief)
    weights = models.log_weights.exp()
    return Smoothed(belief, weights if active is None else (weights.unsqueeze(-2) @ active).squeeze(-2))


def retreat(inner: Recursion, step: BackwardStep, matrix: Tensor, after: Models) -> Models:
    """One step of the backward pass, over all pairs of a model before the step and one after it.

    For each model after the step, all later measurements together act as the measurement that turns its prediction into
    its smoothed belief (``gaussian.future``).  Every model before the step is updated by that measurement, through the
    motion of the model after, and weighted by its likelihood.

    Args:
        inner: the models' filter.
        step: a ``ModelsPast``, the ``Past`` of the next step, and the frame for each model.
        matrix: ``(..., K, K)`` logs of the transition, ``[was, now]``.
        after: the models after the step.
    """
    of_pairs = [matrix + x.log_weights.unsqueeze(-1) for x in (step.past, step.source)]
    share, of_source = (joint - joint.logsumexp(-2, keepdim=True) for joint in of_pairs)
    before, source = (repeated(models_first(x.inner.belief), share.shape[-1]) for x in (step.past, step.source))
    mixed = moment_match(source, of_source.movedim(-2, 0), inner.motion.angles)  # (was, ..., now) before
    frame = adapted(step.frame, mixed.mean)  # shift and process noise of the forward pass
    predicted, _ = inner.propagate(mixed, frame, step.next.factor).belief(triangular=False)
    difference = inner.motion.difference
    # The information of later measurements on a prediction updates every model before that leads to it.
    later = future(predicted, after.belief, difference)
    each, fit = later.update(inner.propagate(before, frame, step.next.factor), difference)
    joint = without_failed((share + without_failed(fit).movedim(0, -2)).log_softmax(-2))
    joint = joint + after.log_weights.unsqueeze(-2)
    log_weights = joint.logsumexp(-1)
    back = Gaussian(each.mean.movedim(-2, 0), each.scale_tril.movedim(-3, 0))  # (now, was, ...)
    updated = moment_match(back, (joint - log_weights.unsqueeze(-1)).movedim((-1, -2), (0, 1)))
    updated = Gaussian(updated.mean.movedim(0, -2), updated.scale_tril.movedim(0, -3))
    return Models(unwhitened(step.past.inner.belief, updated), log_weights)


def unwhitened(belief: Gaussian, updated: Gaussian) -> Gaussian:
    """The belief ``(..., n)`` that ``updated`` describes in units of the root of ``belief``."""
    mean, root = belief
    return Gaussian(mean + apply(root, updated.mean), root @ updated.scale_tril)  # lower roots: so is their product
