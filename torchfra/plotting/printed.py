"""A comparison for print: a column wide, with letters of a paper's size, in colours that all people tell apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchfra.plotting.style import finish, line_styles, plain_ticks, words

_FONTS = {
    "font.size": 8, "axes.labelsize": 8, "xtick.labelsize": 7, "ytick.labelsize": 7, "legend.fontsize": 7,
    "axes.linewidth": 0.6, "lines.linewidth": 1.0,
}  # fmt: skip
_ROW, _CURVES = 0.17, 1.9
"""Heights of a filter's row and of the errors over time, inches."""


def printed(
    results: Mapping[str, Mapping[str, Any]], dt: float, bound: Sequence[float] | None = None, *, width: float = 3.5
) -> Figure:
    """Errors over time with the bound above, and the mean of each filter's runs with its 95 % interval below.

    The axes are labelled ``"time"`` and ``"means"``.

    Args:
        results: from ``torchfra.evaluation.evaluate``.
        dt: seconds per step.
        bound: ``(T,)`` on the root mean square error of the position; None for none.
        width: of the figure, inches.
    """
    styles = line_styles(results)
    with rc_context(_FONTS):
        height = _CURVES + 0.5 + _ROW * len(results) + 0.12 * -(-len(results) // 3)
        figure = Figure(figsize=(width, height), layout="constrained")
        ratios = [_CURVES, 0.25 + _ROW * len(results)]
        axes = figure.subplots(2, 1, gridspec_kw={"height_ratios": ratios})
        for name, place in zip(("time", "means"), axes, strict=True):
            place.set_label(name)
        _draw_time(axes[0], results, dt, bound, styles)
        _draw_means(axes[1], results, styles)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def _draw_time(
    axes: Axes, results: Mapping[str, Mapping[str, Any]], dt: float, bound: Sequence[float] | None,
    styles: Mapping[str, Mapping[str, Any]],
) -> None:  # fmt: skip
    for name, of in results.items():
        curve = np.array(of["rmse_position"], dtype=float)
        axes.plot(dt * np.arange(1, len(curve) + 1), curve, label=words(name), **styles[name])
    if bound is not None:
        axes.plot(dt * np.arange(1, len(bound) + 1), bound, "k--", linewidth=0.8, label="bound")
    axes.set(xlabel="time, s", ylabel="RMSE of the position, m", yscale="log")
    finish(axes)


def _draw_means(axes: Axes, results: Mapping[str, Mapping[str, Any]], styles: Mapping[str, Mapping[str, Any]]) -> None:
    for row, (name, of) in enumerate(results.items()):
        value, low, high = of["mean_track_rmse_position"]
        colour = styles[name]["color"]
        axes.plot(value, row, "o", color=colour, markersize=3)
        axes.plot([low, high], [row, row], color=colour, linewidth=1.2)
    axes.set_yticks(range(len(results)), map(words, results))
    axes.set(xlabel="mean RMSE of a run, m; 95 %", xscale="log", ylim=(len(results) - 0.5, -0.5))
    finish(axes)
    plain_ticks(axes.xaxis)
