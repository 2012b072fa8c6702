"""What a picture of a cleaned track shows, as a chart of plotly's script."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.colours import APART, BLUE, BROWN, DARK, GREY, ORANGE, PALE_BLUE, RED, REGIMES
from torchfra.cleaning.outputs.view import MOST_STD, SURE, Band, View, beyond, placed, view
from torchfra.tables import printable

_LETTERS = 60
"""Characters of the name of a manoeuvre that are as wide as a panel of a narrow window."""
_MOST_MARKS = 50
"""Rejected fixes that are marked at the edge of the map."""


class Chart(NamedTuple):
    """Arguments of ``Plotly.newPlot``."""

    data: list[dict[str, Any]]
    layout: dict[str, Any]


def chart(cleaned: Cleaned) -> Chart:
    """A map on the left, and speed, altitude, innovations and regimes over time on the right."""
    track = view(cleaned)
    rows = ["speed, m/s", *(["altitude, m"] if track.altitude else []), "innovation, std"]
    rows += ["probability"] if track.regimes else []
    data = _map(track, cleaned) + _band(track, track.speed, 2)
    if track.altitude is not None:
        data += _band(track, track.altitude, 3)
    data += _innovations(track, 3 + (track.altitude is not None))
    data += _regimes(track, len(rows) + 1)
    layout = _layout(track.title) | _map_axes(track) | _time_axes(track, rows)
    edge, _, said = beyond(track, *track.window)
    layout["annotations"] = [_words(x, y, "\u25b2", RED) for x, y in edge[:_MOST_MARKS].tolist()] + [
        _words(middle * track.time[-1], 1.0, kind, BROWN) | {"xref": "x2", "yref": "paper", "yshift": 8 + 12 * row}
        for middle, row, kind in placed(track, _LETTERS)
    ]
    if said:
        layout["annotations"] += [_words(0.0, 1.0, said, RED) | {"xref": "paper", "yref": "paper", "xanchor": "left"}]
    layout["shapes"] = [
        {"type": "rect", "xref": "x2", "yref": "paper", "x0": begin, "x1": end, "y0": 0, "y1": 1, "layer": "below",
         "fillcolor": ORANGE, "opacity": 0.22, "line": {"width": 0}}
        for begin, end in track.shades
    ]  # fmt: skip
    return Chart(data, layout)


def overview(results: Sequence[Cleaned]) -> Chart:
    """All tracks on one map."""
    views = [view(cleaned) for cleaned in results]
    metres = max(track.metres for track in views)
    data = [
        _scatter(1, *(track.path * track.metres / metres).T, name=cleaned.recording.name, colour=APART[i % len(APART)])
        for i, (cleaned, track) in enumerate(zip(results, views, strict=True))
    ]
    unit = "km" if metres > 1 else "m"
    east, north = ({"title": {"text": f"{way}, {unit}"}} for way in ("east", "north"))
    return Chart(data, _layout(f"{len(results)} tracks") | {"xaxis": east, "yaxis": north | {"scaleanchor": "x"}})


def _map(track: View, cleaned: Cleaned) -> list[dict[str, Any]]:
    good = np.isfinite(track.sides).all((1, 2))
    band = np.concatenate([track.sides[good, 0], track.sides[good, 1][::-1]])
    rejected = track.rejected
    kept = np.isfinite(track.recorded).all(1) & ~rejected
    row = np.char.add("row ", cleaned.row.astype(str))
    return [
        _scatter(1, *band.T, name=f"within {SURE:g} std", colour=PALE_BLUE, fill="toself", hoverinfo="skip"),
        *(_flown(track, begin, end) for begin, end in track.shades),
        _scatter(1, *track.recorded[kept].T, name="recorded", colour=GREY, marks=3, text=row[kept].tolist()),
        _scatter(1, *track.path.T, name="cleaned", colour=BLUE),
        _scatter(1, *track.recorded[rejected].T, name="rejected", colour=RED, marks=8, text=row[rejected].tolist(),
                 symbol="x-thin-open"),
    ]  # fmt: skip


def _flown(track: View, begin: float, end: float) -> dict[str, Any]:
    """The path of a manoeuvre, wide and below the path."""
    part = track.path[(track.time >= begin) & (track.time <= end)]
    return _scatter(1, *part.T, colour=ORANGE, line={"color": ORANGE, "width": 6}, hoverinfo="skip")


def _band(track: View, band: Band, number: int) -> list[dict[str, Any]]:
    low, high = band.mean - SURE * band.std, band.mean + SURE * band.std
    drawn = [
        _scatter(number, track.time, low, colour=PALE_BLUE, hoverinfo="skip"),
        _scatter(number, track.time, high, colour=PALE_BLUE, fill="tonexty", hoverinfo="skip"),
        _scatter(number, track.time, band.mean, colour=BLUE),
    ]
    if band.recorded is not None:
        kept = np.isfinite(band.recorded) & ~track.rejected
        drawn.append(_scatter(number, track.time[kept], band.recorded[kept], colour=GREY, marks=3))
    return drawn


def _innovations(track: View, number: int) -> list[dict[str, Any]]:
    shown, known = np.minimum(track.innovation, MOST_STD), np.isfinite(track.innovation)
    rejected, high = track.rejected, track.innovation > MOST_STD
    looks = (
        (known & ~rejected & ~high, DARK, 3, "circle"), (known & rejected & ~high, RED, 6, "x-thin-open"),
        (known & ~rejected & high, DARK, 8, "triangle-up"), (known & rejected & high, RED, 8, "triangle-up"),
    )  # fmt: skip
    return [
        _scatter(number, track.time[mask], shown[mask], colour=colour, marks=size, symbol=symbol)
        for mask, colour, size, symbol in looks
    ]


def _regimes(track: View, number: int) -> list[dict[str, Any]]:
    colours = [DARK if name == "others" else colour for name, colour in zip(track.regimes, REGIMES, strict=False)]
    return [
        _scatter(number, track.time, values, name=name, colour=colour, stackgroup="regimes", fillcolor=colour)
        for (name, values), colour in zip(track.regimes.items(), colours, strict=False)
    ]


def _scatter(
    number: int, x: NDArray[np.float64], y: NDArray[np.float64], *, colour: str, name: str = "", marks: float = 0,
    symbol: str = "circle", **others: Any,
) -> dict[str, Any]:  # fmt: skip
    """A line, or marks of some size, in the axes of a number; named ones are in the legend."""
    look: dict[str, Any] = {"mode": "lines", "line": {"color": colour, "width": 0 if "stackgroup" in others else 1.5}}
    if marks:
        look = {"mode": "markers", "marker": {"color": colour, "size": marks, "symbol": symbol}}
    axis = "" if number == 1 else str(number)
    return {
        "type": "scatter", "x": _list(x), "y": _list(y), "xaxis": "x" if number == 1 else "x2", "yaxis": f"y{axis}",
        "name": html.escape(printable(name, 50)), "showlegend": bool(name), **look, **others,
    }  # fmt: skip


def _list(values: NDArray[np.float64]) -> list[float | None]:
    """Six digits are enough for a picture."""
    return [float(f"{v:.7g}") if np.isfinite(v) else None for v in values.tolist()]


def _words(x: float, y: float, text: str, colour: str) -> dict[str, Any]:
    return {"x": x, "y": y, "text": html.escape(text), "showarrow": False, "font": {"color": colour, "size": 10}}


def _layout(title: str) -> dict[str, Any]:
    return {
        "title": {"text": html.escape(printable(title, 100)), "font": {"size": 15}},
        "plot_bgcolor": "white",
        "hovermode": "closest",
        "legend": {"orientation": "h", "y": -0.08},
        "margin": {"t": 60, "r": 20, "l": 60, "b": 40},
    }


def _map_axes(track: View) -> dict[str, Any]:
    (left, bottom), (right, top) = track.window
    east = {"domain": [0, 0.48], "range": [left, right], "zeroline": False, "title": {"text": f"east, {track.unit}"}}
    north = {"range": [bottom, top], "scaleanchor": "x", "zeroline": False, "title": {"text": f"north, {track.unit}"}}
    return {"xaxis": east, "yaxis": north}


def _time_axes(track: View, rows: Sequence[str]) -> dict[str, Any]:
    """One time for all panels, the first on top."""
    high, gap = 1 / len(rows), 0.03
    axes: dict[str, Any] = {
        "xaxis2": {"domain": [0.55, 1], "range": [0, float(track.time[-1]) or 1.0], "title": {"text": track.clock},
                   "anchor": f"y{len(rows) + 1}"}
    }  # fmt: skip
    for i, label in enumerate(rows):
        top = 1 - i * high
        axes[f"yaxis{i + 2}"] = {"domain": [top - high + gap, top], "title": {"text": label}, "anchor": "x2"}
    if track.altitude is not None:
        axes["yaxis3"]["range"] = list(track.altitude.limits())
    axes["yaxis2"]["range"] = [max(0.0, track.speed.limits()[0]), track.speed.limits()[1]]
    axes[f"yaxis{rows.index('innovation, std') + 2}"]["range"] = [0, 1.05 * MOST_STD]
    return axes
