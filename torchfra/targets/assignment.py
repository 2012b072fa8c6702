"""What scipy does here: neighbours, connected components, and the assignment of one set to another."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def scipy(part: str) -> Any:
    """A part of scipy, such as ``"optimize"``, imported when it is needed.

    Raises:
        ImportError: scipy is not installed.
    """
    try:
        return import_module(f"scipy.{part}")
    except ImportError:
        raise ImportError("managing targets needs scipy: pip install torchfra[assignment]") from None
