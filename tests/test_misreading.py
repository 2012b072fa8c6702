"""What would be read wrongly is refused in a line that says what is meant and what to do; the rest goes on."""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_formats import ALTITUDE, FILES, LATITUDE, LONGITUDE, ROWS, START, checksum, csv, gpx, iso, kml, nmea, table

from torchfra.readers import read

MANY = np.arange(963)


@pytest.fixture
def write(tmp_path):
    def write(content, name="a.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


# ---------------------------------------------------------------- times


def flight(times, column="timestamp"):
    return table(f"{column},latitude,longitude", [(t, 47 + i / 1e4, 8) for i, t in enumerate(times)])


def test_seconds_of_the_day_are_no_times_since_1970_unless_the_caller_says_so(write):
    path = write(flight(44800 + MANY))
    said = r"a\.csv: column timestamp: .* received 44800 to 45762, which looks like seconds of the day .*: use --time"
    with pytest.raises(ValueError, match=said):
        read(path)
    (track,) = read(path, time="timestamp")
    assert track.time[-1] == 45762


def test_years_before_1980_are_refused_and_single_ones_dropped(write):
    said = "years from 1980 on in row 1 of when, received 1970-01-01T12:26:00Z, which looks like times since a start"
    early = [f"1970-01-01T12:{26 + i // 60}:{i % 60:02}Z" for i in range(60)]
    with pytest.raises(ValueError, match=said):
        read(write(flight(early, "when")), time="when")
    (track,) = read(write(flight([early[0], *(iso(t) for t in range(9))], "time")))
    assert track.repairs == {"rows from before 1980 dropped": 1}


@pytest.mark.parametrize(("unit", "name"), [(1e3, "ms"), (1e6, "us")])
def test_a_track_that_moves_too_fast_is_refused_with_the_unit_that_is_meant(write, unit, name):
    text = table("t,x,y", [(i * unit, 10 * i, 0) for i in MANY])
    assert len(read(write(text))[0].time) == 963  # slow is possible
    text = table("t,x,y", [(i / unit, 10 * i, 0) for i in MANY])
    with pytest.raises(
        ValueError, match=r"a\.csv: expected .* column t may be in .*days: say by --time-format, or name"
    ):
        read(write(text))
    text = table("elapsed_ms,x,y", [(i, 10 * i, 0) for i in MANY])
    with pytest.raises(
        ValueError, match=r"received 963 fixes within 0\.962 s .* looks like seconds: use --time-format"
    ):
        read(write(text))
    (track,) = read(write(text), time_format="seconds")
    assert track.time[-1] == 962


def test_one_target_that_cannot_be_does_not_stop_the_others(write):
    rows = [(i, name, i * speed, 0) for i in range(40) for name, speed in (("good", 10), ("bad", 1e4))]
    (track,) = read(write(table("t,id,x,y", rows)))
    assert track.name == "good"
    assert track.repairs == {"fixes of target bad dropped, of impossible speed": 40}
    with pytest.raises(ValueError, match=r"expected speeds below 5 km/s, received 10 km/s as the median of target bad"):
        read(write(table("t,id,x,y", [row for row in rows if row[1] == "bad"])))


def test_a_day_that_may_be_a_month_is_refused_by_its_column(write):
    text = "when,x,y\n03/04/2020 12:00:00,1,2\n03/04/2020 12:00:01,1,2\n"
    with pytest.raises(ValueError, match=r"a\.csv: column when: .* the day or the month first: use --time-form"):
        read(write(text), time="when")
    assert read(write(text), time="when", time_format="%d/%m/%Y %H:%M:%S")[0].time[0] == 1_585_915_200


def test_times_of_the_day_go_on_after_midnight(write):
    (track,) = read(write("time,x,y\n23:59:59,1,2\n00:00:00.5,1,2\n00:00:02,1,3\n"))
    np.testing.assert_array_equal(track.time, [86399, 86400.5, 86402])
    assert track.source.written(track.time) == ["23:59:59.000", "00:00:00.500", "00:00:02.000"]


# ---------------------------------------------------------------- cells


@pytest.mark.parametrize(("text", "said"), [
    ("time,lat,lon\nnoon,1,2\n", "expected times in data row 1, column time, received 'noon': say how"),
    ("utc,lat,lon\nnoon,1,2\n", "expected ms since 1970 or ISO text in data row 1, column utc, received 'noon'"),
    (csv().replace("47.0", "x", 1), "expected degrees within .* in data row 1, column lat, received 'x"),
    (csv() + "2020-09-31T00:00:00Z,47,8,1\n", "ISO text in data row 7, column time, received '2020-09-31T00:00:00Z'"),
    (csv(form="%d/%m/%Y %H:%M:%S") + "soon,47,8,1\n", "a time such as 13/09/2020 12:26:40 in data row 7, column time"),
    ("t;x;y\n0;1,5;2\n1;1,5,0;2\n", "expected a number in data row 2, column x, received '1,5,0'"),
    ("t;x;y\n0;1,5;2\n1;1_5;2\n", "expected a number in data row 2, column x, received '1_5'"),
    ("t\tx\ty\n0\t1\n", "expected 3 fields in data row 1, received 2"),
    ("lat,lon\n1,2\n", "missing time, received lat, lon"),
    ("time,lat,x\n1,2,3\n", "missing longitude, y, received time, lat, x"),
    ("mmsi,t,lat,lon\n1,0,92,8\n", "expected degrees within .* in data row 1, column lat, received '92'"),
])  # fmt: skip
def test_a_bad_cell_is_named_by_file_row_and_column(write, text, said):
    with pytest.raises(ValueError, match=rf"a\.csv: .*{said}"):
        read(write(text))


# ---------------------------------------------------------------- formats

BOMB = '<!DOCTYPE x [<!ENTITY a "lol"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>'
POINT = '<trkpt lat="{}" lon="8"><time>2020-09-13T12:26:40Z</time></trkpt>'


@pytest.mark.parametrize(("name", "text", "said"), [
    ("a.gpx", gpx(head=BOMB), "expected GPX, KML or TCX without <!DOCTYPE>"),
    ("a.gpx", gpx()[:-20], "expected GPX, KML or TCX, received other text"),
    ("a.gpx", gpx(POINT.format("1_0") * 2), "expected a number as lat, received '1_0'"),
    ("a.gpx", gpx(POINT.format("inf") * 2), "expected a number as lat, received 'inf'"),
    ("a.gpx", gpx(POINT.format("91") * 2), "expected degrees within .* in data row 1, column latitude, received 91"),
    ("a.gpx", gpx('<trkpt lat="1" lon="8"/>' * 3), "expected GPX with times, received 3 points without any"),
    ("a.gpx", gpx(" "), "expected GPX with tracks, received none"),
    ("a.gpx", gpx("<extensions>" + "<a>" * 200_000 + "</a>" * 200_000 + "</extensions>"), "within at most 64 others"),
    ("a.xml", "<html></html>", "expected GPX, KML or TCX, received other XML"),
    ("a.kml", kml().replace("</kml>", ""), "expected GPX, KML or TCX, received other text"),
    ("a.kml", kml().replace("<gx:coord>", "<other>", 1).replace("</gx:coord>", "</other>", 1),
     "expected a time for each of 5 places of a track, received 6"),
    ("a.kml", "<kml><Placemark><LineString><coordinates>1,2 3,4</coordinates></LineString></Placemark></kml>",
     "expected KML with times .* received lines without any"),
    ("a.geojson", json.dumps(FILES["line.geojson"] | {"properties": {}}, default=float),
     "expected a time for each of the 6 places of feature 1"),
    ("a.geojson", '{"type": "Feature", "geometry": {"type": "Polygon"}}', "points and lines, .* feature 1"),
    ("a.geojson", '{"type": "FeatureCollection", "features": [3]}', "points and lines, .* feature 1"),
    ("a.nmea", "$GPGSV,1,1,00*79\n" * 3, "expected NMEA 0183 with RMC or GGA, received .*3"),
    ("a.nmea", "!AIVDM,1,1,,A,13oUhr0000151NhWKUi1vPvJ08Re,0*3A\n", "AIS messages must be decoded before"),
    ("a.parquet", "PAR1" + "a" * 50, "expected a complete Parquet or Feather file, received none"),
    ("a.feather", "ARROW1" + "a" * 50, "expected a complete Parquet or Feather file, received none"),
])  # fmt: skip
def test_a_damaged_file_is_refused_by_what_was_expected(write, name, text, said):
    with pytest.raises(ValueError, match=rf"(?s){name}: .*{said}"):
        read(write(text, name))


@pytest.mark.parametrize("name", ["walk.gpx", "walk.kml", "walk.nmea", "line.geojson"])
def test_the_bound_on_memory_holds_for_every_format(write, name):
    text = FILES[name] if isinstance(FILES[name], str) else json.dumps(FILES[name], default=float)
    weight = 24 if name.endswith("json") else 32
    size = len(text) * weight if not name.endswith("nmea") else max(len(text), 64 * (text.count("\n") + 1))
    assert len(read(write(text, name), max_bytes=size)[0].time) == 6
    with pytest.raises(ValueError, match=r"--max-bytes\) raises that"):
        read(write(text, name), max_bytes=size - weight)


@pytest.mark.parametrize("kind", ["parquet", "feather"])
def test_the_bound_on_memory_holds_for_columns_that_are_packed_well(tmp_path, kind):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import feather, parquet

    data = pyarrow.table({"t": np.arange(200_000.0), "x": np.zeros(200_000), "y": np.zeros(200_000)})
    path = tmp_path / f"a.{kind}"
    (parquet.write_table if kind == "parquet" else feather.write_feather)(data, path)
    assert len(read(path)[0].time) == 200_000
    with pytest.raises(ValueError, match="of columns, of which a row counts for 64 or more"):
        read(path, max_bytes=10_000_000)


@pytest.mark.parametrize("kind", ["parquet", "feather"])
def test_texts_that_are_packed_well_are_refused_before_they_unfold(tmp_path, kind):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import feather, parquet

    names = pyarrow.array(["x" * 2**14 + str(i % 500) for i in range(1000)])
    data = pyarrow.table({"t": np.arange(1000.0), "x": np.zeros(1000), "y": np.zeros(1000), "id": names})
    path = tmp_path / f"a.{kind}"
    (parquet.write_table if kind == "parquet" else feather.write_feather)(data, path)
    assert path.stat().st_size < 1_000_000
    with pytest.raises(ValueError, match="of columns, of which a row counts for 64 or more"):
        read(path, max_bytes=5_000_000)
    assert len(read(path)) == 500


@pytest.mark.parametrize("kind", ["parquet", "feather"])
def test_a_damaged_table_of_columns_is_read_or_refused_with_a_value_error(tmp_path, kind):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import feather, parquet

    data = pyarrow.table({"t": np.arange(50.0), "x": np.zeros(50), "y": np.zeros(50), "id": ["a"] * 50})
    path = tmp_path / f"a.{kind}"
    (parquet.write_table if kind == "parquet" else feather.write_feather)(data, path)
    whole, random = path.read_bytes(), np.random.default_rng(2)
    for _ in range(100):
        damaged = bytearray(whole)
        for place in random.integers(8, len(whole), 2):
            damaged[place] = random.integers(256)
        path.write_bytes(damaged[: random.choice([len(whole), random.integers(9, len(whole))])])
        with contextlib.suppress(ValueError):
            read(path)


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
        assert rows[row][0] == track.source.written(track.time[fix : fix + 1])[0]
        assert rows[row][1] == LATITUDE[fix]
    assert track.time[0] == START
    assert (len(LONGITUDE), len(ALTITUDE)) == (6, 6)
