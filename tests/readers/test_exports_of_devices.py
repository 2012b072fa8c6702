"""Files as widespread programs export them are read at once, or refused with what reads them."""

import re

import numpy as np
import pytest

from torchfra.readers import read
from torchfra.readers.datasets import open_data

ROWS = 40


def table(header, row, above=()):
    return [*above, header, *(row(i) for i in range(ROWS))]


def lat(i):
    return f"{47 + i * 1.234567e-4:.7f}"


@pytest.mark.parametrize("late", ["unknown", "DGPS"])
def test_words_that_are_neither_true_nor_false_mark_nothing(write, late):
    lines = table("t,x,y,valid", lambda i: f"{i},{2 * i},1.5,{late if i == 30 else 'false' if i == 20 else 'true'}")
    (track,) = read(write(lines))
    assert track.repairs == {"rows marked as invalid dropped": 1}


def test_a_third_word_behind_the_first_thousand_rows_marks_nothing_either(write):
    lines = ["t,x,y,valid", *(f"{i},{2 * i},1.5,{'DGPS' if i == 1500 else 'true'}" for i in range(2000))]
    (track,) = read(write(lines))
    assert len(track.time) == 2000


def test_times_in_utc_are_taken_before_local_ones(write):
    lines = table("datetime(utc),datetime(local),latitude,longitude",
                  lambda i: f"2024-05-06 10:31:{i:02},2024-05-06 12:31:{i:02},{lat(i)},8.3")  # fmt: skip
    (track,) = read(write(lines))
    assert track.source.columns["time"] == "datetime(utc)"


@pytest.mark.parametrize(
    ("beside", "values", "unit"),
    [("Bank,Pitch,g Load", "1,2,1.0", 0.3048), ("gameId,playId,nflId", "1,2,3", 0.9144)],
)
def test_units_of_some_programs_are_known(write, beside, values, unit):
    places = "lat,lon,Altitude" if "Bank" in beside else "x,y,z"
    lines = table(f"time,{places},{beside}", lambda i: f"{i},{47 + i / 1e4},8.3,{400 + i},{values}")
    (track,) = read(write(lines))
    assert track.source.unit == unit


def test_baselines_of_rtklib_are_east_north_and_up(write):
    def row(i):
        return f"2024/05/06 10:31:{i:02}.000  {10 + i}.5  {20 - i}.25  1.125  1"

    header = "%  GPST   e-baseline(m)  n-baseline(m)  u-baseline(m)   Q"
    (track,) = read(write(table(header, row, ["% program : RTKPOST"]), "rover.pos"))
    assert np.ptp(track.position[:, :2], axis=0).tolist() == [ROWS - 1, ROWS - 0.5]


def test_coordinates_from_the_centre_of_the_earth_are_refused_with_the_conversion(write):
    lines = table("time,x-ecef(m),y-ecef(m),z-ecef(m)", lambda i: f"{i},{4277000 + i},{625000 - i},{4671000 + i}")
    with pytest.raises(ValueError, match="centre of the earth: convert them to degrees, such as by pyproj"):
        read(write(lines))


def test_names_with_a_unit_in_words_are_known(write):
    (track,) = read(write(table("ts in ms;x in m;y in m", lambda i: f"{1000 * i};{2 * i}.5;1.5")))
    assert (track.time[-1], track.position[-1, 0]) == (ROWS - 1, 2 * ROWS - 1.5)


def test_a_data_set_of_two_columns_for_an_id_is_explained(tmp_path):
    with pytest.raises(ValueError, match=re.escape("id: expected one column, by which a data set is parted, received")):
        open_data(tmp_path, id="a,b")


def test_the_last_line_of_a_log_may_be_cut(write):
    head = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
            "FMT, 130, 50, GPS, QBIHffBf, TimeUS,Status,GMS,GWk,Lat,Lng,I,Alt"]  # fmt: skip
    rows = (f"GPS, {i}, 3, {124278000 + 1000 * i}, 2313, {lat(i)}, 8.3, 1, 430" for i in range(ROWS))
    (track,) = read(write([*head, *rows, "GPS, 99, 3, 12"], "1.log"))
    assert len(track.time) == ROWS


def test_a_column_called_msg_is_no_message_of_a_receiver(write):
    (track,) = read(write(["MSG,time,lat,lon", *(f"fix,{i},{lat(i)},8.3" for i in range(ROWS))]))
    assert len(track.time) == ROWS


def test_columns_without_names_may_hold_units(write):
    (track,) = read(write(["time,lat,,lon,,", *(f"{i},{lat(i)},N,8.3,E," for i in range(ROWS))]))
    assert len(track.time) == ROWS
