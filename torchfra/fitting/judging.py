"""Losses on held-out tracks, with intervals from a paired bootstrap over tracks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.tables import text_table

RESAMPLES = 2000
"""Of the tracks."""
LOST = 30.0
"""Median changes from which on a track decides the mean of all."""


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
    middle: Figure
    """The median over tracks of what each changes by, which a few lost tracks do not decide."""
    lost: int
    """Tracks that change by over 30 times as much as the median track: they decide the mean."""

    @property
    def figures(self) -> dict[str, Figure]:
        """By name, as tables and files have them."""
        return {"before": self.before, "after": self.after, "change": self.change, "median change": self.middle}

    def note(self, name: str, count: int) -> str:
        """What is to be said of those that are lost, out of so many."""
        much = f"over {LOST:g} times as much as the median one"
        return f"{self.lost} of {count} held-out tracks change {much}, and decide that of the {name}: are they lost?"


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
    change = after.double().sqrt() - before.double().sqrt() if root else after.double() - before.double()
    lost = int((change.abs() > LOST * change.abs().median()).sum())
    ordered = change[drawn].sort(1).values
    middle = (ordered[:, (count - 1) // 2] + ordered[:, count // 2]) / 2
    return Judged(_figure(one), _figure(other), _figure(other - one), _figure(middle), lost)


def _figure(x: Tensor) -> Figure:
    low, high = x[1:].quantile(torch.tensor([0.025, 0.975], dtype=x.dtype)).tolist()
    return Figure(float(x[0]), low, high)


class HeldOutComparison:
    """Filters by the loss of a fit on its held-out tracks; printed, a table, its last column the median over tracks.

    ``torchfra.compare`` compares any filters by their errors, as papers do.
    """

    def __init__(self, quantity: str, tracks: int, rows: Mapping[str, Judged]) -> None:
        self.quantity, self.tracks, self.rows = quantity, tracks, dict(rows)

    def __str__(self) -> str:
        head = [f"{self.quantity}, {self.tracks} held-out tracks", "value", "minus the first's", "median"]
        rows = [[name, *map(str, (row.after, row.change, row.middle))] for name, row in self.rows.items()]
        return text_table(head, rows, align="<")

    __repr__ = __str__
