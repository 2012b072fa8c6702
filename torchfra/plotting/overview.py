"""Several cleaned tracks at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.colours import APART, BLUE, DARK, GREY, RED
from torchfra.cleaning.outputs.summary import summary
from torchfra.plotting.labels import SIZE, Array, in_free_places, show
from torchfra.plotting.style import finish, lay_out, plain_ticks, without_box, words
from torchfra.readers.repairs import plural

_MOST_ROWS = 40
"""Targets that have a row; of more, those with the largest share of rejected fixes."""


def overview(results: Sequence[Cleaned]) -> Figure:
    """All tracks on a map, and a row for each target: how far its fixes were moved, how sure it is, what was rejected.

    The axes are labelled ``"map"`` and ``"rows"``.
    """
    of = [summary(cleaned) for cleaned in results]
    order = sorted(range(len(of)), key=lambda i: of[i]["flags"]["outlier"] / max(of[i]["fixes"], 1))[-_MOST_ROWS:]
    figure = Figure(figsize=(12, max(5.0, 1.6 + 0.19 * len(order))), layout="constrained")
    panels = figure.subplot_mosaic([["map", "rows"]], width_ratios=[1.15, 1])
    colours = dict(zip((s["name"] for s in of), APART, strict=False)) if len(of) <= len(APART) else {}
    paths = _draw_map(panels["map"], results, colours)
    _draw_rows(panels["rows"], [of[i] for i in order], colours, len(of))
    fixes, rejected = sum(s["fixes"] for s in of), sum(s["flags"]["outlier"] for s in of)
    figure.suptitle(f"{len(of)} {plural(results[0].recording.source.word)}: {fixes:,} fixes, {rejected:,} rejected")
    every = np.concatenate([*paths.values()] or [np.zeros((1, 2))])
    margin = 0.04 * max(float(np.ptp(every, axis=0).max()), 1e-3)
    window = every.min(0) - margin, every.max(0) + margin
    show(panels["map"], *window)  # about: the layout needs the numbers at its axes
    lay_out(figure)
    figure.set_layout_engine("none")
    show(panels["map"], *window)
    in_free_places(panels["map"], {name: paths[name] for name in colours if name in paths}, colours)
    return figure


def _draw_map(axes: Axes, results: Sequence[Cleaned], colours: dict[str, str]) -> dict[str, Array]:
    """Draws the path of each target from its first to its last fix that was kept; returns what it drew."""
    every = [cleaned.position[np.isfinite(cleaned.position).all(1), :2] for cleaned in results]
    size = float(np.ptp(np.concatenate(every), axis=0).max()) if any(map(len, every)) else 0.0
    unit, metres = ("km", 1000.0) if size >= 2000 else ("m", 1.0)
    paths = {}
    for cleaned, of in zip(results, every, strict=True):
        if len(path := of / metres):
            name = cleaned.recording.name
            paths[name] = path
            axes.plot(*path.T, color=colours.get(name, BLUE), linewidth=1.1, alpha=1.0 if colours else 0.6)
            axes.plot(*path[0], ".", color=colours.get(name, BLUE), markersize=4)
    axes.set(xlabel=f"east, {unit}", ylabel=f"north, {unit}")
    axes.set_title("cleaned tracks, a dot where each begins", fontsize=10)
    finish(axes)
    return paths


def _draw_rows(axes: Axes, rows: list[dict[str, Any]], colours: dict[str, str], count: int) -> None:
    keys = ("median_correction", "largest_correction", "median_std")
    values = np.array([[row[key] for key in keys] for row in rows])
    for i, (row, (median, largest, std)) in enumerate(zip(rows, values, strict=True)):
        colour = colours.get(row["name"], GREY)
        axes.plot([median, largest], [i, i], color=colour, linewidth=1.2)
        axes.plot(median, i, "o", color=colour, markersize=5)
        axes.plot(std, i, "|", color="black", markersize=8)
        if rejected := row["flags"]["outlier"]:
            axes.annotate(f"{rejected:,}", (1.0, i), (4, 0), xycoords=("axes fraction", "data"), color=RED,
                          textcoords="offset points", va="center", fontsize=SIZE - 1)  # fmt: skip
    axes.set_yticks(range(len(rows)), [words(row["name"], 24) for row in rows], fontsize=SIZE - 1)
    for label, row in zip(axes.get_yticklabels(), rows, strict=True):
        label.set_color(colours.get(row["name"], DARK))
    known = values[np.isfinite(values) & (values > 0)]
    low, high = (known.min(), known.max()) if len(known) else (1.0, 10.0)
    axes.set(xscale="log", xlim=(low / 1.2, high * 1.2), ylim=(-0.6, len(rows) - 0.4), xlabel="m")
    some = "" if len(rows) == count else f"the {len(rows)} with most rejected\n"
    axes.set_title(f"{some}fixes moved: median (dot), most (line); | how sure", fontsize=10)
    axes.annotate("rejected", (1.0, 1.0), (4, 4), xycoords="axes fraction", textcoords="offset points", color=RED,
                  ha="center", fontsize=SIZE - 1)  # fmt: skip
    axes.tick_params(axis="y", length=0)
    plain_ticks(axes.xaxis)
    axes.grid(axis="x", alpha=0.25)
    without_box(axes)
