"""What receivers of aircraft write as JSON is read: traces of one, and lists of all at a moment."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pytest

from torchfra.readers import read

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
    assert track.source.notes[0] == "a trace of readsb"


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
    (TRACE | {"trace": [[0, 1]]}, r"expected rows of seconds, latitude, .* in trace, received \[0, 1\]"),
    (TRACE | {"trace": [["now", 1, 2, 3]]}, "expected rows of seconds"),
    (TRACE | {"timestamp": "noon"}, "in data row 1, column time, received 'noon'"),
    (TRACE | {"trace": []}, "expected rows, received none"),
])  # fmt: skip
def test_a_damaged_trace_is_refused(write, content, said):
    with pytest.raises(ValueError, match=said):
        read(write(content))
