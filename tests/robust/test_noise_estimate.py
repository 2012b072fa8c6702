"""The estimate of the measurement noise follows the paper and converges, and costs little where the noise is known."""

import numpy as np
import oracles
import pytest
import torch

from torchfra import metrics, presets, scenarios
from torchfra.adaptive import Fading, SageHusa
from torchfra.filters import SRCKF
from torchfra.motion import ConstantVelocity
from torchfra.robust import Huber
from torchfra.sensors import Position
from torchfra.types import Gaussian, Whitened

SETTINGS = [
    ({}, oracles.Tuned()),
    ({"forgetting": 0.9, "confidence": (0.3, 0.8)}, oracles.Tuned(b=0.9, confidence=(0.3, 0.8))),
    ({"forgetting": 1.0, "warmup": 0}, oracles.Tuned(b=1.0, warmup=0)),
    ({"adapt": "residual", "lowest": 0.5}, oracles.Tuned(residual=True, lowest=0.5)),
    ({"lowest": 0.9, "highest": 1.2}, oracles.Tuned(lowest=0.9, highest=1.2)),
]


@pytest.fixture(scope="module")
def scenario():
    return scenarios.noise_change()


@pytest.fixture(scope="module")
def tracks(scenario):
    t = scenario.simulate(3, 4)
    z = t.z.clone()
    z[0, 10, 0] = torch.nan
    z[0, 20] = torch.nan
    z[0, 30, 2] = torch.nan
    z[0, 31, :2] = torch.nan
    return t._replace(z=z)


def models(scenario):
    """Transition, process noise and measurement noise of a scenario in Cartesian coordinates, for the oracles."""
    dt = torch.tensor(scenario.dt, dtype=torch.float64)
    root = scenario.motion.process_noise(dt)
    F = scenario.motion.cartesian.transition(dt)
    return F.numpy(), (root @ root.mT).numpy(), scenario.sensor.std().numpy() ** 2


@pytest.mark.parametrize(("options", "how"), SETTINGS)
def test_the_filter_agrees_with_an_oracle_of_plain_loops(scenario, tracks, options, how):
    estimate = presets.iaukf(scenario.motion, scenario.sensor, **options)(tracks.z, tracks.prior)
    root = tracks.prior.scale_tril[0].numpy()
    F, Q, R = models(scenario)
    truth = oracles.iaukf(tracks.z[0].numpy(), tracks.prior.mean[0].numpy(), root @ root.T, F, Q, R, how)
    np.testing.assert_allclose(estimate.mean[0], truth["mean"], rtol=1e-9, atol=1e-12)
    scale = np.sqrt(truth["P"].diagonal(axis1=1, axis2=2))
    scale = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(estimate.covariance[0].numpy() / scale, truth["P"] / scale, atol=1e-8)
    np.testing.assert_allclose(estimate.info.noise[0].numpy() * R, truth["R"], rtol=1e-9)


def test_the_weight_of_an_innovation_is_that_of_the_paper():
    """d = (1 - b) / (1 - b^(k + 2)), and the estimate of a wrong variance converges at that rate."""
    side, b = SageHusa([(0,)], forgetting=0.9, confidence=0.0, warmup=0), 0.9
    memory = side.begin(torch.zeros(1, dtype=torch.float64))
    scale = 1.0
    for k in range(6):
        memory = side(memory, torch.tensor([4.0]).double(), torch.ones(1).double())
        scale += (1 - b) / (1 - b ** (k + 2)) * (4.0 - scale)
        assert memory.scale.item() == pytest.approx(scale, rel=1e-12)


def test_the_estimate_starts_after_the_warmup_and_stays_in_its_bounds():
    side = SageHusa([(0, 1)], warmup=3, lowest=0.5, highest=2.0)
    memory = side.begin(torch.zeros(2, dtype=torch.float64))
    for k in range(30):
        memory = side(memory, torch.tensor([-5.0, 100.0]).double(), torch.ones(2).double())
        if k < 3:
            assert memory.scale.tolist() == [1.0, 1.0]
    assert memory.scale.tolist() == [0.5, 2.0]


def test_a_missing_element_leaves_its_estimate_unchanged():
    side = SageHusa([(0, 1)], warmup=0)
    before = side.begin(torch.zeros(2, dtype=torch.float64))
    after = side(before, torch.tensor([3.0, 3.0]).double(), torch.tensor([1.0, 0.0]).double())
    assert after.scale[0] > 1
    assert [part[1].item() for part in after] == [part[1].item() for part in before]


def test_a_measurement_noise_three_times_as_large_is_estimated_as_such(scenario):
    """Three times the standard deviation from the start: nine times the variance, in both blocks."""
    s = scenarios.noise_change(noise_scale=3.0, change=0)
    t = s.simulate(100, 2)
    noise = presets.iaukf(s.motion, s.sensor)(t.z, t.prior).info.noise[:, 60:]
    assert noise.mean((0, 1)).tolist() == pytest.approx([9.0] * 3, rel=0.1)


@pytest.mark.slow
def test_errors_are_known_with_five_times_the_measurement_noise_and_no_larger_with_the_nominal_one():
    """Range, m, and azimuth, mrad, from step 11 on: 18.1 / 2.15 for the plain filter, 13.7 / 1.69 for this one."""
    errors = {}
    for scale in (5.0, 1.0):
        s = scenarios.noise_change(noise_scale=scale)
        t = s.simulate(150, 0)
        truth = s.sensor(torch.from_numpy(np.array([[oracles.msc_from_cartesian(x) for x in t.truth[0].numpy()]])))
        for name, f in (
            ("ukf", presets.ukf(s.motion, s.sensor, alpha=1.0, beta=2.0, kappa=0.0)),
            ("iaukf", presets.iaukf(s.motion, s.sensor)),
        ):
            estimate = f(t.z, t.prior)
            gap = s.sensor.difference(s.sensor(estimate.mean), truth)[:, 10:]
            errors[name, scale] = gap.square().mean((0, 1)).sqrt() * torch.tensor([1e3, 1e3, 1.0])
            assert not estimate.failed.any()
    assert errors["ukf", 5.0][[2, 0]].tolist() == pytest.approx([18.1, 2.15], rel=0.15)
    assert errors["iaukf", 5.0][[2, 0]].tolist() == pytest.approx([13.7, 1.69], rel=0.15)
    assert (errors["iaukf", 1.0] <= 1.02 * errors["ukf", 1.0]).all()


def test_redrawing_the_points_changes_errors_by_less_than_two_percent(scenario, tracks):
    """The paper measures the propagated points, without the process noise: below 1 % of the error over many runs."""
    F, Q, R = models(scenario)
    root = tracks.prior.scale_tril[1].numpy()
    arguments = tracks.z[1].numpy(), tracks.prior.mean[1].numpy(), root @ root.T, F, Q, R, oracles.Tuned()
    truth = np.array([oracles.msc_from_cartesian(x) for x in tracks.truth[1].numpy()])
    errors = []
    for redraw in (True, False):
        gap = 1 / oracles.iaukf(*arguments, redraw)["mean"][10:, 5] - 1 / truth[10:, 5]
        errors.append(np.sqrt((gap**2).mean()))
    assert errors[1] == pytest.approx(errors[0], rel=0.02)
    assert errors[1] != errors[0]


def test_it_works_with_other_sensors_filters_and_interacting_models(scenario):
    s = scenarios.bearings_outliers("none", initial="truth")
    t = s.simulate(4, 0)
    for f in (
        presets.iaukf(s.motion, s.sensor),
        SRCKF(s.motion, s.sensor, noise=SageHusa(s.sensor.blocks)),
        presets.imm([s.motion, s.motion], s.sensor, inner=presets.iaukf),
    ):
        estimate = f(t.z, t.prior, u=t.u)
        assert (metrics.track_rmse(estimate.mean, t.truth, s.position) < 300).all()


def test_the_likelihood_of_an_innovation_uses_the_noise_estimate_before_it(scenario, tracks):
    """Its density is that of a Gaussian with the covariance that ``step`` gives."""
    f = presets.iaukf(scenario.motion, scenario.sensor)
    state = f.init(tracks.prior)
    for k in range(60):
        state, innovation = f.step(state, tracks.z[:, k])
    law = torch.distributions.MultivariateNormal(torch.zeros(3).double(), scale_tril=innovation.scale_tril)
    torch.testing.assert_close(innovation.log_likelihood, law.log_prob(innovation.residual))
    assert (f(tracks.z, tracks.prior).info.noise[:, 59] > 2).all()


def test_an_argument_out_of_range_is_named(scenario):
    motion, sensor = scenario.motion, scenario.sensor
    for options, message in (
        ({"forgetting": 1.5}, "forgetting"),
        ({"confidence": (0.1, 0.2, 0.3)}, "confidence: expected"),
        ({"confidence": 1.5}, "confidence: expected a value in"),
        ({"adapt": "never"}, "adapt: expected one of"),
        ({"lowest": 2.0}, "lowest, highest, warmup"),
        ({"warmup": -1}, "lowest, highest, warmup"),
    ):
        with pytest.raises(ValueError, match=message):
            presets.iaukf(motion, sensor, **options)
    with pytest.raises(ValueError, match="robust, fading: expected none beside"):
        SRCKF(motion, sensor, robust=Huber(), noise=SageHusa(sensor.blocks))
    with pytest.raises(ValueError, match="share: expected"):
        Fading(states=slice(0, 2), share=[1.0, 2.0])
    with pytest.raises(ValueError, match="blocks: expected those of a sensor of 3"):
        SRCKF(motion, sensor, noise=SageHusa([(0, 1)]))
    assert isinstance(SRCKF(motion, sensor, fading=Fading()).fading, Fading)


def test_what_is_missing_adds_nothing_to_the_likelihood_whatever_its_noise_is_taken_for():
    f = presets.iaukf(ConstantVelocity(0.01), Position(2.0))
    z = 6 * torch.randn(20, 2, generator=torch.Generator().manual_seed(0)).double()
    z[12, 1], z[15] = torch.nan, torch.nan
    state, seen = f.init(Gaussian(torch.zeros(4).double(), 5 * torch.eye(4).double())), []
    for row in z:
        state, innovation = f.step(state, row)
        seen.append(innovation)
    assert (state.noise.scale > 2.0).all()
    alone = torch.distributions.Normal(0.0, seen[12].scale_tril[0, 0]).log_prob(seen[12].residual[0])
    torch.testing.assert_close(seen[12].log_likelihood, alone)
    assert seen[15].log_likelihood == 0


def test_the_excess_is_what_scatters_beyond_the_prediction():
    whitened = Whitened(torch.tensor([3.0, 0.0]).double(), torch.tensor([[2.0, 0.0], [0.0, 1.0]]).double(), 2)
    assert SageHusa([(0, 1)]).excess(whitened).tolist() == [5.0, -1.0]
    assert SageHusa([(0, 1)], adapt="residual").excess(whitened).tolist() == [13.0, 1.0]
    less = whitened._replace(subtracted=torch.tensor([[0.5], [3.0]]).double())
    assert SageHusa([(0, 1)]).excess(less).tolist() == [5.25, 8.0]
