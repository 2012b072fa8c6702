"""A fix without an altitude is written with all else that was recorded of it."""

import csv

import numpy as np
import pytest

from torchfra.cli import main as cli

WITHOUT = (5, 20)
"""Rows without an altitude; the first of them is an outlier."""


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A file of 40 fixes that climb north over 100 km, so that degrees depend on the altitude that is assumed."""
    degrees = 47 + 0.025 * np.arange(40) + np.random.default_rng(0).normal(0, 1e-4, 40)
    degrees[WITHOUT[0]] += 0.1
    heights = ["" if i in WITHOUT else str(1000 + 200 * i) for i in range(40)]
    rows = [f"{1714800000 + 15 * i},{degrees[i]:.6f},8,{heights[i]}" for i in range(40)]
    path = tmp_path_factory.mktemp("flight") / "flight.csv"
    path.write_text("\n".join(["time,lat,lon,alt", *rows]))
    return path


def track(flight, ending):
    out = flight.parent / f"cleaned{ending}"
    assert cli.main(["track", str(flight), "--out", str(out), "--no-plots", "--quiet"]) == 0
    return out


def test_a_table_has_its_degrees_as_recorded_and_no_altitude(flight):
    with track(flight, ".csv").open() as cleaned, flight.open() as recorded:
        rows, given = list(csv.DictReader(cleaned)), list(csv.DictReader(recorded))
    raw, expected = (np.array([float(row[key]) for row in of]) for of, key in ((rows, "raw_latitude"), (given, "lat")))
    np.testing.assert_allclose(raw, expected, atol=1e-8)
    assert [row["raw_altitude"] == "" for row in rows] == [i in WITHOUT for i in range(40)]
    assert rows[WITHOUT[0]]["flag"] == "outlier"
