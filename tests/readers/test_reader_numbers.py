# ruff: noqa: RUF001
"""A cell is a number if it is written as one in decimal, a time if it is in the file's unit, and a key comes once."""

import json
import re
import sys

import numpy as np
import pytest

from torchfra.readers import read, read_ranges

START = 1_600_000_000
NUMBERS = {
    "12": 12, "-1.5e3": -1500, "+.5": 0.5, "5.": 5, "1E-3": 1e-3, " 7 ": 7, "\t7": 7, "007": 7, "1e+2": 100, "-0": 0,
    "9" * 15 + "." + "9" * 3000: 1e15,
}  # fmt: skip
MISSING = ["", " ", "nan", "NaN", "NAN", "-nan", "NA", "n/a", "#N/A", "<NA>", "NaT", "null", "None", "-", "--"]
REFUSED = [
    "1_000", "0x10", "0b1", "1e", "e5", ".", "+-1", "--1", "1,5", "1 2", "1d3", "1e5.0", "1/2", "12m", "(1)", "$1",
    "inf", "-Infinity", "1e400", "1e16", "no data", "true", "nan(1)", "snan", "1\N{NO-BREAK SPACE}",
    "١٢", "१२", "１２", "1２", "−1", "²", "Ⅻ", "一", "\N{MATHEMATICAL DOUBLE-STRUCK DIGIT ONE}", "1\x00", "1\x1f",
]  # fmt: skip


@pytest.fixture
def write(tmp_path):
    def write(content, name="a.csv"):
        path = tmp_path / name
        path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8", newline="")
        return path

    return write


def table(header, *rows):
    return "\n".join([header, *(",".join(f'"{cell}"' for cell in row) for row in rows)])


@pytest.mark.parametrize("written", NUMBERS)
@pytest.mark.parametrize("beside", ["2", "", "nan"])
def test_decimal_numbers_are_read(write, written, beside):
    path = write(table("t,x,y,z", (0, 1, 2, 3), (1, written, 2, beside), (2, 1, 2, 3)))
    assert read(path)[0].position[1, 0] == NUMBERS[written]
    (path,) = [write([{"t": i, "x": x, "y": 0} for i, x in enumerate(["1", written])], "a.json")]
    assert read(path)[0].position[1, 0] == NUMBERS[written]


@pytest.mark.parametrize("written", MISSING)
def test_nan_in_any_letters_is_missing_as_an_empty_cell_is(write, written):
    rows = [(0, 1, 2), (1, written, 3), (2, 3, 4)]
    for path in (write(table("t,x,y", *rows)), write([dict(zip("txy", row, strict=True)) for row in rows], "a.json")):
        (track,) = read(path)
        assert track.time.tolist() == [0, 2]
        assert track.repairs == {"rows without position dropped": 1}


@pytest.mark.parametrize("written", REFUSED)
@pytest.mark.parametrize("beside", ["2", "nan"])
def test_what_only_a_programming_language_or_a_reader_takes_for_a_number_is_refused(write, written, beside):
    old = "\0" in written and sys.version_info < (3, 11)  # whose csv itself reads no NUL
    said = f"expected a number in data row 2, column x, received {re.escape(repr(written))}"
    with pytest.raises(ValueError, match="line contains NUL" if old else said):
        read(write(table("t,x,y", (0, beside, 2), (1, written, 2), (2, 1, 2))))
    with pytest.raises(ValueError, match=said):
        read(write([{"t": i, "x": x, "y": 0} for i, x in enumerate([beside, written])], "a.json"))
    ranges = table("t,range,x,y", (0, beside, 0, 0), (1, written, 0, 0), (2, 1, 0, 0))
    said = "expected a number of metres in data row 2, column range, received"
    with pytest.raises(ValueError, match="line contains NUL" if old else said):
        read_ranges(write(ranges))


@pytest.mark.parametrize("written", ["Infinity", "-Infinity", "1e400", "true", "[1]", '{"a": 1}', '"1_0"', "1" * 400])
def test_what_json_takes_for_more_than_a_number_is_refused(write, written):
    with pytest.raises(ValueError, match=r"expected a number in data row 2, column x, |received objects or lists in x"):
        read(write('[{"t": 0, "x": 1, "y": 2}, {"t": 1, "x": %s, "y": 2}]' % written, "a.json"))  # noqa: UP031


@pytest.mark.parametrize("stamp", [
    "２０２０-09-13T12:26:40", "٢٠٢٠-09-13T12:26:40", "20200913T122640", "2020-09-13x12:26:40", "12:26:40",
    "1_600_000_000_000",
])  # fmt: skip
def test_other_scripts_and_forms_are_no_time_either(write, stamp):
    with pytest.raises(ValueError, match="ms since 1970 or ISO text in data row 1, column timestamp"):
        read(write(table("timestamp,latitude,longitude", (stamp, 1, 2), (START * 1000, 2, 3))))


# ---------------------------------------------------------------- times


HEADS = ["time,icao24,lat,lon", "t,x,y,z", "timestamp,latitude,longitude,altitude", "UTC,Lat,Lng,Alt"]


@pytest.mark.parametrize(("unit", "form"), [(1, "seconds"), (1e3, "ms"), (1e6, "us"), (1e9, "ns")])
@pytest.mark.parametrize("header", HEADS)
def test_times_since_1970_are_read_in_any_unit_and_it_is_said(write, header, unit, form):
    rows = [(START * unit, 1, 2, 3), ((START + 10) * unit, 1, 2.1, 3)]
    records = [dict(zip(header.split(","), row, strict=True)) for row in rows]
    for path in (write(table(header, *rows)), write(records, "a.json")):
        (track,) = read(path)
        np.testing.assert_array_equal(track.time, [START, START + 10])
        assert f"{form} since 1970" in " ".join(track.source.notes)


@pytest.mark.parametrize("unit", [1, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("header", HEADS)
def test_times_in_two_units_are_refused_by_the_row_of_the_second(write, header, unit):
    for other in {1, 1e3, 1e6, 1e9} - {unit}:
        rows = [(START * unit, 1, 2, 3), ((START + 5) * unit, 1, 2.1, 3), ((START + 10) * other, 1, 2.1, 3)]
        with pytest.raises(ValueError, match=f"in data row 3, column {header.partition(',')[0]}, received"):
            read(write(table(header, *rows)))


def test_times_in_the_files_unit_are_seconds_since_1970(write):
    for header, unit in (("time,icao24,lat,lon", 1), ("t,x,y,z", 1), ("timestamp,latitude,longitude,altitude", 1000)):
        (track,) = read(write(table(header, *[((START + s) * unit, 1, 2 + s / 100, 3) for s in (0, 10)])))
        np.testing.assert_array_equal(track.time, [START, START + 10])


@pytest.mark.parametrize("other", [START, START * 1e3, START * 1e6])
def test_a_file_of_ranges_counts_all_its_times_in_one_unit(write, other):
    rows = [((START + s) * 1e9, 1, 0, 0) for s in range(9)]
    assert len(read_ranges(write(table("t,range,x,y", *rows))).times[0]) == 9
    unset = read_ranges(write(table("t,range,x,y", *rows, (0, 1, 0, 0))))
    assert (len(unset.times[0]), unset.repairs) == (9, {"rows without time dropped": 1})
    with pytest.raises(ValueError, match=r"in data row 10, column t, received .*; all times must be in one unit"):
        read_ranges(write(table("t,range,x,y", *rows, (other, 1, 0, 0))))
    with pytest.raises(ValueError, match="all times must be in one unit"):
        read_ranges([write(table("t,range,x,y", *rows)), write(table("t,x,y,z", *rows, (other, 1, 0, 0)), "p.csv")])


# ---------------------------------------------------------------- keys


@pytest.mark.parametrize("text", [
    '[{"t": 0, "x": 1, "y": 2}, {"t": 1, "x": 1, "x": 2, "y": 2}]',
    '[{"t": 0, "x": 1, "y": 2, "note": {"x": 1, "x": 1}}, {"t": 1, "x": 1, "y": 2}]',
    '{"t": {"0": 0, "1": 1}, "x": {"0": 1, "1": 2}, "y": {"0": 0, "1": 0}, "x": {"0": 3, "1": 4}}',
    '{"t": {"0": 0, "1": 1}, "y": {"0": 1, "1": 2}, "x": {"x": 1, "0": 0, "x": 0}}',
])  # fmt: skip
def test_an_object_with_the_same_key_twice_is_refused_by_its_name(write, text):
    with pytest.raises(ValueError, match=r"every key of an object once, received other text \(several keys named x"):
        read(write(text, "a.json"))
    with pytest.raises(ValueError, match="several keys named x"):
        read_ranges(write(text, "a.json"))


def test_columns_of_ranges_that_may_be_the_same_are_refused(write):
    with pytest.raises(ValueError, match=r"expected one column of range, received range, field\.Range"):
        read_ranges(write(table("t,range,field.Range,x,y", (0, 1, 2, 3, 4))))


@pytest.mark.parametrize("name", ["true", '["a"]'])
def test_a_name_is_text_or_a_number(write, name):
    rows = [f'{{"timestamp": {START + i}000, "latitude": {i}, "longitude": 2, "icao24": {name}}}' for i in range(2)]
    with pytest.raises(ValueError, match="expected text in data row 1, column icao24, received"):
        read(write(f"[{','.join(rows)}]", "a.json"))


def test_deep_nests_are_refused_by_the_reader_of_ranges_too(write):
    with pytest.raises(ValueError, match=r"a\.json: expected JSON"):
        read_ranges(write("[" * 100_000, "a.json"))
