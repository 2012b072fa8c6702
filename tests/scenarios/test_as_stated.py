"""Tracks drawn from the models that filters are told: none may lose there to a plain Kalman filter."""

import functools

import pytest
import torch

from torchfra import presets
from torchfra.catalogue import make_scenario
from torchfra.metrics import nees, rmse
from torchfra.scenarios import as_stated, bound

RUNS, FIRST = 200, 20
CHI_SQUARE = 5.991
"""95 % of chi-square with 2 degrees of freedom."""
KALMAN = ("ekf", "ukf", "ghckf", "mr_ckf", "hghckf1", "iaukf", "fra", "gpb")
"""Presets that give nothing up where the models hold."""
PRICES = {"fra_srckf": 1.04, "asrckf": 1.08, "rmckf": 1.12, "hghckf2": 1.06, "hghckf": 1.12, "rsrckf": 1.12}
"""Of the others, at most what they have beside the error of ``srckf``."""
MODELS = ({"index": 0.01}, {"index": 1.0}, {"index": 0.1, "motion": "acceleration", "sensor": "bearings"})
_TRACKS = {}


def tracks(models):
    """A scenario and its tracks; drawn once."""
    key = tuple(models.items())
    if key not in _TRACKS:
        scenario = as_stated(**models, steps=60)
        _TRACKS[key] = scenario, scenario.simulate(RUNS, seed=4)
    return _TRACKS[key]


def half(of):
    """The first half of the tracks: to smooth them takes several times as long as to filter them."""
    first = slice(RUNS // 2)
    prior = of.prior._replace(mean=of.prior.mean[first])
    return of._replace(truth=of.truth[first], z=of.z[first], prior=prior)


def error_and_nees(f, models):
    """Position RMSE, and the normalised estimation error squared per component of the state."""
    scenario, of = tracks(models)
    with torch.no_grad():
        estimate = f(of.z, of.prior, dt=scenario.dt)
    consistency = nees(estimate, of.truth)[:, FIRST:].mean() / scenario.motion.size
    return float(rmse(estimate.mean, of.truth, scenario.position)[FIRST:].mean()), float(consistency)


@functools.cache
def plain_error(number):
    """Of ``srckf`` with the models of this number."""
    models = MODELS[number]
    scenario, _ = tracks(models)
    return error_and_nees(presets.srckf(scenario.motion, scenario.sensor), models)[0]


@pytest.mark.parametrize(("name", "number"), [*((name, 2) for name in KALMAN), ("fra", 1), ("gpb", 1), ("gpb", 0)])
def test_a_filter_that_claims_to_be_a_kalman_filter_or_more_is_one_where_its_models_hold(name, number):
    models = MODELS[number]
    scenario, _ = tracks(models)
    found, consistency = error_and_nees(getattr(presets, name)(scenario.motion, scenario.sensor), models)
    assert found < 1.02 * plain_error(number)
    assert 0.9 < consistency < 1.1


@pytest.mark.parametrize("name", PRICES)
def test_robust_and_adaptive_filters_pay_a_known_price_where_the_models_hold(name):
    scenario, _ = tracks(MODELS[2])
    found, _ = error_and_nees(getattr(presets, name)(scenario.motion, scenario.sensor), MODELS[2])
    assert found < PRICES[name] * plain_error(2)


@pytest.mark.slow
def test_gpb_smoothed_or_settled_is_a_kalman_filter_too_and_its_ellipses_of_95_percent_cover_93_to_97():
    (scenario, of), errors = tracks(MODELS[2]), []
    of = half(of)
    with torch.no_grad():
        for name in ("gpb", "srckf"):
            f = getattr(presets, name)(scenario.motion, scenario.sensor)
            filtered = f(of.z, of.prior, dt=scenario.dt, past=True)
            smoothed = f.smooth(of.z, of.prior, dt=scenario.dt, estimate=filtered)
            settled = filtered.info.lagged if name == "gpb" else filtered
            errors.append([rmse(e.mean, of.truth, scenario.position)[FIRST:].mean() for e in (settled, smoothed)])
            for belief in (filtered, settled, smoothed):
                inside = nees(belief, of.truth, scenario.position)[:, FIRST:] < CHI_SQUARE
                assert 0.93 < inside.double().mean() < 0.97
    for of_gpb, of_plain in zip(*errors, strict=True):
        assert of_gpb < 1.02 * of_plain


CHAIN = {"manoeuvres": "none", "self_transition": (0.925, 0.925), "restart": (1 / 3, 2 / 3)}
"""How the bank of ``as_stated`` switches: each of three motions stays with probability 0.95."""


@pytest.mark.slow
@pytest.mark.parametrize("chain", [{}, CHAIN], ids=["searched", "as stated"])
def test_gpb_with_a_bank_that_switches_is_as_good_as_interacting_models(chain):
    models = {"index": 0.1, "motion": "bank"}
    scenario, _ = tracks(models)
    plain, _ = error_and_nees(presets.imm_srckf(scenario.bank, scenario.sensor, self_transition=0.95), models)
    found, consistency = error_and_nees(presets.gpb(scenario.bank, scenario.sensor, **chain), models)
    assert found < 1.005 * (1.01 if chain else 1.04) * plain  # by 0.5 %: it learns the noise
    assert 0.9 < consistency < (1.1 if chain else 1.5)  # 1.5: it expects motions to last longer than these do


@pytest.mark.slow
def test_gpb_with_a_bank_is_a_kalman_filter_where_only_its_first_motion_is_flown():
    scenario, _ = tracks({"index": 0.1})
    bank = as_stated("bank", index=0.1).bank
    plain, _ = error_and_nees(presets.srckf(scenario.motion, scenario.sensor), {"index": 0.1})
    found, consistency = error_and_nees(presets.gpb(bank, scenario.sensor), {"index": 0.1})
    assert found < 1.02 * plain
    assert 0.9 < consistency < 1.1


@pytest.mark.parametrize("motion", ["velocity", "acceleration", "turn"])
@pytest.mark.parametrize("sensor", ["position", "bearings", "radar", "ranges"])
def test_a_kalman_filter_reaches_the_bound(motion, sensor):
    scenario = as_stated(motion, sensor, steps=30)
    of = scenario.simulate(RUNS, seed=1)
    estimate = presets.srckf(scenario.motion, scenario.sensor)(of.z, of.prior, dt=scenario.dt)
    found = rmse(estimate.mean, of.truth, scenario.position)[5:].mean()
    least = bound(scenario).rmse(scenario.position)[5:].mean()
    assert found / least == pytest.approx(1.0, abs=0.05)


def test_what_filters_are_told_does_not_change_the_tracks():
    told = as_stated(q=10.0, std=0.5, dt=10.0)
    right, wrong = (scenario.simulate(3, 2) for scenario in (as_stated(dt=10.0), told))
    assert torch.equal(right.z, wrong.z)
    assert float(told.motion.q()) == pytest.approx(10 * float(as_stated(dt=10.0).motion.q()))
    assert float(told.sensor.std()) == 0.5


def test_motions_of_a_bank_stay_and_turn():
    scenario = as_stated("bank", index=0.001)
    velocity = scenario.simulate(50, 0).truth[..., 2:]
    heading = torch.atan2(velocity[..., 1], velocity[..., 0]).diff(dim=1)
    turns = (heading.abs() - 0.1).abs() < 0.05
    assert turns.double().mean() == pytest.approx(2 / 3, abs=0.1)
    assert (turns[:, 1:] != turns[:, :-1]).double().mean() < 0.1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"motion": "walk"}, "motion: expected"),
        ({"sensor": "sonar"}, "sensor: expected"),
        ({"outliers": "many"}, "outliers: expected"),
        ({"index": 0.0}, "index: expected a finite value above 0, received 0.0"),
        ({"q": -1.0}, "q: expected"),
        ({"steps": 0}, "steps: expected 1 or more, received 0"),
    ],
)
def test_what_makes_no_sense_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make_scenario("as-stated", **options)
