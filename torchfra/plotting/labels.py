"""Words beside what they name, so that no legend is needed: at the ends of lines, and in free places of a map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchfra.numbers import Array
from torchfra.plotting.style import finish, lay_out, words

SIZE = 9
"""Size of the letters, points."""
_WIDE, _HIGH = 0.6 * SIZE, 1.3 * SIZE
"""Width and height of a letter, points."""
_ANCHORS = 15
"""Number of places along a line from which the one that its label points to is chosen."""
_DISTANCES = (9.0, 16.0, 26.0, 40.0, 60.0)
"""Distances of a label from its anchor that are tried, points."""
_POINTS = 150
"""Number of points of a line or of marks that labels avoid, evenly chosen."""
_SEPARATE = 25.0
"""Points of distance to everything else beyond which a line is not easier to distinguish."""


def spread_apart(places: Sequence[float], gap: float) -> list[float]:
    """Places from 0 to 1 as near as possible to ``places``, in the same order and ``gap`` or more apart.

    If there is not enough room, they are evenly spaced from 0 to 1.
    """
    count = len(places)
    gap = min(gap, 1 / max(count - 1, 1))
    order = np.argsort(places, kind="stable")
    groups: list[tuple[float, int]] = []  # of labels that touch: the mean of their offsets, and how many there are
    for rank, i in enumerate(order):
        groups.append((places[i] - gap * rank, 1))
        while len(groups) > 1 and groups[-1][0] < groups[-2][0]:
            (mean, size), (before, others) = groups.pop(), groups.pop()
            groups.append(((mean * size + before * others) / (size + others), size + others))
    offsets = np.repeat([mean for mean, _ in groups], [size for _, size in groups])
    spread = np.empty(count)
    spread[order] = np.clip(offsets, 0.0, 1.0 - gap * (count - 1)) + gap * np.arange(count)
    return [float(place) for place in spread]


def at_ends(axes: Axes, ends: Mapping[str, float], colours: Mapping[str, str]) -> None:
    """Names to the right of the axes, each level with the end of its line or close by, and a thin line to it.

    Args:
        axes: with its limits along y, in a figure that has its layout.
        ends: by name, where the line ends along y; outside of the limits its name is at the edge.
        colours: by name.
    """
    x, inside = axes.get_xlim()[1], np.clip(list(ends.values()), *axes.get_ylim())
    to_axes = axes.transData + axes.transAxes.inverted()
    level = [float(to_axes.transform((x, y))[1]) for y in inside]
    gap = _HIGH * axes.figure.dpi / 72 / axes.get_window_extent().height
    for name, y, place in zip(ends, level, spread_apart(level, gap), strict=True):
        axes.annotate(words(name), (1.0, y), (1.025, place), xycoords="axes fraction", textcoords="axes fraction",
                      va="center", fontsize=SIZE, color=colours[name], annotation_clip=False,
                      arrowprops={"arrowstyle": "-", "color": colours[name], "linewidth": 0.7, "shrinkA": 0,
                                  "shrinkB": 0, "relpos": (0.0, 0.5)})  # fmt: skip


def show(axes: Axes, low: Array, high: Array) -> tuple[Array, Array]:
    """Gives a map limits around a window, wide or high enough for the same scale along both axes, and returns them.

    Args:
        axes: in a figure that has its layout.
        low: ``(2,)`` lower left corner.
        high: ``(2,)`` upper right corner.
    """
    box = axes.get_window_extent()
    size = np.array([box.width, box.height])
    half = 0.5 * size * ((high - low) / size).max()
    low, high = (low + high) / 2 - half, (low + high) / 2 + half
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return low, high


def named(figure: Figure, lines: Mapping[Axes, Mapping[str, Line2D]]) -> Figure:
    """The figure with a grid in some axes, and to the right of each the names of its lines, in their colours.

    Args:
        figure: finished except for these; it gets its layout.
        lines: of each of the axes, by name.
    """
    for axes in lines:
        finish(axes)
    lay_out(figure)  # labels are put where there is room, which the layout decides
    for axes, of in lines.items():
        ends = {name: _end(line) for name, line in of.items()}
        at_ends(axes, ends, {name: str(line.get_color()) for name, line in of.items()})
    lay_out(figure)
    return figure


def beside(axes: Axes, colours: Mapping[str, str]) -> None:
    """Names of areas to the right of the axes, one above the other, each after a square in its colour."""
    for i, (name, colour) in enumerate(colours.items()):
        place = (1.0, (i + 0.5) / len(colours))
        for text, shift, shade in (("\u25a0", 4, colour), (words(name, 24), 14, "black")):
            axes.annotate(text, place, (shift, 0), xycoords="axes fraction", textcoords="offset points", color=shade,
                          va="center", fontsize=SIZE - 1, annotation_clip=False)  # fmt: skip


def _end(line: Line2D) -> float:
    """The last finite y value of a line."""
    values = np.asarray(line.get_ydata(), dtype=float)
    known = values[np.isfinite(values)]
    return float(known[-1]) if len(known) else np.inf


def in_free_places(axes: Axes, points: Mapping[str, Array], colours: Mapping[str, str]) -> None:
    """Names near what they name, where little else is drawn, each with a thin line to it.

    Args:
        axes: with its limits, in a figure that has its layout.
        points: by name, ``(k, 2)`` what is drawn, in data coordinates; NaN and what is out of the axes do not count,
            and what is nowhere gets no label.
        colours: by name.
    """
    scale = 72 / axes.figure.dpi
    box = axes.get_window_extent()
    corner, size = np.array([box.x0, box.y0]) * scale, np.array([box.width, box.height]) * scale
    drawn = {}
    for name, of in points.items():
        place = axes.transData.transform(of) * scale - corner
        place = place[((place >= 0) & (place <= size)).all(1)]
        if len(place):
            drawn[name] = place[:: -(-len(place) // _POINTS)]
    taken: list[Array] = []
    for name, own in drawn.items():
        others = np.concatenate([of for other, of in drawn.items() if other != name] or [np.empty((0, 2))])
        half = 0.5 * np.array([_WIDE * len(name), _HIGH])
        anchor, centre = _best_place(own, others, half, size, taken)
        taken.append(np.concatenate([centre - half, centre + half]))
        at, beside = (tuple((place / size).tolist()) for place in (anchor, centre))
        axes.annotate(words(name), at, beside, xycoords="axes fraction", textcoords="axes fraction",
                      ha="center", va="center", fontsize=SIZE, color=colours[name], zorder=9,
                      arrowprops={"arrowstyle": "-", "color": colours[name], "linewidth": 0.7, "shrinkA": 0,
                                  "shrinkB": 0, "relpos": (0.5, 0.5)})  # fmt: skip


def _best_place(own: Array, others: Array, half: Array, size: Array, taken: Sequence[Array]) -> tuple[Array, Array]:
    """Which point of ``own (k, 2)`` a label points to, and the label's centre: both ``(2,)``, points from the corner.

    The label of half size ``half`` covers as little as possible of what is drawn and nothing of the labels before it,
    and points to where ``own`` is easiest to distinguish.
    """
    anchors = own[np.unique(np.linspace(0, len(own) - 1, _ANCHORS).round().astype(int))]
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ways = np.stack([np.cos(angles), np.sin(angles)], 1)
    reach = np.array(_DISTANCES)[:, None, None] * ways + half * ways  # (distances, ways, 2)
    anchor, centre = np.broadcast_arrays(anchors[:, None, None], anchors[:, None, None] + reach)
    anchor, centre = anchor.reshape(-1, 2), centre.reshape(-1, 2)
    apart = np.linalg.norm(anchors[:, None] - others, axis=-1).min(1, initial=_SEPARATE)
    cost = 2 * (_SEPARATE - np.repeat(apart, len(angles) * len(_DISTANCES)))
    cost += np.tile(np.repeat(_DISTANCES, len(angles)), len(anchors))
    cost += 8 * (np.abs(np.concatenate([own, others]) - centre[:, None]) < half + 2).all(-1).sum(1)
    cost += 1e4 * ((centre - half < 2) | (centre + half > size - 2)).any(1)
    for box in taken:
        cost += 1e3 * ((centre - half < box[2:] + 2) & (centre + half > box[:2] - 2)).all(1)
    best = int(cost.argmin())
    return anchor[best], centre[best]
