"""What a kernel cannot do, told with the filter, the values and the line of the user that asked for it."""

from __future__ import annotations

import re
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import torch

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
        raise NotImplementedError(f"{name}: {error}{_line(frames)}") from error


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
        raise NotImplementedError(f"{name}: {error}{_line(frames)}") from error


def _line(frames: Sequence[tuple[str, object, object]]) -> str:
    """In words, the innermost line of the user that the library has called, or of the library where there is none."""
    frames = [frame for frame in frames if not frame[0].startswith(_PLUMBING)]
    entered = next((i for i, frame in enumerate(frames) if frame[0].startswith(_LIBRARY)), 0)
    own = [frame for frame in frames[entered:] if not frame[0].startswith(_LIBRARY)]
    if not frames:
        return ""
    path, number, text = (own or frames)[-1]
    return f" ({path}, line {number}: {text})"
