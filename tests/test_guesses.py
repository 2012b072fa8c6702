"""What names do not say of a table is read where it is plain, and guessed in the error message where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from torchfra.readers import read

ROWS = [(10 * i, 47 + i / 1e4, 8 + i / 1e4, 350 + i) for i in range(5)]
TIMES = [f"12:26:{10 * i:02}" for i in range(5)]


def table(header, rows=ROWS, sign=","):
    return "\n".join([header] * bool(header) + [sign.join(map(str, row)) for row in rows]) + "\n"


@pytest.fixture
def write(tmp_path):
    def write(content):
        path = tmp_path / "a.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


# ---------------------------------------------------------------- names


@pytest.mark.parametrize("name", ["FL", "flight_level", "FlightLevel"])
@pytest.mark.parametrize("told", [False, True])
def test_flight_levels_are_hundreds_of_feet_found_or_told(write, name, told):
    path = write(table(f"time,lat,lon,{name}"))
    (track,) = read(path, alt=name if told else None)
    assert track.origin[2] == pytest.approx(35000 * 0.3048)
    assert f"altitude: {name}, in flight levels (hundreds of feet); --units takes others" in track.source.notes
    assert read(path, units="m")[0].origin[2] == 350


def test_flight_levels_are_no_heights_beside_metres(write):
    with pytest.raises(ValueError, match="z: expected heights in the unit of x and y, received flight levels in FL"):
        read(write(table("t,x,y,FL")), z="FL")


@pytest.mark.parametrize(("name", "per_second"), [
    ("time_boot_ms", 1e3), ("timeboot_ms", 1e3), ("timestamp_ms", 1e3), ("timestampms", 1e3), ("TimeUS", 1e6),
    ("time_usec", 1e6), ("timeus", 1e6), ("elapsed [ms]", 1e3),
])  # fmt: skip
def test_times_since_a_device_was_switched_on_are_read_in_the_unit_of_their_name(write, name, per_second):
    (track,) = read(write(table(f"{name},lat,lon,alt", [(t * round(per_second), *place) for t, *place in ROWS])))
    np.testing.assert_allclose(track.time, 10.0 * np.arange(5))


@pytest.mark.parametrize("header", [
    "Zeit;Breite;Länge;Höhe", "Zeitstempel;Breitengrad;Längengrad;Hoehe", "Tiempo;Latitud;Longitud;Altitud",
    "Temps;Latitude;Longitude;Hauteur", "zeit;geographische Breite;geographische Länge;Höhe [m]",
])  # fmt: skip
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_headers_in_other_languages_are_read_as_programs_there_write_them(write, header, encoding):
    text = table(header, sign=";").replace(".", ",").encode(encoding)
    (track,) = read(write(text))
    assert track.source.columns["latitude"] == header.split(";")[1]
    assert track.position.shape == (5, 3)
    west = encoding == "cp1252" and not header.isascii()
    assert ("text is no UTF-8: read as cp1252" in track.source.notes) == west


def test_what_is_no_text_at_all_is_no_western_text_either(write):
    with pytest.raises(ValueError, match="expected UTF-8 text or a complete gzip file of it, received neither"):
        read(write(b"t,x,y\x00\n0,1,\xff\n"))
    with pytest.raises(
        ValueError, match=r"expected a number in data row 1, column y, .*no UTF-8, and was read as cp1252"
    ):
        read(write(b"t,x,y\n0,1,\xff\n"))


def test_a_date_goes_with_the_time_of_the_day_that_is_told(write):
    rows = [("2020-09-13", clock, a, o) for clock, (_, a, o, _) in zip(TIMES, ROWS, strict=True)]
    (track,) = read(write(table("date,clock,lat,lon", rows)), time="clock")
    assert (track.time[0], track.source.notes[0]) == (1_600_000_000 - 40, "time: date and clock, ISO text")
    rows = [("03/04/2020", *row[1:]) for row in rows]
    with pytest.raises(ValueError, match="may have the day or the month first: use --time-format '%d/%m/%Y %H:%M:%S'"):
        read(write(table("date,clock,lat,lon", rows)), time="clock")
    (track,) = read(write(table("date,clock,lat,lon", rows)), time="clock", time_format="%m/%d/%Y %H:%M:%S")
    assert track.source.written(track.time[:1]) == ["03/04/2020 12:26:00"]


def test_a_date_and_a_time_of_any_names_are_named_together(write):
    rows = [("2020-09-13", clock, *row[1:3]) for clock, row in zip(TIMES, ROWS, strict=True)]
    path = write(table("Tag der Messung,Moment,lat,lon", rows))
    with pytest.raises(ValueError, match="looks like --time 'Tag der Messung,Moment'"):
        read(path)
    (track,) = read(path, time="Tag der Messung,Moment")
    np.testing.assert_allclose(track.time, 1_600_000_000 - 40 + 10 * np.arange(5))


# ---------------------------------------------------------------- guesses


@pytest.mark.parametrize(("header", "rows", "said"), [
    ("when,lat,lon", [row[:3] for row in ROWS], "missing time, received when, lat, lon; looks like --time when"),
    ("lat,lon,alt", [(47, 8, 350)] * 5, "lat, lon, alt; rows need a time, such as seconds since the first of them"),
    ("when,b,l,h", ROWS, "received when, b, l, h; looks like --time when --lat b --lon l"),
    ("", ROWS, "received 0, 47.0, 8.0, 350; looks like --time 1 --lat 2 --lon 3"),
    ("", [(clock, o + 100, a) for clock, (_, a, o, _) in zip(TIMES, ROWS, strict=True)],
     "looks like --time 1 --lat 3 --lon 2"),
    ("", [(3.5 * i, -i, i) for i in range(5)],
     r"received 0.0, 0, 0; say --time 1 with --lat and --lon, or --x and --y, of the columns 2 \(-4 to 0\), 3 \(0 to"),
    ("", [(1, 1, 1)] * 5, "received 1, 1, 1; without a header their numbers from 1 on are their names"),
])  # fmt: skip
def test_columns_that_no_name_tells_are_guessed_by_what_is_in_them(write, header, rows, said):
    with pytest.raises(ValueError, match=f"expected a header with a time and .* {said}"):
        read(write(table(header, rows)))


@pytest.mark.parametrize("names", [
    ("gid", "sog"), ("partition", "offset"), ("heading", "rssi"), ("vel_x", "vel_y"), ("temperature", "wind_speed"),
])  # fmt: skip
def test_what_names_say_is_something_else_is_not_proposed_as_a_position(write, names):
    with pytest.raises(ValueError, match=r"; say --time when with --lat and --lon, or --x and --y, of the columns"):
        read(write(table(f"when,{','.join(names)}", [row[:3] for row in ROWS])))


def test_two_columns_are_no_position_because_there_are_two(write):
    with pytest.raises(ValueError, match=r"say --time when .* of the columns a \(0 to 8\), b \(1 to 5\)$"):
        read(write(table("when,a,b", [(clock, 2 * i, i + 1) for i, clock in enumerate(TIMES)])))


def test_no_more_columns_are_listed_than_a_person_reads(write):
    rows = [(clock, *range(i, i + 12)) for i, clock in enumerate(TIMES)]
    with pytest.raises(ValueError, match=r"h \(7 to 11\) and 4 more$"):
        read(write(table("when,a,b,c,d,e,f,g,h,i,j,k,l", rows)))


@pytest.mark.parametrize(("north", "east"), [("boat_north", "boat_east"), ("fields.lat", "fields.lng")])
def test_columns_whose_words_are_known_are_proposed(write, north, east):
    options = "--lat fields.lat --lon fields.lng" if "lat" in north else "--x boat_east --y boat_north"
    with pytest.raises(ValueError, match=f"looks like --time when {options}"):
        read(write(table(f"when,{north},{east},speed", ROWS)))


@pytest.mark.parametrize("unit", [" [deg]", " (°)", "_deg", "_rad"])
def test_angles_are_neither_x_nor_y_nor_a_height(write, unit):
    path = write(table(f"t,range,azimuth{unit},elevation{unit}"))
    with pytest.raises(ValueError, match=r"column azimuth.*: expected lengths, received an angle; range and azim"):
        read(path, x="range", y=f"azimuth{unit}")
    (track,) = read(write(table(f"t,lat,lon,elevation{unit}")))
    assert track.position.shape == (5, 2)


@pytest.mark.parametrize("sign", [",", ";", "\t", " "])
def test_columns_without_a_header_may_be_told_by_their_numbers(write, sign):
    text = table("", sign=sign)
    (track,) = read(write(text), time="1", lat="2", lon="3", alt="4")
    (other,) = read(write(table("time,lat,lon,alt")))
    np.testing.assert_array_equal(track.position, other.position)
    np.testing.assert_array_equal(track.row, range(5))
    assert "no header: columns by their numbers" in track.source.notes
    with pytest.raises(ValueError, match="looks like --time 1 --lat 2 --lon 3"):
        read(write(text), time="1", lat="2", lon="9")


def test_a_header_of_numbers_is_one_where_its_columns_are_told(write):
    (track,) = read(write(table("0,1,2,3")), time="0", lat="1", lon="2", alt="3")
    np.testing.assert_array_equal(track.time, 10 * np.arange(5))


def test_ignored_columns_are_listed_whole_and_counted_where_they_are_too_many(write):
    names = [f"a_long_name_of_a_column_{i}" for i in range(20)]
    (track,) = read(write(table(",".join(["t,x,y", *names]), [(*row[:3], *range(20)) for row in ROWS])))
    assert track.source.notes[-1] == f"ignored: {', '.join(names[:7])}, and 13 more"


def test_a_table_with_a_row_for_each_coordinate_is_to_be_pivoted(tmp_path):
    rows = [f"{i},{value},{name}" for name, value in (("lat", 47.1234), ("lon", 8.1234)) for i in range(5)]
    path = tmp_path / "points.csv"
    path.write_text("\n".join(["_time,_value,_field", *rows]))
    with pytest.raises(ValueError, match="lat is in rows of _field: pivot the table, so that each coordinate has a c"):
        read(path)
    with pytest.raises(ValueError, match="expected a column for each coordinate, received _value, _value"):
        read(path, time="_time", lat="_value", lon="_value")


def test_a_third_coordinate_is_proposed_with_the_others(tmp_path):
    path = tmp_path / "body.csv"
    path.write_text("Time (s),Body Position X,Body Position Y,Body Position Z\n0,1,2,3\n1,2,3,5\n2,3,5,6\n")
    with pytest.raises(ValueError, match="--x 'Body Position X' --y 'Body Position Y' --z 'Body Position Z'"):
        read(path)


def test_a_blank_line_above_a_header_is_left_out_where_spaces_are_stated(tmp_path):
    path = tmp_path / "log.txt"
    path.write_text("logger 1\n\nt x y\n0 1 2\n1 2 3\n2 3 4\n")
    (track,) = read(path, delimiter="space")
    assert track.time.tolist() == [0, 1, 2]


# ---------------------------------------------------------------- what programs write


def test_cells_of_an_address_with_commas_belong_together(write):
    rows = [(f"2025-03-05 06:12:{i:02}", 45 + i / 1e4, 9.19, "1 Via Torino", " Milano", " IT", i) for i in range(9)]
    (track,) = read(write(table("fixTime,latitude,longitude,address,sat", rows)))
    assert len(track.time) == 9
    assert track.repairs == {}


def test_the_line_of_several_beneath_the_header_that_has_units_has_them(write):
    rows = [("X", "Y", "T"), ("X", "Y", "T"), ("(mm)", "(mm)", "(min)"), *((i, 2 * i, i) for i in range(9))]
    (track,) = read(write(table("POSITION_X,POSITION_Y,POSITION_T", rows)))
    assert track.time[-1] - track.time[0] == 8 * 60
    assert track.position[-1, 1] == pytest.approx(0.016)


def test_fixes_are_valid_or_not_in_single_letters_too(write):
    rows = [(i, 47 + i / 1e4, 8, "f" if 3 <= i < 5 else "t") for i in range(9)]
    (track,) = read(write(table("time,lat,lon,valid", rows)))
    assert track.repairs == {"rows marked as invalid dropped": 2}


def test_a_column_gps_may_hold_both_coordinates_and_a_switch_is_no_standard_deviation(write):
    rows = [(f"2025-08-02 15:22:{i:02}", f"{47 + i / 1e5:.6f} 8.300000", i % 3 - 1) for i in range(9)]
    (track,) = read(write(table("Time,GPS,SD", rows)))
    assert len(track.time) == 9
    assert track.sigma is None


def test_the_clock_of_a_game_counts_down_and_is_no_time(write):
    path = write(table("game_clock,x,y", [(720 - i / 25, i / 10, 5) for i in range(50)]))
    with pytest.raises(ValueError, match="column game_clock: expected times that go on, received a clock that counts"):
        read(path, time="game_clock")


def test_both_coordinates_of_a_cell_may_stand_in_brackets(write):
    (track,) = read(
        write(table("time,latlong,alt", [(i, f"[{47 + i / 1e5:.6f}; 8.300000]", 400 + i) for i in range(9)]))
    )
    assert len(track.time) == 9
    assert track.position.shape[1] == 3
