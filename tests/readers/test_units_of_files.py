"""What a file means of units, times and targets is read, or refused with what to do."""

import numpy as np
import pytest

import torchfra
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


@pytest.mark.parametrize(("form", "seconds"), [("minutes", 60), ("hours", 3600), ("days", 86_400)])
def test_coarse_units_of_times_can_be_told(tmp_path, form, seconds):
    (track,) = read(path(tmp_path, time=np.arange(ROWS) * 2.0 / seconds, **straight()), time_format=form)
    assert np.diff(track.time) == pytest.approx(2)


@pytest.mark.parametrize(("name", "per_second"), [("tow", 1), ("iTOW", 1000)])
def test_weeks_of_gps_and_what_of_them_has_passed_are_dates(tmp_path, name, per_second):
    passed = (604_790 + np.arange(ROWS)) % 604_800 * per_second
    week = 2297 + (np.arange(ROWS) >= 10)
    (track,) = read(path(tmp_path, week=week, **{name: passed}, **straight()))
    assert np.diff(track.time) == pytest.approx(1)
    assert track.time[10] == 1_705_795_200 - 18  # 2024-01-21 of GPS, which was 18 s ahead of UTC


def test_greenwich_is_utc(tmp_path):
    seconds = [f"2024-05-06 10:{i // 60:02}:{i % 60:02} GMT" for i in range(ROWS)]
    (track,) = read(path(tmp_path, time=seconds, **straight()))
    assert track.time[0] == 1_714_989_600


def test_frames_are_read_by_how_many_a_second_has(tmp_path):
    (track,) = read(path(tmp_path, frame=100 + np.arange(ROWS), **straight()), time="frame", time_format="12.5fps")
    np.testing.assert_allclose(np.diff(track.time), 0.08)
    assert any("frames, 12.5 a second" in line for line in track.source.notes)


@pytest.mark.parametrize("rate", ["0fps", "fps", "-25fps", "nanfps"])
def test_a_second_has_some_frames(tmp_path, rate):
    with pytest.raises(ValueError, match=f"time_format: expected .* or such as 25fps .*, received '{rate}'"):
        read(path(tmp_path, frame=np.arange(ROWS), **straight()), time="frame", time_format=rate)


@pytest.mark.parametrize(("east", "north"), [("utm_e", "utm_n"), ("UTM_Easting", "UTM_Northing"), ("x_utm", "y_utm")])
def test_northings_are_north_wherever_they_stand(tmp_path, east, north):
    (track,) = read(path(tmp_path, time=np.arange(ROWS), **{north: straight()["y"], east: straight()["x"]}))
    assert track.position[-1] == pytest.approx([10 * (ROWS - 1), 3 * (ROWS - 1)])


@pytest.mark.parametrize(
    ("unit", "metres"), [("km", 1000), ("cm", 0.01), ("mi", 1609.344), ("nmi", 1852), ("ft", 0.3048)]
)
def test_lengths_are_read_in_the_unit_of_their_names(tmp_path, unit, metres):
    lengths = {f"{name}_{unit}": values / metres for name, values in straight().items()}
    (track,) = read(path(tmp_path, time=np.arange(ROWS), **lengths, sigma_m=np.full(ROWS, 5.0)))
    assert track.position[-1] == pytest.approx([10 * (ROWS - 1), 3 * (ROWS - 1)])
    assert track.source.unit == metres
    assert track.sigma == pytest.approx(5)


def test_lengths_in_several_units_are_refused(tmp_path):
    lengths = {"x_km": straight()["x"] / 1e3, "y_km": straight()["y"] / 1e3, "z_ft": np.zeros(ROWS)}
    with pytest.raises(ValueError, match="one unit of lengths, received x_km, y_km, z_ft: convert one"):
        read(path(tmp_path, time=np.arange(ROWS), **lengths))


def test_a_kind_of_target_that_cannot_be_so_fast_is_refused():
    places = np.stack([100.0 * np.arange(ROWS), np.zeros(ROWS)], 1)
    with pytest.raises(ValueError, match=r"bank: expected speeds of a person, below 30 m/s, received 100 m/s .*units"):
        torchfra.clean((np.arange(ROWS), places), bank="person")


@pytest.mark.parametrize("name", ["down", "pos_d", "depth_m"])
def test_what_grows_downwards_is_no_height(tmp_path, name):
    file = path(tmp_path, time=np.arange(ROWS), **straight(), **{name: np.arange(ROWS)})
    with pytest.raises(
        ValueError, match=f"column {name}: expected heights, which grow upwards: name a column of its neg"
    ):
        read(file, z=name)
    assert f"ignored: {name}" in read(file)[0].source.notes


@pytest.mark.parametrize("name", ["enhanced_altitude", "altitude"])
def test_altitudes_of_watches_are_read(tmp_path, name):
    latitude = 47.0 + 1e-4 * np.arange(ROWS)
    columns = {"lat": latitude, "lon": np.full(ROWS, 8.0), name: 400.2 + np.arange(ROWS)}
    (track,) = read(path(tmp_path, timestamp=1.7e9 + np.arange(ROWS), **columns))
    assert np.diff(track.position[:, 2]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    "name", ["player_id", "player", "animal_id", "bird", "bus_id", "collar_id", "imei", "user_id", "vessel", "tag_id"]
)
def test_what_names_a_target_parts_them(tmp_path, name):
    who, frame = np.repeat(np.arange(4), ROWS), np.tile(np.arange(ROWS), 4)
    tracks = read(path(tmp_path, time=frame, **{name: who}, x=frame * 2.0 + 50 * who, y=frame * 1.0))
    assert [len(track.time) for track in tracks] == [ROWS] * 4


def test_rows_that_come_twice_are_no_other_targets(tmp_path):
    once = straight()
    (track,) = read(path(tmp_path, time=np.repeat(np.arange(ROWS), 2), **{k: np.repeat(v, 2) for k, v in once.items()}))
    assert len(track.time) == ROWS
