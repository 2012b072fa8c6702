"""A track as a dictionary of tensors, numbers and words, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from torchfra import tree
from torchfra.stream.window import Entry, Window

FORMAT = 1


def saved(window: Window, of: Mapping[str, Any]) -> dict[str, Any]:
    """A window, and what it is ``of``: words and numbers by name."""
    entries = [{**entry._asdict(), "state": tree.flatten(entry.state)} for entry in window.entries]
    return {
        "format": FORMAT,
        **of,
        "time": window.time,
        "state": tree.flatten(window.state),
        "forgot": window.forgot,
        "entries": entries,
    }


def restored(values: Mapping[str, Any], window: Window, of: Mapping[str, Any]) -> Window:
    """The window that was saved.

    Args:
        values: what ``saved`` gave.
        window: of a tracker like the one that was saved.
        of: what that is.

    Raises:
        ValueError: they are of another tracker.
    """
    for name, expected in {"format": FORMAT, **of}.items():
        received = values.get(name) if isinstance(values, Mapping) else None
        if received != expected:
            raise ValueError(f"values: expected {name} {expected!r}, received {received!r}")
    again = Window(values["time"], _state(values["state"], window.state))
    again.forgot = values["forgot"]
    again.entries = [Entry(**{**x, "state": _state(x["state"], window.state)}) for x in values["entries"]]
    return again


def _state(tensors: Sequence[Tensor], like: Any) -> Any:
    """A state of the form of another."""
    form = [(x.shape, x.dtype) for x in tree.flatten(like)]
    received = [(x.shape, x.dtype) for x in tensors]
    if received != form:
        raise ValueError(f"values: expected states of {form}, received {received}")
    return tree.unflatten(like, iter(tensors))
