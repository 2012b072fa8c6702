"""`torchfra track` writes what it is asked for, where it is asked to, and never over its input."""

import csv
import json

import numpy as np
import pytest
from cleaned_tracks import straight

from torchfra import readers
from torchfra.cleaning import clean_tracks
from torchfra.cli import main as cli
from torchfra.cli import page
from torchfra.cli.plan import MOST_PICTURES, plan

QUICK = ["--filter", "srckf", "--sigma", "25", "--q", "1", "--bank", "aircraft"]


@pytest.fixture
def flight(tmp_path):
    """A straight flight of 60 fixes, 25 m of noise, one fix 3 km off at the 40th."""
    rng, time = np.random.default_rng(0), np.arange(60) * 4.0
    xy = np.stack([100 * time, 50 * time], 1) + 25 * rng.standard_normal((60, 2))
    xy[40] += 3000
    path = tmp_path / "flight.csv"
    path.write_text("t,x,y\n" + "".join(f"{t},{x},{y}\n" for t, (x, y) in zip(time, xy, strict=True)))
    return path


@pytest.fixture
def two_flights(tmp_path):
    """Two targets with latitudes, of ten fixes each."""
    path = tmp_path / "flights.json"
    path.write_text(json.dumps([
        {"timestamp": 1_714_730_400_000 + 1000 * k, "latitude": 48 + i + 1e-3 * k, "longitude": 2.0, "altitude": 3000,
         "icao24": name} for i, name in enumerate(("aaa", "bbb")) for k in range(10)
    ]))  # fmt: skip
    return path


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_track_writes_a_table_a_picture_and_a_summary(flight, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out"), "--json", str(tmp_path / "s.json")]
    assert cli.main(["track", str(flight), "--sigma", "25", "--q", "1", *out]) == 0
    rows = list(csv.DictReader((tmp_path / "out/flight.csv").read_text().splitlines()))
    assert [int(row["row"]) for row in rows] == list(range(60))
    assert [row["row"] for row in rows if row["flag"] == "outlier"] == ["40"]
    assert float(rows[40]["outlier"]) > 0.9
    assert abs(float(rows[40]["x"]) - 100 * 160) < 300 < abs(float(rows[40]["raw_x"]) - 100 * 160)
    assert (tmp_path / "out/flight.png").read_bytes().startswith(b"\x89PNG")
    (said,) = json.loads((tmp_path / "s.json").read_text())["tracks"]
    assert (said["fixes"], said["flags"]["outlier"], said["filter"]) == (60, 1, "gpb")
    said = capsys.readouterr().out.splitlines()
    assert "flight: 60 fixes in 3.9 min, 1 rejected (up to 4.2 km off)" in said
    written = ", ".join(str(tmp_path / name) for name in ("out/flight.csv", "out/flight.meta.json", "out/flight.png"))
    assert said[-1] == f"Written: {written}, {tmp_path / 's.json'}"


def test_a_folder_has_a_table_of_each_target_and_a_file_one_of_all(two_flights, tmp_path):
    def run(*options):
        return cli.main(["track", str(two_flights), *QUICK, "--no-plots", "--quiet", *options])

    assert run("--out", str(tmp_path / "out")) == 0
    assert names(tmp_path / "out") == ["aaa.csv", "aaa.meta.json", "bbb.csv", "bbb.meta.json"]
    assert run("--out", str(tmp_path / "kml"), "--format", "kml") == 0
    assert names(tmp_path / "kml") == ["aaa.kml", "aaa.meta.json", "bbb.kml", "bbb.meta.json"]
    assert run("--out", str(tmp_path / "one/all.csv")) == 0
    assert names(tmp_path / "one") == ["all.csv", "all.meta.json"]
    rows = list(csv.DictReader((tmp_path / "one/all.csv").read_text().splitlines()))
    assert [row["id"] for row in rows] == ["aaa"] * 10 + ["bbb"] * 10
    assert abs(float(rows[3]["latitude"]) - 48.003) < 1e-3
    found = json.loads((tmp_path / "one/all.meta.json").read_text())
    assert [track["name"] for track in found["tracks"]] == ["aaa", "bbb"]


def test_the_input_is_never_written_to(flight, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("torchfra.cli.track_command.clean_tracks", None)
    before = flight.read_bytes()
    for options in (["--out", str(tmp_path)], ["--out", str(flight)], ["--out", "new", "--json", str(flight)]):
        assert cli.main(["track", str(flight), *options]) == 2
        said = capsys.readouterr().err
        assert f"expected a file of its own, received the input {flight}" in said
        assert said.count("\n") == 1
    assert flight.read_bytes() == before
    assert names(tmp_path) == ["flight.csv"]


@pytest.mark.parametrize(("count", "plots", "pictures"), [
    (1, None, 1), (2, None, 2), (MOST_PICTURES + 1, None, 0), (MOST_PICTURES + 1, True, 21), (2, False, 0),
])  # fmt: skip
def test_there_is_one_picture_of_each_of_a_few_targets(count, plots, pictures, tmp_path):
    recordings = [straight(3, name=f"a {i}").recording for i in range(count)]
    for out in (tmp_path, tmp_path / "all.csv"):
        files = plan(recordings, out, None, plots)
        assert len(files.pictures) == len(set(files.pictures.values())) == pictures
        assert len(files.tables) == (count if out == tmp_path else 1)
        beside = "" if out == tmp_path else "all" if count == 1 else "all-a_"
        assert all(path.name.startswith(beside) for path in files.pictures.values())


def test_a_page_is_written_beside_the_table(flight, tmp_path):
    pytest.importorskip("plotly", reason="needs plotly")
    out = ["--no-plots", "--quiet", "--out", str(tmp_path / "a.csv"), "--html", str(tmp_path / "a.html")]
    assert cli.main(["track", str(flight), *QUICK, *out]) == 0
    assert names(tmp_path) == [
        "a.csv",
        "a.html",
        "a.meta.json",
        "flight.csv",
        page.script_beside(tmp_path / "a.html").name,
    ]
    assert (tmp_path / "a.html").read_text().count(" open><summary>") == 1


def test_without_plotly_a_page_is_refused_before_any_work(flight, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "plotly.offline", None)
    assert cli.main(["track", str(flight), "--html", str(tmp_path / "a.html")]) == 2
    assert capsys.readouterr().err == "torchfra: error: html: a page needs plotly: pip install 'torchfra[html]'\n"


@pytest.mark.parametrize("smooth", [True, False])
def test_estimates_between_the_fixes_have_no_row(flight, smooth):
    told = {"sigma": 25.0, "q": 1.0, "filter": "srckf", "smooth": smooth}
    (result,) = clean_tracks(readers.read(flight), dt=1.0, **told)
    np.testing.assert_array_equal(result.row < 0, np.arange(len(result.time)) % 4 != 0)
    assert np.isfinite(result.position).all()


def test_what_the_settings_were_is_said_once_for_all_targets(two_flights, tmp_path, capsys):
    assert (
        cli.main(
            ["track", str(two_flights), *QUICK, "--no-smooth", "--no-plots", "--verbose", "--out", str(tmp_path / "o")]
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("srckf, on line, for aircraft") for line in lines) == 1
    assert [line.split()[0] for line in lines if line.startswith(("aaa", "bbb"))] == ["aaa", "bbb"]


def test_help_teaches_by_examples_that_run(capsys, flight, tmp_path, monkeypatch):
    with pytest.raises(SystemExit):
        cli.main(["track", "--help"])
    said = capsys.readouterr().out
    examples = [line.split("#")[0].split()[1:] for line in said.splitlines() if line.startswith("  torchfra track")]
    assert len(examples) >= 5
    monkeypatch.setattr("torchfra.cli.track_command.run", lambda options: None)
    for words in examples:
        assert cli.main(words) == 0
