"""A track as a dictionary of tensors, numbers and words, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from torchfra import tree
from torchfra.stream.clock import Clock
from torchfra.stream.window import Entry, Window

FORMAT = 1


def saved(window: Window, clock: Clock, counts: Mapping[str, int], of: Mapping[str, Any]) -> dict[str, Any]:
    """A window, its clock, counts, and what it is ``of``: words and numbers by name."""
    entries = [{**entry._asdict(), "state": tree.flatten(entry.state)} for entry in window.entries]
    return {
        "format": FORMAT,
        **of,
        "time": window.time,
        "state": tree.flatten(window.state),
        "forgot": window.forgot,
        "entries": entries,
        "clock": clock.state_dict(),
        "counts": dict(counts),
    }


def restored(
    values: Mapping[str, Any], window: Window, jump: float | None, of: Mapping[str, Any]
) -> tuple[Window, Clock, dict[str, int]]:
    """The window, the clock and the counts that were saved.

    Args:
        values: what ``saved`` gave.
        window: of a tracker like the one that was saved.
        jump: of its clock.
        of: what that is.

    Raises:
        ValueError: they are of another tracker.
    """
    for name, expected in {"format": FORMAT, **of}.items():
        received = values.get(name) if isinstance(values, Mapping) else None
        if received != expected:
            raise ValueError(f"values: expected {name} {expected!r}, received {received!r}")
    try:
        again, clock = Window(values["time"], _state(values["state"], window.state)), Clock(jump)
        again.forgot = values["forgot"]
        again.entries = [Entry(**{**x, "state": _state(x["state"], window.state)}) for x in values["entries"]]
        clock.load_state_dict(values["clock"])
        return again, clock, dict(values["counts"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"values: expected all that state_dict gives, received none of {error}") from None


def _state(tensors: Sequence[Tensor], like: Any) -> Any:
    """A state of the form of another."""
    form = [(x.shape, x.dtype) for x in tree.flatten(like)]
    received = [(x.shape, x.dtype) for x in tensors]
    if received != form:
        raise ValueError(f"values: expected states of {form}, received {received}")
    return tree.unflatten(like, iter(tensors))
