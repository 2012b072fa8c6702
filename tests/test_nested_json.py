"""Fixes in lists within lists, as services answer, are rows."""

import json

import pytest

from torchfra.readers import read

ROWS = 20


def fixes(lat=47.0, **names):
    time, one, other = names.get("time", "time"), names.get("lat", "latitude"), names.get("lon", "longitude")
    return [{time: f"2024-05-06T10:31:{i:02}Z", one: lat + i / 1e4, other: 8.3} for i in range(ROWS)]


@pytest.mark.parametrize(
    "whole",
    [
        {"data": [{"id": "A", "gps": fixes()}, {"id": "B", "gps": fixes(48.0)}], "page": {"next": False}},
        [{"id": "A", "way": {"points": fixes()}}, {"id": "B", "way": {"points": fixes(48.0)}}],
    ],
)
def test_lists_of_fixes_of_several_targets_are_rows_with_their_names(write, whole):
    one, two = read(write(json.dumps(whole), "a.json"))
    assert [one.name, two.name] == ["A", "B"]
    assert len(one.time) == len(two.time) == ROWS
    assert any("a row for each record in" in note for note in one.source.notes)


def test_a_fix_that_names_its_target_is_no_part_of_what_is_around_it(write):
    whole = {"id": "request", "fixes": [fix | {"id": f"bus{i % 2}"} for i, fix in enumerate(fixes())]}
    assert [track.name for track in read(write(json.dumps(whole), "a.json"))] == ["bus0", "bus1"]


@pytest.mark.parametrize(
    "whole",
    [
        {"name": "Run", "exercises": [{"samples": {"heart": [{"dateTime": "x", "value": 7}],
                                                   "route": fixes(time="dateTime")}}]},
        {"data": {"metrics": [], "workouts": [{"name": "Run", "route": fixes(time="timestamp")}]}},
        {"timelineObjects": [{"activitySegment": {"startLocation": {"latitudeE7": 1, "longitudeE7": 2},
            "waypointPath": {"waypoints": [{"latE7": 1, "lngE7": 2}]},
            "simplifiedRawPath": {"points": [
                {"latE7": round(1e7 * fix["latitude"]), "lngE7": 83000000, "timestamp": fix["time"]}
                for fix in fixes()]}}}, {"placeVisit": {"duration": {"startTimestamp": "2024-05-06T10:31:00Z"}}}]},
    ],
)  # fmt: skip
def test_the_only_list_with_times_and_places_is_taken_however_deep(write, whole):
    (track,) = read(write(json.dumps(whole), "a.json"))
    assert len(track.time) == ROWS
    assert track.position[-1, 1] == pytest.approx(19e-4 * 111_170, rel=1e-3)


def test_fixes_of_a_phone_in_json_are_no_aircraft_with_feet(write):
    more = [{"timestamp": fix.pop("time"), "altitude": 430.5} | fix for fix in fixes()]
    for whole in [fix | {"horizontalAccuracy": 5} for fix in more], {"data": [{"name": "Run", "route": more}]}:
        (track,) = read(write(json.dumps(whole), "a.json"))
        assert (track.source.word, track.source.unit) == ("target", 1)


def test_two_lists_of_fixes_beside_each_other_are_refused_with_what_to_do(write):
    frames = [{"wall": i, "home": fixes()[:2], "away": fixes()[:2]} for i in range(ROWS)]
    with pytest.raises(ValueError, match=r"home holds several records, or places, in a cell: write a row for each"):
        read(write(json.dumps(frames), "a.json"))


def test_places_in_objects_of_objects_have_hints(write):
    lines = [
        json.dumps({"result": {"at": fix["time"], "up": {"payload": {"latitude": fix["latitude"], "longitude": 8.3}}}})
        for fix in fixes()
    ]
    with pytest.raises(ValueError, match=r"--time result.at --lat result.up.payload.latitude --lon"):
        read(write(lines, "a.json"))


def test_fixes_of_vehicles_in_a_feed_have_hints_with_their_own_time(write):
    feeds = [
        {"header": {"timestamp": "1"}, "entity": [
            {"id": name, "vehicle": {"trip": {"startTime": f"10:{k % 3}0:00"}, "vehicle": {"id": name},
             "position": {"latitude": fix["latitude"], "longitude": k}, "timestamp": str(1715668200 + 10 * i)}}
            for k, name in enumerate("AB")]}
        for i, fix in enumerate(fixes())
    ]  # fmt: skip
    path = write([json.dumps(one) for one in [{"header": {"timestamp": "0"}, "entity": []}, *feeds]], "a.json")
    with pytest.raises(ValueError, match=r"--time vehicle.timestamp --lat vehicle.position.latitude --lon"):
        read(path)
    words = {"time": "vehicle.timestamp", "lat": "vehicle.position.latitude", "lon": "vehicle.position.longitude"}
    assert [track.name for track in read(path, **words)] == ["A", "B"]


def test_a_list_beside_a_position_without_any_of_its_own_is_no_table(write):
    rows = [{"tag": "7", "at": fix["time"], "data": {"anchors": [{"rss": i}], "coordinates": {"x": i, "y": 0}}}
            for i, fix in enumerate(fixes())]  # fmt: skip
    (track,) = read(write(json.dumps(rows), "a.json"), time="at", x="data.coordinates.x", y="data.coordinates.y")
    assert len(track.time) == ROWS


def test_fixes_of_other_names_are_read_beside_a_list_of_theirs(write):
    whole = [{"t0": i, "north_south": 47 + i / 1e4, "east_west": 8.3, "satellites": [{"prn": 3}]} for i in range(ROWS)]
    (track,) = read(write(json.dumps(whole), "a.json"), time="t0", lat="north_south", lon="east_west")
    assert len(track.time) == ROWS


def test_records_may_come_in_parts(write):
    (track,) = read(write(json.dumps([fixes()[:9], fixes()[9:]]), "a.json"))
    assert len(track.time) == ROWS
