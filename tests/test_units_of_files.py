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


@pytest.mark.parametrize(
    ("name", "seconds"), [("time_min", 60), ("minutes", 60), ("elapsed_h", 3600), ("hours", 3600), ("t [days]", 86_400)]
)
def test_times_of_coarse_units_are_read_by_the_ends_of_their_names(tmp_path, name, seconds):
    (track,) = read(path(tmp_path, **{name: np.arange(ROWS) * 2.0 / seconds}, **straight()))
    assert np.diff(track.time) == pytest.approx(2)


@pytest.mark.parametrize(("form", "seconds"), [("minutes", 60), ("hours", 3600), ("days", 86_400)])
def test_coarse_units_of_times_can_be_told(tmp_path, form, seconds):
    (track,) = read(path(tmp_path, time=np.arange(ROWS) * 2.0 / seconds, **straight()), time_format=form)
    assert np.diff(track.time) == pytest.approx(2)


def test_the_least_of_something_is_no_time_in_minutes(tmp_path):
    with pytest.raises(ValueError, match="missing time"):
        read(path(tmp_path, alt_min=np.arange(ROWS), **straight()))


@pytest.mark.parametrize(("form", "zero"), [("excel", 45_000.5), ("mjd", 60_018.5), ("matlab", 738_960.5)])
def test_days_since_a_date_are_refused_as_seconds_and_read_where_they_are_told(tmp_path, form, zero):
    file = path(tmp_path, **{"mjd" if form == "mjd" else "time": zero + np.arange(ROWS) / 86_400}, **straight())
    with pytest.raises(ValueError, match=f"--time-format {form}"):
        read(file)
    (track,) = read(file, time=None if form != "mjd" else "mjd", time_format=form)
    assert track.source.written(track.time[:1]) == [f"{zero}"]
    assert np.diff(track.time) == pytest.approx(1, abs=1e-4)
    assert track.time[0] == 1_678_881_600  # noon of 2023-03-15, the same day in each


@pytest.mark.parametrize(("name", "per_second"), [("tow", 1), ("iTOW", 1000)])
def test_weeks_of_gps_and_what_of_them_has_passed_are_dates(tmp_path, name, per_second):
    passed = (604_790 + np.arange(ROWS)) % 604_800 * per_second
    week = 2297 + (np.arange(ROWS) >= 10)
    (track,) = read(path(tmp_path, week=week, **{name: passed}, **straight()))
    assert np.diff(track.time) == pytest.approx(1)
    assert track.time[10] == 1_705_795_200 - 18  # 2024-01-21 of GPS, which was 18 s ahead of UTC
    assert track.source.written(track.time[10:11]) == ["2298 0"]


def test_seconds_of_the_week_that_are_told_need_weeks(tmp_path):
    with pytest.raises(ValueError, match=r"expected a column of weeks, .* beside time for gps"):
        read(path(tmp_path, time=np.arange(ROWS), **straight()), time_format="gps")


def test_a_clock_of_twelve_hours_is_read_with_its_halves_and_refused_without(tmp_path):
    minutes = 11 * 60 + 2 * np.arange(ROWS)
    clock = [f"{(m // 60 - 1) % 12 + 1:02}:{m % 60:02}:00" for m in minutes]
    halves = [f"{text} {'AM' if m < 720 else 'PM'}" for text, m in zip(clock, minutes, strict=True)]
    (track,) = read(path(tmp_path, time=halves, **straight()))
    assert np.diff(track.time) == pytest.approx(120)
    with pytest.raises(ValueError, match=r"24 hours, received 01:00:00 behind 12:58:00, .*: add AM or PM, or a date"):
        read(path(tmp_path, time=clock, **straight()))


@pytest.mark.parametrize("zone", ["CST", "CEST", "Europe/Zurich"])
@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S", "%d.%m.%Y %H:%M:%S"])
def test_names_of_zones_are_refused_and_a_form_that_reads_them_is_said(tmp_path, zone, form):
    moments = [np.datetime64("2024-05-06T10:00:00") + i for i in range(ROWS)]
    file = path(tmp_path, time=[f"{moment.item():{form}} {zone}" for moment in moments], **straight())
    with pytest.raises(ValueError, match=rf"zone {zone} .* an offset such as -06:00 .*--time-format '{form} {zone}'"):
        read(file)
    assert read(file, time_format=f"{form} {zone}")[0].time[0] == 1_714_989_600


def test_greenwich_is_utc(tmp_path):
    seconds = [f"2024-05-06 10:{i // 60:02}:{i % 60:02} GMT" for i in range(ROWS)]
    (track,) = read(path(tmp_path, time=seconds, **straight()))
    assert track.time[0] == 1_714_989_600
    assert track.source.written(track.time[:1]) == seconds[:1]


def test_parts_of_a_time_in_several_columns_are_refused(tmp_path):
    i = np.arange(ROWS)
    with pytest.raises(ValueError, match="received parts in hour, minute, second: join them"):
        read(path(tmp_path, hour=i // 3600, minute=i // 60, second=i % 60, **straight()))


HINT = "looks like --time frame --time-format 25fps.*, if a second has 25 frames"


def test_frames_are_no_seconds(tmp_path):
    file = path(tmp_path, frame=np.arange(ROWS), **straight())
    with pytest.raises(ValueError, match=HINT):
        read(file)
    with pytest.raises(ValueError, match=r"column frame: .* received numbers of frames: say how many a second has"):
        read(file, time="frame")


def test_frames_are_read_and_written_by_how_many_a_second_has(tmp_path):
    (track,) = read(path(tmp_path, frame=100 + np.arange(ROWS), **straight()), time="frame", time_format="12.5fps")
    np.testing.assert_allclose(np.diff(track.time), 0.08)
    assert track.source.written(track.time[:2]) == ["100", "101"]
    assert any("frames, 12.5 a second" in line for line in track.source.notes)


@pytest.mark.parametrize("rate", ["0fps", "fps", "-25fps", "nanfps"])
def test_a_second_has_some_frames(tmp_path, rate):
    with pytest.raises(ValueError, match=f"time_format: expected .* or such as 25fps .*, received '{rate}'"):
        read(path(tmp_path, frame=np.arange(ROWS), **straight()), time="frame", time_format=rate)


def test_frames_of_several_targets_are_no_seconds(tmp_path):
    with pytest.raises(ValueError, match=HINT):
        read(path(tmp_path, frame=np.arange(ROWS) // 2, player_id=np.arange(ROWS) % 2, **straight()))


@pytest.mark.parametrize("names", [("range_m", "azimuth_deg", "elevation_deg"), ("Slant Range", "Bearing")])
def test_ranges_and_bearings_are_no_x_and_y(tmp_path, names):
    with pytest.raises(ValueError, match=f"; {names[0]} and {names[1]} must be turned into x and y"):
        read(path(tmp_path, time=np.arange(ROWS), **{name: straight()["x"] for name in names}))


@pytest.mark.parametrize("sigma", [{}, {"sigma": np.full(ROWS, 2.0)}])
def test_x_and_y_beside_ranges_tell_that_their_noise_may_grow_unless_it_is_told(tmp_path, sigma):
    angle = np.linspace(10, 60, ROWS)
    (track,) = read(path(tmp_path, time=np.arange(ROWS), **straight(), range_m=10 + angle, azimuth_deg=angle, **sigma))
    assert any("noise that grows with range needs a column" in note for note in track.source.notes) == (not sigma)


@pytest.mark.parametrize(("east", "north"), [("utm_e", "utm_n"), ("UTM_Easting", "UTM_Northing"), ("x_utm", "y_utm")])
def test_northings_are_north_wherever_they_stand(tmp_path, east, north):
    (track,) = read(path(tmp_path, time=np.arange(ROWS), **{north: straight()["y"], east: straight()["x"]}))
    assert track.position[-1] == pytest.approx([10 * (ROWS - 1), 3 * (ROWS - 1)])


def test_northings_are_suggested_as_y(tmp_path):
    with pytest.raises(ValueError, match="--time time --x my_easts --y my_norths"):
        read(path(tmp_path, time=np.arange(ROWS), my_norths=straight()["y"], my_easts=straight()["x"]))


@pytest.mark.parametrize(
    ("unit", "metres"), [("km", 1000), ("cm", 0.01), ("mi", 1609.344), ("nmi", 1852), ("ft", 0.3048)]
)
def test_lengths_are_read_in_the_unit_of_their_names(tmp_path, unit, metres):
    lengths = {f"{name}_{unit}": values / metres for name, values in straight().items()}
    (track,) = read(path(tmp_path, time=np.arange(ROWS), **lengths, sigma_m=np.full(ROWS, 5.0)))
    assert track.position[-1] == pytest.approx([10 * (ROWS - 1), 3 * (ROWS - 1)])
    assert track.source.unit == metres
    assert track.sigma == pytest.approx(5)


def test_a_unit_that_may_be_another_is_asked_for(tmp_path):
    file = path(tmp_path, time=np.arange(ROWS), **{f"{name}_nm": v / 1852 for name, v in straight().items()})
    with pytest.raises(ValueError, match="--x x_nm --y y_nm --units nmi"):
        read(file)
    with pytest.raises(ValueError, match="x_nm: nm are nautical miles or nanometres: say --units nmi"):
        read(file, x="x_nm", y="y_nm")
    (track,) = read(file, x="x_nm", y="y_nm", units="nmi")
    assert track.position[-1, 0] == pytest.approx(10 * (ROWS - 1))


def test_lengths_in_several_units_are_refused(tmp_path):
    lengths = {"x_km": straight()["x"] / 1e3, "y_km": straight()["y"] / 1e3, "z_ft": np.zeros(ROWS)}
    with pytest.raises(ValueError, match="one unit of lengths, received x_km, y_km, z_ft: convert one"):
        read(path(tmp_path, time=np.arange(ROWS), **lengths))


def test_a_ship_that_is_as_fast_as_none_is_refused_and_the_unit_is_asked_for(tmp_path):
    minutes = np.arange(ROWS) * 1.0
    place = {"lat": 55 + minutes * 4e-3, "lon": np.full(ROWS, 11.0)}
    with pytest.raises(ValueError, match=r"below 150 m/s, received 445 m/s .* column t may be in minutes"):
        read(path(tmp_path, mmsi=[219_000_000] * ROWS, t=minutes, **place))
    (track,) = read(path(tmp_path, mmsi=[111_219_000] * ROWS, t=minutes, **place))  # an aircraft that rescues
    assert len(track.time) == ROWS


def test_a_kind_of_target_that_cannot_be_so_fast_is_refused():
    places = np.stack([100.0 * np.arange(ROWS), np.zeros(ROWS)], 1)
    with pytest.raises(ValueError, match=r"bank: expected speeds of a person, below 30 m/s, received 100 m/s .*units"):
        torchfra.clean((np.arange(ROWS), places), bank="person")


def test_a_unit_that_cannot_be_does_not_win_over_the_size_of_the_numbers(tmp_path):
    ms = (1.7e12 + 500 * np.arange(ROWS)).astype(np.int64)
    (track,) = read(path(tmp_path, time_s=ms, **straight()))
    assert np.diff(track.time) == pytest.approx(0.5)


@pytest.mark.parametrize("name", ["down", "pos_d", "depth_m"])
def test_what_grows_downwards_is_no_height(tmp_path, name):
    file = path(tmp_path, time=np.arange(ROWS), **straight(), **{name: np.arange(ROWS)})
    with pytest.raises(ValueError, match=f"z: expected heights, which grow upwards, received {name}: name its neg"):
        read(file, z=name)
    assert f"ignored: {name}" in read(file)[0].source.notes


@pytest.mark.parametrize("name", ["enhanced_altitude", "altitude"])
def test_altitudes_of_watches_are_read(tmp_path, name):
    latitude = 47.0 + 1e-4 * np.arange(ROWS)
    columns = {"lat": latitude, "lon": np.full(ROWS, 8.0), name: 400.2 + np.arange(ROWS)}
    (track,) = read(path(tmp_path, timestamp=1.7e9 + np.arange(ROWS), **columns))
    assert np.diff(track.position[:, 2]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("gap", [False, True])
def test_semicircles_of_watches_are_degrees(tmp_path, gap):
    latitude, longitude = 47.0 + 1e-4 * np.arange(ROWS), 8.0 + 1e-4 * np.arange(ROWS)
    columns = {
        name: np.round(x * 2**31 / 180).astype(np.int64)
        for name, x in (("position_lat", latitude), ("position_long", longitude))
    }
    if gap:  # whole numbers of a table that misses one have decimals
        columns = {name: [*map(float, column[:-1]), "nan"] for name, column in columns.items()}
    (track,) = read(path(tmp_path, timestamp=1.7e9 + np.arange(ROWS), **columns, altitude=np.full(ROWS, 400)))
    assert np.linalg.norm(np.diff(track.position[:, :2], axis=0), axis=1) == pytest.approx(13.5, rel=0.01)
    assert any("semicircles" in line for line in track.source.notes)


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


def test_vehicles_of_ngsim_are_in_feet(tmp_path):
    path = tmp_path / "trajectories.csv"
    rows = [f"2,{13 + k},437,{1_118_846_980_200 + 100 * k},{16.5 + k},{35.4 + 4 * k}" for k in range(30)]
    path.write_text("\n".join(["Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y", *rows]))
    (track,) = read(path, time="Global_Time", x="Local_X", y="Local_Y")
    assert track.position[-1] == pytest.approx([45.5 * 0.3048, 151.4 * 0.3048])
    assert "position: Local_X, Local_Y, in feet; --units takes others" in track.source.notes
