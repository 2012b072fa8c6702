"""Rows of several targets are told apart by columns that are named, or refused with the columns that may do it."""

from __future__ import annotations

import numpy as np
import pytest

import torchfra
from torchfra.readers import read
from torchfra.readers.options import AskError

ROWS = 60
NOISE = np.random.default_rng(5).normal(0, 0.5, (3 * ROWS, 2))


def fleet(number=(7, 7, 8), operator=("A", "B", "A")):
    """Rows in turn of three buses, 40 km apart: t, x, y, load (measured), version, number, operator."""
    return [
        (i + k / 4, 40_000 * k + 10 * i + dx, dy, f"{0.5 * (k + 1)}", 25, number[k], operator[k])
        for i in range(ROWS)
        for k, (dx, dy) in enumerate(NOISE[3 * i : 3 * i + 3])
    ]


def table(rows, header="t,x,y,load,version,number,operator"):
    return [header, *(",".join(map(str, row)) for row in rows)]


def test_jumps_between_places_are_refused_with_the_columns_that_may_part_them(write):
    rows = [(*row[:5], f"bus {k % 3}", "A") for k, row in enumerate(fleet())]
    with pytest.raises(ValueError, match=r"where load or number stays .* several targets: say id='load' or id='num"):
        read(write(table(rows)))
    assert len(read(write(table(rows)), id="number")) == 3


def test_a_target_too_short_to_be_judged_does_not_vouch_for_one_of_impossible_speed(write):
    bus, van = (
        [f"{k},{name},{k * speed},0" for k in range(n)] for name, speed, n in (("bus", 55_000, 60), ("van", 9, 5))
    )
    with pytest.raises(ValueError, match=r"received 55 km/s as the median of target bus"):
        read(write(["t,id,x,y", *bus, *van]))


def test_a_number_that_two_operators_have_is_refused_with_both_columns(write):
    path = write(table(fleet()))
    with pytest.raises(ValueError, match=r"of target 7; .*such as id='number,ID'; .*not read: load, version, operator"):
        read(path, id="number")
    with pytest.raises(ValueError, match=r"id='number,ID'"):
        torchfra.clean(path, id="number")


@pytest.mark.parametrize("columns", ["number,operator", ("number", "operator")])
def test_several_columns_name_a_target_together(write, columns):
    tracks = read(write(table(fleet())), id=columns)
    assert [(track.name, len(track.time)) for track in tracks] == [("7 A", ROWS), ("7 B", ROWS), ("8 A", ROWS)]
    assert "targets: number operator" in tracks[0].source.notes
    assert "ignored: load, version" in tracks[0].source.notes


def test_a_column_whose_name_has_a_comma_is_one_column(write):
    rows = table(fleet(operator="ABC"), 't,x,y,load,version,number,"number,operator"')
    assert [track.name for track in read(write(rows), id="number,operator")] == ["A", "B", "C"]


def test_several_columns_by_their_numbers_name_a_target(write):
    rows = [(row[0] + 0.1, *row[1:5], row[5] + 70, row[6]) for row in fleet()]
    tracks = read(write(table(rows)[1:]), time="1", x="2", y="3", id="6,7")
    assert [track.name for track in tracks] == ["77 A", "77 B", "78 A"]


def test_targets_of_one_row_each_are_refused_as_such(write):
    rows = [f"{i},{i},{i},0" for i in range(40)]
    with pytest.raises(ValueError, match="expected 2 or more rows with time and position of the same target"):
        read(write(["t,id_of,x,y", *rows]), id="id_of")


@pytest.mark.parametrize(("header", "options"), [
    ("time,gps_lat,gps_lon,pos_lat,pos_lon", {"lat": "gps_lat", "lon": "gps_lon"}),
    ("time,field.x,field.y,pose.x,pose.y", {"x": "field.x", "y": "field.y"}),
])  # fmt: skip
def test_of_two_positions_with_names_as_good_nobody_chooses_in_silence(write, header, options):
    path = write([header, *(f"{i},{10 + i / 1e3},{i / 1e3},{20 + i / 1e3},{i / 1e3}" for i in range(ROWS))])
    with pytest.raises(AskError) as refused:
        read(path)
    assert options in refused.value.args
    assert len(read(path, **options)[0].time) == ROWS
