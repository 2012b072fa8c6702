"""Covariances that robots write beside positions, entry by entry, are the noise of each fix."""

from __future__ import annotations

import numpy as np
import pytest

from torchfra.readers import read

ROWS = 30
VARIANCES = np.array([4.0, 9.0, 25.0]) * np.linspace(1, 4, ROWS)[:, None]


def table(places, names, size, types=None, variances=VARIANCES):
    """Rows with the entries of a covariance of so many rows in columns of these names."""
    header = ["%time", *places, *map(names.format, range(size**2))] + (["position_covariance_type"] if types else [])
    lines = [",".join(header)]
    for i in range(ROWS):
        entries = np.eye(size) * 0.01
        entries[:3, :3] = np.diag(variances[i]) + 0.5
        place = [47 + i / 1e4, 8 + i / 1e4, 400.0] if "latitude" in places[0] else [2.0 * i, i % 3, 1.5 + i % 2]
        cells = [1_714_000_000_000_000_000 + 10**9 * i, *place, *entries.ravel(), *([types[i]] if types else [])]
        lines.append(",".join(map(str, cells)))
    return lines


FIX = ["field.latitude", "field.longitude", "field.altitude"]
POSE = [f"field.pose.pose.position.{axis}" for axis in "xyz"]


@pytest.mark.parametrize(("places", "names", "size"), [
    (FIX, "field.position_covariance{}", 3), (["latitude", "longitude", "altitude"], "position_covariance_{}", 3),
    (POSE, "field.pose.covariance{}", 6),
])  # fmt: skip
def test_variances_are_standard_deviations_of_each_axis(write, places, names, size):
    (track,) = read(write(table(places, names, size)))
    np.testing.assert_allclose(track.sigma, np.sqrt(VARIANCES + 0.5))


def test_the_covariance_of_a_speed_is_none_of_positions(write):
    (track,) = read(write(table(POSE, "field.twist.covariance{}", 6)))
    assert track.sigma is None
