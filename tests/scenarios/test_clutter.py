"""The scenarios of several targets in clutter have their documented properties, and the commands run them."""

import math

import pytest
import torch
from short_tracks import STEPS

from torchfra import scenarios
from torchfra.catalogue import filters_for, learned_filter, scan_filters, scenario_filters
from torchfra.coordinates import from_cartesian
from torchfra.evaluation import evaluate, table

pytestmark = pytest.mark.usefixtures("rough_figures")


def test_tracks_are_straight_or_turn_and_cross():
    straight = scenarios.clutter_straight().simulate(1, 0).truth[0]
    torch.testing.assert_close(straight[:, -1, :3], torch.tensor([[4500.0, 4500.0, 6000.0]] * 2).double())
    turning = scenarios.clutter_crossing().simulate(1, 0).truth[0]
    apart = (turning[0, :, :3] - turning[1, :, :3]).norm(dim=-1)
    assert 43 <= apart.argmin() + 1 <= 44
    torch.testing.assert_close(turning[0, 43, :2], torch.tensor([2449.0, 2449.0]).double(), atol=25, rtol=0)
    torch.testing.assert_close(turning[0][:, [1, 0, 2, 4, 3, 5]], turning[1])  # mirror images
    rates = torch.atan2(turning[..., 4], turning[..., 3]).diff(dim=-1)
    torch.testing.assert_close(rates[0], torch.full((99,), math.radians(0.5)).double())


def test_the_turn_as_printed_never_crosses():
    truth = scenarios.clutter_crossing(rate=0.5, dt=0.1).simulate(1, 0).truth[0]
    assert (truth[0, :, :3] - truth[1, :, :3]).norm(dim=-1).min() > 900


@pytest.mark.parametrize("make", [scenarios.clutter_straight, scenarios.clutter_crossing])
def test_scans_have_the_documented_detections_noise_and_clutter(make):
    s = make(noise_scale=3.0, change=30, clutter=6)
    t = s.simulate(64, 1)
    assert t.truth.shape == (64, 2, 100, 6)
    assert t.z.shape == (64, 100, 8, 3)
    assert t.prior.mean.shape == (64, 2, 6)
    missing = t.z.isnan().all(-1).double().sum(-1).mean()
    assert missing.item() == pytest.approx(2 * 0.05, abs=0.01)
    there = s.sensor(from_cartesian(t.truth)).movedim(1, 2).unsqueeze(-2)
    far = s.sensor.difference(t.z.unsqueeze(2), there) / s.sensor.std()
    nearest = far.square().sum(-1).nan_to_num(torch.inf).min(-1).values
    # Beyond 5 standard deviations the nearest measurement is a false one, of a missed target.
    before, after = (part[part < 25 * k].mean().item() for part, k in ((nearest[:, :30], 1), (nearest[:, 30:], 9)))
    assert before == pytest.approx(3.0, rel=0.1)
    assert after == pytest.approx(27.0, rel=0.1)
    spots = s.sensor.locate(t.z)
    inside = (spots.unsqueeze(2) - t.truth.movedim(1, 2)[..., None, :3]).abs().amax(-1).nan_to_num(0).amin(-2)
    assert inside.max() < 200 + 200  # in the cube of false measurements, or a measurement of the target
    assert s.clutter.volume().item() == pytest.approx(2 * 400.0**3)


def test_a_run_does_not_depend_on_the_number_of_runs():
    s = scenarios.clutter_straight()
    all_runs, part = s.simulate(5, 3), s.simulate(2, 3, first=3)
    torch.testing.assert_close(all_runs.z[3:], part.z, equal_nan=True, rtol=0, atol=0)
    torch.testing.assert_close(all_runs.prior.scale_tril[3:], part.prior.scale_tril, rtol=0, atol=0)


def test_the_errors_of_the_prior_have_its_covariance():
    s = scenarios.clutter_straight()
    t = s.simulate(512, 0)
    starts = torch.tensor([[1500, 500, 1000, 30, 40, 50], [500, 1500, 1000, 40, 30, 50]]).double()
    gap = s.motion.difference(t.prior.mean, from_cartesian(starts))
    nees = torch.linalg.solve_triangular(t.prior.scale_tril, gap.unsqueeze(-1), upper=False).square().sum((-2, -1))
    assert nees.mean().item() == pytest.approx(6.0, rel=0.1)


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_evaluation_counts_every_target_as_a_track_in_metres():
    s = scenarios.clutter_straight(clutter=2)
    assert filters_for(s) == scan_filters()
    results = evaluate(s, ["iaukf_jpda"], runs=6, seed=1, chunk=4)
    of = results["iaukf_jpda"]
    assert 1 < of["median_error_position"] < 12
    assert len(of["rmse_z"]) == STEPS
    assert of["relative_time"] > 0
    assert "iaukf_jpda" in table(results)
    with pytest.raises(ValueError, match="filters: expected some of ukf_jpda, iaukf_jpda"):
        scenario_filters(["fra"], s)
    with pytest.raises(ValueError, match="filters: expected some of gpb, ukf"):
        scenario_filters(["ukf_jpda"], scenarios.noise_change())


def test_learned_values_load_into_a_filter_for_scans(tmp_path):
    s = scenarios.clutter_straight()
    f = scenario_filters(["iaukf_jpda"], s)["iaukf_jpda"]
    f.detection.set(0.8)
    torch.save(f.state_dict(), tmp_path / "state_dict.pt")
    assert learned_filter(tmp_path / "state_dict.pt", s, "iaukf_jpda").detection().item() == pytest.approx(0.8)
    assert s.detection == 0.95
