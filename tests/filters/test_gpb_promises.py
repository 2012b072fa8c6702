"""GPB keeps what the battery does not ask: values of each track, exact gradients, what never happens, named errors."""

import copy

import pytest
import torch
from alike import close
from gpb_cases import ANCHORS, FEWER, MOTION, PRIOR, SENSORS, STEPS, VALUES, measured, same, tensor
from short_tracks import SMALL_GPB
from torch.testing import assert_close

from torchfra import presets, scenarios, tree
from torchfra.filters import GPB, Outliers, Regimes
from torchfra.gaussian import fifth_degree
from torchfra.motion import ConstantAcceleration, ConstantVelocity, Odometry, RandomWalk
from torchfra.sensors import Bearings, Position, RangeBearing, Ranges
from torchfra.types import Gaussian

SOME = SENSORS | {"two ranges": Ranges(ANCHORS[:2], 2.0)}
"""Several blocks are two at least."""


def agree(f, other, z, prior, dt):
    """Two filters have the same estimates, filtered and smoothed."""
    same = {"rtol": 1e-9, "atol": 1e-9}
    for found, right in zip(*[(g(z, prior, dt=dt), g.smooth(z, prior, dt=dt)) for g in (f, other)], strict=True):
        assert_close(found.mean, right.mean, **same)
        assert_close(found.covariance, right.covariance, **same)
        assert_close(found.log_likelihood, right.log_likelihood, **same)


def single(name, **options):
    return presets.gpb(MOTION, SOME[name], **VALUES | options)


def batches():
    """Two values of everything."""
    even = {k: tensor([VALUES[k], 0.8 * VALUES[k]]) for k in ("prior_outlier", "prior_inflation")}
    vectors = {
        k: torch.stack([tensor(v), 0.9 * tensor(v)])
        for k, v in VALUES.items()
        if k in ("noise_levels", "outlier_sizes", "jump_factors", "self_transition")
    }
    simplexes = {
        "outlier_transition": tensor([VALUES["outlier_transition"], ((0.9, 0.1), (0.5, 0.5))]),
        "outlier_shares": tensor([VALUES["outlier_shares"], (0.2, 0.3, 0.5)]),
        "restart": tensor([VALUES["restart"], (0.2, 0.2, 0.5, 0.1)]),
    }
    return even | vectors | simplexes


@pytest.mark.slow
def test_every_value_may_be_one_of_each_track():
    sensor, z, given = SOME["two ranges"], measured("ranges")[:, :6, :2], batches()
    every = presets.gpb(ConstantAcceleration(tensor([0.05, 0.2])), sensor, **given)(z, PRIOR)
    for i, q in enumerate((0.05, 0.2)):
        alone = presets.gpb(ConstantAcceleration(q), sensor, **{k: v[i] for k, v in given.items()})
        close(alone(z[i], PRIOR).mean, every.mean[i])
        close(alone(z[i], PRIOR).info.outlier, every.info.outlier[i])
    for name, values in given.items():
        first = presets.gpb(MOTION, sensor, **VALUES | {name: values[0]})(z, PRIOR).mean[0]
        close(first, presets.gpb(MOTION, sensor, **VALUES | {name: values})(z, PRIOR).mean[0])


# ---------------------------------------------------------------- gradients


@pytest.mark.slow
def test_compiled_kernels_of_ranges_give_the_same_and_the_same_gradients():
    f = presets.gpb(RandomWalk(25.0), SOME["two ranges"], **VALUES | FEWER, learn="all")  # jumps too: the battery
    z, prior = measured("ranges", 3)[:, :9, :2], (PRIOR.mean[:2], PRIOR.scale_tril[:2, :2])
    found = []
    for g in (f, copy.deepcopy(f).compile()):
        x, mean, root = (x.clone().requires_grad_() for x in (z, *prior))
        e = g(x, Gaussian(mean, root))
        (e.mean.square().mean() + e.info.lagged.mean.square().mean() + e.log_likelihood.mean()).backward()
        slopes = [torch.zeros_like(p) if p.grad is None else p.grad for p in g.parameters()]  # of what has no effect
        found.append((e.mean.detach(), e.info, x.grad, mean.grad, root.grad.tril(), slopes))
    close(*found, 1e-8)
    assert sum(bool(x.any()) for x in found[1][-1]) > 8


@pytest.mark.slow
def test_gradients_of_values_measurements_and_prior_are_those_of_finite_differences():
    f, z = single("two ranges", learn="all"), measured("ranges", 1)[0, 2:7, :2]  # with an outlier
    z[3] = torch.nan
    paths, values = zip(*((p, v.detach().clone()) for p, v in f.named_parameters()), strict=True)
    prior = Gaussian(f(z[:1], PRIOR).mean[0], PRIOR.scale_tril / 5)
    missing = z.isnan()

    def outcome(x, mean, root, *values):
        given = (torch.where(missing, torch.nan, x), Gaussian(mean, root.tril()))
        e = torch.func.functional_call(f, dict(zip(paths, values, strict=True)), given)
        return e.mean / 10, e.info.lagged.mean / 10, e.info.outlier, e.info.probabilities, e.log_likelihood

    inputs = [x.detach().clone().requires_grad_() for x in (z.nan_to_num(), *prior, *values)]
    assert torch.autograd.gradcheck(outcome, inputs, eps=1e-6, rtol=1e-4, atol=1e-5, fast_mode=True)


@pytest.mark.parametrize("name", SENSORS)
def test_gradients_are_finite_at_extreme_outliers_and_missing_data(name):
    sizes = tensor([300.0] if name == "bearings" else [1e3, 1e6, 1e12])  # half a turn
    z = measured(name).repeat(len(sizes), 1, 1)
    z[::2, 3] += sizes[:, None] * SENSORS[name].std()
    z[1::2, 6, 1] -= sizes * SENSORS[name].std()
    z.requires_grad_()
    f = single(name, learn="all")
    e = f(z, PRIOR)
    assert not e.failed.any()
    score = e.mean.square().mean() + e.scale_tril.square().mean() + e.info.lagged.mean.square().mean()
    (
        score + e.log_likelihood.mean() + e.nis.mean() + e.info.outlier.sum() + e.info.probabilities[..., 0].sum()
    ).backward()
    assert z.grad.isfinite().all()
    assert all(p.grad.isfinite().all() for p in f.parameters())


def test_gradients_are_finite_where_a_jump_is_forgotten_at_once():
    z = measured("position").repeat(2, 1, 1)
    z[:, 6:] += 1e3 * SENSORS["position"].std()
    z.requires_grad_()
    single("position", self_transition=(*VALUES["self_transition"][:-1], 0.0))(z, PRIOR).log_likelihood.sum().backward()
    assert z.grad.isfinite().all()


def test_a_state_may_be_a_single_number():
    scenario = scenarios.growth()
    tracks = scenario.simulate(3)
    estimate = presets.gpb(scenario.motion, scenario.sensor)(tracks.z[:, :50], tracks.prior, u=tracks.u[:50])
    assert not estimate.failed.any()


NEVER = {
    "no outliers": (
        {"outlier_transition": ((1.0, 0.0), (1.0, 0.0))},
        {"outlier_transition": ((1 - 1e-15, 1e-15), (1 - 1e-15, 1e-15))},
    ),
    "no bad prior": ({"prior_outlier": 0.0}, {"prior_outlier": 1e-15}),
    "no other regime": ({"restart": (1.0, 0.0, 0.0, 0.0)}, {"restart": (1 - 3e-15, *[1e-15] * 3)}),
}
"""Probabilities of 0, and nearly so."""


@pytest.mark.slow
@pytest.mark.parametrize(("never", "motions"), [*((never, 1) for never in NEVER), ("no other regime", 3)])
def test_what_never_happens_is_as_what_hardly_ever_does(never, motions):
    bank = [ConstantVelocity(q) for q in (1.0, 5.0, 0.2)][:motions]
    prior = Gaussian(torch.zeros(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    z = 2 * torch.randn(5, 10, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    nothing, hardly = (presets.gpb(bank, Position(2.0), **SMALL_GPB | values)(z, prior) for values in NEVER[never])
    for ours, expected in zip(tree.flatten(nothing), tree.flatten(hardly), strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-6, atol=1e-6)
    if motions == 1:  # for the compiler's time
        compiled = presets.gpb(bank, Position(2.0), **SMALL_GPB | NEVER[never][0]).compile()(z, prior)
        for ours, expected in zip(tree.flatten(compiled), tree.flatten(nothing), strict=True):
            torch.testing.assert_close(ours, expected, rtol=1e-10, atol=1e-10)


def test_a_level_with_a_belief_of_its_own_smooths_like_a_motion_of_its_own():
    """With a chain in seconds, a separate level is another motion with that process noise, over gaps too."""
    factor, (calm, stated, agile, jump), (a, b, c, d) = 0.01, (60.0, 30.0, 10.0, 0.5), (0.4, 0.3, 0.2, 0.1)
    sensor, q, ranges = Position(5.0), 0.5, {"jump_factors": (9.0,)}
    one = presets.gpb(
        ConstantVelocity(q), sensor, noise_levels=(factor, 1.0, 50.0), durations=(calm, stated, agile, 1.0, jump),
        restart=(a, b, c, 0.0, d), separate_levels=1, **ranges,
    )  # fmt: skip
    two = presets.gpb(
        [ConstantVelocity(q), ConstantVelocity(factor * q)], sensor, noise_levels=(1.0, 50.0),
        durations=(stated, agile, calm, jump), restart=(b, c, a, d), separate_levels=0, **ranges,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(3)
    dt = 0.5 + torch.rand(13, generator=generator, dtype=torch.float64)
    z = (dt.cumsum(0)[:, None] * torch.tensor([8.0, 2.0])).double()
    z = z + 5 * torch.randn(13, 2, generator=generator, dtype=torch.float64)
    z[8:, 1] += 6 * dt.cumsum(0)[8:] - 6 * dt.cumsum(0)[8]
    z[5] += 200.0
    z[10:12] = torch.nan
    prior = Gaussian(torch.zeros(4).double(), torch.diag(torch.tensor([20.0, 20, 9, 9]).double()))
    agree(one, two, z, prior, dt)


# ---------------------------------------------------------------- jumps


JUMP, RUNS = 25, 8
SIZES = tensor([50.0, 100, 300, 1000, 3000])
"""Standard deviations of the noise of fixes, which is 1."""


def ways(count):
    """Directions, ``(count, 2)``."""
    angle = torch.linspace(0, 6, count, dtype=torch.float64)
    return torch.stack([angle.cos(), angle.sin()], -1)


def drifting(index):
    """A filter, truth and fixes of it, as stated, and where ``RUNS`` targets of each size jump to."""
    g, count = torch.Generator().manual_seed(0), RUNS * len(SIZES)
    motion, second = ConstantVelocity(index**2, continuous=True), tensor(1.0)
    F, L = motion.transition(second), motion.process_noise(second)

    def normal(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=g)

    prior = Gaussian(torch.zeros(count, 4).double(), tensor([1.0, 1, 5, 5]).diag())
    x, path = normal(count, 4) @ prior.scale_tril, []
    for _ in range(40):
        x = x @ F.mT + normal(count, L.shape[-1]) @ L.mT
        path.append(x)
    truth = torch.stack(path, 1)
    away = SIZES.repeat_interleave(RUNS).unsqueeze(-1) * ways(count)
    return presets.gpb(motion, Position(1.0)), prior, truth, truth[..., :2] + normal(count, 40, 2), away.unsqueeze(1)


def off(estimate, place):
    """Distances from a place from the jump on, ``(5, RUNS, T)``, in sizes of jumps."""
    distance = (estimate.mean[..., :2] - place)[:, JUMP:].norm(dim=-1)
    return distance.unflatten(0, (len(SIZES), RUNS)) / SIZES[:, None, None]


@pytest.mark.parametrize("index", [0.1, 1.0])
def test_a_target_that_jumps_is_followed_with_the_fifth_measurement(index):
    f, prior, truth, z, away = drifting(index)
    z[:, JUMP:] += away
    distance = off(f(z, prior), truth[..., :2] + away)
    further = 2 if index == 1 else 0  # nearer by, the most agile level may take it for a turn sooner
    assert (distance[further:, :, :4] > 0.5).all()
    assert (distance[:, :, 4:] < 0.1).all()


@pytest.mark.parametrize("index", [0.1, 1.0])
def test_four_equal_outliers_are_not_followed(index):
    f, prior, truth, z, away = drifting(index)
    z[:, JUMP : JUMP + 4] += away
    further = 2 if index == 1 else 0  # as above
    distance = off(f(z, prior), truth[..., :2])
    assert (distance[further:] < 0.5).all()
    assert (distance[:, :, 6:] < 0.1).all()  # it is back, from wherever it was


@pytest.mark.parametrize("size", [1e5, 1e6])
def test_however_far_a_target_jumps_it_is_followed_with_the_fifth_measurement(size):
    f, prior, truth, z, _ = drifting(0.02)
    away = size * ways(len(z)).unsqueeze(1)
    z[:, JUMP:] += away
    off = (f(z, prior).mean[..., :2] - truth[..., :2] - away)[:, JUMP:].norm(dim=-1)
    assert (off[:, :4] > size / 2).all()
    assert (off[:, 4:] < 10).all()


def test_a_target_that_jumps_among_steps_of_very_different_lengths_is_followed_with_the_fifth_measurement():
    """After short steps its acceleration is unknown still, and the next long one predicts hardly anything."""
    g, motion, runs = torch.Generator().manual_seed(0), ConstantAcceleration(0.3), 20
    dt = 0.3 * (2.5 * torch.randn(40, dtype=torch.float64, generator=g).clamp(-1, 1)).exp()
    truth = dt.cumsum(0)[:, None] * tensor([9.0, 4.0])
    z = truth + torch.randn(runs, 40, 2, dtype=torch.float64, generator=g)
    first = torch.arange(runs) + 12
    later = torch.arange(40) - first[:, None]
    z = z + 1e4 * (later >= 0).unsqueeze(-1) * ways(runs).unsqueeze(1)
    prior = Gaussian(tensor([0.0, 0, 9, 4, 0, 0]), tensor([1.0, 1, 2, 2, 0.5, 0.5]).diag())
    off = (presets.gpb(motion, Position(1.0))(z, prior, dt=dt).mean[..., :2] - z).norm(dim=-1)
    assert (off[(later >= 0) & (later < 4)] > 5e3).all()
    assert (off[later >= 4] < 20).all()


@pytest.mark.parametrize("sensor", [
    Bearings(1e-4, stations=[[-1e4, 0.0], [0.0, -1e4]]), RangeBearing(tensor([1.0, 1e-4]), position=[-1e4, 0.0])
], ids=["bearings", "radar"])  # fmt: skip
def test_by_bearings_a_target_that_jumps_aslant_of_the_line_of_sight_is_followed_with_the_fifth_measurement(sensor):
    """A bearing is a product of what is along and across, which points on both axes of a belief do not show."""
    f, prior, truth, _, _ = drifting(0.04)
    runs, g = 12, torch.Generator().manual_seed(1)
    truth, away = truth[:runs], 1000 * ways(runs).unsqueeze(1)
    later = (torch.arange(truth.shape[1]) >= JUMP).unsqueeze(-1)
    place = truth[..., :2] + torch.where(later, away, 0.0)
    z = sensor(place) + sensor.measurement_noise(sensor(place)).std * torch.randn(
        *truth.shape[:2], 2, dtype=torch.float64, generator=g
    )
    f = presets.gpb(f.bank[0], sensor)
    off = (f(z, Gaussian(*(x[:runs] for x in prior))).mean[..., :2] - place)[:, JUMP:].norm(dim=-1)
    assert (off[:, :4] > 500).all()
    assert (off[:, 4:] < 10).all()


@pytest.mark.parametrize("index", [0.1, 1.0])
def test_after_the_reset_of_a_receiver_the_velocity_is_known_as_before(index):
    f, prior, truth, z, away = drifting(index)
    without = f(z, prior)
    z[:, JUMP:] += away
    jumped, plain = ((e.mean - truth)[:, JUMP + 6 :, 2:4].square().mean().sqrt() for e in (f(z, prior), without))
    assert jumped < 1.3 * plain


@pytest.mark.parametrize("index", [0.1, 0.3])
def test_smoothed_a_jump_is_where_it_came(index):
    f, prior, truth, z, away = drifting(index)
    z[:, JUMP:] += away
    truth[:, JUMP:, :2] += away
    error = (f.smooth(z, prior).mean - truth)[:, JUMP - 5 : JUMP + 5, :2].norm(dim=-1)
    far = error[2 * RUNS :]  # nearer by, it may have come with the measurement before
    assert far.square().mean().sqrt() < 2.0
    assert far.max() < 0.1 * SIZES[2]


def beside_odometry(length, size, **options):
    """Distances ``(runs, T)`` of robots, that measure their way, from where fixes are that are off by one offset."""
    g, runs, steps, std = torch.Generator().manual_seed(0), 8, 60, 3.0

    def normal(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=g)

    u = tensor([1.5, 0.0]) + 0.02 * normal(runs, steps, 2)
    truth = torch.stack([1.5 * torch.arange(1, steps + 1).double(), torch.zeros(steps).double()], -1)
    z, away = truth + std * normal(runs, steps, 2), std * size * ways(runs).unsqueeze(1)
    z[:, JUMP : JUMP + length] += away
    prior = Gaussian(torch.zeros(4).double(), tensor([1.0, 1.0, 0.05, 0.02]).diag())
    estimate = presets.gpb(Odometry(1e-2, 1e-6, 1e-7), Position(std), **options)(z, prior, u=u)
    return (estimate.mean[..., :2] - truth - away)[:, JUMP:].norm(dim=-1) / std


@pytest.mark.parametrize("size", [30.0, 1e4])
def test_beside_odometry_a_robot_that_was_carried_away_is_followed_with_the_fifth_or_sixth_measurement(size):
    distance = beside_odometry(60, size)
    assert (distance[:, :4] > 0.5 * size).all()
    assert (distance[:, 5:] < 3).all()


def test_beside_odometry_fixes_that_are_off_for_less_than_a_burst_are_not_followed():
    assert (beside_odometry(20, 30.0, burst=30) > 27).all()


# ---------------------------------------------------------------- errors


def test_the_parts_make_the_filter_that_the_preset_makes():
    regimes = Regimes(
        1,
        noise_levels=(0.1, 30.0),
        separate_levels=1,
        jump_factors=(200.0,),
        self_transition=VALUES["self_transition"],
        restart=VALUES["restart"],
    )
    outliers = Outliers(
        [[0, 1]],
        outlier_transition=VALUES["outlier_transition"],
        outlier_sizes=VALUES["outlier_sizes"],
        outlier_shares=VALUES["outlier_shares"],
        unreliable=VALUES["unreliable"],
    )
    f = GPB(MOTION, SENSORS["position"], regimes=regimes, outliers=outliers, prior_outlier=0.3, prior_inflation=50.0)
    same(f(measured(), PRIOR), presets.gpb(MOTION, SENSORS["position"], **VALUES)(measured(), PRIOR))


def numbered(argument):
    """Only what is said is a name; others, such as functions, are not the same text in every process."""
    return argument if isinstance(argument, str) else ""


@pytest.mark.parametrize(("options", "said"), [
    ({"outlier_transition": ((0.9, 0.2), (0.5, 0.5))}, "outlier_transition: expected"),
    ({"outlier_transition": (0.9, 0.1)}, r"outlier_transition: expected \(2, 2\), received \(2,\)"),
    ({"outlier_shares": (0.6, 0.3, 0.2)}, "outlier_shares: expected"),
    ({"outlier_shares": (0.6, 0.4)}, "outlier_shares: expected one for each of outlier_sizes"),
    ({"outlier_sizes": (0.9, 4.0, 100.0)}, "outlier_sizes: expected a value above 1"),
    ({"outlier_offsets": (0.0, 4.0, float("inf"))}, "outlier_offsets: expected finite numbers"),
    ({"same_offset": 1.5}, r"same_offset: expected a value in \[0, 1\]"),
    ({"noise_levels": (-1.0, 10.0)}, "noise_levels: expected"),
    ({"separate_levels": 2}, "separate_levels: expected a number from 0 to 1, or .* indices of 2 levels, received 2"),
    ({"separate_levels": (1, 1)}, "separate_levels: expected a number from 0 to 1, or .*, received .1, 1."),
    ({"separate_levels": (2,)}, "separate_levels: expected a number from 0 to 1, or .*, received .2,."),
    ({"noise_levels": 3.0}, "noise_levels: expected a sequence of numbers, received 3"),
    ({"noise_levels": ()}, "self_transition: expected"),
    ({"jump_factors": 300.0}, "jump_factors: expected a sequence of numbers, received 300"),
    ({"jump_factors": (-1.0,)}, "jump_factors: expected a value above 0"),
    ({"self_transition": (0.5, 0.5, 0.5, 1.5)}, r"self_transition: expected a value in \[0, 1\]"),
    ({"self_transition": (0.5, 0.5, 0.5)}, r"self_transition: expected \(..., 4\), received \(3,\)"),
    ({"self_transition": 0.9}, r"self_transition: expected \(..., 4\), received \(\)"),
    ({"restart": (0.5, 0.3, 0.2)}, r"restart: expected \(..., 4\), received \(3,\)"),
    ({"restart": (0.5, 0.3, 0.2, 0.1)}, "restart: expected"),
    ({"restart": (0.5, 0.3, 0.3, -0.1)}, "restart: expected"),
    ({"restart": (0.0, 0.0, 0.4, 0.6)}, r"restart: expected a probability above 0 at one of indices \[0, 1\]"),
    ({"prior_outlier": 2.0}, r"prior_outlier: expected a value in \[0, 1\]"),
    ({"prior_inflation": 0.5}, "prior_inflation: expected a value of 1 or more"),
    ({"lag": 2}, "lag: expected 0 or 1 steps, received 2"),
    ({"rule": fifth_degree}, "rule: expected one without negative weights"),
    ({"rule": "ckf"}, "rule: expected torchfra.gaussian.third_degree or the like"),
    ({"learn": ("gamma",)}, r"learn: expected 'all' or some of .*received 'gamma'"),
], ids=numbered)  # fmt: skip
def test_values_that_do_not_fit_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        presets.gpb(MOTION, SENSORS["position"], **VALUES | options)


def with_blocks(*blocks):
    sensor = Ranges(ANCHORS, 2.0)
    sensor.blocks = blocks
    return sensor


ROOT = torch.eye(4).double() + 0.2


@pytest.mark.parametrize(("motion", "sensor", "said"), [
    ([MOTION, ConstantVelocity(1.0)], Position(5.0), "models: expected motions of one state"),
    ([], Position(5.0), "models: expected motions of one state"),
    (Position(5.0), Position(5.0), "motion: expected one, several or a Bank, received Position"),
    (MOTION, MOTION, "sensor: expected an instance of torchfra's Sensor"),
    (MOTION, Position(5.0, dims=3), "sensor: expected one of at most 2 dimensions"),
    (MOTION, with_blocks((0, 1), (1, 2, 3)), "blocks: expected each of 4 elements once"),
    (MOTION, with_blocks((0, 1), (2,)), "blocks: expected each of 4 elements once"),
    (MOTION, with_blocks((0, 1), (2, 3), ()), "blocks: expected each of 4 elements once"),
    (MOTION, Ranges(ANCHORS, noise=ROOT), "sensor: expected noise that is independent between blocks"),
], ids=numbered)  # fmt: skip
def test_models_that_do_not_fit_are_named(motion, sensor, said):
    with pytest.raises(ValueError, match=said):
        presets.gpb(motion, sensor)


def test_regimes_of_other_motions_are_refused():
    regimes = Regimes(
        2,
        noise_levels=(0.1, 30.0),
        jump_factors=(200.0,),
        self_transition=VALUES["self_transition"],
        restart=VALUES["restart"],
    )
    outliers = Outliers(
        [[0, 1]], outlier_transition=VALUES["outlier_transition"], outlier_sizes=(9.0,), outlier_shares=(1.0,)
    )
    with pytest.raises(ValueError, match=r"regimes: expected those of 1 motions, received of 2"):
        GPB(MOTION, SENSORS["position"], regimes=regimes, outliers=outliers)


def test_noise_that_is_correlated_between_blocks_is_refused_before_any_work():
    f, z = presets.gpb(MOTION, SENSORS["ranges"], **VALUES), measured("ranges")
    own = torch.diag_embed(tensor([2.0, 2, 2, 2])).expand(STEPS, 4, 4)
    same(f(z, PRIOR, noise=own), f(z, PRIOR))
    same(presets.gpb(MOTION, Ranges(ANCHORS, noise=own[0]), **VALUES)(z, PRIOR), f(z, PRIOR))
    with pytest.raises(ValueError, match="noise: expected noise that is independent between blocks"):
        f(z, PRIOR, noise=ROOT.expand(STEPS, 4, 4))
    with pytest.raises(ValueError, match="noise: expected noise that is independent between blocks"):
        f.step(f.init(PRIOR), z[0, 0], noise=ROOT)
    inside = presets.gpb(MOTION, with_blocks((0, 2), (1, 3)), **VALUES)
    pairs = torch.eye(4).double()
    pairs[2, 0] = pairs[3, 1] = 0.5
    assert inside(z, PRIOR, noise=pairs.expand(STEPS, 4, 4)).mean.isfinite().all()
