"""In float32 no covariance loses its root over a million steps, forward and back, whatever is missing or wild."""

import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

TRACKS, STEPS = 100, 10_000


@pytest.fixture(scope="module")
def z():
    rng = torch.Generator().manual_seed(0)

    def drawn(rate):
        return torch.rand(TRACKS, STEPS, 1, generator=rng) < rate

    walk = torch.randn(TRACKS, STEPS, 2, generator=rng).cumsum(1)
    noise = 5 * torch.randn(TRACKS, STEPS, 2, generator=rng)
    return (walk + noise.where(~drawn(0.05), 30 * noise)).where(~drawn(0.05), torch.nan)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["srckf", "fra"])
def test_a_million_steps_keep_their_roots(z, name):
    f = getattr(presets, name)(ConstantVelocity(1.0), Position(5.0)).compile()
    prior = Gaussian(torch.zeros(4), torch.tensor([1e3, 1e3, 100.0, 100.0]).diag())
    with torch.no_grad():
        smoothed = f.smooth(z, prior)
    assert smoothed.mean.dtype == torch.float32
    assert smoothed.mean.shape == (TRACKS, STEPS, 4)
    for estimate in (smoothed, smoothed.info.filtered):
        assert not estimate.failed.any()
        assert (estimate.scale_tril.diagonal(dim1=-2, dim2=-1) > 0).all()
