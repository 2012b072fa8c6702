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


def test_fixes_of_a_phone_in_json_are_no_aircraft_with_feet(write):
    more = [{"timestamp": fix.pop("time"), "altitude": 430.5} | fix for fix in fixes()]
    for whole in [fix | {"horizontalAccuracy": 5} for fix in more], {"data": [{"name": "Run", "route": more}]}:
        (track,) = read(write(json.dumps(whole), "a.json"))
        assert (track.source.word, track.source.unit) == ("target", 1)


def test_records_may_come_in_parts(write):
    (track,) = read(write(json.dumps([fixes()[:9], fixes()[9:]]), "a.json"))
    assert len(track.time) == ROWS
