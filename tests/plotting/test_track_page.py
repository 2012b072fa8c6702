"""The page holds all that it needs, and a browser draws it."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from cleaned_tracks import straight

pytest.importorskip("plotly", reason="needs plotly")

from torchfra.cli import page

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def charts(text):
    return [json.loads(found) for found in re.findall(r'<script type="application/json">(.*?)</script>', text, re.S)]


def test_a_page_has_a_chart_of_all_targets_and_one_of_each_and_needs_nothing_else():
    text = page.page([straight(30, name="a"), straight(20, name="b")])
    every, first, second = charts(text)
    assert [line["name"] for line in every["data"]] == ["a", "b"]
    assert "30 fixes" in first["layout"]["title"]["text"]
    assert "20 fixes" in second["layout"]["title"]["text"]
    assert len(charts(page.page([straight(20)]))) == 1
    assert not re.findall(r"<(?:script|link|img)[^>]+(?:src|href)=", text)


def test_a_chart_shows_the_map_speed_and_altitude_of_the_picture():
    of = straight(30, off=3.5e6)
    (chart,) = charts(page.page([of]))
    named = {line["name"]: line for line in chart["data"] if line["name"]}
    assert named.keys() == {"cleaned", "recorded", "rejected", "within 2 std"}
    np.testing.assert_allclose(named["rejected"]["x"], of.raw[7, 0] / 1000, rtol=1e-5)
    assert np.ptp(chart["layout"]["xaxis"]["range"]) < 20
    assert [note["text"] for note in chart["layout"]["annotations"]] == [
        "left turn, 2.5 deg/s", "outside: 1 rejected, up to 4,950 km off"
    ]  # fmt: skip
    assert [(shade["x0"], shade["x1"]) for shade in chart["layout"]["shapes"]] == [(10.0, 30.0)]
    titles = [axis["title"]["text"] for name, axis in chart["layout"].items() if name.startswith("yaxis")]
    assert titles == ["north, km", "speed, m/s", "altitude, m"]


def test_several_targets_have_a_table_that_links_to_each():
    text = page.page([straight(30, name="<a>"), straight(20, name="b")])
    rows = re.findall(r"<tr>(<td.*?)</tr>", text)
    assert [re.search(r'<a href="#(\w+)">(.*?)</a>', row).groups() for row in rows] == [
        ("t0", "&lt;a&gt;"),
        ("t1", "b"),
    ]
    assert [re.findall(r"<td>(\d+)</td>", row)[0] for row in rows] == ["30", "20"]
    assert {"t0", "t1"} <= set(re.findall(r'<details id="(\w+)"', text))
    assert len(re.findall("<th>", text)) == len(re.findall("<td", rows[0]))
    assert "<table>" not in page.page([straight(20)])


def test_a_page_is_as_wide_as_the_screen_of_a_phone():
    assert '<meta name="viewport" content="width=device-width' in page.page([straight(20)])


def test_pages_of_a_folder_share_their_script(tmp_path):
    for name in ("a.html", "b.html"):
        page.write([straight(20)], tmp_path / name, share=True)
    script = page.script_beside(tmp_path / "a.html")
    assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "a.html", tmp_path / "b.html", script])
    text = (tmp_path / "b.html").read_text(encoding="utf-8")
    assert f'<script src="{script.name}"></script>' in text
    assert len(text) < 100_000 < script.stat().st_size


def test_strange_names_and_numbers_do_no_harm():
    of = straight(10, name="</script><b>&\ud800$")
    of.mean[3] = np.nan
    text = page.page([of])
    assert "</script><b>" not in text
    assert len(charts(text)) == 1


@pytest.mark.skipif(BROWSER is None, reason="needs a browser: apt-get install chromium")
@pytest.mark.parametrize("share", [False, True])
def test_a_browser_draws_the_page_without_complaint(tmp_path, share):
    page.write([straight(30)], tmp_path / "p.html", share=share)
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000", "--enable-logging=stderr",
               "--v=0", f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom"]  # fmt: skip
    url = f"file://{tmp_path}/p.html"
    done = subprocess.run([BROWSER, *options, url], capture_output=True, text=True, timeout=120, check=True)
    assert "Uncaught" not in done.stderr
    drawn = re.sub(r"<script>.*?</script>", "", done.stdout, flags=re.S)
    assert 'data-drawn="yes"' in drawn
    assert len(re.findall(r'<g class="trace scatter', drawn)) >= 12
    assert "left turn, 2.5 deg/s" in drawn
