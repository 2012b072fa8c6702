"""Packages that may not be installed."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def optional(module: str, what: str, extra: str) -> Any:
    """A module of a package that may not be installed, imported when it is first needed.

    Args:
        module: its name.
        what: needs it, for the error.
        extra: of torchfra that installs the package.

    Raises:
        ImportError: the package is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ImportError(f'{what} needs the package {package}: pip install "torchfra[{extra}]"') from error
