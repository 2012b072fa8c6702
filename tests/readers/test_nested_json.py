"""JSON is records or columns; fixes in lists within lists are refused with what to write."""

import json
import re

import pytest

from torchfra.readers import read

ROWS = 20


def fixes(lat=47.0):
    return [{"time": f"2024-05-06T10:31:{i:02}Z", "latitude": lat + i / 1e4, "longitude": 8.3} for i in range(ROWS)]


@pytest.mark.parametrize(
    ("whole", "said"),
    [
        ({"data": [{"id": "A", "gps": fixes()}, {"id": "B", "gps": fixes(48.0)}]}, "expected a time and a position"),
        ([{"id": "A", "way": {"points": fixes()}}], "expected a time and a position"),
        ({"one": fixes(), "two": {"more": fixes()}}, "expected one list of records, received one, two.more"),
        ([fixes()[:9], fixes()[9:]], "received list instead of an object"),
        ({name: {"data": [fix[name] for fix in fixes()]} for name in fixes()[0]}, "column time: expected times"),
    ],
)
def test_lists_within_lists_and_several_lists_are_refused(write, whole, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        read(write(json.dumps(whole), "a.json"))


def test_the_only_list_with_places_is_read_with_the_target_that_the_objects_around_it_name(write):
    whole = {"id": "bus 7", "answer": {"fixes": fixes(), "laps": [{"lap": 1}]}, "page": {"next": False}}
    (track,) = read(write(json.dumps(whole), "a.json"))
    assert (track.name, len(track.time)) == ("bus 7", ROWS)
    assert "JSON: records in answer.fixes" in track.source.notes


def test_a_fix_that_names_its_target_is_no_part_of_what_is_around_it(write):
    whole = {"id": "request", "fixes": [fix | {"id": f"bus{i % 2}"} for i, fix in enumerate(fixes())]}
    assert [track.name for track in read(write(json.dumps(whole), "a.json"))] == ["bus0", "bus1"]


def test_fixes_of_a_phone_in_json_are_no_aircraft_with_feet(write):
    records = [{"timestamp": fix["time"], "altitude": 430.5, "horizontalAccuracy": 5} | fix for fix in fixes()]
    (track,) = read(write(json.dumps({"data": records}), "a.json"))
    assert (track.source.word, track.source.unit) == ("target", 1)
