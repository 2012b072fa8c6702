"""What pictures are made of, apart from plotting, as matplotlib is slow to import: formats, colours, runs on maps."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor

from torchfra.numbers import Array

FORMATS = ("pdf", "svg", "png")
RED, BLUE, GREEN, PURPLE, ORANGE, SKY, BLACK = APART = (
    "#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000",
)  # fmt: skip
"""Colours that colour-blind people distinguish too.

Source: Okabe & Ito (2008), "Color universal design": without yellow, which is pale on white.
"""
GREY, DARK, PALE_BLUE, BROWN = "#999999", "#555555", "#cfe4f3", "#8a5e00"
REGIMES = ("#d9d9d9", SKY, GREEN, PURPLE, RED, ORANGE, BLUE, BLACK)
"""Colours of areas; the first is that of the usual regime."""


class MappedRun(NamedTuple):
    """A part of one run in the horizontal plane, m; ``N`` targets, ``T`` steps, ``J`` measurements of a step."""

    number: int
    """Number of the run."""
    name: str
    """Name of the recording, or the number in words."""
    time: Tensor
    """``(T,)`` seconds since the first measurement of the run was due."""
    truth: Tensor
    """``(N, T, 2)``."""
    fixes: Tensor
    """``(T, J, 2)`` positions that the measurements imply, NaN where they imply none."""
    outlying: Tensor
    """``(T, J)`` bool: measurements of which an element is far off the truth."""
    estimates: dict[str, Tensor]
    """``(N, T, 2)`` by name of the filter."""


def corners(low: Array, high: Array, fixes: Array, room: float) -> tuple[Array, Array]:
    """Lower left and upper right, with a margin, of a path and of the fixes that are at most ``room`` away from it."""
    near = fixes[((fixes > low - room) & (fixes < high + room)).all(1)]
    points = np.concatenate([[low], [high], near])
    low, high = points.min(0), points.max(0)
    margin = 0.04 * max((high - low).max(), 1.0)
    return low - margin, high + margin


def picture_format(path: str | Path, argument: str = "path") -> str:
    """The format of a figure by its file extension; PNG without one.

    Args:
        path: of the file.
        argument: name of the argument, for error messages.

    Raises:
        ValueError: an extension that is not among ``FORMATS``.
    """
    extension = Path(path).suffix.lower().removeprefix(".") or "png"
    if extension not in FORMATS:
        endings = ", ".join(f".{known}" for known in FORMATS)
        raise ValueError(f"{argument}: expected a file that ends in {endings}, received {path}")
    return extension
