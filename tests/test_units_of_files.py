"""Names of columns say units and targets: what a file means is read, or refused."""

import numpy as np
import pytest

from torchfra.readers import read

ROWS = 120


def path(tmp_path, **columns):
    """A CSV file of these columns."""
    lines = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    file = tmp_path / "track.csv"
    file.write_text("\n".join(lines) + "\n")
    return file


def straight(n=ROWS):
    return {"x": np.arange(n) * 10.0, "y": np.arange(n) * 3.0}


@pytest.mark.parametrize(
    ("name", "per_second"),
    [("time_us", 1e6), ("TimeUS", 1e6), ("timestamp_us", 1e6), ("timestamp_ns", 1e9), ("time_ms", 1e3), ("iTOW", 1e3)],
)
def test_the_end_of_a_name_says_the_unit_of_times(tmp_path, name, per_second):
    seconds = 1200 + 0.5 * np.arange(ROWS)
    (track,) = read(path(tmp_path, **{name: (seconds * per_second).astype(np.int64)}, **straight()))
    assert np.diff(track.time) == pytest.approx(0.5)


def test_a_unit_that_cannot_be_does_not_win_over_the_size_of_the_numbers(tmp_path):
    ms = (1.7e12 + 500 * np.arange(ROWS)).astype(np.int64)
    (track,) = read(path(tmp_path, time_s=ms, **straight()))
    assert np.diff(track.time) == pytest.approx(0.5)


def test_semicircles_of_watches_are_degrees(tmp_path):
    latitude, longitude = 47.0 + 1e-4 * np.arange(ROWS), 8.0 + 1e-4 * np.arange(ROWS)
    columns = {
        name: np.round(x * 2**31 / 180).astype(np.int64)
        for name, x in (("position_lat", latitude), ("position_long", longitude))
    }
    (track,) = read(path(tmp_path, timestamp=1.7e9 + np.arange(ROWS), **columns, altitude=np.full(ROWS, 400)))
    assert np.linalg.norm(np.diff(track.position[:, :2], axis=0), axis=1) == pytest.approx(13.5, rel=0.01)
    assert any("semicircles" in line for line in track.source.said)


@pytest.mark.parametrize(
    "name", ["player_id", "player", "animal_id", "bird", "bus_id", "collar_id", "imei", "user_id", "vessel", "tag_id"]
)
def test_what_names_a_target_parts_them(tmp_path, name):
    who, frame = np.repeat(np.arange(4), ROWS), np.tile(np.arange(ROWS), 4)
    tracks = read(path(tmp_path, time=frame, **{name: who}, x=frame * 2.0 + 50 * who, y=frame * 1.0))
    assert [len(track.time) for track in tracks] == [ROWS] * 4


@pytest.mark.parametrize("name", ["shirt", "who"])
def test_many_fixes_at_the_same_times_are_refused_and_what_may_part_them_is_named(tmp_path, name):
    who, frame = np.repeat(np.arange(4), ROWS), np.tile(np.arange(ROWS), 4)
    file = path(tmp_path, time=frame, **{name: who}, x=frame * 2.0 + 50 * who, y=frame * 1.0)
    with pytest.raises(ValueError, match=f"360 of 480 rows .* other positions at the same times.*--id {name}"):
        read(file)
    assert len(read(file, id=name)) == 4


def test_rows_that_come_twice_are_no_other_targets(tmp_path):
    once = straight()
    (track,) = read(path(tmp_path, time=np.repeat(np.arange(ROWS), 2), **{k: np.repeat(v, 2) for k, v in once.items()}))
    assert len(track.time) == ROWS
