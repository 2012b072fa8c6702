"""What every preset has: the keyword ``learn``, a docstring with the lines of what it shares, its place by name."""

from __future__ import annotations

import copy
import inspect
import textwrap
from collections.abc import Callable, Collection
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from torchfra import register
from torchfra.filters.base import Filter
from torchfra.hyper import hypers, named
from torchfra.presets.options import Group
from torchfra.presets.values import with_values

P = ParamSpec("P")
F = TypeVar("F", bound=Filter)
SHARED = {
    "motion": "how targets move.",
    "models": "motions of one state, or a ``Bank`` of them.",
    "sensor": "what is measured.",
    "clutter": "density of false measurements: ``association.Clutter``.",
    "values": "name of a set of learned values for what is not given: ``torchfra.values()``.",
    "learn": 'names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.',
}
"""Lines of documentation of arguments that many presets have."""


def preset(name: str, *groups: Group, **traits: str | bool) -> Callable[[Callable[P, F]], Callable[P, F]]:
    """A decorator that makes a preset of a function ``(motion, sensor, *, learn)`` of a filter, which need not learn.

    What the filter learns is its own: a motion, a sensor or a robust update that has some of it is copied first.
    ``**options`` in the docstring stands for the lines of the arguments that it does not describe itself.

    Args:
        name: of the filter.
        groups: of keywords that it takes as ``**options``, whose lines stand in its docstring (``presets.options``).
        traits: fields of ``register.FilterEntry``.

    Raises:
        TypeError: at a call, a keyword that neither the function nor a group has, as of any function.
        ValueError: at a call, a name in ``learn`` that the filter does not have, or a value on the boundary of its
            range.
    """

    def decorate(function: Callable[P, F]) -> Callable[P, F]:
        own = inspect.signature(function).parameters
        known = {*own, *(keyword for group in groups for keyword in group.__optional_keys__)}

        @wraps(function)
        def made(*arguments: P.args, **options: P.kwargs) -> F:
            for keyword in options.keys() - known:
                raise TypeError(f"{function.__name__}() got an unexpected keyword argument {keyword!r}")
            learn: Any = options.pop("learn", ())
            return _learning(function(*arguments, **options), learn)

        if function.__doc__:  # python -OO has none
            made.__doc__ = _documented(inspect.cleandoc(function.__doc__), list(own), groups)
        return register.filter(name, **traits)(with_values(made) if "values" in own else made)

    return decorate


def _documented(text: str, names: list[str], groups: tuple[Group, ...]) -> str:
    """A docstring with the lines of shared arguments: models, sensor and clutter first, then its own, then others."""
    missing = [f"{name}: {SHARED[name]}" for name in names if name != "options" and f"    {name}: " not in text]
    first = [line for line in missing if line.partition(":")[0] not in ("values", "learn")]
    parts = [inspect.cleandoc(group.__doc__ or "").partition("\n\n")[2] for group in groups]
    for mark, lines in (("Args:\n", first), ("    **options", [*missing[len(first) :], *parts])):
        text = text.replace(mark, mark * (mark == "Args:\n") + textwrap.indent("\n".join([*lines, ""]), "    "), 1)
    return text.replace("\n\n\n", "\n\n").rstrip()


def _learning(f: F, names: Collection[str]) -> F:
    """The same filter, which learns the hyperparameters of these names: see ``hyper.named``."""
    inner: Filter = f
    while isinstance(further := getattr(inner, "inner", None), Filter):
        inner = further
    paths = named(f, names)
    chosen = {id(hyper) for hyper in paths.values() if not hyper.raw.requires_grad}
    for part in ("motion", "sensor", "robust"):
        model = getattr(inner, part, None)
        if model is not None and any(id(hyper) in chosen for hyper in model.modules()):
            setattr(inner, part, copy.deepcopy(model))
    for path, hyper in hypers(f).items():  # some are copies now
        if path in paths:
            hyper.learn(path)
    return f
