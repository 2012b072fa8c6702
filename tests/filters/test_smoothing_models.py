"""Smoothed models are close to the exact mixture of all histories, and what moment-form arithmetic makes of them."""

import numpy as np
import oracles
import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.filters import IMM, SRCKF
from torchfra.motion import Augmented, Bank, ConstantVelocity, CoordinatedTurn, GaussMarkov, aircraft
from torchfra.sensors import Biased, Position

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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["imm_fra", "vsimm_srckf"])
def test_batches_vmap_and_checkpoints_give_the_same(name):
    f, (prior, z) = getattr(presets, name)(aircraft(), Position(STD), learn=("transition",)), turning()

    def smooth(z, **options):
        smoothed = f.smooth(z, prior, **options)
        return smoothed.mean, smoothed.scale_tril, smoothed.info.probabilities

    with torch.no_grad():
        together = smooth(z)
        torch.testing.assert_close(smooth(z[1]), tuple(x[1] for x in together), rtol=1e-7, atol=1e-7)
        torch.testing.assert_close(torch.func.vmap(smooth)(z), together, rtol=1e-7, atol=1e-7)
    gradients = [
        torch.autograd.grad(sum(x.square().sum() for x in smooth(z, checkpoint=c)), list(f.parameters()))
        for c in (None, 4)
    ]
    assert all(g.isfinite().all() and (g != 0).any() for g in gradients[0])
    torch.testing.assert_close(*gradients, rtol=1e-7, atol=1e-7)


def test_gradients_are_exact():
    _, z = simulated(bank(), runs=1, steps=5)
    f = imm(Bank([ConstantVelocity(0.5), CoordinatedTurn(0.1, 4.0)]))

    def smooth(z, mean):
        smoothed = f.smooth(z, Gaussian(mean, ROOT))
        return smoothed.mean, smoothed.scale_tril, smoothed.info.probabilities

    inputs = (z[0].requires_grad_(), START.clone().requires_grad_())
    assert torch.autograd.gradcheck(smooth, inputs, eps=1e-6, rtol=1e-4, atol=1e-5, fast_mode=True)


@pytest.mark.slow
def test_compiled_three_models_smooth_as_ones_that_are_not():
    _, z = simulated(bank(), runs=3, steps=8)
    f = presets.imm_srckf(Bank([ConstantVelocity(q) for q in (0.01, 1.0, 25.0)]), Position(STD))
    eager = f.smooth(z, PRIOR)
    fast = f.compile().smooth(z, PRIOR)
    torch.testing.assert_close(tuple(fast[:2]), tuple(eager[:2]), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(fast.info.probabilities, eager.info.probabilities, rtol=1e-10, atol=1e-10)


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
