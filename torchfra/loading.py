"""Packages whose modules load when something of theirs is first named."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def when_named(package: str, modules: Mapping[str, str]) -> tuple[list[str], Callable[[str], Any], Callable[[], Any]]:
    """``__all__``, ``__getattr__`` and ``__dir__`` of a package, whose own modules load when they are named, too.

    Args:
        package: its ``__name__``.
        modules: by module of ``torchfra`` the names that it has for the package, with spaces between.
    """
    module_of = {name: module for module, names in modules.items() for name in names.split()}

    def get(name: str) -> Any:
        if name in module_of:
            found = getattr(import_module(f"torchfra.{module_of[name]}"), name)
            setattr(sys.modules[package], name, found)
            return found
        if not name.startswith("_"):
            try:
                return import_module(f"{package}.{name}")
            except ModuleNotFoundError as error:
                if error.name != f"{package}.{name}":
                    raise
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    every = list(module_of)
    return every, get, lambda: sorted({*vars(sys.modules[package]), *every})
