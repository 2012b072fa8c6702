"""Smoothed estimates are those of the whole track at once, and of its first steps where there is a lag."""

import numpy as np
import oracles
import pytest
import torch
from conftest import STEPS

from torchfra import presets, scenarios
from torchfra.adaptive import Fading
from torchfra.angles import wrap
from torchfra.association import Clutter, Euclidean
from torchfra.compiler import backward
from torchfra.coordinates import AZIMUTH, belief_from_cartesian, from_cartesian
from torchfra.filters import SRCKF
from torchfra.filters.whole_tracks import WholeTracks
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
from torchfra.types import Gaussian

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


@pytest.mark.parametrize("lag", [None, 2])
@pytest.mark.parametrize("several", [False, True])
def test_truncated_gradients_of_later_steps_end_where_they_are_cut(several, lag):
    motion, sensor = ConstantVelocity(1.0), Position(2.0)
    f = presets.imm([motion, ConstantVelocity(9.0)], sensor) if several else presets.rsrckf(motion, sensor)
    z = walk(motion, whole=True)[:6].requires_grad_()

    def gradient(**options):
        later = f.smooth(z, Gaussian(START, ROOT), lag=lag, **options).mean[3:]
        return torch.autograd.grad(later.square().sum(), z)[0]

    expected = gradient()
    expected[:3] = 0.0
    torch.testing.assert_close(gradient(truncate=3), expected)


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


# ---------------------------------------------------------------- Fisher's identity


Q, STD = 0.5, 2.0


class Pairs(Motion):
    """Constant velocity with the state before kept beside the state: what smoothing says of both together."""

    linear = True

    def __init__(self):
        super().__init__(2, 4, None, size=8)
        self.inside = ConstantVelocity(Q)

    def transition(self, dt):
        step, nothing = self.inside.transition(dt), torch.zeros(*dt.shape, 4, 4, dtype=dt.dtype)
        eye = torch.eye(4, dtype=dt.dtype).expand_as(step)
        return torch.cat([torch.cat([step, nothing], -1), torch.cat([eye, nothing], -1)], -2)

    def process_noise(self, dt):
        noise = self.inside.process_noise(dt)
        return torch.cat([noise, torch.zeros_like(noise)], -2)


@pytest.fixture(scope="module")
def gradients():
    """Of the log likelihood, by q and by the standard deviation: as autograd has them."""
    f = presets.srckf(ConstantVelocity(Q), Position(STD), learn=("q", "std"))
    loss = -f(walk(ConstantVelocity(Q)), Gaussian(START, ROOT), dt=DT).log_likelihood.sum()
    values = {"q": f.motion.q, "std": f.sensor.std}
    raw = torch.autograd.grad(-loss, [value.raw for value in values.values()])
    slopes = {}
    for (name, value), gradient in zip(values.items(), raw, strict=True):
        natural = value(DT)
        (slope,) = torch.autograd.grad(natural.sum(), value.raw)
        slopes[name] = (gradient / slope).item()
    return slopes


def test_that_by_the_measurement_noise_is_the_expected_square_of_what_is_left(gradients):
    z = walk(ConstantVelocity(Q))
    smoothed = presets.srckf(ConstantVelocity(Q), Position(STD)).smooth(z, Gaussian(START, ROOT), dt=DT)
    variance = smoothed.covariance.diagonal(dim1=-2, dim2=-1)[:, :2]
    square = (z - smoothed.mean[:, :2]).square() + variance
    expected = (square / STD**3 - 1 / STD)[~z.isnan()].sum()
    assert gradients["std"] == pytest.approx(expected.item(), rel=1e-9)


def test_that_by_the_process_noise_is_the_expected_square_of_the_accelerations(gradients):
    motion = Pairs()
    prior = Gaussian(torch.cat([START, START]), torch.block_diag(ROOT, torch.zeros_like(ROOT)))
    smoothed = presets.srckf(motion, Position(STD)).smooth(walk(ConstantVelocity(Q)), prior, dt=DT)
    gain = torch.linalg.pinv(ConstantVelocity(1.0).process_noise(DT))
    noise = torch.cat([gain, -gain @ motion.inside.transition(DT)], -1)  # (T, 2, 8): the acceleration of each step
    mean = (noise @ smoothed.mean.unsqueeze(-1)).squeeze(-1)
    square = mean.square() + (noise @ smoothed.covariance @ noise.mT).diagonal(dim1=-2, dim2=-1)
    expected = (square / (2 * Q**2) - 1 / (2 * Q)).sum()
    assert gradients["q"] == pytest.approx(expected.item(), rel=1e-9)


# ---------------------------------------------------------------- scans


nan = float("nan")
CALM, SENSOR = ConstantVelocity(0.5), Position(2.0)
WIDE = torch.tensor([5.0, 5.0, 3.0, 3.0]).double().diag()
STARTS = torch.tensor([[0.0, 0.0, 10.0, 0.0], [500.0, 0.0, -10.0, 3.0]]).double()


def apart(steps=12, seed=0):
    """Two targets far apart, and scans of both in an order that changes."""
    rng = torch.Generator().manual_seed(seed)
    t = torch.arange(1, steps + 1).double()[:, None, None]
    z = STARTS[:, :2] + t * STARTS[:, 2:] + 2 * torch.randn(steps, 2, 2, generator=rng).double()
    z[3, 1] = nan
    scans = z.clone()
    scans[1::2] = scans[1::2].flip(-2)
    return z.movedim(1, 0), scans


def jpda(**options):
    return presets.jpda(CALM, SENSOR, clutter=Clutter(1e6, rate=1e-9), gate=Euclidean(100.0), **options)


@pytest.mark.parametrize("lag", [None, 3])
def test_targets_that_are_told_apart_are_smoothed_as_alone(lag):
    tracks, scans = apart()
    both = jpda(detection=1.0).smooth(scans, Gaussian(STARTS, WIDE), lag=lag)
    alone = presets.ukf(CALM, SENSOR).smooth(tracks, Gaussian(STARTS, WIDE), lag=lag)
    assert both.mean.shape == (2, 12, 4)
    seen = [k for k in range(12) if k != 3]  # where a target is missed the others' measurements are weighed too
    torch.testing.assert_close(both.mean[0], alone.mean[0], rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(both.mean[1, seen], alone.mean[1, seen], rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(both.covariance[0], alone.covariance[0], rtol=1e-6, atol=1e-4)


def test_a_target_that_seemed_lost_goes_back_through_the_wider_prediction():
    tracks, scans = apart()
    scans = tracks[:1].movedim(1, 0).clone()  # one target
    scans[4:9] = 1e4  # something else, far away
    f, prior = jpda(detection=0.9, lost=0.05), Gaussian(STARTS[:1], WIDE)
    smoothed = f.smooth(scans, prior)
    state, inflations = f.init(prior), [0.0]
    for scan in scans:
        state, _ = f.step(state, scan)
        inflations.append(state.inflations.item())
    times = 4 ** np.diff(inflations).clip(0)
    assert times.max() > 2
    dt = torch.tensor(1.0).double()
    F, SQ = CALM.transition(dt).numpy(), CALM.process_noise(dt).numpy()

    def ahead(mean, P, k):
        return F @ mean, times[k] * (F @ P @ F.T + SQ @ SQ.T), times[k] ** 0.5 * P @ F.T

    filtered = smoothed.info.filtered
    expected = oracles.smoother(filtered.mean[0].numpy(), filtered.covariance[0].numpy(), ahead)
    np.testing.assert_allclose(smoothed.mean[0], expected["mean"], rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(smoothed.covariance[0], expected["P"], rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_targets_with_a_lag_and_from_what_the_filter_said_are_smoothed_alike(crossing, scans):
    f = presets.iaukf_jpda(
        crossing.motion, crossing.sensor, clutter=crossing.clutter, gate=Euclidean(150.0, probability=0.9999)
    )

    def smooth(**options):
        return tuple(f.smooth(scans.z, scans.prior, **options)[:2])

    together = smooth()
    torch.testing.assert_close(smooth(lag=24), together, rtol=1e-12, atol=1e-12)
    filtered, lagged = f(scans.z, scans.prior), smooth(lag=4)
    whole = f.smooth(scans.z[:, :15], scans.prior)
    torch.testing.assert_close(lagged[0][:, :, 10], whole.mean[:, :, 10], rtol=1e-9, atol=1e-9)
    for estimate in (filtered, f(scans.z, scans.prior, past=True)):
        reused = f.smooth(scans.z, scans.prior, estimate=estimate)
        torch.testing.assert_close(reused.mean, together[0], rtol=0, atol=0)


def test_constant_gains_are_not_smoothed_and_say_why():
    f = presets.alphabeta(CALM, SENSOR)
    with pytest.raises(NotImplementedError, match=r"AlphaBetaBank: constant gains have no process noise"):
        f.smooth(torch.zeros(5, 2).double(), Gaussian(STARTS[0], WIDE))


# ---------------------------------------------------------------- a million steps in float32


TRACKS, LONG = 100, 10_000


@pytest.fixture(scope="module")
def z():
    rng = torch.Generator().manual_seed(0)

    def drawn(rate):
        return torch.rand(TRACKS, LONG, 1, generator=rng) < rate

    walk = torch.randn(TRACKS, LONG, 2, generator=rng).cumsum(1)
    noise = 5 * torch.randn(TRACKS, LONG, 2, generator=rng)
    return (walk + noise.where(~drawn(0.05), 30 * noise)).where(~drawn(0.05), torch.nan)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["srckf", "fra"])
def test_a_million_steps_keep_their_roots(z, name):
    f = getattr(presets, name)(ConstantVelocity(1.0), Position(5.0)).compile()
    prior = Gaussian(torch.zeros(4), torch.tensor([1e3, 1e3, 100.0, 100.0]).diag())
    with torch.no_grad():
        smoothed = f.smooth(z, prior)
    assert smoothed.mean.dtype == torch.float32
    assert smoothed.mean.shape == (TRACKS, LONG, 4)
    for estimate in (smoothed, smoothed.info.filtered):
        assert not estimate.failed.any()
        assert (estimate.scale_tril.diagonal(dim1=-2, dim2=-1) > 0).all()


# ---------------------------------------------------------------- promises of a filter


LAGS = [None, 3]
MOTION, SENSOR = ConstantVelocity(1.0), Position(2.0)
PRIOR = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
Z = torch.zeros(6, 2).double()


def near(a, b, tol=1e-9):
    torch.testing.assert_close(tuple(a[:2]), tuple(b[:2]), rtol=tol, atol=tol)


@pytest.mark.parametrize("name", ["srckf", "iaukf", "fra"])
def test_what_the_filter_said_is_handed_on_and_can_be_handed_in(make, tracks, name, monkeypatch):
    f = make(name)
    kept = f(tracks.z, tracks.prior, u=tracks.u, past=True)
    smoothed, filtered = f.smooth(tracks.z, tracks.prior, u=tracks.u), f(tracks.z, tracks.prior, u=tracks.u)
    torch.testing.assert_close(smoothed.info.filtered, filtered, equal_nan=True)
    assert torch.equal(smoothed.nis, filtered.nis)
    assert torch.equal(smoothed.log_likelihood, filtered.log_likelihood)
    near(f.smooth(tracks.z, tracks.prior, u=tracks.u, estimate=filtered), smoothed, tol=0)
    monkeypatch.setattr(WholeTracks, "_run", None)  # whoever has the past need not run the filter again
    near(f.smooth(tracks.z, tracks.prior, u=tracks.u, estimate=kept), smoothed, tol=0)
    assert torch.equal(smoothed.mean[:, -1], filtered.mean[:, -1])


@pytest.mark.parametrize("lag", LAGS)
def test_compiled_tracks_may_have_values_of_their_own(lag):
    """Of as many tracks as there are windows of a lag, so that one might be taken for the other."""
    f = presets.srckf(ConstantVelocity(torch.tensor([0.5, 1.0, 2.0]).double()), Position(2.0))
    z = torch.randn(3, 6, 2, generator=torch.Generator().manual_seed(1)).double()
    prior = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
    near(f.smooth(z, prior, lag=lag)[:4], f.compile().smooth(z, prior, lag=lag)[:4], tol=1e-10)


def test_a_prior_without_uncertainty_and_a_motion_without_noise_have_finite_gradients():
    f = presets.srckf(ConstantVelocity(0.0), SENSOR)
    mean = torch.ones(4).double().requires_grad_()
    smoothed = f.smooth(torch.randn(5, 2).double(), Gaussian(mean, torch.zeros(4, 4).double()))
    (gradient,) = torch.autograd.grad(smoothed.mean[:, :2].sum() + smoothed.scale_tril.sum(), mean)
    torch.testing.assert_close(gradient, torch.tensor([5.0, 5.0, 15.0, 15.0]).double())


def test_values_may_differ_by_track(make, tracks):
    thresholds = torch.tensor([[0.8], [1.5], [3.0]]).double()
    f, together = make("rsrckf"), make("rsrckf", threshold=thresholds)
    smoothed = together.smooth(tracks.z, tracks.prior, u=tracks.u)
    assert smoothed.mean.shape == (3, 4, STEPS, 4)
    for i, threshold in enumerate(thresholds[:, 0]):
        f.robust.threshold.set(threshold)
        near([x[i] for x in smoothed[:2]], f.smooth(tracks.z, tracks.prior, u=tracks.u))


@pytest.mark.slow
def test_with_a_lag_a_compiled_filter_that_decides_late_smooths_as_one_that_is_not(make, tracks, monkeypatch):
    """Also where not all windows are taken at once."""
    monkeypatch.setattr(backward, "_AT_ONCE", 80)
    dt = 0.5 + torch.rand(4, 1).double()
    f, fast, z = make("fra"), make("fra").compile(), tracks.z.clone()
    z[:, 7] += 0.4
    for lag in (1, 4, 11):
        slow = f.smooth(z, tracks.prior, u=tracks.u, lag=lag, dt=dt)
        quick = fast.smooth(z, tracks.prior, u=tracks.u, lag=lag, dt=dt)
        near(quick, slow, tol=1e-10)
    assert slow.info.filtered.info.abnormal[:, 7].any()


def test_a_compiled_motion_that_is_not_linear_goes_back_too():
    scenario = scenarios.growth()
    tracks = scenario.simulate(3, 0)
    f = presets.ghckf(scenario.motion, scenario.sensor)
    given = (tracks.z[:, :10], tracks.prior), {"u": tracks.u[..., :10, :], "dt": scenario.dt}
    slow, fast = f.smooth(*given[0], **given[1]), f.compile().smooth(*given[0], **given[1])
    near(fast, slow, tol=1e-7)


def test_a_track_of_one_step_is_filtered():
    f = presets.srckf(MOTION, SENSOR)
    near(f.smooth(Z[:1], PRIOR), f(Z[:1], PRIOR), tol=0)
    near(f.smooth(Z[:1], PRIOR, lag=2), f(Z[:1], PRIOR), tol=0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f: f.smooth(Z, PRIOR, lag=0), r"lag: expected at least 1 step, received 0"),
        (lambda f: f.smooth(Z, PRIOR, dt=-1.0), r"dt: expected seconds above 0"),
        (lambda f: f.smooth(Z, PRIOR, estimate=f(Z[:4], PRIOR)), r"estimate: .*\(6, 4\), received \(4, 4\)"),
        (lambda f: f.smooth(Z, PRIOR, estimate=f(Z, PRIOR), dt=-1.0), r"dt: expected seconds above 0"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(presets.srckf(MOTION, SENSOR))


def test_compiled_a_certain_direction_tells_nothing_either():
    f = presets.srckf(ConstantVelocity(0.0), SENSOR)  # no noise: velocities stay what they were
    root = torch.diag(torch.tensor([3.0, 0.0, 0.5, 0.0])).double()  # nothing is uncertain along y
    z = torch.randn(5, 6, 2, generator=torch.Generator().manual_seed(0)).double()
    eager = f.smooth(z, Gaussian(PRIOR.mean, root))
    fast = f.compile().smooth(z, Gaussian(PRIOR.mean, root))
    near(fast, eager)
    assert (fast.scale_tril[..., 1, :].abs() < 1e-12).all()
