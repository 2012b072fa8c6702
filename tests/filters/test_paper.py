"""Check values and published behaviour of Wang et al. (2021)."""

import math

import pytest
import torch

from torchfra import metrics, presets, scenarios
from torchfra.adaptive import Fading
from torchfra.gaussian.inputs import Measurements, make_frames
from torchfra.gaussian.model import compare, predict
from torchfra.gaussian.update import correct, down_weight, innovation
from torchfra.robust import Huber, ThreeSegment
from torchfra.types import Gaussian


def close(value, expected, digits):
    torch.testing.assert_close(
        value, torch.tensor(expected, dtype=torch.float64), rtol=10.0**-digits, atol=10.0**-digits
    )


@pytest.fixture(scope="module")
def first():
    """The first step of scenario 1: the filter, the prediction and the measurement [0.44, -0.02] against it."""
    scenario = scenarios.bearings_outliers()
    f = presets.srckf(scenario.motion, scenario.sensor)
    z = torch.tensor([[0.44, -0.02]], dtype=torch.float64)
    (frame,), _ = make_frames(Measurements(z, u=scenarios.bearings.stations(1)), f.motion, f.sensor, 0)
    prediction = predict(f.motion, f.motion_rule, f.init(scenario.prior).belief, frame)
    return scenario, frame, prediction, compare(f.sensor, f.sensor_rule, prediction.belief, frame)


def test_the_first_prediction(first):
    scenario, frame, prediction, whitened = first
    close(prediction.belief.mean, [2410.5, 1515.5, 11.0, 16.0, 1.0, 1.0], 12)
    close(prediction.belief.covariance.diagonal()[:2], [101.005, 101.005], 9)
    root, normalised = innovation(whitened)
    covariance = scenario.sensor.std() ** 2 * root @ root.mT
    close(covariance * 1e4, [[3.179751376, 0.1747911147], [0.1747911147, 3.504650922]], 8)
    residual = frame.measurement_noise.colour(whitened.residual.unsqueeze(-1)).squeeze(-1)
    close(frame.z - residual, [1.017617921, 0.230985010], 8)
    assert normalised.square().sum().item() == pytest.approx(1186.7905, abs=1e-3)
    slope = scenario.sensor.std() * whitened.slope @ torch.linalg.inv(prediction.belief.scale_tril[:2, :2])
    close(slope * 1e4, [[1.91068066, -3.09413709], [6.55818396, -1.54287739]], 7)


def test_the_first_update(first):
    _, _, prediction, whitened = first
    belief, _, normalised = correct(prediction.belief, whitened)
    close(belief.mean[:2], [2334.557232, 1580.969090], 6)
    weights = Huber()(whitened.residual, normalised.square().sum())
    close(weights, [0.040640495, 0.093530201], 7)
    robust, _, _ = correct(prediction.belief, down_weight(whitened, weights))
    close(robust.mean[:2], [2404.011874, 1519.076543], 6)


def test_the_first_fading_factor(first):
    _, frame, prediction, whitened = first
    fading = Fading(rcond=0.0, fading_max=math.inf)
    memory = fading.remember(fading.begin(prediction.belief.mean, 2), whitened.residual, frame.measured)
    assert prediction.spread.square().sum().item() == pytest.approx(204.045, abs=1e-9)
    factor = fading(prediction, whitened, memory, torch.ones(2, dtype=torch.float64)).item()
    assert factor == pytest.approx(17797.6, rel=1e-5)
    assert factor * 204.045 == pytest.approx(3631512.2, rel=1e-7)


def test_three_segments():
    distance = torch.tensor([2.0, 5.0, 20.0, 200.0], dtype=torch.float64)
    weights = ThreeSegment()(torch.zeros(4, 2, dtype=torch.float64), distance.square())
    close(weights[:, 0], [1.0, 0.4642494646, 0.0823046142, 0.0], 9)


def test_the_true_paths():
    one, two = (s().simulate(1, 0).truth[0] for s in (scenarios.bearings_outliers, scenarios.bearings_manoeuvre))
    close(one[[39, 99], :2], [[2400.0, 3360.0], [3600.0, 1500.0]], 9)
    close(two[29, :4], [2270.0, 3565.0, 12.0, -19.0], 9)
    close(two[79, 2:4], [-12.0, 19.0], 9)


@pytest.mark.parametrize("make", [scenarios.bearings_outliers, scenarios.bearings_manoeuvre])
def test_a_run_does_not_depend_on_how_many_are_asked_for(make):
    many = make(truth_noise=0.01).simulate(1000, 7)
    for few, at in (
        (make(truth_noise=0.01).simulate(10, 7), 0),
        (make(truth_noise=0.01).simulate(20, 7, first=250), 250),
    ):
        n = len(few.z)
        for a, b in ((few.z, many.z), (few.truth, many.truth), (few.prior.mean, many.prior.mean)):
            torch.testing.assert_close(a, b[at : at + n], rtol=0, atol=0)
    assert not torch.equal(make().simulate(10, 8).z, many.z[:10])


def test_outliers_are_where_the_paper_has_them_and_as_large():
    quiet = scenarios.bearings_outliers("none").simulate(1000, 0)
    for mode, ten, forty in (("covariance", 10**0.5, 40**0.5), ("std", 10.0, 40.0)):
        outlying = scenarios.bearings_outliers(mode).simulate(1000, 0)
        noise = (outlying.z - quiet.z).abs().amax((0, 2))
        assert noise.nonzero().flatten().tolist() == [39, 49, 59, 69]
        spread = (outlying.z - quiet.z).std((0, 2)) / math.radians(1)
        assert spread[39].item() == pytest.approx(ten - 1, rel=0.05)
        assert spread[69].item() == pytest.approx(forty - 1, rel=0.05)
    offset = (scenarios.bearings_outliers("offset").simulate(50, 0).z - quiet.z[:50]).abs()
    torch.testing.assert_close(offset[:, 69], torch.full((50, 2), 40 * math.radians(1)).double())


TABLE = {
    "bearings_outliers": {"srckf": 506, "rsrckf": 1609, "mr_ckf": 1217, "rmckf": 218, "fra_srckf": 162, "fra": 135},
    "bearings_manoeuvre": {"srckf": 157, "rsrckf": 184, "mr_ckf": 159, "rmckf": 167, "fra_srckf": 149.5, "fra": 148.5},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(TABLE))
def test_mean_errors_over_500_runs(name):
    scenario = getattr(scenarios, name)()
    tracks = scenario.simulate(500, 11)
    mean = {}
    for preset, expected in TABLE[name].items():
        with torch.no_grad():
            e = getattr(presets, preset)(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, u=tracks.u)
        mean[preset] = metrics.rmse(e.mean, tracks.truth, scenario.position).mean().item()
        assert mean[preset] == pytest.approx(expected, rel=0.1)
        lost = metrics.diverged(e.mean, tracks.truth, scenario.position)
        if preset in ("srckf", "fra_srckf", "fra"):
            assert not lost.any()
    if name == "bearings_outliers":
        assert mean["fra"] <= 0.35 * mean["srckf"]
        assert mean["fra"] <= 0.15 * mean["rsrckf"]


def test_scenarios_answer_what_they_do_not_know():
    for options in ({"outliers": "many"}, {"initial": "near"}, {"truth_noise": -1.0}):
        with pytest.raises(ValueError, match=next(iter(options))):
            scenarios.bearings_outliers(**options)
    with pytest.raises(ValueError, match="runs"):
        scenarios.bearings_outliers().simulate(0)


def test_a_simulated_track_is_float64_or_what_is_asked_for():
    tracks = scenarios.bearings_outliers().simulate(2, 0, dtype=torch.float32)
    assert {t.dtype for t in (tracks.z, tracks.truth, *tracks.prior)} == {torch.float32}
    assert isinstance(tracks.prior, Gaussian)
