"""Cleaned tracks as one interactive page: its script is inside, or beside it for several pages."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.summary import COLUMNS, LEGEND, cells, headline, settings_lines, summary
from torchfra.cli.charts import Chart, chart, overview
from torchfra.running.atomic_write import write_text
from torchfra.tables import printable

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ font-family: sans-serif; margin: 1em auto; max-width: 1400px; padding: 0 1em; }}
summary {{ cursor: pointer; padding: .4em 0; }}
.chart {{ width: 100%; height: 760px; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; }}
th, td {{ padding: .2em .7em; text-align: right; white-space: nowrap; }}
th:first-child, td:first-child {{ text-align: left; }}
th {{ cursor: pointer; border-bottom: 1px solid; }}
</style>
{script}</head>
<body><h1>{title}</h1>
{said}
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
document.querySelectorAll("th").forEach((head, column) => head.addEventListener("click", () => {{
  const body = head.closest("table").tBodies[0], down = head.dataset.down !== "yes";
  head.dataset.down = down ? "yes" : "no";
  const key = row => Number(row.cells[column].dataset.key);
  [...body.rows].sort((a, b) => (down ? -1 : 1) * (key(a) - key(b))).forEach(row => body.append(row));
}}));
document.querySelectorAll("a[href^='#']").forEach(link => link.addEventListener("click", () => {{
  document.getElementById(link.hash.slice(1)).open = true;
}}));
</script></body></html>
"""
_SECTION = """<details id="{name}"{opened}><summary>{said}</summary><div class="chart"></div>
<script type="application/json">{chart}</script></details>"""


def check_script() -> None:
    """Checks that the script is there.

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


def write(results: Sequence[Cleaned], path: Path, *, share: bool = False) -> None:
    """Writes a page with a map of all targets, and what a picture of each one shows; charts are drawn when opened.

    Args:
        results: of the targets.
        path: of the page.
        share: whether the script, of some 5 MB, is beside the page, where other pages find it, and not inside.

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
    return _PAGE.format(
        title=_text(results[0].recording.source.name or results[0].recording.name),
        script=script,
        said="\n".join(f"<p>{_text(text)}</p>" for text in settings_lines(results)),
        sections="\n".join(sections),
    )


def _table(results: Sequence[Cleaned], every: Sequence[dict[str, Any]]) -> str:
    """A row for each target, sorted by a column when its head is clicked."""
    heads = "".join(f"<th>{name}</th>" for name in (results[0].recording.source.word, *COLUMNS))
    rows = "".join(
        f'<tr><td data-key="{-i}"><a href="#t{i}">{_text(of["name"])}</a></td>'
        + "".join(f'<td data-key="{number:.9g}">{_text(text)}</td>' for number, text in cells(of))
        + "</tr>"
        for i, of in enumerate(every)
    )
    table = f"<table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>"
    return f'<div class="wide">{table}</div>\n' + "\n".join(f"<p>{line}</p>" for line in LEGEND)


def _section(name: str, said: str, of: Chart, *, opened: bool) -> str:
    text = json.dumps(of._asdict(), allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    return _SECTION.format(name=name, opened=" open" if opened else "", said=_text(said), chart=text)


def _text(of: Any) -> str:
    return html.escape(printable(str(of), 1000))
