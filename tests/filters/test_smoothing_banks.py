"""Smoothed models and hypotheses are close to the exact mixture of all histories, and streams with a lag are too."""

import math
from functools import partial

import numpy as np
import oracles
import pytest
import torch
from gpb_cases import ANCHORS, STEPS, VALUES, measured
from gpb_cases import PRIOR as OF_RANGES

from torchfra import presets
from torchfra.association import Euclidean
from torchfra.filters import IMM, SRCKF, FixedLag
from torchfra.motion import (
    Augmented,
    Bank,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    GaussMarkov,
    aircraft,
)
from torchfra.sensors import Biased, Position, Ranges
from torchfra.types import Gaussian

nan = float("nan")
STD = 5.0
TRANSITION = torch.tensor([[0.9, 0.1], [0.3, 0.7]]).double()
START, ROOT = torch.tensor([0.0, 0.0, 20.0, 5.0]).double(), torch.tensor([5.0, 5.0, 3.0, 3.0]).double().diag()
PRIOR = Gaussian(START, ROOT)


def bank():
    return Bank([ConstantVelocity(0.01), ConstantVelocity(25.0)])


def models(motion):
    dt = torch.tensor(1.0).double()
    return [
        oracles.Model(
            m.transition(dt).numpy(), m.process_noise(dt).numpy(), STD * np.eye(2), lambda x, k: x[:2], [0, 0]
        )
        for m in motion
    ]


def simulated(motion, runs, steps, seed=0):
    """Targets that switch as the transition says: truth ``(runs, steps, 4)`` and positions."""
    rng = np.random.default_rng(seed)
    x, mode, truth = START.numpy() + rng.standard_normal((runs, 4)) @ ROOT.numpy(), rng.integers(2, size=runs), []
    for _ in range(steps):
        mode = np.where(rng.random(runs) < TRANSITION.numpy()[mode, 0], 0, 1)
        of = models(motion)
        x = np.stack([of[m].F @ one + of[m].SQ @ rng.standard_normal(2) for m, one in zip(mode, x, strict=True)])
        truth.append(x)
    truth = np.stack(truth, 1)
    return truth, torch.from_numpy(truth[..., :2] + STD * rng.standard_normal((runs, steps, 2)))


def imm(motion=None):
    return IMM(SRCKF(bank() if motion is None else motion, Position(STD)), transition=TRANSITION)


def forth(f, z, prior=PRIOR, dt=1.0):
    """What each model knew after each step: means, covariances and weights."""
    state, kept = f.init(prior), {"means": [], "Ps": [], "weights": []}
    for k in range(len(z)):
        state, _ = f.step(state, z[k], dt=dt)
        kept["means"].append(state.inner.belief.mean.numpy())
        kept["Ps"].append(state.inner.belief.covariance.numpy())
        kept["weights"].append(state.log_weights.exp().numpy())
    return kept


@pytest.mark.slow
def test_on_short_tracks_it_is_close_to_the_exact_mixture_of_all_histories():
    motion = bank()
    truth, z = simulated(motion, runs=60, steps=6)
    smoothed = imm().smooth(z, PRIOR)
    filtered = smoothed.info.filtered
    exact = [
        oracles.every_history(
            one, START.numpy(), (ROOT @ ROOT.mT).numpy(), models(motion), TRANSITION.numpy(), [0.5, 0.5]
        )
        for one in z.numpy()
    ]
    mean, P, probabilities = (np.stack([e[key] for e in exact]) for key in ("mean", "P", "probabilities"))
    size = np.sqrt(np.trace(P[..., :2, :2], axis1=-2, axis2=-1))

    def off(estimate):
        return (np.linalg.norm(estimate.mean.numpy()[..., :2] - mean[..., :2], axis=-1) / size)[:, :-1].mean()

    def wrong(weights):
        return np.abs(weights.numpy() - probabilities)[:, :-1].mean()

    assert off(smoothed) < 0.06
    assert off(smoothed) < 0.15 * off(filtered)
    assert wrong(smoothed.info.probabilities) < 0.04
    assert wrong(smoothed.info.probabilities) < 0.2 * wrong(filtered.info.probabilities)
    spread = np.trace(smoothed.covariance.numpy()[..., :2, :2], axis1=-2, axis2=-1) / size**2
    assert abs(spread[:, :-1].mean() - 1) < 0.02

    def error(x):
        return np.sqrt(((x[..., :2] - truth[..., :2]) ** 2).sum(-1).mean())

    assert error(smoothed.mean.numpy()) < 1.01 * error(mean)


@pytest.mark.parametrize("missing", [False, True])
def test_it_is_what_moment_form_arithmetic_says(missing):
    motion = bank()
    _, z = simulated(motion, runs=1, steps=12, seed=1)
    if missing:
        z[0, 4:7], z[0, 9, 1] = nan, nan
    f = imm()
    smoothed = f.smooth(z[0], PRIOR)
    expected = oracles.models_smoother(forth(f, z[0]), models(motion), TRANSITION.numpy())
    np.testing.assert_allclose(smoothed.mean, expected["mean"], rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(smoothed.covariance, expected["P"], rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(smoothed.info.probabilities, expected["probabilities"], rtol=1e-6, atol=1e-6)


def test_models_that_are_all_alike_are_one():
    one = ConstantVelocity(1.0)
    _, z = simulated(bank(), runs=4, steps=15)
    z[0, 3], z[1, -1] = nan, nan
    alone, several = (
        SRCKF(one, Position(STD)).smooth(z, PRIOR),
        imm(Bank([one, ConstantVelocity(1.0)])).smooth(z, PRIOR),
    )
    torch.testing.assert_close(several.mean, alone.mean, rtol=1e-9, atol=1e-5)
    torch.testing.assert_close(several.covariance, alone.covariance, rtol=1e-9, atol=1e-5)
    torch.testing.assert_close(several.info.probabilities, several.info.filtered.info.probabilities, rtol=0, atol=1e-6)


def test_turns_with_errors_that_are_all_alike_are_one():
    one, sensor = (Augmented(aircraft()[3], GaussMarkov(3.0, 10.0, 2)), Biased(Position(STD), [6, 7]))
    prior = Gaussian(torch.zeros(8).double(), torch.tensor([9.0, 7.0, 3.0, 4.0, 1.0, 1.0, 3.0, 3.0]).double().diag())
    _, z = simulated(bank(), runs=4, steps=15)
    alone = SRCKF(one, sensor).smooth(z, prior)
    several = IMM(SRCKF(Bank([one, one]), sensor), transition=TRANSITION).smooth(z, prior)
    torch.testing.assert_close(several.mean, alone.mean, rtol=1e-9, atol=1e-5)
    torch.testing.assert_close(several.covariance, alone.covariance, rtol=1e-9, atol=1e-5)


def test_where_nothing_is_measured_any_more_it_is_as_filtered():
    _, z = simulated(bank(), runs=4, steps=12)
    z[:, 8:] = nan
    smoothed = imm().smooth(z, PRIOR)
    filtered = smoothed.info.filtered
    torch.testing.assert_close(smoothed.mean[:, 7:], filtered.mean[:, 7:], rtol=0, atol=1e-3)
    torch.testing.assert_close(
        smoothed.info.probabilities[:, 7:], filtered.info.probabilities[:, 7:], rtol=0, atol=1e-4
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "lag"), [("imm_fra", 3), ("vsimm_srckf", 1)])
def test_with_a_lag_each_step_is_that_of_the_track_up_to_so_many_later(name, lag):
    f, (prior, z) = getattr(presets, name)(aircraft(), Position(STD)), turning(8)
    lagged = f.smooth(z, prior, lag=lag)
    for k in range(z.shape[-2]):
        whole = f.smooth(z[:, : k + lag + 1], prior)
        torch.testing.assert_close(lagged.mean[:, k], whole.mean[:, k], rtol=1e-7, atol=1e-7)
        torch.testing.assert_close(lagged.covariance[:, k], whole.covariance[:, k], rtol=1e-7, atol=1e-7)
        torch.testing.assert_close(
            lagged.info.probabilities[:, k], whole.info.probabilities[:, k], rtol=1e-7, atol=1e-9
        )


def turning(steps=10):
    """A prior and two tracks that start to turn, with an outlier and a gap."""
    rng = torch.Generator().manual_seed(2)
    t = torch.arange(1.0, steps + 1).double()
    heading = 0.2 * (t - 4).clamp_min(0)
    step = 60 * torch.stack([heading.cos(), heading.sin()], -1)
    z = step.cumsum(0) + STD * torch.randn(2, steps, 2, generator=rng).double()
    z[0, 2] += 60
    z[1, 5] = nan
    mean = torch.tensor([0.0, 0, 60, 0, 0, 0]).double()
    return Gaussian(mean, torch.tensor([10.0, 10, 5, 5, 1, 1]).double().diag()), z


def test_a_model_that_fails_fails_alone():
    class Bursting(ConstantVelocity):
        def transition(self, dt):
            return super().transition(dt) * nan

    _, z = simulated(bank(), runs=2, steps=6)
    f = imm(Bank([ConstantVelocity(1.0), Bursting(1.0)]))
    smoothed = f.smooth(z, PRIOR)
    assert not smoothed.info.filtered.failed.any()
    assert not smoothed.failed.any()
    alone = SRCKF(ConstantVelocity(1.0), Position(STD)).smooth(z, PRIOR)
    torch.testing.assert_close(smoothed.mean, alone.mean, rtol=0, atol=1e-4)


# ---------------------------------------------------------------- hypotheses of gpb


nan = float("nan")
LEVELS, SIZE = (0.01, 25.0), 100.0
STAY, RENEW = (0.9, 0.7, 0.5), (0.6, 0.4, 0.0)
CHAIN = ((0.9, 0.1), (0.6, 0.4))


def few():
    """Two levels, one size of outliers, no jumps, no bad prior: of few steps all histories can be told."""
    return presets.gpb(
        ConstantVelocity(1.0),
        Position(STD),
        noise_levels=LEVELS,
        jump_factors=torch.zeros(0),
        adaptive_largest_size=False,
        self_transition=STAY,
        restart=RENEW,
        outlier_transition=CHAIN,
        outlier_sizes=(SIZE,),
        outlier_shares=(1.0,),
        prior_outlier=1e-12,
        prior_inflation=1.0,
    )


def chains():
    """Transitions and first probabilities of regimes and qualities together, and the models of the four."""
    stay, renew, quality = np.diag(STAY[:2]), np.array(RENEW[:2]), np.array(CHAIN)
    regime = stay + (1 - np.diag(stay))[:, None] * renew
    calm, agile = models([ConstantVelocity(LEVELS[0]), ConstantVelocity(LEVELS[1])])
    each = [m._replace(SR=root * STD * np.eye(2)) for m in (calm, agile) for root in (1, SIZE**0.5)]
    lasting = renew / (1 - np.diag(stay))
    return np.kron(regime, quality), np.kron(lasting / lasting.sum(), [1.0, 0.0]), each


def switching(runs, steps, seed=0):
    rng = np.random.default_rng(seed)
    transition, first, each = chains()
    z = np.zeros((runs, steps, 2))
    for run in z:
        x, mode = START.numpy() + ROOT.numpy() @ rng.standard_normal(4), rng.choice(4, p=first)
        for k in range(steps):
            mode = rng.choice(4, p=transition[mode])
            x = each[mode].F @ x + each[mode].SQ @ rng.standard_normal(2)
            run[k] = x[:2] + each[mode].SR @ rng.standard_normal(2)
    return torch.from_numpy(z)


@pytest.mark.slow
def test_on_short_tracks_gpb_is_close_to_the_exact_mixture_of_all_histories():
    transition, first, each = chains()
    z = switching(runs=40, steps=4)
    z[0, 2], z[1, 1, 0] = nan, nan
    smoothed = few().smooth(z, Gaussian(START, ROOT))
    filtered = smoothed.info.filtered
    given = START.numpy(), (ROOT @ ROOT.mT).numpy(), each, transition, first
    exact = [oracles.every_history(one, *given) for one in z.numpy()]
    mean, P, probabilities = (np.stack([e[key] for e in exact]) for key in ("mean", "P", "probabilities"))
    size = np.sqrt(np.trace(P[..., :2, :2], axis1=-2, axis2=-1))
    agile, outlier = probabilities[..., 2:].sum(-1), probabilities[..., 1::2].sum(-1)

    def off(x):
        return (np.linalg.norm(x.numpy()[..., :2] - mean[..., :2], axis=-1) / size)[:, :-1].mean()

    def wrong(regimes, outliers):
        gaps = np.abs(regimes.numpy()[..., 1] - agile), np.abs(outliers.numpy()[..., 0] - outlier)
        return [gap[:, :-1].mean() for gap in gaps]

    assert off(smoothed.mean) < 0.18
    assert off(smoothed.mean) < 0.2 * off(filtered.mean)
    of_regimes, of_outliers = wrong(smoothed.info.probabilities, smoothed.info.outlier)
    regimes_before, outliers_before = wrong(filtered.info.probabilities, filtered.info.outlier)
    assert of_outliers < min(0.01, 0.3 * outliers_before)
    assert of_regimes < regimes_before
    spread = np.trace(smoothed.covariance.numpy()[..., :2, :2], axis1=-2, axis2=-1) / size**2
    assert abs(spread[:, :-1].mean() - 1) < 0.03


@pytest.mark.parametrize("motions", [1, 3])
def test_hypotheses_that_are_all_alike_are_one(motions):
    one, z = ConstantVelocity(1.0), switching(runs=4, steps=12)
    z[0, 3], z[1, -1] = nan, nan
    f = presets.gpb(
        [ConstantVelocity(1.0) for _ in range(motions)],
        Position(STD),
        noise_levels=(1.0, 1.0),
        jump_factors=(1e-9,),
        adaptive_largest_size=False,
        outlier_sizes=(1.0 + 1e-12,),
        outlier_shares=(1.0,),
        self_transition=(0.9, 0.5, 0.8, 0.1),
        restart=(0.4, 0.3, 0.2, 0.1),
        prior_outlier=0.1,
        prior_inflation=1.0,
        noise="stated",
    )
    prior = Gaussian(START, ROOT)
    smoothed, alone = f.smooth(z, prior), SRCKF(one, Position(STD)).smooth(z, prior)
    torch.testing.assert_close(smoothed.mean, alone.mean, rtol=0, atol=1e-4)
    torch.testing.assert_close(smoothed.covariance, alone.covariance, rtol=1e-5, atol=1e-4)


def of_ranges():
    """GPB with several blocks and motions, and measurements."""
    motions = [ConstantAcceleration(0.05), CoordinatedTurn(math.pi / 20, 0.1, orders=3)]
    return presets.gpb(motions, Ranges(ANCHORS[:2], 2.0), **VALUES), measured("ranges", 3)[..., :2]


@pytest.mark.slow
def test_batches_vmap_lags_and_reruns_give_the_same():
    f, z = of_ranges()
    steps = 6
    z = z[:, :steps]

    def smooth(z, **options):
        smoothed = f.smooth(z, OF_RANGES, **options)
        return smoothed.mean, smoothed.scale_tril, smoothed.info.probabilities, smoothed.info.outlier

    together = smooth(z)
    torch.testing.assert_close(smooth(z[1]), tuple(x[1] for x in together), rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(torch.func.vmap(smooth)(z), together, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(smooth(z, lag=steps), together, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(smooth(z, estimate=f(z, OF_RANGES)), together, rtol=0, atol=0)
    kept = f(z, OF_RANGES, past=True)
    torch.testing.assert_close(smooth(z, estimate=kept, lag=steps), together, rtol=1e-9, atol=1e-9)
    lagged = smooth(z, lag=2)
    for k in (0, steps - 2):
        whole = smooth(z[:, : k + 3])
        torch.testing.assert_close(tuple(x[:, k] for x in lagged), tuple(x[:, k] for x in whole), rtol=1e-7, atol=1e-7)


def test_the_filter_says_the_same_whether_it_will_go_back_or_not():
    f, z = of_ranges()
    torch.testing.assert_close(f.smooth(z, OF_RANGES).info.filtered, f(z, OF_RANGES), rtol=0, atol=0)


def test_values_may_differ_by_track():
    jumps, z = torch.tensor([[[10.0]], [[1000.0]]]).double(), measured("position", 3)
    make = partial(presets.gpb, ConstantAcceleration(0.1), Position(STD))
    together = make(jump_factors=jumps).smooth(z, Gaussian(OF_RANGES.mean.expand(2, 3, 6), OF_RANGES.scale_tril))
    assert together.mean.shape == (2, 3, STEPS, 6)
    for i, values in enumerate(jumps[:, 0]):
        alone = make(jump_factors=values).smooth(z, OF_RANGES)
        torch.testing.assert_close(together.mean[i], alone.mean, rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_gradients_of_gpb_are_exact():
    f = presets.gpb(ConstantAcceleration(0.1), Position(STD), learn=("noise_levels", "durations"))
    z = measured("position", 3)[:1, :4]

    def smooth(z, mean):
        smoothed = f.smooth(z, Gaussian(mean, OF_RANGES.scale_tril))
        return smoothed.mean, smoothed.scale_tril, smoothed.info.probabilities, smoothed.info.outlier

    inputs = (z.clone().requires_grad_(), OF_RANGES.mean.clone().requires_grad_())
    assert torch.autograd.gradcheck(smooth, inputs, eps=1e-6, rtol=1e-3, atol=1e-4, fast_mode=True)
    loss = sum(x.square().sum() for x in smooth(z, OF_RANGES.mean))
    assert all(g.isfinite().all() for g in torch.autograd.grad(loss, list(f.parameters())))


# ---------------------------------------------------------------- streams with a lag


SENSOR = Position(STD)


def filters():
    one = ConstantAcceleration(0.3)
    named = {name: getattr(presets, name)(one, SENSOR) for name in ("rsrckf", "asrckf", "fra", "gpb")}
    named["fra, adaptive first"] = presets.fra(one, SENSOR, provisional="adaptive", plain=0.0)
    return named | {
        name: getattr(presets, name)(aircraft(), SENSOR) for name in ("imm_srckf", "imm_fra", "vsimm_srckf")
    }


def close(a, b):
    torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(("name", "lag"), [*((name, 4) for name in filters()), ("gpb", 1), ("fra", 1)])
def test_each_step_hands_out_the_estimate_of_so_many_steps_back(name, lag):
    f, (prior, z) = filters()[name], turning()
    stream, whole = FixedLag(f, lag), f.smooth(z, prior, dt=0.8, lag=lag)
    state = stream.init(Gaussian(prior.mean.expand(2, 6), prior.scale_tril))
    close(state.lagged, state.belief)
    inner = state.inner
    for k in range(z.shape[-2] - 1):
        state, innovation = stream.step(state, z[:, k], dt=0.8)
        inner, expected = f.step(inner, z[:, k], dt=0.8)
        close(innovation, expected)
        close(state.belief, inner.belief)
        if k >= lag:
            close(state.lagged.mean, whole.mean[:, k - lag])
            close(state.lagged.covariance, whole.covariance[:, k - lag])


def test_until_there_are_enough_it_is_the_first_step():
    f, (prior, z) = presets.srckf(ConstantAcceleration(0.3), SENSOR), turning()
    stream = FixedLag(f, 5)
    state = stream.init(prior)
    for k in range(5):
        state, _ = stream.step(state, z[0, k])
        close(state.lagged.mean, f.smooth(z[0, : k + 1], prior).mean[0])


def test_a_bank_tells_its_probabilities_and_a_compiled_filter_does_the_same():
    f, (prior, z) = presets.gpb(ConstantAcceleration(0.3), SENSOR), turning()
    for one in (f, presets.srckf(ConstantAcceleration(0.3), SENSOR).compile()):
        stream, smoothed = FixedLag(one, 2), one.smooth(z, prior, lag=2)
        state = stream.init(Gaussian(prior.mean.expand(2, 6), prior.scale_tril))
        for k in range(5):
            state, _ = stream.step(state, z[:, k])
        close(state.lagged.mean, smoothed.mean[:, 2])
        if one is f:
            close(state.smoothed.probabilities, smoothed.info.probabilities[:, 2])
            close(state.smoothed.outlier, smoothed.info.outlier[:, 2])


def test_scans_come_one_at_a_time_too(crossing, scans):
    gate = Euclidean(150.0, probability=0.9999)
    f = presets.iaukf_jpda(crossing.motion, crossing.sensor, clutter=crossing.clutter, gate=gate)
    stream, whole = FixedLag(f, 3), f.smooth(scans.z[:, :8], scans.prior, lag=3)
    state = stream.init(scans.prior)
    for k in range(8):
        state, _ = stream.step(state, scans.z[:, k])
    close(state.lagged.mean, whole.mean[:, :, 4])


def test_gradients_flow_back_through_the_window():
    f, (prior, z) = presets.rsrckf(ConstantAcceleration(0.3), SENSOR, learn=("q",)), turning()

    def last(z, mean):
        stream = FixedLag(f, 2)
        state = stream.init(Gaussian(mean, prior.scale_tril))
        for one in z:
            state, _ = stream.step(state, one)
        return tuple(state.lagged)

    inputs = (z[1, :5].clone().requires_grad_(), prior.mean.clone().requires_grad_())
    assert torch.autograd.gradcheck(last, inputs, eps=1e-6, rtol=1e-4, atol=1e-5, fast_mode=True)
    assert list(FixedLag(f, 2).parameters()) == list(f.parameters())


@pytest.mark.parametrize(("make", "error", "message"), [
    (lambda f: FixedLag(SENSOR, 2), ValueError, r"filter: expected one of torchfra.filters, received Position"),
    (lambda f: FixedLag(f, 0), ValueError, r"lag: expected at least 1 step, received 0"),
    (lambda f: FixedLag(presets.alphabeta(f.motion, SENSOR), 2), NotImplementedError, r"constant gains"),
])  # fmt: skip
def test_what_does_not_fit_is_named(make, error, message):
    with pytest.raises(error, match=message):
        make(presets.srckf(ConstantAcceleration(0.3), SENSOR))
