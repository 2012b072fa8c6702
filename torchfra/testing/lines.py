"""Which line of a user's something comes from."""

from __future__ import annotations

import inspect
import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

_OTHERS = tuple(f"{path}{os.sep}" for path in (Path(__file__).parents[1], Path(torch.__file__).parent))
"""Folders whose lines are no user's."""


def line_of_error(error: BaseException) -> str:
    """The innermost line of a user that an error, or what caused it, has come through; empty if there is none."""
    found = ""
    cause: BaseException | None = error
    while cause is not None:
        for frame in traceback.extract_tb(cause.__traceback__):
            if not frame.filename.startswith(_OTHERS):
                found = f"{frame.filename}, line {frame.lineno}, in {frame.name}: {frame.line}"
        cause = cause.__cause__
    return found


def told(error: Exception, line: str = "", hint: str = "") -> str:
    """An error that nobody expected, and the user's line, if it is known, or one that is known anyway."""
    return with_line(f"expected no error, received {type(error).__name__}: {error}{hint}", line_of_error(error) or line)


def with_line(said: str, line: str) -> str:
    """A sentence, and a line below it if there is one."""
    return f"{said}\n     {line}" if line else said


def line_of_method(method: Callable[..., Any]) -> str:
    """Where a user has written a method; empty for those of the library."""
    try:
        path, (lines, number) = inspect.getfile(method), inspect.getsourcelines(method)
    except (OSError, TypeError):
        return ""
    text = next((line.strip() for line in lines if line.lstrip().startswith("def ")), "")
    return "" if path.startswith(_OTHERS) else f"{path}, line {number}: {text}"
