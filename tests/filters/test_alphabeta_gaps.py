"""Filters of constant gains know how far they are off, over gaps too, and do not follow a single wild measurement."""

import math

import numpy as np
import oracles
import pytest
import torch

from torchfra import presets
from torchfra.cleaning import clean_tracks
from torchfra.filters.alphabeta import AlphaBeta, gains
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.readers import Recording
from torchfra.sensors import Position
from torchfra.types import Gaussian

LINE, SENSOR = ConstantVelocity(1.0, 1), Position(20.0, dims=1)
PRIOR = Gaussian(torch.zeros(2).double(), torch.tensor([500.0, 300.0]).double().diag())
OPTIONS = {"manoeuvre": 3.5, "outlier": 10.0, "level_shares": [60 / 70], "margin": 3.6}


def wild(seed):
    """A straight line with measurements that are far off, alone and in a row, at the start and later."""
    g = np.random.default_rng(seed)
    z = 200 * np.arange(70.0) + 20 * g.standard_normal(70)
    for first, count in ((seed % 4, 1), (20, 1), (30, 5), (45, 7 + seed % 3)):
        z[first : first + count] += g.choice([-1, 1]) * g.uniform(2e3, 9e4)
    z[g.choice(np.arange(46, 52), 2)] -= 1e6
    return z


# ---------------------------------------------------------------- the covariance


@pytest.mark.parametrize("confirm", [True, False])
def test_decisions_means_and_covariances_are_those_of_a_filter_written_plainly(confirm):
    several = [wild(seed) for seed in range(8)]
    f = presets.alphabeta(LINE, SENSOR, **OPTIONS, confirm=confirm)
    e = f(torch.from_numpy(np.stack(several))[..., None], PRIOR)
    pairs = list(zip(f.alpha().tolist(), f.beta().tolist(), strict=True))
    for i, z in enumerate(several):
        said = oracles.alphabeta_bank(z, 1.0, pairs, 20.0, 70.0, 200.0, [60.0], 60.0, 3.6, confirm=confirm, speed=300.0)
        assert e.info.rejected[i, 2:, 0].tolist() == [bool(x) for x in said["out"]]
        assert e.info.restarted[i, 2:, 0].tolist() == said["restart"]
        np.testing.assert_allclose(e.mean[i, 2:], np.stack([said["x"], said["v"]], 1), rtol=1e-9, atol=1e-5)
        np.testing.assert_allclose(e.covariance[i, 2:], said["P"], rtol=1e-9, atol=1e-6)
        assert e.info.rejected[i].any()
        assert e.info.restarted[i].any() or confirm


def joseph(P, K, F, sigma):
    P, H = F @ P @ F.T, np.eye(len(F))[:1]
    A = np.eye(len(F)) - K @ H
    return A @ P @ A.T + sigma**2 * K @ K.T


@pytest.mark.parametrize("orders", [2, 3])
def test_a_single_filter_has_the_covariance_of_its_errors_from_the_first_step_over_every_gap(orders):
    g = np.random.default_rng(orders)
    dt, seen = g.uniform(0.5, 2.0, 40), g.uniform(size=40) > 0.4
    motion = (ConstantVelocity if orders == 2 else ConstantAcceleration)(1.0, 1)
    found = gains.kalata(0.5, orders)
    column = [found.alpha, found.beta] + ([] if orders == 2 else [found.gamma / 2])
    z = np.where(seen, g.standard_normal(40), np.nan)[:, None]
    start = np.tril(g.standard_normal((orders, orders)))
    prior = Gaussian(torch.zeros(orders).double(), torch.from_numpy(start))
    e = AlphaBeta(motion, SENSOR, found)(torch.from_numpy(z), prior, dt=torch.from_numpy(dt))
    P, used, since = start @ start.T, 0, 0.0
    for k in range(40):
        F = np.array([[dt[k] ** (j - i) / math.factorial(j - i) if j >= i else 0.0 for j in range(orders)]
                      for i in range(orders)])  # fmt: skip
        since += dt[k]
        now = ([1.0, 0, 0], [1.0, 1, 0])[used][:orders] if used < 2 else [float(x) for x in column]
        K = np.array([[x / since**i * seen[k]] for i, x in enumerate(now)])
        P = joseph(P, K, F, 20.0)
        used, since = used + seen[k], since * (1 - seen[k])
        np.testing.assert_allclose(e.covariance[k], P, rtol=1e-9)


@pytest.mark.parametrize("make", [
    lambda d: presets.alphabeta(ConstantVelocity(1.0, d), Position(20.0, dims=d)),
    lambda d: presets.alphabeta(ConstantAcceleration(1.0, d), Position(20.0, dims=d)),
    lambda d: presets.alphabeta(ConstantAcceleration(1.0, d), Position(20.0, dims=d), detect="polar"),
    lambda d: AlphaBeta(ConstantAcceleration(1.0, d), Position(20.0, dims=d), gains.kalata(0.5, 3)),
])  # fmt: skip
def test_the_std_is_that_of_the_errors_at_steps_with_and_without_measurements(make):
    f, g, steps = make(2), torch.Generator().manual_seed(0), 80
    orders = f.motion.orders
    speed = 100 * torch.randn(1000, 1, 2, generator=g).double()
    truth = 3e4 + speed * torch.arange(1, steps + 1)[:, None]
    z = truth + 20 * torch.randn(truth.shape, generator=g).double()
    z[:, torch.arange(steps) % 7 > 3] = torch.nan
    z[:, 50:60] = torch.nan
    prior = Gaussian(torch.zeros(2 * orders).double(), torch.tensor([3e4, 100.0, 0.0][:orders]).double()
                     .repeat_interleave(2).diag())  # fmt: skip
    with torch.no_grad():
        e = f(z, prior)
    std = e.scale_tril[..., :2, :].square().sum(-1).sqrt()
    ratio = ((e.mean[..., :2] - truth) / std)[:, 4:].square().mean((0, 2)).sqrt()
    assert (ratio - 1).abs().max() < 0.2  # noise itself chooses gains, now and then
    gap = std[0, 50:60, 0]
    assert (gap.diff() > 0).all()
    assert gap[-1] > 2 * gap[0]


@pytest.mark.parametrize("motion", [LINE, ConstantAcceleration(1.0, 1)])
def test_what_was_lost_for_longer_than_the_longest_gap_may_be_anywhere_and_restarts(motion):
    f = presets.alphabeta(motion, SENSOR, max_gap=10.0)
    z = 100 * torch.arange(50, dtype=torch.float64)
    z[20:40] = torch.nan
    std = torch.tensor([500.0, 300.0, 5.0]).double()[: motion.orders]
    e = f(z[:, None], Gaussian(torch.zeros(motion.orders).double(), std.diag()))
    kept, lost = e.scale_tril[29], e.scale_tril[30:40]
    assert kept[0].norm() < 2 * 20.0
    since = torch.arange(11, 21).double()  # at the speed of the prior, since the last measurement
    torch.testing.assert_close(lost[:, 0, 0], since * 300.0)
    torch.testing.assert_close((lost @ lost.mT)[:, 1:, 1:], std[1:].square().diag().expand(10, -1, -1))
    torch.testing.assert_close((lost @ lost.mT)[:, 0, 1], since * 300.0**2)
    assert e.info.restarted[:, 0].nonzero()[:, 0].tolist() == [40]


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [1.0, 30.0])
def test_track_knows_how_sure_it_is_between_fixes(sigma):
    gaps = [1.0] * 30 + [9.0] + [1.0] * 30 + [40.0] + [1.0] * 20
    time = np.cumsum(gaps)
    course = lambda t: np.stack([200 * t, 50 * t], 1)  # noqa: E731
    fixes = course(time) + sigma * np.random.default_rng(1).standard_normal((len(time), 2))
    options = {"filter": "alphabeta", "smooth": False, "sigma": sigma, "q": 1.0}
    (result,) = clean_tracks([Recording("a", time, fixes, None, {})], dt=0.5, **options)
    missing, std = result.row < 0, result.std[:, 0]
    assert missing.sum() > 150
    assert std[missing].min() > 0.4 * sigma
    for begin in (29, 68):
        inside = missing & (result.time > begin) & (result.time < begin + (8 if begin == 29 else 39))
        assert (np.diff(std[inside]) > 0).all()
        assert std[inside][-1] > 2 * std[inside][0]
    error = np.abs(result.position - course(result.time + time[0])).max(1) / std
    assert error.max() < 6
    assert error[missing].mean() > 0.3


# ---------------------------------------------------------------- wild measurements


def line(time):
    return np.stack([200 * time, -100 * time], 1)


def flown(at, off, gap=50.0, fixes=40, after=1):
    """A straight track with one fix that is far off, the next ``after`` fixes later only after a gap."""
    time = np.arange(fixes) + np.where(np.arange(fixes) > at + after - 1, gap, 0.0)
    position = line(time) + 25 * np.random.default_rng(at).standard_normal((fixes, 2))
    position[at] += off
    return Recording("a", time, position, None, {})


@pytest.mark.parametrize("gap", [5.0, 50.0, 500.0])
def test_a_single_wild_fix_is_not_followed_into_a_gap(gap):
    cases = [(at, after) for at in (0, 1, 2, 3, 5, 12) for after in (1, 2, 3)]
    recordings = [flown(at, np.array([3e5, -1e5]), gap, after=after) for at, after in cases]
    options = {"filter": "alphabeta", "smooth": False, "sigma": 25.0, "q": 1.0}
    results = clean_tracks(recordings, dt=max(1.0, gap / 20), **options)
    for (at, _), result in zip(cases, results, strict=True):
        time, error = result.time, np.linalg.norm(result.position - line(result.time), axis=1)
        fixed = result.recording.time - result.recording.time[0]
        late = time >= fixed[at + 3 if at < 3 else 0]  # a start is at the newest fix
        assert (error < 6 * np.linalg.norm(result.std, axis=1) + 50)[late].all()
        assert error[late].max() < 1e6
        assert error[-10:].max() < 150


def test_a_restart_waits_until_a_measurement_is_confirmed():
    z = torch.cat([100 * torch.arange(20.0), 9e4 - 50 * torch.arange(20.0)]).double()
    wild = range(20, 32)  # the step that is far off, in each track
    seen = z + 5e5 * torch.eye(len(z), dtype=torch.float64)[list(wild)]
    e = presets.alphabeta(ConstantAcceleration(1.0, 1), SENSOR)(seen[..., None], Gaussian(
        torch.zeros(3).double(), torch.tensor([500.0, 300.0, 5.0]).double().diag()))  # fmt: skip
    for at, mean, restarted in zip(wild, e.mean, e.info.restarted[..., 0], strict=True):
        (restart,) = restarted.nonzero()[:, 0].tolist()
        assert restart == (25 if at not in (23, 24, 25) else at + 3)
        assert (mean[restart + 1 :, 0] - z[restart + 1 :]).abs().max() < 1e-6
        assert mean[:, 0].abs().max() < 1.2e5


@pytest.mark.parametrize("share", [-1.01, -0.99, 0.99, 1.01])
def test_a_track_starts_where_the_greatest_acceleration_and_the_noise_explain_its_bend(share):
    f = presets.alphabeta(LINE, SENSOR, **OPTIONS, confirm=True)
    between, since = 2.0, 3.0
    ratio = since / between  # of the times by which a line through two measurements goes on to the third
    noise = 3.6 * 20.0 * math.sqrt(1 + (1 + ratio) ** 2 + ratio**2)
    bend = share * (0.5 * f.max_acceleration().item() * since * (between + since) + noise)
    z, dt = torch.tensor([[0.0], [0.0], [bend]]).double(), torch.tensor([1.0, between, since]).double()
    assert f(z, PRIOR, dt=dt).mean[-1, 1].item() == pytest.approx(bend / since if abs(share) < 1 else 0.0)


def test_two_wild_measurements_side_by_side_are_no_restart_either():
    z = torch.cat([100 * torch.arange(20.0), 9e4 - 50 * torch.arange(30.0)]).double()
    z[25:27] += torch.tensor([5e5, -4e5])
    e = presets.alphabeta(ConstantAcceleration(1.0, 1), SENSOR)(z[:, None], Gaussian(
        torch.zeros(3).double(), torch.eye(3).double()))  # fmt: skip
    assert e.info.restarted[:, 0].nonzero()[:, 0].tolist() == [29]


def test_the_papers_bank_restarts_as_it_always_did():
    z = torch.cat([100 * torch.arange(20.0), 9e4 - 50 * torch.arange(20.0)]).double()
    z[25] += 5e5
    e = presets.alphabeta(LINE, SENSOR)(z[:, None], PRIOR)
    assert e.info.restarted[25, 0]
    assert e.mean[25, 1] > 4e5
