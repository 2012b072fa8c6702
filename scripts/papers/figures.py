"""Figures of the papers' experiments: errors, innovations and probabilities over time, one panel for each kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from torchfra.pictures import APART, BLACK, GREY, RED, REGIMES
from torchfra.plotting.curves import WIDE
from torchfra.plotting.labels import SIZE, beside, named
from torchfra.plotting.style import TITLE, line_styles, without_box, words

_ROOM = 30.0
"""Upper limit of errors, as a factor on their median over all lines; a name at the upper edge is beyond."""
_QUANTITIES = (("range", "m", 1.0), ("azimuth", "mrad", 1e3), ("elevation", "mrad", 1e3))


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
    values = np.concatenate(list(curves.values()))
    known = values[np.isfinite(values) & (values > 0)]
    if len(known):
        axes.set_ylim(known.min() / 1.15, min(known.max(), _ROOM * float(np.median(known))) * 1.15)
    return named(figure, {axes: lines})


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
    return named(figure, {axes: lines})


def innovations(nis: dict[str, Tensor], gate: float, dt: float, title: str) -> Figure:
    """Normalised innovation squared over time, with the gate: medians of the runs, and their quartiles as bands.

    Args:
        nis: by name, ``(B, T)`` each.
        gate: above which an innovation is abnormal.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes, styles = figure.subplots(), line_styles(nis)
    lines = {name: _band(axes, dt, of.clamp_min(1e-3), styles[name]) for name, of in nis.items()}
    lines[f"gate {gate:g}"] = axes.axhline(gate, color=BLACK, linestyle="--", linewidth=1)
    axes.set(xlabel="time, s", ylabel="normalised innovation squared", yscale="log", title=words(title, TITLE))
    return named(figure, {axes: lines})


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
    return named(figure, lines)


def probabilities(of: dict[str, Any], models: Sequence[str], start: float, dt: float, title: str) -> Figure:
    """Probabilities of models over time, stacked, one panel for each filter.

    Args:
        of: by name of the filter ``(T, K)``.
        models: their names, K or more; a filter of fewer has the first of them.
        start: seconds at the first step.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(9, 2.2 * len(of) + 0.6), layout="constrained")
    rows = figure.subplots(len(of), 1, squeeze=False, sharex=True)[:, 0]
    for (name, values), axes in zip(of.items(), rows, strict=True):
        values = np.asarray(values, dtype=float)
        time = start + dt * np.arange(len(values))
        axes.stackplot(time, values.T, colors=REGIMES, linewidth=0)
        axes.set(ylabel=words(name), ylim=(0, 1), xlim=(time[0], time[-1]))
        beside(axes, dict(zip(models[: values.shape[1]], cycle(REGIMES), strict=False)))
        without_box(axes)
    rows[-1].set(xlabel="time, s")
    figure.suptitle(words(title, TITLE))
    return figure


def by_target(results: dict[str, dict[str, Any]], dt: float, title: str) -> Figure:
    """Root mean square errors of range, azimuth and elevation over time, one row for each target.

    Args:
        results: by name of the filter, ``"rmse_range"`` (m), ``"rmse_azimuth"`` and ``"rmse_elevation"`` (rad),
            ``[N][T]``.
        dt: seconds per step.
        title: of the figure.
    """
    targets = len(next(iter(results.values()))["rmse_range"])
    figure = Figure(figsize=(15, 3 * targets), layout="constrained")
    grid = figure.subplots(targets, len(_QUANTITIES), squeeze=False, sharex=True)
    lines, styles = {}, line_styles(results)
    for i, row in enumerate(grid):
        for axes, (key, unit, scale) in zip(row, _QUANTITIES, strict=True):
            curves = {name: scale * np.array(values[f"rmse_{key}"][i], dtype=float) for name, values in results.items()}
            lines[axes] = {
                name: _line(axes, dt * np.arange(1, len(of) + 1), of, styles[name]) for name, of in curves.items()
            }
            axes.set(ylabel=f"target {i + 1}: {key}, {unit}", yscale="log")
    for axes in grid[-1]:
        axes.set(xlabel="time, s")
    figure.suptitle(f"root mean square error, {words(title, TITLE)}")
    return named(figure, lines)


def raw_and_filtered(ranges: dict[str, tuple[Tensor, Tensor]], dt: float, title: str) -> Figure:
    """Sizes of range errors of measurements and of estimates, one panel for each target: medians and quartiles of runs.

    Args:
        ranges: by name of the target, measured and filtered errors of runs ``(B, T)``, m; NaN where missed.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 2.6 * len(ranges)), layout="constrained")
    panels = figure.subplots(len(ranges), 1, squeeze=False, sharex=True)[:, 0]
    lines = {}
    for axes, (name, (raw, filtered)) in zip(panels, ranges.items(), strict=True):
        styles = {"measured": {"color": BLACK, "linewidth": 1.0}, "filtered": {"color": RED, "linewidth": 1.4}}
        values = {"measured": raw, "filtered": filtered}
        lines[axes] = {key: _band(axes, dt, of, styles[key]) for key, of in values.items()}
        axes.set(xlabel="time, s", ylabel=words(f"{name}: range error, m"))
    figure.suptitle(words(title, TITLE))
    return named(figure, lines)


def in_space(truth: Tensor, estimates: Tensor, measured: Tensor, title: str) -> Figure:
    """Targets, what was measured and what a filter made of it, in space.

    Args:
        truth: ``(N, T, 3 or more)``, m.
        estimates: ``(N, T, 3 or more)``, m.
        measured: ``(M, 3)`` of all scans, m; NaN for none.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 7), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    axes.scatter(*(measured.mT / 1000).numpy(), s=2, color=GREY, alpha=0.4, depthshade=False)
    for i, (path, mean) in enumerate(zip(truth, estimates, strict=False)):
        colour = APART[i % len(APART)]
        axes.plot(*(path[:, :3].mT / 1000).numpy(), **WIDE)
        axes.plot(*(mean[:, :3].mT / 1000).numpy(), color=colour, linewidth=1.4)
        others = torch.cat([truth[:i], truth[i + 1 :]])[..., :3].reshape(-1, 3)
        apart = torch.cdist(path[:, :3].contiguous(), others).amin(-1) if len(others) else path[:, 0]
        axes.text(*(path[apart.nan_to_num(0.0).argmax(), :3] / 1000).tolist(), f" target {i + 1}", color=colour,
                  fontsize=SIZE)  # fmt: skip
    axes.set(xlabel="east, km", ylabel="north, km", zlabel="up, km")
    axes.set_title(f"{words(title, TITLE)}\nwide: truth; lines: filtered; dots: measured", fontsize=10)
    return figure


def errors_along(errors: dict[str, Tensor], dt: float, ylabel: str, title: str) -> Figure:
    """Errors over time: medians of the runs, and their quartiles as bands.

    The axis is linear up to twice the median size, and logarithmic beyond: errors of metres show beside kilometres.

    Args:
        errors: by name of the filter, ``(B, T)`` each.
        dt: seconds per step.
        ylabel: what they are.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes, styles = figure.subplots(), line_styles(errors)
    lines = {name: _band(axes, dt, of, styles[name]) for name, of in errors.items()}
    usual = float(torch.stack(list(errors.values())).abs().nanmedian())
    axes.set_yscale("symlog", linthresh=2 * usual)
    axes.set(xlabel="time, s", ylabel=ylabel, title=words(title, TITLE))
    return named(figure, {axes: lines})


def along(truth: Tensor, measured: Tensor, estimates: dict[str, Tensor], dt: float, ylabel: str, title: str) -> Figure:
    """A coordinate over time: truth, measurements and estimates of a run.

    Args:
        truth: ``(T,)``.
        measured: ``(T,)``; NaN is missing.
        estimates: by name of the filter, ``(T,)`` each.
        dt: seconds per step.
        ylabel: of the coordinate.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes, styles, time = figure.subplots(), line_styles(estimates), dt * np.arange(1, len(truth) + 1)
    (wide,) = axes.plot(time, truth, **WIDE)
    (dots,) = axes.plot(time, measured, ".", color=GREY, markersize=4)
    lines = {"truth": wide, "measured": dots}
    lines |= {name: _line(axes, time, of, styles[name]) for name, of in estimates.items()}
    axes.set(xlabel="time, s", ylabel=ylabel, title=words(title, TITLE))
    return named(figure, {axes: lines})


def _band(axes: Axes, dt: float, of: Tensor, style: Mapping[str, Any]) -> Line2D:
    """The median of runs ``(B, T)`` over time as a line, and their quartiles as a band; NaN where there are none."""
    low, middle, high = of.nanquantile(torch.tensor([0.25, 0.5, 0.75], dtype=of.dtype), 0)
    time = dt * np.arange(1, of.shape[-1] + 1)
    axes.fill_between(time, low, high, color=style["color"], alpha=0.2, linewidth=0)
    return _line(axes, time, middle, style)


def _line(axes: Axes, x: Any, y: Any, style: Mapping[str, Any]) -> Line2D:
    (line,) = axes.plot(x, y, **style)
    return line
