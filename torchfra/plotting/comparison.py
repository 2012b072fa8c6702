"""Filters compared: a run on a map, all runs of every filter, errors over time; and for print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchfra.numbers import Array
from torchfra.pictures import APART, BLACK, GREY, MappedRun, corners
from torchfra.plotting.labels import SIZE, at_ends, in_free_places
from torchfra.plotting.style import TITLE, finish, lay_out, line_styles, plain_ticks, without_box, words

_ROW = 0.27
"""Height of a filter's row, inches."""
_BEYOND = 2.0
"""Largest limit of the axes, as a factor on the error at which a run has diverged."""
_ROOM = 0.5
"""By how much fixes may widen the map of the true path, as a share of its size; those further away are left out."""
_LONGEST = 30
"""Characters of a recording's name in the title; of longer ones it has the end."""
_FONTS = {
    "font.size": 8, "axes.labelsize": 8, "xtick.labelsize": 7, "ytick.labelsize": 7, "legend.fontsize": 7,
    "axes.linewidth": 0.6, "lines.linewidth": 1.0,
}  # fmt: skip
_PRINTED_ROW, _PRINTED_CURVES = 0.17, 1.9
"""Heights of a filter's row and of the errors over time, inches."""


def comparison(
    results: Mapping[str, Mapping[str, Any]], shown: Sequence[str], dt: float, limit: float, title: str,
    mapped: MappedRun | None = None,
) -> Figure:  # fmt: skip
    """Filters compared: one run on a map, the errors of all runs, and those of some filters over time.

    The axes are labelled ``"map"`` (where there is a run to draw), ``"runs"`` and ``"time"``.

    Args:
        results: from ``torchfra.evaluation.evaluate``.
        shown: names of those whose errors are shown over time, as many as there are colours in ``style.APART`` or less.
        dt: seconds per step.
        limit: position error above which a run has diverged, m.
        title: of the figure.
        mapped: the run on the map; the filters of its estimates are among ``shown``.
    """
    colours = dict(zip(shown, APART, strict=False))
    height = max(4.5 if mapped is None else 7.0, 1.6 + _ROW * len(results))
    figure = Figure(figsize=(11.5, height), layout="constrained")
    if mapped is None:
        panels = figure.subplot_mosaic([["time", "runs"]], width_ratios=[1.2, 1])
    else:
        places: list[Any] = [["map", "runs"], ["time", "runs"]]
        panels = figure.subplot_mosaic(places, width_ratios=[1.2, 1], height_ratios=[1.55, 1])
        metres = _draw_map(panels["map"], mapped, colours)
    _draw_runs(panels["runs"], results, limit, colours)
    ends = _draw_time(panels["time"], results, dt, limit, colours)
    figure.suptitle(words(title, TITLE))
    lay_out(figure)  # labels are put where there is room, which the layout decides
    at_ends(panels["time"], ends, colours)
    lay_out(figure)
    if mapped is not None:
        _label_map(panels["map"], mapped, colours, metres)
    return figure


def _draw_runs(axes: Axes, results: Mapping[str, Mapping[str, Any]], limit: float, colours: Mapping[str, str]) -> None:
    """A row for each filter, the best on top: median, 5 to 95 % and worst of its runs, and how many diverged."""
    keys = ("p05_track_rmse", "median_track_rmse", "p95_track_rmse", "worst_track")
    errors = {name: np.array([of[key] for key in keys], dtype=np.float64) for name, of in results.items()}
    errors = {name: np.where(np.isnan(of), np.inf, of) for name, of in errors.items()}
    names = sorted(results, key=lambda name: errors[name][1], reverse=True)
    values = np.stack([errors[name] for name in names])
    low, high = _limits(values, limit)
    inside = np.clip(values, low, high)
    for row, (name, (least, median, most, worst)) in enumerate(zip(names, inside, strict=True)):
        colour = colours.get(name, GREY)
        axes.plot([most, worst], [row, row], color=colour, linewidth=1)
        axes.plot([least, most], [row, row], color=colour, linewidth=6, alpha=0.45, solid_capstyle="butt")
        axes.plot(worst, row, marker="|" if values[row, 3] <= high else ">", color=colour, markersize=6, clip_on=False)
        axes.plot(median, row, "o", color=colour, markersize=5, clip_on=False)
        if diverged := results[name]["diverged"]:
            axes.annotate(f"{diverged} diverged", (1.0, row), (6, 0), xycoords=("axes fraction", "data"),
                          textcoords="offset points", va="center", fontsize=SIZE, color="black")  # fmt: skip
    if low < limit < high:
        axes.axvline(limit, color="black", linestyle=":", linewidth=1)
    axes.set_yticks(range(len(names)), map(words, names))
    for label, name in zip(axes.get_yticklabels(), names, strict=True):
        label.set(color=colours.get(name, "black"), fontweight="bold" if name in colours else "normal")
    axes.set(xscale="log", xlim=(low, high), ylim=(-0.6, len(names) - 0.4), xlabel="RMSE of the position in a run, m")
    axes.set_title(f"all runs: median, 5 to 95 %, worst; diverged: over {limit:g} m", fontsize=10)
    axes.tick_params(axis="y", length=0)
    plain_ticks(axes.xaxis)
    axes.grid(axis="x", alpha=0.25)
    without_box(axes)


def _draw_time(
    axes: Axes, results: Mapping[str, Mapping[str, Any]], dt: float, limit: float, colours: Mapping[str, str]
) -> dict[str, float]:
    """A line for each of the filters in ``colours``; returns the height of its end by name."""
    curves = {name: np.array(results[name]["rmse_position"], dtype=float) for name in colours}
    low, high = _limits(np.array(list(curves.values())), limit)
    steps = max(len(curve) for curve in curves.values())
    axes.set(yscale="log", ylim=(low, high), xlim=(0, dt * steps), xlabel="time, s", ylabel="RMSE of the position, m")
    for name, curve in reversed(curves.items()):
        axes.plot(dt * np.arange(1, len(curve) + 1), curve, color=colours[name], linewidth=1.4)
    plain_ticks(axes.yaxis)
    axes.set_title("over time, all runs", fontsize=10)
    finish(axes)
    known = {name: curve[~np.isnan(curve)] for name, curve in curves.items()}
    return {name: curve[-1] if len(curve) else high for name, curve in known.items()}


def _limits(values: Array, limit: float) -> tuple[float, float]:
    """Limits of a logarithmic axis around what informs: no further than some way beyond where runs have diverged."""
    known = values[(values > 0) & (values <= limit)]
    low, high = (known.min(), known.max()) if len(known) else (limit, limit)
    beyond = values[values > limit]
    if len(beyond):
        high = max(high, min(beyond.max(), _BEYOND * limit, 10 * high))
    return low / 1.15, high * 1.15


# ---------------------------------------------------------------- one run on a map


def _draw_map(axes: Axes, mapped: MappedRun, colours: Mapping[str, str]) -> float:
    """The true path, what was measured, and what filters made of it; returns the metres in the unit of the axes."""
    path, fixes = mapped.truth.flatten(0, 1).numpy(), mapped.fixes.flatten(0, 1).numpy()
    low, high = np.nanmin(path, 0), np.nanmax(path, 0)
    low, high = corners(low, high, fixes, _ROOM * max((high - low).max(), 1.0))
    unit, metres = ("km", 1000.0) if (high - low).max() >= 500 else ("m", 1.0)
    for path in mapped.truth.numpy() / metres:
        axes.plot(*path.T, color="black", linewidth=4, alpha=0.25, solid_capstyle="round")
    for name, of in _fixes(mapped).items():
        mark, colour = (".", GREY) if name == "measured" else ("x", BLACK)
        axes.plot(*(of / metres).T, linestyle="none", marker=mark, color=colour, zorder=3)
    for name, paths in reversed(mapped.estimates.items()):
        for path in paths.numpy() / metres:
            axes.plot(*path.T, color=colours[name], linewidth=1.4)
    (left, bottom), (right, top) = low / metres, high / metres
    axes.set_xlim(left, right, auto=True)  # may be widened, so that both axes have the same scale
    axes.set_ylim(bottom, top, auto=True)
    axes.set(xlabel=f"x, {unit}", ylabel=f"y, {unit}", aspect="equal", adjustable="datalim")
    name = mapped.name if len(mapped.name) <= _LONGEST else f"...{mapped.name[3 - _LONGEST :]}"
    nowhere = mapped.outlying.flatten().numpy() & np.isnan(fixes).any(1)  # outliers without a position
    count = int((((fixes < low) | (fixes > high)).any(1) | nowhere).sum())
    outside = f", {count} measured elsewhere" if count else ""
    axes.set_title(f"{words(name)}, {mapped.time[0]:g} to {mapped.time[-1]:g} s{outside}", fontsize=10)
    finish(axes)
    return metres


def _label_map(axes: Axes, mapped: MappedRun, colours: Mapping[str, str], metres: float) -> None:
    """Names what is on the map, once the figure has its layout."""
    lines = {"truth": mapped.truth} | mapped.estimates
    points = {name: _dense(paths.numpy()) for name, paths in lines.items()} | _fixes(mapped)
    shades = {"truth": "#555555", "measured": "#777777", "outlier": BLACK} | dict(colours)
    in_free_places(axes, {name: of / metres for name, of in points.items()}, shades)


def _fixes(mapped: MappedRun) -> dict[str, Array]:
    """Positions that were measured, and those that are outliers: ``(k, 2)`` each."""
    fixes, outlying = mapped.fixes.flatten(0, 1).numpy(), mapped.outlying.flatten().numpy()
    return {"measured": fixes[~outlying], "outlier": fixes[outlying]}


def _dense(paths: Array) -> Array:
    """Points ``(k, 2)`` along paths ``(N, T, 2)``, ten for each step."""
    share = np.linspace(0, 1, 10, endpoint=False)[:, None]
    between = paths[:, :-1, None] + share * (paths[:, 1:, None] - paths[:, :-1, None])
    dense: Array = np.concatenate([between.reshape(-1, 2), paths[:, -1]])
    return dense


# ---------------------------------------------------------------- for print


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
        height = _PRINTED_CURVES + 0.5 + _PRINTED_ROW * len(results) + 0.12 * -(-len(results) // 3)
        figure = Figure(figsize=(width, height), layout="constrained")
        heights = [_PRINTED_CURVES, 0.25 + _PRINTED_ROW * len(results)]
        axes = figure.subplots(2, 1, gridspec_kw={"height_ratios": heights})
        for name, place in zip(("time", "means"), axes, strict=True):
            place.set_label(name)
        _draw_errors(axes[0], results, dt, bound, styles)
        _draw_means(axes[1], results, styles)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def _draw_errors(
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
