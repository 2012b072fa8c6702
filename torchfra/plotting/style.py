"""Common parts of all figures: colours, lines, axes, and files."""

from __future__ import annotations

import unicodedata
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from torchfra.pictures import APART, picture_format
from torchfra.running.atomic_write import write
from torchfra.tables import printable

_BROKEN = ("-", "--", ":", "-.")
"""Styles of lines that share a colour."""


def save(figure: Figure, path: str | Path) -> Path:
    """Writes a figure, completely or not at all, as PNG, or as PDF or SVG where the file ends so.

    PDF and SVG keep letters as text, not as outlines, and two of the same figure are the same to the byte.

    Raises:
        OSError: it cannot be written.
        ValueError: a name that ends in none of .png, .pdf and .svg.
    """
    picture, form = BytesIO(), picture_format(path)
    undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": None}[form]
    fonts = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "torchfra"}
    with any_letters(), rc_context(fonts):
        figure.savefig(picture, format=form, dpi=140, metadata=undated)
    return write(path, lambda file: file.write(picture.getvalue()))


def lay_out(figure: Figure) -> None:
    """Gives axes the places that they will have: for labels that go where there is room."""
    engine = figure.get_layout_engine()
    assert engine is not None
    with any_letters():
        engine.execute(figure)


@contextmanager
def any_letters() -> Iterator[None]:
    """Letters of a name that the font does not have become boxes, without warnings."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        yield


TITLE = 100
"""Characters of a title."""


def words(text: str, longest: int = 50) -> str:
    """Text from outside, a name or a title that has one, as figures draw it: ``$`` is no mathematics there.

    Of a longer text, with each letter of twice the width counted as two, the middle is left out.
    """
    drawn = printable(text, longest * len(text) // max(width(text), 1)).replace("$", r"\$")
    return f" {drawn}" if drawn.startswith("_") else drawn  # a legend leaves out what begins with it


def width(text: str) -> int:
    """Letters of a text, those of twice the width counted as two."""
    return len(text) + sum(unicodedata.east_asian_width(letter) in "FW" for letter in text)


def line_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Style of each name's line, as keywords of ``Axes.plot``: a colour of its own for as many as ``APART`` has.

    Lines after those have the same colours in the same order, but are broken.
    """
    from torchfra.catalogue import FILTERS  # filters of all kinds, which pictures of one track need none of

    styles = {}
    for i, name in enumerate(names):
        bold = name in FILTERS and FILTERS[name].emphasised
        look = {"color": APART[i % len(APART)], "linestyle": _BROKEN[i // len(APART) % len(_BROKEN)]}
        styles[name] = {**look, "linewidth": 1.8 if bold else 1.1, "zorder": 3 if bold else 2}
    return styles


def finish(axes: Axes) -> None:
    """Gives axes a grid and, where they are logarithmic, ticks that are written out; takes two of their spines away."""
    axes.grid(alpha=0.25)
    for axis, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
        if scale == "log":
            plain_ticks(axis)
    without_box(axes)


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
