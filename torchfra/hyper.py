"""Constrained values, fixed or learnable, and how to find them in a filter."""

from __future__ import annotations

from collections.abc import Collection
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.distributions import constraints, transform_to

from torchfra.tables import text_table

Value = float | Tensor
M = TypeVar("M", bound=nn.Module)


def one_of(**choices: tuple[str, Collection[str]]) -> None:
    """Checks arguments against what they may be: ``one_of(rule=(rule, ("this", "that")))``.

    Raises:
        ValueError: names the first that is none of its own.
    """
    for name, (value, known) in choices.items():
        if value not in known:
            raise ValueError(f"{name}: expected one of {tuple(known)}, received {value!r}")


class Hyper(nn.Module):
    """A hyperparameter in natural units: call it to read it.

    Args:
        value: a number, or a tensor whose shape broadcasts with the batch of tracks: thresholds of shape ``(100, 1)``
            against 1000 tracks give a batch of ``(100, 1000)``.
        constraint: of ``torch.distributions.constraints``; what the value may be.
        learn: whether gradient descent may change it.
        event: last dimensions of ``value`` that are no batch: 1 for a vector with a value for each element.
        name: what an error calls it.

    The state dict holds the unconstrained value under ``raw`` whether it is learnable or not, so that values learned
    by one filter load into a fixed one.

    Raises:
        ValueError: the value is outside the constraint, not a number, or on its edge and to be learned.
    """

    raw: Tensor
    shared = 0
    """Last dimensions of a batch that share the values of their track: those of models, say."""

    def __init__(
        self,
        value: Value,
        constraint: constraints.Constraint = constraints.positive,
        *,
        learn: bool = False,
        event: int = 0,
        name: str = "value",
    ) -> None:
        super().__init__()
        self.constraint, self.event = constraint, event
        self.register_buffer("raw", self._unconstrained(value, name))
        if learn:
            self.learn(name)

    def set(self, value: Value, name: str = "value") -> None:
        """Give it another value, of the same shape or a number for all.

        Raises:
            ValueError: the value is outside the constraint, or not a number.
        """
        with torch.no_grad():
            self.raw.copy_(self._unconstrained(value, name))

    def _unconstrained(self, value: Value, name: str) -> Tensor:
        if not isinstance(value, Tensor) or not value.is_floating_point():
            value = torch.as_tensor(value, dtype=torch.float64)
        if not bool(self.constraint.check(value).all()):
            raise ValueError(f"{name}: expected {_said(self.constraint)}, received {value.tolist()}")
        raw: Tensor = transform_to(self.constraint).inv(value.detach().clone())
        return raw

    @property
    def inside(self) -> bool:
        """Whether the value lies inside its range and not on the edge, where gradient descent cannot leave from."""
        return bool(self.raw.isfinite().all())

    @property
    def batch_rank(self) -> int:
        """Batch dimensions that the value brings."""
        return self.raw.dim() - self.event

    def learn(self, name: str = "value") -> None:
        """Make the value a parameter from here on."""
        if not self.inside:
            raise ValueError(f"{name}: to be learned it must lie inside its range, not on the edge: {self().tolist()}")
        raw = self.raw
        if "raw" in self._buffers:
            del self._buffers["raw"]
            self.raw = nn.Parameter(raw)

    def forward(self, like: Tensor | None = None) -> Tensor:
        """The value, in natural units; in the dtype and on the device of ``like``, if that is given."""
        value: Tensor = transform_to(self.constraint)(self.raw)
        for _ in range(self.shared if self.batch_rank else 0):
            value = value.unsqueeze(-1 - self.event)
        return value if like is None else value.to(like)

    def elements(self, like: Tensor | None = None) -> Tensor:
        """The value with a last dimension for the elements of a vector: one for each, or one for all."""
        value: Tensor = self(like)
        return value if self.event else value.unsqueeze(-1)

    def describe(self) -> tuple[str, str, str]:
        """For people: the value (or the shape of many), its range, and whether it learns."""
        value = self().detach()
        few = (
            ", ".join(f"{v:.6g}" for v in value.flatten().tolist()) if value.numel() <= 6 and value.dim() < 2 else None
        )
        shown = f"values of shape {tuple(value.shape)}" if few is None else few
        return shown, _said(self.constraint), "learnable" if self.raw.requires_grad else "fixed"

    def extra_repr(self) -> str:
        """Value, range and whether it learns."""
        return ", ".join(self.describe())


def _said(constraint: constraints.Constraint) -> str:
    low, high = getattr(constraint, "lower_bound", None), getattr(constraint, "upper_bound", None)
    if low is None:
        return "a number" if isinstance(constraint, type(constraints.real)) else f"a value in {constraint}"
    if high is not None:
        return f"a value in [{low:g}, {high:g}]"
    strict = isinstance(constraint, type(constraints.greater_than(0.0)))
    return f"a value above {low:g}" if strict else f"a value of {low:g} or more"


def hypers(module: nn.Module) -> dict[str, Hyper]:
    """All hyperparameters of a module by their path, ``"motion.q"`` say."""
    return {path: part for path, part in module.named_modules() if isinstance(part, Hyper)}


def named(module: nn.Module, names: Collection[str]) -> dict[str, Hyper]:
    """The hyperparameters of these names by their path.

    Args:
        module: where to look, at any depth.
        names: last parts of a path, ``"q"``, or whole paths, ``"motion.q"``; or ``"all"``, which is every value that
            lies inside its range: those on the edge, such as an infinite threshold, stay as they are.

    Raises:
        ValueError: a name that the module does not have; says which there are.
    """
    known = hypers(module)
    if names == "all":
        return {path: hyper for path, hyper in known.items() if hyper.inside}
    names = (names,) if isinstance(names, str) else names
    found: dict[str, Hyper] = {}
    for name in names:
        matching = {path: hyper for path, hyper in known.items() if name in (path, path.rpartition(".")[2])}
        if not matching:
            last = sorted({path.rpartition(".")[2] for path in known})
            raise ValueError(f"learn: expected 'all' or names out of {last}, received {name!r}")
        found |= matching
    return found


def learnable(module: M, names: Collection[str]) -> M:
    """Make the hyperparameters of these names learnable, wherever in the module they are.

    Args:
        module: it is changed and returned.
        names: see ``named``.

    Raises:
        ValueError: a name that the module does not have, or a value on the edge of its range.
    """
    for path, hyper in named(module, names).items():
        hyper.learn(path)
    return module


def summary(module: nn.Module) -> None:
    """Print a table of a filter's hyperparameters: name, value, what it may be, and whether it is learnable."""
    rows = [(path, *hyper.describe()) for path, hyper in hypers(module).items()]
    print(text_table(("name", "value", "range", "learning"), rows, align="<"))
