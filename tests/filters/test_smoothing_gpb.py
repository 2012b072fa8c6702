"""Smoothed hypotheses of GPB are close to the exact mixture of all histories, and keep every promise of a filter."""

import math
from functools import partial

import numpy as np
import oracles
import pytest
import torch
from gpb_cases import ANCHORS, PRIOR, STEPS, VALUES, measured
from test_smoothing_models import START, models

from torchfra import Gaussian, presets
from torchfra.filters import SRCKF
from torchfra.motion import ConstantAcceleration, ConstantVelocity, CoordinatedTurn
from torchfra.sensors import Position, Ranges

nan = float("nan")
STD, LEVELS, SIZE = 5.0, (0.01, 25.0), 100.0
STAY, RENEW = (0.9, 0.7, 0.5), (0.6, 0.4, 0.0)
CHAIN = ((0.9, 0.1), (0.6, 0.4))
ROOT = torch.tensor([5.0, 5.0, 3.0, 3.0]).double().diag()


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


def simulated(runs, steps, seed=0):
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
def test_on_short_tracks_it_is_close_to_the_exact_mixture_of_all_histories():
    transition, first, each = chains()
    z = simulated(runs=40, steps=4)
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
    one, z = ConstantVelocity(1.0), simulated(runs=4, steps=12)
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
        smoothed = f.smooth(z, PRIOR, **options)
        return smoothed.mean, smoothed.scale_tril, smoothed.info.probabilities, smoothed.info.outlier

    together = smooth(z)
    torch.testing.assert_close(smooth(z[1]), tuple(x[1] for x in together), rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(torch.func.vmap(smooth)(z), together, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(smooth(z, lag=steps), together, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(smooth(z, estimate=f(z, PRIOR)), together, rtol=0, atol=0)
    kept = f(z, PRIOR, past=True)
    torch.testing.assert_close(smooth(z, estimate=kept, lag=steps), together, rtol=1e-9, atol=1e-9)
    lagged = smooth(z, lag=2)
    for k in (0, steps - 2):
        whole = smooth(z[:, : k + 3])
        torch.testing.assert_close(tuple(x[:, k] for x in lagged), tuple(x[:, k] for x in whole), rtol=1e-7, atol=1e-7)


def test_the_filter_says_the_same_whether_it_will_go_back_or_not():
    f, z = of_ranges()
    torch.testing.assert_close(f.smooth(z, PRIOR).info.filtered, f(z, PRIOR), rtol=0, atol=0)


def test_values_may_differ_by_track():
    jumps, z = torch.tensor([[[10.0]], [[1000.0]]]).double(), measured("position", 3)
    make = partial(presets.gpb, ConstantAcceleration(0.1), Position(STD))
    together = make(jump_factors=jumps).smooth(z, Gaussian(PRIOR.mean.expand(2, 3, 6), PRIOR.scale_tril))
    assert together.mean.shape == (2, 3, STEPS, 6)
    for i, values in enumerate(jumps[:, 0]):
        alone = make(jump_factors=values).smooth(z, PRIOR)
        torch.testing.assert_close(together.mean[i], alone.mean, rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_gradients_are_exact():
    f = presets.gpb(ConstantAcceleration(0.1), Position(STD), learn=("noise_levels", "durations"))
    z = measured("position", 3)[:1, :4]

    def smooth(z, mean):
        smoothed = f.smooth(z, Gaussian(mean, PRIOR.scale_tril))
        return smoothed.mean, smoothed.scale_tril, smoothed.info.probabilities, smoothed.info.outlier

    inputs = (z.clone().requires_grad_(), PRIOR.mean.clone().requires_grad_())
    assert torch.autograd.gradcheck(smooth, inputs, eps=1e-6, rtol=1e-3, atol=1e-4, fast_mode=True)
    loss = sum(x.square().sum() for x in smooth(z, PRIOR.mean))
    assert all(g.isfinite().all() for g in torch.autograd.grad(loss, list(f.parameters())))
