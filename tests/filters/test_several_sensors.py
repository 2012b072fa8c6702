"""Measurements of different sensors on one track, and several at one instant."""

import copy

import numpy as np
import pytest
import torch
from short_tracks import SMALL_GPB

from torchfra import Gaussian, presets
from torchfra.association import ChiSquare, Clutter
from torchfra.filters import FixedLag
from torchfra.motion import ConstantVelocity, aircraft
from torchfra.sensors import Bearings, Correlated, Position, RangeBearing, RangeRates
from torchfra.sensors.base import Sensor

F64 = {"dtype": torch.float64}
GPS, RADAR = Position(2.0), RangeBearing(torch.tensor([3.0, 0.02], **F64))
CAMERA = Bearings(0.01, stations=torch.tensor([[50.0, -30.0]], **F64))
SENSORS, WHICH = [GPS, RADAR, CAMERA], [0, 1, 1, 2, 0, 0, 2, 1, 0]
DT = torch.tensor([0.5, 0.0, 0.7, 0.0, 0.4, 0.8, 0.3, 0.0, 1.1], **F64)
SEVERAL = [
    "srckf",
    "ukf",
    "ekf",
    "rsrckf",
    "asrckf",
    "rmckf",
    "hghckf2",
    "fra",
    "gpb",
    "imm_srckf",
    "imm_fra",
    "vsimm_srckf",
]


class Stacked(Sensor):
    """Two positions at once: those of ``GPS`` and of ``OTHER``."""

    linear = True

    def __init__(self):
        super().__init__(2, [False] * 4, torch.tensor([2.0, 2.0, 1.0, 3.0], **F64))

    def forward(self, x, u=None):
        return torch.cat([x[..., :2]] * 2, -1)


OTHER = Position(torch.tensor([1.0, 3.0], **F64))


def motion_of(name):
    return aircraft(continuous=True) if "imm" in name else ConstantVelocity(1.0)


def made(name, sensor=GPS, **options):
    return getattr(presets, name)(motion_of(name), sensor, **options)


def prior_of(f, runs=2):
    n = f.motion.size
    mean = torch.zeros(runs, n, **F64)
    mean[:, 0], mean[:, 1] = 100.0, 80.0
    return Gaussian(mean, 8 * torch.eye(n, **F64))


def measured(seed=0):
    """Measurements of three sensors of sizes 2, 2 and 1, of two targets at (100, 80), and one that is missing."""
    rng, at = torch.Generator().manual_seed(seed), torch.tensor([100.0, 80.0], **F64)
    z = torch.full((2, len(WHICH), 2), torch.nan, **F64)
    for k, number in enumerate(WHICH):
        sensor = SENSORS[number]
        noise = sensor.std() * torch.randn(2, sensor.size, generator=rng, **F64)
        z[:, k, : sensor.size] = sensor(at) + noise
    z[1, 4] = torch.nan
    return z


def close(a, b, tolerance=1e-10):
    torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)


def streamed(f, z, prior, dt=DT):
    """The estimates of ``step`` with a sensor each."""
    state, beliefs = f.init(prior), []
    for k, number in enumerate(WHICH):
        sensor = SENSORS[number]
        state, innovation = f.step(state, z[:, k, : sensor.size], dt=dt[k], sensor=sensor)
        beliefs.append(state.belief.mean)
    return torch.stack(beliefs, 1), innovation


@pytest.mark.parametrize("name", SEVERAL)
def test_a_whole_track_is_its_steps(name):
    f, z = made(name), measured()
    estimate = f(z, prior_of(f), dt=DT, sensors=SENSORS, which=WHICH)
    at_once = estimate.info.provisional.mean if name == "fra" else estimate.mean
    means, innovation = streamed(f, z, prior_of(f))
    close(at_once, means)
    close(estimate.nis[:, -1], innovation.nis)
    assert estimate.mean.isfinite().all()
    error = (estimate.mean[:, -1, :2] - torch.tensor([100.0, 80.0])).norm(dim=-1)
    assert (error < 8).all()


@pytest.mark.parametrize("name", ["srckf", "ukf", "ekf", "ghckf", "imm_srckf", "vsimm_srckf"])
def test_two_sensors_at_one_instant_are_one_that_measures_both(name):
    z = torch.tensor([100.0, 80.0, 100.0, 80.0], **F64) + 3 * torch.randn(
        2, 6, 4, generator=torch.Generator().manual_seed(3), **F64
    )
    f, both = made(name), made(name, Stacked())
    whole = both(z, prior_of(f), dt=0.7)
    apart, dt = z.unflatten(-1, (2, 2)).flatten(1, 2), torch.tensor([0.7, 0.0] * 6, **F64)
    estimate = f(apart, prior_of(f), dt=dt, sensors=[GPS, OTHER], which=[0, 1] * 6)
    close(estimate.mean[:, 1::2], whole.mean, 1e-12)
    close(estimate.covariance[:, 1::2], whole.covariance, 1e-12)
    close(estimate.log_likelihood.unflatten(-1, (6, 2)).sum(-1), whole.log_likelihood, 1e-11)


def test_over_no_time_nothing_changes_but_by_what_is_measured():
    for name in SEVERAL:
        f, z = made(name), measured()
        state = f.init(prior_of(f))
        for k in range(2):
            state, _ = f.step(state, z[:, 0], dt=1.0 + k)
        after, _ = f.step(state, torch.full((2, 2), torch.nan, **F64), dt=0.0)
        if name != "fra":  # which settles the step before
            close(after.belief.mean, state.belief.mean)
            close(after.belief.covariance, state.belief.covariance)


@pytest.mark.slow
def test_compiled_it_is_the_same_and_so_are_its_gradients():
    z, found = measured(), []
    for compiled in (False, True):
        camera = Bearings(0.01, stations=torch.tensor([[50.0, -30.0]], **F64))
        camera.std.learn()
        f = made("srckf", learn=("q",))
        f = f.compile() if compiled else f
        data = z[:, 3:7].clone().requires_grad_()
        estimate = f(data, prior_of(f), dt=DT[3:7], sensors=[GPS, camera], which=[1, 0, 0, 1])
        (estimate.mean.square().mean() + estimate.log_likelihood.sum()).backward()
        slopes = [data.grad.nan_to_num(), camera.std.raw.grad, *(p.grad for p in f.parameters())]
        found.append([estimate.mean, slopes])
        assert all(x.abs().sum() > 0 for x in slopes)
    close(*found, 1e-8)


def test_a_compiled_filter_that_knows_tracks_of_the_same_shapes_still_asks_which_sensor_measured():
    """A call that comes again takes a short cut, which is of one sensor."""
    f, z, coarse = made("srckf"), measured().nan_to_num(), Position(50.0)
    expected = f(z, prior_of(f), sensors=[GPS, coarse, GPS], which=WHICH).mean
    f.compile()
    with torch.no_grad():
        for _ in range(3):
            f(z, prior_of(f))
        close(f(z, prior_of(f), sensors=[GPS, coarse, GPS], which=WHICH).mean, expected)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [("fra", {}), ("imm_fra", {}), ("gpb", SMALL_GPB)])
def test_kernels_of_another_sensor_have_the_states_of_the_filter(name, options):
    z, found = measured(), []
    for f in (made(name, **options), made(name, **options).compile()):
        state, _ = f.step(f.init(prior_of(f)), z[:, 0], dt=0.5)
        after, innovation = f.step(state, z[:, 3, :1], dt=0.0, sensor=CAMERA)
        found.append([after, innovation, f.step(after, z[:, 4], dt=0.5)])
    close(*found)


def test_compiled_another_sensor_leaves_what_is_known_of_errors_that_last():
    found = []
    for compiled in (False, True):
        f = presets.srckf(ConstantVelocity(1.0), Correlated(GPS, 3.0, 30.0))
        f = f.compile() if compiled else f
        state, _ = f.step(f.init(prior_of(f)), torch.tensor([90.0, 70.0], **F64))
        found.append(f.step(state, torch.tensor([101.0, 81.0], **F64), sensor=OTHER)[0].inner.belief)
    assert (found[0].mean[..., -2:].abs() > 0.1).all()
    close(*found)


def test_gradients_are_cut_where_they_are_told_to_be():
    f, z = made("srckf"), measured().requires_grad_()
    f(z, prior_of(f), dt=DT, sensors=SENSORS, which=WHICH, truncate=4).mean[:, -1].sum().backward()
    assert (z.grad[:, :8].nan_to_num() == 0).all()
    assert (z.grad[:, 8] != 0).any()


@pytest.mark.parametrize("which", [np.array(WHICH), torch.tensor(WHICH), [np.int64(k) for k in WHICH], tuple(WHICH)])
def test_numbers_of_sensors_may_be_of_any_kind(which):
    f, z = made("srckf"), measured()
    expected = f(z, prior_of(f), dt=DT, sensors=SENSORS, which=WHICH).mean
    close(f(z, prior_of(f), dt=DT, sensors=SENSORS, which=which).mean, expected, 0)


def test_what_a_filter_says_of_elements_is_filled_up_with_nan():
    f, z = made("rsrckf"), measured()
    weights = f(z, prior_of(f), dt=DT, sensors=SENSORS, which=WHICH).info.weights
    assert weights.shape == (2, 9, 2)
    of_camera = torch.tensor(WHICH) == 2
    assert weights[:, of_camera, 1].isnan().all()
    assert weights[:, of_camera, 0].isfinite().all()
    assert weights[:, ~of_camera].isfinite().all()


@pytest.mark.parametrize("first", [0, 1])
def test_repairs_are_counted_for_all_sensors_where_the_rule_of_one_has_no_negative_weights(first):
    """Of six components that a sensor reads the fifth degree has negative weights, of three it has none."""
    sensors = [Position(2.0, dims=3), RangeRates(torch.eye(3, **F64) * 100, 0.5)]
    f, which = presets.ghckf(ConstantVelocity(1.0, 3), sensors[first]), [first, first, 1 - first]
    z, prior = torch.ones(3, 3, **F64), Gaussian(torch.ones(6, **F64), torch.eye(6, **F64))
    together, state = f(z, prior, sensors=sensors, which=which), f.init(prior)
    assert together.info.repaired.tolist() == [0, 0, 0]
    for k, number in enumerate(which):
        state, _ = f.step(state, z[k], sensor=sensors[number])
        torch.testing.assert_close(together.mean[k], state.belief.mean, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ["srckf", "imm_srckf"])
def test_the_backward_pass_knows_all_sensors(name):
    z = measured()[:, :, :2]
    f, both, two = made(name), made(name, Stacked()), torch.tensor([0.7, 0.0] * 3, **F64)
    z = torch.tensor([100.0, 80.0] * 2, **F64) + torch.randn(2, 3, 4, generator=torch.Generator().manual_seed(1), **F64)
    apart = z.unflatten(-1, (2, 2)).flatten(1, 2)
    smoothed = f.smooth(apart, prior_of(f), dt=two, sensors=[GPS, OTHER], which=torch.tensor([0, 1] * 3))
    whole = both.smooth(z, prior_of(f), dt=0.7)
    close(smoothed.mean[:, ::2], whole.mean, 1e-9)
    close(smoothed.covariance[:, 1::2], whole.covariance, 1e-9)


def test_a_fixed_lag_goes_back_over_all_sensors():
    f, z = made("rsrckf"), measured()
    stream, state = FixedLag(f, 3), None
    state = stream.init(prior_of(f))
    for k, number in enumerate(WHICH):
        size = SENSORS[number].size
        state, _ = stream.step(state, z[:, k, :size], dt=DT[k], sensor=SENSORS[number])
    whole = f.smooth(z, prior_of(f), dt=DT, sensors=SENSORS, which=WHICH, lag=3)
    close(state.lagged.mean, whole.mean[:, -4])


def test_steps_by_another_sensor_follow_what_changes_in_the_filter():
    f, z = made("gpb"), measured()
    state = f.init(prior_of(f))
    before, _ = f.step(state, z[:, 1], sensor=RADAR)
    f.motion = made("gpb").motion
    f.motion.models[0].q.set(50.0)
    after, _ = f.step(state, z[:, 1], sensor=RADAR)
    assert (after.belief.scale_tril != before.belief.scale_tril).any()
    close(after.belief, made_with(50.0).step(state, z[:, 1], sensor=RADAR)[0].belief)
    twin = copy.deepcopy(f)
    close(twin.step(state, z[:, 1], sensor=RADAR)[0].belief, after.belief)
    assert set(f.state_dict()) == set(made("gpb").state_dict())


def made_with(q):
    f = made("gpb")
    f.motion.models[0].q.set(q)
    return f


@pytest.mark.parametrize(("name", "memory"), [("asrckf", "fading"), ("fra", "memory"), ("gpb", "outlier")])
def test_what_is_remembered_of_measurements_is_of_the_filters_own_sensor(name, memory):
    f, z = made(name), measured()
    state, _ = f.step(f.init(prior_of(f)), z[:, 0] + 40.0)
    after, _ = f.step(state, z[:, 3, :1], dt=0.0, sensor=CAMERA)
    expected = torch.zeros_like(state.outlier) if name == "gpb" else getattr(state, memory)
    close(getattr(after, memory), expected)


BAD = [
    ({"which": None}, r"which: expected it beside sensors, received None"),
    ({"sensors": None}, r"sensors: expected it beside which, received None"),
    ({"sensors": []}, r"sensors: expected one or more, received none"),
    ({"which": [0, 1, 3] * 3}, r"which: expected \(T,\) indices from 0 to 2"),
    ({"which": 0}, r"which: expected \(T,\) indices from 0 to 2, received 0"),
    ({"which": [True] * 9}, r"which: expected \(T,\) indices from 0 to 2"),
    ({"sensors": GPS}, r"sensors: expected one or more, received Position: take a list"),
    ({"which": [0.0] * 9}, r"which: expected \(T,\) indices from 0 to 2"),
    ({"which": [0, 1]}, r"which: expected the index of a sensor for each of 9 steps"),
    (
        {"which": [2] * 9},
        r"z: expected NaN beyond the 1 elements of sensor 2 at step 0, received a number in element 1",
    ),
    ({"sensors": [GPS, RADAR, Position(1.0, dims=3)]}, "sensor: expected one of at most 2 dimensions"),
    ({"sensors": [GPS, RADAR, "camera"]}, "sensor: expected an instance of torchfra's Sensor"),
]


@pytest.mark.parametrize(("wrong", "message"), BAD)
def test_what_does_not_fit_is_named(wrong, message):
    f = made("srckf")
    right = {"z": measured(), "prior": prior_of(f), "dt": DT, "sensors": SENSORS, "which": WHICH}
    with pytest.raises(ValueError, match=message):
        f(**right | wrong)


@pytest.mark.parametrize("name", SEVERAL)
def test_the_sensor_that_a_filter_was_made_with_is_its_own(name):
    f, z = made(name), measured()[:, :6]
    close(f(z, prior_of(f), sensors=[RADAR, GPS], which=[1] * 6).mean, f(z, prior_of(f)).mean)
    assert f.other_sensor(GPS) is None


@pytest.mark.parametrize(("name", "x"), [("std", torch.ones(())), ("noise", torch.ones(2)), ("u", torch.ones(()))])
def test_a_step_names_what_has_too_few_dimensions(name, x):
    f = made("srckf")
    with pytest.raises(ValueError, match=f"{name}: expected . or more dimensions, received"):
        f.step(f.init(prior_of(f)), torch.zeros(2, 2, **F64), **{name: x})


def test_filters_that_are_of_one_sensor_say_why():
    z = torch.zeros(2, 2, **F64)
    reasons = {"iaukf": "estimate of the measurement noise", "alphabeta": "constant gains are chosen for one sensor"}
    for name, reason in reasons.items():
        f = made(name)
        with pytest.raises(ValueError, match=f"sensor: expected None.*{reason}.*, received range bearing"):
            f.step(f.init(prior_of(f)), z, sensor=RADAR)
    f = presets.jpda(motion_of("jpda"), GPS, gate=ChiSquare(0.99), clutter=Clutter(1e-4))
    with pytest.raises(
        ValueError, match="sensor: expected None, as gate and clutter are of the elements of one sensor"
    ):
        f.step(f.init(prior_of(f)), z, sensor=RADAR)
    with pytest.raises(NotImplementedError, match="GPB: hypotheses of outliers are of one sensor in the backward pass"):
        made("gpb").smooth(measured(), prior_of(f), dt=DT, sensors=SENSORS, which=WHICH)


def test_constant_gains_have_no_second_measurement_at_one_instant():
    for f in (made("alphabeta"), made("alphabeta").compile()):
        for dt in (0.0, torch.zeros((), **F64)):
            with pytest.raises(ValueError, match="dt: expected seconds above 0 and finite"):
                f.step(f.init(prior_of(f)), torch.zeros(2, 2, **F64), dt=dt)
