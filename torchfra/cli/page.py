"""Cleaned tracks as an interactive page, with its script inside or, shared by several pages, beside it."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.summary import (
    COLUMNS,
    LEGEND,
    cells,
    headline,
    report,
    sentences_on_all,
    settings_lines,
    summary,
)
from torchfra.cleaning.outputs.view import SURE, Band, View, beyond, placed, view
from torchfra.cleaning.segments import spans
from torchfra.pictures import APART, BLUE, BROWN, GREY, ORANGE, PALE_BLUE, RED
from torchfra.running.atomic_write import write_text
from torchfra.tables import printable

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ font-family: sans-serif; margin: 1em auto; max-width: 1400px; padding: 0 1em; }}
summary {{ cursor: pointer; padding: .4em 0; }}
.chart {{ width: 100%; height: 1100px; }}
@media (max-width: 700px) {{ h1 {{ font-size: 1.3em; }} body {{ padding: 0 .3em; }} }}
h1, p, summary {{ overflow-wrap: anywhere; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; }}
th, td {{ padding: .2em .7em; text-align: right; white-space: nowrap; }}
th:first-child, td:first-child {{ text-align: left; }}
th {{ border-bottom: 1px solid; }}
</style>
{script}</head>
<body><h1>{title}</h1>
{settings}
{sections}
<script>
function draw(section) {{
  const place = section.querySelector(".chart");
  if (!section.open || place.dataset.drawn) return;
  const chart = JSON.parse(section.querySelector("script").textContent);
  Plotly.newPlot(place, chart.data, chart.layout, {{responsive: true, displaylogo: false}});
  place.dataset.drawn = "yes";
}}
document.querySelectorAll("details").forEach(section => {{
  section.addEventListener("toggle", () => draw(section));
  draw(section);
}});
document.querySelectorAll("a[href^='#']").forEach(link => link.addEventListener("click", () => {{
  document.getElementById(link.hash.slice(1)).open = true;
}}));
</script></body></html>
"""
_SECTION = """<details id="{name}"{opened}><summary>{title}</summary><div class="chart"></div>
<script type="application/json">{chart}</script></details>"""
_LETTERS = 60
"""Width of a panel in a narrow window, in characters."""
_TOP = 0.52
"""Upper end of the panels below the map, as a share of the height."""


def check_script() -> None:
    """Checks that plotly, which has the script, is installed.

    Raises:
        ImportError: plotly is missing.
    """
    try:
        import plotly.offline  # noqa: F401
    except ImportError:
        raise ImportError("html: a page needs plotly: pip install 'torchfra[html]'") from None


def script_beside(path: Path) -> Path:
    """The file of the script that pages in one folder share."""
    from plotly.offline import get_plotlyjs_version

    return path.with_name(f"plotly-{get_plotlyjs_version()}.min.js")


def write(results: Sequence[Cleaned], path: Path, *, share: bool = True) -> None:
    """Writes a page with a map and a table of all targets, and the chart of each, which is drawn when opened.

    Args:
        results: of the targets.
        path: of the page.
        share: whether the script, of some 5 MB, is a file beside the page, for all pages of the folder, or inside it.

    Raises:
        ImportError: plotly is missing.
        OSError: a file cannot be written.
    """
    check_script()
    from plotly.offline import get_plotlyjs

    beside = script_beside(path) if share else None
    if beside is not None:
        write_text(beside, get_plotlyjs())
    write_text(path, page(results, beside))


def page(results: Sequence[Cleaned], beside: Path | None = None) -> str:
    """The page as text, with its script inside, or in a file beside it."""
    from plotly.offline import get_plotlyjs

    script = f"<script>{get_plotlyjs()}</script>" if beside is None else f'<script src="{beside.name}"></script>'
    every = [summary(cleaned) for cleaned in results]
    sections = [
        _section(f"t{i}", headline(of), chart(cleaned), opened=len(results) == 1)
        for i, (of, cleaned) in enumerate(zip(every, results, strict=True))
    ]
    if len(results) > 1:
        sections = [_section("all", "all targets", overview(results), opened=True), _table(results, every), *sections]
    read = dict.fromkeys(note for cleaned in results for note in cleaned.recording.source.notes)
    said = report(results)[1:] if len(results) == 1 else sentences_on_all(results)
    lines = [f"Read: {'; '.join(read)}", *said, *settings_lines(results)] if read else [*said, *settings_lines(results)]
    return _PAGE.format(
        title=_text(results[0].recording.source.name or results[0].recording.name),
        script=script,
        settings="\n".join(f"<p>{_text(text)}</p>" for text in lines),
        sections="\n".join(sections),
    )


def _table(results: Sequence[Cleaned], every: Sequence[dict[str, Any]]) -> str:
    """A row for each target, which leads to its chart."""
    heads = "".join(f"<th>{name}</th>" for name in (results[0].recording.source.word, *COLUMNS))
    rows = "".join(
        f'<tr><td><a href="#t{i}">{_text(of["name"])}</a></td>'
        + "".join(f"<td>{_text(text)}</td>" for text in cells(of))
        + "</tr>"
        for i, of in enumerate(every)
    )
    table = f"<table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>"
    return f'<div class="wide">{table}</div>\n' + "\n".join(f"<p>{line}</p>" for line in LEGEND)


def _section(name: str, title: str, of: Chart, *, opened: bool) -> str:
    text = json.dumps(of._asdict(), allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    return _SECTION.format(name=name, opened=" open" if opened else "", title=_text(title), chart=text)


def _text(of: object) -> str:
    return html.escape(printable(str(of), 1000))


# ---------------------------------------------------------------- charts of plotly's script


class Chart(NamedTuple):
    """Arguments of ``Plotly.newPlot``."""

    data: list[dict[str, Any]]
    layout: dict[str, Any]


def chart(cleaned: Cleaned) -> Chart:
    """A map, and below it speed and altitude over time."""
    track = view(cleaned)
    panels: list[tuple[str, list[dict[str, Any]], list[float]]] = [
        ("speed, m/s", _band(track, track.speed, 2), [max(0.0, track.speed.limits()[0]), track.speed.limits()[1]])
    ]
    if track.altitude is not None:
        panels.append(("altitude, m", _band(track, track.altitude, 3), [*track.altitude.limits()]))
    layout = _layout(track.title) | _axes(track, {label: limits for label, _, limits in panels})
    bands = [(f"y{i + 2} domain", of) for i, of in enumerate(filter(None, [track.speed, track.altitude]))]
    layout["annotations"] = [
        _words(middle * track.time[-1], 1.0, kind, BROWN) | {"xref": "x2", "yref": domain, "yshift": 8 + 12 * row}
        for domain, band in bands
        for middle, row, kind in placed(track, band, _LETTERS)
    ]
    if sentence := beyond(track, *track.window)[2]:
        corner = {"xref": "paper", "yref": "paper", "xanchor": "left"}
        layout["annotations"].append(_words(0.0, 1.0, sentence, RED) | corner)
    layout["shapes"] = [
        {"type": "rect", "xref": "x2", "yref": domain, "x0": begin, "x1": end, "y0": 0, "y1": 1, "layer": "below",
         "fillcolor": ORANGE, "opacity": 0.22, "line": {"width": 0}}
        for domain, band in bands
        for begin, end in spans(band.manoeuvres)
    ]  # fmt: skip
    return Chart(_map(track, cleaned) + [line for _, lines, _ in panels for line in lines], layout)


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
        *(_manoeuvre(track, begin, end) for begin, end in spans(track.speed.manoeuvres)),
        _scatter(1, *track.recorded[kept].T, name="recorded", colour=GREY, marks=3, text=row[kept].tolist()),
        _scatter(1, *track.path.T, name="cleaned", colour=BLUE),
        _scatter(1, *track.recorded[rejected].T, name="rejected", colour=RED, marks=8, text=row[rejected].tolist(),
                 symbol="x-thin-open"),
    ]  # fmt: skip


def _manoeuvre(track: View, begin: float, end: float) -> dict[str, Any]:
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
        kept = np.isfinite(band.recorded) & ~(track.rejected if band.rejected is None else band.rejected)
        drawn.append(_scatter(number, track.time[kept], band.recorded[kept], colour=GREY, marks=3))
    return drawn


def _scatter(
    number: int, x: NDArray[np.float64], y: NDArray[np.float64], *, colour: str, name: str = "", marks: float = 0,
    symbol: str = "circle", **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """A line, or marks of some size, in the axes of a number; named ones are in the legend."""
    look: dict[str, Any] = {"mode": "lines", "line": {"color": colour, "width": 1.5}}
    if marks:
        look = {"mode": "markers", "marker": {"color": colour, "size": marks, "symbol": symbol}}
    axis = "" if number == 1 else str(number)
    return {
        "type": "scatter", "x": _list(x), "y": _list(y), "xaxis": "x" if number == 1 else "x2", "yaxis": f"y{axis}",
        "name": html.escape(printable(name, 50)), "showlegend": bool(name), **look, **more,
    }  # fmt: skip


def _list(values: NDArray[np.float64]) -> list[float | None]:
    """Values with seven digits, which suffice for a picture; None for NaN."""
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


def _axes(track: View, limits: dict[str, list[float]]) -> dict[str, Any]:
    """The axes of the map, and below it a common axis of time of panels, by their labels and limits."""
    (left, bottom), (right, top) = track.window
    axes: dict[str, Any] = {
        "xaxis": {"range": [left, right], "zeroline": False, "title": {"text": f"east, {track.unit}"}},
        "yaxis": {"range": [bottom, top], "domain": [_TOP + 0.1, 1], "scaleanchor": "x", "zeroline": False,
                  "title": {"text": f"north, {track.unit}"}},
        "xaxis2": {"range": [0, float(track.time[-1]) or 1.0], "title": {"text": track.clock},
                   "anchor": f"y{len(limits) + 1}"},
    }  # fmt: skip
    ends = np.linspace(_TOP, 0, len(limits) + 1).tolist()
    for number, (label, of) in enumerate(limits.items()):
        axes[f"yaxis{number + 2}"] = {
            "domain": [ends[number + 1] + 0.015, ends[number]], "range": of, "title": {"text": label}, "anchor": "x2",
        }  # fmt: skip
    return axes
