"""``torchfra.fit`` of a single time series, and of targets whose state is a position alone."""

import math

import numpy as np
import pytest
import torch

import torchfra
from torchfra import Gaussian, presets
from torchfra.fitting.data import batch_of
from torchfra.motion import RandomWalk
from torchfra.sensors import Position
from torchfra.targets import OnePoint

NILE = """
1120 1160 963 1210 1160 1160 813 1230 1370 1140 995 935 1110 994 1020 960 1180 799 958 1140 1100 1210 1150 1250 1260
1220 1030 1100 774 840 874 694 940 833 701 916 692 1020 1050 969 831 726 456 824 702 1120 1100 832 764 821 768 845 864
862 698 845 744 796 1040 759 781 865 845 944 984 897 822 1010 771 676 649 846 812 742 801 1040 860 874 848 890 744 749
838 1050 918 986 797 923 975 815 1020 906 901 1170 912 746 919 718 714 740
"""
"""Annual flow at Aswan from 1871 to 1970, 1e8 m^3.  Source: Durbin & Koopman (2012), section 2.2.5 and their data."""


def series():
    return torch.tensor([float(flow) for flow in NILE.split()], dtype=torch.float64).unsqueeze(-1)


def local_level(q=1.0, std=1.0):
    return presets.srckf(RandomWalk(q, dims=1), Position(std, dims=1))


def walks(count, steps=30):
    normal = torch.randn(count, 2, steps, 1, dtype=torch.float64)
    return normal[:, 0].cumsum(1) + 2.0 * normal[:, 1]


@pytest.fixture(scope="module")
def nile():
    return torchfra.fit(local_level(), series(), learn=("q", "std"), quiet=True)


def test_a_single_series_has_the_variances_of_the_largest_likelihood(nile):
    """Those of Durbin & Koopman (2012), section 2.10.3, and of statsmodels 0.14, with an exact diffuse start."""
    assert nile.learned["motion.q"] == pytest.approx(1469.2, rel=1e-3)
    assert nile.learned["sensor.std"] ** 2 == pytest.approx(15098.5, rel=1e-3)
    first, rest = series()[:1], series()[1:]
    start = Gaussian(first[0], torch.full((1, 1), nile.learned["sensor.std"], dtype=torch.float64))
    assert nile.filter(rest, start).log_likelihood.sum().item() == pytest.approx(-632.5456, abs=1e-4)


def log_likelihood(values):
    """Of the Nile by a Kalman filter of two numbers, with an exact diffuse start."""
    q, std = values
    y = series().flatten().tolist()
    level, variance, total = y[0], std**2, 0.0
    for flow in y[1:]:
        predicted = variance + q
        spread = predicted + std**2
        total -= (math.log(2 * math.pi * spread) + (flow - level) ** 2 / spread) / 2
        level, variance = level + predicted / spread * (flow - level), predicted * std**2 / spread
    return total


def test_standard_errors_of_a_single_series_are_those_of_the_curvature_of_its_likelihood(nile):
    best = np.array(list(nile.learned.values()))
    steps = np.diag(1e-3 * best)
    assert log_likelihood(best) == pytest.approx(-632.5456, abs=1e-4)
    assert all(log_likelihood(best) > log_likelihood(best + side) for side in (*steps, *-steps))
    bend = [
        [sum(i * j * log_likelihood(best + i * a + j * b) for i in (1, -1) for j in (1, -1)) for a in steps]
        for b in steps
    ]
    covariance = np.linalg.inv(-np.array(bend) / (4 * np.outer(1e-3 * best, 1e-3 * best)))
    assert list(nile.errors.values()) == pytest.approx(np.sqrt(covariance.diagonal()), rel=1e-2)


def test_a_single_series_says_that_nothing_is_held_out_and_has_no_interval_over_tracks(nile):
    assert nile.counts == {"train": 1, "validation": 0, "test": 0, "left out": 0}
    assert "no track is held out" in " ".join(nile.notes)
    assert "1 tracks, none held out" in str(nile)
    assert math.isnan(nile.held_out["likelihood"].change.low)
    assert nile.to_json()["held_out"]["likelihood"]["change"]["value"] < 0
    with pytest.raises(ValueError, match="bootstrap: expected more tracks than values"):
        nile.bootstrap()


def test_a_loss_whose_standard_errors_need_many_tracks_has_none_of_a_single_one():
    z = walks(1, 5)
    options = {"loss": "mse", "compile": False, "polish": False, "quiet": True}
    found = torchfra.fit(local_level(), {"z": z, "truth": z}, learn=("q",), **options)
    assert math.isnan(found.errors["motion.q"])
    assert "no more tracks than values" in " ".join(found.notes)


@pytest.mark.parametrize("options", [{}, {"held_out": 0}])
def test_tracks_of_which_none_is_held_out_come_to_the_least_loss_of_all(options):
    z = walks(3 if not options else 6)
    found = torchfra.fit(local_level(), z, learn=("q", "std"), compile=False, quiet=True, **options)
    assert found.counts["train"] == len(z)
    assert found.certainty.gradient_size < 1e-3
    for name, true in (("motion.q", 1.0), ("sensor.std", 2.0)):
        low, high = found.intervals[name]
        assert low < true < high


def test_targets_without_a_velocity_begin_at_their_first_measurement_with_its_noise():
    f = presets.srckf(RandomWalk(1.0), Position(2.0))
    z = torch.randn(5, 4, 2, dtype=torch.float64)
    belief = batch_of(f, z, runs=0, seed=0).belief(f)
    assert torch.equal(belief.mean, z[:, 0])
    torch.testing.assert_close(belief.covariance, 4 * torch.eye(2, dtype=torch.float64).expand(5, 2, 2))


def test_a_birth_of_a_motion_without_a_velocity_takes_the_position_alone():
    mean, root = torch.arange(4.0).unsqueeze(0), torch.diag(torch.tensor([2.0, 3.0, 30.0, 30.0])).unsqueeze(0)
    belief = OnePoint().belief(RandomWalk(1.0), mean, root)
    assert torch.equal(belief.mean, torch.tensor([[0.0, 1.0]]))
    torch.testing.assert_close(belief.covariance, torch.tensor([[[4.0, 0.0], [0.0, 9.0]]]))
