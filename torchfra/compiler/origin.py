"""Where an expression comes from: the line of the step that was running when it was first written."""

from __future__ import annotations

import os
import re
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from torchfra.linalg import tracing

_PACKAGE = Path(__file__).parents[1]
_BELOW = (*(f"{Path(module).parent}{os.sep}" for module in (__file__, torch.__file__)), tracing.__file__)
"""Folders and a file that say nothing of a step."""
_STEP = str(Path(__file__).with_name("step.py"))
_DIFFERENTIATED = "compiler/step.py:"
"""What runs when no line of the filter does."""


class Origins:
    """The lines of one trace.  Ways back know their operations by the numbers that autograd gives them."""

    def __init__(self) -> None:
        self._forwards: dict[int, str] = {}

    def here(self) -> str:
        """The innermost line of the filter that is running, or what is differentiated."""
        line = _line()
        try:
            if not line.startswith(_DIFFERENTIATED):
                self._forwards.setdefault(torch.autograd._get_sequence_nr(), line)  # type: ignore[attr-defined]
                return line
            node = torch._C._current_autograd_node()
            of = node and self._forwards.get(node._sequence_nr() + 1)  # its own number, counted on before it ran
        except AttributeError:  # they are private: versions may differ, and comments say less
            return line
        return f"gradient of {of}" if of else line


def _line() -> str:
    frame: Any = sys._getframe(3)  # what has called torch
    while frame is not None:
        place = _place(frame.f_code.co_filename)
        if place is not None:
            return f"{place}:{frame.f_lineno} {frame.f_code.co_name}"
        frame = frame.f_back
    return ""


@lru_cache(maxsize=1024)
def _place(file: str) -> str | None:
    """A file by its path in the package, or by its name if it is a user's; None if it says nothing of a step.

    It becomes part of a comment of C++, whatever it is called.
    """
    if file.startswith(_BELOW) and file != _STEP:
        return None
    path = Path(file)
    inside = path.is_relative_to(_PACKAGE)
    return re.sub(r"[^\w./<>-]", "_", path.relative_to(_PACKAGE).as_posix() if inside else path.name, flags=re.ASCII)
