"""Reading tracks: what comes out of every format, what is repaired and counted, and what is refused."""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra import readers
from torchfra.readers import Recording, read, resample
from torchfra.readers.options import AskError

Write = Callable[..., Path]
CENTRE = (47.0, 8.0, 0.0)
START = 1_600_000_000
HEADERS = r"expected a header with a time and x,y\[,z\] or lat,lon\[,alt\]"


@pytest.fixture(scope="module")
def write(tmp_path_factory: pytest.TempPathFactory) -> Write:
    folder = tmp_path_factory.mktemp("tracks")

    def write(name: str, content: Any) -> Path:
        data = content if isinstance(content, str | bytes) else json.dumps(content)
        data = data.encode() if isinstance(data, str) else data
        path = folder / name
        path.write_bytes(gzip.compress(data) if name.endswith(".gz") and data[:2] != b"\x1f\x8b" else data)
        return path

    return write


def record(second: float, latitude: Any = None, **more: Any) -> dict[str, Any]:
    place = 47 + second / 1e3 if latitude is None else latitude
    return {
        "timestamp": 1000 * (START + second),
        "latitude": place,
        "longitude": 8.0,
        "altitude": 1000.0,
        "callsign": None,
    } | more


def flight(seconds: Any = range(0, 40, 10), **more: Any) -> list[dict[str, Any]]:
    return [record(second, **more) for second in seconds]


def states(*rows: str) -> str:
    """State vectors of OpenSky, from cells of time, icao24, lat, lon, callsign, baro and geo altitude, update."""
    head = "time,icao24,lat,lon,velocity,heading,vertrate,callsign,onground,alert,spi,squawk,baroaltitude,"
    lines = []
    for row in rows:
        time, icao24, lat, lon, call, baro, geo, update = row.split(",")
        lines.append(f"{time},{icao24},{lat},{lon},80,90,0,{call},False,False,False,,{baro},{geo},{update},{time}")
    return "\n".join([head + "geoaltitude,lastposupdate,lastcontact", *lines])


def only(path: Path, **more: Any) -> Recording:
    (recording,) = read(path, **more)
    return recording


# What the formats mean


def test_records_are_read_in_seconds_and_metres(write: Write) -> None:
    track = only(write("a.json", flight(icao24="4b43ac", callsign="REGA1 ")))
    assert track.name == "4b43ac REGA1"
    assert track.origin == (47.0, 8.0, 1000 * 0.3048)
    assert track.repairs == {}
    np.testing.assert_array_equal(track.time, START + np.arange(0, 40, 10))
    # 0.01 degrees of latitude are 1111.8 m at 47 degrees north (meridian radius 6 369 700 m); the earth curves down
    np.testing.assert_allclose(track.position[:, 1], 1111.8 * np.arange(4), rtol=2e-4)
    np.testing.assert_allclose(track.position[:, 0], 0, atol=1e-6)
    np.testing.assert_allclose(track.position[:, 2], -(track.position[:, 1] ** 2) / 2 / 6.37e6, atol=1e-2)


def test_east_north_up_point_to_where_they_say(write: Write) -> None:
    east = record(1, 47.0, longitude=8.001)
    up = record(2, 47.0, altitude=1100.0)
    position = only(write("a.json", [record(0), east, up])).position
    np.testing.assert_allclose(position[1], [76.06, 0, 0], atol=0.05)
    np.testing.assert_allclose(position[2], [0, 0, 30.48], atol=1e-6)


def test_columns_say_the_same_as_records(write: Write) -> None:
    records = flight(icao24="4b43ac")
    columns = {name: {str(i): row[name] for i, row in enumerate(records)} for name in records[0]}
    one, other = only(write("a.json", records)), only(write("b.json.gz", columns))
    np.testing.assert_array_equal(one.position, other.position)
    np.testing.assert_array_equal(one.time, other.time)
    assert (one.name, one.origin) == (other.name, other.origin)


@pytest.mark.parametrize(("latitude", "longitude"), [("latitudeE7", "longitudeE7"), ("latitude_e7", "longitude_e7")])
def test_where_a_phone_has_been_is_read_from_its_records(write, latitude, longitude):
    rows = [
        {"timestampMs": str(1000 * (START + k)), latitude: 470000000 + 100 * k, longitude: 80000000,
         "accuracy": 8, "altitude": 500 + k}
        for k in range(4)
    ]  # fmt: skip
    track = only(write("Records.json", rows))
    assert track.origin == (47.0, 8.0, 500.0)
    np.testing.assert_allclose(track.position[:, 1], 1.1118 * np.arange(4), rtol=1e-3)
    np.testing.assert_allclose(track.position[:, 2], np.arange(4), atol=1e-3)
    np.testing.assert_array_equal(track.time, START + np.arange(4.0))


@pytest.mark.parametrize(
    "text",
    ["2020-09-13T12:26:40", "2020-09-13T12:26:40.000Z", "2020-09-13 12:26:40+00:00", "2020-09-13T14:26:40+02:00"],
)
def test_iso_text_is_a_time_too(write: Write, text: str) -> None:
    later = text.replace("40", "50", 1)
    track = only(write("a.json", [record(0, timestamp=text), record(10, timestamp=later)]))
    np.testing.assert_array_equal(track.time, [START, START + 10])


def test_a_plain_file_takes_columns_in_any_order_and_leaves_others_alone(write: Write) -> None:
    track = only(write("p.q.csv", "z, y,note,x,t\n3,2,a,1,0\n6,5,b,4,0.5\n"))
    assert track.name == "p.q"
    assert track.origin is None
    np.testing.assert_array_equal(track.time, [0, 0.5])
    np.testing.assert_array_equal(track.position, [[1, 2, 3], [4, 5, 6]])


def test_without_altitudes_a_track_is_flat(write: Write) -> None:
    assert only(write("p.csv", "t,x,y\n0,1,2\n1,4,5\n")).position.shape == (2, 2)
    track = only(write("a.json", flight(altitude=None)))
    assert track.position.shape == (4, 2)
    assert track.origin == (47.0, 8.0, 0.0)


def test_the_suffix_may_be_missing(write: Write) -> None:
    assert len(read(write("track", flight()))) == 1
    assert len(read(write("other", "\ufefft,x,y\r\n0,1,2\r\n\r\n1,4,5\r\n"))) == 1


def test_many_aircraft_in_one_file_become_many_tracks(write: Write) -> None:
    rows = [record(s, icao24=name, longitude=lon) for s in range(3) for name, lon in (("b", 8.1), ("a", 8.2))]
    one, other = read(write("a.json", rows))
    assert (one.name, other.name) == ("a", "b")
    assert one.origin == other.origin == (47.0, 8.1, 1000 * 0.3048)
    assert one.position[0, 0] > 7000
    np.testing.assert_allclose(other.position[0], 0, atol=1e-9)


def test_a_new_callsign_does_not_split_a_track(write: Write) -> None:
    rows = [record(s, icao24="a", callsign=call) for s, call in enumerate([None, "ONE", "TWO"])]
    assert only(write("a.json", rows)).name == "a ONE"


def test_rows_that_name_no_aircraft_take_the_name_of_the_file(write: Write) -> None:
    rows = [*flight(icao24=None), *flight(icao24=" "), *flight(range(50, 70, 10), icao24="a")]
    assert [track.name for track in read(write("who.json.gz", rows))] == ["a", "who"]
    assert only(write("who.json.gz", flight(callsign="AB1"))).name == "AB1"


def test_the_origin_may_be_given(write: Write) -> None:
    path = write("a.json", flight())
    track = only(path, origin=(46.99, 8.0, 304.8))
    assert track.origin == (46.99, 8.0, 304.8)
    np.testing.assert_allclose(track.position[0, 1], 1111.8, rtol=2e-4)


def test_an_outlier_on_the_other_side_of_the_earth_is_no_way_there(write: Write) -> None:
    places = [(-33.8, 151.2 + k / 1e4) if k != 2 else (60.1, 1.5) for k in range(5)]
    track = only(write("p.csv", "t,lat,lon\n" + "".join(f"{k},{lat},{lon}\n" for k, (lat, lon) in enumerate(places))))
    assert track.origin is not None
    np.testing.assert_allclose(track.origin[:2], places[0])


def test_targets_without_altitudes_on_other_sides_of_the_earth_have_origins_of_their_own(write: Write) -> None:
    places = [("a", 10, 20), ("b", 11, 21), ("c", -10, -160)]
    rows = "".join(f"{k},{name},{lat + k / 100},{lon}\n" for k in range(9) for name, lat, lon in places)
    one, other, far = read(write("p.csv", "t,id,lat,lon\n" + rows))
    assert one.origin == other.origin == (10, 20, 0)
    assert far.origin == (-10, -160, 0)


def test_a_way_around_the_earth_that_no_place_sees_is_refused(write: Write) -> None:
    path = write("p.csv", "t,lat,lon\n" + "".join(f"{k},1,{k - 180}\n" for k in range(0, 360, 10)))
    with pytest.raises(ValueError, match="expected positions without altitudes within 85 degrees"):
        read(path)


# What is repaired, and counted


def test_held_positions_are_dropped_and_counted(write: Write) -> None:
    track = only(write("a.json", [record(0), record(1, 47.0), record(2, 47.0, altitude=1.0), record(3), record(4)]))
    assert track.repairs == {"held positions dropped": 2}
    np.testing.assert_array_equal(track.time - START, [0, 3, 4])


def test_a_repeated_position_of_what_is_no_aircraft_is_a_measurement(write: Write) -> None:
    for text in ("t,x,y,z\n0,1,2,3\n1,1,2,3\n2,1,2,4\n", "t,mmsi,lat,lon\n0,1,2,3\n1,1,2,3\n2,1,2,3\n"):
        track = only(write("p.csv", text))
        assert track.repairs == {}
        np.testing.assert_array_equal(track.time, [0, 1, 2])


def test_a_newer_update_of_the_same_position_is_not_held(write: Write) -> None:
    rows = [f"{t},a,47.0,8.0,,500,,{update}" for t, update in ((0, 0), (1, 0), (2, 2), (3, 2), (4, 4))]
    track = only(write("s.csv", states(*rows)))
    assert track.repairs == {"held positions dropped": 2}
    np.testing.assert_array_equal(track.time, [0, 2, 4])
    rows = [record(s, 47.0, last_position=update) for s, update in ((0, 5), (1, 5), (2, None), (3, None), (4, 6))]
    np.testing.assert_array_equal(only(write("a.json", rows)).time - START, [0, 2, 4])


def test_late_rows_are_put_in_order_and_counted(write: Write) -> None:
    track = only(write("a.json", flight([0, 30, 10, 20, 40])))
    assert track.repairs == {"rows put in time order": 2}
    np.testing.assert_array_equal(track.time - START, [0, 10, 20, 30, 40])
    assert (np.diff(track.position[:, 1]) > 0).all()


def test_of_rows_with_one_time_the_first_is_kept(write: Write) -> None:
    track = only(write("p.csv", "t,x,y\n0,1,2\n1,3,4\n1,9,9\n2,5,6\n1,3,5\n"))
    assert track.repairs == {"rows put in time order": 1, "duplicate times dropped": 2}
    np.testing.assert_array_equal(track.position, [[1, 2], [3, 4], [5, 6]])


@pytest.mark.parametrize("empty", [None, math.nan, "", " "])
def test_rows_without_position_or_time_are_dropped_and_counted(write: Write, empty: Any) -> None:
    lost = [record(1, longitude=empty), record(2) | {"latitude": empty}, record(3, timestamp=empty)]
    track = only(write("a.json", [record(0), *lost, record(4)]))
    assert track.repairs == {"rows without position dropped": 2, "rows without time dropped": 1}
    np.testing.assert_array_equal(track.time - START, [0, 4])


def test_a_record_may_lack_a_key(write: Write) -> None:
    track = only(write("a.json", [*flight(), {"timestamp": 1000 * (START + 50)}]))
    assert track.repairs == {"rows without position dropped": 1}


def test_missing_altitudes_are_filled_and_counted(write: Write) -> None:
    track = only(write("a.json", [record(s, altitude=up) for s, up in enumerate([None, 100, None, None, 200])]))
    assert track.repairs == {"altitudes missing": 3}
    np.testing.assert_allclose(track.position[:, 2] / 0.3048, [0, 0, 0, 0, 100], atol=0.2)
    assert track.filled.tolist() == [True, False, True, True, False]


def test_geoaltitude_is_taken_where_there_is_no_baroaltitude_or_it_is_asked_for(write: Write) -> None:
    for baro, words in (("", {}), ("500", {"alt": "geoaltitude"})):
        rows = [f"{t},a,47.0{t},8.0,,{baro},{up},{t}" for t, up in enumerate(["550", "560", "570", ""])]
        track = only(write("s.csv", states(*rows)), origin=CENTRE, **words)
        assert track.repairs == {"altitudes missing": 1}
        np.testing.assert_allclose(track.position[:, 2], [550, 560, 570, 570], atol=1)


def test_geoaltitude_does_not_mix_with_baroaltitude_from_which_it_differs_by_the_weather(write: Write) -> None:
    rows = [f"{t},a,47.0{t},8.0,,{up},{t}" for t, up in enumerate(["500,550", ",560", "520,570"])]
    track = only(write("s.csv", states(*rows)), origin=CENTRE)
    assert track.repairs == {"altitudes missing": 1}
    assert track.filled.tolist() == [False, True, False]


def test_an_aircraft_with_one_fix_is_dropped_and_counted_with_the_others(write: Write) -> None:
    rows = [*flight(icao24="a"), record(0, icao24="b"), record(5, 47.0, icao24="b"), *flight(icao24="c")]
    tracks = read(write("a.json", rows))
    assert [track.name for track in tracks] == ["a", "c"]
    assert [track.repairs for track in tracks] == [{"aircraft of one fix or none dropped": 1}, {}]


def test_the_first_aircraft_that_is_kept_gives_the_origin(write: Write) -> None:
    rows = [record(0, 10.0, icao24="b"), *flight([20, 0], icao24="a")]
    assert only(write("a.json", rows)).origin == (47.0, 8.0, 1000 * 0.3048)


def test_an_aircraft_without_altitudes_is_flat_beside_others_that_are_not(write: Write) -> None:
    rows = [*flight(icao24="b", altitude=None), *flight(icao24="a")]
    one, other = read(write("a.json", rows))
    assert one.origin == other.origin == (47.0, 8.0, 0.0)
    assert (one.position.shape, other.position.shape) == ((4, 3), (4, 2))
    np.testing.assert_allclose(one.position[:, :2], other.position, rtol=1e-4, atol=1e-6)


# What is refused


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.json", "", "empty file"),
        ("a.csv", " \n", "empty file"),
        ("a.csv.gz", "", "empty file"),
        ("a.json", "[]", "expected rows, received none"),
        ("a.json", "{}", "expected rows, received none"),
        ("a.json", "[{}]", "expected rows, received none"),
        ("a.csv", "t,x,y\n", "expected rows, received none under the columns t, x, y"),
        ("a.json", '[{"timestamp": 1', "expected JSON"),
        ("a.json", "t,x,y\n0,1,2\n1,2,3\n", "expected JSON"),
        ("a.json", "[1, 2]", "expected a list of records"),
        ("a.json", "7", "expected a list of records"),
        ("a.json", "[" * 100_000, "expected"),
        ("a.csv", 't,x,y\n0,1,"2\n1,2,3\n', "expected CSV"),
        ("a.csv", b"t,x,y\n0,1,\xff\n", "a number in data row 1, column y, received '\u00ff'"),
        ("a.csv", "t,x\n0,1\n", "such as time='t', x='x', y='Y'; columns: t .0., x .1."),
        ("a.csv", "time,lat\n0,1\n", "expected a position .*such as time='time', lat='lat', lon='LON'"),
        ("a.csv", "hello\nworld\n", f"{HEADERS}; received hello"),
        ("a.csv", "Time,P,Q\n0,1,2\n", "expected a position .*columns: Time .0., P .1., Q .2."),
        ("a.csv", "t;x;y\n0;1,5;2\n1;1.5;2\n", r"a number in data row 2, column x, received '1\.5'"),
        ("a.csv", "0,10,10\n1,20,30\n", "expected a header, .*: 1 .0, 1., 2 .10, 20., 3 .10, 30."),
        ("a.csv", "time,icao24\n0,abc\n", "expected a position .*such as time='time', x='X', y='Y'"),
        ("a.csv", "icao24,lat,lon\nabc,1,2\n", "expected a time, .*such as time='TIME', lat='lat', lon='lon'"),
        ("a.json", '[{"timestamp": 1, "latitude": 2}]', "such as time='timestamp', lat='latitude', lon='LON'"),
        ("a.csv", "t,x,x,y\n0,1,2,3\n", "every column once, received several named x"),
        ("a.csv", "t,x,y\n0,1,2\n1,2\n", "expected 3 fields in data row 2, received 2"),
        ("a.csv", "t,x,y\n0,1,2\n1,2,3,4\n", "expected 3 fields in data row 2, received 4"),
        ("a.csv", "t,x,y\n0,1,2\n1,two,3\n", "expected a number in data row 2, column x, received 'two'"),
        ("a.csv", "t,x,y\n0,1,2\n1,inf,3\n", "expected a number in data row 2, column x, received 'inf'"),
        (
            "a.csv",
            "t,x,y\nnoon,1,2\n",
            "column t: expected times such as .*received 'noon'",
        ),
        (
            "a.json",
            [record(0), record(1, timestamp="noon")],
            "ISO text in data row 2, column timestamp",
        ),
        (
            "a.json",
            [record(0), record(1, timestamp=START)],
            "ms since 1970 or ISO text in data row 2, .* received 1600000000",
        ),
        (
            "a.json",
            [record(0, altitude="ground")],
            "a number in data row 1, column altitude, received 'ground'",
        ),
        ("a.json", [record(0, altitude=True)], "expected a number in data row 1, column altitude, received True"),
        ("a.json", [record(0, [1])], r"column latitude, received \[1\]"),
        ("a.json", [record(0), record(1, 90.1)], r"within \+-90 in data row 2, column latitude, received 90.1"),
        (
            "a.json",
            [record(0), record(1, longitude=-181)],
            r"within \+-180 in data row 2, column longitude, .* -181",
        ),
        ("a.csv", states("0,a,-91,8,,,,"), r"within \+-90 in data row 1, column lat, received '-91'"),
        ("a.csv", states("0,a,9,188,,,,"), r"within \+-180 in data row 1, column lon, received '188'"),
        ("a.csv", "t,x,y\n0,1,2\n", "expected 2 or more rows with time and position, received 1$"),
        ("a.csv", "t,x,y\n,,\n,,\n", "time and position, received 0 after repairs: 2 rows without time dropped$"),
        ("a.json", [record(0, 47.0), record(1, 47.0)], "received 1 after repairs: 1 held position dropped$"),
        ("a.json", [record(0, icao24="a"), record(1, icao24="b")], "position of the same aircraft, received 1$"),
    ],
)
def test_what_is_no_track_is_refused_by_name(write: Write, name: str, content: Any, said: str) -> None:
    with pytest.raises(ValueError, match=f"(?s)a[.](csv|json).*{said}"):
        read(write(name, content))


def test_a_missing_file_is_said_to_be_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.json"):
        read(tmp_path / "nowhere.json")


def test_a_truncated_gzip_is_refused_wherever_it_breaks_off(write: Write) -> None:
    whole = gzip.compress(json.dumps(flight()).encode())
    for length in range(2, len(whole)):
        with pytest.raises(ValueError, match=r"cut\.json\.gz: expected a complete gzip file, received none"):
            read(write("cut.json.gz", whole[:length]))


def test_a_damaged_gzip_is_refused(write: Write) -> None:
    whole = bytearray(gzip.compress(json.dumps(flight()).encode()))
    whole[len(whole) // 2] ^= 0xFF
    with pytest.raises(ValueError, match=r"bad\.json\.gz"):
        read(write("bad.json.gz", bytes(whole)))


@pytest.mark.parametrize("origin", [(91, 0, 0), (0, 181, 0), (0, 0, math.inf), (math.nan, 0, 0), (1, 2)])
def test_an_origin_that_is_nowhere_is_refused(write: Write, origin: Any) -> None:
    with pytest.raises(ValueError, match="expected"):
        read(write("a.json", flight()), origin=origin)


def test_an_origin_for_x_and_y_is_refused(write: Write) -> None:
    with pytest.raises(ValueError, match="origin: expected degrees beside it, received the columns t, x, y"):
        read(write("p.csv", "t,x,y\n0,1,2\n1,2,3\n"), origin=CENTRE)


# What holds for any file

numbers = st.floats(-1e6, 1e6)
tracks = st.lists(st.tuples(st.integers(0, 10_000), numbers, numbers, numbers), min_size=2, max_size=20, unique=True)


def same(one: Recording, other: Recording) -> bool:
    return np.array_equal(one.time, other.time) and np.array_equal(one.position, other.position)


@settings(max_examples=60, deadline=None)
@given(count=st.integers(2, 12), data=st.data())
def test_shuffling_rows_with_dates_gives_the_same_recording(write: Write, count: int, data: st.DataObject) -> None:
    rows = flight(range(count), callsign="AB1", icao24="a")
    rows[0]["altitude"] = rows[-1]["callsign"] = None
    shuffled = data.draw(st.permutations(rows))
    one, other = only(write("a.json", rows)), only(write("b.json", shuffled))
    assert same(one, other)
    assert (one.name, one.origin) == (other.name, other.origin)
    assert one.repairs == {k: v for k, v in other.repairs.items() if k != "rows put in time order"}


@settings(max_examples=60, deadline=None)
@given(rows=tracks)
def test_a_csv_round_trip_keeps_times_and_positions(write: Write, rows: list[tuple[float, ...]]) -> None:
    rows = [(i + row[0] / 1e5, i + row[1] / 1e7, *row[2:]) for i, row in enumerate(rows)]
    text = "t,x,y,z\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows)
    track = only(write("p.csv", text))
    np.testing.assert_array_equal(np.column_stack([track.time, track.position]), rows)
    assert track.repairs == {}


@settings(max_examples=60, deadline=None)
@given(rows=tracks)
def test_times_increase_and_every_row_is_kept_or_counted(write: Write, rows: list[tuple[float, ...]]) -> None:
    rows = [(t % 7, x // 1e6, y // 1e6, z // 1e6) for t, x, y, z in rows] + [(8, 8, 8, 8), (9, 9, 9, 9)]
    path = write("p.csv", "t,x,y,z\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows))
    with suppress(AskError):  # rows that are far from their place are refused
        track = only(path)
        assert (np.diff(track.time) > 0).all()
        assert len(track.time) + sum(v for k, v in track.repairs.items() if "dropped" in k) == len(rows)


cells = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.sampled_from(["nan", "1e308", "90"])
)
names = st.sampled_from(["timestamp", "latitude", "longitude", "altitude", "icao24", "t", "x", "y", "z", "time", "lat"])
texts = st.one_of(
    st.text(),
    st.lists(st.lists(st.text('0123456789.-e",\n nait', max_size=4), min_size=3, max_size=3), max_size=5).map(
        lambda rows: "t,x,y\n" + "\n".join(map(",".join, rows))
    ),
    st.lists(st.dictionaries(names, cells), max_size=5).map(json.dumps),
    st.dictionaries(names, st.dictionaries(st.sampled_from("0123"), cells), max_size=5).map(json.dumps),
    st.lists(st.fixed_dictionaries(dict.fromkeys(["timestamp", "latitude", "longitude", "altitude"], cells))).map(
        json.dumps
    ),
    st.tuples(*[st.text("[{]}:,\"a1 '\\", max_size=6)] * 3).map("".join),
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(text=texts | st.binary(), name=st.sampled_from(["a.csv", "a.json", "a"]))
def test_any_text_is_read_or_refused_with_a_value_error(write: Write, text: str | bytes, name: str) -> None:
    try:
        tracks = read(write(name, text.encode(errors="surrogatepass") if isinstance(text, str) else text))
    except ValueError:
        return
    for track in tracks:
        assert len(track.time) >= 2
        assert (np.diff(track.time) > 0).all()
        assert np.isfinite(track.position).all()


def test_nests_of_any_depth_are_refused_with_a_value_error(write: Write) -> None:
    for depth in (10, 300, 500, 700, 900):
        nest = "[" * depth + "]" * depth
        for text in (nest, f'[{{"timestamp": {nest}, "latitude": 1, "longitude": 1}}]'):
            with pytest.raises(ValueError, match=r"nest\.json"):
                read(write("nest.json", text))


# Resampling


def made(time: Any, position: Any) -> Recording:
    return Recording("made", np.asarray(time, float), np.asarray(position, float), None, {})


def test_a_regular_grid_starts_at_the_first_fix_and_stays_within_the_last() -> None:
    ((time, position),) = resample(made([10, 12, 15], [[0, 0], [2, 4], [5, 10]]), 2.0, max_gap=5)
    np.testing.assert_allclose(time, [10, 12, 14])
    np.testing.assert_allclose(position, [[0, 0], [2, 4], [4, 8]])


def test_a_gap_over_the_limit_splits_the_track_and_one_at_the_limit_does_not() -> None:
    track = made([0, 1, 2, 7, 8, 14, 20, 20.5], [[t, 0, -t] for t in [0, 1, 2, 7, 8, 14, 20, 20.5]])
    pieces = resample(track, 1.0, max_gap=5)
    assert [time.tolist() for time, _ in pieces] == [[*range(9)]]  # 14 is alone, and 20 to 20.5 too short
    pieces = resample(track, 0.5, max_gap=4.9)
    assert [(time[0], time[-1]) for time, _ in pieces] == [(0, 2), (7, 8), (20, 20.5)]
    for time, position in pieces:
        np.testing.assert_allclose(position, np.stack([time, 0 * time, -time], 1), atol=1e-12)


def test_a_step_longer_than_the_track_gives_no_piece() -> None:
    assert resample(made([0, 1], [[0, 0], [1, 1]]), 1.5, max_gap=math.inf) == []


def test_times_since_1970_do_not_lose_the_last_point() -> None:
    time = START + np.arange(334) / 10
    ((grid, _),) = resample(made(time, np.stack([time, time], 1)), 0.1, max_gap=1)
    assert len(grid) == 334


def test_a_constant_acceleration_is_followed_exactly_between_uneven_fixes() -> None:
    path = lambda t: np.stack([3 + 2 * t - 0.5 * t**2, t**2], 1)  # noqa: E731
    knots = np.array([0, 1, 4, 4.5, 9, 12])
    ((time, position),) = resample(made(knots, path(knots)), 0.25, max_gap=10)
    np.testing.assert_allclose(position, path(time), atol=1e-12)


def test_a_turn_is_followed_far_better_than_along_straight_lines() -> None:
    circle = lambda t: 1500 * np.stack([np.cos(2 * np.pi * t / 180), np.sin(2 * np.pi * t / 180)], 1)  # noqa: E731
    knots = np.cumsum(np.random.default_rng(0).integers(4, 11, 60)).astype(float)
    ((time, position),) = resample(made(knots, circle(knots)), 1.0, max_gap=10)
    straight = np.stack([np.interp(time, knots, column) for column in circle(knots).T], 1)
    assert np.abs(position - circle(time)).mean() < np.abs(straight - circle(time)).mean() / 10


@settings(max_examples=100, deadline=None)
@given(
    steps=st.lists(st.integers(1, 9), min_size=1, max_size=20),
    dt=st.sampled_from([0.125, 0.5, 1.0]),
    d=st.integers(2, 3),
    data=st.data(),
)
def test_resampling_keeps_to_the_fixes(steps: list[int], dt: float, d: int, data: st.DataObject) -> None:
    time = START + np.concatenate([[0], np.cumsum(steps)]).astype(float)
    position = np.array(data.draw(st.lists(st.tuples(*[numbers] * d), min_size=len(time), max_size=len(time))))
    ((grid, curve),) = resample(made(time, position), dt, max_gap=9)
    at = np.isin(grid, time)
    assert at.sum() == len(time)
    np.testing.assert_allclose(curve[at], position, rtol=1e-12, atol=1e-6)


@pytest.mark.parametrize(("dt", "gap"), [(0, 1), (-1, 1), (math.nan, 1), (math.inf, 1), (1, 0), (1, -1), (1, math.nan)])
def test_a_step_or_a_gap_that_is_not_positive_is_refused(dt: float, gap: float) -> None:
    with pytest.raises(ValueError, match=f"{'max_gap' if dt == 1 else 'dt'}: expected seconds above 0, received"):
        resample(made([0, 1], [[0, 0], [1, 1]]), dt, max_gap=gap)


# The recorded tracks of the sample package


def test_samples_name_the_files_of_their_groups() -> None:
    files = readers.samples("gliders", "calibration")
    assert len(files) == 8 + 24
    assert files == sorted(files)
    assert {file.parent.name for file in files} == {"gliders", "calibration"}


def test_an_unknown_group_of_samples_is_refused_with_those_there_are() -> None:
    for groups in ((), ("gliders", "balloons")):
        with pytest.raises(ValueError, match=r"among .*calibration, .*gliders, .*noisy.*, received"):
            readers.samples(*groups)


def test_without_their_package_the_samples_say_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchfra.readers.sample_files.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install --no-deps traffic==2\.13"):
        readers.samples("gliders")


@pytest.mark.parametrize(
    ("group", "count", "rows"), [("calibration", 24, 52_000), ("gliders", 8, 15_000), ("noisy", 5, 12_000)]
)
def test_every_sample_gives_one_sound_track(group: str, count: int, rows: int) -> None:
    recordings = [recording for file in readers.samples(group) for recording in read(file)]
    assert len(recordings) == count
    assert sum(len(recording.time) for recording in recordings) > rows
    for recording in recordings:
        assert recording.position.shape == (len(recording.time), 3)
        assert np.isfinite(recording.position).all()
        assert (np.diff(recording.time) > 0).all()
        assert 1.2e9 < recording.time[0] < 2e9
        assert set(recording.repairs.values()).isdisjoint({0})
        assert np.abs(recording.position[0]).max() < 1e-6


def test_calibration_flights_fly_at_the_speed_of_aircraft() -> None:
    for file in readers.samples("calibration"):
        recording = only(file)
        speed = np.linalg.norm(np.diff(recording.position, axis=0), axis=1) / np.diff(recording.time)
        assert 60 < np.median(speed) < 130, file.name  # m/s
        assert speed.max() < 400, file.name


def test_noisy_flights_say_what_was_repaired() -> None:
    repairs = {file.name.split(".")[0]: only(file).repairs for file in readers.samples("noisy")}
    sent = "times taken from the update of the position"
    assert repairs["noisy_ground"] == {sent: 804, "held positions dropped": 378, "altitudes missing": 47}
    assert repairs["noisy_spoofing"] == {
        sent: 6665,
        "rows without position dropped": 11,
        "held positions dropped": 3986,
    }


def test_the_recorded_speed_of_gliders_agrees_with_their_positions() -> None:
    file = next(file for file in readers.samples("gliders") if file.name.startswith("danube"))
    told = [row["groundspeed"] for row in json.loads(gzip.decompress(file.read_bytes()))]
    recording = only(file)
    pieces = resample(recording, 1.0, max_gap=20)
    speed = np.concatenate([np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1) for _, p in pieces])
    assert abs(np.median(speed) - np.median(told) * 1852 / 3600) < 3  # m/s
