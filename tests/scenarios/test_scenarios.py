"""There is one way from an estimate to its error, and a wrong one is an error instead of a wrong number."""

import pytest
import torch

from torchfra import metrics, presets, scenarios
from torchfra.catalogue import SCENARIOS, filters_for, make_scenario, scenario_filters


def estimated(scenario, tracks):
    options = {} if scenario.clutter is None else {"clutter": scenario.clutter, "detection": scenario.detection}
    preset = presets.iaukf if scenario.clutter is None else presets.iaukf_jpda
    with torch.no_grad():
        return preset(scenario.motion, scenario.sensor, **options)(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)


@pytest.mark.parametrize(
    ("make", "most"), [(scenarios.clutter_crossing, 7.0), (scenarios.noise_change, 12.0)], ids=["crossing", "change"]
)
def test_converted_estimates_have_the_coordinates_of_the_truth(make, most):
    scenario = make()
    tracks = scenario.simulate(8, 0)
    estimate = scenario.cartesian(estimated(scenario, tracks))
    error = metrics.rmse(estimate.mean, tracks.truth, scenario.truth_position)[:40].mean()
    assert 2.0 < error < most
    assert metrics.rmse(estimate.mean, tracks.truth, scenario.truth_velocity)[20:40].mean() < 10.0
    assert 0.3 < metrics.nees(estimate, tracks.truth, scenario.truth_position)[..., :40].mean() / 3 < 2.0


@pytest.mark.parametrize("make", [scenarios.clutter_crossing, scenarios.clutter_straight, scenarios.noise_change])
@pytest.mark.parametrize("name", ["position", "velocity"])
def test_components_that_estimates_and_truth_do_not_share_are_refused(make, name):
    with pytest.raises(ValueError, match=rf"{name}: estimates of .* have other coordinates .*scenario\.cartesian\(est"):
        getattr(make(), name)


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_says_where_the_truth_has_position_and_velocity(name):
    scenario = make_scenario(name)
    truth = scenario.simulate(1, 0).truth
    assert scenario.quantities["position"] == scenario.truth_position
    if scenario.motion.size == 1:  # growth: a single state
        return
    moved = truth[..., 1:, scenario.truth_position] - truth[..., :-1, scenario.truth_position]
    speed = truth[..., scenario.truth_velocity]
    expected = scenario.dt * (speed[..., 1:, :] + speed[..., :-1, :]) / 2
    apart = (moved - expected).norm(dim=-1) / expected.norm(dim=-1)
    assert apart.median() < 0.05


@pytest.mark.parametrize("make", [scenarios.bearings_outliers, scenarios.adsb_turns, scenarios.reentry])
def test_where_coordinates_are_the_same_conversion_changes_nothing(make):
    scenario = make()
    assert (scenario.position, scenario.velocity) == (scenario.truth_position, scenario.truth_velocity)
    estimate = estimated(scenario, scenario.simulate(2, 0))
    assert scenario.cartesian(estimate) is estimate


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_every_filter_that_goes_with_a_scenario_is_made_around_its_models(name):
    options = [{"motion": motion} for motion in ("velocity", "acceleration", "turn", "bank")]
    for more in options if name == "as-stated" else [{}]:
        scenario = make_scenario(name, **more)
        names = filters_for(scenario)
        assert list(scenario_filters(names, scenario)) == names
        assert len(names) > 1


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_scenario_is_shown_in_some_lines(name):
    shown = str(make_scenario(name))
    assert name in shown
    assert "motion=" in shown
    assert "sensor=" in shown
    assert len(shown.splitlines()) < 80
