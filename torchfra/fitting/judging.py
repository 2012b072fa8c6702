"""Losses on held-out tracks, with intervals from a paired bootstrap over tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.tables import text_table

RESAMPLES = 2000
"""Number of resamples of the tracks."""
LOST = 30.0
"""Multiple of the median change beyond which a track dominates the mean of all."""


class Figure(NamedTuple):
    """A number and its 95 % interval, NaN of a single track."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        interval = "" if math.isnan(self.low) else f" [{self.low:.4g}, {self.high:.4g}]"
        return f"{self.value:.4g}{interval}"


class Judged(NamedTuple):
    """One quantity for two sets of values (or two filters) on the same tracks."""

    before: Figure
    after: Figure
    change: Figure
    """After minus before, with the same resampled tracks for both."""
    middle: Figure
    """The median over tracks of the change, which a few lost tracks do not dominate."""
    lost: int
    """Number of tracks that change by over 30 times as much as the median track: they dominate the mean."""

    @property
    def figures(self) -> dict[str, Figure]:
        """The figures by their names in tables and files."""
        return {"before": self.before, "after": self.after, "change": self.change, "median change": self.middle}

    def note(self, name: str, count: int) -> str:
        """The warning about lost tracks, out of the ``count`` tracks that judge."""
        much = f"over {LOST:g} times as much as the median one"
        return f"{self.lost} of {count} tracks that judge change {much}, and decide that of the {name}: are they lost?"


def judged(
    before: Tensor, after: Tensor, *, weights: Tensor | None = None, root: bool = False, seed: int = 0
) -> Judged:
    """A mean over tracks before and after, and its change.

    Args:
        before: ``(N,)`` value of each track before.
        after: ``(N,)`` value of each track after.
        weights: ``(N,)`` of the tracks, such as their numbers of measurements; equal if None.
        root: whether to take the square root of the mean.
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
    first, second, difference, usual = (_figure(x, count) for x in (one, other, other - one, middle))
    return Judged(first, second, difference, usual, lost)


def _figure(x: Tensor, count: int) -> Figure:
    if count == 1:  # whose resamples are all the same
        return Figure(float(x[0]), math.nan, math.nan)
    low, high = x[1:].quantile(torch.tensor([0.025, 0.975], dtype=x.dtype)).tolist()
    return Figure(float(x[0]), low, high)


@dataclass(frozen=True, repr=False)
class HeldOutComparison:
    """Filters by the loss of a fit on its held-out tracks; printed, a table, its last column the median over tracks.

    ``torchfra.compare`` compares any filters by their errors, as papers do.
    """

    quantity: str
    """The loss and the tracks, in words."""
    rows: dict[str, Judged]

    def __repr__(self) -> str:
        head = [self.quantity, "value", "minus the first's", "median"]
        rows = [[name, *map(str, (row.after, row.change, row.middle))] for name, row in self.rows.items()]
        return text_table(head, rows, align="<")
