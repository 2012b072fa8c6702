"""The one registry of filters and scenarios by name, and decorators that add one's own.

::

    @torchfra.register.filter("mine")
    def mine(motion, sensor, **options):
        return torchfra.filters.SRCKF(motion, sensor, **options)

    @torchfra.register.scenario("figure-eight")
    def figure_eight(size=100.0):
        return torchfra.scenarios.Scenario(...)

From then on ``catalogue``, ``torchfra.compare``, ``testing.check_filter`` and, with ``--import FILE``, the command line
know them by these names.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from importlib import import_module
from typing import Any, TypeVar

from torchfra.filters.base import Filter
from torchfra.filters.correlated import with_errors

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


@dataclass(frozen=True)
class FilterEntry:
    """A preset and its traits."""

    preset: Callable[..., Filter]
    words: str = ""
    """The filter in a few words: its name spelt out."""
    bank: bool = False
    """Whether it takes a ``Bank`` of motions instead of one motion."""
    neighbours: bool = False
    """Whether its bank must say which motions are active: ``Bank.neighbours`` and ``Bank.first``."""
    either: bool = False
    """Whether it takes either a ``Bank`` of motions or one motion."""
    scans: bool = False
    """Whether it takes scans of several targets."""
    gated: bool = False
    """Whether it takes a ``gate``: the normalised innovation squared above which a step is abnormal."""
    constant_gains: bool = False
    """Whether it takes positions with a standard deviation and motions of constant velocity or acceleration only, the
    ``period`` of its gains, and the ``max_gap`` that it bridges."""
    emphasised: bool = False
    """Whether its lines in figures are bold."""
    listed: bool = True
    """Whether commands list it in their help and run it by default; other filters run only by name."""


LIBRARY = {
    "presets.regimes": "gpb",
    "presets.single": "ukf ekf srckf rsrckf mr_ckf ghckf hghckf1 hghckf2 hghckf asrckf rmckf iaukf",
    "presets.feedback": "fra_srckf fra",
    "presets.banks": "imm imm_srckf imm_ckf imm_fra vsimm_srckf",
    "presets.constant_gains": "alphabeta",
    "presets.scans": "jpda ukf_jpda iaukf_jpda",
}
"""The presets of the library by module, in the order in which commands and tables list them."""
_MODULE_OF = {name: f"torchfra.{module}" for module, names in LIBRARY.items() for name in names.split()}
FILTERS: dict[str, FilterEntry] = {}
"""Filters by name; each module of presets adds its own when it is loaded, and ``filters`` loads all."""
SCENARIOS: dict[str, Callable[..., Any]] = {}
"""Functions that make a ``Scenario``, by name; ``catalogue`` adds those of the library."""


def filters() -> dict[str, FilterEntry]:
    """All filters by name: those of the library first, in its order."""
    own = [name for name in FILTERS if name not in _MODULE_OF]
    for module in _MODULE_OF.values():
        import_module(module)
    for name in [*_MODULE_OF, *own]:
        FILTERS[name] = FILTERS.pop(name)
    return FILTERS


def filter(name: str, **traits: Any) -> Callable[[F], F]:
    """A decorator that adds a function of ``(motion, sensor, **options)`` to the filters.

    Args:
        name: letters, digits, ``_``, ``-`` and ``.``.
        traits: fields of ``FilterEntry``: ``words`` for what the name stands for; ``bank=True`` if it takes a ``Bank``
            of motions instead of one, ``either=True`` if it takes both, ``scans=True`` if its filter takes scans of
            several targets (it is then called with ``clutter`` and ``detection``), and others.

    Raises:
        ValueError: a name that another function has or that has other characters, what is no function, or no trait.
    """
    known = [field.name for field in fields(FilterEntry) if field.name != "preset"]
    for key in traits.keys() - known:
        raise ValueError(f"{key}: expected one of {', '.join(known)}, received {key}={traits[key]!r}")

    def add(preset: F) -> F:
        if name in _MODULE_OF and getattr(preset, "__module__", None) != _MODULE_OF[name]:
            import_module(_MODULE_OF[name])  # which has taken the name
        _check(name, preset, FILTERS[name].preset if name in FILTERS else None)
        entry = FilterEntry(preset, **traits)
        made = with_errors(preset, takes=not (entry.scans or entry.constant_gains))
        FILTERS[name] = replace(entry, preset=made)
        return made

    return add


def scenario(name: str) -> Callable[[F], F]:
    """A decorator that adds a function that makes a ``Scenario`` to the scenarios; its arguments have defaults.

    Raises:
        ValueError: a name that another function has or that has other characters, or what is no function.
    """

    def add(make: F) -> F:
        _check(name, make, SCENARIOS.get(name))
        SCENARIOS[name] = make
        return make

    return add


def made(function: str, found: object, wanted: type[T], arguments: str) -> T:
    """The result of a user's function, checked for its type.

    Raises:
        ValueError: another type; the message names the function, the expected type and the received one.
    """
    if not isinstance(found, wanted):
        expected = f"{arguments} to return a {wanted.__name__}"
        raise ValueError(f"{function}: expected {expected}, received {type(found).__name__}")
    return found


def _check(name: str, function: object, taken: Callable[..., Any] | None) -> None:
    """Checks a name; the same function may be registered again, as in a notebook whose cell runs twice."""
    if not isinstance(name, str) or not re.fullmatch(r"[\w.-]+", name):
        raise ValueError(f"name: expected letters, digits, _, - and ., received {name!r}")
    if not callable(function):
        raise ValueError(f"{name}: expected a function, received {type(function).__name__}")
    if taken is not None and _place(taken) != _place(function):
        raise ValueError(f"name: expected one that is not taken, received {name!r}, which is {_place(taken)}")


def _place(function: object) -> str:
    return f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', repr(function))}"
