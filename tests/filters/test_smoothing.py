"""Smoothed estimates are those of the whole track at once, and of its first steps where there is a lag."""

import numpy as np
import oracles
import pytest
import torch

from torchfra import Gaussian, presets, scenarios
from torchfra.adaptive import Fading
from torchfra.angles import wrap
from torchfra.coordinates import AZIMUTH, belief_from_cartesian, from_cartesian
from torchfra.filters import SRCKF
from torchfra.gaussian import fifth_degree
from torchfra.motion import (
    Augmented,
    ConstantAcceleration,
    ConstantVelocity,
    GaussMarkov,
    Motion,
    Spherical,
    aircraft,
)
from torchfra.scenarios.reentry import Reentry
from torchfra.sensors import Biased, InfraredLaser, Position, RangeBearing

nan = float("nan")
START = torch.tensor([30.0, -20.0, 12.0, -8.0]).double()
ROOT = torch.tensor([9.0, 7.0, 3.0, 4.0]).double().diag()
DT = torch.tensor([1.0, 0.3, 2.5, 1.0, 4.0, 0.1, 1.0, 1.7, 0.5, 3.0, 1.0, 0.8]).double()


def walk(motion, start=START, batch=(), dt=DT, std=2.0, seed=0, whole=False):
    """Positions of a target that moves as the motion says; elements and a step of them missing unless ``whole``."""
    generator = torch.Generator().manual_seed(seed)
    x, z = start.expand(*batch, -1), []
    for step in dt:
        noise = motion.process_noise(step)
        noise = noise @ torch.randn(*batch, noise.shape[-1], 1, dtype=dt.dtype, generator=generator)
        x = (motion.transition(step) @ x.unsqueeze(-1) + noise).squeeze(-1)
        z.append(x[..., :2] + std * torch.randn(*batch, 2, dtype=dt.dtype, generator=generator))
    z = torch.stack(z, -2)
    if not whole:
        z[..., 2, 0], z[..., 5, :], z[..., -1, 1] = nan, nan, nan
    return z


def of(motion, dt=DT, std=2.0):
    """The linear model of the oracle."""

    def matrix(name):
        return lambda k: getattr(motion, name)(dt[k]).numpy()

    return oracles.Model(matrix("transition"), matrix("process_noise"), std * np.eye(2), lambda x, k: x[:2], [0, 0])


def close(estimate, expected, tol=1e-9):
    scale = np.abs(expected["P"]).max()
    np.testing.assert_allclose(estimate.mean, expected["mean"], rtol=tol, atol=tol * np.sqrt(scale))
    np.testing.assert_allclose(estimate.covariance, expected["P"], rtol=tol, atol=tol * scale)


@pytest.mark.parametrize(("motion", "singular"), [
    *((ConstantVelocity(0.5), singular) for singular in ("nothing", "prior", "motion", "both")),
    (ConstantAcceleration(0.1), "both"),
], ids=lambda x: x if isinstance(x, str) else type(x).__name__)  # fmt: skip
def test_a_linear_track_is_that_of_least_squares_over_all_of_it(motion, singular):
    if singular in ("motion", "both"):
        motion = type(motion)(0.0)
    n = motion.size
    start, root = START.new_zeros(n), torch.eye(n).double()
    start[:4], root[:4, :4] = START, ROOT
    if singular in ("prior", "both"):
        root = root @ torch.tensor([1.0, 0, 0, 1, 1, 0]).double()[:n].diag()
    z = walk(motion, start)
    f = presets.srckf(motion, Position(2.0))
    expected = oracles.whole_track(z.numpy(), start.numpy(), (root @ root.mT).numpy(), of(motion))
    close(f.smooth(z, Gaussian(start, root), dt=DT), expected)


def test_errors_behind_an_acceleration_that_the_turn_determines_keep_their_uncertainty():
    motion = Augmented(aircraft()[3], GaussMarkov(3.0, 10.0, 2))  # its acceleration follows from its velocity
    start, root = torch.zeros(8).double(), torch.tensor([9.0, 7.0, 3.0, 4.0, 1.0, 1.0, 3.0, 3.0]).double().diag()
    model = of(motion)._replace(h=lambda x, k: x[:2] + x[6:])
    z = walk(motion, start)
    expected = oracles.whole_track(z.numpy(), start.numpy(), (root @ root.mT).numpy(), model)
    f = presets.srckf(motion, Biased(Position(2.0), [6, 7]))
    close(f.smooth(z, Gaussian(start, root), dt=DT), expected)


def test_a_start_without_uncertainty_and_a_motion_without_noise_leave_none():
    motion = ConstantVelocity(0.0)
    smoothed = presets.srckf(motion, Position(2.0)).smooth(walk(motion), Gaussian(START, 0 * ROOT), dt=DT)
    assert (smoothed.scale_tril == 0).all()
    expected = START[:2] + DT.cumsum(0).unsqueeze(-1) * START[2:]
    torch.testing.assert_close(smoothed.mean[:, :2], expected, rtol=1e-12, atol=0.0)


class Half(Motion):
    """Forgets one of two states that depend on each other: the state after a step has rank 1."""

    linear = True

    def __init__(self, noise):
        super().__init__(1, 2, None)
        self.noise = noise

    def transition(self, dt):
        return torch.tensor([[0.1, 0.2], [0.3, 0.6]], dtype=dt.dtype)

    def process_noise(self, dt):
        return self.noise * torch.ones(2, 1, dtype=dt.dtype)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_what_a_motion_forgets_no_later_measurement_tells(noise):
    motion, root = Half(noise), torch.tensor([[2.0, 0], [1.5, 1.0]]).double()
    z = torch.tensor([[1.0], [0.4], [nan], [0.5]]).double()
    f = SRCKF(motion, Position(0.7, dims=1))
    model = oracles.Model(
        motion.transition(root).numpy(), motion.process_noise(root).numpy(), 0.7 * np.eye(1), lambda x, k: x[:1], [0]
    )
    prior = Gaussian(torch.zeros(2).double(), root)
    close(f.smooth(z, prior), oracles.whole_track(z.numpy(), np.zeros(2), (root @ root.mT).numpy(), model))


def test_a_nearly_linear_track_is_that_of_iterated_least_squares():
    motion, start = ConstantVelocity(0.01), torch.tensor([3e4, 4e4, 12.0, -8.0]).double()
    std = torch.tensor([2.0, 5e-5]).double()
    at = walk(motion, start, std=0.0, whole=True)
    z = RangeBearing(std)(at) + std * torch.randn(at.shape, dtype=at.dtype)
    z[4] = nan
    f = presets.srckf(motion, RangeBearing(std))
    model = oracles.Model(
        lambda k: motion.transition(DT[k]).numpy(), lambda k: motion.process_noise(DT[k]).numpy(), np.diag(std.numpy()),
        lambda x, k: np.array([np.hypot(x[0], x[1]), np.arctan2(x[0], x[1])]), [0, 1],
    )  # fmt: skip
    smoothed = f.smooth(z, Gaussian(start, ROOT), dt=DT)
    expected = oracles.whole_track(z.numpy(), start.numpy(), (ROOT @ ROOT.mT).numpy(), model, iterations=5)
    std = np.sqrt(np.diagonal(expected["P"], axis1=1, axis2=2))
    assert np.abs((smoothed.mean.numpy() - expected["mean"]) / std).max() < 1e-3
    np.testing.assert_allclose(np.diagonal(smoothed.covariance, axis1=1, axis2=2), std**2, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["third", "fifth"])
def test_a_motion_that_is_not_linear_goes_back_through_the_same_points(rule):
    scenario = scenarios.reentry()
    tracks = scenario.simulate(1, 0)
    motion, dt, z = scenario.motion, torch.tensor(scenario.dt).double(), tracks.z[0, :30]
    assert isinstance(motion, Reentry)
    f = presets.srckf(motion, scenario.sensor) if rule == "third" else presets.ghckf(motion, scenario.sensor)
    smoothed = f.smooth(z, scenario.prior, dt=scenario.dt)
    filtered = smoothed.info.filtered
    points = oracles.third_degree(5) if rule == "third" else symmetric(fifth_degree(5))

    def ahead(mean, P, k):
        moved = lambda x: motion(torch.from_numpy(x), dt).numpy()  # noqa: E731
        return oracles.through(moved, motion.process_noise(dt).numpy(), points, mean, P)

    expected = oracles.smoother(filtered.mean.numpy(), filtered.covariance.numpy(), ahead)
    size = np.sqrt(np.diagonal(expected["P"], axis1=1, axis2=2))
    # Positions of 6.5e6 m whose standard deviation is 1 m leave 1e-9 of it to moment form, and correlations more.
    np.testing.assert_allclose((smoothed.mean.numpy() - expected["mean"]) / size, 0 * size, atol=1e-5)
    scaled = (smoothed.covariance.numpy() - expected["P"]) / (size[:, :, None] * size[:, None])
    np.testing.assert_allclose(scaled, 0 * scaled, atol=1e-5)
    if rule == "third":
        assert smoothed.info.repaired is None
    else:
        assert smoothed.info.repaired.shape == (30,)


def symmetric(rule):
    """Points and weights of a rule, for the oracle."""
    points, weights, _, _ = rule._rule
    centre = 1 - weights.sum()
    points = torch.cat([torch.zeros(len(points), 1), points], 1)
    weights = torch.cat([centre.reshape(1), weights])
    return points.numpy(), weights.numpy(), weights.numpy()


@pytest.mark.parametrize("share", [None, 0.3])
def test_fading_factors_widen_the_prediction_in_the_backward_pass_as_they_did_in_the_forward_pass(share):
    fading = Fading(1.0, share=None if share is None else [share], states=slice(0, 2))
    motion = ConstantVelocity(0.5)
    f, z = SRCKF(motion, Position(2.0), fading=fading), walk(motion)
    z[6:] += 40.0
    smoothed = f.smooth(z, Gaussian(START, ROOT), dt=DT)
    filtered, factor = smoothed.info.filtered, smoothed.info.filtered.info.fading.numpy()
    assert factor.max() > 2

    def ahead(mean, P, k):
        F, SQ = motion.transition(DT[k]).numpy(), motion.process_noise(DT[k]).numpy()
        scale = np.sqrt(1 + (factor[k] - 1) * (1.0 if share is None else share)) * np.array([1.0, 1, 0, 0])
        stretched = np.diag(np.where(scale > 0, scale, 1.0)) @ F
        return F @ mean, stretched @ P @ stretched.T + SQ @ SQ.T, P @ stretched.T

    close(smoothed, oracles.smoother(filtered.mean.numpy(), filtered.covariance.numpy(), ahead))


@pytest.mark.parametrize(("provisional", "plain"), [("robust", None), ("adaptive", None), ("likeliest", 0.5)])
def test_fra_smooths_what_it_has_decided_for(scenario, tracks, provisional, plain):
    options = {"provisional": provisional, "final": provisional, "plain": plain, "patience": 0.0}
    f = presets.fra(scenario.motion, scenario.sensor, **options)
    z = tracks.z.clone()
    z[:, 6:, 0] += 0.2
    smoothed = f.smooth(z, tracks.prior, u=tracks.u)
    filtered = smoothed.info.filtered
    info = filtered.info
    assert (info.adaptive & (info.fading > 1)).any()
    assert (info.abnormal & ~info.adaptive).any()
    dt = torch.tensor(1.0).double()
    F, SQ = scenario.motion.transition(dt).numpy(), scenario.motion.process_noise(dt).numpy()
    for b in range(len(z)):
        factor = torch.where(info.adaptive, info.fading, 1.0)[b].numpy()

        def ahead(mean, P, k, factor=factor):
            stretched = np.diag([np.sqrt(factor[k])] * 2 + [1.0] * 2) @ F
            return F @ mean, stretched @ P @ stretched.T + SQ @ SQ.T, P @ stretched.T

        expected = oracles.smoother(filtered.mean[b].numpy(), filtered.covariance[b].numpy(), ahead)
        close(Gaussian(smoothed.mean[b], smoothed.scale_tril[b]), expected, tol=1e-8)


@pytest.mark.parametrize(("name", "lag"), [("rsrckf", 5), ("asrckf", 2), ("fra", 1), ("fra", 5)])
def test_with_a_lag_each_step_is_that_of_the_track_up_to_so_many_later(make, tracks, name, lag):
    f = make(name)
    lagged = f.smooth(tracks.z, tracks.prior, u=tracks.u, lag=lag)
    steps = tracks.z.shape[-2]
    for k in range(steps):
        end = min(k + lag + 1, steps)
        whole = f.smooth(tracks.z[:, :end], tracks.prior, u=tracks.u[:end])
        torch.testing.assert_close(lagged.mean[:, k], whole.mean[:, k], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(lagged.covariance[:, k], whole.covariance[:, k], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("final", "provisional"), [("robust", "robust"), ("adaptive", "robust"), ("plain", "adaptive")]
)
def test_with_a_lag_as_long_as_the_track_it_is_the_smoother(make, tracks, final, provisional):
    f = make("fra", final=final, provisional=provisional)
    z = tracks.z.clone()
    z[:, -1] += 0.4
    whole = f.smooth(z, tracks.prior, u=tracks.u)
    assert whole.info.filtered.info.abnormal[:, -1].any()
    for lag in (z.shape[-2] - 1, z.shape[-2] + 3):
        lagged = f.smooth(z, tracks.prior, u=tracks.u, lag=lag)
        torch.testing.assert_close(tuple(lagged[:2]), tuple(whole[:2]), rtol=1e-12, atol=1e-12)


def test_a_target_that_passes_north_is_smoothed_as_one_that_passes_elsewhere():
    start = torch.tensor([-400.0, 2000.0, 300.0, 20.0, 1.0, 0.0]).double()
    truth = start + torch.arange(1, 41).double().unsqueeze(-1) * torch.tensor([20.0, 1, 0, 0, 0, 0]).double()
    std = torch.tensor([1e-3, 1e-3, 5.0]).double()
    sensor = InfraredLaser(std)
    f, z = presets.srckf(Spherical(ConstantVelocity(0.25, 3)), sensor), sensor(from_cartesian(truth))
    z = z + std * torch.randn(z.shape, dtype=z.dtype)
    prior = belief_from_cartesian(Gaussian(start, torch.tensor([30.0, 30, 30, 5, 5, 5]).double().diag()))
    north = f.smooth(z, prior)
    assert (north.mean[:, AZIMUTH].diff().abs() > 6).any()
    assert ((north.mean[:, AZIMUTH] >= 0) & (north.mean[:, AZIMUTH] < 2 * np.pi)).all()
    turned = torch.tensor([1.0, 0, 0]).double()
    away = torch.eye(6).double()[AZIMUTH]
    elsewhere = f.smooth(z + turned, Gaussian(prior.mean + away, prior.scale_tril))
    torch.testing.assert_close(wrap(elsewhere.mean - north.mean), away.expand(40, 6), rtol=0, atol=1e-8)
    torch.testing.assert_close(elsewhere.scale_tril, north.scale_tril, rtol=1e-6, atol=1e-9)
