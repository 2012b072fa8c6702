"""What every filter of the papers and ``gpb`` promise beyond the battery."""

import pytest
import torch
from conftest import PRESETS

from torchfra.types import Gaussian


@pytest.mark.parametrize("name", PRESETS)
def test_no_initial_uncertainty_has_finite_gradients(name, make, tracks):
    f = make(name, learn=("q", "std"))
    prior = Gaussian(tracks.prior.mean, torch.zeros_like(tracks.prior.scale_tril))
    e = f(tracks.z, prior, u=tracks.u)
    assert not e.failed.any()
    e.mean.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())
