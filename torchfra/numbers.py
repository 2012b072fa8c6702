"""Arguments that should be numbers."""

from __future__ import annotations

import math
import reprlib
from numbers import Integral, Real
from typing import Any, TypeAlias, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

Array: TypeAlias = NDArray[np.float64]
V = TypeVar("V")
NUMBERS = int, float, np.integer, np.floating
"""Types of the numbers of Python and numpy that are real."""


def as_number(value: object) -> float:
    """The value as a number; NaN for anything that is not a number, so that every comparison fails."""
    if isinstance(value, Real) or (isinstance(value, Tensor) and value.numel() == 1):
        return float(value)
    return float("nan")


def positive(name: str, value: object, what: str = "a finite number") -> float:
    """A finite number above 0; ``what`` says in the error what the argument of this name is.

    Raises:
        ValueError: it is not.
    """
    number = as_number(value)
    if not 0 < number < math.inf:
        raise ValueError(f"{name}: expected {what} above 0, received {value!r}")
    return number


def fraction(name: str, value: object) -> float:
    """A probability above 0 and below 1.

    Raises:
        ValueError: it is not.
    """
    number = as_number(value)
    if not 0 < number < 1:
        raise ValueError(f"{name}: expected a probability above 0 and below 1, received {value!r}")
    return number


def is_integer(value: object, least: int) -> bool:
    """Whether a value is a whole number of Python or numpy, ``least`` or more."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


def as_tensor(value: ArrayLike, like: Tensor | None = None) -> Tensor:
    """Numbers of Python, numpy or torch as a tensor with all their digits.

    ``torch.as_tensor`` rounds numbers of Python to torch's default precision, whatever they are for.

    Args:
        value: a number, several in a list or an array, or a tensor.
        like: a tensor whose dtype and device the result gets, rounded once; None for double precision, but for arrays
            and tensors their own.
    """
    if isinstance(value, Tensor):
        return value if like is None else value.to(like)
    value = unmasked(value)
    if isinstance(value, np.generic):
        value = float(value)  # torch takes no number of some types
    if like is not None:
        return torch.as_tensor(value, dtype=like.dtype, device=like.device)
    return torch.as_tensor(value, dtype=None if hasattr(value, "dtype") else torch.float64)


def unmasked(values: V) -> V | Array:
    """A masked array of numpy as a plain one, NaN where it is masked, which is missing; anything else as it is.

    torch and numpy would take the numbers behind the mask.
    """
    if not isinstance(values, np.ma.MaskedArray):
        return values
    floating = values if values.dtype.kind == "f" else values.astype(np.float64)
    plain: Array = np.ma.filled(floating, np.nan)  # type: ignore[no-untyped-call]  # in numpy
    return plain


def as_numbers(value: object, name: str, uneven: str = "") -> Tensor:
    """Numbers from a list, an array, a column of a table or a tensor; all but floating-point tensors become float64.

    What is masked or has no value in a table is NaN.

    Args:
        value: the numbers.
        name: what error messages call them.
        uneven: what an error says of rows of several lengths, beside that.

    Raises:
        ValueError: no real numbers, or rows of different lengths.
    """
    if isinstance(value, Tensor) and value.is_floating_point():
        return value
    if "complex" in (kind := str(getattr(value, "dtype", ""))):
        raise ValueError(f"{name}: expected real numbers, received {kind}")
    try:
        return torch.as_tensor(_of_table(unmasked(value)), dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        if isinstance(value, list | tuple) and len({len(row) for row in value if hasattr(row, "__len__")}) > 1:
            raise ValueError(f"{name}: expected rows of one length, received several lengths{uneven}") from None
        raise ValueError(f"{name}: expected numbers, received {reprlib.repr(value)}") from None


def _of_table(values: Any) -> Any:
    """A column or a table of a data frame as an array, NaN where it has nothing; anything else as it is."""
    if isinstance(values, np.ndarray | Tensor) or not hasattr(values, "__array__") or not hasattr(values, "shape"):
        return values
    if hasattr(values, "iloc"):  # of pandas, whose own missing values numpy does not know
        return values.to_numpy(dtype=float, na_value=np.nan).copy()
    return np.array(values, dtype=float)
