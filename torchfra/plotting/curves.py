"""Numbers of every filter over time, or over a setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from torchfra.cleaning.outputs.colours import BLACK, BLUE
from torchfra.plotting.labels import Array, name_lines
from torchfra.plotting.style import TITLE, finish, line_styles, words

_ROOM = 30.0
"""How far errors are followed beyond their median over all lines, as a factor; a name at the upper edge is beyond."""


def rmse_curves(results: dict[str, dict[str, Any]], quantity: str, dt: float, title: str) -> Figure:
    """Root mean square error over time of every filter.

    Args:
        results: from ``torchfra.evaluation.evaluate``.
        quantity: ``"position"`` (m), ``"velocity"`` (m/s) or another of ``Scenario.quantities``.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes, styles = figure.subplots(), line_styles(results)
    curves = {name: np.array(result[f"rmse_{quantity}"], dtype=float) for name, result in results.items()}
    lines = {name: _line(axes, dt * np.arange(1, len(of) + 1), of, styles[name]) for name, of in curves.items()}
    unit = {"position": ", m", "velocity": ", m/s"}.get(quantity, "")
    axes.set(xlabel="time, s", ylabel=f"RMSE of {quantity}{unit}", yscale="log", title=words(title, TITLE))
    _limit(axes, list(curves.values()))
    return _finished(figure, {axes: lines})


def against(x: Sequence[float], curves: dict[str, list[float]], xlabel: str, ylabel: str, title: str) -> Figure:
    """One number of every filter over a setting.

    Args:
        x: the settings.
        curves: by name of the filter, one number for each.
        xlabel: what is set.
        ylabel: what came out.
        title: of the figure.
    """
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes, styles = figure.subplots(), line_styles(curves)
    lines = {name: _line(axes, x, y, styles[name] | {"marker": "o", "markersize": 3}) for name, y in curves.items()}
    axes.set(xlabel=xlabel, ylabel=ylabel, title=words(title, TITLE))
    return _finished(figure, {axes: lines})


def innovations(nis: dict[str, Tensor], gate: float, dt: float, title: str) -> Figure:
    """Normalised innovation squared over time, with the gate.

    Args:
        nis: by name, ``(T,)`` each.
        gate: above which an innovation is abnormal.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes, styles = figure.subplots(), line_styles(nis)
    lines = {
        name: _line(axes, dt * np.arange(1, len(of) + 1), of.clamp_min(1e-3), styles[name]) for name, of in nis.items()
    }
    lines[f"gate {gate:g}"] = axes.axhline(gate, color=BLACK, linestyle="--", linewidth=1)
    axes.set(xlabel="time, s", ylabel="normalised innovation squared", yscale="log", title=words(title, TITLE))
    return _finished(figure, {axes: lines})


def by_coordinate(results: dict[str, dict[str, Any]], quantity: str, start: float, dt: float, title: str) -> Figure:
    """An error of the position over time, one panel for each coordinate.

    Args:
        results: from ``torchfra.evaluation.evaluate``.
        quantity: ``"mean_error"``, ``"rmse"`` (m) or ``"mape"`` (%).
        start: seconds at the first step.
        dt: seconds per step.
        title: of the figure.
    """
    axes_of = [axis for axis in "xyz" if all(f"{quantity}_{axis}" in of for of in results.values())]
    figure = Figure(figsize=(5.5 * len(axes_of), 3.6), layout="constrained")
    label = {"mean_error": "mean error, m", "rmse": "RMSE, m", "mape": "mean relative error, %"}[quantity]
    panels, styles = figure.subplots(1, len(axes_of), squeeze=False)[0], line_styles(results)
    lines = {}
    for axis, axes in zip(axes_of, panels, strict=True):
        curves = {name: np.array(of[f"{quantity}_{axis}"], dtype=float) for name, of in results.items()}
        lines[axes] = {
            name: _line(axes, start + dt * np.arange(len(of)), of, styles[name]) for name, of in curves.items()
        }
        axes.set(xlabel="time, s", ylabel=f"{label}, {axis}")
    figure.suptitle(words(title, TITLE))
    return _finished(figure, lines)


def scaling(panels: dict[str, list[tuple[float, float]]], title: str) -> Figure:
    """Time per track and step over the size of the job.

    Args:
        panels: one for each size, such as ``"batch"``: pairs of the size and microseconds.
        title: of the figure.
    """
    columns, rows = min(len(panels), 3), -(-len(panels) // 3)
    figure = Figure(figsize=(4 * columns, 3.1 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    grid[0, 0].set(yscale="log")
    figure.supylabel("microseconds per track and step", fontsize="medium")
    for axes, (size, pairs) in zip(grid.flat, panels.items(), strict=False):
        axes.plot(*zip(*pairs, strict=True), marker="o", color=BLUE)
        axes.set(xlabel=size)
        if max(pairs)[0] > 100:
            axes.set_xscale("log")
        else:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        finish(axes)
    figure.suptitle(words(title, TITLE))
    return figure


def _line(axes: Axes, x: Any, y: Any, style: Mapping[str, Any]) -> Line2D:
    (line,) = axes.plot(x, y, **style)
    return line


def _finished(figure: Figure, lines: Mapping[Axes, Mapping[str, Line2D]]) -> Figure:
    """The figure with a grid in its axes and a name at each line."""
    for axes in lines:
        finish(axes)
    name_lines(figure, lines)
    return figure


def _limit(axes: Axes, curves: Sequence[Array]) -> None:
    """Gives a logarithmic axis limits around what informs."""
    values = np.concatenate(curves)
    known = values[np.isfinite(values) & (values > 0)]
    if len(known):
        axes.set_ylim(known.min() / 1.15, min(known.max(), _ROOM * float(np.median(known))) * 1.15)
