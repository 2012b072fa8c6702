"""What receivers of aircraft write as JSON is read: traces of one, and lists of all at a moment."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pytest

from torchfra.cleaning.second_differences import second_differences
from torchfra.readers import read, samples

START = 1_600_000_000.5
TRACE = {
    "icao": "a1b2c3", "r": "N1", "timestamp": START,
    "trace": [
        [2.0 * i, 47 + i / 1e3, 8.0, "ground" if i < 2 else 1000 + 100 * i, 120.0, 0.0, 0, 600, {"flight": "AB1   "}]
        for i in range(6)
    ],
}  # fmt: skip


@pytest.fixture
def write(tmp_path):
    def write(content, name="a.json"):
        path = tmp_path / name
        text = content if isinstance(content, str) else json.dumps(content)
        path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
        return path

    return write


def moment(i):
    aircraft = [
        {"hex": "a1b2c3", "flight": "AB1 ", "lat": 47 + i / 1e3, "lon": 8.0, "alt_baro": 1000, "seen_pos": 0.5},
        {"hex": "d4e5f6", "lat": 48.0, "lon": 9 + i / 1e3, "alt_baro": "ground", "seen_pos": 1.0},
        {"hex": "aaaaaa", "alt_baro": 3000},
    ]
    return {"now": START + 5 * i, "messages": 7, "aircraft": aircraft}


@pytest.mark.parametrize("name", ["trace_full_a1b2c3.json", "trace_full_a1b2c3.json.gz"])
def test_a_trace_is_a_flight_in_seconds_since_its_start_and_feet(write, name):
    (track,) = read(write(TRACE, name))
    np.testing.assert_allclose(track.time, START + 2.0 * np.arange(6))
    assert (track.name, track.source.word, track.source.unit) == ("a1b2c3 AB1", "aircraft", 0.3048)
    np.testing.assert_allclose(np.diff(track.position[2:, 2]), 30.48, atol=0.01)
    np.testing.assert_allclose(np.diff(track.position[:, 1]), 111.2, atol=0.3)
    assert track.source.notes[0] == "JSON: trace of readsb"


@pytest.mark.parametrize("lines", [False, True])
def test_lists_of_several_moments_are_tracks_with_the_times_of_their_positions(write, lines):
    several = [moment(i) for i in range(4)]
    one, other = read(write("\n".join(map(json.dumps, several)) if lines else several))
    np.testing.assert_allclose(one.time, START - 0.5 + 5.0 * np.arange(4))
    np.testing.assert_allclose(other.time, START - 1.0 + 5.0 * np.arange(4))
    assert (one.name, other.name, other.position.shape) == ("a1b2c3 AB1", "d4e5f6", (4, 2))


def test_one_moment_is_no_track(write):
    with pytest.raises(ValueError, match="expected 2 or more rows with time and position of the same aircraft"):
        read(write(moment(0), "aircraft.json"))


def test_records_may_be_an_object_a_line(write):
    (track,) = read(write("\n".join(json.dumps({"t": i, "x": 2 * i, "y": 0}) for i in range(5)), "a.jsonl"))
    np.testing.assert_array_equal(track.position[:, 0], [0, 2, 4, 6, 8])


@pytest.mark.parametrize(("content", "said"), [
    (TRACE | {"trace": [[0, 1]]}, r"expected second, lat, lon, alt_baro in trace, received \[0, 1\]"),
    (TRACE | {"trace": [["now", 1, 2, 3]]}, "expected second, lat"),
    (TRACE | {"timestamp": "noon"}, "expected a number of seconds, received 'noon'"),
    (TRACE | {"timestamp": None}, "expected a number of seconds, received None"),
    (TRACE | {"trace": []}, "expected rows, received none"),
])  # fmt: skip
def test_a_damaged_trace_is_refused(write, content, said):
    with pytest.raises(ValueError, match=said):
        read(write(content))


def test_recorded_flights_are_smoother_by_the_times_of_their_updates():
    along = {}
    for name in ("noisy_landing", "noisy_takeoff"):
        (file,) = [file for file in samples("noisy") if file.name.startswith(name)]
        for time in (None, "timestamp"):
            track = max(read(file, time=time), key=lambda track: len(track.time))
            path = track.position[:, :2]
            ahead = path[2:] - path[:-2]
            course = ahead / np.linalg.norm(ahead, axis=1, keepdims=True).clip(1e-9)
            error = second_differences(track.time, path)
            along[name, time] = np.median(np.abs((error * course).sum(1)))
        assert along[name, None] < 0.6 * along[name, "timestamp"]


@pytest.mark.parametrize("unit", [1, 1000])
def test_positions_of_state_vectors_are_of_the_time_of_their_update(tmp_path, unit):
    start, ages = 1_672_574_400, [0.2, 0.9, 0.4, 1.4, 0.1, 0.6]
    rows = [f"{start + 2 * k},4b1805,{47 + 0.002 * (2 * k - age)},8.5,{(start + 2 * k - age) * unit},10000"
            for k, age in enumerate(ages)]  # fmt: skip
    rows.append(f"{start + 12},4b1805,{47 + 0.002 * 9.4},8.5,{(start + 9.4) * unit},10000")
    path = tmp_path / "states.csv"
    path.write_text("\n".join(["time,icao24,lat,lon,lastposupdate,baroaltitude", *rows]))
    (track,) = read(path)
    assert track.time - start == pytest.approx([2 * k - age for k, age in enumerate(ages)], abs=1e-5)
    assert np.diff(track.position[:, 1]) / np.diff(track.time) == pytest.approx(np.full(5, 222.3), rel=1e-2)
    (stated,) = read(path, time="time")
    assert (stated.time - start).tolist() == [2.0 * k for k in range(6)]
