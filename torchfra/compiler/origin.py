"""Where an expression comes from, and what a kernel cannot do: the lines of the step that say so."""

from __future__ import annotations

import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from types import FrameType

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
            # its own number, counted on before it ran
            of = None if node is None else self._forwards.get(node._sequence_nr() + 1)
        except AttributeError:  # they are private: versions may differ, and comments say less
            return line
        return f"gradient of {of}" if of else line


def _line() -> str:
    frame: FrameType | None = sys._getframe(3)  # what has called torch
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


_LIBRARY = str(Path(__file__).parents[1])
_PLUMBING = (str(Path(torch.__file__).parent), str(Path(__file__).parent))
"""Folders whose lines tell a user nothing."""


@contextmanager
def refusals_of(name: str) -> Iterator[None]:
    """Inside this context, a ``NotImplementedError`` begins with this name and ends with the line it comes from."""
    try:
        yield
    except NotImplementedError as error:
        frames = [(f.filename, f.lineno, f.line) for f in traceback.extract_tb(error.__traceback__)]
        raise NotImplementedError(f"{name}: {error}{_asked(frames)}") from error


@contextmanager
def gradient_refusals_of(name: str, again: Callable[[], object]) -> Iterator[None]:
    """The same for gradients, whose errors come from no line: ``again`` differentiates once more to find it."""
    try:
        yield
    except NotImplementedError as error:
        with warnings.catch_warnings(record=True) as caught, torch.autograd.set_detect_anomaly(True, check_nan=False):
            warnings.simplefilter("always")
            with suppress(NotImplementedError):
                again()
        text = "".join(str(warning.message) for warning in caught)
        frames = re.findall(r'File "([^"]*)", line (\d+), in [^\n]*\n *([^\n]*)', text)
        raise NotImplementedError(f"{name}: {error}{_asked(frames)}") from error


def _asked(frames: Sequence[tuple[str, object, object]]) -> str:
    """In words, the innermost line of the user that the library has called, or of the library where there is none."""
    frames = [frame for frame in frames if not frame[0].startswith(_PLUMBING)]
    entered = next((i for i, frame in enumerate(frames) if frame[0].startswith(_LIBRARY)), 0)
    own = [frame for frame in frames[entered:] if not frame[0].startswith(_LIBRARY)]
    if not frames:
        return ""
    path, number, text = (own or frames)[-1]
    return f" ({path}, line {number}: {text})"
