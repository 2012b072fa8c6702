"""The plain branch of FRA and the odds of the branches: what they do, and that they keep every promise of a filter."""

import pytest
import torch
from conftest import without_acceleration
from scipy.stats import chi2, norm

from torchfra import metrics, presets, scenarios
from torchfra.hyper import hypers
from torchfra.motion import ConstantSpeed, ConstantVelocity, UnknownTurn
from torchfra.sensors import Camera, Position
from torchfra.types import Gaussian

NEVER, ALWAYS = -1e6, 1e6
"""Log odds that no measurement outweighs."""
# Evidence for a jump often ends in a half: such a preference would tie, which the robust branch alone wins if hard.
THREE = {"plain": 1.0, "preference": 0.4, "provisional": "likeliest", "final": "likeliest"}
HOW = [{"temperature": 0.0}, {"temperature": 1.0}]


def estimate(f, tracks):
    return f(tracks.z, tracks.prior, u=tracks.u)


@pytest.fixture(scope="module")
def poor():
    """A bad prior: many of these first steps are abnormal, and every branch wins some."""
    tracks = without_acceleration(scenarios.bearings_outliers("std")).simulate(24, 3)
    return tracks._replace(z=tracks.z[:, :30], u=tracks.u[:30], truth=tracks.truth[:, :30])


# ---------------------------------------------------------------- what it does


@pytest.mark.parametrize("how", HOW, ids=str)
def test_a_plain_branch_that_nothing_speaks_for_is_none(make, poor, how):
    none, never = (estimate(make("fra", plain=plain, **how), poor) for plain in (None, NEVER))
    torch.testing.assert_close(never.mean, none.mean, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(never.covariance, none.covariance, rtol=1e-7, atol=1e-7)
    assert (never.info.adaptive == none.info.adaptive).all()
    assert not never.info.plain.any()
    assert not none.info.plain.any()


def test_a_plain_branch_that_always_wins_makes_the_plain_filter(make, poor):
    f = make("fra", plain=ALWAYS, provisional="likeliest", final="likeliest")
    e, expected = estimate(f, poor), estimate(make("srckf"), poor)
    torch.testing.assert_close(e.mean, expected.mean, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(e.info.provisional.mean, expected.mean, rtol=1e-9, atol=1e-6)
    assert e.info.abnormal.any()
    assert (e.info.plain == e.info.abnormal).all()


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_a_step_is_far_off_beyond_what_one_in_fifteen_hundred_exceeds(make, size):
    f, limit = make("fra"), chi2.isf(norm.sf(3.2), size)
    excess = torch.tensor([0.95 * limit, 1.2 * limit], dtype=torch.float64)  # of one element alone it is 17 % more
    assert f.is_far(excess - f.gate(excess), size).tolist() == [False, True]


@pytest.mark.slow
def test_odds_move_the_decision_to_their_side(make, poor):
    odds = (NEVER, -2.0, 0.0, 2.0, ALWAYS)
    infos = [estimate(make("fra", plain=plain), poor).info for plain in odds]
    kept = [info.plain.sum().item() for info in infos]
    assert kept == sorted(kept)
    assert 0 == kept[0] < kept[2] < kept[4]
    for info in infos:
        assert not (info.plain & info.adaptive).any()
        assert not ((info.plain | info.adaptive) & ~info.abnormal).any()


@pytest.mark.parametrize("how", HOW, ids=str)
@pytest.mark.parametrize(("odds", "branch"), [
    ((0.0, -1.0), "robust"), ((-1.0, -2.0), "adaptive"), ((1.0, 2.0), "plain"), ((0.0, 0.0), "robust"),
])  # fmt: skip
def test_with_nothing_measured_after_it_the_largest_odds_decide(make, poor, odds, branch, how):
    preference, plain = (60 * x for x in odds) if how["temperature"] else odds  # soft: no weight left for the others
    f = make("fra", preference=preference, plain=plain, provisional="likeliest", final="likeliest", **how)
    z = poor.z[:, :12].clone()
    z[:, 10] += 1.0
    z[:, 11] = torch.nan
    e = f(z, poor.prior, u=poor.u[:12])
    last = f(z[:, :11], poor.prior, u=poor.u[:11])  # here that step is the last one
    assert e.info.abnormal[:, 10].all()
    for x in (e, last):
        assert (x.info.adaptive[:, 10] == (branch == "adaptive")).all()
        assert (x.info.plain[:, 10] == (branch == "plain")).all()
    if odds != (0.0, 0.0):
        torch.testing.assert_close(e.info.provisional.mean[:, 10], e.mean[:, 10], rtol=1e-9, atol=1e-6)
        torch.testing.assert_close(last.mean[:, 10], e.mean[:, 10], rtol=1e-9, atol=1e-6)


def test_a_false_alarm_is_plain_and_then_the_plain_branch_helps():
    """No outliers, a good prior: what the gate finds abnormal is neither an outlier nor a manoeuvre."""
    scenario = scenarios.bearings_outliers("none", initial="truth")
    tracks = scenario.simulate(60, 8)

    def error(**options):
        e = estimate(presets.fra(scenario.motion, scenario.sensor, **options), tracks)
        return metrics.rmse(e.info.provisional.mean, tracks.truth, scenario.position).mean()

    srckf = estimate(presets.srckf(scenario.motion, scenario.sensor), tracks)
    least = metrics.rmse(srckf.mean, tracks.truth, scenario.position).mean()
    excess = [error(**options) / least - 1 for options in ({}, {"plain": 4.0, "provisional": "likeliest"})]
    assert excess[1] < 0.5 * excess[0]


def test_a_soft_decision_among_three_becomes_the_hard_one_as_its_temperature_falls(make, poor):
    hard, soft = (estimate(make("fra", temperature=t, **THREE), poor) for t in (0.0, 1e-7))
    assert hard.info.plain.any()
    assert hard.info.adaptive.any()
    torch.testing.assert_close(soft.mean, hard.mean, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(soft.info.provisional.mean, hard.info.provisional.mean, rtol=1e-9, atol=1e-6)
    assert (soft.info.plain == hard.info.plain).all()
    assert (soft.info.adaptive == hard.info.adaptive).all()


def test_a_branch_that_lost_its_numbers_is_not_kept(make, tracks):
    f = make("fra", plain=ALWAYS)
    state = f.init(tracks.prior)
    for k in range(4):
        state, _ = f.step(state, tracks.z[:, k], u=tracks.u[k])
    lost = Gaussian(*(torch.full_like(x, torch.nan) for x in state.plain))
    state = state._replace(plain=lost, excess=torch.full_like(state.excess, 1e9))  # surely abnormal
    after, _ = f.step(state, tracks.z[:, 4], u=tracks.u[4])
    assert after.lagged.mean.isfinite().all()


@pytest.mark.slow
def test_models_that_interact_take_it_too():
    scenario = scenarios.bearings_manoeuvre("std")
    tracks = scenario.simulate(4, 1)
    none, never, some = (
        estimate(presets.imm_fra(scenario.bank, scenario.sensor, plain=plain), tracks) for plain in (None, NEVER, 4.0)
    )
    torch.testing.assert_close(never.mean, none.mean, rtol=1e-9, atol=1e-6)
    assert some.mean.isfinite().all()
    assert (some.mean - none.mean).abs().max() > 1e-3


@pytest.mark.parametrize("name", ["provisional", "final"])
def test_an_unknown_branch_is_refused(make, name):
    with pytest.raises(ValueError, match=rf"{name}: expected one of .*'plain', 'likeliest'\), received 'best'"):
        make("fra", **{name: "best"})


def test_odds_that_are_no_number_are_refused(make):
    with pytest.raises(ValueError, match="plain: expected a number, received nan"):
        make("fra", plain=torch.nan)


# ---------------------------------------------------------------- promises


def test_odds_have_gradients_but_of_a_hard_decision(make, tracks):
    for temperature in (0.0, 1.0):
        f = make("fra", learn=("plain", "preference", "gate"), temperature=temperature, **THREE)
        estimate(f, tracks).mean.square().mean().backward()
        assert all((p.grad != 0) == (temperature > 0) for p in f.parameters())


@pytest.mark.parametrize("how", HOW, ids=str)
def test_a_batch_of_odds_and_an_ensemble_under_vmap_are_a_loop_over_them(make, tracks, how):
    odds = torch.tensor([-3.0, 0.0, 2.0], dtype=torch.float64)
    batch = estimate(make("fra", **THREE | {"plain": odds.unsqueeze(-1)}, **how), tracks)
    f = make("fra", **THREE, **how)
    call = ((tracks.z, tracks.prior), {"u": tracks.u})
    mapped = torch.func.vmap(lambda raw: torch.func.functional_call(f, {"plain.raw": raw}, *call).mean)(odds)
    for i, plain in enumerate(odds):
        alone = estimate(make("fra", **THREE | {"plain": plain.item()}, **how), tracks).mean
        torch.testing.assert_close(batch.mean[i], alone, rtol=1e-9, atol=1e-6)
        torch.testing.assert_close(mapped[i], alone, rtol=1e-9, atol=1e-6)


def test_learned_odds_load_and_those_of_two_branches_stay_as_they_were(make, tracks):
    learned, fixed = make("fra", learn=("plain",), temperature=1.0, **THREE), make("fra", **THREE | {"plain": 0.0})
    with torch.no_grad():
        learned.plain.raw += 0.7
    learned.temperature = 0.0
    fixed.load_state_dict(learned.state_dict())
    assert fixed.plain().item() == pytest.approx(1.7)
    torch.testing.assert_close(estimate(fixed, tracks).mean, estimate(learned, tracks).mean, rtol=0, atol=0)
    assert "plain" not in hypers(make("fra"))
    make("fra").load_state_dict({k: x for k, x in fixed.state_dict().items() if k != "plain.raw"})


# ---------------------------------------------------------------- tracks that fork beside tracks that do not


SEPARATE = torch.tensor([1.0, 4.0, 9.0]).double()
"""A value for each of three tracks."""
TURNS = [UnknownTurn(1.0, 0.01), UnknownTurn(9.0, 0.1)]
ABOVE = torch.tensor([0.0, 0.0, 50.0]).double()
DOWN = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]).double()


def of_a_camera(values):
    focal = 100 * torch.stack([values, values], -1)
    return presets.fra(ConstantVelocity(1.0, 3), Camera(focal, 2.0, position=ABOVE, rotation=DOWN))


UNEVEN = {
    "models that are not linear": (lambda _: presets.imm_fra(TURNS, Position(2.0)), 5),
    "values of a motion that is not linear": (lambda q: presets.fra(ConstantSpeed(q, 0.01, 2), Position(2.0)), 4),
    "values of a sensor": (of_a_camera, 6),
}


@pytest.mark.parametrize("name", UNEVEN)
def test_a_batch_in_which_some_tracks_fork_is_a_loop_over_tracks(name):
    make, n = UNEVEN[name]
    generator = torch.Generator().manual_seed(5)
    z = 4 * torch.randn(3, 8, 2, generator=generator, dtype=torch.float64)
    z[0, 3], z[2, 5] = 300.0, 300.0
    root, mean = torch.eye(n, dtype=torch.float64), torch.zeros(3, n, dtype=torch.float64)
    together = make(SEPARATE)(z, Gaussian(mean, root))
    assert together.mean.isfinite().all()
    for track, q in enumerate(SEPARATE):
        alone = make(q)(z[track], Gaussian(mean[track], root))
        torch.testing.assert_close(together.mean[track], alone.mean, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(together.covariance[track], alone.covariance, rtol=1e-9, atol=1e-9)


def test_where_no_track_forks_nothing_is_computed_for_them():
    f = presets.imm_fra(TURNS, Position(2.0)).inner
    none = torch.zeros(3, 2, dtype=torch.bool)
    assert f.where_abnormal(none, lambda: pytest.fail("computed"), (), default := torch.zeros(3, 2)) is default
