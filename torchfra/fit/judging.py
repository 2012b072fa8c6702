"""Losses on held-out tracks, with intervals from a paired bootstrap over tracks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.tables import text_table

RESAMPLES = 2000
"""Of the tracks."""


class Figure(NamedTuple):
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"


class Judged(NamedTuple):
    """One quantity of two sets of values (or two filters) on the same tracks."""

    before: Figure
    after: Figure
    change: Figure
    """After minus before, by tracks drawn for both together."""


def judged(
    before: Tensor, after: Tensor, *, weights: Tensor | None = None, root: bool = False, seed: int = 0
) -> Judged:
    """A mean over tracks before and after, and its change.

    Args:
        before: ``(N,)`` of each track.
        after: likewise.
        weights: ``(N,)`` of the tracks, their numbers of measurements say; all the same if None.
        root: whether the square root of the mean is wanted.
        seed: of the resamples.
    """
    generator = torch.Generator().manual_seed(seed)
    count = len(before)
    weights = torch.ones(count, dtype=torch.float64) if weights is None else weights.double()
    drawn = torch.randint(count, (RESAMPLES, count), generator=generator)
    drawn = torch.cat([torch.arange(count).unsqueeze(0), drawn])  # the tracks as they are come first
    means = [(x * weights)[drawn].sum(1) / weights[drawn].sum(1) for x in (before.double(), after.double())]
    one, other = (x.sqrt() if root else x for x in means)
    return Judged(*(_figure(x) for x in (one, other, other - one)))


def _figure(x: Tensor) -> Figure:
    low, high = x[1:].quantile(torch.tensor([0.025, 0.975], dtype=x.dtype)).tolist()
    return Figure(float(x[0]), low, high)


class Comparison:
    """Filters on the same held-out tracks; printing it prints a table."""

    def __init__(self, quantity: str, tracks: int, rows: Mapping[str, Judged]) -> None:
        self.quantity, self.tracks, self.rows = quantity, tracks, dict(rows)

    def __str__(self) -> str:
        head = [f"{self.quantity}, {self.tracks} held-out tracks", "value", "minus the first's"]
        return text_table(head, [[name, str(row.after), str(row.change)] for name, row in self.rows.items()], align="<")

    __repr__ = __str__

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"quantity": self.quantity, "tracks": self.tracks,
                "filters": {name: {"value": row.after._asdict(), "change": row.change._asdict()}
                            for name, row in self.rows.items()}}  # fmt: skip
