"""Filters and scenarios of the user, by ``module:function`` or ``file.py:function``."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from torchfra import register
from torchfra.catalogue import FILTERS, scenario_by, scenario_filter
from torchfra.filters.base import Filter
from torchfra.scenarios import Scenario

_NAME = "torchfra_loaded_{}"


def is_place(name: str) -> bool:
    """Whether a name is ``module:function`` or ``file.py:function``."""
    return ":" in name


def load_module(place: str, argument: str) -> ModuleType:
    """The module of a dotted name, also in the current folder, or of a ``.py`` file.

    Args:
        place: the name, or the file.
        argument: the option with it, for messages.

    Raises:
        ValueError: no such module, or one that cannot be run.
    """
    try:
        if place.endswith(".py"):
            return _module_of_file(Path(place))
        if str(Path.cwd()) not in sys.path and "" not in sys.path:
            sys.path.append(str(Path.cwd()))
        return importlib.import_module(place)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise ValueError(
            f"{argument}: expected a module, or a file that ends in .py, received {place} ({reason})"
        ) from error


def load_function(place: str, argument: str) -> Callable[..., Any]:
    """The function of ``module:function``, given as ``argument``.

    Raises:
        ValueError: there is no such module, or nothing in it by that name that can be called.
    """
    module, _, name = place.rpartition(":")
    if not module or not name:
        raise ValueError(f"{argument}: expected module:function or file.py:function, received {place!r}")
    loaded = load_module(module, argument)
    found = getattr(loaded, name, None)
    if not callable(found):
        known = sorted(key for key, value in vars(loaded).items() if _own(value, loaded))
        received = "nothing" if found is None else type(found).__name__
        hint = f"; it has {', '.join(known)}" if known else ""
        raise ValueError(f"{argument}: expected {module} to have a function {name}, received {received}{hint}")
    function: Callable[..., Any] = found
    return function


def load_scenario(place: str, **options: Any) -> Scenario:
    """The scenario that ``module:function`` makes.

    Raises:
        ValueError: there is no such function, it does not take an option, or it returns something else.
    """
    return scenario_by(place, load_function(place, "scenario"), options)


def load_filters(names: Sequence[str], scenario: Scenario) -> dict[str, Filter]:
    """Filters of the catalogue, and those that ``module:function`` makes of ``(motion, sensor)``, by name.

    Raises:
        ValueError: an unknown name, no such function, one that returns something else, or a filter that does not fit
            the scenario.
    """
    if not names:
        raise ValueError(f"filters: expected some of {', '.join(FILTERS)}, received none")
    return {name: _filter(name, scenario) for name in names}


def _filter(name: str, scenario: Scenario) -> Filter:
    if not is_place(name):
        return scenario_filter(name, scenario)
    preset = load_function(name, "filters")
    f = register.made(name, preset(scenario.motion, scenario.sensor), Filter, "(motion, sensor)")
    if f.scans != (scenario.clutter is not None):
        wanted = "scans" if scenario.clutter is not None else "single targets"
        raise ValueError(f"filters: expected one of {wanted} for {scenario.name}, received {name}")
    return f


def _module_of_file(path: Path) -> ModuleType:
    """The module of a file, run once."""
    path = path.resolve()
    name = _NAME.format(str(path).encode().hex())
    if name not in sys.modules:
        if not path.is_file():
            raise FileNotFoundError(f"no file {path}")
        spec = importlib.util.spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise ImportError(f"no module {path}")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]


def _own(value: object, module: ModuleType) -> bool:
    """Whether a function is defined in a module."""
    return inspect.isfunction(value) and value.__module__ == module.__name__
