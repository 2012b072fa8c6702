"""Files of loggers, watches, phones and robots are read as their makers mean them, or refused with what to do."""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from torchfra.readers import read
from torchfra.readers.options import AskError
from torchfra.readers.times import seconds_of

START = datetime(2024, 6, 3, 8, 15, tzinfo=timezone.utc)
ROWS = 40
LATITUDES = 50.0 + np.arange(ROWS) / 1e4
LONGITUDES = 7.0 + np.arange(ROWS) / 1e4
PLACES = list(zip(LATITUDES, LONGITUDES, strict=True))


def moments(seconds=1.0):
    return [START + timedelta(seconds=seconds * i) for i in range(ROWS)]


def assert_in_place(track, seconds=1.0):
    """Of a track of degrees."""
    assert np.diff(track.time) == pytest.approx(seconds)
    assert track.origin[:2] == pytest.approx((50, 7))
    assert track.position[-1, :2] == pytest.approx([279.4, 433.8], abs=1)


# ---------------------------------------------------------------- lines around the header


RACE = [
    "This file is created using RaceChrono v8.0.4", "Format,3", 'Session title,"Ring"', "Note,", "",
    "timestamp,lap_number,elapsed_time,accuracy,altitude,bearing,latitude,longitude,speed",
    "unix time,,s,m,m,deg,deg,deg,m/s",
    ",,,100: gps,100: gps,100: gps,100: gps,100: gps,100: gps",
]  # fmt: skip


def test_lines_before_the_header_and_units_beneath_it_are_left_out_and_said(write):
    rows = [f"{START.timestamp() + i},1,{i},1.5,600,10,{lat},{lon},40" for i, (lat, lon) in enumerate(PLACES)]
    (track,) = read(write([*RACE, *rows]))
    assert_in_place(track)
    assert track.row.tolist() == list(range(ROWS))
    assert {"lines before the header left out: 4", "lines of units beneath the header: 2"} <= {*track.source.notes}


def test_units_beneath_the_header_count(write):
    (track,) = read(write(["Time,X,Y", "s,mm,mm", *(f"{i},{1000 * i},0" for i in range(ROWS))]))
    assert track.position[:2, 0].tolist() == [0, 1]


@pytest.mark.parametrize("unit", ["rad", "[radians]", "inch", "px"])
def test_a_unit_beneath_the_header_that_nobody_converts_is_refused(write, unit):
    path = write(["time,lat,lon", f"s,{unit},{unit}", *(f"{i},{(82 + i) / 100},0.14" for i in range(ROWS))])
    with pytest.raises(ValueError, match=r"column lat \(.*\): expected metres or degrees, received .*: convert"):
        read(path)


@pytest.mark.parametrize("text", [
    "t,x [furlong],y [furlong]\n", "t,x,y\ns,deg,deg\n", "# s,um,um\nt,x,y\n", "# s,rad,rad\nt,x,y\n",
    "# units: mrad\nt,x,y\n", "Units;px\nt,x,y\n",
])  # fmt: skip
def test_a_unit_of_x_and_y_that_is_not_known_is_refused_wherever_it_stands_and_can_be_stated(write, text):
    path = write(text + "".join(f"{i},{2 * i},{3 * i}\n" for i in range(ROWS)))
    with pytest.raises(AskError) as refused:
        read(path)
    assert "--units" in refused.value.command
    assert read(path, units="mm")[0].position[1] == pytest.approx([0.002, 0.003])


def test_a_first_row_without_a_position_is_no_row_of_units(write):
    (track,) = read(write(["t,x,y", "0,nan,nan", *(f"{i},{i},0" for i in range(1, ROWS))]))
    assert track.repairs == {"rows without position dropped": 1}
    assert track.row[0] == 1


def test_columns_that_are_asked_for_tell_the_header(write):
    rows = ["Trajectories", "100", "sample,Sub Frame,ax,ay", *(f"{i},0,{i},0" for i in range(ROWS))]
    (track,) = read(write(rows), time="sample", x="ax", y="ay")
    assert len(track.time) == ROWS


MOTIVE = ["Format Version,1.23,Length Units,Millimeters", ",,Type,Rigid Body", "Frame,Time (Seconds),X,Y,Z"]


def test_a_unit_before_the_header_is_asked_for(write):
    path = write([*MOTIVE, *(f"{i},{i / 100},{1000 * i},0,0" for i in range(300))])
    with pytest.raises(ValueError, match=r"line beside the rows states lengths in Millimeters: state it by units='mm'"):
        read(path)
    assert read(path, units="mm")[0].position[1, 0] == 1


@pytest.mark.parametrize("unit", ["ft", "foot", "yd", "miles", "nmi"])
def test_short_names_of_units_before_the_header_count_too(write, unit):
    path = write([f"Length unit: {unit}", "Time,X,Y", *(f"{i},{i},0" for i in range(ROWS))])
    with pytest.raises(ValueError, match=f"line beside the rows states lengths in {unit}"):
        read(path)


def test_radians_before_the_header_may_be_of_an_angle_beside_metres(write):
    path = write(["# units: m, s, rad", "time,x,y,heading", *(f"{i},{i},0,1" for i in range(ROWS))])
    with pytest.raises(ValueError, match=r"lengths in rad: say units='m'"):
        read(path)
    assert read(path, units="m")[0].position[1, 0] == 1


def test_unknown_units_beneath_x_and_y_are_refused(write):
    path = write(["time,x,y", "s,furlong,furlong", *(f"{i},{i},0" for i in range(ROWS))])
    with pytest.raises(ValueError, match=r"column x \(furlong\): expected lengths, received furlong: .*units='m'"):
        read(path)
    assert read(path, units="m")[0].position[1, 0] == 1


def test_columns_of_one_name_are_refused_with_what_to_do(write):
    lines = ["Trajectories", "100", "Frame,Sub Frame,X,Y,Z,X,Y,Z", *(f"{i},0,1,2,3,4,5,6" for i in range(ROWS))]
    with pytest.raises(ValueError, match=r"several named X, Y, Z: give each a name of its own in the header"):
        read(write(lines))


def test_headers_in_the_middle_of_files_that_were_joined_are_refused(write):
    rows = [f"{i},{i},0" for i in range(ROWS)]
    with pytest.raises(ValueError, match="expected a number in data row 21, column time, received 'time'"):
        read(write(["time,x, y", *rows[:20], "time,x, y", *rows[20:]]))


# ---------------------------------------------------------------- robots


def test_topics_of_ros_are_read_by_the_comment_that_names_them(write):
    names = "%time,field.header.seq,field.header.stamp,field.pose.pose.position.x,field.pose.pose.position.y,"
    names += "field.pose.pose.orientation.x,field.pose.pose.orientation.y"
    stamps = [round(moment.timestamp()) * 10**9 for moment in moments()]
    (track,) = read(write([names, *(f"{stamp},{i},{stamp},{i},{2 * i},0,1" for i, stamp in enumerate(stamps))]))
    assert track.position[1].tolist() == [1, 2]
    assert track.time[0] == START.timestamp()


# ---------------------------------------------------------------- watches, cars and phones


def test_laps_of_a_watch_as_tcx_are_asked_for_as_gpx(write):
    with pytest.raises(ValueError, match="export TCX as GPX"):
        read(write("<TrainingCenterDatabase><Activities/></TrainingCenterDatabase>", "run.tcx"))


def test_a_glider_flies_on_after_midnight(write):
    start = datetime(2024, 6, 3, 23, 59, 50, tzinfo=timezone.utc)
    fixes = [
        f"B{start + timedelta(seconds=i):%H%M%S}{int(lat):02}{round(lat % 1 * 60000):05}N"
        f"{int(lon):03}{round(lon % 1 * 60000):05}EA0100000{500 + i}" for i, (lat, lon) in enumerate(PLACES)
    ]  # fmt: skip
    (track,) = read(write(["AXXX001", "HFDTEDATE:030624,01", *fixes, "LXXXsome words"], "flight.igc"))
    assert_in_place(track)
    assert track.time[0] == start.timestamp()
    assert track.origin[2] == 500
    with pytest.raises(ValueError, match=r"expected IGC with a date \(HFDTE\) and fixes \(B\)"):
        read(write(["AXXX001", *fixes], "flight.igc"))


def test_fixes_of_a_glider_that_change_places_at_midnight_are_of_one_night(write):
    clocks = ["235957", "000001", "235959", "000002", "000003"]
    fixes = [f"B{clock}470000{i}N0080000{i}EA0100000500" for i, clock in enumerate(clocks)]
    (track,) = read(write(["AXXX001", "HFDTE030624", *fixes], "flight.igc"))
    assert (track.time - track.time[0]).tolist() == [0, 2, 4, 5, 6]


def test_a_position_that_is_held_without_satellites_is_none(write):
    east, held = [0, 10, 20, 20, 20, 50, 50, 60], "AAAVVVAA"
    fixes = [f"B1000{i:02}5000000N007{way:05}E{valid}0100000500"
             for i, (way, valid) in enumerate(zip(east, held, strict=True))]  # fmt: skip
    (track,) = read(write(["AXXX001", "HFDTE030624", *fixes], "flight.igc"))
    assert (track.time - track.time[0]).tolist() == [0, 1, 2, 5, 6, 7]  # one that stands has a position, and so has V
    assert any("2 held positions (V) left out" in note for note in track.source.notes)


@pytest.mark.parametrize("nothing", ["0", "0.0", ""])
def test_an_accuracy_that_is_0_everywhere_is_none(write, nothing):
    rows = [f"{i},{lat},{lon},{nothing}" for i, (lat, lon) in enumerate(PLACES)]
    (track,) = read(write(["time,lat,lon,accuracy", *rows], "taxi.csv"))
    assert track.sigma is None
    assert not any("sigma" in note for note in track.source.notes)


@pytest.mark.parametrize("nothing", ["0", ""])
def test_an_accuracy_that_is_written_later_on_is_used(write, nothing):
    rows = [f"{i},{47 + i / 1e5:.5f},8,{nothing if i < 1500 else 5 + i % 2}" for i in range(2000)]
    (track,) = read(write(["time,lat,lon,accuracy", *rows], "phone.csv"))
    assert track.sigma is not None
    assert track.repairs["sigmas filled with their median"] == 1500


@pytest.mark.parametrize("name", ["valid", "gps_valid", "isValid"])
@pytest.mark.parametrize(("yes", "no"), [("true", "false"), ("1", "0")])
def test_fixes_that_a_tracker_marks_as_invalid_are_dropped(write, name, yes, no):
    rows = [f"{i},{lat},{lon},{no if 3 <= i < 5 else yes}" for i, (lat, lon) in enumerate(PLACES)]
    (track,) = read(write([f"time,lat,lon,{name}", *rows], "taxi.csv"))
    assert len(track.time) == ROWS - 2
    assert track.repairs["rows marked as invalid dropped"] == 2


@pytest.mark.parametrize("cells", [["0"], ["7", "8"]])
def test_a_column_of_marks_that_tells_nothing_is_ignored(write, cells):
    rows = [f"{i},{lat},{lon},{cells[i % len(cells)]}" for i, (lat, lon) in enumerate(PLACES)]
    (track,) = read(write(["time,lat,lon,valid", *rows], "taxi.csv"))
    assert len(track.time) == ROWS


@pytest.mark.parametrize(("lines", "said"), [
    (["HFDTE030624", "B9959574700000N00800000EA0100000500"], "fixes (B), received none"),
    (["HFDTE990624", "B0959574700000N00800000EA0100000500"], "expected a date (HFDTE) such as 310124, received 990624"),
    (["HFDTE030624", "HFDTE040624", "B0959574700000N00800000EA0100000500"], "one date (HFDTE), received 030624, 0"),
])  # fmt: skip
def test_what_no_clock_or_calendar_has_is_refused_of_a_glider(write, lines, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        read(write(["AXXX001", *lines], "flight.igc"))


def test_altitudes_of_a_glider_are_by_pressure_where_it_has_no_others(write):
    fixes = [f"B1000{i:02}5000000N007{10 * i:05}WV0100000000" for i in range(ROWS)]
    (track,) = read(write(["AXXX001", "HFDTE030624", *fixes], "flight.igc"))
    assert track.origin == pytest.approx((50, -7, 1000))


def test_what_rtklib_writes_has_one_name_for_date_and_time(write):
    names = "%  GPST       latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    rows = [f"{moment:%Y/%m/%d %H:%M:%S}.000   {lat} {lon} 400.0 1 12 0.005 0.004 0.01"
            for moment, (lat, lon) in zip(moments(), PLACES, strict=True)]  # fmt: skip
    (track,) = read(write(["% program   : RTKPOST", "%", names, *rows], "a.pos"))
    assert_in_place(track)
    assert track.sigma[0].tolist() == [0.004, 0.005, 0.01]


# ---------------------------------------------------------------- degrees that are called x and y


def test_degrees_that_are_called_x_and_y_are_no_metres(write):
    rng = np.random.default_rng(0)
    places = np.array(PLACES) + 3e-5 * rng.standard_normal((ROWS, 2))
    rows = [f"{i},{lon:.7f},{lat:.7f}" for i, (lat, lon) in enumerate(places)]
    path = write(["time,X,Y", *rows])
    with pytest.raises(
        ValueError, match=r"metres in X and Y, .* looks like degrees .*: say lat='Y', lon='X'; or units='m'"
    ):
        read(path)
    assert_in_place_nearly(read(path, lat="Y", lon="X")[0])
    assert read(path, units="m")[0].origin is None


def assert_in_place_nearly(track):
    assert track.origin[:2] == pytest.approx((50, 7), abs=2e-4)


@pytest.mark.parametrize("step", [0.0, 0.01, 1.0])
def test_metres_are_no_degrees_however_fine_they_are(write, step):
    rng = np.random.default_rng(1)
    places = (20.0, 30.0) + np.arange(ROWS)[:, None] * step + 1e-4 * rng.standard_normal((ROWS, 2))
    (track,) = read(write(["time,x,y", *(f"{i},{x:.7f},{y:.7f}" for i, (x, y) in enumerate(places))]))
    assert track.origin is None


# ---------------------------------------------------------------- dates


@pytest.mark.parametrize("form", ["%d-%b-%Y", "%d %b %Y"])
def test_months_may_have_names(write, form):
    rows = [f"{moment:{form}},{moment:%H:%M:%S},{i},0" for i, moment in enumerate(moments(7200))]
    (track,) = read(write(["Date (UTC),Time (UTC),x,y", *rows]))
    assert track.time[0] == START.timestamp()
    assert np.diff(track.time) == pytest.approx(7200)


def test_names_of_months_are_english_in_every_locale(monkeypatch):
    class Elsewhere(datetime):
        """In a locale whose months have other names."""

        @classmethod
        def strptime(cls, text, form):
            assert not {"%b", "%B"} & {form[i : i + 2] for i in range(len(form))}
            return datetime.strptime(text, form)

    monkeypatch.setattr("torchfra.readers.times.datetime", Elsewhere)
    expected = datetime(2024, 12, 3, 1, 2, tzinfo=timezone.utc).timestamp()
    assert seconds_of("03-Dec-2024 01:02", "%d-%b-%Y %H:%M") == expected
    with pytest.raises(ValueError, match="does not match"):
        seconds_of("03-Dez-2024 01:02", "%d-%b-%Y %H:%M")


def test_a_local_time_that_only_goes_backwards_is_put_in_order(write):
    rows = [f"{moment:%Y-%m-%d %H:%M:%S},{i},0" for i, moment in enumerate(moments(1800))]
    assert len(read(write(["time,x,y", *reversed(rows)]))[0].time) == ROWS


# ---------------------------------------------------------------- numbers


@pytest.mark.parametrize("number", ["1,234", "1.23,4.5", "12,34.5", "1,2345.6", "1,,234.5", "1234,567.8"])
def test_other_groups_are_no_numbers(write, number):
    with pytest.raises(ValueError, match="expected a number in data row 2, column y"):
        read(write(["t,x,y", "0,1,2", f'1,2,"{number}"', "2,3,4"]))


@pytest.mark.parametrize("number", ["1,234", "1,234.50", "1'234.50", "1\u2019234"])
def test_what_may_be_thousands_or_decimals_is_refused_as_such(write, number):
    with pytest.raises(ValueError, match=f"received .{number}., whose sign may part thousands or decimals"):
        read(write(["t,x,y", "0,1,2", f'1,2,"{number}"', "2,3,4.5"]))


# ---------------------------------------------------------------- what is no track on the ground


def test_a_satellite_may_be_as_fast_as_it_is(write):
    angles = 7612 / 6878e3 * 10 * np.arange(ROWS)
    rows = [f"{moment:%Y-%m-%dT%H:%M:%SZ},{6878 * np.cos(a)},{6878 * np.sin(a)},0"
            for moment, a in zip(moments(10), angles, strict=True)]  # fmt: skip
    path = write(["epoch,x_km,y_km,z_km", *rows])
    with pytest.raises(ValueError, match=r"7.61 km/s as the median .*; or it is right: time_format='iso'"):
        read(path)
    assert len(read(path, time_format="iso")[0].time) == ROWS


# ---------------------------------------------------------------- times


def local(form, days=0, minutes=0):
    moment = datetime(2024, 4, 10, 8, 15) + timedelta(days=days, minutes=minutes)
    return moment.strftime(form)


def test_dates_whose_day_and_month_a_spreadsheet_exchanged_are_refused(write):
    forms = ["%m/%d/%Y %H:%M" if i < 22 else "%d/%m/%Y %H:%M" for i in range(ROWS)]  # up to the 12th, and behind it
    rows = [f"{local(form, i / 8)},{lat},{lon}" for i, (form, (lat, lon)) in enumerate(zip(forms, PLACES, strict=True))]
    with pytest.raises(AskError, match="expected times that go on, received earlier ones from data row 23 on"):
        read(write(["Date,lat,lon", *rows]))


def test_counts_that_begin_anew_are_refused(write):
    rows = [f"{i % 25},{lat},{lon}" for i, (lat, lon) in enumerate(PLACES)]
    with pytest.raises(AskError, match="expected times that go on, received earlier ones from data row 26 on"):
        read(write(["seconds,lat,lon", *rows]))


def test_pieces_of_a_track_may_be_in_any_order_by_unix_times(write):
    """As the flights of an aircraft by their names, far from each other."""
    flights = [[f"{START.timestamp() + 3600 * k + i},{lat + k},{lon}" for i, (lat, lon) in enumerate(PLACES)]
               for k in range(3)]  # fmt: skip
    (track,) = read(write(["timestamp,lat,lon", *flights[2], *flights[0], *flights[1]]))
    assert track.repairs == {"rows put in time order": 2 * ROWS}
    assert (np.diff(track.time) > 0).all()


def test_dates_of_a_whole_year_are_in_one_order(write):
    rows = [f"{local('%d/%m/%Y %H:%M', 9 * i)},{lat},{lon}" for i, (lat, lon) in enumerate(PLACES)]
    (track,) = read(write(["Date,lat,lon", *rows]))
    assert np.diff(track.time) == pytest.approx(9 * 86_400)


def test_one_fix_a_month_is_in_the_order_that_is_written(write):
    rows = [f"05.{1 + i % 12:02}.{2020 + i // 12} 10:00,{lat},{lon}" for i, (lat, lon) in enumerate(PLACES)]
    (track,) = read(write(["Date,lat,lon", *rows]))
    assert np.diff(track.time).min() >= 28 * 86_400


SINCE_2001 = START.timestamp() - 978_307_200


@pytest.mark.parametrize(
    "header",
    ["timeIntervalSinceReferenceDate,latitude,longitude,speed,course", "ZTIMESTAMP,ZLATITUDE,ZLONGITUDE,ZSPEED,Z_PK",
     "timestamp,latitude,longitude,horizontalAccuracy,verticalAccuracy"],
)  # fmt: skip
def test_phones_may_count_from_2001(write, header):
    rows = [f"{SINCE_2001 + i:.3f},{lat},{lon},3,4" for i, (lat, lon) in enumerate(PLACES)]
    (track,) = read(write([header, *rows]))
    assert_in_place(track)
    assert track.time[0] == START.timestamp()
    assert ", apple" in " ".join(track.source.notes)


def test_seconds_since_1970_of_a_phone_stay_so(write):
    rows = [f"{START.timestamp() + i:.3f},{lat},{lon},3,4" for i, (lat, lon) in enumerate(PLACES)]
    (track,) = read(write(["timestamp,latitude,longitude,horizontalAccuracy,verticalAccuracy", *rows]))
    assert track.time[0] == START.timestamp()


# ---------------------------------------------------------------- cells and columns


def test_columns_without_names_do_not_shift_the_others(write):
    (track,) = read(write(["t,x,y,,", *(f"{i},{2 * i},{3 * i},," for i in range(ROWS))]))
    assert track.time.tolist() == list(range(ROWS))
    assert (track.position == np.stack([2 * track.time, 3 * track.time], 1)).all()


def test_a_first_row_of_words_for_nothing_is_no_row_of_units(write):
    rows = [
        "NULL,NULL,NULL",
        *(f"{START + timedelta(seconds=i):%FT%TZ},{lat},{lon}" for i, (lat, lon) in enumerate(PLACES)),
    ]
    (track,) = read(write(["time,lat,lon", *rows]))
    assert track.row.tolist() == list(range(1, ROWS + 1))


def test_times_may_be_words_for_nothing(write):
    rows = [
        f"{local('%d.%m.%Y,%H:%M:%S', 0, i) if i % 5 else 'N/A,N/A'},{lat},{lon}" for i, (lat, lon) in enumerate(PLACES)
    ]
    (track,) = read(write(["Date,Time,lat,lon", *rows]))
    assert track.repairs == {"rows without time dropped": 8}


def test_numbers_of_tracks_are_targets(write):
    rows = [f"{i},{i % 2},{i + 9000 * (i % 2)},{i}" for i in range(ROWS)]
    assert [track.name for track in read(write(["t,TRACK_NO,x,y", *rows]))] == ["0", "1"]
