"""gpb finds out whether a device is unreliable: whether half of what it measures are large outliers."""

import pytest
import torch

from torchfra import Gaussian, metrics, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

RUNS, STEPS, STD = 40, 100, 2.0
F64 = {"dtype": torch.float64}
MOTION, SENSOR = ConstantVelocity(0.1), Position(STD)
PRIOR = Gaussian(torch.zeros(4, **F64), 10 * torch.eye(4, **F64))


def simulated(std=STD, outlying=0.0, size=1000.0, seed=0):
    """Truth ``(B, T, 4)`` and measurements ``(B, T, 2)``; the first ten are no outliers."""
    rng = torch.Generator().manual_seed(seed)
    second = torch.tensor(1.0, **F64)
    F, noise = MOTION.transition(second), MOTION.process_noise(second)
    x, truth = torch.randn(RUNS, 4, generator=rng, **F64) @ PRIOR.scale_tril.mT, []
    for _ in range(STEPS):
        x = x @ F.mT + torch.randn(RUNS, noise.shape[-1], generator=rng, **F64) @ noise.mT
        truth.append(x)
    truth = torch.stack(truth, 1)
    z = truth[..., :2] + std * torch.randn(RUNS, STEPS, 2, generator=rng, **F64)
    wrong = torch.rand(RUNS, STEPS, 1, generator=rng, **F64) < outlying
    wrong[:, :10] = False
    return truth, z + wrong * size * STD * torch.randn(RUNS, STEPS, 2, generator=rng, **F64)


def unreliable(z, **options):
    """What gpb believes after the last measurement, ``(B,)``."""
    f = presets.gpb(MOTION, SENSOR, **options)
    state = f.init(Gaussian(*(x.expand(len(z), *x.shape) for x in PRIOR)))
    for now in z.unbind(-2):
        state, _ = f.step(state, now)
    return (state.log_weights.logsumexp(-1).exp() * state.unreliable[..., 0]).sum(-1)


def test_a_device_of_which_half_is_outliers_is_found_and_filtered_as_one_that_is_known():
    truth, z = simulated(outlying=0.5)
    assert unreliable(z).min() > 0.7
    known = presets.gpb(MOTION, SENSOR, outlier_transition=((0.5, 0.5), (0.5, 0.5)), unreliable=0.0)
    found, known, never = (
        metrics.error(f(z, PRIOR).mean, truth, slice(0, 2)).square().mean().sqrt()
        for f in (presets.gpb(MOTION, SENSOR), known, presets.gpb(MOTION, SENSOR, unreliable=0.0))
    )
    assert found < 1.03 * known
    assert found < 0.97 * never


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_a_device_whose_noise_is_stated_wrongly_is_not_unreliable(factor):
    _, z = simulated(std=factor * STD)
    assert unreliable(z).max() < 0.01


@pytest.mark.parametrize("size", [10.0, 1e3, 1e6])
def test_after_one_outlier_a_few_inliers_say_that_there_was_nothing(size):
    _, z = simulated()
    z[:, 50] += size * STD
    assert unreliable(z[:, :51]).max() < 0.02
    assert unreliable(z[:, :56]).max() < 0.003


def test_a_missing_measurement_says_nothing():
    _, z = simulated(outlying=0.5)
    gap = torch.full((RUNS, 20, 2), torch.nan, **F64)
    torch.testing.assert_close(unreliable(torch.cat([z, gap], 1)), unreliable(z))
