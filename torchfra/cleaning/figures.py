"""Figures of cleaned tracks: where they were, how they moved, and what was thought of their fixes.

``torchfra.plotting.save`` writes them.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.view import SURE, Band, View, beyond, placed, view
from torchfra.cleaning.segments import spans
from torchfra.pictures import BLUE, BROWN, DARK, GREY, ORANGE, PALE_BLUE, RED
from torchfra.plotting.labels import SIZE, in_free_places, show
from torchfra.plotting.style import TITLE, finish, lay_out, without_box, words

_MANY = 50
"""Rejected fixes whose marks are small, so that the path is seen."""
_LIKELY = 0.5
"""Probability of a manoeuvre from which on a track has a panel of it."""
_LETTERS = 76
"""Letters of a manoeuvre's name that fit in the width of a panel."""


def cleaned(track: Cleaned) -> Figure:
    """A track on a map, and its speed, altitude and the probability of a manoeuvre over time.

    A rejected fix is drawn where it was recorded, on the map, in the panel of the altitude or in both, as it is off;
    the map shows the track, and one that is far off is a triangle at its edge.  Manoeuvres are shaded, climbs in the
    panel of the altitude, and what the track is sure to is a band.  The axes are labelled ``"map"``,
    ``"speed"``, ``"altitude"`` (of a track in space) and ``"manoeuvre"``, which is there if one is likely at some time.
    """
    shown = view(track)
    rows = ["speed", *(["altitude"] if shown.altitude else [])]
    rows += ["manoeuvre"] if (shown.manoeuvre >= _LIKELY).any() else []
    figure = Figure(figsize=(12, 7), layout="constrained")
    panels = figure.subplot_mosaic([["map", row] for row in rows], width_ratios=[1.15, 1])
    _draw_map(panels["map"], shown)
    _draw_band(panels["speed"], shown, shown.speed, "speed, m/s")
    if shown.altitude is not None:
        _draw_band(panels["altitude"], shown, shown.altitude, "altitude, m")
    if "manoeuvre" in panels:
        panels["manoeuvre"].fill_between(shown.time, np.nan_to_num(shown.manoeuvre), color=ORANGE, linewidth=0)
        panels["manoeuvre"].set(ylabel="manoeuvre", ylim=(0, 1))
    _finish_time([panels[row] for row in rows], shown)
    figure.suptitle(words(shown.title, TITLE))
    seen = show(panels["map"], *shown.window)  # about: the layout needs the numbers at its axes, and room above the map
    panels["map"].set_title(beyond(shown, *seen)[2], fontsize=SIZE, color=RED, loc="left")
    lay_out(figure)  # labels are put where there is room, which the layout decides
    figure.set_layout_engine("none")
    _label_map(panels["map"], shown)
    return figure


def _draw_map(axes: Axes, track: View) -> None:
    good = np.isfinite(track.sides).all((1, 2))
    edges = track.sides[good]
    quads = np.stack([edges[:-1, 0], edges[1:, 0], edges[1:, 1], edges[:-1, 1]], 1)
    axes.add_collection(PolyCollection(list(quads), facecolor=PALE_BLUE, edgecolor=PALE_BLUE, linewidth=0.5, zorder=1))
    for begin, end in spans(track.speed.manoeuvres):
        part = track.path[(track.time >= begin) & (track.time <= end)]
        axes.plot(*part.T, color=ORANGE, linewidth=5, alpha=0.6, solid_capstyle="butt", zorder=2)
    axes.plot(*track.recorded[~track.rejected].T, linestyle="none", marker=".", markersize=3, color=GREY, zorder=3)
    axes.plot(*track.path.T, color=BLUE, linewidth=1.3, zorder=4)
    size = 6 if track.rejected.sum() < _MANY else 3.5
    axes.plot(*track.recorded[track.rejected].T, linestyle="none", marker="x", markersize=size, color=RED, zorder=3.5)
    axes.set(xlabel=f"east, {track.unit}", ylabel=f"north, {track.unit}")
    finish(axes)


def _label_map(axes: Axes, track: View) -> None:
    """Names what is on the map, and marks at its edge what is outside, once the figure has its layout."""
    low, high = show(axes, *track.window)
    edge, way, _ = beyond(track, low, high)
    for (x, y), (dx, dy) in zip(edge, way, strict=True):
        axes.plot(x, y, marker=(3, 0, np.degrees(np.arctan2(dy, dx)) - 90), markersize=7, color=RED, clip_on=False,
                  linestyle="none", zorder=6)  # fmt: skip
    points = {
        "cleaned": track.path,
        "recorded": track.recorded[~track.rejected],
        "rejected": track.recorded[track.rejected],
    }
    turns = [track.path[(track.time >= begin) & (track.time <= end)] for begin, end in spans(track.speed.manoeuvres)]
    if turns:
        points["manoeuvre"] = np.concatenate(turns)
    finite = {name: places[np.isfinite(places).all(1)] for name, places in points.items()}
    colours = {"cleaned": BLUE, "recorded": DARK, "rejected": RED, "manoeuvre": BROWN}
    in_free_places(axes, {name: places for name, places in finite.items() if len(places)}, colours)


def _draw_band(axes: Axes, track: View, band: Band, label: str) -> None:
    """A quantity with its band; limits are those of the band where it is sure, and of what was recorded nearby."""
    low, high = band.mean - SURE * band.std, band.mean + SURE * band.std
    axes.fill_between(track.time, low, high, color=PALE_BLUE, linewidth=0)
    axes.plot(track.time, band.mean, color=BLUE, linewidth=1.2)
    low_end, high_end = band.limits()
    limits = (low_end if band.recorded is not None else max(low_end, 0.0), high_end)
    if band.recorded is not None:
        rejected = track.rejected if band.rejected is None else band.rejected
        for mask, mark, colour in ((~rejected, ".", GREY), (rejected, "x", RED)):
            axes.plot(track.time[mask], band.recorded[mask], mark, markersize=3 if mark == "." else 5, color=colour,
                      zorder=1 if mark == "." else 3)  # fmt: skip
    values = band.mean if band.recorded is None else band.recorded
    if count := int(((values < limits[0]) | (values > limits[1])).sum()):
        axes.set_title(f"{count:,} outside", fontsize=SIZE - 1, color=RED, loc="right", pad=2)
    axes.set(ylabel=label, ylim=limits)


def _finish_time(rows: list[Axes], track: View) -> None:
    """Shades the manoeuvres, and gives all panels the same time."""
    end = track.time[-1] if track.time[-1] > 0 else 1.0
    for axes, band in zip(rows, (track.speed, *filter(None, [track.altitude]), None), strict=False):
        axes.set_xlim(0, end)  # dots at the ends are seen
        without_box(axes)
        if band is None:
            continue
        for begin, last in spans(band.manoeuvres):
            axes.axvspan(begin, last, color=ORANGE, alpha=0.22, linewidth=0, zorder=0)
        finish(axes)
        for middle, row, kind in placed(track, band, _LETTERS):
            axes.annotate(kind, (middle, 1.0), (0, 3 + 10 * row), xycoords="axes fraction", textcoords="offset points",
                          ha="center", fontsize=SIZE - 1.5, color=BROWN, annotation_clip=False)  # fmt: skip
    for axes in rows[:-1]:
        axes.tick_params(labelbottom=False)
    rows[-1].set(xlabel=track.clock)
