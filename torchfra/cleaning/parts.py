"""Axes that are cleaned as one, with their parameters: of a batch of rows, some of which are of one track."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.cleaning.closed_form import DEFAULT, Fixes, Levels, OutlierModel
from torchfra.tree import map_tensors

SHORT = 0
"""Owner of the rows of all tracks that are too short to have values of their own."""


class Part(NamedTuple):
    """Axes with one variance, and their parameters: those across the ground, or the height."""

    fixes: Fixes
    """Fixes with the variance in units of sigma squared."""
    levels: Levels
    sigma: Tensor
    """``(B,)`` m."""
    least: Tensor
    """``(B,)`` least sigma, m."""
    most: Tensor
    """``(B,)`` largest estimated sigma, m: infinite but for tracks that circle, NaN where sigma is given."""
    lowest: Tensor
    """``(B,)`` m, the lowest sigma that a track does not rule out, by which its path is computed, if its estimates are
    hardly more certain than its fixes; NaN for other tracks."""
    stops: Tensor
    """``(B,)`` whether targets may stop between two fixes (``may_stop``)."""
    model: OutlierModel = DEFAULT
    """How likely outliers are."""

    def at(self, rows: Tensor) -> Part:
        """The part of some rows."""
        return map_tensors(lambda x: x[..., rows], self)

    @property
    def on_line(self) -> Part:
        """The part for a filter on line: outliers are as likely as they are by default, whatever other axes say."""
        model = DEFAULT._replace(least_offset=self.model.least_offset, same_offset=self.model.same_offset)
        return self._replace(fixes=self.fixes._replace(log_odds=torch.zeros_like(self.fixes.log_odds)), model=model)

    @property
    def scaled(self) -> Fixes:
        """The fixes with their variance in m^2."""
        return self.fixes._replace(variance=self.fixes.variance * self.sigma.square())


def summed(values: Tensor, owner: Tensor) -> Tensor:
    """Values ``(..., B)`` summed over all rows of the same ``owner (B,)``, for each row."""
    every = values.new_zeros(*values.shape[:-1], int(owner.max()) + 1).index_add(-1, owner, values)
    return every[..., owner]
