"""A data set of tracks is cleaned part by part: each target once and whole, whenever and however often it is ended."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import many as script
import numpy as np
import pytest
from two_processes import forked

from torchfra import readers
from torchfra.cleaning import clean_tracks, many
from torchfra.cleaning.outputs import columns
from torchfra.cli import main as cli
from torchfra.cli import many_command
from torchfra.readers.datasets import open_data
from torchfra.running.distributed import launched
from torchfra.running.progress import progress_bar

pyarrow = pytest.importorskip("pyarrow")
from pyarrow import dataset, parquet  # noqa: E402

FIXES = 60
"""So many that a track has a sigma of its own, whatever else is in its part."""
NAMES = [f"a{i:05x}" for i in range(6)]


def flight(i, fixes=FIXES):
    """Straight flights far apart, with noise of 20 m."""
    rng, time = np.random.default_rng(i), 1.7e9 + i + 5.0 * np.arange(fixes)
    north, east = (200 * (time - time[0]) + 20 * rng.standard_normal(fixes) for _ in range(2))
    return {"time": time, "icao24": [NAMES[i]] * fixes, "lat": 10.0 * i - 40 + north / 111e3,
            "lon": 20.0 * i + east / 111e3, "geoaltitude": 9000 + 10 * rng.standard_normal(fixes)}  # fmt: skip


def table_of(flights):
    """All rows in the order of time."""
    table = pyarrow.concat_tables([pyarrow.table(flight) for flight in flights])
    return table.sort_by("time")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Four flights, two of each part, mixed over three files, one of them below."""
    table, folder = table_of(map(flight, range(2, 6))), tmp_path_factory.mktemp("data") / "flights"
    (folder / "later").mkdir(parents=True)
    for name, first, last in (("b", 50, 150), ("a", 0, 50), ("later/c", 150, 240)):
        write(table.slice(first, last - first), folder / f"{name}.parquet")
    return folder


def write(table, path):
    """A file whose bytes are as many whatever the numbers are."""
    parquet.write_table(table, path, compression="none", use_dictionary=False)


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """What becomes of them where nothing goes wrong."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert clean(data, out) == 0
    return out


def clean(data, out, *options, rows="120"):
    return cli.main(["many", str(data), "--out", str(out), "--rows", rows, *options])


def rows_of(out):
    """All that was written, by id and time."""
    return dataset.dataset(out, format="parquet").to_table().sort_by([("id", "ascending"), ("seconds", "ascending")])


def check_equal(one, other):
    assert one.schema == other.schema
    for name in one.column_names:
        if pyarrow.types.is_floating(one.schema.field(name).type):
            a, b = (table.column(name).to_numpy() for table in (one, other))
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6, err_msg=name)
        else:
            assert one.column(name).equals(other.column(name)), name


# ---------------------------------------------------------------- what is there


@pytest.mark.slow
def test_every_row_of_every_target_is_there_once(data, whole):
    found, files = rows_of(whole), [data / f"{name}.parquet" for name in ("a", "b", "later/c")]
    given = pyarrow.concat_tables([parquet.read_table(file) for file in files])
    assert sorted(found.column("row").to_pylist()) == list(range(4 * FIXES))
    same = given.take(found.column("row"))
    assert same.column("icao24").equals(found.column("id"))
    np.testing.assert_allclose(same.column("lat"), found.column("raw_latitude"), rtol=0, atol=1e-9)
    assert len(list(whole.glob("*.parquet"))) == 2


@pytest.mark.slow
def test_a_target_is_cleaned_as_it_is_alone(data, tmp_path):
    assert clean(data, tmp_path / "out", "--sigma", "20", "--no-smooth") == 0
    found = rows_of(tmp_path / "out")
    for i in (2, 5):
        parquet.write_table(table_of([flight(i)]), tmp_path / "one.parquet")
        (alone,) = clean_tracks(readers.read(tmp_path / "one.parquet"), sigma=20.0, smooth=False)
        of = found.filter(pyarrow.compute.equal(found.column("id"), NAMES[i]))
        for name in ("latitude", "longitude", "altitude", "x", "vx", "std_across", "outlier"):
            np.testing.assert_allclose(of.column(name), columns(alone)[name], rtol=1e-6, atol=1e-6)


def test_a_date_and_a_time_of_the_day_are_one_time(tmp_path):
    track = flight(0)
    stamps = np.datetime_as_string(track.pop("time").astype("datetime64[s]"))
    day, clock = (np.array([stamp.split("T")[k] for stamp in stamps]) for k in (0, 1))
    parquet.write_table(pyarrow.table(track | {"flown": day, "clock": clock}), tmp_path / "one.parquet")
    data = open_data(tmp_path / "one.parquet", time="flown,clock")
    ((_, (recording,), _),) = data.recordings(0, 1, 1000)
    assert recording.time == pytest.approx(1.7e9 + 5.0 * np.arange(FIXES))


@pytest.mark.slow
def test_all_parts_have_the_same_columns_although_a_target_has_no_altitude(tmp_path):
    low = flight(1) | {"geoaltitude": np.full(FIXES, np.nan)}
    parquet.write_table(table_of([flight(0), low]), tmp_path / "two.parquet")
    assert clean(tmp_path / "two.parquet", tmp_path / "out", rows="8") == 0
    first, *others = (parquet.read_schema(file) for file in sorted((tmp_path / "out").glob("*.parquet")))
    assert len(others) == 14
    assert all(other == first for other in others)
    found = rows_of(tmp_path / "out")
    assert (found.num_rows, found.column("altitude").null_count) == (2 * FIXES, FIXES)


@pytest.mark.slow
def test_a_target_is_one_whether_a_file_has_its_number_with_or_without_gaps(tmp_path):
    first, second = (flight(0) | {"icao24": [number] * FIXES} for number in (7, 7.0))
    second = {name: list(cells) for name, cells in second.items()} | {"time": second["time"] + 5 * FIXES}
    second["icao24"][3] = None
    (tmp_path / "data").mkdir()
    parquet.write_table(pyarrow.table(first), tmp_path / "data/a.parquet")
    parquet.write_table(pyarrow.table(second), tmp_path / "data/b.parquet")
    assert clean(tmp_path / "data", tmp_path / "out", "--json", str(tmp_path / "s.json")) == 0
    assert set(rows_of(tmp_path / "out").column("id").to_pylist()) == {"7"}
    said = json.loads((tmp_path / "s.json").read_text())
    assert (said["targets"], said["rows"]) == (1, 2 * FIXES - 1)


def test_rows_are_given_back_some_at_a_time(data):
    for part in range(2):
        counts = [rows for rows, _, _ in open_data(data).recordings(part, 2, together=60)]
        assert len(counts) > 1
        assert max(counts) <= 3 * FIXES


# ---------------------------------------------------------------- ended and begun again


def killed(moment, arguments):
    """The command, killed where it writes its second part."""
    calls = []

    def at(function, kind):
        def called(*given, **named):
            calls.append(kind)
            if calls.count(kind) == 2 and kind == moment:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*given, **named)

        return called

    many.Growing.close = at(many.Growing.close, "within its table")
    many.peak_memory = at(many.peak_memory, "after its table")
    return cli.main(arguments)


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["within its table", "after its table"])
def test_a_command_that_was_killed_goes_on_with_nothing_lost_or_twice(moment, data, whole, tmp_path):
    out = tmp_path / "out"
    process = forked(killed, moment, ["many", str(data), "--out", str(out), "--rows", "120", "--quiet"])
    process.join()
    assert process.exitcode == -signal.SIGKILL
    first = (out / "part-00000.parquet").stat().st_mtime_ns
    assert clean(data, out) == 0
    assert (out / "part-00000.parquet").stat().st_mtime_ns == first
    check_equal(rows_of(out), rows_of(whole))
    assert sorted(path.name for path in out.iterdir()) == sorted(path.name for path in whole.iterdir())


@pytest.mark.slow
def test_several_processes_that_are_killed_go_on_as_one(data, whole, tmp_path):
    command = [sys.executable, "-m", "torchfra", "many", str(data), "--out", str(tmp_path / "out"), "--rows", "120"]
    with subprocess.Popen([*command, "--jobs", "2"], stdout=subprocess.PIPE, start_new_session=True) as process:
        while process.poll() is None and not list((tmp_path / "out").glob("_parts/*.json")):
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGKILL)
    assert clean(data, tmp_path / "out") == 0
    check_equal(rows_of(tmp_path / "out"), rows_of(whole))


@pytest.mark.slow
def test_a_part_that_was_taken_away_is_made_again(data, whole, tmp_path, capsys):
    out = shutil.copytree(whole, tmp_path / "out")
    (out / "part-00001.parquet").unlink()
    assert clean(data, out) == 0
    assert "1 of 2 parts were done before" in capsys.readouterr().out
    check_equal(rows_of(out), rows_of(whole))


def test_a_progress_bar_begins_with_what_was_done_before(monkeypatch, capsys):
    pytest.importorskip("tqdm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert list(progress_bar(iter([1]), "part", True, total=4, done=3)) == [1]
    assert "3/4" in capsys.readouterr().err


@pytest.mark.slow
def test_the_script_cleans_flights_that_it_simulates_and_says_how_fast(tmp_path, monkeypatch, capsys):
    def run(command, env, **_):
        monkeypatch.setenv("RANK", env["RANK"])
        monkeypatch.setenv("WORLD_SIZE", env["WORLD_SIZE"])
        assert cli.main(command[3:]) == 0

    monkeypatch.setattr(subprocess, "run", run)  # in this process
    monkeypatch.setattr(script, "processors", iter([0.0, 2.0]).__next__)
    assert script.main(["--tracks", "4", "--jobs", "1", "--json", str(tmp_path / "many.json")]) == 0
    (found,) = json.loads((tmp_path / "many.json").read_text())["runs"]
    assert (found["tracks"], found["rows"], found["parts"]) == (4, 400, 1)
    assert found["rows a processor's second"] == 200
    assert found["error"] < 0.8
    assert "rows a second" in capsys.readouterr().out


# ---------------------------------------------------------------- several processes


@pytest.mark.slow
def test_processes_that_are_numbered_share_the_parts_and_the_last_one_sums_up(
    data, whole, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank, parts in (("1", [1]), ("0", [0, 1])):
        monkeypatch.setenv("RANK", rank)
        assert clean(data, tmp_path / "out", "--json", str(tmp_path / "s.json")) == 0
        assert sorted((tmp_path / "out").glob("*.parquet")) == [tmp_path / f"out/part-{i:05}.parquet" for i in parts]
        assert (tmp_path / "s.json").exists() == (rank == "0")
    assert "4 aircraft: 240 fixes" in capsys.readouterr().out
    check_equal(rows_of(tmp_path / "out"), rows_of(whole))


@pytest.mark.parametrize(("rank", "size"), [("2", "2"), ("-1", "2"), ("0", "no")])
def test_a_number_that_no_process_has_is_refused(rank, size, monkeypatch):
    monkeypatch.setenv("RANK", rank)
    monkeypatch.setenv("WORLD_SIZE", size)
    with pytest.raises(ValueError, match=rf"RANK, WORLD_SIZE: expected .*, received \('{rank}', '{size}'\)"):
        launched()


# ---------------------------------------------------------------- what fails


def test_a_target_that_fails_is_said_and_all_others_are_there(tmp_path, capsys):
    wrong = flight(1)
    wrong["lat"][7] = 95.0
    parquet.write_table(table_of([flight(0), wrong, flight(2)]), tmp_path / "three.parquet")
    assert clean(tmp_path / "three.parquet", tmp_path / "out", "--json", str(tmp_path / "s.json"), rows="999") == 1
    error = capsys.readouterr().err
    assert error.startswith("torchfra: error: a00001: expected degrees within +-90 in data row 8, column lat, received")
    assert list(json.loads((tmp_path / "s.json").read_text())["failed"]) == ["a00001"]
    assert set(rows_of(tmp_path / "out").column("id").to_pylist()) == {"a00000", "a00002"}
    assert clean(tmp_path / "three.parquet", tmp_path / "out", rows="999") == 1
    assert capsys.readouterr().err == error


def test_a_target_of_one_fix_is_dropped_whatever_is_wrong_with_another(tmp_path, capsys):
    wrong = flight(1)
    wrong["lat"][7] = 95.0
    one = {name: column[:1] for name, column in flight(2).items()}
    parquet.write_table(table_of([flight(0), wrong, one]), tmp_path / "three.parquet")
    assert clean(tmp_path / "three.parquet", tmp_path / "out", "--json", str(tmp_path / "s.json"), rows="999") == 1
    said = json.loads((tmp_path / "s.json").read_text())
    assert list(said["failed"]) == ["a00001"]
    assert said["repairs"] == {"aircraft of one fix or none dropped": 1}
    parquet.write_table(table_of([one]), tmp_path / "one.parquet")
    assert clean(tmp_path / "one.parquet", tmp_path / "none", rows="999") == 0
    capsys.readouterr()


@pytest.mark.slow
def test_a_target_too_fast_for_its_bank_fails_alone(tmp_path, capsys):
    slow = flight(1) | {"lat": 10 + np.arange(FIXES) / 1e5, "lon": np.arange(FIXES) / 1e5}
    parquet.write_table(table_of([flight(0), slow]), tmp_path / "two.parquet")
    assert clean(tmp_path / "two.parquet", tmp_path / "out", "--bank", "ship", rows="999") == 1
    assert "a00000: bank: expected speeds of a ship, below 150 m/s" in capsys.readouterr().err
    assert set(rows_of(tmp_path / "out").column("id").to_pylist()) == {"a00001"}


def test_of_many_targets_that_fail_some_are_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(many_command, "_MOST_NAMED", 1)
    parquet.write_table(table_of([flight(i) | {"lat": np.full(FIXES, 95.0)} for i in (0, 1)]), tmp_path / "two.parquet")
    assert clean(tmp_path / "two.parquet", tmp_path / "out", rows="999") == 1
    first, second = capsys.readouterr().err.splitlines()
    assert "a0000" in first
    assert second == "torchfra: error: 2 aircraft failed: --json names all"


# ---------------------------------------------------------------- what is refused


def refused(capsys, *arguments, **named):
    assert clean(*arguments, **named) == 2
    return capsys.readouterr().err


def test_parts_of_other_settings_or_data_are_refused(data, whole, tmp_path, capsys):
    assert "sigma null, received 30.0: name" in refused(capsys, data, whole, "--sigma", "30")
    assert "rows 120, received 60: name" in refused(capsys, data, whole, rows="60")
    assert 'reading nothing more, received units "ft": name' in refused(capsys, data, whole, "--units", "ft")
    more = shutil.copytree(data, tmp_path / "more")
    shutil.copy(more / "a.parquet", more / "d.parquet")
    assert "files nothing more, received d.parquet [50, " in refused(capsys, more, whole)


def test_a_file_of_as_many_rows_and_bytes_that_says_something_else_is_refused(data, whole, tmp_path, capsys):
    other = shutil.copytree(data, tmp_path / "other")
    table, path = parquet.read_table(other / "a.parquet"), other / "a.parquet"
    at, size = table.schema.get_field_index("geoaltitude"), path.stat().st_size
    write(table.set_column(at, "geoaltitude", pyarrow.array([9001.0] * len(table))), path)
    assert path.stat().st_size == size
    assert "files a.parquet" in refused(capsys, other, whole)


def test_types_that_differ_between_files_are_those_that_hold_all(data, tmp_path):
    other = shutil.copytree(data, tmp_path / "other")
    table = parquet.read_table(other / "a.parquet")
    for name, kind in (("lat", "float32"), ("lon", "float32")):
        at = table.schema.get_field_index(name)
        table = table.set_column(at, name, table.column(at).cast(kind, safe=False))
    parquet.write_table(table, other / "a.parquet")
    assert open_data(other).schema.field("lat").type == "double"


def test_ids_that_are_numbers_here_and_text_there_are_refused(data, tmp_path, capsys):
    other = shutil.copytree(data, tmp_path / "other")
    table = parquet.read_table(other / "a.parquet")
    at = table.schema.get_field_index("icao24")
    parquet.write_table(table.set_column(at, "icao24", pyarrow.array([1] * len(table))), other / "a.parquet")
    assert "expected columns of one type in all files, received others" in refused(capsys, other, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_each_process_says_what_is_wrong_with_it(data, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("RANK", "1")
    assert "expected 1 or more" in refused(capsys, data, tmp_path / "out", rows="0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert "expected 1 or more" in refused(capsys, data, tmp_path / "out", rows="0")


def test_a_folder_with_other_files_is_refused(data, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").write_text("")
    said = refused(capsys, data, tmp_path / "out")
    assert f"out: expected a new folder or an empty one, received {tmp_path / 'out'} with mine.txt" in said


def test_a_file_that_another_process_is_writing_is_no_other_file(data, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/._run.json.part").write_text("")
    many.Work(open_data(data), tmp_path / "out", 120, {}).begin()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["_run.json"]


def test_a_folder_within_the_data_is_refused(data, capsys):
    said = refused(capsys, data, data / "out")
    assert f"out: expected a folder outside of {data}, received {data / 'out'}" in said


def test_data_that_cannot_be_read_are_refused(data, tmp_path, capsys):
    data, out = shutil.copytree(data, tmp_path / "data"), tmp_path / "out"
    assert "rows: expected 1 or more, received 0" in refused(capsys, data, out, rows="0")
    assert "jobs: expected 1 or more, received 0" in refused(capsys, data, out, "--jobs", "0")
    (tmp_path / "empty").mkdir()
    assert "expected files that end in .parquet, received none" in refused(capsys, tmp_path / "empty", out)
    (data / "d.parquet").write_bytes(b"PAR1")
    said = refused(capsys, data, out)
    assert f"{data / 'd.parquet'}: expected a complete Parquet or Feather file" in said
    parquet.write_table(table_of([flight(0)]).drop_columns("lon"), data / "d.parquet")
    said = refused(capsys, data, out)
    assert f"{data / 'd.parquet'}: expected the columns of a.parquet, missing lon" in said
    parquet.write_table(table_of([flight(0)]).drop_columns("icao24"), tmp_path / "one.parquet")
    said = refused(capsys, tmp_path / "one.parquet", out)
    assert "id: expected a column that says which target a row is of, received time, lat, lon, geoaltitude" in said
    assert not out.exists()
