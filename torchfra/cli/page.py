"""Cleaned tracks as one page to look around in, which needs nothing else: the script that draws it is inside."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.summary import headline, settings_lines, summary
from torchfra.cli.charts import Chart, chart, overview
from torchfra.running.atomic_write import write_text
from torchfra.tables import printable

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font-family: sans-serif; margin: 1em auto; max-width: 1400px; }}
summary {{ cursor: pointer; padding: .4em 0; }}
.chart {{ width: 100%; height: 760px; }}
</style>
<script>{script}</script></head>
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
</script></body></html>
"""
_SECTION = """<details{opened}><summary>{said}</summary><div class="chart"></div>
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


def write(results: Sequence[Cleaned], path: Path) -> None:
    """Writes a page with a map of all targets, and what a picture of each one shows; charts are drawn when opened.

    Raises:
        ImportError: plotly is missing.
        OSError: the page cannot be written.
    """
    check_script()
    write_text(path, page(results))


def page(results: Sequence[Cleaned]) -> str:
    """The page as text."""
    from plotly.offline import get_plotlyjs

    several = len(results) > 1
    sections = [_section("all targets", overview(results), opened=True)] if several else []
    sections += [_section(headline(summary(cleaned)), chart(cleaned), opened=not several) for cleaned in results]
    return _PAGE.format(
        title=_text(results[0].recording.source.name or results[0].recording.name),
        script=get_plotlyjs(),
        said="\n".join(f"<p>{_text(text)}</p>" for text in settings_lines(results)),
        sections="\n".join(sections),
    )


def _section(said: str, of: Chart, *, opened: bool) -> str:
    text = json.dumps(of._asdict(), allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    return _SECTION.format(opened=" open" if opened else "", said=_text(said), chart=text)


def _text(of: Any) -> str:
    return html.escape(printable(str(of), 1000))
