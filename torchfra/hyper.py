"""One constrained value, fixed or learnable."""

from __future__ import annotations

from collections.abc import Collection
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.distributions import constraints, transform_to

Value = float | Tensor
M = TypeVar("M", bound=nn.Module)


class Hyper(nn.Module):
    """A hyperparameter in natural units: call it to read it.

    Args:
        value: a number, or a tensor whose shape broadcasts with the batch of tracks: thresholds of shape ``(100, 1)``
            against 1000 tracks give a batch of ``(100, 1000)``.
        constraint: of ``torch.distributions.constraints``; what the value may be.
        learn: whether gradient descent may change it.
        name: what an error calls it.

    The state dict holds the unconstrained value under ``raw`` whether it is learnable or not, so that values learned
    by one filter load into a fixed one.

    Raises:
        ValueError: the value is outside the constraint, not a number, or on its edge and to be learned.
    """

    raw: Tensor

    def __init__(
        self,
        value: Value,
        constraint: constraints.Constraint = constraints.positive,
        *,
        learn: bool = False,
        name: str = "value",
    ) -> None:
        super().__init__()
        if not isinstance(value, Tensor) or not value.is_floating_point():
            value = torch.as_tensor(value, dtype=torch.float64)
        if not bool(constraint.check(value).all()):
            raise ValueError(f"{name}: expected {_said(constraint)}, received {value.tolist()}")
        self.constraint = constraint
        self.register_buffer("raw", transform_to(constraint).inv(value.detach().clone()))
        if learn:
            self.learn(name)

    def learn(self, name: str = "value") -> None:
        """Make the value a parameter from here on."""
        if not bool(self.raw.isfinite().all()):
            raise ValueError(f"{name}: to be learned it must lie inside its range, not on the edge: {self().tolist()}")
        raw = self.raw
        if "raw" in self._buffers:
            del self._buffers["raw"]
            self.raw = nn.Parameter(raw)

    def forward(self) -> Tensor:
        """The value, in natural units."""
        value: Tensor = transform_to(self.constraint)(self.raw)
        return value

    def extra_repr(self) -> str:
        """Value (or the shape of many), range and whether it learns."""
        value = self().detach()
        said = f"{value.item():.6g}" if value.dim() == 0 else f"values of shape {tuple(value.shape)}"
        return f"{said}, {_said(self.constraint)}, {'learnable' if self.raw.requires_grad else 'fixed'}"


def _said(constraint: constraints.Constraint) -> str:
    named = {constraints.positive: "a value above 0", constraints.nonnegative: "a value of 0 or more"}
    if constraint in named:
        return named[constraint]
    low, high = getattr(constraint, "lower_bound", None), getattr(constraint, "upper_bound", None)
    if low is None:
        return "a number" if constraint is constraints.real else f"a value in {constraint}"
    return f"a value of {low:g} or more" if high is None else f"a value in [{low:g}, {high:g}]"


def learnable(module: M, names: Collection[str]) -> M:
    """Make the hyperparameters of these names learnable, wherever in the module they are.

    Raises:
        ValueError: a name that the module does not have; says which there are.
    """
    hypers = {path.rpartition(".")[2]: part for path, part in module.named_modules() if isinstance(part, Hyper)}
    names = (names,) if isinstance(names, str) else names
    for name in names:
        if name not in hypers:
            raise ValueError(f"learn: expected names out of {sorted(hypers)}, received {name!r}")
        hypers[name].learn(name)
    return module
