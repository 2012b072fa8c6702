"""Dates of two digits are read in the order by which they go on from row to row; where several do, they are refused."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from torchfra.readers import read

ROWS = 60
LATE = datetime(2021, 4, 9, 22)


def lines(form, step, start=LATE):
    """Rows of a track, an hour apart or so."""
    times = [f"{start + timedelta(hours=step * i):{form} %H:%M:%S}" for i in range(ROWS)]
    return ["time,x,y", *(f"{time},{i},{i % 7}" for i, time in enumerate(times))]


@pytest.mark.parametrize("form", ["%y/%m/%d", "%y-%m-%d", "%d/%m/%y", "%m/%d/%y", "%m/%d/%Y", "%d-%m-%Y"])
@pytest.mark.parametrize("step", [1 / 12, 1])
def test_dates_are_read_in_the_order_by_which_they_go_on(write, form, step):
    (track,) = read(write(lines(form, step)))
    assert track.source.time == f"{form} %H:%M:%S"
    np.testing.assert_allclose(np.diff(track.time), 3600 * step)


def test_the_order_is_found_from_rows_a_day_apart_where_the_years_tell_it(write):
    (track,) = read(write(lines("%y/%m/%d", 24, datetime(2021, 4, 1, 12))))
    np.testing.assert_allclose(np.diff(track.time), 86_400)


def test_dates_of_one_day_that_may_have_several_orders_are_refused_with_the_form_of_each(write):
    path = write(lines("%y-%m-%d", 1 / 60))
    with pytest.raises(ValueError, match=r"may have the day or the year first: use --time-format '%d-%m-%y %H:%M:%S' "
                       r"or '%y-%m-%d %H:%M:%S'"):  # fmt: skip
        read(path)
    (track,) = read(path, time_format="%y-%m-%d %H:%M:%S")
    assert track.source.written(track.time[:1]) == ["21-04-09 22:00:00"]


def test_dates_of_one_day_with_slashes_have_the_day_first(write):
    (track,) = read(write(lines("%d/%m/%y", 1 / 60, datetime(2023, 12, 25, 10))))
    assert track.source.notes[0] == "time: time, %d/%m/%y %H:%M:%S"
    assert track.time[0] == datetime(2023, 12, 25, 10, tzinfo=timezone.utc).timestamp()


def test_a_day_that_is_followed_by_the_same_a_year_later_may_have_the_year_first(write):
    days = ["21/04/09"] * 1200 + ["21/04/10"] * 10
    rows = [f"{day} {k // 60 % 24:02}:{k % 60:02}:00,{k},{k}" for k, day in enumerate(days)]
    with pytest.raises(ValueError, match="the year may be first: use --time-format '%y/%m/%d %H:%M:%S'"):
        read(write(["time,x,y", *rows]))


def test_a_row_a_month_may_be_a_row_a_day_in_another_order(write):
    rows = [f"{month:02}/01/2021 12:00:00,{month},0" for month in range(1, 13)]
    with pytest.raises(ValueError, match="may have the day or the month first"):
        read(write(["time,x,y", *rows]))


def test_a_date_goes_with_the_time_that_is_called_alike_and_a_date_of_zeros_is_missing(write):
    """As collars of animals write them, beside the time of their own clock."""
    rows = []
    for i in range(ROWS):
        fix = LATE + timedelta(minutes=30 * i)
        told = "00/00/00,00:00:00" if i % 7 == 3 else f"{fix:%y/%m/%d,%H:%M:%S}"
        rows.append(f"{fix + timedelta(seconds=40):%y/%m/%d,%H:%M:%S},{told},{51 + i / 1e4:.6f},{4 + i / 1e4:.6f}")
    (track,) = read(write(["RTC-date,RTC-time,FIX-date,FIX-time,Latitude,Longitude", *rows]))
    assert track.source.notes[0] == "time: FIX-date and FIX-time, %y/%m/%d %H:%M:%S"
    assert track.repairs == {"rows without time dropped": sum(i % 7 == 3 for i in range(ROWS))}
    np.testing.assert_allclose(track.time - track.time[0], 1800.0 * track.row)


def test_rows_behind_the_first_thousand_tell_whether_the_day_is_first(write):
    first = [f"05/06/2024 {i // 60:02}:{i % 60:02}:00,{i},0" for i in range(1200)]
    (track,) = read(write(["time,x,y", *first, "13/06/2024 10:00:00,5,0"]))
    assert track.source.time == "%d/%m/%Y %H:%M:%S"
    (track,) = read(write(["time,x,y", *first, "05/13/2024 10:00:00,5,0"]))
    assert track.source.time == "%m/%d/%Y %H:%M:%S"
