"""Figures of regrets: ratios to the smallest error, and errors with their standard deviations over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from torchfra.pictures import BLUE, PALE_BLUE
from torchfra.plotting.style import TITLE, width, words

_WORST = 10.0
"""Ratios above have the same colour."""


def ratios(panels: Mapping[str, tuple[Sequence[str], Sequence[Sequence[float]]]], rows: Sequence[str],
           title: str) -> Figure:  # fmt: skip
    """A heat map of each panel, dark where an error is large, on a logarithmic scale that colour blindness leaves.

    Args:
        panels: by title, the names of the columns, and for each row and column a ratio; NaN leaves a place empty.
        rows: names that all panels share.
        title: of the figure.
    """
    widths = [len(columns) for columns, _ in panels.values()]
    beside = 0.075 * max(width(words(row)) for row in rows)
    below = max(1.8, 0.8 + 0.075 * max(width(words(name)) for columns, _ in panels.values() for name in columns))
    figure = Figure(figsize=(2 + beside + 0.5 * sum(widths), below + 0.27 * len(rows)), layout="constrained")
    places = figure.subplots(1, len(panels), squeeze=False, sharey=True, gridspec_kw={"width_ratios": widths})[0]
    values = {name: np.asarray(ratio, dtype=float) for name, (_, ratio) in panels.items()}
    lowest = min([1.0, *(x[np.isfinite(x)].min(initial=1.0) for x in values.values())])
    norm = LogNorm(max(lowest, 1 / _WORST), _WORST)
    for axes, (name, (columns, _)) in zip(places, panels.items(), strict=True):
        shown = axes.imshow(np.clip(values[name], norm.vmin, norm.vmax), norm=norm, cmap="cividis_r", aspect="auto")
        axes.set_title(words(name), fontsize=9)
        axes.set_xticks(range(len(columns)), map(words, columns), rotation=90, fontsize=8)
        _write(axes, values[name], norm)
    places[0].set_yticks(range(len(rows)), map(words, rows), fontsize=8)
    bar = figure.colorbar(shown, ax=list(places), shrink=0.6, extend="max", ticks=(1, 2, 5, 10))
    bar.ax.set_yticklabels(["1", "2", "5", "10"])
    bar.set_label("error, as a multiple of the best other filter's", fontsize=8)
    figure.suptitle(words(title, TITLE), fontsize=10)
    return figure


def _write(axes: Axes, values: NDArray[np.float64], norm: LogNorm) -> None:
    """Every ratio into its place, in a colour that can be read there."""
    for (row, column), value in np.ndenumerate(values):
        if not np.isnan(value):
            red, green, blue, _ = colormaps["cividis_r"](norm(min(value, _WORST)))
            colour = "black" if 0.3 * red + 0.6 * green + 0.1 * blue > 0.5 else "white"
            axes.text(column, row, _number(value), ha="center", va="center", fontsize=6.5, color=colour)


def _number(value: float) -> str:
    """In few characters."""
    if value < 9.995:
        return f"{value:.2f}"
    return f"{value:.0f}" if value < 1e4 else f"$10^{{{np.log10(value):.0f}}}$" if np.isfinite(value) else r"$\infty$"


def bands(errors: Mapping[str, tuple[Tensor, Tensor]], dt: float, ylabel: str, title: str) -> Figure:
    """Errors over time and bands of two standard deviations, a panel for each kind of estimate.

    Args:
        errors: by kind, the errors ``(T,)`` of one coordinate and their standard deviations ``(T,)``.
        dt: seconds per step.
        ylabel: what the errors are of, with the unit.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 2 * len(errors)), layout="constrained")
    panels = figure.subplots(len(errors), sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, (kind, (error, std)) in zip(panels, errors.items(), strict=True):
        time, wide = dt * np.arange(1, len(error) + 1), 2 * std.numpy()
        axes.fill_between(time, -wide, wide, color=PALE_BLUE, linewidth=0)
        axes.plot(time, error.numpy(), color=BLUE, linewidth=1)
        axes.set(ylabel=f"{kind}\n{ylabel}")
    panels[0].set_title(words(title, TITLE))
    panels[-1].set_xlabel("time, s")
    return figure
