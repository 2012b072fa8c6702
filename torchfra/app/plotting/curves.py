"""Numbers of every filter over time, or over a setting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from torchfra.app.plotting.style import BLUE, TITLE, finish, line_styles, words


def rmse_curves(results: dict[str, dict[str, Any]], quantity: str, dt: float, title: str) -> Figure:
    """Root mean square error over time of every filter.

    Args:
        results: from ``torchfra.app.evaluate.evaluate``.
        quantity: ``"position"`` (m), ``"velocity"`` (m/s) or another of ``Scenario.quantities``.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes, styles = figure.subplots(), line_styles(results)
    for name, result in results.items():
        curve = np.array(result[f"rmse_{quantity}"], dtype=float)
        axes.plot(dt * np.arange(1, len(curve) + 1), curve, label=words(name), **styles[name])
    unit = {"position": ", m", "velocity": ", m/s"}.get(quantity, "")
    axes.set(xlabel="time, s", ylabel=f"RMSE of {quantity}{unit}", yscale="log", title=words(title, TITLE))
    finish(axes)
    return figure


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
    for name, values in curves.items():
        axes.plot(x, values, marker="o", markersize=3, label=words(name), **styles[name])
    axes.set(xlabel=xlabel, ylabel=ylabel, title=words(title, TITLE))
    finish(axes)
    return figure


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
    for name, values in nis.items():
        axes.plot(dt * np.arange(1, len(values) + 1), values.clamp_min(1e-3), label=words(name), **styles[name])
    axes.axhline(gate, color="black", linestyle="--", linewidth=1, label=f"gate {gate:g}")
    axes.set(xlabel="time, s", ylabel="normalised innovation squared", yscale="log", title=words(title, TITLE))
    finish(axes)
    return figure


def by_coordinate(results: dict[str, dict[str, Any]], quantity: str, start: float, dt: float, title: str) -> Figure:
    """An error of the position over time, one panel for each coordinate.

    Args:
        results: from ``torchfra.app.evaluate.evaluate``.
        quantity: ``"mean_error"``, ``"rmse"`` (m) or ``"mape"`` (%).
        start: seconds at the first step.
        dt: seconds per step.
        title: of the figure.
    """
    axes_of = [axis for axis in "xyz" if all(f"{quantity}_{axis}" in of for of in results.values())]
    figure = Figure(figsize=(5 * len(axes_of), 3.6), layout="constrained")
    label = {"mean_error": "mean error, m", "rmse": "RMSE, m", "mape": "mean relative error, %"}[quantity]
    panels, styles = figure.subplots(1, len(axes_of), squeeze=False)[0], line_styles(results)
    for axis, axes in zip(axes_of, panels, strict=True):
        for name, of in results.items():
            curve = np.array(of[f"{quantity}_{axis}"], dtype=float)
            axes.plot(start + dt * np.arange(len(curve)), curve, label=words(name), **styles[name])
        axes.set(xlabel="time, s", ylabel=f"{label}, {axis}")
        finish(axes)
    figure.suptitle(words(title, TITLE))
    return figure


def scaling(panels: dict[str, list[tuple[float, float]]], title: str) -> Figure:
    """Time per track and step over the size of the job.

    Args:
        panels: one for each size, such as ``"batch"``: pairs of the size and microseconds.
        title: of the figure.
    """
    figure = Figure(figsize=(4 * len(panels), 3.4), layout="constrained")
    grid = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    grid[0].set(ylabel="microseconds per track and step", yscale="log")
    for axes, (size, pairs) in zip(grid, panels.items(), strict=True):
        axes.plot(*zip(*pairs, strict=True), marker="o", color=BLUE)
        axes.set(xlabel=size)
        if max(pairs)[0] > 100:
            axes.set_xscale("log")
        axes.grid(True, which="both", alpha=0.3)
    figure.suptitle(words(title, TITLE))
    return figure
