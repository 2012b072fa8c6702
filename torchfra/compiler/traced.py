"""What kernels take down of a filter: its first state and its step, of one track."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchfra import tree
from torchfra.compiler.entries import Entries
from torchfra.compiler.expressions import Expressions
from torchfra.gaussian.inputs import CompleteScans, Frame, Measurements
from torchfra.hyper import spoilt
from torchfra.steps.records import kept
from torchfra.steps.recursion import HasBelief, Recursion
from torchfra.types import Gaussian


class WithSensor(nn.Module):
    """A filter, and another sensor than its own that measures."""

    def __init__(self, f: nn.Module, sensor: nn.Module) -> None:
        super().__init__()
        self.filter, self.sensor, self.scans = f, sensor, False


def _parts(module: object) -> tuple[Any, Any]:
    """A filter, and another sensor that measures; None for its own."""
    return (module.filter, module.sensor) if isinstance(module, WithSensor) else (module, None)


def begin(module: object, book: Expressions, targets: Sequence[int] = (), like: Any = None) -> Any:
    """The state before the first measurement, of scans that of so many ``targets``.

    A state ``like`` it may have more than the filter's own: numbers of each target beside that, which are unknown.
    """
    f, sensor = _parts(module)
    n, dtype = f.motion.size, torch.float64
    root = Entries.inputs(book, (*targets, n, n), dtype).ids.tril()
    state = f.begin(Gaussian(Entries.inputs(book, (*targets, n), dtype), Entries(book, root, dtype)))
    if sensor is not None:
        # Whatever is 0 here and stays 0 in steps of this sensor, steps of the filter's own may have changed.
        unknown = tree.map_tensors(lambda x: Entries.inputs(book, x.shape, dtype), state)
        return tree.map_parts(
            lambda x: x._replace(scale_tril=Entries(book, x.scale_tril.ids.tril(), dtype)), unknown, Gaussian
        )
    if like is None or type(like) is type(state):
        return state
    return type(like)(state, *(x if x is None else Entries.inputs(book, tuple(targets), dtype) for x in like[1:]))


@dataclass(frozen=True)
class Advance:
    """One step by a function of the filter, a state and a frame, of scans that are ``complete`` or not."""

    function: Callable[[Any, Any, Frame], tuple[Any, Any]]
    complete: bool = False

    def __call__(self, module: object, state: HasBelief, data: dict[str, Tensor]) -> tuple[Any, Any]:
        """The next state, and what else the function gives; of one track, or scene."""
        f, sensor = _parts(module)
        measurements = Measurements(**data, sensor=sensor).as_track(scans=f.scans)
        (frame,), _ = f._frames(CompleteScans(*measurements) if self.complete else measurements, int(f.scans))
        return self.function(f, spoilt(f, state, sensor), frame)


def keep(f: Recursion, state: HasBelief, frame: Frame) -> tuple[Any, Any]:
    """A step of ``forward``: the next state, and what is kept of the step."""
    state, of_step = keep_past(f, state, frame)
    return state, of_step._replace(past=None)


def keep_past(f: Recursion, state: HasBelief, frame: Frame) -> tuple[Any, Any]:
    """The same with what the backward pass needs."""
    state, record = f.advance(state, frame)
    return state, kept(record, frame.measurement_noise.log_norm)
