"""The line of a user's code from which an error or a method comes."""

from __future__ import annotations

import inspect
import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

_OTHERS = tuple(f"{path}{os.sep}" for path in (Path(__file__).parents[1], Path(torch.__file__).parent))
"""Folders of code that is not the user's."""


def line_of_error(error: BaseException) -> str:
    """The innermost line of a user's code in the traceback of an error and of its causes; empty if there is none."""
    found = ""
    cause: BaseException | None = error
    while cause is not None:
        for frame in traceback.extract_tb(cause.__traceback__):
            if not frame.filename.startswith(_OTHERS):
                found = f"{frame.filename}, line {frame.lineno}, in {frame.name}: {frame.line}"
        cause = cause.__cause__
    return found


def unexpected(error: Exception, line: str = "", hint: str = "") -> str:
    """The message about an unexpected error, with the user's line in its traceback, or else ``line``."""
    return with_line(f"expected no error, received {type(error).__name__}: {error}{hint}", line_of_error(error) or line)


def with_line(sentence: str, line: str) -> str:
    """A sentence, and a line below it if there is one."""
    return f"{sentence}\n     {line}" if line else sentence


def line_of_method(method: Callable[..., Any]) -> str:
    """File, line and head of a user's method; empty for those of the library."""
    try:
        path, (lines, number) = inspect.getfile(method), inspect.getsourcelines(method)
    except (OSError, TypeError):
        return ""
    text = next((line.strip() for line in lines if line.lstrip().startswith("def ")), "")
    return "" if path.startswith(_OTHERS) else f"{path}, line {number}: {text}"
