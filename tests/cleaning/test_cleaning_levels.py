"""The closed form of cleaning is Kalman's filter and smoother where there is one level and no outlier."""

import numpy as np
import oracles
import pytest
import torch

from torchfra.cleaning.closed_form import Fixes, Levels, OutlierModel
from torchfra.cleaning.parameters import estimated, fitted
from torchfra.cleaning.parts import Part
from torchfra.cleaning.process_noise import levels_up_to
from torchfra.cleaning.two_filters import filtered, two_filters

SURE = OutlierModel(after_inlier=1e-300, after_outlier=1e-300)
Q, SIGMA = 0.3, 4.0


def white(dt, q=Q):
    """The root of the process noise of one axis."""
    return np.linalg.cholesky(q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))


def one_level(batch, q=Q):
    q = torch.full((1, batch), q, dtype=torch.float64)
    return Levels(q, torch.zeros_like(q), torch.full_like(q, 60.0), torch.zeros_like(q))


@pytest.fixture
def fixes():
    """Two tracks of 30 irregular steps in the plane, with fixes that are missing."""
    rng = np.random.default_rng(3)
    gap = rng.uniform(0.3, 4.0, (30, 2))
    z = 5e4 + np.cumsum(rng.standard_normal((30, 2, 2)) * 20, 0)
    z[[4, 11, 12], :, 0] = np.nan
    gap, z = torch.from_numpy(gap), torch.from_numpy(z)
    return Fixes(z, gap, torch.full_like(gap, SIGMA**2), torch.zeros_like(gap))


def expected(fixes, axis, track):
    gap = fixes.gap[:, track].numpy()
    model = oracles.Model(
        lambda k: np.array([[1, gap[k]], [0, 1]]) if k else np.eye(2),
        lambda k: white(gap[k]) if k else np.zeros((2, 2)),
        np.array([[SIGMA]]), lambda x, k: x[:1], np.array([False]),
    )  # fmt: skip
    order = sorted(fixes.z[:, axis, track][~fixes.z[:, axis, track].isnan()][:9].tolist())
    first = order[(len(order) - 1) // 2]
    return fixes.z[:, axis, track, None].numpy(), np.array([first, 0.0]), np.diag([1e8, 1e5]), model


@pytest.mark.parametrize("track", [0, 1])
@pytest.mark.parametrize("axis", [0, 1])
def test_one_level_without_outliers_is_kalman_s_filter(fixes, axis, track):
    of = expected(fixes, axis, track)
    oracle = oracles.kalman(*of, np.array([[1.0, 0.0]]))
    found = filtered(fixes, one_level(2), SURE).belief
    np.testing.assert_allclose(found.position[axis, :, track], oracle["mean"][:, 0], rtol=1e-9)
    np.testing.assert_allclose(found.velocity[axis, :, track], oracle["mean"][:, 1], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.pp[:, track], oracle["P"][:, 0, 0], rtol=1e-6)


@pytest.mark.parametrize("track", [0, 1])
def test_both_ways_together_are_the_least_squares_solution_of_the_whole_track(fixes, track):
    oracle = oracles.whole_track(*expected(fixes, 0, track))
    found = two_filters(fixes, one_level(2), SURE).belief
    # The two priors, one for each end, are worth next to nothing, but not nothing.
    np.testing.assert_allclose(found.position[0, :, track], oracle["mean"][:, 0], atol=0.02)
    np.testing.assert_allclose(found.velocity[0, :, track], oracle["mean"][:, 1], atol=0.02)
    np.testing.assert_allclose(found.pp[:, track], oracle["P"][:, 0, 0], rtol=1e-3)
    np.testing.assert_allclose(found.vv[:, track], oracle["P"][:, 1, 1], rtol=1e-3)


def test_levels_that_are_alike_are_one_level(fixes):
    several = Levels(*(x.repeat(3, 1) for x in one_level(2)))
    several = several._replace(log_share=several.log_share - np.log(3))
    one, three = two_filters(fixes, one_level(2)), two_filters(fixes, several)
    torch.testing.assert_close(three.belief.position, one.belief.position, rtol=1e-12, atol=1e-6)
    torch.testing.assert_close(three.outlier, one.outlier, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(three.predictions.log_likelihood, one.predictions.log_likelihood, rtol=1e-9, atol=1e-9)


def test_time_that_runs_backwards_gives_the_same_track_backwards(fixes):
    forth, back = two_filters(fixes, one_level(2), SURE), two_filters(fixes.backwards(), one_level(2), SURE)
    torch.testing.assert_close(back.belief.position.flip(1), forth.belief.position, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(-back.belief.velocity.flip(1), forth.belief.velocity, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(back.belief.pp.flip(0), forth.belief.pp, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize(("period", "change"), [(1.0, 3.0), (7200.0, 6.0)])
def test_no_process_noise_changes_a_velocity_by_more_than_a_target_can(period, change):
    acceleration, fastest, period = (torch.tensor([x], dtype=torch.float64) for x in (3.0, 6.0, period))
    levels = levels_up_to(acceleration, fastest, period, 8)
    assert (levels.q.amax() * period).sqrt().item() == pytest.approx(change)
    assert (levels.q[:8].diff(dim=0) > 0).all()


@pytest.mark.parametrize(
    ("period", "walks"), [(1.0, False), (15.0, False), (15.1, True), (1000.0, True), (1001.0, False)]
)
def test_targets_walk_at_random_up_to_their_speed_between_fixes_that_are_rare_but_not_too_rare(period, walks):
    acceleration, fastest, period = (torch.tensor([x], dtype=torch.float64) for x in (3.0, 6.0, period))
    ways = (levels_up_to(acceleration, fastest, period, 8, steady=1000.0).walk * period).sqrt()
    assert ways.max().item() == pytest.approx(walks * 6.0 * period.item())


@pytest.mark.parametrize(("period", "walks"), [(14.9, False), (15.0, True)])
def test_vehicles_whose_corners_take_as_long_walk_from_15_s_on(period, walks):
    acceleration, fastest, period = (torch.tensor([x], dtype=torch.float64) for x in (6.0, 60.0, period))
    assert bool((levels_up_to(acceleration, fastest, period, 8).walk > 0).any()) == walks


@pytest.mark.parametrize(("begins", "lasts"), [(0.1, 0.0), (0.03, 0.6), (0.0, 0.0)])
def test_how_likely_outliers_are_after_clean_fixes_and_after_outliers_is_found(begins, lasts):
    rng, steps, batch = np.random.default_rng(1), 200, 8
    wrong = np.zeros((steps, batch), bool)
    for k in range(1, steps):
        wrong[k] = rng.random(batch) < np.where(wrong[k - 1], lasts, begins)
    z = SIGMA * rng.standard_normal((steps, 2, batch)) * np.where(wrong, 100, 1)[:, None]
    gap = torch.ones(steps, batch, dtype=torch.float64)
    fixes = Fixes(torch.from_numpy(z), gap, gap, torch.zeros_like(gap))
    sigma = torch.full_like(gap[0], SIGMA)
    part = Part(fixes, one_level(batch, 1e-4), sigma, torch.zeros_like(sigma), sigma, sigma, sigma < 0)
    owner = torch.zeros(batch, dtype=torch.long)  # one track in eight rows
    (found,) = fitted([part], owner, find_sigma=False, find_q=False)
    clean, after = (~wrong[:-1]).sum(), wrong[:-1].sum()
    begun, lasted = (wrong[1:] & ~wrong[:-1]).sum(), (wrong[1:] & wrong[:-1]).sum()
    expected = (4.5 + begun) / (300 + clean), (10.5 + lasted) / (30 + after)
    assert found.model.after_inlier[0].item() == pytest.approx(expected[0], rel=0.1, abs=0.005)
    assert found.model.after_outlier[0].item() == pytest.approx(expected[1], rel=0.1, abs=0.05)


def test_a_fix_is_an_outlier_where_its_position_or_its_height_is_one():
    rng, steps = np.random.default_rng(5), 60
    gap = torch.ones(steps, 1, dtype=torch.float64)
    parts = []
    for axes, alone, beside in ((2, 0.02, 0.7), (1, 0.05, 0.8)):
        off = rng.choice([0.0, 2.0, 4.0, 8.0, 15.0], (steps, 1, 1))
        z = SIGMA * (rng.standard_normal((steps, axes, 1)) + off)
        fixes = Fixes(torch.from_numpy(z), gap, gap, torch.zeros_like(gap))
        model = OutlierModel(beside_inlier=alone, beside_outlier=beside)
        sigma, sure = torch.full((1,), SIGMA, dtype=torch.float64), torch.full((1,), torch.nan, dtype=torch.float64)
        parts.append(Part(fixes, one_level(1), sigma, torch.zeros_like(sigma), sigma, sure, sigma < 0, model))
    parts[1].fixes.z[::7] = torch.nan
    (position, height), found = estimated(parts, smooth=True)
    for k in range(steps):
        prior = position.predictions.prior_outlier[k, 0].item()
        ratio, other = (np.exp(of.evidence[k, 0].item()) for of in (position, height))
        none, alone, beside = 1 - prior, 0.05, 0.8
        if k % 7 == 0:  # there is no height
            some = prior * ratio
        else:
            some = none * alone * other + prior * ratio * (1 - beside + beside * other)
            none *= 1 - alone
        assert found[k, 0].item() == pytest.approx(some / (none + some), rel=1e-9)


@pytest.mark.parametrize("period", [5.0, 600.0, 3600.0])
@pytest.mark.parametrize("q", [None, 1e-4, 1e4, 1e8])
def test_the_chain_of_levels_is_the_exponential_of_its_rates_whatever_q_is_told(period, q):
    gap = torch.tensor([period], dtype=torch.float64)
    fastest, hardest = torch.tensor([300.0]).double(), torch.tensor([9.0]).double()
    levels = levels_up_to(hardest, fastest, gap, 7, q)
    restart, duration = levels.log_restart.exp()[:, 0], levels.duration[:, 0]
    count = len(restart)
    rates = (restart - torch.eye(count)) / duration.unsqueeze(1)
    each = torch.eye(count, dtype=torch.float64)
    lasted, _, follow = levels.chain.over(*levels.chain.shares(gap.expand(count, 1)), each.unsqueeze(-1))
    torch.testing.assert_close((lasted + follow)[..., 0], torch.matrix_exp(rates * period), rtol=0, atol=1e-8)
