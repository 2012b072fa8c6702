"""A state of targets as a dictionary that ``torch.load`` reads with ``weights_only=True``, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchfra import tree
from torchfra.targets.state import TargetsState

FORMAT = 1


def saved(state: TargetsState) -> dict[str, Any]:
    """A state, as a number and a list of tensors."""
    return {"format": FORMAT, "state": tree.flatten(state)}


def restored(values: Mapping[str, Any], empty: TargetsState) -> TargetsState:
    """The state that was saved.

    Args:
        values: what ``saved`` gave.
        empty: of a manager like the one whose state was saved, without targets.

    Raises:
        ValueError: they are of another manager.
    """
    received = values.get("format") if isinstance(values, Mapping) else None
    if received != FORMAT:
        raise ValueError(f"values: expected format {FORMAT}, received {received!r}")
    form, given = (
        [(x.shape[1:], x.is_floating_point()) for x in each] for each in (tree.flatten(empty), values["state"])
    )
    if given != form:
        raise ValueError(f"values: expected a state of {form}, received {given}")
    state: TargetsState = tree.unflatten(empty, iter(values["state"]))
    return state
