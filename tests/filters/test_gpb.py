"""GPB becomes the filters it generalises, weighs hypotheses by what comes after, and learns what it is asked to."""

import math

import alike
import pytest
import torch
from gpb_cases import ALMOST_NONE, ANCHORS, FEWER, MOTION, PRIOR, SENSORS, STEPS, VALUES, close, measured, same, tensor
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from torchfra import metrics, presets, scenarios, tree
from torchfra.association import Clutter
from torchfra.filters.gpb.noise import NoiseScale
from torchfra.hyper import hypers
from torchfra.metrics import nees, rmse
from torchfra.motion import Augmented, Bank, ConstantVelocity, CoordinatedTurn, GaussMarkov, Odometry
from torchfra.scenarios import as_stated
from torchfra.sensors import Position, Ranges
from torchfra.types import Gaussian

# ---------------------------------------------------------------- what it generalises


@pytest.mark.parametrize("name", ["position", "bearings"])
def test_without_outliers_jumps_and_poor_starts_one_level_is_srckf(name):
    z = measured(name, outliers=False)
    e = presets.gpb(MOTION, SENSORS[name], **ALMOST_NONE)(z, PRIOR)
    expected = presets.srckf(MOTION, SENSORS[name])(z, PRIOR)
    close(e.mean, expected.mean)
    close(e.covariance, expected.covariance)
    close(e.nis, expected.nis)
    close(e.log_likelihood, expected.log_likelihood)
    close(e.info.lagged.mean, expected.mean, 1e-8)


def test_blocks_of_a_sensor_that_bends_linearise_anew_and_that_matters_little():
    z = measured("ranges", outliers=False)
    e = presets.gpb(MOTION, SENSORS["ranges"], **ALMOST_NONE)(z, PRIOR)
    expected = presets.srckf(MOTION, SENSORS["ranges"])(z, PRIOR)
    std = expected.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((e.mean - expected.mean).abs() < 0.5 * std).all()
    assert ((e.mean - expected.mean).abs() < 0.15 * std)[:, 5:].all()


def test_blocks_of_a_linear_sensor_one_after_the_other_are_all_at_once():
    together, apart, z = Position(5.0), Position(5.0), measured(outliers=False)
    apart.blocks = ((1,), (0,))
    e, expected = (presets.gpb(MOTION, s, **ALMOST_NONE)(z, PRIOR) for s in (apart, together))
    close(e.mean, expected.mean)
    close(e.covariance, expected.covariance)
    close(e.log_likelihood, expected.log_likelihood)


def test_without_outliers_and_jumps_a_bank_is_imm_srckf():
    motions = [MOTION, ConstantVelocity(0.1, orders=3), CoordinatedTurn(math.pi / 20, 0.1, orders=3)]
    stay, renew = tensor([0.6, 0.8, 0.8]), tensor([0.5, 0.25, 0.25])
    matrix, z = stay.diag() + (1 - stay).unsqueeze(-1) * renew, measured(outliers=False)
    e = presets.gpb(motions, SENSORS["position"], **ALMOST_NONE)(z, PRIOR)
    initial = renew / (1 - stay) / (renew / (1 - stay)).sum()
    expected = presets.imm_srckf(motions, SENSORS["position"], transition=matrix, initial=initial)(z, PRIOR)
    close(e.mean, expected.mean)
    close(e.covariance, expected.covariance)
    close(e.info.probabilities[..., :3], expected.info.probabilities)
    close(e.log_likelihood, expected.log_likelihood)


def test_a_bank_of_one_is_the_motion_itself():
    z = measured()
    one, *banks = (presets.gpb(m, SENSORS["position"], **VALUES)(z, PRIOR) for m in (MOTION, [MOTION], Bank([MOTION])))
    for bank in banks:
        same(one, bank)


# ---------------------------------------------------------------- what it knows


def first_regimes(stay, restart, motions=1):
    """Probabilities of the regimes before the first step: two levels, other motions, a jump, settled."""
    options = {"noise_levels": (0.1, 10.0), "jump_factors": (200.0,), "self_transition": stay, "restart": restart}
    f = presets.gpb([MOTION, ConstantVelocity(0.1, orders=3)][:motions], SENSORS["position"], **options)
    return f.init(PRIOR).log_weights.exp().sum(-2)


def test_regimes_begin_as_often_as_the_chain_has_them_in_the_long_run():
    stay, restart = tensor([0.95, 0.8, 0.9]), tensor([0.5, 0.3, 0.15])
    chain = stay.diag() + (1 - stay).unsqueeze(-1) * restart / restart.sum()
    found = first_regimes((*stay.tolist(), 0.5), (*restart.tolist(), 0.05), 2)
    close(found[:3], torch.linalg.matrix_power(chain, 1000)[0])
    assert (found[3:] == 0).all()  # no target has just jumped


def test_a_regime_that_begins_and_never_ends_is_there_from_the_first_step_on():
    found = first_regimes((1.0, 0.8, 1.0, 0.5), (0.5, 0.3, 0.1, 0.1), 2)
    close(found, tensor([0.5, 0.0, 0.1, 0.0, 0.0, 0.0]) / 0.6)
    assert first_regimes((0.9, 1.0, 0.9, 0.5), (0.5, 0.0, 0.4, 0.1))[1] == 0  # it never begins


@pytest.mark.slow
@given(
    seed=st.integers(0, 1000), name=st.sampled_from(sorted(SENSORS)), spread=st.floats(1.0, 1e4),
    outlier=st.floats(0.001, 0.5), jump=st.floats(1e-8, 0.05),
)  # fmt: skip
@settings(deadline=None, max_examples=10)
def test_probabilities_are_probabilities(seed, name, spread, outlier, jump):
    noise = torch.randn(2, STEPS, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    z = measured(name, seed=seed)
    z = z + spread * SENSORS[name].std() * noise * (noise > 1)
    options = VALUES | {
        "restart": (0.5, 0.3, 0.2 - jump, jump),
        "outlier_transition": ((1 - outlier, outlier), (0.6, 0.4)),
    }
    e = presets.gpb(MOTION, SENSORS[name], **options)(z, PRIOR)
    for of in (e.info.probabilities, e.info.outlier):
        assert ((of >= 0) & (of <= 1 + 1e-12)).all()
    close(e.info.probabilities.sum(-1), torch.ones(2, STEPS).double(), 1e-12)
    assert e.info.outlier.shape == (2, STEPS, len(SENSORS[name].blocks))


def test_later_measurements_tell_an_outlier_from_a_jump():
    t = torch.arange(1.0, 21.0).double()
    straight = torch.stack([9 * t, torch.full_like(t, 100)], -1)
    gone, back = straight.clone(), straight.clone()
    gone[14:, 1] += 60  # twelve sigma
    back[14, 1] += 60
    e = presets.gpb(MOTION, SENSORS["position"], **VALUES)(torch.stack([gone, back]), PRIOR)
    filtered, settled = e.info.filtered.mean[:, 14, 1], e.info.lagged.mean[:, 14, 1]
    close(filtered[0], filtered[1])
    assert settled[1] < settled[0]
    assert abs(settled[1] - 100) < 10
    assert abs(e.mean[0, 19, 1] - 160) < 15  # a burst of outliers is shorter


@pytest.mark.parametrize(
    ("values", "most"), [(VALUES | {"separate_levels": 0}, 0.2), ({}, 0.5)], ids=["own", "default"]
)
def test_only_the_block_that_is_wrong_is_an_outlier(values, most):
    z = measured("ranges", outliers=False)
    z[:, 8, 2] += 100
    outlier = presets.gpb(MOTION, SENSORS["ranges"], **values)(z, PRIOR).info.outlier
    assert (outlier[:, 8, 2] > 0.99).all()
    assert (outlier[:, 8, [0, 1, 3]] < most).all()


def test_outliers_come_in_runs_where_the_chain_says_so():
    z = measured(outliers=False)
    z[:, 8:11] += 20
    once, runs = (
        presets.gpb(MOTION, SENSORS["position"], **VALUES | {"outlier_transition": ((0.95, 0.05), (1 - still, still))})(
            z, PRIOR
        )
        for still in (0.05, 0.8)
    )
    assert (runs.info.outlier[:, 9] > once.info.outlier[:, 9]).all()


def test_blocks_may_come_in_any_order():
    z = measured("ranges", outliers=False)
    z[:, 8, 2] += 100
    order = [2, 0, 3, 1]
    turned = Ranges(ANCHORS[order], 2.0)
    cases = ((SENSORS["ranges"], z), (turned, z[..., order]))
    e, other = (presets.gpb(MOTION, sensor, **VALUES)(x, PRIOR) for sensor, x in cases)
    std = e.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    apart = (e.mean - other.mean).abs() / std
    assert (apart < 0.8).all()  # from a prior so wide that it matters which block has what ranges bend
    assert (apart[:, 2:] < 0.4).all()
    assert ((e.info.outlier[..., order] - other.info.outlier).abs() < 0.3).all()


def test_it_does_not_matter_which_block_is_missing():
    ranges = [Ranges(ANCHORS[list(order)], 2.0) for order in ((0, 1), (1, 0))]
    z = measured("ranges", outliers=False)[:1, :1, :2]
    z[..., 0] = torch.nan
    e, other = (presets.gpb(MOTION, sensor)(x, PRIOR) for sensor, x in zip(ranges, (z, z.flip(-1)), strict=True))
    torch.testing.assert_close(e.covariance, other.covariance)


def test_nothing_measured_is_a_prediction_that_jumps_nowhere():
    z = measured()
    z[:, 10:] = torch.nan
    f = presets.gpb(MOTION, SENSORS["position"], **VALUES)
    e, one = f(z, PRIOR), torch.tensor(1.0).double()
    matrix, noise = MOTION.transition(one), MOTION.process_noise(one)
    for k in range(10, STEPS):
        level = (e.info.probabilities[:, k] * tensor([0.1, 30, 30, 1, 30])).sum(-1)[:, None, None]
        close(e.mean[:, k], e.mean[:, k - 1] @ matrix.mT)
        close(e.covariance[:, k], matrix @ e.covariance[:, k - 1] @ matrix.mT + level * noise @ noise.mT)
    assert (e.nis[:, 10:] == 0).all()
    close(1 + e.log_likelihood[:, 10:], torch.ones(2, 5).double(), 1e-12)


def test_lag_chooses_between_the_filtered_and_the_settled_estimate():
    z = measured()
    now, later = (presets.gpb(MOTION, SENSORS["position"], lag=lag, **VALUES)(z, PRIOR) for lag in (0, 1))
    close(now.mean, now.info.filtered.mean, 0)
    close(later.scale_tril, later.info.lagged.scale_tril, 0)
    close(now.info.lagged.mean, later.mean, 0)
    close(later.info.lagged.mean[:, -1], later.info.filtered.mean[:, -1], 0)
    assert (now.mean - later.mean)[:, :-1].abs().max() > 1


# ---------------------------------------------------------------- values


def test_every_value_learns():
    f = presets.gpb(MOTION, SENSORS["position"], learn="all", **VALUES)
    paths = set(hypers(f))
    assert {p.removesuffix(".raw") for p, _ in f.named_parameters()} == paths
    assert {path.rpartition(".")[2] for path in paths} == {"q", "std", *VALUES} - {"noise"}
    f = presets.gpb(MOTION, SENSORS["position"], learn=("prior_outlier", "self_transition"), **VALUES)
    assert {p for p, _ in f.named_parameters()} == {"prior_outlier.raw", "regimes.self_transition.raw"}
    assert not list(MOTION.parameters())


class Shifted(Position):
    """A position whose forward is its own: no matrix times the state."""

    def forward(self, x, u=None):
        return super().forward(x) + 100.0


def test_a_sensor_with_a_forward_of_its_own_is_not_taken_for_linear():
    z = torch.randn(3, 8, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    prior = Gaussian(torch.zeros(3, 4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    plain, shifted = (presets.gpb(ConstantVelocity(1.0), sensor(2.0)) for sensor in (Position, Shifted))
    torch.testing.assert_close(plain(z, prior).mean, shifted(z + 100, prior).mean)


# ---------------------------------------------------------------- what a target may do


STD, TURNING, TURNS = 10.0, 80, 20
AHEAD = Gaussian(torch.tensor([0.0, 0, 40, 0]).double(), torch.diag(torch.tensor([STD, STD, 3, 3]).double()))


def turn(outliers=0.0):
    """40 m/s and a half turn at 10 deg/s, by fixes of 10 m, some of which may be 100 m off."""
    rng = torch.Generator().manual_seed(5)
    rate = torch.zeros(TURNING, dtype=torch.float64)
    rate[40:58] = math.radians(10.0)
    heading = rate.cumsum(0)
    truth = (40 * torch.stack([heading.cos(), heading.sin()], -1)).cumsum(0).expand(TURNS, -1, -1)
    noise = torch.randn(truth.shape, dtype=torch.float64, generator=rng)
    wrong = torch.rand(TURNS, TURNING, 1, dtype=torch.float64, generator=rng) < outliers
    return truth, truth + STD * torch.where(wrong, 10.0, 1.0) * noise


def gpb(manoeuvres, motion=None, **options):
    return presets.gpb(
        motion or ConstantVelocity(0.1, continuous=True), Position(STD), manoeuvres=manoeuvres, **options
    )


@pytest.mark.slow
@pytest.mark.parametrize("word", ["some", "hard"])
def test_a_hard_turn_of_one_motion_is_not_taken_for_outliers(word):
    (truth, plain), (_, some) = turn(), turn(0.05)
    for error in (gpb(word)(torch.stack([plain, some]), AHEAD).mean[..., :2] - truth).norm(dim=-1):
        assert error.square().mean() < (2 * STD) ** 2
        assert error[:, 60:].median() < 2 * STD


@pytest.mark.slow
def test_smoothed_a_hard_turn_is_nearer_than_filtered():
    truth, z = turn()
    smoothed = gpb("hard").smooth(z, AHEAD)
    filtered, later = (rmse(e.mean, truth, slice(0, 2)).square().mean() for e in (smoothed.info.filtered, smoothed))
    assert later < 0.7 * filtered


@pytest.mark.parametrize("word", ["none", "hard"])
def test_where_the_model_holds_each_is_a_kalman_filter(word):
    scenario = as_stated("velocity", index=0.1, steps=60)
    tracks = scenario.simulate(100, 11)
    f = presets.gpb(scenario.motion, scenario.sensor, manoeuvres=word)
    found, plain = (g(tracks.z, tracks.prior) for g in (f, presets.srckf(scenario.motion, scenario.sensor)))
    errors = [rmse(e.mean, tracks.truth, scenario.position)[20:].mean() for e in (found, plain)]
    assert errors[0] < 1.02 * errors[1]
    assert 0.9 < nees(found, tracks.truth)[:, 20:].mean() / 4 < 1.1


def test_with_none_a_target_moves_as_it_is_stated_to_and_outliers_are_still_found():
    _, z = turn()
    z = z.clone()
    z[:, 20] += 300
    e = gpb("none")(z[:, :30], AHEAD)
    assert e.info.probabilities.shape[-1] == 1
    assert (e.info.outlier[:, 20] > 0.99).all()


def test_what_is_given_wins_over_the_word():
    f = gpb("none", noise_levels=(2.0,))
    assert f.regimes.noise_levels().tolist() == [2.0]


@pytest.mark.slow
def test_compiled_hard_manoeuvres_are_the_same_with_the_same_gradients():
    line = ConstantVelocity(0.1, dims=1, continuous=True)  # and no bank, for the compiler's time
    prior = Gaussian(torch.zeros(2).double(), torch.diag(torch.tensor([10, 40]).double()))
    z, found = turn(0.05)[1][:3, 36:46, 1:], []
    for compiled in (False, True):
        values = {"outlier_sizes": (100.0,), "outlier_shares": (1.0,), "adaptive_largest_size": False}
        learn = ("manoeuvre_factors", "noise_levels")
        f = presets.gpb(line, Position(STD, dims=1), manoeuvres="hard", learn=learn, **values)
        f = f.compile() if compiled else f
        e = f(z - z[:, :1], prior)
        (e.mean.square().sum() + e.info.filtered.mean.square().sum()).backward()
        found.append([e.mean, e.covariance, e.info.outlier, *(p.grad for p in f.parameters())])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-9 * float(one.detach().abs().max()))


def test_an_unknown_word_is_an_error():
    with pytest.raises(ValueError, match="manoeuvres: expected one of none, jumps, slips, some, hard, received 'wild'"):
        gpb("wild")


def test_a_motion_that_measures_itself_slips_and_has_no_manoeuvres_unless_it_is_asked_for_some():
    own, plain = Odometry(0.01, 1e-4, 1e-6), ConstantVelocity(0.1)
    levels = {
        name: presets.gpb(motion, Position(STD), **options).regimes.kinds.count("level")
        for name, motion, options in (
            ("odometry", own, {}), ("with a bias", Augmented(own, GaussMarkov(1.0, 60.0)), {}),
            ("asked for", own, {"manoeuvres": "some"}), ("any other", plain, {}),
        )
    }  # fmt: skip
    assert levels == {"odometry": 2, "with a bias": 2, "asked for": 6, "any other": 6}


# ---------------------------------------------------------------- noise that is learned


RANGES = Ranges(ANCHORS[:2], 2.0)


def learned(sensor=RANGES, **options):
    values = VALUES | {"noise": "learned", "noise_doubt": 0.9, "noise_memory": 8.0, "noise_least": 0.0}
    return presets.gpb(MOTION, sensor, **values | options)


def seen(runs=3):
    """Ranges of which some are missing."""
    return measured("ranges", runs)[..., :2]


def position_rmse(estimate, tracks):
    return metrics.rmse(estimate.mean, tracks.truth, slice(0, 2)).mean().item()


@pytest.mark.slow
@pytest.mark.parametrize("stated", [0.5, 2.0])
def test_noise_that_is_stated_twice_off_is_found(stated):
    cell = scenarios.as_stated("velocity", index=0.1, std=stated)
    tracks = cell.simulate(runs=32, seed=71)
    f = presets.gpb(cell.motion, cell.sensor, noise="learned", noise_least=0.0).compile()
    best, found = (g(tracks.z, tracks.prior, dt=cell.dt) for g in (presets.iaukf(cell.motion, cell.sensor), f))
    assert position_rmse(found, tracks) < 1.08 * position_rmse(best, tracks)
    assert 0.6 < found.info.noise[:, -1].log().mean().exp() * stated**2 < 1.6


@pytest.mark.slow
def test_noise_that_is_stated_right_costs_little():
    cell = scenarios.as_stated("velocity", index=0.1)
    tracks = cell.simulate(runs=64, seed=72)
    each = (presets.gpb(cell.motion, cell.sensor, noise=noise).compile() for noise in ("stated", "learned"))
    stated, found = (f(tracks.z, tracks.prior, dt=cell.dt) for f in each)
    assert position_rmse(found, tracks) < 1.01 * position_rmse(stated, tracks)
    assert (stated.info.noise == 1).all()


@pytest.mark.slow
def test_a_target_that_moves_more_than_stated_is_not_taken_for_noise():
    cell = scenarios.as_stated("velocity", index=0.1, q=0.01)
    tracks = cell.simulate(runs=32, seed=73)
    options = {"noise": "stated"}, {"noise_least": 0.0}, {"noise_least": 1.0}
    each = (presets.gpb(cell.motion, cell.sensor, **x).compile() for x in options)
    stated, *others = (f(tracks.z, tracks.prior, dt=cell.dt) for f in each)
    for found in others:
        assert position_rmse(found, tracks) < 1.05 * position_rmse(stated, tracks)
        assert found.info.noise[:, -1].log().mean().exp() < 1.3


@pytest.mark.slow
def test_noise_is_never_below_its_least_and_follows_what_is_above():
    below, above = (scenarios.as_stated("velocity", index=0.1, std=std) for std in (2.0, 0.5))
    for cell, low, high in ((below, 0.49, 0.6), (above, 0.6 * 4, 1.6 * 4)):
        tracks = cell.simulate(runs=16, seed=74)
        noise = (
            presets.gpb(cell.motion, cell.sensor, noise="learned")
            .compile()(tracks.z, tracks.prior, dt=cell.dt)
            .info.noise
        )
        assert (noise > 0.4999).all()
        assert low < noise[:, -1].log().mean().exp() < high


def test_an_outlier_at_the_first_measurement_says_nothing_about_the_noise():
    f, z = presets.gpb(ConstantVelocity(0.01), Position(2.0), noise="learned"), torch.zeros(8, 6, 2).double()
    z += 2 * torch.randn(z.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    z[:, 0] += 2e4
    assert (f(z, Gaussian(torch.zeros(4).double(), torch.eye(4).double())).info.noise[:, 1].log().abs() < 0.1).all()


def test_what_is_not_measured_says_nothing_about_the_noise():
    f, z = learned(), seen(1)[0]
    z[5:, 1] = math.nan
    noise = f(z, PRIOR).info.noise
    assert (noise[5:, 1] == noise[4, 1]).all()
    assert noise[-1, 0] != noise[4, 0]


def test_a_track_is_its_steps_and_smooths_alike():
    f, z = learned(**FEWER), seen()
    whole, state = f(z, PRIOR), f.init(tree.map_tensors(lambda x: x.expand(3, *x.shape), PRIOR))
    for k in range(z.shape[-2]):
        state, _ = f.step(state, z[:, k])
    alike.close(state.belief.mean, whole.mean[:, -1])
    alike.close(state.noise.log_scale.exp(), whole.info.noise[:, -1])
    alike.close(f.smooth(z, PRIOR).mean[:, -1], whole.mean[:, -1])


def test_a_step_of_another_sensor_leaves_what_was_learned_as_it_is():
    f, z = learned(), seen()[:, 0]
    state, _ = f.step(f.init(tree.map_tensors(lambda x: x.expand(3, *x.shape), PRIOR)), z)
    after, _ = f.step(state, z[..., :2] * 0 + 50.0, sensor=Position(5.0))
    assert_close(after.noise, state.noise, rtol=0, atol=0)


def test_a_forecast_has_the_noise_that_was_learned():
    f, z = learned(), seen()
    e = [learned(noise_doubt=doubt)(z, PRIOR) for doubt in (1e-6, 0.9)]
    stated = presets.gpb(MOTION, RANGES, **VALUES)(z, PRIOR)
    assert_close(e[0].nis, stated.nis, rtol=1e-5, atol=1e-5)
    assert_close(e[0].log_likelihood, stated.log_likelihood, rtol=1e-5, atol=1e-5)
    assert (e[1].log_likelihood - stated.log_likelihood).abs().max() > 0.01
    state, louder = f.init(PRIOR), f.init(PRIOR)
    louder = louder._replace(noise=louder.noise._replace(log_scale=louder.noise.log_scale + math.log(4.0)))
    each = [f.predict(x, 1.0).measurement.covariance.diagonal(dim1=-2, dim2=-1) for x in (state, louder)]
    kept = math.exp(-1 / 8.0)
    assert_close(each[1] - each[0], torch.full((2,), (4**kept - 1) * 4.0, dtype=torch.float64))


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences_and_finite_at_extreme_outliers():
    z = seen(1)[0, :5].nan_to_num(nan=100.0)

    def end(z):
        return learned()(z, PRIOR).info.noise[-1].sum()

    assert torch.autograd.gradcheck(end, z.requires_grad_(True), rtol=1e-4, atol=1e-7, fast_mode=True)
    for dtype in (torch.float32, torch.float64):
        far = seen(1)[0].to(dtype).nan_to_num(nan=100.0)
        far[3] = torch.finfo(dtype).max ** 0.45
        far.requires_grad_(True)
        e = learned()(far, tree.map_tensors(lambda x, d=dtype: x.to(d), PRIOR))
        (slope,) = torch.autograd.grad(e.info.noise.sum() + e.mean.sum(), far)
        assert e.info.noise.isfinite().all()
        assert slope.isfinite().all()


def test_in_clutter_each_target_has_learned_noise_of_its_own():
    sensor, prior = Position(5.0), tree.map_tensors(lambda x: x.expand(2, *x.shape), PRIOR)
    f = presets.jpda(MOTION, sensor, clutter=Clutter(1e6), inner=lambda motion, own: learned(own))
    mean = prior.mean.clone()
    mean[1, :2] += 400.0
    path = mean[:, None, :2] + torch.arange(1, 13, dtype=torch.float64)[:, None] * torch.tensor([9.0, 0.0])
    noise = torch.randn(2, 12, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    z = path + noise * torch.tensor([2.0, 12.0])[:, None, None]
    scans = torch.cat([z.transpose(0, 1), z[:1, :, :].transpose(0, 1) + 150.0], 1)  # (12, 3, 2), the last clutter
    state = f.init(prior._replace(mean=mean))
    for scan in scans:
        state, _ = f.step(state, scan)
    assert all(x.isfinite().all() for x in tree.flatten(state))
    known = next(x for x in walk(state) if isinstance(x, NoiseScale))
    assert known.log_scale[0] < 0 < known.log_scale[1]


def walk(x):
    """A tree's named tuples."""
    if isinstance(x, tuple):
        yield x
        for part in x:
            yield from walk(part)


def test_another_word_is_refused():
    with pytest.raises(ValueError, match=r"noise: expected one of \('stated', 'learned'\), received 'known'"):
        presets.gpb(MOTION, RANGES, noise="known")


@pytest.mark.parametrize("least", [-0.1, 1.5, math.nan])
def test_a_least_noise_that_is_no_share_is_refused(least):
    with pytest.raises(ValueError, match="noise_least: expected a number from 0 to 1, received"):
        presets.gpb(MOTION, RANGES, noise="learned", noise_least=least)


def test_gradients_are_finite_where_outliers_never_come():
    never = ((1.0, 0.0), (1.0, 0.0))
    f = presets.gpb(ConstantVelocity(0.01), Position(2.0), outlier_transition=never, learn="all").double()
    z = torch.zeros(1, 6, 2, dtype=torch.float64)
    z[:, 3] += 40.0
    f(z, Gaussian(torch.zeros(4).double(), torch.eye(4).double()), dt=1.0).log_likelihood.sum().backward()
    wrong = [name for name, x in f.named_parameters() if x.grad is not None and not bool(x.grad.isfinite().all())]
    assert not wrong
