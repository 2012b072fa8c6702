"""Every file that people have of a track is read as it is meant, and it is said how."""

from __future__ import annotations

import gzip
import json
import re
from datetime import date, datetime, timedelta, timezone

import numpy as np
import pymap3d
import pytest

from torchfra.cli.main import main
from torchfra.readers import read

START = 1_600_000_000  # 2020-09-13T12:26:40Z
STEPS = np.arange(0, 60, 10)
LATITUDE, LONGITUDE, ALTITUDE = 47 + STEPS / 1e4, 8 + STEPS / 2e4, 400.0 + STEPS
EAST_NORTH_UP = np.stack(pymap3d.geodetic2enu(LATITUDE, LONGITUDE, ALTITUDE, LATITUDE[0], LONGITUDE[0], ALTITUDE[0]), 1)
ROWS = list(zip(STEPS, LATITUDE, LONGITUDE, ALTITUDE, strict=True))


def iso(second, form="%Y-%m-%dT%H:%M:%SZ"):
    return (datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(seconds=START + float(second))).strftime(form)


def table(header, rows, sign=","):
    return "\n".join([header, *(sign.join(map(str, row)) for row in rows)]) + "\n"


def csv(header="time,lat,lon,alt", sign=",", form="%Y-%m-%dT%H:%M:%SZ"):
    return table(header, [(iso(t, form), a, o, h) for t, a, o, h in ROWS], sign)


def commas(text):
    return text.replace(".", ",")


def checksum(body):
    value = 0
    for letter in body:
        value ^= ord(letter)
    return f"${body}*{value:02X}"


def nmea(second, latitude, longitude, altitude, date=True, hdop=0.9):
    def degrees(value, digits):
        return f"{int(value):0{digits}d}{(value % 1) * 60:010.7f}"

    clock, place = iso(second, "%H%M%S.00"), f"{degrees(latitude, 2)},N,{degrees(longitude, 3)},E"
    gga = checksum(f"GPGGA,{clock},{place},1,08,{hdop},{altitude:.1f},M,47.0,M,,")
    return [checksum(f"GPRMC,{clock},A,{place},0.0,90.0,{iso(second, '%d%m%y')},,,A")] * date + [gga]


def gpx(points=None, name="<name>walk</name>", head=""):
    points = points or "".join(
        f'<trkpt lat="{a}" lon="{o}"><ele>{h}</ele><time>{iso(t)}</time><hdop>2.0</hdop></trkpt>' for t, a, o, h in ROWS
    )
    start = f'<?xml version="1.0" encoding="UTF-8"?>{head}<gpx version="1.1" creator="x" '
    return f'{start}xmlns="http://www.topografix.com/GPX/1/1"><trk>{name}<trkseg>{points}</trkseg></trk></gpx>'


def kml():
    whens = "".join(f"<when>{iso(t)}</when>" for t, *_ in ROWS)
    places = "".join(f"<gx:coord>{o} {a} {h}</gx:coord>" for _, a, o, h in ROWS)
    start = '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>'
    return f"{start}<Placemark><name>walk</name><gx:Track>{whens}{places}</gx:Track></Placemark></Document></kml>"


def kml_points():
    marks = "".join(
        f"<Placemark><TimeStamp><when>{iso(t)}</when></TimeStamp><Point><coordinates>{o},{a},{h}</coordinates></Point>"
        "</Placemark>" for t, a, o, h in ROWS
    )  # fmt: skip
    return f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{marks}</Document></kml>'


def geojson_line():
    line = {"type": "LineString", "coordinates": [[o, a, h] for _, a, o, h in ROWS]}
    return {"type": "Feature", "geometry": line, "properties": {"coordTimes": [iso(t) for t, *_ in ROWS]}}


def geojson_points():
    return {"type": "FeatureCollection", "features": [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [o, a, h]}, "properties": {"time": iso(t)}}
        for t, a, o, h in ROWS
    ]}  # fmt: skip


FILES = {
    "plain.csv": csv(),
    "upper.CSV": csv("TIME,LAT,LON,ALT"),
    "spelt.csv": csv("Timestamp (UTC),Latitude [deg],Longitude [deg],Altitude (m)"),
    "short.csv": csv("utc,lat_deg,lng,height_m"),
    "moves.csv": csv("timestamp,location-lat,location-long,height"),
    "stamps.csv": table("unixtime,lat,lon,ele", [(START + t, a, o, h) for t, a, o, h in ROWS]),
    "ms.csv": table("t_ms,lat,lon,ele", [(1000 * (START + t), a, o, h) for t, a, o, h in ROWS]),
    "drone.csv": table("TimeUS,Lat,Lng,Alt", [(10**6 * (START + t), a, o, h) for t, a, o, h in ROWS]),
    "semicolons.csv": commas(csv("zeit;lat;lon;alt".replace("zeit", "time"), ";")),
    "tabs.tsv": csv("time\tlat\tlon\talt", "\t"),
    "bars.txt": csv("time|lat|lon|alt", "|"),
    "spaces.txt": csv("time   lat lon  alt", "  "),
    "excel.csv": "sep=;\n" + commas(csv("time;lat;lon;alt", ";")),
    "comments.csv": "# recorded by me\n# twice; on a walk\n\n" + csv().replace("\n2", "\n# a pause\n2", 2),
    "heading.csv": csv("# time,lat,lon,alt"),
    "spanish.csv": csv("time,lat,lon,alt", form="%d/%m/%Y %H:%M:%S"),
    "american.csv": csv("time,lat,lon,alt", form="%m/%d/%Y %I:%M:%S %p"),
    "parted.csv": table("date,time,lat,lon,alt", [(iso(t, "%d.%m.%Y"), iso(t, "%H:%M:%S"), *x) for t, *x in ROWS]),
    "trailing.csv": csv().replace("\n", ",\n").replace("alt,\n", "alt\n"),
    "walk.gpx": gpx(), "walk.gpx.gz": gpx(), "walk.txt": gpx(),
    "walk.kml": kml(), "points.kml": kml_points(),
    "line.geojson": geojson_line(), "points.geojson": geojson_points(), "points.json": geojson_points(),
    "lists.json": {"time": [iso(t) for t in STEPS], "lat": [*LATITUDE], "lon": [*LONGITUDE], "alt": [*ALTITUDE]},
    "walk.nmea": "\r\n".join(line for row in ROWS for line in nmea(*row)),
    "log.txt": "\n".join(line for row in ROWS for line in [*nmea(*row), "$GPGSV,1,1,00*79"]),
}  # fmt: skip


@pytest.fixture
def write(tmp_path):
    def write(name, content):
        text = content if isinstance(content, str) else json.dumps(content, default=float)
        path = tmp_path / name
        path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
        return path

    return write


@pytest.mark.parametrize("name", FILES)
def test_the_same_walk_is_read_from_every_file(write, name):
    (track,) = read(write(name, FILES[name]))
    np.testing.assert_array_equal(track.time, START + STEPS)
    np.testing.assert_allclose(track.position, EAST_NORTH_UP, rtol=0, atol=1e-3)
    np.testing.assert_array_equal(track.row, np.arange(6))
    assert track.repairs == {}
    assert track.source.word == "target"


@pytest.mark.parametrize("name", ["walk.parquet", "walk.feather", "walk.arrow", "named.dat"])
@pytest.mark.parametrize("zone", [None, "UTC"])
def test_columns_of_parquet_and_feather_are_read_too(tmp_path, name, zone):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import feather, parquet

    moments = pyarrow.array([int(1e6 * (START + t)) for t in STEPS]).cast(pyarrow.timestamp("us", zone))
    data = pyarrow.table({"timestamp": moments, "lat": LATITUDE, "lon": LONGITUDE, "height": ALTITUDE, "id": ["a"] * 6})
    write = parquet.write_table if "parquet" in name or "dat" in name else feather.write_feather
    write(data, tmp_path / name)
    (track,) = read(tmp_path / name)
    np.testing.assert_array_equal(track.time, START + STEPS)
    np.testing.assert_allclose(track.position, EAST_NORTH_UP, rtol=0, atol=1e-3)
    assert track.name == "a"


def test_marks_and_dates_of_parquet_are_read(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    days = [date(2024, 5, 6 + i) for i in range(6)]
    valid = [True, True, False, None, True, True]
    columns = {"date": days, "lat": LATITUDE, "lon": LONGITUDE, "valid": valid}
    parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    (track,) = read(tmp_path / "a.parquet")
    np.testing.assert_array_equal(np.diff(track.time), 86_400 * np.array([1, 2, 1, 1]))
    assert track.repairs == {"rows marked as invalid dropped": 1}


@pytest.mark.parametrize(
    ("points", "said"), [("", "GPX: 1 track"), ('<wpt lat="47" lon="8"/>', "points of routes left out: 1")]
)
def test_tracks_of_gpx_and_what_is_left_out_are_counted_in_words(write, points, said):
    (track,) = read(write("a.gpx", gpx().replace("<trk>", f"{points}<trk>")))
    assert any(line.endswith(said) for line in track.source.notes)


def test_names_of_gpx_may_have_a_prefix(write):
    text = re.sub(r"<(/?)(?=[a-z])", r"<\1g:", gpx()).replace("xmlns=", "xmlns:g=")
    plain, prefixed = read(write("a.gpx", gpx())), read(write("b.gpx", text))
    np.testing.assert_array_equal(prefixed[0].position, plain[0].position)
    np.testing.assert_array_equal(prefixed[0].time, plain[0].time)


# ---------------------------------------------------------------- ships and aircraft

DANISH = """# Timestamp,Type of mobile,MMSI,Latitude,Longitude,Navigational status,ROT,SOG,COG,Heading,IMO,Callsign,Name
13/09/2020 12:26:40,Class A,219000001,55.5,12.5,Moored,0,0.0,10.0,20,9000001,ABCD,FERRY
13/09/2020 12:26:40,Class B,219000002,55.6,12.6,,,5.0,10.0,20,Unknown,,
13/09/2020 12:26:50,Class A,219000001,55.5,12.5,Moored,0,0.0,10.0,20,9000001,ABCD,FERRY
13/09/2020 12:27:00,Class A,219000001,55.5,12.5,Moored,0,0.0,10.0,20,9000001,ABCD,FERRY
13/09/2020 12:27:00,Class B,219000002,55.601,12.6,,,5.0,10.0,20,Unknown,,
13/09/2020 12:27:00,Base Station,2190003,91,181,,,,,,,,
"""


def test_a_danish_log_of_ships_keeps_every_fix_of_a_moored_one(write):
    moored, sailing = read(write("aisdk.csv", DANISH))
    assert (moored.name, sailing.name) == ("219000001 FERRY", "219000002")
    np.testing.assert_array_equal(moored.time, [START, START + 10, START + 20])
    np.testing.assert_array_equal(moored.row, [0, 2, 3])
    assert (moored.position == 0).all()
    assert moored.repairs == {"ships of one fix or none dropped": 1}
    assert moored.source.word == "ship"


def test_a_log_of_the_solent_is_read(write):
    text = "MMSI,Vessel_Name,Time,Longitude_degrees,Latitude_degrees,SOG\n" + "".join(
        f"235{i},A,2016-01-12 13:0{t}:11,-1.{i},50.{t},3\n" for t in range(3) for i in range(2)
    )
    tracks = read(write("SolentAIS.csv", text))
    assert [track.name for track in tracks] == ["2350 A", "2351 A"]
    assert tracks[0].time[0] == 1_452_603_611


def test_aircraft_are_in_feet_and_their_held_positions_are_none(write):
    text = "timestamp,icao24,callsign,latitude,longitude,altitude,groundspeed\n" + "".join(
        f"{iso(t, '%Y-%m-%d %H:%M:%S+00:00')},abc,AB1,{47 + t // 2 / 100},8,1000,200\n" for t in range(6)
    )
    (track,) = read(write("flight.csv", text))
    assert track.repairs == {"held positions dropped": 3}
    np.testing.assert_array_equal(track.row, [0, 2, 4])
    assert (track.source.word, track.source.unit, track.origin[2]) == ("aircraft", 0.3048, 304.8)
    assert "altitude: altitude, in feet; option units takes others" in track.source.notes
    assert read(write("flight.csv", text), units="m")[0].origin[2] == 1000


# ---------------------------------------------------------------- what is said


def test_of_two_times_the_iso_text_is_taken_and_the_other_named(write):
    rows = [(44800 + t, iso(t), *place) for t, *place in ROWS]
    (track,) = read(write("a.csv", table("timestamp,utc,lat,lon,alt", rows)))
    assert track.time[0] == START
    assert track.source.notes[0] == "time: utc, ISO text; not timestamp (option time takes another)"
    (track,) = read(write("a.csv", table("timestamp,utc,lat,lon,alt", rows)), time="timestamp")
    np.testing.assert_array_equal(track.time, 44800 + STEPS)


def test_ignored_columns_and_units_are_said_in_a_line_each(write):
    (track,) = read(write("a.csv", "t,x_ft,y_ft,speed,note\n0,1,2,3,a\n1,2,3,4,b\n"))
    assert track.source.notes == ("time: t, seconds", "position: x_ft, y_ft, in feet", "ignored: speed, note")
    np.testing.assert_allclose(track.position[0], [0.3048, 0.6096])
    assert track.source.columns == {"time": "t", "x": "x_ft", "y": "y_ft"}
    (track,) = read(write("a.csv", commas("t;x;y\n0;1.5;2\n1;2;3\n")))
    assert track.source.notes[:2] == ("separated by semicolons", "decimal commas")


def test_columns_that_number_the_rows_are_no_targets(write):
    text = table("id,time,lat,lon", [(i, iso(t), a, o) for i, (t, a, o, _) in enumerate(ROWS)])
    (track,) = read(write("a.csv", text))
    assert "ignored: id" in track.source.notes


# ---------------------------------------------------------------- what a caller says


def test_any_column_can_be_named(write):
    text = commas("wann;rechts;hoch;oben;wer;fehler\n0;1.5;2;3;a;2\n1;2.5;3;4;a;4\n0;9;9;9;b;1\n1;9;9;9;b;1\n")
    one, other = read(write("a.csv", text), time="wann", x="rechts", y="hoch", z="oben", id="wer",
                      sigma_column="fehler", units="ft", decimal=",", delimiter="semicolon")  # fmt: skip
    assert (one.name, other.name) == ("a", "b")
    np.testing.assert_allclose(one.position, np.array([[1.5, 2, 3], [2.5, 3, 4]]) * 0.3048)
    np.testing.assert_allclose(one.sigma, [0.6096, 1.2192])
    np.testing.assert_array_equal(other.row, [2, 3])


@pytest.mark.parametrize(("words", "said"), [
    ({"time": "when"}, "expected a column when, received time, lat, lon, alt"),
    ({"units": "inch"}, "units: expected m, ft, km, .* received 'inch'"),
    ({"decimal": ";"}, "decimal: expected . or ,, received ';'"),
    ({"delimiter": "ab"}, "delimiter: expected one character or tab, space, comma, semicolon, received 'ab'"),
    ({"time_format": "weeks"}, "time_format: expected one of seconds, ms, us, ns, .* iso, or such as"),
    ({"x": "lat"}, "x, y: expected both or neither"),
    ({"x": "lat", "y": "lon", "lat": "lat", "lon": "lon"}, "expected columns of metres or of degrees, received both"),
    ({"colour": "red"}, "colour: expected one of time, x, y"),
    ({"time": 3}, "time: expected text, received 3"),
])  # fmt: skip
def test_what_a_caller_says_is_checked(write, words, said):
    with pytest.raises(ValueError, match=said):
        read(write("a.csv", csv()), **words)


@pytest.mark.parametrize(("form", "written"), [
    ("%Y%m%d%H%M%S", "20200913122640"), ("%d %b %Y %H:%M:%S", "13 Sep 2020 12:26:40"), ("ms", f"{START}000"),
])  # fmt: skip
def test_a_form_of_times_can_be_said(write, form, written):
    later = f"{START + 1}000" if form == "ms" else iso(1, form)
    (track,) = read(write("a.csv", f"when,x,y\n{written},1,2\n{later},2,3\n"), time="when", time_format=form)
    np.testing.assert_array_equal(track.time, [START, START + 1])


# ---------------------------------------------------------------- how good a fix is


@pytest.mark.parametrize(("column", "factor"), [
    ("hdop", 5 / 2**0.5), ("accuracy", 1 / 1.5096), ("sigma", 1.0), ("eph", 1.0), ("horizontalAccuracy", 1 / 1.5096),
])  # fmt: skip
def test_columns_of_accuracy_become_standard_deviations(write, column, factor):
    rows = [(iso(t), a, o, 2.0) for t, a, o, _ in ROWS]
    rows[3] = (*rows[3][:3], "")
    (track,) = read(write("a.csv", table(f"time,lat,lon,{column}", rows)))
    np.testing.assert_allclose(track.sigma, 2.0 * factor, rtol=1e-3)
    assert track.repairs == {"sigmas filled with their median": 1}
    assert track.source.notes[-1].startswith(f"sigma: {column}")


def test_every_axis_may_have_its_own(write):
    text = "t,x,y,z,sigma_x,sigma_y,sigma_z\n0,1,2,3,1,2,3\n1,2,3,4,4,5,6\n"
    np.testing.assert_array_equal(read(write("a.csv", text))[0].sigma, [[1, 2, 3], [4, 5, 6]])
    assert read(write("a.csv", text.replace("sigma_z", "note")))[0].sigma.tolist() == [[1, 2, 2], [4, 5, 5]]


def test_the_hdop_of_receivers_is_taken(write):
    for name in ("walk.gpx", "walk.nmea"):
        (track,) = read(write(name, FILES[name]))
        assert track.sigma.shape == (6,)
        assert "ranges good to 5 m" in " ".join(track.source.notes)


# ---------------------------------------------------------------- what people's devices write


def test_callsigns_part_flights_where_nothing_else_does(write):
    rows = [(iso(t), call, 47 + t / 1e4 + i, 8, 1000) for t in STEPS for i, call in enumerate(("AB1", "CD2"))]
    assert [track.name for track in read(write("a.csv", table("time,callsign,lat,lon,altitude", rows)))] == [
        "AB1",
        "CD2",
    ]


def test_a_date_goes_before_a_finer_time_which_is_named(write):
    rows = [(100 * i, iso(i // 10, "%Y-%m-%d %H:%M:%S"), 47 + i / 1e6, 8) for i in range(40)]
    path = write("drone.csv", table("time(millisecond),datetime(utc),latitude,longitude", rows))
    for words, start in (({}, START), ({"time": "time(millisecond)"}, 0)):
        np.testing.assert_allclose(read(path, **words)[0].time - start, np.arange(40) / 10, atol=1e-6)
    said = "time: datetime(utc), ISO text; not time(millisecond) (option time takes another)"
    assert read(path)[0].source.notes[0] == said


def test_text_as_spreadsheets_write_it_is_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(csv("time\tlat\tlon\talt", "\t").encode("utf-16"))
    np.testing.assert_array_equal(read(path)[0].time, START + STEPS)


def test_a_danish_log_of_a_day_that_may_be_a_month_has_the_day_first(write):
    text = "# Timestamp,Type of mobile,MMSI,Latitude,Longitude\n" + "".join(
        f"02/01/2020 00:00:{second:02},Class A,219000001,55.5,12.5\n" for second in range(3)
    )
    assert read(write("aisdk.csv", text))[0].time[0] == 1_577_923_200


def test_the_commands_take_the_same_by_options(write, capsys):
    path = write("a.csv", commas("wann;hoch;rechts\n0;1.5;2\n1;2.5;3\n"))
    assert main(["compare", str(path), "--x", "rechts", "--y", "hoch"]) == 2
    said = capsys.readouterr().err
    assert "such as --time TIME --x rechts --y hoch; columns: wann (0, 1), hoch" in said
    assert main(["compare", str(path), "--x", "rechts", "--y", "hoch", "--time", "wann", "--decimal", "."]) == 2
    assert "expected a number in data row 1, column rechts, received '1,5'" in capsys.readouterr().err.replace(
        "hoch", "rechts"
    )
    assert main(["compare", "--scenario", "growth", "--time", "t"]) == 2
    assert "time: expected beside files, received beside --scenario" in capsys.readouterr().err
