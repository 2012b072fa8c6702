"""The gradient of the likelihood is made of smoothed moments (Fisher's identity): a loss of these says the same."""

import pytest
import torch
from test_smoothing import DT, ROOT, START, walk

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity, Motion
from torchfra.sensors import Position

Q, STD = 0.5, 2.0


class Pairs(Motion):
    """Constant velocity with the state before kept beside the state: what smoothing says of both together."""

    linear = True

    def __init__(self):
        super().__init__(2, 4, None, size=8)
        self.inside = ConstantVelocity(Q)

    def transition(self, dt):
        step, nothing = self.inside.transition(dt), torch.zeros(*dt.shape, 4, 4, dtype=dt.dtype)
        eye = torch.eye(4, dtype=dt.dtype).expand_as(step)
        return torch.cat([torch.cat([step, nothing], -1), torch.cat([eye, nothing], -1)], -2)

    def process_noise(self, dt):
        noise = self.inside.process_noise(dt)
        return torch.cat([noise, torch.zeros_like(noise)], -2)


@pytest.fixture(scope="module")
def gradients():
    """Of the log likelihood, by q and by the standard deviation: as autograd has them."""
    f = presets.srckf(ConstantVelocity(Q), Position(STD), learn=("q", "std"))
    loss = -f(walk(ConstantVelocity(Q)), Gaussian(START, ROOT), dt=DT).log_likelihood.sum()
    values = {"q": f.motion.q, "std": f.sensor.std}
    raw = torch.autograd.grad(-loss, [value.raw for value in values.values()])
    slopes = {}
    for (name, value), gradient in zip(values.items(), raw, strict=True):
        natural = value(DT)
        (slope,) = torch.autograd.grad(natural.sum(), value.raw)
        slopes[name] = (gradient / slope).item()
    return slopes


def test_that_by_the_measurement_noise_is_the_expected_square_of_what_is_left(gradients):
    z = walk(ConstantVelocity(Q))
    smoothed = presets.srckf(ConstantVelocity(Q), Position(STD)).smooth(z, Gaussian(START, ROOT), dt=DT)
    variance = smoothed.covariance.diagonal(dim1=-2, dim2=-1)[:, :2]
    square = (z - smoothed.mean[:, :2]).square() + variance
    expected = (square / STD**3 - 1 / STD)[~z.isnan()].sum()
    assert gradients["std"] == pytest.approx(expected.item(), rel=1e-9)


def test_that_by_the_process_noise_is_the_expected_square_of_the_accelerations(gradients):
    motion = Pairs()
    prior = Gaussian(torch.cat([START, START]), torch.block_diag(ROOT, torch.zeros_like(ROOT)))
    smoothed = presets.srckf(motion, Position(STD)).smooth(walk(ConstantVelocity(Q)), prior, dt=DT)
    gain = torch.linalg.pinv(ConstantVelocity(1.0).process_noise(DT))
    noise = torch.cat([gain, -gain @ motion.inside.transition(DT)], -1)  # (T, 2, 8): the acceleration of each step
    mean = (noise @ smoothed.mean.unsqueeze(-1)).squeeze(-1)
    square = mean.square() + (noise @ smoothed.covariance @ noise.mT).diagonal(dim1=-2, dim2=-1)
    expected = (square / (2 * Q**2) - 1 / (2 * Q)).sum()
    assert gradients["q"] == pytest.approx(expected.item(), rel=1e-9)
