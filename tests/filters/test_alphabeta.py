"""Constant gains are what the theory of steady states says, and the bank of them decides as its paper describes."""

import math
from itertools import product

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra import metrics, presets
from torchfra.filters.alphabeta import AlphaBeta, AlphaBetaBank, Gains, gains
from torchfra.motion import ConstantAcceleration, ConstantVelocity, CoordinatedTurn
from torchfra.scenarios import level_then_weave
from torchfra.sensors import Bearings, Position
from torchfra.types import Gaussian

LINE, SENSOR = ConstantVelocity(1.0, 1), Position(20.0, dims=1)
PRIOR = Gaussian(torch.zeros(2).double(), torch.eye(2).double())


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


# ---------------------------------------------------------------- gains


def test_known_gains():
    one, small = gains.kalata(1.0), gains.kalata(0.05)
    assert (one.alpha.item(), one.beta.item()) == pytest.approx((0.75, 0.5))
    assert (small.alpha.item(), small.beta.item()) == pytest.approx((0.2708671190, 0.0426946390), abs=1e-10)
    assert gains.benedict_bordner(0.5).beta.item() == pytest.approx(1 / 6)
    with pytest.raises(ValueError, match="expected index above 0"):
        gains.kalata([1.0, -1.0])
    damped = gains.critically_damped(0.6)
    assert damped.beta.item() == pytest.approx(2 - 0.64 - 2 * (1 - 0.64) ** 0.5)


@pytest.mark.parametrize("orders", [2, 3])
def test_kalatas_gains_are_those_of_a_kalman_filter_that_has_settled(orders):
    index = torch.logspace(-2, 0.7, 12, dtype=torch.float64)
    motion = (ConstantVelocity if orders == 2 else ConstantAcceleration)(index**2, 1)  # a level for each track
    n = motion.size
    f = presets.srckf(motion, Position(1.0, dims=1))
    prior = Gaussian(torch.zeros(n).double(), torch.eye(n).double())
    P = f(torch.zeros(12, 400, 1).double(), prior).covariance[:, -1]
    found = gains.kalata(index, orders)
    expected = [found.alpha, found.beta] + ([] if orders == 2 else [found.gamma / 2])
    torch.testing.assert_close(P[..., 0], torch.stack(expected, -1), rtol=1e-6, atol=1e-9)


def test_expanding_memory_is_the_least_squares_line():
    line = gains.expanding_memory(tensor(1, 2, 3, 4))
    torch.testing.assert_close(line.alpha, tensor(1, 1, 5 / 6, 0.7))
    torch.testing.assert_close(line.beta, tensor(0, 1, 0.5, 0.3))
    z = torch.randn(12, 1, generator=torch.Generator().manual_seed(0)).double()
    slow = gains.kalata(1e-6)
    f = AlphaBeta(LINE, SENSOR, slow, expanding=True)
    found = f(z, PRIOR, dt=2.0).mean
    for k in range(2, 13):
        slope, level = np.polyfit(2.0 * np.arange(k), z[:k, 0].numpy(), 1)
        assert found[k - 1].tolist() == pytest.approx([level + slope * 2 * (k - 1), slope], abs=1e-9)


@given(st.floats(0.05, 0.99), st.floats(0.02, 1.9))
@settings(deadline=None, max_examples=40)
def test_variances_solve_the_steady_state(alpha, beta):
    K, F = np.array([[alpha], [beta]]), np.array([[1.0, 1], [0, 1]])
    A = (np.eye(2) - K @ [[1.0, 0]]) @ F
    P = np.linalg.solve(np.eye(4) - np.kron(A, A), (K @ K.T).ravel()).reshape(2, 2)
    found = gains.variances(tensor(alpha), tensor(beta))
    assert [v.item() for v in found[:3]] == pytest.approx([P[0, 0], P[0, 1], P[1, 1]], rel=1e-8)
    assert found.prediction.item() == pytest.approx((F @ P @ F.T)[0, 0], rel=1e-8)


def test_a_filter_lags_as_it_should():
    t = torch.arange(400, dtype=torch.float64)
    z = (0.5 * 3.0 * t**2).unsqueeze(-1)
    g = Gains(tensor(0.5).squeeze(), tensor(0.2).squeeze())
    e = AlphaBeta(LINE, SENSOR, g)(z, PRIOR)
    assert (z[-1, 0] - e.mean[-1, 0]).item() == pytest.approx(3 * (1 - 0.5) / 0.2)
    assert (3 * t[-1] - e.mean[-1, 1]).item() == pytest.approx(3 * (2 * 0.5 - 0.2) / (2 * 0.2))


@pytest.mark.parametrize("orders", [2, 3])
def test_the_covariance_is_that_of_the_errors(orders):
    motion = (ConstantVelocity if orders == 2 else ConstantAcceleration)(1.0, 2)
    z = 20 * torch.randn(3000, 60, 2, generator=torch.Generator().manual_seed(0)).double()
    prior = Gaussian(torch.zeros(2 * orders).double(), torch.eye(2 * orders).double())
    e = AlphaBeta(motion, Position(20.0), gains.kalata(0.5, orders))(z, prior, dt=2.0)
    std = e.covariance[0, -1].diagonal().sqrt()
    spread = (e.mean[:, -1] / std).mT @ (e.mean[:, -1] / std) / 3000
    torch.testing.assert_close(spread, e.covariance[0, -1] / std / std.unsqueeze(-1), rtol=0, atol=0.1)
    assert e.nis[:, -10:].mean().item() == pytest.approx(2.0, rel=0.05)


def test_what_is_not_stable_is_refused():
    for alpha, beta in ((0.5, 3.2), (-0.1, 0.1), (1.0, 2.0)):
        assert not gains.stable(Gains(tensor(alpha), tensor(beta)))
    with pytest.raises(ValueError, match="gains: expected stable alpha and beta, received"):
        AlphaBeta(LINE, SENSOR, Gains(tensor(0.5).squeeze(), tensor(3.2).squeeze()))


def test_three_gains_are_stable_where_errors_decay():
    g, seen = np.random.default_rng(0), set()
    for alpha, beta, gamma in g.uniform([0, 0, 0], [2.0, 2.0, 1.0], (60, 3)):
        column = np.array([[alpha], [beta], [gamma / 2]])
        errors = (np.eye(3) - column @ [[1.0, 0, 0]]) @ [[1.0, 1, 0.5], [0, 1, 1], [0, 0, 1]]
        decay = np.abs(np.linalg.matrix_power(errors, 512)).max() < 1.0
        assert gains.stable(Gains(*tensor(alpha, beta, gamma))) == decay
        seen.add(decay)
    assert seen == {True, False}


# ---------------------------------------------------------------- the bank


def test_flags_are_raised_at_three_standard_deviations_of_the_slowest_filters_residual():
    f = AlphaBetaBank(LINE, SENSOR)
    slowest = AlphaBeta(LINE, SENSOR, Gains(f.alpha()[-1], f.beta()[-1]))
    e = slowest(torch.zeros(3000, 1).double(), PRIOR)
    predicted = torch.tensor([[1.0, 1], [0, 1]]).double() @ e.scale_tril[-1]
    residual = (1 + predicted[0].square().sum() / 400).sqrt()
    assert f.manoeuvre().item() == pytest.approx(3 * residual.item(), rel=1e-6)
    assert f.outlier().item() == pytest.approx(3 * f.manoeuvre().item())


OPTIONS = {"manoeuvre": 3.5, "outlier": 10.0, "level_shares": [60 / 70], "margin": 3.6}


def with_outliers(seed, steps=80, outliers=6):
    """A line, a bend, an outlier here and there, sometimes many in a row."""
    g = np.random.default_rng(seed)
    t = np.arange(steps, dtype=float)
    z = 200 * t + 0.5 * g.uniform(-40, 40) * np.maximum(t - 30, 0) ** 2 + 20 * g.standard_normal(steps)
    z[g.choice(np.arange(4, steps), outliers)] += g.choice([-1, 1], outliers) * g.uniform(100, 3000, outliers)
    if seed % 3 == 0:
        z[50:] += 5000  # the track jumps for good: it restarts
    return z


@pytest.mark.parametrize("options", [{}, {"hysteresis": 1.0, "dwell": 1.0}])
def test_it_decides_as_the_paper_describes(options):
    several = [with_outliers(seed) for seed in range(2)]  # of which the first jumps for good
    f = presets.alphabeta(LINE, SENSOR, **OPTIONS, **options)
    estimate = f(torch.from_numpy(np.stack(several))[..., None], PRIOR)
    pairs = list(zip(f.alpha().tolist(), f.beta().tolist(), strict=True))
    names = {"hysteresis": "hyst"}
    given = {names.get(key, key): value for key, value in options.items()}
    for i, z in enumerate(several):
        said = oracles.alphabeta_bank(z, 1.0, pairs, 20.0, 70.0, 200.0, [60.0], 60.0, 3.6, **given)
        keep = ~np.array(said["restart"])  # there the manoeuvre ends and the fastest level begins
        for ours, key, where in (
            (estimate.info.vote, "vote", slice(None)),
            (estimate.info.rejected, "out", slice(None)),
            (estimate.info.restarted, "restart", slice(None)),
            (estimate.info.manoeuvre, "state", keep),
            (estimate.info.level, "level", keep),
        ):
            assert ours[i, 2:, 0].numpy()[where].tolist() == np.array(said[key])[where].tolist(), key
        np.testing.assert_allclose(estimate.mean[i, 2:, 0], said["x"], rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(estimate.mean[i, 2:, 1], said["v"], rtol=1e-9, atol=1e-6)


@pytest.mark.slow
def test_some_of_those_tracks_restart_and_reject():
    z = torch.stack([torch.from_numpy(with_outliers(seed)) for seed in range(12)])
    info = presets.alphabeta(LINE, SENSOR, **OPTIONS)(z[..., None], PRIOR).info
    assert info.restarted.sum() >= 3
    assert info.rejected.sum() >= 30
    assert all(len(level.unique()) == 3 for level in info.level)


def test_the_vote_is_the_majority_of_three():
    f = presets.alphabeta(LINE, SENSOR, **OPTIONS)
    for older, old, new in product((0.0, 1.0), repeat=3):
        state = f.init(PRIOR._replace(mean=PRIOR.mean.expand(1, 2)))
        state = state._replace(used=state.used + 9, flag_count=state.flag_count + 2, flags=tensor([[old], [older]]))
        after, _ = f.step(state, tensor([300.0 if new else 0.0]))
        assert bool(after.manoeuvre.item()) == (older + old + new >= 2)


def test_each_axis_is_filtered_as_if_it_were_alone_whatever_the_other_lacks():
    several = torch.from_numpy(np.stack([with_outliers(seed) for seed in range(2)], -1))
    several[10:14, 0], several[40, 1] = torch.nan, torch.nan
    both = presets.alphabeta(ConstantVelocity(1.0, 2), Position(20.0))(several, Gaussian(
        torch.zeros(4).double(), torch.eye(4).double()))  # fmt: skip
    for axis in range(2):
        alone = presets.alphabeta(LINE, SENSOR)(several[:, axis, None], PRIOR)
        torch.testing.assert_close(both.mean[:, axis::2], alone.mean)
        assert both.info.rejected[:, axis].equal(alone.info.rejected[:, 0])


def test_by_range_and_azimuth_a_track_is_decided_as_its_mirror_image():
    t, mirror = torch.arange(60, dtype=torch.float64), tensor(1, -1)
    z = torch.stack([1e4 + 50 * t, 20 * t + 5 * (t - 30).clamp_min(0).square()], -1)
    z[15, 1] += 900.0  # beside the course, at the same range
    f = presets.alphabeta(ConstantVelocity(1.0, 2), Position(20.0), detect="polar")
    prior = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
    one, other = f(z, prior), f(z * mirror, prior)
    torch.testing.assert_close(one.mean[:, [1, 3]], -other.mean[:, [1, 3]])
    assert one.info.rejected[:, 0].nonzero()[:, 0].tolist() == [15]
    assert one.info.manoeuvre[30:].any()
    assert not one.info.manoeuvre[:30].any()


@pytest.mark.slow
def test_soft_choices_become_hard_ones_and_have_gradients():
    motion, sensor = ConstantAcceleration(1.0, 3), Position(20.0, dims=3)
    tracks = level_then_weave().simulate(3, 1)
    hard = presets.alphabeta(motion, sensor)(tracks.z, tracks.prior).mean
    errors = []
    for temperature in (0.1, 1e-7):
        f = presets.alphabeta(motion, sensor, temperature=temperature)
        errors.append((f(tracks.z, tracks.prior).mean - hard).abs().max().item())
    assert errors[1] < 1e-3 < errors[0]
    f = presets.alphabeta(motion, sensor, temperature=0.2, learn="all")
    f(tracks.z, tracks.prior).mean[..., :3].sub(tracks.truth[..., :3]).square().mean().backward()
    assert all((p.grad != 0).all() for name, p in f.named_parameters() if name != "motion.q.raw")


def test_steps_of_time_may_differ_where_the_gains_know_their_period():
    g = torch.Generator().manual_seed(0)
    dt = torch.tensor([0.5, 8.0] * 60, dtype=torch.float64)
    truth = 200 * dt.cumsum(0)[:, None].expand(120, 3)
    z = truth + 20 * torch.randn(50, 120, 3, generator=g).double()
    motion, sensor = ConstantVelocity(1.0, 3), Position(20.0, dims=3)
    prior = Gaussian(torch.zeros(6).double(), torch.eye(6).double())
    for f in (AlphaBeta(motion, sensor, gains.kalata(1.5), period=8.0), presets.alphabeta(motion, sensor, period=8.0)):
        e = f(z, prior, dt=dt)
        assert (e.mean[..., :3] - truth)[:, 40:].square().mean().sqrt() < 20
    assert not e.info.rejected[:, 10:].any()


def test_two_gains_leave_an_acceleration_at_zero_compiled_or_not():
    z = torch.cumsum(800 * torch.ones(2, 20, 2), 1).double()
    narrow = AlphaBeta(ConstantVelocity(1.0), Position(20.0), gains.kalata(0.5))
    slow, fast = (AlphaBeta(ConstantAcceleration(1.0), Position(20.0), gains.kalata(0.5)) for _ in range(2))
    e = narrow(z, Gaussian(torch.zeros(4).double(), torch.eye(4).double()))
    for f in (slow, fast.compile()):
        wide = f(z, Gaussian(torch.zeros(6).double(), torch.eye(6).double()))
        torch.testing.assert_close(wide.mean[..., :4], e.mean)
        torch.testing.assert_close(wide.scale_tril[..., :4, :4], e.scale_tril)
        assert (wide.mean[..., 4:] == 0).all()


def test_missing_steps_are_a_longer_step():
    z = torch.cumsum(800 * torch.ones(20, 3), 0).double() + 20 * torch.randn(20, 3).double()
    gaps = torch.full((20, 4, 3), torch.nan, dtype=torch.float64)
    gaps[:, 3] = z
    prior = Gaussian(torch.zeros(6).double(), torch.eye(6).double())
    for f in (presets.alphabeta(ConstantVelocity(1.0, 3), Position(20.0, dims=3)),
              AlphaBeta(ConstantVelocity(1.0, 3), Position(20.0, dims=3), gains.kalata(0.5))):  # fmt: skip
        once, often = f(z, prior, dt=4.0), f(gaps.flatten(0, 1), prior, dt=1.0)
        torch.testing.assert_close(often.mean[3::4], once.mean)
        torch.testing.assert_close(often.scale_tril[3::4], once.scale_tril)


def test_values_may_bring_a_batch_of_their_own():
    z = level_then_weave().simulate(2, 0).z[:, 60:]
    motion, sensor = ConstantVelocity(1.0, 3), Position(20.0, dims=3)
    prior = Gaussian(torch.zeros(2, 6).double(), torch.eye(6).double())
    values = torch.linspace(2.5, 4, 3)[:, None].double()
    e = presets.alphabeta(motion, sensor, manoeuvre=values, outlier=20.0)(z, prior)
    assert e.mean.shape == (3, 2, 60, 6)
    for i in range(3):
        own = presets.alphabeta(motion, sensor, manoeuvre=values[i, 0].item(), outlier=20.0)(z, prior)
        torch.testing.assert_close(e.mean[i], own.mean)
        torch.testing.assert_close(e.scale_tril[i], own.scale_tril)


def test_after_a_long_gap_it_starts_anew():
    z = torch.cat([torch.arange(20.0) * 100, 5000 - torch.arange(20.0) * 100]).double()[:, None]
    dt = torch.ones(40).double()
    dt[20] = 600.0
    e = presets.alphabeta(LINE, SENSOR, max_gap=60.0)(z, PRIOR, dt=dt)
    assert e.info.restarted[:, 0].nonzero().tolist() == [[20]]
    assert not e.info.rejected.any()
    torch.testing.assert_close(e.mean[21:, 0], z[21:, 0])
    assert e.mean[30, 1].item() == pytest.approx(-100)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: AlphaBetaBank(LINE, Position(1.0)), "motion: expected"),
        (lambda: AlphaBetaBank(CoordinatedTurn(0.1, 1.0), Position(1.0)), "motion: expected"),
        (lambda: presets.alphabeta(ConstantVelocity(1.0), Bearings(0.1)), "sensor: expected a Position"),
        (lambda: AlphaBetaBank(LINE, SENSOR, gains.kalata(tensor(0.1, 0.5))), "the fastest first"),
        (lambda: AlphaBetaBank(LINE, SENSOR, gains.levels(3)), "gains: expected two for constant velocity"),
        (lambda: AlphaBetaBank(LINE, SENSOR, outlier=1.0), "outlier: expected"),
        (lambda: AlphaBetaBank(LINE, SENSOR, level_shares=[0.5, 0.2]), "level_shares"),
        (lambda: AlphaBetaBank(LINE, SENSOR, detect="polar"), "detect"),
        (lambda: AlphaBetaBank(LINE, SENSOR, onset="late"), "onset"),
        (lambda: AlphaBetaBank(LINE, SENSOR, max_gap=0.0), "max_gap"),
        (lambda: AlphaBetaBank(LINE, SENSOR, period=0.0), "period"),
        (lambda: AlphaBetaBank(LINE, SENSOR, temperature=-1.0), "temperature"),
        (lambda: gains.kalata(0.0), "index"),
        (lambda: gains.critically_damped(1.5), "theta"),
        (lambda: level_then_weave("many"), "outliers"),
    ],
)
def test_what_does_not_fit_is_named(make, said):
    with pytest.raises(ValueError, match=said):
        make()


# ---------------------------------------------------------------- the experiment


def figures(e, truth):
    """Along x: RMSE in 20-73 s and 74-120 s, mean and median run; good and planted measurements rejected; restarts."""
    error = (e.mean - truth)[..., 0].square()
    rejected = e.info.rejected[..., 0].double()
    good = rejected[:, [96, 97, 98, 101, 102, 103]].mean(0).max().item()
    planted = rejected[:, [99, 100]].mean(0).min().item()
    level, manoeuvre = error[:, 19:73].mean().sqrt().item(), error[:, 73:].mean(1).sqrt()
    return (
        level,
        manoeuvre.mean().item(),
        manoeuvre.median().item(),
        good,
        planted,
        e.info.restarted[..., 0].sum().item(),
    )


def test_the_papers_bank_errs_as_much_as_it_should():
    tracks = level_then_weave().simulate(400, 5)
    motion, sensor = ConstantVelocity(1.0, 3), Position(20.0, dims=3)
    prior = Gaussian(torch.zeros(6).double(), torch.eye(6).double())
    with torch.no_grad():
        e = presets.alphabeta(motion, sensor, **OPTIONS)(tracks.z, prior)
    level, mean, median, good, planted, restarts = figures(e, tracks.truth[..., :6])
    assert level == pytest.approx(10.7, abs=0.25)
    assert 33 < median < 43
    assert mean < 125
    assert 0.02 < good < 0.12
    assert planted > 0.99
    assert restarts < 0.08 * 400


def test_ours_keeps_the_straight_part_and_nearly_the_fast_filters_error_in_the_manoeuvre():
    scenario = level_then_weave()
    tracks, calm = scenario.simulate(400, 5), level_then_weave("none").simulate(400, 5)
    motion = ConstantVelocity(1.0, 3)
    single = [AlphaBeta(motion, scenario.sensor, gains.kalata(index)) for index in (1.5, 0.1)]
    prior = Gaussian(torch.zeros(6).double(), torch.eye(6).double())
    with torch.no_grad():
        errors = [(f(calm.z, prior).mean - calm.truth[..., :6])[..., 0].square() for f in single]
        e = presets.alphabeta(scenario.motion, scenario.sensor)(tracks.z, tracks.prior)
    level, mean, _, good, planted, restarts = figures(e, tracks.truth)
    assert level < errors[1][:, 19:73].mean().sqrt() + 0.1
    assert mean < 1.3 * errors[0][:, 73:].mean(1).sqrt().mean()
    assert (good < 0.02, planted > 0.99, restarts) == (True, True, 0)
    assert not metrics.diverged(e.mean, tracks.truth, scenario.position).any()
    assert math.isfinite(e.log_likelihood.sum().item())
