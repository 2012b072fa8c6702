"""JSON lines of any ending, headers of ``np.savetxt`` and DataFrames are read as they are written."""

from __future__ import annotations

import json

import numpy as np
import pytest

import torchfra
from torchfra.readers import read

ROWS = 40
TIME = np.arange(ROWS) * 0.5
TRACK = np.stack([TIME, 3 * TIME, -TIME, np.sin(TIME)], 1)


def test_arrays_of_numpy_are_refused_with_what_to_do(tmp_path):
    np.save(tmp_path / "a.npy", TRACK)
    with pytest.raises(ValueError, match=r"a\.npy: .* hand its arrays to torchfra.clean as \(time, position\)"):
        read(tmp_path / "a.npy", time="1", x="2", y="3")


# ---------------------------------------------------------------- text


@pytest.mark.parametrize(
    "header", ["t east north up", "t [s] east [m] north [m] up [m]", "t (s) east (m) north (m) up"]
)
def test_a_header_of_savetxt_is_one_with_units_too(tmp_path, header):
    np.savetxt(tmp_path / "a.txt", TRACK, header=header)
    (track,) = read(tmp_path / "a.txt")
    np.testing.assert_array_equal(track.position, TRACK[:, 1:])


RECORDS = [{"time": t, "id": name, "x": x, "y": y} for t, x, y, _ in TRACK.tolist() for name in "ab"]


def test_a_sentence_of_as_many_words_as_columns_asks_for_its_unit(write):
    path = write(["# walk in mm", "time x y", *(f"{i} {3 * i} {i}" for i in range(ROWS))], "a.txt")
    with pytest.raises(ValueError, match="states lengths in mm: state it by units='mm'"):
        read(path)
    assert read(path, units="m")[0].position[1].tolist() == [3, 1]


@pytest.mark.parametrize("name", ["a.json", "a.jsonl", "a.ndjson", "a.log", "a.csv"])
def test_lines_of_objects_are_read_whatever_the_ending(write, name):
    assert [len(track.time) for track in read(write(map(json.dumps, RECORDS), name))] == [ROWS, ROWS]


@pytest.mark.parametrize("name", ["a.json", "a.jsonl", "a.txt"])
def test_lines_of_lists_of_objects_are_read(write, name):
    lines = [json.dumps(RECORDS[i : i + 2]) for i in range(0, len(RECORDS), 2)]
    assert [len(track.time) for track in read(write(lines, name))] == [ROWS, ROWS]


def test_what_is_no_json_is_told_of_json_lines(write):
    with pytest.raises(ValueError, match=r"expected JSON, or JSON lines \(records one a line\)"):
        read(write(['{"t": 0}', "{'t': 1}"], "a.json"))


# ---------------------------------------------------------------- a third dimension


def test_a_z_that_is_the_same_everywhere_is_a_dimension_and_changes_no_other(write):
    (track,) = read(write(["t,x,y,z", *(f"{t},{x},{y},1.5" for t, x, y, _ in TRACK)]))
    assert track.position[:, 2].tolist() == [1.5] * ROWS
    flat, solid = (torchfra.clean((TIME, track.position[:, :d])) for d in (2, 3))
    np.testing.assert_allclose(solid.position[:, :2], flat.position, atol=0.1 * flat.std.mean())


# ---------------------------------------------------------------- tables in memory


@pytest.mark.parametrize("place", ["column", "index", "level"])
@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_the_only_moments_of_a_table_are_its_times_whatever_their_name(place, zone):
    pandas = pytest.importorskip("pandas")
    received = pandas.date_range("2024-10-27 00:30", periods=ROWS, freq="5s", tz="UTC").tz_convert(zone)
    frame = pandas.DataFrame({"received": received, "wagon": 7, "x": TRACK[:, 1], "y": TRACK[:, 2]})
    frame = frame if place == "column" else frame.set_index(["wagon", "received"] if place == "level" else "received")
    cleaned = torchfra.clean(frame)
    assert cleaned.index.equals(frame.index)
    assert cleaned["clean_x"].notna().all()
