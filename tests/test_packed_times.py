"""Dates and clocks whose digits stand in one number are refused, with the form that reads them."""

from __future__ import annotations

import re
from datetime import datetime, timedelta

import numpy as np
import pytest

from torchfra.readers import read

START = datetime(2024, 6, 3, 1, 15)
ROWS = 120


def moments(seconds):
    return [START + timedelta(seconds=float(passed)) for passed in seconds]


@pytest.fixture
def write(tmp_path):
    def write(names, cells):
        path = tmp_path / "a.csv"
        rows = [f"{cell},{50 + i / 1e4},{7 + i / 1e4}" for i, cell in enumerate(cells)]
        path.write_text("\n".join([f"{names},lat,lon", *rows]) + "\n", encoding="utf-8")
        return path

    return write


FORMS = [
    ("time", "%Y%m%d%H%M%S", 1), ("timestamp", "%Y%m%d%H%M%S", 1), ("time", "%Y%m%d%H%M", 60), ("time", "%H%M%S", 1),
    ("date", "%Y%m%d", 86_400), ("date", "%Y%j", 86_400), ("utc", "%H%M%S", 10), ("time", "%H%M", 60),
    ("date,time", "%Y%m%d %H%M%S", 1), ("date,time", "%d%m%y %H%M%S", 1), ("Date,Time", "%Y%m%d %H%M", 60),
]  # fmt: skip


@pytest.mark.parametrize(("names", "form", "step"), FORMS)
def test_digits_of_a_date_or_a_clock_are_refused_with_the_form_that_reads_them(write, names, form, step):
    seconds = step * np.arange(ROWS)
    cells = [" ".join(f"{int(part)}" for part in f"{moment:{form}}".split()) for moment in moments(seconds)]
    path = write(names, [cell.replace(" ", ",") for cell in cells])
    with pytest.raises(ValueError, match=rf"which looks like .* in one number: --time-format .*{re.escape(form)}"):
        read(path)
    (track,) = read(path, time_format=form)
    assert np.diff(track.time) == pytest.approx(np.diff(seconds))


def test_times_that_come_unevenly_are_told_by_their_endings(write):
    seconds = np.cumsum(np.random.default_rng(3).integers(5, 120, 60))
    with pytest.raises(ValueError, match=r"hours and minutes in one number: --time-format %H%M%S"):
        read(write("time", [f"{moment:%H%M%S}" for moment in moments(seconds)]))


def test_a_clock_whose_hour_rises_as_far_as_its_minute_falls_is_one(write):
    seconds = 30 * np.arange(119)  # from 08:30:00 to 09:29:00
    cells = [f"{datetime(2024, 6, 3, 8, 30) + timedelta(seconds=int(passed)):%H%M%S}" for passed in seconds]
    with pytest.raises(ValueError, match="hours and minutes in one number"):
        read(write("time", cells))


def test_parts_of_a_second_behind_the_digits_are_asked_for(write):
    cells = [f"{moment:%d%m%y,%H%M%S}25" for moment in moments(np.arange(ROWS))]
    with pytest.raises(ValueError, match=r"parts of one in one number: write them as 08:15:00.25"):
        read(write("Date,Time", cells))


def test_parts_of_a_second_behind_a_point_are_read(write):
    cells = [f"{moment:%H%M%S}.{5 * (i % 2)}" for i, moment in enumerate(moments(np.arange(ROWS)))]
    (track,) = read(write("time", cells), time_format="%H%M%S")
    assert np.diff(track.time)[:2].tolist() == [1.5, 0.5]


COUNTS = [
    np.arange(300), np.arange(3000) / 10, 100 * np.arange(60), 50 * np.arange(60), 8 * 3600 + 10 * np.arange(300),
    1000 * np.arange(60), np.cumsum(np.random.default_rng(4).integers(5, 120, 60)), np.arange(59),
]  # fmt: skip


@pytest.mark.parametrize("seconds", COUNTS, ids=range(len(COUNTS)))
def test_counts_of_seconds_are_taken_for_no_clocks(write, seconds):
    (track,) = read(write("time", seconds.tolist()))
    assert np.diff(track.time) == pytest.approx(np.diff(seconds))


def test_two_pieces_of_seconds_that_end_before_a_minute_are_no_clock(write):
    seconds = [*range(60), *range(500, 560)]
    assert read(write("time", seconds))[0].time.tolist() == seconds


WRAPS = [("tod", 1, 86_400), ("time", 1, 86_400), ("tow", 1, 604_800), ("itow", 1000, 604_800_000),
         ("time_us", 10_000, 2**32), ("time_ms", 1000, 2**32)]  # fmt: skip


@pytest.mark.parametrize(("name", "step", "whole"), WRAPS)
def test_counts_go_on_after_midnight_a_week_and_32_bits(write, name, step, whole):
    (track,) = read(write(name, [(whole - 60 * step + step * i) % whole for i in range(ROWS)]))
    assert np.ptp(np.diff(track.time)) == pytest.approx(0, abs=1e-6)
    assert track.repairs == {"times carried on where the count begins anew": 60}


@pytest.mark.parametrize("newest_first", [False, True])
def test_plots_of_a_radar_go_on_after_midnight_though_late_and_with_gaps(write, newest_first):
    """Rows of several targets: those of a turn are not in order, and some are missing."""
    rng = np.random.default_rng(5)
    since = np.delete(17.0 * np.arange(ROWS) + rng.uniform(-9, 9, ROWS), [*range(20, 24), *range(60, 63)])
    order = slice(None, None, -1 if newest_first else 1)
    (track,) = read(write("tod", np.round(86_400 - 16.5 * ROWS / 2 + since, 2)[order] % 86_400))
    np.testing.assert_allclose(np.sort(since) - since.min(), track.time - track.time[0], atol=0.02)


def test_a_pause_of_nearly_a_day_in_a_count_is_no_midnight_though_rows_change_places(write):
    seconds = [*range(20), 21, 20, *range(22, 60), *range(85_060, 85_120)]
    (track,) = read(write("t", seconds))
    assert track.time.tolist() == sorted(seconds)


def test_days_of_other_targets_are_none_after_midnight(tmp_path):
    path = tmp_path / "a.csv"
    rows = [f"{name},{600 * i},{50 + i / 1e4},7" for name in "ab" for i in range(144)]
    path.write_text("\n".join(["id,tod,lat,lon", *rows]) + "\n", encoding="utf-8")
    assert [track.time[0] for track in read(path)] == [0, 0]


def test_times_of_a_logger_that_was_started_again_are_refused(write):
    with pytest.raises(
        ValueError, match=r"received 0.5 s behind 79 s in data row 81, t, as of a logger that was start"
    ):
        read(write("t", [i if i < 80 else i - 79.5 for i in range(ROWS)]))


@pytest.mark.parametrize("step", [21_600, 86_400])
def test_a_row_that_is_late_by_hours_begins_no_other_day(write, step):
    order = [0, 1, 3, 2, *range(4, ROWS)]
    (track,) = read(write("t", [step * i for i in order]))
    assert track.time.tolist() == [step * i for i in range(ROWS)]


def test_pieces_of_one_path_that_take_turns_are_put_in_time_order(tmp_path):
    path, order = tmp_path / "a.csv", [*range(0, ROWS, 2), *range(1, ROWS, 2)]
    path.write_text("\n".join(["t,lat,lon", *(f"{i},{50 + i / 1e4},7" for i in order)]) + "\n", encoding="utf-8")
    assert np.diff(read(path)[0].time).tolist() == [1.0] * (ROWS - 1)


def test_pieces_in_another_order_are_put_in_time_order(write):
    (track,) = read(write("t", [*range(60, ROWS), *range(60)]))
    assert np.diff(track.time).tolist() == [1.0] * (ROWS - 1)


@pytest.mark.parametrize(("epoch", "said"), [(1, "ticks of .NET"), (1601, "100 ns since 1601")])
def test_counts_since_other_years_are_refused_with_how_to_convert_them(write, epoch, said):
    ticks = [int((moment - datetime(epoch, 1, 1)) / timedelta(microseconds=1)) * 10 for moment in moments(range(ROWS))]
    path = write("time", ticks)
    with pytest.raises(ValueError, match=rf"column time: .* which looks like {said}") as refused:
        read(path)
    shift = int(re.search(r"- ([0-9]+)\)", str(refused.value))[1])
    assert (ticks[0] - shift) / 1e7 == (START - datetime(1970, 1, 1)).total_seconds()


def test_julian_days_are_read(write):
    path = write("jd", [f"{2_460_464.5 + i / 1440:.9f}" for i in range(ROWS)])
    with pytest.raises(ValueError, match=r"looks like --time jd --time-format jd"):
        read(path)
    (track,) = read(path, time="jd", time_format="jd")
    assert np.diff(track.time) == pytest.approx(60, abs=1e-3)
