"""Latitudes and longitudes in any spelling are read, or refused with what to do; placeholders are no places."""

import numpy as np
import pytest

import torchfra
from torchfra.readers import read
from torchfra.readers.options import AskError

ROWS = 40
LATITUDE, LONGITUDE = 47.5 + 1e-4 * np.arange(ROWS), 8.25 + 1e-4 * np.arange(ROWS)


@pytest.fixture
def track(tmp_path):
    """Reads the only track of a file of these columns, one fix a second."""

    def track(missing=None, **columns):
        columns = {"time": np.arange(ROWS), **columns}
        rows = ["\t".join(columns), *("\t".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
        file = tmp_path / "track.tsv"
        file.write_text("\n".join(rows) + "\n", encoding="utf-8")
        (only,) = read(file, missing=missing)
        return only

    return track


def test_columns_of_sides_say_nothing_new_of_degrees_with_signs(track):
    assert track(lat=-LATITUDE, ns=["S"] * ROWS, lon=LONGITUDE, ew=["E"] * ROWS).origin[0] == -47.5


@pytest.mark.parametrize("number", ["-999", "-9999.0", "99999"])
def test_degrees_that_stand_for_none_are_refused_until_it_is_said(track, number):
    gone = np.arange(ROWS) % 10 == 3
    columns = {"lat": np.where(gone, float(number), LATITUDE), "lon": np.where(gone, float(number), LONGITUDE)}
    with pytest.raises(ValueError, match="and missing a number that stands for none"):
        track(**columns)
    found = track(missing=f"7,{number}", **columns)
    assert (len(found.time), found.repairs) == (ROWS - 4, {"rows without position dropped": 4})


def test_the_corner_of_all_degrees_is_no_place_far_from_all_others(track):
    gone = np.arange(ROWS) % 10 == 3
    found = track(lat=np.where(gone, 0, LATITUDE), lon=np.where(gone, 0, LONGITUDE))
    assert found.repairs == {"rows at 0, 0 degrees dropped": 4}
    assert len(track(lat=LATITUDE - 47.502, lon=LONGITUDE - 8.252).time) == ROWS


def test_metres_that_stand_for_none_are_refused_until_it_is_said(track):
    x, y, gone = 10.0 * np.arange(ROWS), 3.0 * np.arange(ROWS), np.arange(ROWS) % 10 == 3
    columns = {"x": np.where(gone, -999, x), "y": np.where(gone, -999, y)}
    with pytest.raises(AskError, match="received -999 as x and y in data row 4, far from all others") as error:
        track(**columns)
    assert "--missing -999" in error.value.command
    assert len(track(**columns, missing="-999").time) == ROWS - 4
    assert len(track(**columns, missing="none").time) == ROWS
    with pytest.raises(AskError, match="received -999 as x in data row 4, far from all others"):
        track(x=np.where(gone, -999, x), y=y)
    assert len(track(x=x - 1000, y=np.full(ROWS, -999.0)).time) == ROWS


@pytest.mark.parametrize("none", ["-9999", "2147483647"])
def test_altitudes_that_stand_for_none_are_refused_until_it_is_said(track, none):
    gone = np.arange(ROWS) % 10 == 3
    columns = {"lat": LATITUDE, "lon": LONGITUDE, "alt": np.where(gone, int(none), 400)}
    with pytest.raises(
        AskError, match=rf"received {none} as alt in data row 4, .*missing='{none}' if it stands for no"
    ):
        track(**columns)
    assert np.flatnonzero(track(**columns, missing=none).filled).tolist() == [3, 13, 23, 33]
    assert not track(lat=LATITUDE, lon=LONGITUDE, alt=np.where(gone, 9999, 9980)).repairs  # a level of aircraft


def test_what_stands_for_none_is_numbers(track):
    with pytest.raises(ValueError, match="missing: expected numbers with commas between, such as -999,9999, received"):
        track(lat=LATITUDE, lon=LONGITUDE, missing="-999;9999")


def test_altitudes_that_are_all_0_are_altitudes_until_it_is_said(track):
    columns = {"lat": LATITUDE, "lon": LONGITUDE, "alt": np.zeros(ROWS)}
    assert track(**columns).position.shape == (ROWS, 3)
    assert track(**columns, missing="0").position.shape == (ROWS, 2)


def test_arrays_keep_their_length_where_a_number_stands_for_none():
    position = np.stack([10.0 * np.arange(ROWS), 3.0 * np.arange(ROWS)], 1)
    position[[3, 13]] = -999
    cleaned = torchfra.clean((np.arange(ROWS), position), missing="-999", sigma=1.0, q=0.01)
    assert cleaned.position[[3, 13]] == pytest.approx(np.array([[30, 9], [130, 39]]), abs=1)


@pytest.mark.parametrize(("header", "side"), [
    ("time,Latitude,Hemisphere,Longitude", ",S"), ("time,lat,unknown,lon", ",S"), ("time,Latitude (S),Longitude", ""),
    ("time,lat,Longitude (W)", ""), ("time,lat,ns,lon", ",South"), ("time,lat,unknown,lon", ",south"),
])  # fmt: skip
def test_degrees_to_the_south_or_west_without_a_sign_are_refused(write, header, side):
    with pytest.raises(ValueError, match="expected degrees that grow to the north and east, received others, as"):
        read(write([header, *(f"{i},{47 + i / 1e4}{side},8.5" for i in range(40))]))


def test_numbers_of_days_are_no_seconds(write):
    path = write(["day,lat,lon", *(f"{i},{47 + i / 1e4},8.5" for i in range(40))])
    with pytest.raises(ValueError, match="time='day', time_format='seconds'"):
        read(path)
    assert read(path, time="day", time_format="days")[0].time[1] == 86_400
