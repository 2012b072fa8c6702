"""Outliers come in bursts: four steps in a row with ten times the standard deviation, 5 % of all steps."""

import numpy as np
import pytest
import torch

from torchfra import readers, scenarios
from torchfra.scenarios.outliers import LENGTH, burst_factors


def circle():
    time = 5.0 * np.arange(200)
    return readers.Recording("a", time, 8000 * np.stack([np.cos(0.01 * time), np.sin(0.01 * time)], 1), None, {})


def recorded(outliers, **options):
    return scenarios.recorded([circle()], "radar", steps=60, outliers=outliers, **options)


SCENARIOS = [scenarios.bearings_outliers, scenarios.bearings_manoeuvre, recorded]


def test_a_burst_lasts_four_steps_unless_the_track_ends_or_another_follows():
    inside = burst_factors(np.random.default_rng(0), 2000, 100).squeeze(-1) > 1
    for run in inside.tolist():
        lengths = [len(part) for part in "".join("x" if now else " " for now in run[:-LENGTH]).split()]
        assert all(length >= LENGTH for length in lengths[:-1])
    # In the long run a step is in no burst if none of the last four starts one.
    assert inside[:, LENGTH:].double().mean() == pytest.approx(1 - (1 - 0.05 / LENGTH) ** LENGTH, abs=0.004)


@pytest.mark.parametrize("make", SCENARIOS)
def test_bursts_enlarge_the_noise_of_all_elements_tenfold_and_change_nothing_else(make):
    quiet, bursts = make("none").simulate(300, 3), make("bursts").simulate(300, 3)
    torch.testing.assert_close(bursts.truth, quiet.truth, rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(bursts.prior.mean, quiet.prior.mean, rtol=0, atol=0)
    exact = make("none").sensor(quiet.truth, quiet.u)
    known = ~quiet.z.isnan().any(-1)
    ratio = ((bursts.z - exact) / (quiet.z - exact))[known]
    inside = (bursts.z != quiet.z)[known]
    assert torch.equal(inside.any(-1), inside.all(-1))
    assert 0.03 < inside.double().mean() < 0.06
    torch.testing.assert_close(ratio[inside].median(), torch.tensor(10.0, dtype=torch.float64), rtol=1e-6, atol=0)


@pytest.mark.parametrize("make", SCENARIOS)
def test_run_i_of_a_seed_has_the_same_bursts_in_every_call(make):
    many, few = make("bursts").simulate(260, 4), make("bursts").simulate(2, 4, first=255)
    torch.testing.assert_close(many.z[255:257], few.z, rtol=0, atol=0, equal_nan=True)


def test_share_and_size_are_those_of_the_recorded_tracks():
    calm, wild = (recorded("bursts", share=s, size=3.0).simulate(300, 0) for s in (0.0, 0.4))
    torch.testing.assert_close(calm.z, recorded("none").simulate(300, 0).z, rtol=0, atol=0, equal_nan=True)
    known = ~wild.z.isnan().any(-1)
    assert 0.25 < (wild.z != calm.z).any(-1)[known].double().mean() < 0.4


@pytest.mark.parametrize("make", [scenarios.growth, scenarios.reentry, scenarios.level_then_weave])
def test_other_scenarios_have_no_bursts(make):
    with pytest.raises(ValueError, match=r"outliers: expected one of .*, received 'bursts'"):
        make("bursts")
