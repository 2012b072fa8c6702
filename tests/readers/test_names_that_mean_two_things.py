"""What a name means is said by the names beside it, or the file is refused: nothing is read wrongly without a word."""

from __future__ import annotations

import math

import numpy as np
import pytest

from torchfra.readers import read
from torchfra.readers.options import AskError

ROWS, START = 60, 1_717_402_500  # 2024-06-03T08:15:00Z


@pytest.fixture
def rows(tmp_path):
    """Writes a file of a header and rows of which a function makes the cells."""

    def written(header, of, count=ROWS):
        path = tmp_path / "track.csv"
        path.write_text("\n".join([header, *(",".join(map(str, of(i))) for i in range(count))]) + "\n", "utf-8")
        return path

    return written


@pytest.mark.parametrize("speed", ["gs", "groundspeed", "vertical_rate"])
def test_a_track_beside_the_speed_of_an_aircraft_is_its_course(rows, speed):
    (track,) = read(rows(f"time,lat,lon,{speed},track", lambda i: (START + i, 50 + i / 1e4, 7, 408, 40 + i // 3)))
    assert len(track.time) == ROWS


def test_a_track_beside_no_speed_is_a_target(rows):
    assert len(read(rows("time,lat,lon,track", lambda i: (START + i, 50 + i / 1e4, 7 + i % 2, i % 2)))) == 2


def test_tables_of_traffic_without_transponders_are_read_in_feet(rows):
    names = "timestamp,flight_id,latitude,longitude,altitude,groundspeed,track,vertical_rate"
    tracks = read(rows(names, lambda i: (START + i // 2, f"F{i % 2}", 50 + i / 1e4, 7 + i % 2, 10_000, 408, i, 900)))
    assert [track.name for track in tracks] == ["F0", "F1"]
    assert tracks[0].origin[2] == pytest.approx(3048)


def test_a_height_beside_a_width_is_the_size_of_a_box(rows):
    (track,) = read(rows("time,x,y,width,height", lambda i: (i / 10, i, 3, 1.8, 1.4 + i % 3 / 10)))
    assert track.position.shape == (ROWS, 2)


def test_an_elevation_beside_an_azimuth_is_an_angle(rows):
    (track,) = read(rows("time,x,y,azimuth,elevation", lambda i: (i / 10, i, 3, 40, 2 + i / 10)))
    assert track.position.shape == (ROWS, 2)


@pytest.mark.parametrize("unit", ["kft", "FL", "hPa"])
def test_units_of_altitudes_that_are_not_known_are_refused(rows, unit):
    with pytest.raises(AskError, match=f"expected lengths, received {unit.lower()}: a unit by units='m'"):
        read(rows(f"time,lat,lon,altitude ({unit})", lambda i: (START + i, 50 + i / 1e4, 7, 30)))


@pytest.mark.parametrize("words", ["MSL", "m MSL", "above sea level", "WGS84"])
def test_what_altitudes_are_above_is_no_unit(rows, words):
    (track,) = read(rows(f"time,lat,lon,altitude ({words})", lambda i: (START + i, 50 + i / 1e4, 7, 30)))
    assert track.origin[2] == 30


@pytest.mark.parametrize("unit", ["um", "microns", "px"])
def test_a_column_of_units_without_a_conversion_is_refused(rows, unit):
    with pytest.raises(AskError, match=rf"expected m, received {unit} in the column unit: say units='mm'"):
        read(rows("t,x,y,unit", lambda i: (i, i, 3, unit)))


@pytest.mark.parametrize(
    "header", ["mmsi,time,lat,lon", "icao24,time,lat,lon", "individual-local-identifier,time,lat,lon"]
)
def test_radians_of_ships_aircraft_and_animals_are_refused_until_degrees_are_said(rows, header):
    path = rows(header, lambda i: (219_000_001, START + i, math.radians(50 + i / 1e3), math.radians(7)))
    with pytest.raises(AskError, match="expected degrees in lat and lon, received what looks like radians"):
        read(path)
    assert len(read(path, lat="lat", lon="lon")) == 1


@pytest.mark.parametrize("header", ["gps_epoch_ms,lat,lon", "gps_time_ms,lat,lon"])
def test_milliseconds_since_the_epoch_of_gps_are_none_since_1970(rows, header):
    path = rows(header, lambda i: (1_401_437_718_000 + 1000 * i, 50 + i / 1e4, 7))
    with pytest.raises(AskError, match="say time_format='ms' or write seconds and say time_format='gps_seconds'"):
        read(path)


def test_milliseconds_of_a_week_are_no_seconds(rows):
    path = rows("week,tow,lat,lon", lambda i: (2317, 116_118_000 + 1000 * i, 50 + i / 1e4, 7))
    with pytest.raises(AskError, match="say time='week,tow', time_format='gps_ms' if they are ms"):
        read(path)
    (track,) = read(path, time="week,tow", time_format="gps_ms")
    assert track.time[[0, -1]] == pytest.approx([START, START + ROWS - 1])
    with pytest.raises(ValueError, match="expected a time such as 2317 116118000 in data row 1"):
        read(path, time="week,tow", time_format="gps")


def test_a_position_of_ublox_is_in_millimetres(rows):
    (track,) = read(rows("iTOW,lat,lon,height,hAcc", lambda i: (1000 * i, 50 + i / 1e4, 7, 120_000, 2100)))
    assert track.origin[2] == 120
    assert track.sigma == pytest.approx(np.full(ROWS, 2.1 / math.sqrt(-2 * math.log(0.32))))


def test_the_accuracy_of_a_vessel_is_a_mark(rows):
    (track,) = read(rows("vessel_id,t,lat,lon,accuracy", lambda i: ("v1", START + 10 * i, 50 + i / 1e4, 7, i % 2)))
    assert track.sigma is None
    assert track.source.word == "ship"


@pytest.mark.parametrize("header", ["time,lat,N/S,lon,E/W", "time,lat,lat_ns,lon,hemisphere"])
def test_a_side_that_changes_behind_the_first_thousand_rows_is_refused(rows, header):
    east = 0.2 - np.arange(1500) / 5e3

    def of(i, sign=1):
        return START + i, 50, "N", abs(east[i]) if sign else east[i], "EW"[int(east[i] < 0)]

    with pytest.raises(ValueError, match="column lon: expected degrees that grow to the north and east, received oth"):
        read(rows(header, of, 1500))
    (track,) = read(rows(header, lambda i: of(i, 0), 1500))
    assert track.position[-1, 0] == pytest.approx(-21_490, abs=50)


def test_a_zone_that_changes_behind_the_first_thousand_rows_is_refused(rows):
    path = rows("time,utm_e,utm_n,utm_zone_number", lambda i: (i, 700_000 - 300 * i, 5_500_000, 32 + i // 1200), 1500)
    with pytest.raises(ValueError, match="expected one zone of the grid, received 32, 33"):
        read(path)


def test_columns_named_by_their_units_or_numbers_do_not_stop_the_search_for_the_header(rows):
    path = rows("Date,today\nTime,GPS Latitude,GPS Longitude\ns,deg,deg", lambda i: (i, 50 + i / 1e4, 7))
    (track,) = read(path)
    assert track.source.columns["time"] == "Time (s)"
    for words in ({"time": "Time (s)"}, {"time": "1", "lat": "2", "lon": "3"}, {"lat": "2", "lon": "3"}):
        (again,) = read(path, **words)
        assert np.array_equal(track.position, again.position)


def test_a_year_and_its_parts_are_named_in_the_hint(rows):
    header = "UTC_Year,UTC_Month,UTC_Day,UTC_Hour,UTC_Minute,UTC_Second,lat,lon"
    path = rows(header, lambda i: (2024, 6, 3, 8, 15, i, 50 + i / 1e4, 7))
    with pytest.raises(AskError, match="received parts of them") as error:
        read(path)
    (track,) = read(path, **error.value.args[-1])
    assert track.time[0] == START


def test_records_of_fit_are_recognised_behind_an_index(rows):
    header = ",record.timestamp[s],record.position_lat[semicircles],record.position_long[semicircles]"
    semicircles = 2**31 / 180
    path = rows(
        header, lambda i: (i, START - 631_065_600 + i, round((50 + i / 1e4) * semicircles), round(7 * semicircles))
    )
    (track,) = read(path)
    assert track.time[0] == START
    assert track.origin[:2] == pytest.approx((50, 7), abs=1e-6)


@pytest.mark.parametrize(
    "header", ["timestamp,time_utc_usec,lat,lon,alt,fix_type", "timestamp,time,latitudeE7,longitudeE7"]
)
def test_degrees_where_parts_of_them_are_stated_are_refused(rows, header):
    path = rows(header, lambda i: (i, 10**6 * (START + i), 50 + i / 1e4, 7, 1000, 3)[: header.count(",") + 1])
    with pytest.raises(ValueError, match=r"expected 1e-07 degrees, at most 9e\+08 of them"):
        read(path)


def test_nautical_miles_and_nanometres_have_one_sign_and_are_refused(rows):
    with pytest.raises(AskError, match=r"column x \(nm\): nm are nautical miles or nanometres: say units='nmi'"):
        read(rows("t,x (nm),y (nm)", lambda i: (i, i, 3)))


def test_hours_that_nobody_names_are_refused_as_too_short_a_time(rows):
    path = rows("time,lat,lon", lambda i: (i / 3600, 50 + i / 1e4, 7))
    (track,) = read(path, time_format="hours")
    assert track.time[-1] - track.time[0] == pytest.approx(ROWS - 1)
    path = rows("time,lat,lon", lambda i: (i / 86_400, 50 + i / 1e4, 7))
    with pytest.raises(AskError, match=r"expected more than 1 s, received 60 fixes within 0\.000683 s"):
        read(path)


def test_ships_faster_than_any_are_refused(rows):
    with pytest.raises(
        AskError, match="expected speeds below 150 m/s, received 717 m/s as the median of ship 219000001"
    ):
        read(rows("mmsi,time,lat,lon", lambda i: (219_000_001, START + i, 50, 7 + i / 1e2)))
