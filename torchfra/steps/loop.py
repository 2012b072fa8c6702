"""One loop over the steps of tracks, forwards over frames and backwards over what was kept of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any, NamedTuple, TypeVar

import torch

from torchfra import tree
from torchfra.gaussian.inputs import BackwardStep, Frame, Measurements
from torchfra.hyper import same_values
from torchfra.steps.records import Kept, Smoothed, innovation, undecided
from torchfra.steps.recursion import Recursion, S
from torchfra.types import Estimate, Gaussian, Innovation

A = TypeVar("A")  # the state of a loop
I = TypeVar("I")  # noqa: E741  # an input of its step
O = TypeVar("O")  # noqa: E741  # an output of its step


class Options(NamedTuple):
    """What a loop keeps for gradients and for the backward pass."""

    checkpoint: int | None = None
    """Steps between states that are kept for gradients; the steps between are computed again."""
    truncate: int | None = None
    """Steps after which gradients flow no further back."""
    past: bool = False
    """Whether to keep ``Record.past``."""


def start(
    f: Recursion[S], measurements: Measurements, prior: Gaussian, batch: torch.Size | None = None
) -> tuple[S, int]:
    """The state of a filter before the first measurement, and its number of batch dimensions.

    Without a ``batch`` the arguments are checked.
    """
    batch = f._batch(measurements, prior) if batch is None else batch
    batch = batch + prior.mean.shape[-1 - f.scans : -1]
    mean, root = (x.to(measurements.z) for x in prior)
    return f.init(Gaussian(mean.expand((*batch, f.motion.size)), root)), len(batch)


def finish(f: Recursion[S], state: S, kept: Kept) -> Estimate:
    """The estimate of whole tracks, from the last state and the kept parts of all steps."""
    (mean, root), info = f.finish(state, kept.belief, kept.info)
    return Estimate(mean, root, kept.nis, kept.log_likelihood, info)


def observe(f: Recursion[S], state: S, frame: Frame) -> tuple[S, Innovation]:
    """The state after one step, and its innovation."""
    state, record = f.advance(state, frame)
    return state, innovation(record, frame.measurement_noise, scans=f.scans)


def observe_apart(f: Recursion[S], state: S, frame: Frame) -> tuple[S, tuple[Innovation, Gaussian]]:
    """The same with a copy of the belief, for who keeps the state and hands out the belief."""
    state, seen = observe(f, state, frame)
    return state, (seen, tree.map_tensors(torch.clone, state.belief))


def scan(
    step: Callable[[A, I], tuple[A, O]], state: A, inputs: Sequence[I], checkpoint: int | None = None,
    truncate: int | None = None,
) -> tuple[A, list[O]]:  # fmt: skip
    """The state after all steps, and what each gives beside it.

    Args:
        step: from a state and an input to the next state and a result.
        state: before the first step.
        inputs: one for each step.
        checkpoint: see ``Options``.
        truncate: see ``Options``.
    """

    def stretch(state: A, first: int, last: int) -> tuple[A, list[O]]:
        results: list[O] = []
        for k in range(first, last):
            if truncate is not None and k and k % truncate == 0:
                state = tree.detach(state)
            state, result = step(state, inputs[k])
            results.append(result)
        return state, results

    if checkpoint is None or not torch.is_grad_enabled():
        # No step runs again for its gradient; ``torch.compile`` finds equal expressions itself.
        with same_values() if checkpoint is None and not torch.compiler.is_compiling() else nullcontext():
            return stretch(state, 0, len(inputs))
    from torch.utils.checkpoint import checkpoint as recompute  # before torch 2.11 it imports half of torch's compiler

    results: list[O] = []
    for first in range(0, len(inputs), checkpoint):
        last = min(first + checkpoint, len(inputs))
        state, more = recompute(stretch, state, first, last, use_reentrant=False)
        results += more
    return state, results


def backward(
    f: Recursion, past: Sequence[Any], frames: Sequence[Frame], rank: int, lag: int | None, options: Options
) -> Smoothed:
    """The smoothed estimates of all steps, stacked over time behind ``rank`` batch dimensions.

    Args:
        f: the filter.
        past: one for each step.
        frames: one for each step.
        rank: batch dimensions.
        lag: number of later steps whose measurements count; None for all.
        options: of the forward pass.
    """
    cut = options.truncate
    sources = [tree.detach(x) if cut and k % cut == 0 else x for k, x in enumerate(past, 1)]
    steps = [BackwardStep(*of) for of in zip(past[:-1], past[1:], frames[1:], sources[:-1], strict=True)]
    state, end = f.last(past[-1])
    if lag is not None:
        state = tree.stack([state] * lag, 0)

    def back(after: A, step: BackwardStep) -> tuple[A, Smoothed]:
        return f.retreat(step, after) if lag is None else _lagged(f, after, step)

    _, smoothed = scan(back, state, steps[::-1], options.checkpoint)
    return tree.stack([*smoothed[::-1], end], rank)


def _lagged(f: Recursion, window: A, step: BackwardStep) -> tuple[A, Smoothed]:
    """One step of the backward pass with a fixed lag: ``window[l]`` is smoothed by the ``l`` steps after its own.

    For ``window[0]`` the past of the next step is provisional: no later measurement has decided that step.
    """
    provisional = undecided(step.next)
    if provisional is step.next:
        before, smoothed = f.retreat(step, window)
    else:
        before, smoothed = f.retreat(step._replace(next=provisional), tree.map_tensors(lambda x: x[:1], window))
        if len(tree.flatten(window)[0]) > 1:
            older, smoothed = f.retreat(step, tree.map_tensors(lambda x: x[1:], window))
            before = tree.map_tensors(lambda *xs: torch.cat(xs), before, older)
    now, _ = f.last(undecided(step.past))
    window = tree.map_tensors(lambda x, older: torch.cat([x.unsqueeze(0), older[:-1]]), now, before)
    return window, tree.map_tensors(lambda x: x[-1], smoothed)
