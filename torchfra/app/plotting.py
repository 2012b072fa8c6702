"""Figures.  Each function returns a matplotlib figure that belongs to nobody; ``save`` writes it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torchfra.app.atomic_write import write

_BESIDE = 12
"""Lines of a legend that fit into a figure; more stand beside it."""


_MODELS = ("#bbbbbb", "#4c72b0", "#dd8452", "#55a868", "#c44e52", "#8172b3", "#ccb974", "#64b5cd")


_COLOURS = {
    "ukf": "#999999", "ekf": "#c7a76c", "srckf": "#4c72b0", "rsrckf": "#8172b3", "mr_ckf": "#937860",
    "asrckf": "#64b5cd", "rmckf": "#dd8452", "fra_srckf": "#55a868", "fra": "#c44e52",
    "imm_fra": "#da8bc3", "imm_srckf": "#8c564b", "imm_ckf": "#8c564b", "vsimm_srckf": "#17becf",
    "ghckf": "#4c72b0", "hghckf1": "#dd8452", "hghckf2": "#55a868", "imm5": "#8c564b", "imm3": "#ccb974",
}  # fmt: skip


def save(figure: Figure, path: str | Path) -> Path:
    """Writes a figure as PNG, whole or not at all."""
    return write(path, lambda file: figure.savefig(file, format="png", dpi=140))


def rmse_curves(results: dict[str, dict[str, Any]], quantity: str, dt: float, title: str) -> Figure:
    """Root mean square error over time of every filter.

    Args:
        results: from ``torchfra.evaluate.evaluate``.
        quantity: ``"position"`` (m), ``"velocity"`` (m/s) or another of ``Scenario.quantities``.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for name, result in results.items():
        curve = np.array(result[f"rmse_{quantity}"], dtype=float)
        axes.plot(dt * np.arange(1, len(curve) + 1), curve, label=name, **_style(name))
    unit = {"position": ", m", "velocity": ", m/s"}.get(quantity, "")
    axes.set(xlabel="time, s", ylabel=f"RMSE of {quantity}{unit}", yscale="log", title=title)
    return _finished(figure, axes)


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
    axes = figure.subplots()
    for name, values in curves.items():
        axes.plot(x, values, marker="o", markersize=3, label=name, **_style(name))
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title)
    return _finished(figure, axes)


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
        axes.plot(*zip(*pairs, strict=True), marker="o", color=_COLOURS["srckf"])
        axes.set(xlabel=size)
        if max(pairs)[0] > 100:
            axes.set_xscale("log")
        axes.grid(True, which="both", alpha=0.3)
    figure.suptitle(title)
    return figure


def tracks(truth: Tensor, estimates: dict[str, Tensor], title: str, stations: Tensor | None = None) -> Figure:
    """One target's true path and what filters made of it, in the plane.

    Args:
        truth: ``(T, n)``.
        estimates: by name, ``(T, n)`` each.
        title: of the figure.
        stations: ``(T, 2 k)`` positions of the stations.
    """
    figure = Figure(figsize=(7, 6), layout="constrained")
    axes = figure.subplots()
    if stations is not None:
        for i, path in enumerate(stations.unflatten(-1, (-1, 2)).unbind(-2)):
            axes.plot(
                *(path.mT / 1000), color="black", linestyle=":", linewidth=1, label="stations" if i == 0 else None
            )
    axes.plot(*(truth[:, :2].mT / 1000), color="black", linewidth=2.5, label="truth")
    for name, mean in estimates.items():
        axes.plot(*(mean[:, :2].mT / 1000), label=name, **_style(name))
    axes.set(xlabel="x, km", ylabel="y, km", title=title, aspect="equal")
    axes.set_adjustable("datalim")
    return _finished(figure, axes)


def innovations(nis: dict[str, Tensor], gate: float, dt: float, title: str) -> Figure:
    """Normalised innovation squared over time, against the gate.

    Args:
        nis: by name, ``(T,)`` each.
        gate: what is abnormal.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for name, values in nis.items():
        axes.plot(dt * np.arange(1, len(values) + 1), values.clamp_min(1e-3), label=name, **_style(name))
    axes.axhline(gate, color="black", linestyle="--", linewidth=1, label=f"gate {gate:g}")
    axes.set(xlabel="time, s", ylabel="normalised innovation squared", yscale="log", title=title)
    return _finished(figure, axes)


def by_coordinate(results: dict[str, dict[str, Any]], quantity: str, start: float, dt: float, title: str) -> Figure:
    """An error of the position over time, one panel for each coordinate.

    Args:
        results: from ``torchfra.evaluate.evaluate``.
        quantity: ``"mean_error"``, ``"rmse"`` (m) or ``"mape"`` (%).
        start: seconds at the first step.
        dt: seconds per step.
        title: of the figure.
    """
    axes_of = [axis for axis in "xyz" if all(f"{quantity}_{axis}" in of for of in results.values())]
    figure = Figure(figsize=(5 * len(axes_of), 3.6), layout="constrained")
    said = {"mean_error": "mean error, m", "rmse": "RMSE, m", "mape": "mean relative error, %"}[quantity]
    for axis, axes in zip(axes_of, figure.subplots(1, len(axes_of), squeeze=False)[0], strict=True):
        for name, of in results.items():
            curve = np.array(of[f"{quantity}_{axis}"], dtype=float)
            axes.plot(start + dt * np.arange(len(curve)), curve, label=name, **_style(name))
        axes.set(xlabel="time, s", ylabel=f"{said}, {axis}")
        _finished(figure, axes)
    figure.suptitle(title)
    return figure


def probabilities(of: dict[str, Any], models: Sequence[str], start: float, dt: float, title: str) -> Figure:
    """Probabilities of models over time, on top of each other, one panel for each filter.

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
        axes.stackplot(time, values.T, colors=_MODELS, labels=models[: values.shape[1]], linewidth=0)
        axes.set(ylabel=name, ylim=(0, 1), xlim=(time[0], time[-1]))
    widest = max(rows, key=lambda axes: len(axes.get_legend_handles_labels()[1]))
    rows[0].legend(*widest.get_legend_handles_labels(), frameon=False, fontsize=8, ncols=4, loc="lower center",
                   bbox_to_anchor=(0.5, 1.0))  # fmt: skip
    rows[-1].set(xlabel="time, s")
    figure.suptitle(title)
    return figure


def filtered(
    time: Any,
    raw: Any,
    mean: Any,
    nis: Any,
    flags: dict[str, Any],
    gate: float,
    title: str,
    models: Sequence[str] = (),
    leading: Any = None,
) -> Figure:
    """A recorded track after filtering: the path, how far the fixes lie from it, the innovations, and what was flagged.

    Args:
        time: ``(T,)`` seconds.
        raw: ``(T, d)`` positions as recorded, NaN where missing.
        mean: ``(T, d)`` filtered positions, m.
        nis: ``(T,)``.
        flags: by name, ``(T,)`` bool each.
        gate: what is abnormal.
        title: of the figure.
        models: names of interacting models.
        leading: ``(T,)`` which of them is the most probable: shades the time.
    """
    figure = Figure(figsize=(11, 6), layout="constrained")
    path, residual, innovation = figure.subplot_mosaic([["path", "residual"], ["path", "innovation"]]).values()
    distance = np.linalg.norm(raw - mean, axis=-1)
    path.plot(mean[:, 0] / 1000, mean[:, 1] / 1000, color=_COLOURS["srckf"], linewidth=1.2, label="filtered")
    path.plot(raw[:, 0] / 1000, raw[:, 1] / 1000, ".", color="black", markersize=2, label="recorded")
    residual.plot(time, distance, color=_COLOURS["srckf"], linewidth=0.8)
    innovation.plot(time, np.maximum(nis, 1e-3), color=_COLOURS["srckf"], linewidth=0.8)
    innovation.axhline(gate, color="black", linestyle="--", linewidth=1)
    for (name, flag), mark, colour in zip(flags.items(), "x+", ("#c44e52", "#dd8452"), strict=False):
        path.plot(mean[flag, 0] / 1000, mean[flag, 1] / 1000, mark, color=colour, label=f"{name} ({int(flag.sum())})")
        for axes, values in ((residual, distance), (innovation, nis)):
            axes.plot(time[flag], values[flag], mark, color=colour)
    path.set(xlabel="east, km", ylabel="north, km", title=title, aspect="equal", adjustable="datalim")
    residual.set(ylabel="recorded to filtered, m", yscale="symlog")
    innovation.set(xlabel="time, s", ylabel="normalised innovation squared", yscale="log")
    path.legend(frameon=False, fontsize=8)
    if leading is not None:
        for axes in (residual, innovation):
            _shade(axes, time, leading, models)
        residual.legend(frameon=False, fontsize=7, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    for axes in (path, residual, innovation):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def by_target(of: dict[str, dict[str, Any]], dt: float, title: str) -> Figure:
    """Root mean square errors of range, azimuth and elevation over time, one row for each target.

    Args:
        of: by name of the filter, in pairs that share a colour, ``"rmse_range"`` (m), ``"rmse_azimuth"`` and
            ``"rmse_elevation"`` (rad), ``[N][T]``.
        dt: seconds per step.
        title: of the figure.
    """
    targets = len(next(iter(of.values()))["rmse_range"])
    figure = Figure(figsize=(12, 3 * targets), layout="constrained")
    for row, i in zip(figure.subplots(targets, 3, squeeze=False, sharex=True), range(targets), strict=True):
        for axes, (key, unit, scale) in zip(
            row, (("range", "m", 1.0), ("azimuth", "mrad", 1e3), ("elevation", "mrad", 1e3)), strict=True
        ):
            for number, (name, values) in enumerate(of.items()):
                curve = scale * np.array(values[f"rmse_{key}"][i], dtype=float)
                colour, dash = _MODELS[1 + number // 2 % 7], ("-", ":")[number % 2]
                axes.plot(
                    dt * np.arange(1, len(curve) + 1), curve, color=colour, linestyle=dash, label=name, linewidth=1.3
                )
            axes.set(ylabel=f"target {i + 1}: {key}, {unit}", yscale="log")
            axes.grid(alpha=0.25)
            axes.spines[["top", "right"]].set_visible(False)
            if i == targets - 1:
                axes.set(xlabel="time, s")
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=8
    )
    figure.suptitle(f"root mean square error, {title}")
    return figure


def raw_and_filtered(ranges: dict[str, tuple[Tensor, Tensor]], dt: float, title: str) -> Figure:
    """Range errors of measurements and of estimates, one panel for each target.

    Args:
        ranges: by name of the target, measured and filtered errors ``(T,)``, m; NaN where missed.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 2.6 * len(ranges)), layout="constrained")
    for axes, (name, (raw, filtered)) in zip(
        figure.subplots(len(ranges), 1, squeeze=False, sharex=True)[:, 0], ranges.items(), strict=True
    ):
        time = dt * np.arange(1, len(raw) + 1)
        axes.plot(time, raw, ".", color="black", markersize=4, label="measured")
        axes.plot(time, filtered, color=_COLOURS["fra"], linewidth=1.4, label="filtered")
        axes.set(xlabel="time, s", ylabel=f"{name}: range error, m")
        _finished(figure, axes)
    figure.suptitle(title)
    return figure


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
    axes.scatter(*(measured.mT / 1000).numpy(), s=2, color="#999999", alpha=0.5, label="measured")
    for i, (path, mean, colour) in enumerate(zip(truth, estimates, cycle(_MODELS[1:]), strict=False)):
        axes.plot(*(path[:, :3].mT / 1000).numpy(), color="black", linewidth=2.5, label="truth" if i == 0 else None)
        axes.plot(*(mean[:, :3].mT / 1000).numpy(), color=colour, linewidth=1.4, label=f"target {i + 1}, filtered")
    axes.set(xlabel="east, km", ylabel="north, km", zlabel="up, km", title=title)
    axes.legend(frameon=False, fontsize=8)
    return figure


def learning_curve(rows: list[dict[str, float]], start: dict[str, float], title: str) -> Figure:
    """How a training went: the losses, and the values that were learned as multiples of their start.

    Args:
        rows: one for each iteration, with ``"iteration"``, ``"loss"``, the values, and ``"validation"`` in some.
        start: the values before the first.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 6), layout="constrained")
    loss, values = figure.subplots(2, 1, sharex=True)
    time = [row["iteration"] for row in rows]
    loss.plot(time, [row["loss"] for row in rows], color=_COLOURS["srckf"], linewidth=0.8, label="training batch")
    checked = [row for row in rows if "validation" in row]
    loss.plot(*zip(*((row["iteration"], row["validation"]) for row in checked), strict=True) if checked else ((), ()),
              "o-", color=_COLOURS["fra"], markersize=4, label="validation, hard decision")  # fmt: skip
    for name, first in start.items():
        value = np.array([row[name] for row in rows])
        # A value that began at 0 is a log of odds: those are compared.
        label, change = (name, value / first) if first else (f"exp({name})", np.exp(value))
        values.plot([0, *time], [1.0, *change], label=label)
    loss.set(ylabel="loss", title=title)
    values.set(xlabel="iteration", ylabel="times the start", yscale="log")
    for axes in (loss, values):
        _finished(figure, axes)
    if len(start) > _BESIDE:
        figure.set_size_inches(12, 6)
        values.legend(frameon=False, fontsize=7, ncols=2, loc="upper left", bbox_to_anchor=(1.0, 2.1))
    return figure


def _shade(axes: Axes, time: Any, leading: Any, models: Sequence[str]) -> None:
    """Colours the time by the model that leads; those that never lead are left out."""
    for k, (name, colour) in enumerate(zip(models, cycle(_MODELS), strict=False)):
        if (leading == k).any():
            axes.fill_between(time, 0, 1, where=leading == k, step="post", color=colour, alpha=0.35, linewidth=0,
                              transform=axes.get_xaxis_transform(), label=name)  # fmt: skip


def _style(name: str) -> dict[str, Any]:
    ours = name.startswith("fra")
    return {"color": _COLOURS.get(name), "linewidth": 1.8 if ours else 1.1, "zorder": 3 if ours else 2}


def _finished(figure: Figure, axes: Axes) -> Figure:
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, ncols=2)
    return figure
