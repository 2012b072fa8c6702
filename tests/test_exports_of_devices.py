"""Files as widespread programs export them are read at once, or refused with what reads them."""

import math
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


def test_a_hint_names_the_altitude_beside_places(write):
    lines = table("time,OSD.latitude,OSD.longitude,OSD.altitude [ft],HOME.latitude,HOME.longitude",
                  lambda i: f"{i},{lat(i)},8.3000001,{400 + i},47.0,8.3")  # fmt: skip
    with pytest.raises(ValueError, match=r"--lat OSD.latitude --lon OSD.longitude --alt 'OSD.altitude \[ft\]'"):
        read(write(lines))


def test_a_hint_takes_the_column_of_times_before_one_that_counts_rows(write):
    lines = table("Nr,t [sec],x [pixel],y [pixel]", lambda i: f"{i},{i / 10},{3 * i},{2 * i}")
    with pytest.raises(ValueError, match=r"--time 't \[sec\]' --x 'x \[pixel\]'"):
        read(write(lines))


def test_a_hint_names_the_target_though_a_column_numbers_the_rows(write):
    names = ("id", "bus.id", "bus.position.latitude", "bus.position.longitude", "bus.timestamp")
    lines = table(",".join(f"entity.{name}" for name in names), lambda i:
                  f"e{i},bus{i % 2},{47 + i * 1e-4 + i % 2:.6f},8.3000{i % 9 + 1},{1714991460 + i // 2}")  # fmt: skip
    with pytest.raises(ValueError, match=r"--lon entity.bus.position.longitude --id entity.bus.id"):
        read(write(lines))


@pytest.mark.parametrize("late", ["unknown", "DGPS"])
def test_words_that_are_neither_true_nor_false_mark_nothing(write, late):
    lines = table("t,x,y,valid", lambda i: f"{i},{2 * i},1.5,{late if i == 30 else 'false' if i == 20 else 'true'}")
    (track,) = read(write(lines))
    assert track.repairs == {"rows marked as invalid dropped": 1}


def test_a_third_word_behind_the_first_thousand_rows_marks_nothing_either(write):
    lines = ["t,x,y,valid", *(f"{i},{2 * i},1.5,{'no fix' if i == 1500 else 'true'}" for i in range(2000))]
    (track,) = read(write(lines))
    assert len(track.time) == 2000


def test_points_without_a_grid_whose_steps_are_metres_are_refused_however_many_digits_they_have(write):
    lines = table("t,geom", lambda i: f"{i},POINT({20.123456 + 0.3456789 * i:.7f} {30 + 0.2345678 * i:.7f})")
    with pytest.raises(ValueError, match="expected speeds below 5 km/s"):
        read(write(lines))


def test_times_in_utc_are_taken_before_local_ones(write):
    lines = table("datetime(utc),datetime(local),latitude,longitude",
                  lambda i: f"2024-05-06 10:31:{i:02},2024-05-06 12:31:{i:02},{lat(i)},8.3")  # fmt: skip
    (track,) = read(write(lines))
    assert track.source.columns["time"] == "datetime(utc)"


def test_time_stamps_of_an_autopilot_are_microseconds(write):
    (track,) = read(write(table("timestamp,timestamp_sample,lat,lon", lambda i: f"{i * 10**6},{i},{lat(i)},8.3")))
    assert track.time[-1] == ROWS - 1


@pytest.mark.parametrize(("altitude", "metres"), [(lambda i: 430 + i % 3, 2), (lambda i: 430_000 + 100 * i, 3.9)])
def test_whole_altitudes_beside_whole_degrees_are_metres_where_they_hardly_change(write, altitude, metres):
    lines = table("time,lat,lon,alt", lambda i: f"{i},{470000000 + 1000 * i},83000000,{altitude(i)}")
    (track,) = read(write(lines))
    assert np.ptp(track.position[:, 2]) == pytest.approx(metres, abs=0.02)


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


def test_elements_around_places_are_targets_where_nothing_names_them(write):
    ways = "".join("<track>" + "".join(f'<point time="{i}" x="{i + 50 * k}" y="1"/>' for i in range(ROWS)) + "</track>"
                   for k in range(2))  # fmt: skip
    one, two = read(write(f"<tracks>{ways}</tracks>", "a.xml"))
    assert [one.name, two.name] == ["track 1", "track 2"]


def test_spots_of_a_microscope_need_frames_and_a_unit(write):
    spots = "".join(f'<detection t="{i}" x="{i}.5" y="1.0" z="0.0"/>' for i in range(ROWS))
    path = write(f'<Tracks spaceUnits="micron" frameInterval="0.5"><particle>{spots}</particle></Tracks>', "a.xml")
    with pytest.raises(ValueError, match=r"--time frame --time-format 25fps --x 'x \(micron\)' --y 'y \(micron\)'"):
        read(path)
    (track,) = read(path, time="frame", time_format="2fps", x="x (micron)", y="y (micron)", units="mm")
    assert (track.time[-1], math.dist(*track.position[:2])) == pytest.approx(((ROWS - 1) / 2, 0.001))


def test_a_data_set_of_two_columns_for_an_id_is_explained(tmp_path):
    with pytest.raises(ValueError, match=re.escape("id: expected one column, by which a data set is parted, received")):
        open_data(tmp_path, id="a,b")


def test_logs_of_autopilots_have_fixes_of_one_receiver_among_other_messages(write):
    head = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
            "FMT, 130, 50, GPS, QBBIHff, TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt", "PARM, 1, SYSID, 1"]  # fmt: skip
    rows = (f"GPS, {i}, {k}, 3, {124278000 + 1000 * i}, 2313, {lat(i)}, 8.3, 430\nATT, 1, 2"
            for i in range(ROWS) for k in range(2))  # fmt: skip
    (track,) = read(write([*head, *rows], "1.log"))
    assert (len(track.time), track.time[0]) == (ROWS, 1714991460)


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


def test_messages_of_receivers_of_aircraft_without_a_header_have_feet_and_targets(write):
    day = "2024/05/06"
    rows = (f"MSG,3,1,1,4B180{k},1,{day},10:31:{i:02}.123,{day},10:31:{i:02}.2,,{3000 + i},,,{lat(i)},8.3,,,0,0,0,0"
            for i in range(ROWS) for k in range(2))  # fmt: skip
    one, two = read(write(list(rows)))
    assert (one.name, two.name, one.source.word, one.source.unit) == ("4B1800", "4B1801", "aircraft", 0.3048)


def test_the_axis_that_is_up_in_motion_capture_is_said(write):
    head = ["Format Version,1.23,Length Units,Meters,Coordinate Space,Global", "", ",,Drone,Drone,Drone",
            ",,Position,Position,Position"]  # fmt: skip
    (track,) = read(
        write(table("Frame,Time (Seconds),X,Y,Z", lambda i: f"{i},{i / 10},{i / 9:.3f},{i % 3},1.{i}", head))
    )
    assert any("y is up" in note for note in track.source.notes)


WIDE = {
    "names": table("time,Player11_x,Player11_y,Player1_x,Player1_y", lambda i: f"{i / 10},{i}.5,1,{2 * i},3"),
    "blanks": table("Period,Frame,Time [s],Player11,,Player1,", lambda i: f"1,{i},{i / 10},{i}.5,1,{2 * i},3",
                    [",,,Home,,Home,", ",,,11,,1,"]),
}  # fmt: skip


@pytest.mark.parametrize("way", WIDE)
def test_targets_side_by_side_are_refused_with_a_line_of_python_that_parts_them(write, way, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    path = write(WIDE[way])
    with pytest.raises(ValueError, match=r"side by side, and all are read from long\.csv after") as refused:
        read(path)
    exec(str(refused.value).rpartition("after: ")[2], {"pandas": pytest.importorskip("pandas"), "FILE": path})
    one, two = read("long.csv")
    assert one.name.startswith("Player1")
    assert {one.position[-1, 0], two.position[-1, 0]} == {ROWS - 0.5, 2 * ROWS - 2}
