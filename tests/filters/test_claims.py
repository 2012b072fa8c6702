"""Laws that hold between filters, and against closed forms."""

import math

import numpy as np
import oracles
import pytest
import torch

from torchfra import presets, scenarios
from torchfra.adaptive import Fading
from torchfra.filters import FRA, SRCKF
from torchfra.gaussian import third_degree, unscented
from torchfra.motion import ConstantAcceleration, ConstantVelocity, Motion
from torchfra.robust import Huber, ThreeSegment
from torchfra.sensors import Bearings, Position, Sensor
from torchfra.types import Gaussian


@pytest.fixture(scope="module")
def scenario():
    return scenarios.bearings_outliers("std", initial="truth")


@pytest.fixture(scope="module")
def tracks(scenario):
    return scenario.simulate(5, 1)


def estimate(f, tracks):
    return f(tracks.z, tracks.prior, u=tracks.u)


def same(a, b, tolerance=1e-9):
    torch.testing.assert_close(a, b, rtol=tolerance, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        {"robust": Huber(math.inf)},
        {"fading": Fading(weakening=1e12)},
        {"robust": ThreeSegment(low=1e9, high=1e10)},
        {"rule": unscented(1.0, 0.0, 0.0)},
    ],
    ids=["Huber at infinity", "fading off", "three segments at infinity", "unscented(1, 0, 0)"],
)
def test_what_never_acts_is_the_plain_filter(scenario, tracks, options):
    plain = estimate(SRCKF(scenario.motion, scenario.sensor), tracks)
    same(estimate(SRCKF(scenario.motion, scenario.sensor, **options), tracks).mean, plain.mean)


def test_fra_with_its_gate_at_infinity_is_the_plain_filter(scenario, tracks):
    plain = estimate(presets.srckf(scenario.motion, scenario.sensor), tracks)
    gated = estimate(presets.fra(scenario.motion, scenario.sensor, gate=math.inf), tracks)
    same(gated.mean, plain.mean)
    assert not gated.info.abnormal.any()


@pytest.mark.parametrize("name", ["fra_srckf", "fra"])
def test_fra_looks_ahead_one_step_and_no_further(scenario, tracks, name):
    f = getattr(presets, name)(scenario.motion, scenario.sensor)
    whole = estimate(f, tracks)
    assert whole.info.abnormal.any()
    for k in (20, 49, 70):
        changed = tracks.z.clone()
        changed[:, k + 2 :] += 0.5
        same(f(changed, tracks.prior, u=tracks.u).mean[:, : k + 1], whole.mean[:, : k + 1])


@pytest.mark.parametrize("name", ["ekf", "ukf", "srckf"])
@pytest.mark.parametrize("correlated", [False, True])
def test_with_a_linear_sensor_it_is_the_kalman_filter_whatever_is_missing(name, correlated):
    rng = np.random.default_rng(0)
    (F, SQ), H = oracles.cv(2.0, 0.5), np.eye(2, 4)
    SR = np.array([[3.0, 0.0], [2.0, 1.0]]) if correlated else np.diag([3.0, 2.0])
    z = np.cumsum(rng.standard_normal((60, 2)) * 10, 0)
    z[5, 0] = z[9, 1] = z[20] = z[30:33] = np.nan
    model = oracles.Model(F, SQ, SR, lambda x, k: H @ x, np.array([False, False]))
    expected = oracles.kalman(z, np.zeros(4), np.eye(4) * 100, model, H)
    noise = {"noise": torch.from_numpy(SR)} if correlated else {"std": torch.tensor([3.0, 2.0], dtype=torch.float64)}
    f = getattr(presets, name)(ConstantVelocity(0.5), Position(**noise))
    e = f(torch.from_numpy(z), Gaussian(torch.zeros(4).double(), 10 * torch.eye(4).double()), dt=2.0)
    for key, value in (("mean", e.mean), ("P", e.covariance), ("nis", e.nis), ("log_likelihood", e.log_likelihood)):
        np.testing.assert_allclose(value.numpy(), expected[key], rtol=1e-9, atol=1e-9)


def test_absolute_and_relative_positions_give_the_same_filter(scenario, tracks):
    """Stations at constant velocity: relative to the first of them, they stand still."""
    absolute = estimate(presets.srckf(scenario.motion, scenario.sensor), tracks)
    speed = torch.tensor([100 / math.sqrt(2)] * 2 + [0.0, 0.0], dtype=torch.float64)
    own = torch.cat([torch.zeros(2).double(), speed])
    fixed = Bearings(scenario.sensor.std().item(), stations=torch.tensor([[0.0, 0.0], [2000.0, 0.0]]).double())
    relative = presets.srckf(scenario.motion, fixed)
    e = relative(tracks.z, Gaussian(tracks.prior.mean - own, tracks.prior.scale_tril))
    moved = torch.cat([tracks.u[:, :2], speed.expand(100, 4)], -1)
    same(e.mean + moved, absolute.mean)
    same(e.log_likelihood, absolute.log_likelihood)


def test_a_moving_frame_that_manoeuvres_is_a_known_shift(scenario, tracks):
    """Wang et al. (2021), eq. (1): x_k = F x_{k-1} - u_{k-1} + w, here with a frame that swerves."""
    absolute = estimate(presets.fra(scenario.motion, scenario.sensor), tracks)
    frame = torch.randn(101, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).cumsum(0) * 5
    matrix = scenario.motion.transition(torch.tensor(1.0, dtype=torch.float64))
    shift = frame[1:] - frame[:-1] @ matrix.mT

    class Relative(ConstantAcceleration):
        def shift(self, dt, u):
            return -u[..., 4:]

    u = torch.cat([tracks.u - frame[1:, :2].repeat(1, 2), shift], -1)
    f = presets.fra(Relative(0.01), scenario.sensor)
    e = f(tracks.z, Gaussian(tracks.prior.mean - frame[0], tracks.prior.scale_tril), u=u)
    same(e.mean + frame[1:], absolute.mean, 1e-7)


class Whole(Sensor):
    """Bearings that say they read all six states."""

    def __init__(self, std):
        super().__init__(6, [True, True], std, None)
        self.inner = Bearings(std)

    def forward(self, x, u=None):
        return self.inner(x, u)


def test_a_sensor_of_the_position_alone_has_no_slope_in_the_other_states(scenario, tracks):
    part, whole = scenario.sensor, Whole(scenario.sensor.std().item())
    same(estimate(presets.asrckf(scenario.motion, whole), tracks).mean,
         estimate(presets.asrckf(scenario.motion, part), tracks).mean, 1e-7)  # fmt: skip
    root = torch.randn(6, 6, dtype=torch.float64).tril()
    belief = Gaussian(tracks.prior.mean[0], root)
    _, spread, _ = third_degree(6)(lambda x: whole(x, tracks.u[0]), belief, whole.difference)
    assert spread[:, -4:].abs().max() < 1e-15
    assert spread[:, -6:-4].abs().min() > 1e-6


class Points(Motion):
    """Constant acceleration that does not say that it is linear."""

    def __init__(self, q):
        super().__init__(2, 3, q)
        self.inner = ConstantAcceleration(q)

    def forward(self, x, dt, u=None):
        return self.inner(x, dt, u)


@pytest.mark.parametrize("name", ["ekf", "ukf", "srckf", "asrckf", "fra"])
def test_a_linear_motion_carried_by_points_is_the_same(scenario, tracks, name):
    preset = getattr(presets, name)
    same(estimate(preset(Points(0.01), scenario.sensor), tracks).mean,
         estimate(preset(scenario.motion, scenario.sensor), tracks).mean, 1e-7)  # fmt: skip


def test_a_weight_of_zero_leaves_the_measurement_out(scenario, tracks):
    f = presets.mr_ckf(scenario.motion, scenario.sensor, high=20.0)
    outlying, missing = tracks.z.clone(), tracks.z.clone()
    outlying[:, 30], missing[:, 30] = outlying[:, 30] + 1.5, torch.nan
    same(f(outlying, tracks.prior, u=tracks.u).mean[:, :40], f(missing, tracks.prior, u=tracks.u).mean[:, :40])


def test_what_is_none_of_the_choices_is_named(scenario):
    for options in ({"decision": "coin"}, {"memory": "none"}, {"final": "last"}):
        with pytest.raises(ValueError, match=next(iter(options))):
            presets.fra(scenario.motion, scenario.sensor, **options)
    with pytest.raises(ValueError, match="rcond"):
        presets.asrckf(scenario.motion, scenario.sensor, rcond=1.0)
    with pytest.raises(ValueError, match="sensor: expected one that reads at most 4"):
        FRA(ConstantVelocity(1.0), Whole(0.1), robust=Huber(), fading=Fading())
    with pytest.raises(ValueError, match="high: expected"):
        presets.mr_ckf(scenario.motion, scenario.sensor, low=5.0, high=2.0)
