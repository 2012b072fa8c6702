"""A grid of values, all in one program."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence, Sized
from typing import NamedTuple

import torch

from torchfra.filters import Filter
from torchfra.fitting.data import Source, batch_of
from torchfra.fitting.objective import LossFunction, compiled, objective_of
from torchfra.fitting.vector import Vector, copied
from torchfra.tables import text_table


class Sweep(NamedTuple):
    """Mean losses over tracks at a grid of values."""

    names: list[str]
    """Names of the values."""
    points: list[tuple[float, ...]]
    """Combinations of the values."""
    losses: list[float]
    """Mean loss per track of each combination."""
    notes: list[str]

    @property
    def best(self) -> dict[str, float]:
        """The combination of the least loss; a loss that is NaN, as of a filter that diverges, is the largest."""
        place = min(range(len(self.losses)), key=lambda i: (math.isnan(self.losses[i]), self.losses[i]))
        return dict(zip(self.names, self.points[place], strict=True))

    def __str__(self) -> str:
        rows = [[*(f"{v:.5g}" for v in point), f"{loss:.6g}"]
                for point, loss in zip(self.points, self.losses, strict=True)]  # fmt: skip
        return text_table([*self.names, "loss"], rows, align=">")


def sweep(
    filter: Filter, data: Source, values: Mapping[str, Sequence[float]], *, loss: str | LossFunction | None = None,
    scale: float | None = None, skip: int = 0, runs: int = 400, compile: bool | None = None, seed: int = 0,
) -> Sweep:  # fmt: skip
    """The mean loss over all tracks at every combination of some values.

    Args:
        filter: any preset; it stays as it is.
        data: see ``fit``.
        values: values of hyperparameters by name, in natural units; ``{"q": (0.1, 1, 10), "std": (1, 2)}``.
        loss: see ``fit``.
        scale: see ``fit``.
        skip: see ``fit``.
        runs: see ``fit``.
        compile: see ``fit``.
        seed: of simulated tracks.

    Raises:
        ValueError: names that are not those of single numbers, or arguments that do not fit.
    """
    if not isinstance(values, Mapping) or not all(isinstance(tried, Sized) for tried in values.values()):
        raise ValueError(f"values: expected a sequence of numbers for each name, received {values!r}")
    f = copied(filter, tuple(values))
    vector = Vector(f)
    if len(vector.names) != len(values):
        raise ValueError(f"values: expected the names of single numbers, received {sorted(values)} for {vector.names}")
    keys = [name if name in values else name.rpartition(".")[2] for name in vector.names]
    grids = [vector.unconstrained(name, values[key]) for name, key in zip(vector.names, keys, strict=True)]
    raw = torch.cartesian_prod(*grids).reshape(-1, len(grids))
    tracks = batch_of(f, data, runs=runs, seed=seed)
    objective = objective_of(f, vector, data, tracks, loss, scale, skip)
    if scale is None:
        objective.choose_scale(tracks)
    notes, _ = compiled(objective, tracks, compile)
    mean = objective.losses(raw.unsqueeze(1), tracks).mean(1)
    return Sweep(keys, list(itertools.product(*(map(float, values[key]) for key in keys))), mean.tolist(), notes)
