"""Models and tracks of other libraries come in and go out, and a step is theirs to rounding."""

from datetime import datetime, timedelta

import numpy as np
import pytest
import torch

from torchfra import presets
from torchfra.adapters.linear import of_seconds

START = datetime(2024, 5, 1, 12)
ORDER = (0, 2, 1, 3)
"""Of states ``[x, vx, y, vy]``."""


# ---------------------------------------------------------------- matrices


def test_matrices_of_a_step_are_computed_once_for_each_step_that_differs():
    asked = []

    def matrix(seconds):
        asked.append(seconds)
        return np.array([[1.0, seconds], [0.0, 1.0]])

    found = of_seconds(matrix)(torch.tensor([[1.0, 2.0], [2.0, 1.0]]).double())
    assert asked == [1.0, 2.0]
    assert found[..., 0, 1].tolist() == [[1.0, 2.0], [2.0, 1.0]]


# ---------------------------------------------------------------- FilterPy


@pytest.fixture
def filterpy():
    kalman = pytest.importorskip("filterpy.kalman")
    kf = kalman.KalmanFilter(4, 2, 1)
    kf.F = np.array([[1, 2.0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0], [0, 0, 0, 1]])
    kf.H = np.array([[1.0, 0, 0, 0], [0, 0.3, 1.0, 0]])
    kf.B = np.array([[2.0], [2.0], [0.0], [1.0]])
    gain = np.array([[2.0, 0], [2, 0], [0, 2], [0, 2]])
    kf.Q, kf.R = 0.1 * gain @ gain.T, np.array([[2.0, 0.5], [0.5, 1.0]])
    kf.x, kf.P = np.array([[1.0], [0.2], [-3.0], [0.1]]), np.diag([4.0, 1.0, 9.0, 0.5])
    return kf


@pytest.mark.parametrize("order", [None, ORDER])
def test_steps_are_those_of_filterpy(filterpy, order):
    from torchfra.adapters import filterpy as adapter

    motion, sensor, prior = adapter.models(filterpy, order=order)
    z, u = np.random.default_rng(1).normal(size=(5, 2)), np.array([[0.3], [0.0], [-1.0], [0.2], [0.1]])
    estimate = presets.srckf(motion, sensor)(torch.from_numpy(z), prior, dt=2.0, u=torch.from_numpy(u))
    index = list(order or range(4))
    for k in range(5):
        filterpy.predict(u=u[k].reshape(1, 1))
        filterpy.update(z[k].reshape(2, 1))
        np.testing.assert_allclose(estimate.mean[k], filterpy.x.reshape(-1)[index], rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance[k], filterpy.P[np.ix_(index, index)], rtol=0, atol=1e-9)
        assert float(estimate.log_likelihood[k]) == pytest.approx(filterpy.log_likelihood, abs=1e-9)


def test_what_filterpy_has_and_torchfra_has_not_is_refused(filterpy):
    from torchfra.adapters import filterpy as adapter

    with pytest.raises(ValueError, match="order: expected each of the components 0 to 3 once"):
        adapter.models(filterpy, order=(0, 1, 2, 2))
    filterpy.alpha = 1.1
    with pytest.raises(ValueError, match=r"kf: expected alpha 1, received 1\.1"):
        adapter.models(filterpy)
    with pytest.raises(ValueError, match=r"kf: expected a filterpy\.kalman\.KalmanFilter, received int"):
        adapter.models(3)


@pytest.mark.parametrize("size", [1, 2])
def test_numbers_instead_of_matrices_are_what_they_are_in_the_steps_of_filterpy(size):
    kalman = pytest.importorskip("filterpy.kalman")
    from torchfra.adapters import filterpy as adapter

    kf = kalman.KalmanFilter(size, 1)
    kf.F = np.array([[1.0, 1.0], [0.0, 1.0]])[:size, :size]
    kf.H = np.array([[1.0, 0.0]])[:, :size]
    kf.P, kf.R, kf.Q = 1000.0, 5, 0.1
    motion, sensor, prior = adapter.models(kf)
    z = np.random.default_rng(0).normal(size=(5, 1))
    estimate = presets.srckf(motion, sensor)(torch.from_numpy(z), prior)
    for k in range(5):
        kf.predict()
        kf.update(z[k])
        np.testing.assert_allclose(estimate.mean[k], kf.x.reshape(-1), rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance[k], kf.P, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("change", "message"), [
    ({"R": 5}, r"kf\.R: expected a matrix \(2, 2\), received the number 5"),
    ({"F": 1.0}, r"kf\.F: expected a matrix \(4, 4\), received the number 1"),
    ({"H": np.ones(4)}, r"kf\.H: expected a matrix \(2, 4\), received \(4,\)"),
    ({"Q": np.ones(4)}, r"kf\.Q: expected a matrix \(4, 4\), received \(4,\)"),
    ({"Q": -0.1}, r"kf\.Q: expected a symmetric positive semidefinite matrix"),
])  # fmt: skip
def test_a_matrix_of_filterpy_that_does_not_fit_is_named(filterpy, change, message):
    from torchfra.adapters import filterpy as adapter

    for name, value in change.items():
        setattr(filterpy, name, value)
    with pytest.raises(ValueError, match=message):
        adapter.models(filterpy)


# ---------------------------------------------------------------- Stone Soup


@pytest.fixture(scope="module")
def soup():
    pytest.importorskip("stonesoup")
    from torchfra.adapters import stonesoup

    return stonesoup


def step_of_stone_soup(transition, measurement, prior, z, extended=False):
    """Mean and covariance after a prediction of 2 s and an update, by Stone Soup."""
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.updater.kalman import ExtendedKalmanUpdater, KalmanUpdater

    time = START + timedelta(seconds=2)
    predicted = KalmanPredictor(transition).predict(prior, timestamp=time)
    updater = (ExtendedKalmanUpdater if extended else KalmanUpdater)(measurement)
    detection = Detection(z.reshape(-1, 1), timestamp=time, measurement_model=measurement)
    posterior = updater.update(SingleHypothesis(predicted, detection))
    return np.asarray(posterior.mean, dtype=float).reshape(-1), np.asarray(posterior.covar, dtype=float)


def prior_of_stone_soup(size=4):
    from stonesoup.types.state import GaussianState

    mean = np.array([[100.0], [1.0], [50.0], [-2.0], [30.0], [0.5]])[:size]
    return GaussianState(mean, np.diag([25.0, 1.0, 16.0, 2.0, 9.0, 1.0][:size]), timestamp=START)


def transitions():
    from stonesoup.models.transition import linear

    def both(one):
        return linear.CombinedLinearGaussianTransitionModel([one, one])

    return {
        "velocity": both(linear.ConstantVelocity(0.5)), "coasting": both(linear.OrnsteinUhlenbeck(0.5, 0.1)),
        "turn": linear.KnownTurnRate([0.5, 0.5], 0.1),
    }  # fmt: skip


@pytest.mark.parametrize("name", ["velocity", "coasting", "turn"])
def test_a_linear_step_is_that_of_stone_soup(soup, name):
    from stonesoup.models.measurement.linear import LinearGaussian

    transition = transitions()[name]
    measurement = LinearGaussian(4, (0, 2), np.array([[4.0, 1.0], [1.0, 9.0]]))
    z, prior = np.array([104.0, 44.0]), prior_of_stone_soup()
    expected = step_of_stone_soup(transition, measurement, prior, z)
    f = presets.srckf(soup.motion(transition, order=ORDER), soup.sensor(measurement, order=ORDER))
    estimate = f(torch.from_numpy(z)[None], soup.belief(prior, order=ORDER), dt=2.0)
    index = list(ORDER)
    np.testing.assert_allclose(estimate.mean[0], expected[0][index], rtol=0, atol=1e-9)
    np.testing.assert_allclose(estimate.covariance[0], expected[1][np.ix_(index, index)], rtol=0, atol=1e-9)


def polar(kind):
    from stonesoup.models.measurement import nonlinear

    offset = np.array([[10.0], [-5.0], [2.0]])
    at = {"translation_offset": offset[:2], "rotation_offset": np.array([[0.0], [0.0], [0.3]])}
    if kind == "elevation":
        at = {"translation_offset": offset, "rotation_offset": np.array([[0.1], [-0.2], [0.3]])}
        return nonlinear.CartesianToElevationBearingRange(6, (0, 2, 4), np.diag([1e-4, 1e-4, 4.0]), **at)
    if kind == "bearing":
        return nonlinear.Cartesian2DToBearing(4, (0, 2), np.diag([1e-4]), **at)
    return nonlinear.CartesianToBearingRange(4, (0, 2), np.diag([1e-4, 4.0]), **at)


@pytest.mark.parametrize("kind", ["bearing", "range", "elevation"])
def test_an_extended_step_on_bearings_is_that_of_stone_soup(soup, kind):
    from stonesoup.models.transition import linear

    measurement = polar(kind)
    size = measurement.ndim_state
    transition = linear.CombinedLinearGaussianTransitionModel([linear.ConstantVelocity(0.5)] * (size // 2))
    order, prior = soup.order_of(transition), prior_of_stone_soup(size)
    sensor = soup.sensor(measurement, order=order)
    x = torch.from_numpy(np.asarray(prior.mean, dtype=float).reshape(-1)[order])
    exact = np.asarray(measurement.function(prior, noise=False), dtype=float).reshape(-1)
    np.testing.assert_allclose(sensor(x), exact, rtol=0, atol=1e-12)
    z = exact + 0.01
    expected = step_of_stone_soup(transition, measurement, prior, z, extended=True)
    f = presets.ekf(soup.motion(transition), sensor)
    estimate = f(torch.from_numpy(z)[None], soup.belief(prior, order=order), dt=2.0)
    # Stone Soup differentiates by differences
    np.testing.assert_allclose(estimate.mean[0], expected[0][order], rtol=0, atol=1e-5)
    np.testing.assert_allclose(estimate.covariance[0], expected[1][np.ix_(order, order)], rtol=0, atol=1e-5)


def test_detections_and_tracks_go_out_and_come_back(soup):
    times = [START + timedelta(seconds=s) for s in (0, 1.5, 4)]
    z = torch.tensor([[1.0, 2.0], [torch.nan, 3.0], [5.0, 6.0]]).double()
    out = soup.detections(z, times)
    assert [one.timestamp for one in out] == [times[0], times[2]]
    back = soup.measurements(reversed(out))
    assert back.values.tolist() == [[1.0, 2.0], [5.0, 6.0]]
    assert back.dt.tolist() == [4.0]
    half = torch.randn(3, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    mean, covariance = half[:, 0], half @ half.mT
    track = soup.track(mean, covariance, times, order=ORDER)
    assert np.asarray(track[1].mean, dtype=float).reshape(-1)[[0, 2, 1, 3]].tolist() == mean[1].tolist()
    timed, again = soup.estimates(track, order=ORDER)
    torch.testing.assert_close(timed.values, mean)
    torch.testing.assert_close(again, covariance)
    assert timed.dt.tolist() == [1.5, 2.5]


def test_what_stone_soup_has_and_torchfra_has_not_is_refused(soup):
    from stonesoup.models.measurement.nonlinear import CartesianToBearingRangeRate

    model = CartesianToBearingRangeRate(6, (0, 2, 4), np.eye(3))
    with pytest.raises(
        ValueError, match=r"model: expected one of LinearGaussian, .* received CartesianToBearingRangeRate"
    ):
        soup.sensor(model)
    with pytest.raises(ValueError, match="model: expected a linear Gaussian transition model"):
        soup.motion(model)
    with pytest.raises(ValueError, match="detections: expected one or more, all of one size"):
        soup.measurements([])
    with pytest.raises(ValueError, match="times: expected one for each of"):
        soup.detections(torch.zeros(2, 2), [START])


# ---------------------------------------------------------------- pandas


@pytest.fixture
def frames():
    pytest.importorskip("pandas")
    from torchfra.adapters import frames

    return frames


def test_columns_of_a_table_become_measurements(frames):
    import pandas as pd

    moments = pd.to_datetime(
        ["2024-05-01 12:00:04", "2024-05-01 12:00:00", "2024-05-01 12:00:01", "2024-05-01 12:00:09"]
    )
    frame = pd.DataFrame({"when": moments, "x": [4.0, 0.0, None, 9.0], "y": [1.0, 2.0, 3.0, 4.0], "id": list("aaab")})
    z, dt = frames.measurements(frame, ["x", "y"], time="when")
    assert dt.tolist() == [1.0, 3.0, 5.0]
    assert z[:, 1].tolist() == [2.0, 3.0, 1.0, 4.0]
    assert z[1, 0].isnan()
    with pytest.raises(ValueError, match="names: expected some of when, x, y, id, received speed"):
        frames.measurements(frame, ["speed"], time="when")


def test_estimates_and_cleaned_tracks_become_tables(frames):
    import torchfra

    scenario = torchfra.scenarios.adsb_turns()
    tracks = scenario.simulate(2)
    estimate = presets.srckf(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, dt=scenario.dt)
    one = estimate._replace(mean=estimate.mean[0], scale_tril=estimate.scale_tril[0], nis=estimate.nis[0])
    frame = frames.estimates(one, scenario.motion, np.arange(448) * 2.0)
    assert list(frame.columns[:2]) == list(scenario.motion.components[:2])
    assert frame.index.name == "time"
    np.testing.assert_allclose(frame["std_x"] ** 2, one.covariance[:, 0, 0].detach())
    with pytest.raises(ValueError, match=r"estimate: expected one track \(T, n\)"):
        frames.estimates(estimate, scenario.motion)
    cleaned = torchfra.clean((np.arange(60.0), tracks.truth[0, :60, :2].numpy() + np.sin(np.arange(60.0))[:, None]))
    from torchfra.cleaning.frames import table as table_of

    table = table_of([cleaned, cleaned])
    assert len(table) == 120
    assert {"seconds", "x", "y", "outlier", "flag"} <= set(table.columns)
