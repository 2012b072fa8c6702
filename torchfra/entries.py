"""Matrices whose entries are numbers or hyperparameters."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchfra.hyper import Hyper, once
from torchfra.numbers import as_numbers


class Entries(nn.Module):
    """A matrix of numbers, of which some entries may be ``Hyper``, learnable or not; calling it returns its value.

    The state dict has the hyperparameters alone, ``"F.0,1.raw"`` say; the numbers are part of the model.

    Args:
        values: numbers as a tensor, an array or nested lists; in lists an entry may be a ``Hyper``.
        name: what error messages call the matrix.

    Raises:
        ValueError: no numbers, infinite or missing ones, or rows of different lengths.
    """

    fixed: Tensor

    def __init__(self, values: object, name: str) -> None:
        super().__init__()
        found: dict[tuple[int, ...], Hyper] = {}
        numbers = as_numbers(_plain(values, (), found), name).double()
        if not bool(numbers.isfinite().all()):
            raise ValueError(f"{name}: expected finite numbers, received {numbers.tolist()}")
        self.register_buffer("fixed", numbers.detach().clone(), persistent=False)
        self.places = tuple(found)
        for place, hyper in found.items():
            if hyper.raw.dim():
                at = f"{name}[{', '.join(map(str, place))}]"
                raise ValueError(f"{at}: expected a single value, received {tuple(hyper.raw.shape)}")
            self.add_module(_label(place), hyper)

    @property
    def shape(self) -> torch.Size:
        """Of the matrix."""
        return self.fixed.shape

    @once
    def forward(self, like: Tensor | None = None) -> Tensor:
        """The matrix, with the dtype and on the device of ``like`` if that is not None."""
        value = self.fixed if like is None else self.fixed.to(like)
        for place in self.places:
            where = self.fixed.new_zeros(self.shape, dtype=torch.bool)
            where[place] = True
            value = torch.where(where, self.get_submodule(_label(place))(value), value)
        return value


def _label(place: tuple[int, ...]) -> str:
    return ",".join(map(str, place))


def _plain(values: object, place: tuple[int, ...], found: dict[tuple[int, ...], Hyper]) -> Any:
    """The values with 0 in the place of each hyperparameter, which goes into ``found``."""
    if isinstance(values, Hyper):
        found[place] = values
        return 0.0
    if isinstance(values, list | tuple):
        return [_plain(value, (*place, i), found) for i, value in enumerate(values)]
    return values
