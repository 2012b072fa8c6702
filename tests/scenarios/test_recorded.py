"""Recorded tracks become a scenario: what was flown is the truth, and the sensor that looks at it is simulated."""

import numpy as np
import pytest
import torch

from torchfra import metrics, readers, scenarios
from torchfra.catalogue import scenario_filters


def circle(steps=200, gap=None, name="a"):
    time = np.arange(steps) * 5.0
    if gap is not None:
        time[gap:] += 500.0
    angle = 0.01 * time
    return readers.Recording(name, time, 8000 * np.stack([np.cos(angle), np.sin(angle)], 1), None, {})


def test_a_window_holds_the_recorded_positions_and_their_differences():
    scenario = scenarios.recorded([circle()], steps=50)
    tracks = scenario.simulate(3, 0)
    angle = 0.01 * 5.0 * torch.arange(1, 51, dtype=torch.float64)
    torch.testing.assert_close(tracks.truth[0, :, 0], 8000 * angle.cos(), rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(tracks.truth[0, 5:45, 3], (80 * angle.cos())[5:45], rtol=1e-2, atol=0.5)


def test_a_gap_splits_a_track_and_a_short_end_is_missing():
    scenario = scenarios.recorded([circle(steps=100, gap=60)], steps=40)
    assert scenario.settings["windows"] == 2
    tracks = scenario.simulate(2, 0)
    assert int((~tracks.truth[..., 0].isnan()).sum(-1).min()) < 40
    torch.testing.assert_close(tracks.z.isnan(), tracks.truth[..., :2].isnan())


@pytest.mark.parametrize("sensor", ["bearings", "radar", "position"])
def test_filters_follow_the_recorded_truth(sensor):
    scenario = scenarios.recorded([circle(), circle(300, name="b")], sensor, steps=60, outliers="none")
    tracks = scenario.simulate(20, 0)
    for f in scenario_filters(["srckf", "fra", "imm_srckf", "vsimm_srckf"], scenario).values():
        estimate = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
        assert metrics.track_rmse(estimate.mean, tracks.truth, scenario.position).max() < 200


def test_run_i_takes_window_i_and_is_the_same_in_every_call():
    scenario = scenarios.recorded([circle(), circle(name="b")], steps=50)
    many, few = scenario.simulate(300, 4), scenario.simulate(2, 4, first=255)
    torch.testing.assert_close(many.z[255:257], few.z, rtol=0, atol=0, equal_nan=True)
    assert many.u is not None
    assert few.u is not None
    torch.testing.assert_close(many.u[255:257], few.u, rtol=0, atol=0)
    windows = int(str(scenario.settings["windows"]))
    torch.testing.assert_close(many.truth[0], many.truth[windows], equal_nan=True)


def test_a_share_of_the_measurements_are_outliers():
    quiet, outlying = (
        scenarios.recorded([circle()], "radar", steps=60, outliers=o).simulate(200, 0) for o in ("none", "std")
    )
    differs = ((quiet.z - outlying.z).abs() > 0).any(-1)
    assert 0.04 < differs.double().mean() < 0.06


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"sensor": "sonar"}, "sonar"),
        ({"outliers": "offset"}, "offset"),
        ({"steps": 5}, "received 5"),
        ({"share": 2.0}, "share"),
        ({"max_gap": 1.0}, "recordings"),
        ({"std": -1.0}, "std"),
    ],
)
def test_what_does_not_fit_is_named(options, said):
    with pytest.raises(ValueError, match=said):
        scenarios.recorded([circle()], **options)


def test_names_of_files_are_not_recordings():
    with pytest.raises(TypeError, match=r"recordings: expected what torchfra\.readers\.read returns, received str"):
        scenarios.recorded(["a.csv"])
