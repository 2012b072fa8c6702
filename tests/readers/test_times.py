"""Times are read from every way of writing them."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from torchfra.readers import read
from torchfra.readers.times import CLOCK, forms_of, seconds_of

START = 1_600_000_000  # 2020-09-13T12:26:40Z
MOMENTS = (
    "2020-09-13T12:26:40Z", "2020-09-13T12:26:40+00:00", "2020-09-13T12:26:40", "2020-09-13 12:26:40",
    "2020-09-13 12:26:40.000", "2020-09-13 12:26:40 UTC", "2020-09-13T14:26:40+02:00", "2020-09-13T08:56:40-0330",
    "13/09/2020 12:26:40", "09/13/2020 12:26:40 PM", "13.09.2020 12:26:40", "2020/09/13 12:26:40",
)  # fmt: skip


@pytest.mark.parametrize("text", MOMENTS)
def test_a_moment_is_read_from_its_text(text):
    (read,) = forms_of([text])
    assert seconds_of(text, read) == START


def test_parts_of_a_second_are_read():
    assert seconds_of("2020-09-13 12:26:40.5", "iso") == START + 0.5
    assert seconds_of("2020-09-13T12:26:40,123456789Z", "iso") == START + 0.123456
    assert seconds_of("13/09/2020 12:26:40.25", "%d/%m/%Y %H:%M:%S") == START + 0.25


def test_a_time_of_the_day_is_seconds_since_midnight():
    assert forms_of(["12:26:40.5"]) == [CLOCK]
    assert seconds_of("12:26:40.5", CLOCK) == 44800.5


def test_a_day_that_may_be_a_month_has_both_forms_unless_another_row_tells():
    both = ["%d/%m/%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S"]
    assert forms_of(["03/04/2020 12:00:00"]) == both
    assert forms_of(["03/04/2020 12:00:00", "03/13/2020 12:00:00"]) == both[1:]


@pytest.mark.parametrize("text", ["noon", "2020-09-13T12", "1", "2020-9-1x1:00:00"])
def test_other_text_is_no_time(text):
    assert forms_of([text]) == []


@pytest.mark.parametrize("text", ["2020-02-30T00:00:00", "2020-01-01T25:00:00", "2020-13-01 00:00:00", "soon"])
def test_moments_that_are_not_there_are_refused(text):
    with pytest.raises(ValueError, match=r"expected|must be in|out of range"):
        seconds_of(text, "iso")


def test_the_clock_of_a_receiver_is_taken_before_that_of_a_computer(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("sys_time,gps_time,x,y\n5,100,0,0\n6,101,1,1\n7,102,2,2\n")
    (track,) = read(path)
    assert track.time.tolist() == [100, 101, 102]


def test_an_hour_beside_a_whole_moment_is_no_part_of_the_time(write):
    moments = [datetime(2024, 5, 6, 22, 59, 40) + timedelta(seconds=i) for i in range(60)]
    (track,) = read(
        write(["date,hour,lat,lon", *(f"{one},{one.hour},{47 + i / 1e5},8" for i, one in enumerate(moments))])
    )
    assert np.diff(track.time).tolist() == [1] * 59
