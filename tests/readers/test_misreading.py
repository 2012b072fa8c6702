"""What would be read wrongly is refused in a line that says what is meant and what to do; the rest goes on."""

from __future__ import annotations

import json
import re
from datetime import datetime, timezone
from datetime import time as clock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_formats import ALTITUDE, FILES, LATITUDE, LONGITUDE, ROWS, START, checksum, iso, nmea, table

from torchfra.readers import read


@pytest.fixture
def write(tmp_path):
    def write(content, name="a.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


# ---------------------------------------------------------------- times


def test_one_target_that_cannot_be_does_not_stop_the_others(write):
    rows = [(i, name, i * speed, 0) for i in range(40) for name, speed in (("good", 10), ("bad", 1e4))]
    (track,) = read(write(table("t,id,x,y", rows)))
    assert track.name == "good"
    assert track.repairs == {"fixes of target bad dropped, of impossible speed": 40}
    with pytest.raises(ValueError, match=r"expected speeds below 5 km/s, received 10 km/s as the median of target bad"):
        read(write(table("t,id,x,y", [row for row in rows if row[1] == "bad"])))


def test_times_of_the_day_go_on_after_midnight(write):
    (track,) = read(write("time,x,y\n23:59:59,1,2\n00:00:00.5,1,2\n00:00:02,1,3\n"))
    np.testing.assert_array_equal(track.time, [86399, 86400.5, 86402])


# ---------------------------------------------------------------- formats


def test_damaged_sentences_are_left_out_and_said(write):
    lines = [line for row in ROWS for line in nmea(*row)]
    lines[2] = lines[2].replace("*", "1*")
    (track,) = read(write("\n".join(lines), "a.nmea"))
    assert len(track.time) == 6
    assert "1 damaged sentences left out" in track.source.notes[0]


def test_sentences_without_a_date_are_seconds_of_the_day_and_go_on_after_midnight(write):
    late = [
        nmea(second, *place, date=False) for second, place in zip((41590, 41600, 41610), [(47, 8, 1)] * 3, strict=True)
    ]
    (track,) = read(write("\n".join(line for fix in late for line in fix), "a.nmea"))
    np.testing.assert_array_equal(track.time, [86390, 86400, 86410])
    assert "no date" in track.source.notes[0]


def test_a_receiver_without_a_fix_gives_no_position(write):
    lost = checksum("GPRMC,122645.00,V,,,,,,,130920,,,N")
    (track,) = read(write("\n".join([*nmea(*ROWS[0]), lost, *nmea(*ROWS[1])]), "a.nmea"))
    assert len(track.time) == 2
    assert track.repairs == {"rows without position dropped": 1}
    np.testing.assert_array_equal(track.row, [0, 2])


# ---------------------------------------------------------------- what holds for any file


@settings(max_examples=60, deadline=None)
@given(
    rows=st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=2, max_size=20),
    sign=st.sampled_from([";", "\t", "|", " "]),
    comma=st.booleans(),
    head=st.sampled_from(["t{0}x{0}y", "Time{0}East{0}North", "# a note\nT{0}X{0}Y", "t [s]{0}x_m{0}y_m"]),
)  # fmt: skip
def test_any_separator_and_decimal_sign_keep_the_numbers(tmp_path_factory, rows, sign, comma, head):
    head = head.replace(" [s]", "") if sign == " " else head
    text = table(head.format(sign), [(float(i), *row) for i, row in enumerate(rows)], sign)
    path = tmp_path_factory.mktemp("any") / "a.csv"
    path.write_text(text.replace(".", ",") if comma else text)
    (track,) = read(path)
    np.testing.assert_array_equal(track.position, rows)
    np.testing.assert_array_equal(track.time, np.arange(len(rows)))


@settings(max_examples=150, deadline=None)
@given(
    name=st.sampled_from([name for name in FILES if not name.endswith("gz")]),
    at=st.floats(0, 1),
    insert=st.text('0.,;-/:"<>{}[]$*\n\té#', max_size=6) | st.sampled_from(["nan", "<!DOCTYPE", "1e999", "inf"]),
    cut=st.integers(0, 30),
)
def test_a_file_with_a_changed_part_is_read_or_refused_with_a_value_error(tmp_path_factory, name, at, insert, cut):
    text = FILES[name] if isinstance(FILES[name], str) else json.dumps(FILES[name], default=float)
    place = int(at * len(text))
    path = tmp_path_factory.mktemp("any") / name
    path.write_bytes((text[:place] + insert + text[place + cut :]).encode())
    try:
        tracks = read(path)
    except ValueError:
        return
    for track in tracks:
        assert (np.diff(track.time) > 0).all()
        assert np.isfinite(track.position).all()


def test_rows_join_results_to_the_file_whatever_was_repaired(write):
    order = [3, 0, 5, 1, 4, 2]
    rows = [(iso(ROWS[i][0]), *ROWS[i][1:]) for i in order]
    rows.insert(2, ("", 1, 2, 3))
    rows.append(rows[0])
    (track,) = read(write(table("time,lat,lon,alt", rows)))
    assert track.repairs == {"rows without time dropped": 1, "rows put in time order": 5, "duplicate times dropped": 1}
    for fix, row in enumerate(track.row):
        assert rows[row][0] == iso(track.time[fix] - START)
        assert rows[row][1] == LATITUDE[fix]
    assert track.time[0] == START
    assert (len(LONGITUDE), len(ALTITUDE)) == (6, 6)


# ---------------------------------------------------------------- what stands in other columns, and in brackets


def eight(header, row):
    return header + "\n" + "".join(",".join(map(str, row(i))) + "\n" for i in range(8))


@pytest.mark.parametrize("header", [
    "time,Lat Deg,Lat Min,Lon Deg,Lon Min", "time,Latitude (deg),Latitude (min),Longitude (deg),Longitude (min)",
    "time,lat,lat_minutes,lon,lon_minutes", "time,latDD,latMM,lonDD,lonMM",
])  # fmt: skip
def test_degrees_whose_minutes_are_in_another_column_are_refused(write, header):
    path = write(eight(header, lambda i: (i, 47, 18 + i, 8, 30 + i)))
    _, lat, _, lon, _ = header.split(",")
    for words in ({}, {"lat": lat, "lon": lon}):
        if words or "DD" not in header:
            with pytest.raises(ValueError, match=r"received whole ones beside .*: write one column of degrees"):
                read(path, **words)


def test_degrees_beside_their_bounds_are_read(write):
    (track,) = read(write(eight("time,lat,lat_min,lon", lambda i: (i, 47.3 + i / 1e4, 47, 8))))
    assert len(track.time) == 8


@pytest.mark.parametrize(("header", "cell", "option"), [
    ("time,x,y,x_unit", "cm", {"units": "cm"}), ("time,x,y,Time unit", "ms", {"time_format": "ms"}),
    ("time,lat,lon,alt,Alt Units", "ft", {"units": "ft"}),
])  # fmt: skip
def test_a_unit_in_a_column_of_its_own_is_asked_for(write, header, cell, option):
    path = write(eight(header, lambda i: (1000 * i, *range(i, i + header.count(",") - 1), cell)))
    ((name, value),) = option.items()
    with pytest.raises(ValueError, match=f"received {cell} in the column .*: say {name}='{value}'"):
        read(path)
    assert len(read(path, **option)[0].time) == 8


@pytest.mark.parametrize("header", ["Time [1/100 s],x,y", "Time (10ms),x,y", "time (ticks),x,y", "t (elapsed ms),x,y"])
def test_unknown_units_of_times_are_asked_for(write, header):
    path = write(eight(header, lambda i: (100 * i, i, 0)))
    with pytest.raises(ValueError, match=r"expected seconds since a start or since 1970, received .*which is in \("):
        read(path)
    assert np.diff(read(path, time="1", time_format="100fps")[0].time) == pytest.approx(1)
    assert len(read(write(eight("Time (UTC),x,y", lambda i: (100 * i, i, 0))))[0].time) == 8


@pytest.mark.parametrize("line", ["# altitude in feet", "Height [ft]", "# all distances are given in feet"])
def test_units_in_sentences_before_the_header_are_asked_for(write, line):
    path = write(eight(line + "\ntime,lat,lon,alt", lambda i: (i, 47 + i / 1e4, 8, 100 * i)))
    with pytest.raises(ValueError, match=r"a line beside the rows states lengths in (feet|ft): state it by units='ft'"):
        read(path)
    (track,) = read(write(path.read_text().replace(",alt", ",alt (ft)")))
    assert track.position[1, 2] == pytest.approx(30.48, abs=1e-3)
    assert len(read(write(path.read_text().replace(",alt", ",rate")))[0].time) == 8


def test_units_above_the_names_are_those_of_the_columns(write):
    (track,) = read(write(eight("# [s],[mm],[mm]\nt,x,y", lambda i: (i, i, 0))))
    assert track.position[1, 0] == pytest.approx(0.001)


def test_units_beside_records_are_asked_for(write):
    path = write(json.dumps([{"t": i, "x": i, "y": 0, "unit": "cm"} for i in range(8)]), "a.json")
    with pytest.raises(ValueError, match=r"received cm in the column .*units?: say units='cm'"):
        read(path)
    assert read(path, units="cm")[0].position[1, 0] == pytest.approx(0.01)


def test_an_accuracy_in_other_units_than_lengths_is_left_out(write):
    for unit, expected in (("%", None), ("deg", None), ("m", 8)):
        (track,) = read(write(eight(f"t,lat,lon,accuracy ({unit})", lambda i: (i, 47 + i / 1e4, 8, 2))))
        assert (None if track.sigma is None else len(track.sigma)) == expected


def test_sentences_of_two_receivers_in_one_file_are_refused(write):
    pytest.importorskip("pynmea2")
    lines = [checksum(f"GPGGA,1000{i:02}.00,4730.{place}00,N,00830.0000,E,1,10,0.9,400.0,M,48.0,M,,")
             for i in range(20) for place in ("00", "50")]  # fmt: skip
    with pytest.raises(
        ValueError, match="expected one position for each moment, received 20 others in sentences of one kind"
    ):
        read(write("\n".join(lines), "a.nmea"))
    assert len(read(write("\n".join(lines[::2]), "a.nmea"))[0].time) == 20


def test_parts_of_degrees_in_brackets_are_refused(write):
    for unit in ("mdeg", "\u00b5deg", "arcsec"):
        with pytest.raises(ValueError, match="expected metres or degrees, received"):
            read(write(eight(f"t,lat ({unit}),lon ({unit})", lambda i: (i, i, i))))


def test_sides_of_both_in_one_column_are_refused(write):
    path = write(eight("t,lat,lon,hemisphere", lambda i: (i, 47 + i / 1e4, 8, "NW")))
    with pytest.raises(ValueError, match="column lon: expected degrees that grow to the north and east"):
        read(path)
    assert len(read(write(path.read_text().replace("NW", "NE")))[0].time) == 8


def test_a_date_and_a_clock_in_cells_of_a_workbook_are_joined(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["Date", "Time", "Latitude", "Longitude"])
    for i in range(8):
        book.active.append([datetime(2024, 5, 6), clock(10, 0, i), 47 + i / 1e4, 8])
    book.save(tmp_path / "a.xlsx")
    (track,) = read(tmp_path / "a.xlsx")
    assert track.time[:2].tolist() == [1_714_989_600, 1_714_989_601]


# ---------------------------------------------------------------- what stands beside rows


def rows_of(head, rows):
    return "\n".join(",".join(map(str, row)) for row in (head.split(","), *rows)) + "\n"


@pytest.mark.parametrize(("above", "below", "said"), [
    ("", "# units: cm\n", "states lengths in cm: state it by units='cm'"),
    ("# Scale: 0.01 m\n", "", "states a scale, '# Scale: 0.01 m': multiply by it, or say units='m'"),
    ("1 unit = 0.01 m\n", "", "states a scale"),
])  # fmt: skip
def test_units_and_scales_in_lines_beside_the_rows_are_asked_for(write, above, below, said):
    text = above + rows_of("t,x,y", [(i, 2 * i, 3 * i) for i in range(30)]) + below
    with pytest.raises(ValueError, match=said):
        read(write(text))
    np.testing.assert_allclose(read(write(text), units="cm")[0].position[-1], [0.58, 0.87], rtol=1e-12)


def test_degrees_that_grow_to_the_west_are_refused(write):
    text = rows_of("time,lat,lon", [(i, 47 + i / 1e4, 8 + i / 1e4) for i in range(30)])
    with pytest.raises(
        ValueError, match="expected degrees that grow to the east, received '# longitude: west positive'"
    ):
        read(write("# longitude: west positive\n" + text))


def test_numbers_of_frames_beside_their_rate_are_no_seconds(write):
    path = write(json.dumps([{"t": i, "x": 2.0 * i, "y": 3.0 * i, "fps": 50} for i in range(30)]), "a.json")
    with pytest.raises(ValueError, match=r"received numbers of frames: .* time_format='50fps'"):
        read(path)
    np.testing.assert_allclose(read(path, time_format="50fps")[0].time[-1], 29 / 50, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "bad"), [("Fix Quality", 0), ("fix", "none"), ("gps_fix_type", 0), ("VALID", "NO FIX")]
)
def test_rows_of_fix_quality_0_have_no_position(write, name, bad):
    rows = [(i, 47 + i / 1e4 if i % 5 else 46, 8 + i / 1e4, 3 if i % 5 else bad) for i in range(30)]
    (track,) = read(write(rows_of(f"time,lat,lon,{name}", rows)))
    assert track.repairs == {"rows marked as invalid dropped": 6}
    assert np.abs(track.position).max() < 1e3


def test_an_odd_number_of_fixes_two_in_a_second_is_spread(write):
    fixes = [f"B1000{i // 2:02}47183{i:02}N0083050{i // 10}EA00400{400 + i:05}" for i in range(59)]
    (track,) = read(write("\n".join(["AXXX001", "HFDTE060524", *fixes]), "a.igc"))
    np.testing.assert_allclose(np.diff(track.time), 0.5, rtol=1e-6)


def test_platforms_of_argos_are_targets_and_degrees_beside_ecef_are_read(write):
    rows = [
        (1000 + i % 2, f"2024-05-06 {i // 4:02}:{15 * (i % 4):02}:00", 4e6, 47 + i / 1e4, 8 + i % 2) for i in range(60)
    ]
    tracks = read(write(rows_of("Platform ID No.,Loc. date,ECEF_X [m],Latitude,Longitude", rows)))
    assert [track.name for track in tracks] == ["1000", "1001"]
    assert all(len(track.time) == 30 and not track.repairs for track in tracks)


def test_a_zone_behind_the_name_of_a_time_is_asked_for(write):
    text = rows_of("Time (JST),lat,lon", [(f"2024-05-06 10:00:{i:02}", 47 + i / 1e4, 8) for i in range(30)])
    with pytest.raises(ValueError, match=r"zone JST has several .*: write an offset .* which reads the times as UTC"):
        read(write(text))


def test_a_line_of_words_with_a_time_in_front_of_the_header_is_no_header(write):
    rows = [(i, 47 + i / 1e4, 8 + i / 1e4) for i in range(30)]
    (track,) = read(write("Reference time : now\n" + rows_of("time,lat,lon", rows)))
    assert (len(track.time), track.origin[:2]) == (30, (47, 8))


def test_rows_that_jump_to_and_fro_with_a_word_beside_them_are_of_several_targets(write):
    rows = [(60 * i, f"!a{i % 2}", 47 + i / 1e4 + 0.02 * (i % 2), 8 + i / 1e4, "gps") for i in range(40)]
    with pytest.raises(ValueError, match=r"jump to and fro, and do not where node stays the same, .*: say id='node'"):
        read(write(rows_of("time,node,lat,lon,provider", rows)))
    cells = [(i, 47 + i / 1e4, 8, 5, "gps") if i % 3 else (i, 47.01, 8.01, 800, "cell") for i in range(40)]
    (phone,) = read(write(rows_of("time,lat,lon,accuracy,provider", cells)))
    assert len(phone.time) == 40


def test_a_few_degrees_that_are_called_x_and_y_are_no_metres(write):
    rows = [(10 * i, 8.5 + 2e-4 * i, 47.3 + 1.37e-4 * i) for i in range(10)]
    with pytest.raises(ValueError, match=r"looks like degrees of longitude and latitude: say lat='Y', lon='X'"):
        read(write(rows_of("t,X,Y", [(t, f"{x:.6f}", f"{y:.6f}") for t, x, y in rows])))


def test_names_of_rows_without_a_name_above_them_shift_no_columns(write):
    text = "time,x,y\n" + "".join(f'"{i + 1}",{0.5 * i},{2 * i},{3 * i}\n' for i in range(30))
    with pytest.raises(ValueError, match="expected 3 fields in data row 1, received 4"):
        read(write(text), time="time", x="x", y="y")


def test_an_accuracy_of_another_share_than_68_percent_is_left_out(write):
    (track,) = read(write(rows_of("time,lat,lon,accuracy (95%)", [(i, 47 + i / 1e4, 8, 10) for i in range(30)])))
    assert track.sigma is None


def test_a_header_that_comes_twice_above_the_rows_has_no_units(write):
    (track,) = read(write("time,x,y\n" + rows_of("time,x,y", [(i, 2 * i, 3 * i) for i in range(30)])))
    np.testing.assert_allclose(track.position[-1], (58, 87))


def test_parts_of_times_in_columns_are_joined_as_the_error_says(write):
    text = rows_of("Id,Year,Month,Day,Hour,Minute,Second,lat,lon",
                   [("a", 2024, 5, 6, 10 + i // 60, i % 60, 3, 47 + i / 1e4, 8) for i in range(80)])  # fmt: skip
    parts = {"time": "Year,Month,Day,Hour,Minute,Second", "time_format": "%Y %m %d %H %M %S"}
    with pytest.raises(ValueError, match="received parts of them: say " + re.escape(
            f"time={parts['time']!r}, time_format={parts['time_format']!r}")):  # fmt: skip
        read(write(text))
    (track,) = read(write(text), **parts)
    np.testing.assert_allclose(
        track.time, datetime(2024, 5, 6, 10, 0, 3, tzinfo=timezone.utc).timestamp() + 60 * np.arange(80)
    )


def test_a_decimal_comma_where_points_are_expected_names_the_option(write):
    path = write("time,x,y\n" + "".join(f'{i},"{i},50",2\n' for i in range(30)))
    with pytest.raises(ValueError, match=r"received '0,50', whose sign may part thousands or decimals.*option decimal"):
        read(path)
    np.testing.assert_allclose(read(path, decimal=",")[0].position[:, 0], np.arange(30) + 0.5)


# ---------------------------------------------------------------- radians, and accuracies that nobody knows


def degrees_at(lat, lon, step, columns="time,lat,lon"):
    return table(columns, [(i, f"{lat + i * step:.9f}", f"{lon + i * step:.9f}") for i in range(40)])


def test_radians_that_are_called_latitudes_are_refused_and_read_as_what_they_are_said_to_be(write):
    path = write(degrees_at(0.82, 0.15, 2e-6))
    with pytest.raises(ValueError, match=r"looks like radians: write degrees, or say lat='lat', lon='lon' if"):
        read(path)
    (track,) = read(path, lat="lat", lon="lon")
    assert track.position[-1] == pytest.approx([39 * 2e-6 * 111_300, 39 * 2e-6 * 110_600], rel=1e-2)


@pytest.mark.parametrize(("place", "step", "columns"), [
    ((0.0, 0.0), 1e-5, "time,lat,lon"), ((1.2, 2.5), 2e-4, "time,lat,lon"),
    ((1.2, 2.5), 1e-6, "time,lat [deg],lon [deg]"),
])  # fmt: skip
def test_true_places_near_the_equator_are_read(write, place, step, columns):
    (track,) = read(write(degrees_at(*place, step, columns)))
    assert track.origin[:2] == pytest.approx(place)


def test_a_boat_in_the_gulf_of_guinea_beside_others_elsewhere_is_read(write):
    rows = [(i, name, place + i * 1e-6, 2.5) for i in range(40) for name, place in (("a", 1.2), ("b", 14.0))]
    assert [track.name for track in read(write(table("time,id,lat,lon", rows)))] == ["a", "b"]


@pytest.mark.parametrize(
    ("column", "unknown"), [("hdop", "99.99"), ("eph", "65535"), ("eph", "655.35"), ("hacc", "4294967295")]
)
def test_an_accuracy_that_a_receiver_does_not_know_is_missing_and_it_is_said(write, column, unknown):
    rows = [(i, 47 + i * 1e-4, 8, unknown if i % 4 == 0 else "1.5") for i in range(40)]
    (track,) = read(write(table(f"time,lat,lon,{column}", rows)))
    assert np.ptp(track.sigma) == 0
    assert track.repairs == {"sigmas filled with their median": 10}
    assert f"{unknown} is no accuracy" in " ".join(track.source.notes)
    (track,) = read(write(table(f"time,lat,lon,{column}", [(*row[:3], unknown) for row in rows])))
    assert track.sigma is None
