"""Assertions of the checks, and their messages, with the line of the user's code at fault."""

from __future__ import annotations

import inspect
import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

TOLERANCE = {torch.float64: 1e-8, torch.float32: 2e-2}
"""Relative to the largest entry; in float32 rounding is amplified by robust decisions and by short roots."""
LARGE = 2e3
"""Measurements of more standard deviations than this leave more rounding in an estimate."""
LOOSER: ContextVar[float] = ContextVar("looser", default=1.0)
"""Factor on the tolerances where measurements are that large."""
_OTHERS = tuple(f"{path}{os.sep}" for path in (Path(__file__).parents[1], Path(torch.__file__).parent))
"""Folders of code that is not the user's."""


@contextmanager
def as_large_as(z: Tensor, std: Tensor) -> Iterator[None]:
    """Scales the tolerances with measurements that are large in units of their noise, such as pseudoranges."""
    size = float((z.abs() / std).nan_to_num().max())
    token = LOOSER.set(max(1.0, size / LARGE))
    try:
        yield
    finally:
        LOOSER.reset(token)


def expect(holds: bool, what: str, expected: object, received: object) -> None:
    """Raises an ``AssertionError`` unless the condition holds."""
    if not holds:
        raise AssertionError(f"{what}: expected {expected}, received {received}")


def expect_same(found: object, expected: object, what: str, tolerance: float | None = None) -> None:
    """Expects trees of the same form, shapes, dtypes and, up to rounding, values."""
    if isinstance(expected, Tensor) and isinstance(found, Tensor):
        form, wanted = (tuple(found.shape), found.dtype), (tuple(expected.shape), expected.dtype)
        expect(form == wanted, what, wanted, form)
        gap = difference(found, expected)
        limit = LOOSER.get() * (TOLERANCE.get(expected.dtype, 0.0) if tolerance is None else tolerance)
        expect(gap <= limit, what, f"the same up to {limit:g} of the largest entry", f"a difference of {gap:.3g}")
    elif isinstance(expected, tuple) and isinstance(found, tuple):
        names = getattr(expected, "_fields", range(len(expected)))
        expect(len(found) == len(expected), what, f"{len(expected)} parts", len(found))
        for name, a, b in zip(names, found, expected, strict=True):
            expect_same(a, b, f"{what}.{name}", tolerance)
    else:
        expect(type(found) is type(expected), what, type(expected).__name__, type(found).__name__)


def difference(found: Tensor, expected: Tensor) -> float:
    """The largest difference relative to the largest entry; infinity where only one of the two is finite."""
    if not expected.numel():
        return 0.0
    a, b = found.detach().double(), expected.detach().double()
    finite = b.isfinite()
    if not torch.equal(finite, a.isfinite()) or not torch.equal(a[~finite].nan_to_num(), b[~finite].nan_to_num()):
        return torch.inf
    scale = b[finite].abs().max().clamp_min(1e-300) if bool(finite.any()) else torch.tensor(1.0)
    return float(((a - b)[finite].abs() / scale).max()) if bool(finite.any()) else 0.0


def expect_finite(tree: dict[str, Tensor], what: str) -> None:
    """Expects tensors without NaN and infinity."""
    for name, x in tree.items():
        expect(bool(x.isfinite().all()), f"{what} of {name}", "finite numbers", f"{int((~x.isfinite()).sum())} others")


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
