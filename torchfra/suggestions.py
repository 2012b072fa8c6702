"""Suggestions for misspelt names in error messages."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def meant(received: object, known: Iterable[object]) -> str:
    """The end of an error message: the known name that is closest to what was received; empty if none is close.

    Example::

        >>> meant("gbp", ["gpb", "ukf"])
        " (did you mean 'gpb'?)"
    """
    names = {str(name).lower(): str(name) for name in known}
    close = get_close_matches(str(received).lower(), names, n=1, cutoff=0.6)
    return f" (did you mean {names[close[0]]!r}?)" if close else ""
