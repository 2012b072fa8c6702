"""What every filter of the papers and ``gpb`` promise beyond the battery."""

import pytest
import torch
from conftest import PRESETS, STEPS

from torchfra import presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Bearings
from torchfra.types import Gaussian

each = pytest.mark.parametrize("name", PRESETS)
of_each_class = pytest.mark.parametrize("name", ["srckf", "fra", "gpb"])


def same(a, b, tolerance=1e-10):
    torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance * 1e3, equal_nan=True)


@each
def test_no_initial_uncertainty_has_finite_gradients(name, make, tracks):
    f = make(name, learn=("q", "std"))
    prior = Gaussian(tracks.prior.mean, torch.zeros_like(tracks.prior.scale_tril))
    e = f(tracks.z, prior, u=tracks.u)
    assert not e.failed.any()
    e.mean.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())


@of_each_class
def test_it_maps_over_hyperparameters_and_takes_a_batch_of_them(name, make, tracks):
    q = torch.tensor([0.001, 0.1, 0.3], dtype=torch.float64)
    sensor = Bearings(torch.tensor([0.01, 0.02, 0.03], dtype=torch.float64).reshape(3, 1, 1).expand(3, 1, 2))
    preset = getattr(presets, name)
    batch = preset(ConstantVelocity(q.unsqueeze(-1)), sensor)(tracks.z, tracks.prior, u=tracks.u)
    assert batch.mean.shape == (3, 4, STEPS, 4)
    for i in range(3):
        alone = preset(ConstantVelocity(float(q[i])), Bearings(0.01 * (i + 1)))
        same(batch.mean[i], alone(tracks.z, tracks.prior, u=tracks.u).mean, 1e-6)
    f = make(name)
    (path,) = (path for path in f.state_dict() if path.endswith(".q.raw"))
    mapped = torch.func.vmap(
        lambda raw: torch.func.functional_call(f, {path: raw}, (tracks.z, tracks.prior), {"u": tracks.u}).mean
    )
    same(mapped(q.log())[1], f(tracks.z, tracks.prior, u=tracks.u).mean, 1e-7)
