"""JSON is records or columns; objects within others are refused with what to write."""

import json

import pytest

from torchfra.readers import read

ROWS = 20


def fixes():
    return [{"time": f"2024-05-06T10:31:{i:02}Z", "latitude": 47 + i / 1e4, "longitude": 8.3} for i in range(ROWS)]


@pytest.mark.parametrize(
    ("whole", "inner"),
    [
        ({"data": fixes()}, "data"),
        ({"unit": "cm"} | {name: [fix[name] for fix in fixes()] for name in fixes()[0]}, "time, latitude, longitude"),
        ([{"id": "A", "way": {"points": fixes()}}], "way"),
        ([fix | {"device": {"id": i % 2}} for i, fix in enumerate(fixes())], "device"),
        ({"one": fixes(), "two": {"more": fixes()}}, "one, two"),
    ],
)
def test_objects_within_others_are_refused_with_what_makes_a_table_of_them(write, whole, inner):
    with pytest.raises(ValueError, match=f"received objects or lists in {inner}: pandas.json_normalize makes a table"):
        read(write(json.dumps(whole), "a.json"))


def test_lists_instead_of_records_are_refused(write):
    with pytest.raises(ValueError, match="received list instead of an object"):
        read(write(json.dumps([fixes()[:9], fixes()[9:]]), "a.json"))


def test_fixes_of_a_phone_in_json_are_no_aircraft_with_feet(write):
    records = [{"timestamp": fix["time"], "altitude": 430.5, "horizontalAccuracy": 5} | fix for fix in fixes()]
    (track,) = read(write(json.dumps(records), "a.json"))
    assert (track.source.word, track.source.unit) == ("target", 1)
