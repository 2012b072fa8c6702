"""What all figures share: colours, lines, axes, and files."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from torchfra.app.atomic_write import write
from torchfra.catalogue import FILTERS
from torchfra.tables import printable

RED, BLUE, GREEN, PURPLE, ORANGE, SKY, BLACK = APART = (
    "#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000",
)  # fmt: skip
"""Colours that people who see colours differently tell apart too.

Source: Okabe & Ito (2008), "Color universal design": without their yellow, which is pale on white.
"""
GREY, DARK, PALE_BLUE = "#999999", "#555555", "#cfe4f3"
REGIMES = ("#d9d9d9", SKY, GREEN, PURPLE, RED)
"""Of areas; the first is the usual regime."""


def save(figure: Figure, path: str | Path) -> Path:
    """Writes a figure as PNG, completely or not at all.

    Raises:
        OSError: it cannot be written.
    """
    picture = BytesIO()
    with any_letters():
        figure.savefig(picture, format="png", dpi=140)
    return write(path, lambda file: file.write(picture.getvalue()))


@contextmanager
def any_letters() -> Iterator[None]:
    """Letters of a name that the font does not have become boxes, without warnings."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        yield


TITLE = 100
"""Characters of a title."""


def words(text: str, longest: int = 50) -> str:
    """Text from outside, a name or a title that has one, as figures draw it: ``$`` is no mathematics there."""
    drawn = printable(text, longest).replace("$", r"\$")
    return f" {drawn}" if drawn.startswith("_") else drawn  # a legend leaves out what begins with it


def line_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """How the line of each filter looks, as keywords of ``Axes.plot``.

    Filters of the catalogue have their colours; others (``"learned"``, say) get colours that no line of the figure has,
    as long as there are some.
    """
    names = list(names)
    known = {name: FILTERS[name].colour for name in names if name in FILTERS}
    free = cycle([colour for colour in CYCLE if colour not in known.values()] or CYCLE)
    styles = {}
    for name in names:
        bold = name in FILTERS and FILTERS[name].emphasised
        colour = known[name] if name in known else next(free)
        styles[name] = {"color": colour, "linewidth": 1.8 if bold else 1.1, "zorder": 3 if bold else 2}
    return styles


def finish(axes: Axes) -> None:
    """Gives axes a grid and a legend, and takes two of their spines away."""
    axes.grid(alpha=0.25)
    without_box(axes)
    axes.legend(frameon=False, fontsize=8, ncols=2)


def without_box(axes: Axes) -> None:
    """Takes the upper and the right spine away."""
    axes.spines[["top", "right"]].set_visible(False)


def plain_ticks(axis: Axis) -> None:
    """Gives a logarithmic axis, with its limits, ticks at round numbers that are written out."""
    low, high = axis.get_view_interval()
    if high < 6 * low:
        axis.set_major_locator(MaxNLocator(5))
    else:
        digits = (1.0, 2.0, 3.0, 5.0, 7.0) if high < 30 * low else (1.0, 2.0, 5.0) if high < 300 * low else (1.0,)
        axis.set_major_locator(LogLocator(subs=digits))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())
