"""A table of a cleaned track joins the input by its rows, and says all in the input's own coordinates."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from cleaned_tracks import FOUND, geodetic, straight

from torchfra.cleaning import outputs
from torchfra.cleaning.outputs import csv_table, parquet
from torchfra.cleaning.outputs.course import course
from torchfra.cleaning.outputs.summary import MANY, UNLIKELY, notes, overview, sentences, settings_lines, summary
from torchfra.cleaning.outputs.table import UNITS, columns
from torchfra.geodesy import to_geodetic
from torchfra.readers.recording import Source
from torchfra.tables import duration, metres


def rows(results):
    return list(csv.DictReader(io.StringIO(csv_table.encode(results).decode(), newline="")))


def test_rows_and_names_are_those_of_the_input_and_times_utc_or_seconds():
    table = rows([straight(5)])
    assert [row["row"] for row in table] == ["1", "4", "7", "10", "13"]
    assert table[2]["time"] == "2024-05-03T10:00:04Z"
    assert {row["id"] for row in table} == {"3c6444 DLH1AB"}
    finer = rows([straight(3, period=0.25)])
    assert [row["time"][-7:] for row in finer] == ["00.000Z", "00.250Z", "00.500Z"]
    counted = rows([straight(3, start=5.0, period=0.04)])
    assert [row["time"] for row in counted] == ["5", "5.04", "5.08"]


@pytest.mark.parametrize("name", ["a,b", 'a "b"', "a\nb", "a\rb", " a;b ", ""])
def test_any_name_reads_back_as_it_was(name):
    of = straight(3)
    table = rows([replace(of, recording=replace(of.recording, name=name))])
    assert [row["id"] for row in table] == 3 * [name]


def test_positions_are_in_the_coordinates_and_units_of_the_input():
    of = straight(6)
    latitude, longitude, altitude = to_geodetic(of.position, of.recording.origin)
    table = columns(of)
    np.testing.assert_allclose(table["latitude"], latitude)
    np.testing.assert_allclose(table["longitude"], longitude)
    np.testing.assert_allclose(table["altitude"], altitude / 0.3048)
    np.testing.assert_allclose(table["raw_latitude"], to_geodetic(of.raw, of.recording.origin)[0])
    np.testing.assert_allclose(table["x"], of.position[:, 0])
    plain = columns(straight(6, d=2, origin=None, source=Source(unit=0.3048)))
    assert "latitude" not in plain
    assert "raw_z" not in plain
    np.testing.assert_allclose(plain["x"] * 0.3048, of.position[:, 0])
    np.testing.assert_allclose(plain["speed"], 100)


def test_a_table_can_be_read_back_to_what_it_was_written_from():
    of = straight(30)
    table, text = columns(of), rows([of])
    assert list(text[0]) == list(table)
    for name, values in table.items():
        if values.dtype.kind == "f":
            got = np.array([float(row[name] or "nan") for row in text])
            np.testing.assert_allclose(got, values, rtol=1e-5, atol=1e-7 if "itude" in name else 6e-4, equal_nan=True)


def test_no_number_is_written_as_a_negative_zero():
    of = straight(3)
    of.mean[:, 5], of.mean[0, 0] = (-1e-4, -0.0, -6e-4), -0.0
    table = rows([of])
    assert [row["vz"] for row in table] == ["0.000", "0.000", "-0.001"]
    assert not any(cell.startswith("-") and not cell.strip("-0.") for row in table for cell in row.values())


def test_course_speed_and_climb_are_those_where_the_target_is_and_not_at_a_far_origin():
    # Level flight along the meridian of 11 east at 100 m/s, 1500 km north of the origin.
    latitude = 48.0 + 13.5 + np.array([0.0, 1e-5])
    of = geodetic(latitude, np.full(2, 11.0), np.full(2, 9000.0), (48.0, 11.0, 0.0))
    step = of.position[1] - of.position[0]
    way = np.concatenate([of.position, np.tile(100 * step / np.linalg.norm(step), (2, 1))], 1)
    moved = course(replace(of, mean=way))
    np.testing.assert_allclose(moved.speed, 100, rtol=1e-6)
    np.testing.assert_allclose((moved.course + 180) % 360, 180, atol=1e-4)
    np.testing.assert_allclose(moved.climb, 0, atol=1e-3)
    assert abs(way[0, 5]) > 20  # in the axes of the origin it goes down
    flat = replace(of, raw=of.raw[:, :2], mean=way[:, [0, 1, 3, 4]], covariance=of.covariance[:, :4, :4])
    np.testing.assert_allclose(course(flat).speed, 100, rtol=2e-3)
    assert course(flat).climb is None


@pytest.mark.parametrize(("velocity", "expected"), [((0, 5), 0), ((5, 0), 90), ((0, -5), 180), ((-5, 0), 270)])
def test_course_is_clockwise_from_north_and_std_is_along_it(velocity, expected):
    of = straight(2, d=2, origin=None)
    mean = np.concatenate([of.position, np.tile(velocity, (2, 1))], 1)
    covariance = np.tile(np.diag([9.0, 16.0, 1.0, 4.0]), (2, 1, 1))
    moved = course(replace(of, mean=mean, covariance=covariance))
    np.testing.assert_allclose(moved.course, expected)
    east = velocity[0] != 0
    np.testing.assert_allclose(moved.along, 3 if east else 4)
    np.testing.assert_allclose(moved.across, 4 if east else 3)
    np.testing.assert_allclose(moved.speed_std, 1 if east else 2)


def test_steps_between_fixes_have_no_row_and_no_recorded_position():
    of = straight(6)
    between = np.arange(6) % 2 == 1
    of = replace(of, row=np.where(between, -1, of.row), raw=np.where(between[:, None], np.nan, of.raw))
    table = rows([of])
    assert [row["row"] for row in table] == ["1", "", "7", "", "13", ""]
    assert [row["raw_latitude"] == "" for row in table] == between.tolist()
    assert all(row["latitude"] for row in table)


def test_targets_with_other_columns_share_a_table_and_names_may_be_anything():
    strange = 'a, "b"\n$'
    table = rows([straight(3), straight(2, d=2, name=strange)])
    assert [row["id"] for row in table] == ["3c6444 DLH1AB"] * 3 + [strange] * 2
    assert [row["altitude"] != "" for row in table] == [True] * 3 + [False] * 2


def test_all_columns_are_explained():
    names = list(columns(straight(2)))
    assert all(outputs.metadata([straight(2)], {})["columns"][name] for name in names)
    assert all(any(name.removeprefix("raw_").startswith(known) for known in UNITS) for name in names)


def test_covariances_are_the_upper_triangle():
    of, table = straight(2), columns(straight(2))
    assert sum(name.startswith("cov_") for name in table) == 21
    np.testing.assert_allclose(table["cov_y_vz"], of.covariance[:, 1, 5])
    np.testing.assert_allclose(table["cov_vz_vz"], of.covariance[:, 5, 5])


def test_parquet_holds_numbers_and_null_where_nothing_is_known():
    pyarrow = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")
    of = straight(4, start=0.0)
    of = replace(of, row=np.array([0, -1, 1, 2]), raw=np.where(np.arange(4)[:, None] == 1, np.nan, of.raw))
    table = pyarrow.read_table(io.BytesIO(parquet.encode([of])))
    assert table["row"].to_pylist() == [1, None, 4, 7]
    assert table["raw_x"].null_count == 1
    assert table["time"].to_pylist() == [0.0, 2.0, 4.0, 6.0]
    np.testing.assert_array_equal(table["latitude"].to_numpy(), columns(of)["latitude"])
    assert "course" in json.loads(table.schema.metadata[b"torchfra"])
    iso = pyarrow.read_table(io.BytesIO(parquet.encode([straight(2)])))
    assert iso["time"].to_pylist()[0] == "2024-05-03T10:00:00Z"


def test_metadata_says_how_the_table_was_made(tmp_path):
    outputs.write([straight(4)], tmp_path / "a.csv", {"sigma": None})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.meta.json"]
    said = json.loads((tmp_path / "a.meta.json").read_text())
    assert (said["input"], said["metres_per_unit"]) == ("flights.csv", 0.3048)
    assert {"torchfra", "torch", "numpy"} <= said["versions"].keys()
    (track,) = said["tracks"]
    assert track["origin"] == {"latitude": 48.0, "longitude": 11.0, "altitude": 400.0}
    assert (track["sigma"], track["q"], track["bank"], track["filter"]) == (20.0, 0.5, "aircraft", "gpb")
    assert track["segments"] == [{"begin": 10.0, "end": 30.0, "kind": "left turn", "rate": 2.5}]


def test_a_summary_counts_and_measures():
    of = straight(40, rejected=(7, 9))
    off = np.linalg.norm(of.raw - of.position, axis=1)
    said = summary(of)
    assert said["flags"] == {"usual": 38, "outlier": 2, "manoeuvre": 0, "unclear": 0}
    kept = np.delete(off, [7, 9])
    assert said["median_correction"] == pytest.approx(np.median(kept))
    assert said["largest_correction"] == pytest.approx(kept.max())
    assert said["largest_rejected"] == pytest.approx(off[[7, 9]].max())


def test_what_a_path_is_good_to_is_said_of_its_fixes_whatever_is_estimated_between_them():
    of, between = straight(40), np.arange(40) % 4 > 0
    covariance = np.where(between[:, None, None], 1e4, 1.0) * of.covariance[0]
    some = replace(of, row=np.where(between, -1, of.row), covariance=covariance)
    assert summary(some)["median_std"] == pytest.approx(np.sqrt(np.trace(of.covariance[0, :2, :2]) / 2), rel=1e-3)


def test_sentences_say_what_a_person_asks_for_in_a_line_each():
    said = sentences(straight(40))
    assert said[0] == "3c6444 DLH1AB: 40 fixes in 78 s, 1 rejected (up to 2.8 km off)"
    assert said[1] == "Noise found: 20 m per axis"
    assert said[2].startswith("Path good to ")
    assert "; fixes moved 15.4 m, at most " in said[2]
    assert said[3] == "Manoeuvres: 1 left turn; 20 s in all"
    assert max(map(len, said)) <= 100
    (line,) = settings_lines([straight(40)])
    assert line == "gpb, smoothed, for aircraft; sigma 20 m (found), q 0.5 m^2/s^3 (found)"


def test_of_many_targets_there_is_a_row_for_each_and_what_they_share_is_said_once():
    some = [straight(40, name=f"target {i}", rejected=tuple(range(i))) for i in range(30)]
    some = [replace(of, found=replace(FOUND, sigma=float(i + 1))) for i, of in enumerate(some)]
    table, *said = overview(some)
    assert len(table.splitlines()) == 31
    assert table.splitlines()[3].split()[:5] == ["target", "2", "40", "78", "s"]
    assert max(map(len, [*table.splitlines(), *said])) <= 100
    assert "30 targets: 1,200 fixes, 435 rejected" in said
    assert settings_lines(some) == ["gpb, smoothed, for aircraft"]
    assert notes(some) == ["fixes 20 m off, say the innovations"]


def test_what_is_said_of_some_targets_is_counted():
    off = replace(straight(10), found=replace(FOUND, notes=("Sigma of the height: 2 m", "Late: 3 s")))
    later = replace(off, found=replace(FOUND, notes=("Sigma of the height: 3 m", "Late: 4 s")))
    assert notes([off, later, straight(10)]) == ["Late: 2 of 3", "fixes 20 m off, say the innovations: 1 of 3"]


def test_sigma_of_fixes_that_state_how_good_they_are_is_a_factor_in_the_table_too():
    of = straight(20)
    stated = replace(of, found=replace(of.found, sigma=0.64, stated=True))
    table, *_ = overview([stated, of])
    assert "0.64 times as stated" in table
    assert metres(of.found.sigma) in table


def test_a_track_without_any_number_has_sentences_too():
    of = straight(5)
    broken = replace(of, mean=of.mean * np.nan)
    assert "FAILED: NaN or infinity" in sentences(broken)[0]
    assert overview([broken, of])[-1] == "FAILED: NaN or infinity in 3c6444 DLH1AB"
    assert rows([broken])[0]["latitude"] == ""


@pytest.mark.parametrize(("value", "text"), [
    (4.6e-13, "below 0.01 mm"), (0.00045, "0.45 mm"),
    (0.0045, "4.5 mm"), (0.45, "0.45 m"), (6.0, "6.0 m"), (156.2, "156 m"), (4676.0, "4.7 km"),
    (5e5, "500 km"), (np.nan, "an unknown length"),
])  # fmt: skip
def test_lengths_are_in_the_unit_that_fits(value, text):
    assert metres(value) == text


@pytest.mark.parametrize(("value", "text"), [
    (0.25, "0.25 s"), (78.0, "78 s"), (1200.0, "20 min"), (4200.0, "70 min"), (2.5 * 3600, "2.5 h"),
    (719.5 * 3600, "30 days"),
])  # fmt: skip
def test_times_are_in_the_unit_that_fits(value, text):
    assert duration(value) == text


@pytest.mark.parametrize(("rejected", "said"), [(3, set()), (4, {MANY}), (13, {MANY}), (14, {UNLIKELY})])
def test_from_a_tenth_of_the_fixes_on_rejections_are_said_to_be_many(rejected, said):
    cleaned = straight(40, rejected=range(rejected))
    assert {MANY, UNLIKELY} & set(sentences(cleaned)) == said
