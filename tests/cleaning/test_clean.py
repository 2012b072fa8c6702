"""One call cleans a table, arrays or a file, and the results join to what was handed in."""

from __future__ import annotations

import sys
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

import torchfra
from torchfra.cleaning import Cleaned
from torchfra.geodesy import to_geodetic
from torchfra.readers import read

pandas = pytest.importorskip("pandas")
ORIGIN = (47.0, 8.0, 400.0)
STEPS, BAD = 30, 15
"""Fixes, and the one that is wrong."""


@pytest.fixture(scope="module")
def walk():
    """Times, true positions and measured ones of a straight walk at 2 m/s, and one fix 400 m off."""
    random = np.random.default_rng(7)
    time = np.arange(STEPS + 0.0)
    truth = np.stack([2 * time, time, 0 * time], 1)
    measured = truth + random.normal(scale=3.0, size=truth.shape)
    measured[BAD] += [300.0, 250.0, 0.0]
    return time, truth, measured


def settings(**more):
    return {"sigma": 3.0, "q": 0.1} | more


def errors(position, truth):
    return np.linalg.norm(position - truth, axis=1)


def test_arrays_are_cleaned_to_one_track(walk):
    time, truth, measured = walk
    cleaned = torchfra.clean((time, measured[:, :2]), **settings())
    assert isinstance(cleaned, Cleaned)
    np.testing.assert_array_equal(cleaned.time, time)
    assert errors(cleaned.position, truth[:, :2]).mean() < errors(measured[:, :2], truth[:, :2]).mean() / 2
    assert cleaned.flag[BAD] == "outlier"
    assert cleaned.found.smooth


def test_moments_and_missing_positions_are_taken(walk):
    time, truth, measured = walk
    moments = np.datetime64("2020-09-13T12:26:40") + (1000 * time).astype("timedelta64[ms]")
    measured = np.where(time[:, None] == 10, np.nan, measured)
    cleaned = torchfra.clean((moments, measured), **settings())
    np.testing.assert_array_equal(cleaned.recording.row, np.arange(STEPS))
    assert cleaned.recording.time[0] == 1_600_000_000
    assert errors(cleaned.position, truth).mean() < 5


def test_on_line_each_estimate_knows_only_the_past(walk):
    time, _, measured = walk
    whole, part = (torchfra.track((time[:k], measured[:k]), **settings(bank="aircraft")) for k in (STEPS, 20))
    np.testing.assert_allclose(whole.position[:20], part.position, rtol=1e-9, atol=1e-9)
    assert not whole.found.smooth


@pytest.fixture
def frame(walk):
    """Two targets in latitudes, one of them with a gap, in no order, under an index of its own."""
    time, _, measured = walk
    latitude, longitude, altitude = to_geodetic(measured, ORIGIN)
    data = pandas.DataFrame({
        "Time": pandas.Timestamp("2020-09-13 12:26:40", tz="UTC") + pandas.to_timedelta(time, "s"),
        "LAT": latitude, "Lon": longitude, "Altitude": altitude / 0.3048, "note": "a", "id": 5.0,
    })  # fmt: skip
    data["note"] = data["note"].astype("string").where(time != 3)
    data.loc[10, "LAT"] = np.nan
    other = data.assign(id=7.0, LAT=data["LAT"] + 0.01).iloc[:20]
    both = pandas.concat([data, other], ignore_index=True).sample(frac=1, random_state=1)
    return both.set_index(pandas.Index([f"row {i}" for i in range(len(both))], name="mine"))


def test_a_table_keeps_its_index_and_columns_and_gets_new_ones(frame, walk):
    before = frame.copy()
    cleaned = torchfra.clean(frame, units="ft", **settings())
    pandas.testing.assert_frame_equal(frame, before)
    pandas.testing.assert_frame_equal(cleaned[frame.columns], frame)
    new = set(cleaned.columns) - set(frame.columns)
    assert {"clean_latitude", "clean_longitude", "clean_altitude", "clean_speed", "clean_outlier", "clean_flag"} <= new
    assert all(name.startswith("clean_") for name in new)
    missing = frame["LAT"].isna()
    assert cleaned.loc[missing, "clean_latitude"].isna().all()
    assert (cleaned.loc[missing, "clean_flag"] == "").all()
    assert cleaned.loc[~missing, "clean_latitude"].notna().all()


def test_a_table_says_what_was_read_as_what_and_what_became_of_it(frame):
    said = torchfra.clean(frame, **settings()).attrs["torchfra"]
    assert "position: LAT, Lon" in said
    assert "--" not in said
    assert "2 targets" in said


def test_the_rows_of_a_table_are_those_of_its_own_target_and_unit(frame, walk):
    truth = to_geodetic(walk[1], ORIGIN)
    cleaned = torchfra.clean(frame, units="ft", **settings())
    second = (cleaned["Time"] - pandas.Timestamp("2020-09-13 12:26:40", tz="UTC")).dt.total_seconds().to_numpy(int)
    shift = np.where(cleaned["id"] == 7, 0.01, 0.0)
    off = 111_000 * np.abs(cleaned["clean_latitude"] - truth[0][second] - shift)
    assert off.max() < 12
    assert (cleaned["clean_altitude"] * 0.3048 - truth[2][second]).abs().max() < 12
    assert set(second[cleaned["clean_flag"] == "outlier"]) == {BAD}


def test_an_index_of_moments_tells_the_time_where_no_column_does(walk):
    time, _, measured = walk
    index = pandas.to_datetime(1_600_000_000 + time, unit="s")
    data = pandas.DataFrame(measured[:, :2], columns=["x", "y"], index=index)
    cleaned = torchfra.clean(data, **settings())
    assert cleaned.index.equals(index)
    assert [*cleaned.columns[:4]] == ["x", "y", "clean_x", "clean_y"]


def test_levels_of_an_index_are_columns(walk):
    time, _, measured = walk
    index = pandas.to_datetime(1_600_000_000 + time, unit="s").rename("time")
    data = pandas.DataFrame(measured[:, :2], columns=["x", "y"], index=index)
    cleaned = torchfra.clean(pandas.concat({"a": data, "b": data}, names=["id"]), **settings())
    flag = cleaned["clean_flag"] == "outlier"
    assert flag.loc["a"].to_numpy()[BAD]
    assert flag.loc["b"].to_numpy()[BAD]


def test_rows_of_several_targets_whose_level_has_no_name_are_not_taken_for_one(walk):
    time, _, measured = walk
    index = pandas.to_datetime(1_600_000_000 + time, unit="s")
    data = pandas.DataFrame(measured[:, :2], columns=["x", "y"], index=index)
    both = pandas.concat({"a": data, "b": data + 500.0})
    with pytest.raises(ValueError, match=r"targets do, .*such as id='level_0'"):
        torchfra.clean(both, **settings())
    assert torchfra.clean(both, id="level_0", **settings())["clean_x"].notna().all()


@pytest.mark.parametrize("kind", ["timedelta", "datetime", "Timestamp", "period"])
def test_times_may_be_of_any_type_of_pandas(walk, kind):
    _, _, measured = walk
    seconds = range(STEPS)
    start = datetime(2024, 6, 3, 8, 15, tzinfo=timezone(timedelta(hours=2)))
    moments = [start + timedelta(seconds=passed) for passed in seconds]
    times = {
        "timedelta": pandas.to_timedelta(seconds, unit="s"), "datetime": pandas.Series(moments, dtype=object),
        "Timestamp": pandas.Series([*map(pandas.Timestamp, moments)], dtype=object),
        "period": pandas.period_range("2024-06-03", periods=STEPS, freq="s"),
    }[kind]  # fmt: skip
    frame = pandas.DataFrame({"time": times, "x": measured[:, 0], "y": measured[:, 1]})
    same = frame.assign(time=[*seconds])
    speed = torchfra.clean(frame, **settings())["clean_speed"]
    np.testing.assert_allclose(speed, torchfra.clean(same, **settings())["clean_speed"], rtol=1e-6)


def test_a_list_of_datetimes_tells_the_time(walk):
    _, _, measured = walk
    moments = [datetime(2024, 6, 3, 8, 15) + timedelta(seconds=passed) for passed in range(STEPS)]
    assert torchfra.clean((moments, measured), **settings()).recording.time[0] == 1_717_402_500


def test_what_is_masked_is_missing(walk):
    time, _, measured = walk
    masked = np.ma.MaskedArray(measured, mask=measured == measured[7])
    assert np.isnan(torchfra.clean((time, masked), **settings()).raw[7]).all()


@pytest.mark.parametrize("dtype", ["int64", "float64", "Int64"])
def test_a_form_of_digits_is_read_of_numbers_too(walk, dtype):
    _, _, measured = walk
    start = datetime(2024, 6, 3, 8, 15)
    digits = [int(f"{start + timedelta(seconds=i):%Y%m%d%H%M%S}") for i in range(STEPS)]
    frame = pandas.DataFrame({"time": pandas.array(digits, dtype=dtype), "x": measured[:, 0], "y": measured[:, 1]})
    cleaned = torchfra.clean(frame, time_format="%Y%m%d%H%M%S", **settings())
    same = torchfra.clean(frame.assign(time=range(STEPS)), **settings())
    np.testing.assert_allclose(cleaned["clean_speed"], same["clean_speed"], rtol=1e-6)


def points_of(walk, crs):
    geopandas = pytest.importorskip("geopandas")
    time, _, measured = walk
    latitude, longitude, _ = to_geodetic(measured, ORIGIN)
    points = geopandas.GeoSeries.from_xy(longitude, latitude, crs=4326).to_crs(crs)
    when = pandas.to_datetime(1_600_000_000 + time, unit="s")
    return geopandas.GeoDataFrame({"traj_id": "a", "time": when}, geometry=points)


def test_points_are_cleaned_in_their_own_coordinate_reference_system(walk):
    points = points_of(walk, 32632)
    plain = points.to_crs(4326)
    degrees = pandas.DataFrame({"time": points["time"], "lat": plain.geometry.y, "lon": plain.geometry.x})
    points.loc[5, "geometry"] = None
    degrees.loc[5, ["lat", "lon"]] = np.nan
    cleaned, expected = torchfra.clean(points, **settings()), torchfra.clean(degrees, **settings())
    assert type(cleaned) is type(points)
    assert cleaned.geometry.equals(points.geometry)
    assert cleaned["clean_geometry"].crs == points.crs
    assert cleaned.loc[5, "clean_geometry"] is None
    back = cleaned["clean_geometry"].to_crs(4326)
    np.testing.assert_allclose(back.y, expected["clean_latitude"], atol=1e-9)
    np.testing.assert_allclose(back.x, expected["clean_longitude"], atol=1e-9)


def test_what_geometry_cannot_be_cleaned_is_said(walk):
    points = points_of(walk, 4326)
    with pytest.raises(ValueError, match=r"data: expected points with a coordinate reference system \(set_crs\)"):
        torchfra.clean(points.set_crs(None, allow_override=True))
    with pytest.raises(ValueError, match="data: expected points as geometry, received Polygon"):
        torchfra.clean(points.set_geometry(points.geometry.to_crs(3857).buffer(1.0)))


def test_a_file_and_its_recordings_are_cleaned_to_a_list(walk, tmp_path):
    time, _, measured = walk
    path = tmp_path / "walk.csv"
    np.savetxt(path, np.column_stack([time, measured]), delimiter=",", header="when,east,north,up", comments="")
    (one,) = torchfra.clean(path, time="when", **settings(filter="srckf"))
    (other,) = torchfra.clean(read(path, time="when"), **settings(filter="srckf"))
    np.testing.assert_array_equal(one.mean, other.mean)
    (fine,) = torchfra.clean(str(path), time="when", dt=0.5, **settings(filter="srckf"))
    assert len(fine.time) == 2 * STEPS - 1


@pytest.mark.parametrize(("data", "said"), [
    (3, r"expected a path, a DataFrame, recordings or \(time, position\), received int"),
    (np.zeros((5, 3)), r"expected a path, a DataFrame, recordings or \(time, position\), received ndarray"),
    ((np.zeros(3), np.zeros((4, 2))), r"expected time \(k,\) and position \(k, 2\) or \(k, 3\), received"),
    ((np.zeros(3), np.zeros((3, 4))), r"expected time \(k,\) and position"),
    ((np.zeros(3), np.zeros((3, 2))), "expected 2 or more rows with time and position, received 1"),
    ((np.zeros(0), np.zeros((0, 2))), "expected rows, received none"),
    ((np.array([0.0, 1.0, 1.0, 2.0]), np.eye(4)[:, :2]), "times that increase, .* received 1 duplicate times dropped"),
    ((np.array([0.0, 2.0, 1.0, 3.0]), np.eye(4)[:, :2]), "times that increase, .* received 1 rows put in time order"),
    (pandas.DataFrame({"t": [0, 1], "x": [1, 2]}), "such as time='t', x='x', y='Y'; columns: t .0"),
    (pandas.DataFrame({"t": [0, 1], "x": [1, "a"], "y": [1, 2]}), "a number in data row 2, column x, received 'a'"),
    (pandas.DataFrame({"t": [0, 1], "x": [1, 2], "y": [1, 2], "clean_x": 0}), "not cleaned yet, received clean_x"),
])  # fmt: skip
def test_what_is_no_track_is_refused(data, said):
    with pytest.raises(ValueError, match=said):
        torchfra.clean(data)


@pytest.mark.parametrize(("data", "said"), [
    ({"when": [0.0, 1.0], "x": [1, 2], "y": [1, 2]}, "such as time='TIME', x='x', y='y'; columns: when"),
    ({"t": ["03/04/2024 10:00"] * 2, "x": [1, 2], "y": [1, 2]}, "say time_format='%d/%m/%Y %H:%M' or time_format='%m/"),
    ({"t": [0, 1], "lat": [100.1234, 100.1235], "lon": [10, 11]}, "swapped, .*the options lat and lon name"),
])  # fmt: skip
def test_a_remedy_names_arguments_and_no_options_of_the_command(data, said):
    with pytest.raises(ValueError, match=said) as refused:
        torchfra.clean(pandas.DataFrame(data))
    assert "--" not in str(refused.value)


def test_a_bank_that_is_none_is_refused():
    data = np.arange(20.0), np.random.default_rng(0).normal(size=(20, 2))
    with pytest.raises(ValueError, match="bank: expected a kind of target, a Bank or None, received 3"):
        torchfra.clean(data, bank=3)


def test_a_table_cannot_get_more_rows(frame):
    with pytest.raises(ValueError, match="dt: expected None for a DataFrame, whose rows are kept, received 1"):
        torchfra.clean(frame, dt=1.0)


def test_without_a_table_pandas_is_not_imported(walk, monkeypatch):
    monkeypatch.delitem(sys.modules, "pandas")
    time, _, measured = walk
    assert len(torchfra.clean((time, measured), **settings(filter="srckf")).time) == STEPS
    assert "pandas" not in sys.modules


def test_a_wrong_number_of_a_frame_is_shown_as_it_is_written():
    """A column of numpy's numbers would otherwise show its type."""
    data = pandas.DataFrame({"time": [0.0, 1.0, 2.0], "lat": [47.0, 97.5, 47.0], "lon": [8.0, 8.0, 8.0]})
    with pytest.raises(ValueError, match=r"column lat, received 97\.5"):
        torchfra.clean(data)
