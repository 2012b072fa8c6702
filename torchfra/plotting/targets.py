"""Errors of several targets, one row of panels for each."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from torchfra.cleaning.outputs.colours import BLACK, RED
from torchfra.plotting.labels import name_lines
from torchfra.plotting.style import TITLE, finish, line_styles, words

_QUANTITIES = (("range", "m", 1.0), ("azimuth", "mrad", 1e3), ("elevation", "mrad", 1e3))


def by_target(of: dict[str, dict[str, Any]], dt: float, title: str) -> Figure:
    """Root mean square errors of range, azimuth and elevation over time, one row for each target.

    Args:
        of: by name of the filter, ``"rmse_range"`` (m), ``"rmse_azimuth"`` and
            ``"rmse_elevation"`` (rad), ``[N][T]``.
        dt: seconds per step.
        title: of the figure.
    """
    targets = len(next(iter(of.values()))["rmse_range"])
    figure = Figure(figsize=(15, 3 * targets), layout="constrained")
    grid = figure.subplots(targets, len(_QUANTITIES), squeeze=False, sharex=True)
    lines, styles = {}, line_styles(of)
    for i, row in enumerate(grid):
        for axes, (key, unit, scale) in zip(row, _QUANTITIES, strict=True):
            curves = {name: scale * np.array(values[f"rmse_{key}"][i], dtype=float) for name, values in of.items()}
            lines[axes] = {
                name: axes.plot(dt * np.arange(1, len(curve) + 1), curve, **styles[name])[0]
                for name, curve in curves.items()
            }
            axes.set(ylabel=f"target {i + 1}: {key}, {unit}", yscale="log")
            finish(axes)
    for axes in grid[-1]:
        axes.set(xlabel="time, s")
    figure.suptitle(f"root mean square error, {words(title, TITLE)}")
    name_lines(figure, lines)
    return figure


def raw_and_filtered(ranges: dict[str, tuple[Tensor, Tensor]], dt: float, title: str) -> Figure:
    """Range errors of measurements and of estimates, one panel for each target.

    Args:
        ranges: by name of the target, measured and filtered errors ``(T,)``, m; NaN where missed.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 2.6 * len(ranges)), layout="constrained")
    panels = figure.subplots(len(ranges), 1, squeeze=False, sharex=True)[:, 0]
    lines = {}
    for axes, (name, (raw, filtered)) in zip(panels, ranges.items(), strict=True):
        time = dt * np.arange(1, len(raw) + 1)
        (dots,) = axes.plot(time, raw, ".", color=BLACK, markersize=4)
        (line,) = axes.plot(time, filtered, color=RED, linewidth=1.4)
        lines[axes] = {"measured": dots, "filtered": line}
        axes.set(xlabel="time, s", ylabel=words(f"{name}: range error, m"))
        finish(axes)
    figure.suptitle(words(title, TITLE))
    name_lines(figure, lines)
    return figure
