"""Checks of a filter's arguments, before any work."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchfra.gaussian.arguments import check_belief, check_kinds
from torchfra.gaussian.inputs import Measurements
from torchfra.linalg.tracing import is_traced
from torchfra.numbers import is_integer
from torchfra.steps.recursion import Recursion, S
from torchfra.types import Gaussian


def check_parts(**parts: tuple[object, type]) -> None:
    """Checks that each part of a filter is of its class: ``check_parts(robust=(robust, Robust))``.

    Raises:
        ValueError: names the first that is not.
    """
    for name, (part, kind) in parts.items():
        if not isinstance(part, kind):
            expected = f"{kind.__name__} of torchfra.{'robust' if name == 'robust' else 'adaptive'}, or a subclass"
            raise ValueError(f"{name}: expected {expected}, received {type(part).__name__}")


def check_weights(f: Recursion, beside: str = "") -> None:
    """Checks that no weights of a filter's rule are negative, ``beside`` something.

    Raises:
        ValueError: some are.
    """
    if f.motion_rule.signed or f.sensor_rule.signed:
        raise ValueError(f"rule: expected one without negative weights{beside}, received one with some")


def check_state(f: Recursion[S], state: S) -> None:
    """Checks that a state comes from this filter, or has the same form.

    Raises:
        ValueError: it is something else, such as a prior or the state of another filter.
    """
    if not isinstance(getattr(state, "belief", None), Gaussian):
        raise ValueError(f"state: expected what init or step has returned, received {type(state).__name__}")
    check_belief(state.belief, "state.belief", size=f.motion.size, from_filter=True)
    if not _fits(f.begin(state.belief), state):
        expected = f"one that init or step of this {type(f).__name__} has returned"
        raise ValueError(f"state: expected {expected}, received a {type(state).__name__} of another filter")


def _fits(made: object, state: object) -> bool:
    """Whether a state has the form of the one that the filter has ``made`` from the same belief."""
    if isinstance(made, Tensor):
        sizes = zip(reversed(made.shape), reversed(getattr(state, "shape", (None,))), strict=False)
        return isinstance(state, Tensor) and all(a == b or 1 in (a, b) for a, b in sizes)
    if not isinstance(made, tuple):
        return made is None or type(state) is type(made)
    return type(state) is type(made) and len(state) == len(made) and all(map(_fits, made, state))


def check_step(f: Recursion[S], state: S, measurements: Measurements) -> Measurements:
    """Checks a single step, and returns it as a track of one step in the precision of the state.

    Raises:
        ValueError: a kind, a shape or a value that does not fit the state.
    """
    check_state(f, state)
    check_kinds(measurements)
    track, mean = measurements.as_track(scans=f.scans), state.belief.mean
    batch, expected = f._batch(track, state.belief, "state.belief"), mean.shape[: mean.dim() - 1 - f.scans]
    if batch != expected:
        raise ValueError(f"state: expected one from a prior of batch {tuple(batch)}, received one of {tuple(expected)}")
    return track._replace(z=track.z.to(mean))


def needed_inputs(f: Recursion, measurements: Measurements, check: Callable[[], object]) -> Measurements:
    """Replaces NaN in ``u`` that only missing elements depend on, such as the positions of satellites out of view.

    A NaN on which the motion or a measured element depends stays: such a track fails.

    Args:
        f: the filter.
        measurements: of whole tracks, or of a step.
        check: checks the arguments; it is called only if ``u`` has a NaN.
    """
    z, u = measurements.z, measurements.u
    if not isinstance(u, Tensor) or f.scans or is_traced(u) or not bool(u.isnan().any()):
        return measurements
    check()
    with torch.no_grad():
        filled, x = torch.where(u.isnan(), 1.0, u), u.new_zeros(*u.shape[:-1], f.motion.size)
        sensor = measurements.sensor or f.sensor
        needed = (sensor(x, u).isnan() & ~sensor(x, filled).isnan() & ~z.isnan()).any(-1, keepdim=True)
        dt = torch.ones_like(u[..., 0])
        for motion in getattr(f.motion, "models", [f.motion]):
            moved = [
                motion.shift(dt, u) if motion.linear else motion(x, dt, u),
                motion.process_noise_by(dt, u).flatten(-2),
            ]
            moved += [motion.transition_by(dt, u).flatten(-2)] if motion.linear else []
            for part in moved:
                if part is not None:
                    needed = needed | part.isnan().any(-1, keepdim=True)
    return measurements._replace(u=torch.where(u.isnan() & ~needed, 1.0, u))


def check_lengths(**lengths: int | None) -> None:
    """Checks that each of these is a number of steps of 1 or more, or None.

    Raises:
        ValueError: names the first that is not.
    """
    for name, length in lengths.items():
        if length is not None and not is_integer(length, 1):
            raise ValueError(f"{name}: expected at least 1 step, received {length!r}")
