"""What is masked in an array of numpy is missing, wherever arrays are taken."""

import numpy as np
import pytest
import torch

import torchfra
from torchfra import Gaussian, presets
from torchfra.fitting.data import batch_of
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.stream import Tracker

ABSURD = 9.96921e36
"""What NetCDF writes where nothing was measured."""
MASK = np.array([[False, False], [True, True], [False, True], [False, False]])
Z = np.array([[0.0, 1], [ABSURD, ABSURD], [2, ABSURD], [3, 4]])
PRIOR = Gaussian(torch.zeros(4).double(), 9 * torch.eye(4).double())


def masked(whole=False):
    return np.ma.masked_array(np.where(MASK, 7, Z).astype(int) if whole else Z, MASK)


def srckf():
    return presets.srckf(ConstantVelocity(1.0), Position(1.0))


@pytest.mark.parametrize("whole", [False, True])
def test_a_fit_takes_what_is_masked_for_missing(whole):
    z = torch.from_numpy(np.where(MASK, np.nan, Z))
    for data in (masked(whole)[None], {"z": masked(whole)[None], "prior": PRIOR}, [masked(whole)]):
        f = srckf()
        torch.testing.assert_close(
            batch_of(f, {"z": data["z"], "prior": PRIOR} if isinstance(data, dict) else data, runs=0, seed=0).z,
            z[None] if isinstance(data, dict) else z[None, 1:],
            equal_nan=True,
        )


@pytest.mark.parametrize("whole", [False, True])
def test_a_tracker_takes_what_is_masked_for_missing(whole):
    one, other = Tracker(srckf(), PRIOR, time=0.0), Tracker(srckf(), PRIOR, time=0.0)
    for k, (row, plain) in enumerate(zip(masked(whole), np.where(MASK, np.nan, Z), strict=True)):
        one.update(k + 1.0, row)
        other.update(k + 1.0, plain)
    assert torch.equal(one.belief.mean, other.belief.mean)


def test_cleaning_takes_what_is_masked_for_missing():
    time, rng = np.arange(60.0), np.random.default_rng(0)
    path = np.stack([10 * time, 5 * time], 1) + rng.standard_normal((60, 2))
    gone = np.zeros((60, 2), dtype=bool)
    gone[20:23] = True
    plain = torchfra.clean((time, np.where(gone, np.nan, path)))
    found = torchfra.clean((time, np.ma.masked_array(np.where(gone, ABSURD, path), gone)))
    np.testing.assert_array_equal(found.position, plain.position)
