"""Hyperparameters: constrained values, fixed or learnable, and how to find them in a filter."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import reduce, wraps
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.distributions import constraints, transform_to
from typing_extensions import Self

from torchfra import tree
from torchfra.linalg.tracing import is_traced, now_elementary
from torchfra.numbers import as_numbers
from torchfra.suggestions import meant
from torchfra.tables import text_table

_HALF_OPEN = type(constraints.half_open_interval(0.0, 1.0))
Value = float | Tensor
Values = Value | Sequence[float] | Sequence[Sequence[float]]
M = TypeVar("M", bound=nn.Module)
T = TypeVar("T")  # a state
F = TypeVar("F", bound=Callable[..., Any])
_known: ContextVar[dict[Any, Any] | None] = ContextVar("known", default=None)


@contextmanager
def same_values() -> Iterator[None]:
    """Inside this context no hyperparameter changes, so that what depends on them alone is computed once.

    A part that is computed again for its gradient must not run in it: it would not find what the first run found.
    """
    token = _known.set({})
    try:
        yield
    finally:
        _known.reset(token)


def once(method: F) -> F:
    """Computes a method once inside of ``same_values``.

    Its result depends on hyperparameters and on the dtype, device and rank of its argument alone.
    """

    @wraps(method)
    def call(module: nn.Module, like: Tensor | None = None) -> Any:
        known = None if torch.compiler.is_compiling() or now_elementary() else _known.get()
        if known is None:
            return method(module, like)
        form = None if like is None else (like.dtype, like.device, like.dim())
        key = method, module, form, torch.is_grad_enabled()
        if key not in known:
            result = method(module, like)
            if is_traced(*tree.flatten(result)):  # by a transform that may end inside of the context
                return result
            known[key] = result
        return known[key]

    return call  # type: ignore[return-value]


def one_of(**choices: tuple[str, Collection[str]]) -> None:
    """Checks that arguments are among their allowed values: ``one_of(rule=(rule, ("third", "fifth")))``.

    Raises:
        ValueError: names the first argument that is not, and its allowed values.
    """
    for name, (value, allowed) in choices.items():
        if value not in allowed:
            raise ValueError(f"{name}: expected one of {tuple(allowed)}, received {value!r}{meant(value, allowed)}")


def one_given(**arguments: Any) -> tuple[str, Any]:
    """Name and value of the only argument that is not None, among mutually exclusive ones.

    Raises:
        ValueError: all are None, or several are not.
    """
    given = {name: value for name, value in arguments.items() if value is not None}
    if len(given) != 1:
        received = " and ".join(given) or "none"
        raise ValueError(f"{', '.join(arguments)}: expected one of them, received {received}")
    return given.popitem()


class Hyper(nn.Module):
    """A hyperparameter in natural units; calling it returns its value.

    Args:
        value: a number, or a tensor whose shape broadcasts with the batch of tracks: thresholds of shape ``(100, 1)``
            with 1000 tracks make a batch of ``(100, 1000)``.  It is held in double precision, unless ``float()`` of the
            module says otherwise.
        constraint: allowed values, from ``torch.distributions.constraints``.
        learn: whether the value is a parameter that gradient descent may change.
        event_dim: number of last dimensions of ``value`` that are not batch dimensions, as in ``torch.distributions``:
            1 for a vector with one value per element.
        finite: whether an infinity means nothing, as of noise; a threshold of infinity is none.
        name: what error messages call the value.

    The state dict holds the unconstrained value as ``raw`` whether it is learnable or not, so that values learned by
    one filter load into another where they are fixed.

    Raises:
        ValueError: the value violates the constraint, is NaN, or infinite where it must be ``finite``, or is to be
            learned and on the boundary of its range.

    Example:
        >>> threshold = torchfra.Hyper(1.5, learn=True)
        >>> round(threshold().item(), 3), threshold.raw.requires_grad
        (1.5, True)
    """

    raw: Tensor
    shared_dims = 0
    """Number of last batch dimensions of a filter over which the value is shared, such as the models of an ``IMM``."""

    def __init__(
        self,
        value: Value,
        constraint: constraints.Constraint = constraints.positive,
        *,
        learn: bool = False,
        event_dim: int = 0,
        finite: bool = False,
        name: str = "value",
    ) -> None:
        super().__init__()
        self.constraint, self.event_dim, self.finite = constraint, event_dim, finite
        self.register_buffer("raw", self._unconstrained(value, name))
        if learn:
            self.learn(name)

    def set(self, value: Value, name: str = "value") -> None:
        """Replaces the value, in place.

        Args:
            value: of the same shape, or one number for all entries.
            name: what error messages call the value.

        Raises:
            ValueError: the value violates the constraint, is NaN, or infinite where it must be ``finite``, or is of
                another shape.
        """
        raw = self._unconstrained(value, name)
        if raw.dim() and raw.shape != self.raw.shape:
            expected = f"a number or {tuple(self.raw.shape)}" if self.raw.dim() else "a number"
            raise ValueError(f"{name}: expected {expected}, received {tuple(raw.shape)}")
        with torch.no_grad():
            self.raw.copy_(raw)

    def _unconstrained(self, value: Value, name: str) -> Tensor:
        value = as_numbers(value, name)
        if value.is_meta:
            raise ValueError(f"{name}: expected numbers, received a tensor on the meta device, which has none")
        if value.requires_grad:
            received = "a Parameter" if isinstance(value, nn.Parameter) else "a tensor with a gradient"
            last = name.rpartition(".")[2]
            expected = f"numbers, as a filter learns its own copy: learn=({last!r},), torchfra.learnable or .learn()"
            other = "to compute it elsewhere, torch.func.functional_call with its .raw"
            raise ValueError(f"{name}: expected {expected}; {other}; received {received}")
        value = value.double()
        if 0 in value.shape[: value.dim() - self.event_dim]:
            raise ValueError(f"{name}: expected one value or more, received none, {tuple(value.shape)}")
        if not bool(self.constraint.check(value).all()):
            raise ValueError(f"{name}: expected {_allowed(self.constraint)}, received {value.tolist()}")
        if self.finite and bool(value.isinf().any()):
            raise ValueError(f"{name}: expected finite numbers, received {value.tolist()}")
        raw: Tensor = transform_to(self.constraint).inv(value.detach().clone())
        return raw

    @property
    def interior(self) -> bool:
        """Whether no entry is on the boundary of its range, from where gradient descent cannot move it."""
        raw, transform = self.raw.detach(), transform_to(self.constraint)
        value, least = transform(raw), torch.finfo(raw.dtype).tiny
        for infinite in (-torch.inf, torch.inf):  # torch stops short of an end, by the least number or so
            end = transform(torch.full_like(raw, infinite))
            if bool(((value == end) | ((value - end).abs() <= 4 * least)).any()):
                return False
        return bool(raw.isfinite().all())

    def out_of_range(self) -> Tensor:
        """``(...)`` bool, where an entry is NaN, or infinitely far out where its range has no end.

        Training may have left it there.  One that must be ``finite`` is not infinite in its range either.
        """
        raw = self.raw.detach()
        value = transform_to(self.constraint)(raw)
        bad: Tensor = ~value.isfinite() if self.finite else value.isnan()
        if not self.sums_to_one:
            bad = bad | ((raw.abs() == torch.inf) & ~self.constraint.check(value))
        return bad.flatten(-self.event_dim).any(-1) if self.event_dim else bad

    @property
    def sums_to_one(self) -> bool:
        """Whether the value is rows of probabilities."""
        return isinstance(self.constraint, type(constraints.simplex))  # a copy has a constraint of its own

    @property
    def batch_rank(self) -> int:
        """Number of batch dimensions of the value."""
        return self.raw.dim() - self.event_dim

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """``nn.Module.requires_grad_``; a fixed value learns."""
        if requires_grad:
            self.learn()
        return super().requires_grad_(requires_grad)

    def learn(self, name: str = "value") -> None:
        """Makes the value a parameter, which an optimiser finds in ``parameters()``: ``f.robust.threshold.learn()``.

        Raises:
            ValueError: the value is on the boundary of its range.
        """
        if not self.interior:
            raise ValueError(f"{name}: expected a value inside its range, to learn it, received {self().tolist()}")
        raw = self.raw
        if "raw" in self._buffers:
            del self._buffers["raw"]
            self.raw = nn.Parameter(raw)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, local_metadata: object, strict: bool, missing_keys: list[str],
        unexpected_keys: list[str], error_msgs: list[str],
    ) -> None:  # fmt: skip
        """Loads a value; one that is NaN or out of its range is an error."""
        raw = state_dict.get(f"{prefix}raw")
        if isinstance(raw, Tensor) and raw.shape == self.raw.shape and not raw.is_meta:
            loaded = Hyper.__new__(Hyper)
            nn.Module.__init__(loaded)
            loaded.constraint, loaded.event_dim, loaded.finite = self.constraint, self.event_dim, self.finite
            loaded.raw = raw.detach()
            if bool(loaded.out_of_range().any()):
                expected = f"{_allowed(self.constraint)}, finite" if self.finite else _allowed(self.constraint)
                error_msgs.append(f"{prefix[:-1]}: expected {expected}, received {loaded().tolist()}")
                return
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, error_msgs
        )

    @once
    def forward(self, like: Tensor | None = None) -> Tensor:
        """The value in natural units, with the dtype and on the device of ``like`` if that is not None."""
        value: Tensor = transform_to(self.constraint)(self.raw)
        for _ in range(self.shared_dims if self.batch_rank else 0):
            value = value.unsqueeze(-1 - self.event_dim)
        return value if like is None else value.to(like)

    def elements(self, like: Tensor | None = None) -> Tensor:
        """The value with a last dimension that broadcasts with the elements of a vector ``like (..., m)``."""
        value: Tensor = self(like)
        return value if self.event_dim else value.unsqueeze(-1)

    def describe(self) -> tuple[str, str, str]:
        """As text: the value (or the shape of many values), its range, and ``"learnable"`` or ``"fixed"``."""
        value = self().detach()
        if value.numel() <= 10 and value.dim() < 2:
            values = ", ".join(f"{v:.6g}" for v in value.flatten().tolist())
        else:
            values = f"values of shape {tuple(value.shape)}"
        return values, _allowed(self.constraint), "learnable" if self.raw.requires_grad else "fixed"

    def extra_repr(self) -> str:
        """Value, range and whether it is learnable."""
        return ", ".join(self.describe())


def _allowed(constraint: constraints.Constraint) -> str:
    """The allowed values of a constraint as text."""
    low, high = getattr(constraint, "lower_bound", None), getattr(constraint, "upper_bound", None)
    if low is None:
        return "a number" if isinstance(constraint, type(constraints.real)) else f"a value in {constraint}"
    if high is not None:
        return f"a value in [{low:g}, {high:g}{')' if isinstance(constraint, _HALF_OPEN) else ']'}"
    strict = isinstance(constraint, type(constraints.greater_than(0.0)))
    return f"a value above {low:g}" if strict else f"a value of {low:g} or more"


class Part(nn.Module):
    """A module with hyperparameters, which refuses what would change none of them without a word.

    Raises:
        ValueError: an assignment to the name of a hyperparameter, at any depth, or ``requires_grad_()`` of a module
            that has nothing to learn.
    """

    def __setattr__(self, name: str, value: Tensor | nn.Module) -> None:
        known, plain = self.__dict__, not isinstance(value, nn.Module | None)
        if plain and name not in known and "_modules" in known:
            self._refuse(name, value)
        super().__setattr__(name, value)

    def _refuse(self, name: str, value: object) -> None:
        """Refuses a value for the name of a hyperparameter."""
        paths = [path for path in hypers(self) if path.rpartition(".")[2] == name]
        if paths:
            way = " or ".join(f".{path}.set(...)" for path in paths)
            learning = ", and .learn() to learn it" if isinstance(value, nn.Parameter) else ""
            raise ValueError(f"{name}: expected {way}{learning}, received an assignment of {value!r}")

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """``nn.Module.requires_grad_``, of a module that has something to learn."""
        if requires_grad and next(self.parameters(), None) is None and hypers(self):
            expected = "values to learn: torchfra.learnable(..., 'all'), or .learn() of a hyperparameter, makes them"
            raise ValueError(f"requires_grad_: expected {expected}, received none")
        return super().requires_grad_(requires_grad)


def hypers(module: nn.Module) -> dict[str, Hyper]:
    """All hyperparameters of a module, by their path, such as ``"motion.q"``."""
    return {path: part for path, part in module.named_modules() if isinstance(part, Hyper)}


def element_names(path: str, hyper: Hyper) -> list[str]:
    """A name for each number of a hyperparameter: its path, with an index where it has several, ``"motion.q[1]"``."""
    indices = (",".join(map(str, index)) for index in itertools.product(*map(range, hyper.raw.shape)))
    return [f"{path}[{index}]" if index else path for index in indices]


def natural_values(module: nn.Module) -> dict[str, float]:
    """All hyperparameters of a module in natural units by their path; each element of a vector by its index."""
    values: dict[str, float] = {}
    for path, hyper in hypers(module).items():
        values |= zip(element_names(path, hyper), hyper().detach().flatten().tolist(), strict=True)
    return values


def out_of_range(module: nn.Module) -> Tensor | None:
    """``(...)`` bool, where a hyperparameter of a module is NaN or out of its range; None if none is anywhere.

    Where the values themselves are traced the answer is a tensor.  It is quick, as every call of a filter asks.
    """
    parts = [part for part in module.modules() if isinstance(part, Hyper)]
    raws = [part.raw.detach() for part in parts]
    traced = is_traced(*raws)
    if not raws or (not traced and math.isfinite(sum(x.sum() for x in raws).item())):  # type: ignore[union-attr]
        return None
    bad = reduce(torch.logical_or, (part.out_of_range() for part in parts))
    return bad if traced or bool(bad.any()) else None


def spoilt(f: nn.Module, state: T, sensor: nn.Module | None = None) -> T:
    """The state, whose means are NaN for each track with a hyperparameter that is NaN or out of its range.

    A choice takes NaN for no, and goes on: a gate of NaN would let every measurement pass, or none.  So a filter's
    state is spoilt where it enters a step, of another ``sensor`` than the filter's own too.
    """
    bad = out_of_range(f if sensor is None else nn.ModuleList([f, sensor]))
    return state if bad is None else _with_nan(state, bad, state.belief.mean.dim() - 1)  # type: ignore[attr-defined]


def _with_nan(state: T, bad: Tensor, rank: int) -> T:
    """The state with NaN for every field ``mean`` where ``bad (...)``, of ``rank`` dimensions."""
    if not isinstance(state, tuple):
        return state
    if not hasattr(state, "_fields"):
        return tuple(_with_nan(part, bad, rank) for part in state)  # type: ignore[return-value]  # a plain one
    parts = {name: _with_nan(part, bad, rank) for name, part in zip(state._fields, state, strict=True)}
    if isinstance(mean := parts.get("mean"), Tensor):
        each = bad.reshape(bad.shape + (1,) * (mean.dim() - rank))
        parts["mean"] = torch.where(each, torch.nan, mean)
    return type(state)(**parts)


def named(module: nn.Module, names: Collection[str]) -> dict[str, Hyper]:
    """The hyperparameters of a module that have certain names, by their path.

    Args:
        module: searched at any depth.
        names: whole paths, such as ``"motion.q"``, or their last parts, such as ``"q"``, which may match several
            hyperparameters; a single name may be a plain string.  ``"all"`` selects every hyperparameter except those
            on the boundary of their range, such as an infinite threshold.

    Raises:
        ValueError: the module has no hyperparameter of that name; the message lists the names that it has.
    """
    every = hypers(module)
    if names == "all":
        return {path: hyper for path, hyper in every.items() if hyper.interior}
    selected: dict[str, Hyper] = {}
    for name in (names,) if isinstance(names, str) else names:
        matching = {path: hyper for path, hyper in every.items() if name in (path, path.rpartition(".")[2])}
        if not matching:
            known = sorted({path.rpartition(".")[2] for path in every})
            raise ValueError(f"learn: expected 'all' or some of {known}, received {name!r}")
        selected |= matching
    return selected


def learnable(module: M, names: Collection[str]) -> M:
    """Makes hyperparameters of a module parameters, which an optimiser finds in ``module.parameters()``.

    Args:
        module: it is changed in place.
        names: as in ``named``: ``("q", "robust.threshold")``, or ``"all"``.

    Returns:
        The same module.

    Raises:
        ValueError: the module has no hyperparameter of that name, or its value is on the boundary of its range.

    Example:
        >>> srckf = torchfra.presets.rsrckf(torchfra.motion.ConstantVelocity(1.0), torchfra.sensors.Position(2.0))
        >>> [name for name, _ in torchfra.learnable(srckf, ('threshold',)).named_parameters()]
        ['robust.threshold.raw']
    """
    for path, hyper in named(module, names).items():
        hyper.learn(path)
    return module


def summary(module: nn.Module) -> None:
    """Print a table of a filter's hyperparameters: name, value, what it may be, and whether it is learnable."""
    rows = [(path, *hyper.describe()) for path, hyper in hypers(module).items()]
    print(text_table(("name", "value", "range", "learning"), rows, align="<"))
