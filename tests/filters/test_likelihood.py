"""The likelihood as a plain function: numpy in, numpy out, with its gradient."""

import numpy as np
import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.fitting import LogLikelihood
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

Z = torch.randn(4, 12, 2, generator=torch.Generator().manual_seed(0)).double().cumsum(1)
PRIOR = Gaussian.from_std(np.zeros((4, 4)), 3.0)


def made(compile):
    f = presets.rsrckf(ConstantVelocity(q=1.0), Position(std=2.0))
    return LogLikelihood(f, {"z": Z, "prior": PRIOR}, learn=("q", "std", "threshold"), compile=compile)


@pytest.mark.parametrize("compile", [False, None], ids=["interpreted", "where it can"])
def test_it_is_the_sum_over_tracks_and_steps_with_its_gradient(compile):
    likelihood = made(compile)
    raw = likelihood.start + 0.3
    q, std, threshold = (likelihood.natural(raw)[[likelihood.names.index(n)]][0] for n in NAMES)
    f = presets.rsrckf(ConstantVelocity(q=q), Position(std=std), threshold=threshold)
    value, gradient = likelihood(raw)
    np.testing.assert_allclose(value, f(Z, PRIOR).log_likelihood.sum().item(), rtol=1e-10)
    for i, step in enumerate(1e-5 * np.eye(3)):
        slope = (likelihood(raw + step)[0] - likelihood(raw - step)[0]) / 2e-5
        np.testing.assert_allclose(gradient[i], slope, rtol=1e-5, atol=1e-6)


NAMES = ("motion.q", "sensor.std", "robust.threshold")


def test_chains_are_evaluated_at_once():
    likelihood = made(False)
    raw = likelihood.start + np.linspace(-1, 1, 6).reshape(2, 3, 1)
    values, gradients = likelihood(raw)
    assert values.shape == (2, 3)
    assert gradients.shape == (2, 3, 3)
    for at in np.ndindex(2, 3):
        value, gradient = likelihood(raw[at])
        np.testing.assert_allclose(values[at], value, rtol=1e-12)
        np.testing.assert_allclose(gradients[at], gradient, rtol=1e-9)


def test_another_number_of_values_is_named():
    with pytest.raises(ValueError, match=r"raw: expected \(\.\.\., 3\), received \(2,\)"):
        made(False)([0.0, 1.0])
