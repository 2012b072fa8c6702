"""The same filters on a GPU, where there is one."""

import copy

import pytest
import torch
from conftest import PRESETS

pytestmark = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]


def moved(x, device="cuda"):
    return type(x)(*(moved(y, device) for y in x)) if isinstance(x, tuple) else x.to(device)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("compiled", [False, True])
def test_a_gpu_gives_what_the_cpu_gives(name, compiled, make, tracks):
    f = make(name)
    there = copy.deepcopy(f).to("cuda")
    there = there.compile() if compiled else there  # kernels are for the CPU: it runs as it is
    data = moved(tracks)
    with torch.no_grad():
        here, far = f(tracks.z, tracks.prior, u=tracks.u), there(data.z, data.prior, u=data.u)
    assert far.mean.is_cuda
    torch.testing.assert_close(far.mean.cpu(), here.mean, rtol=1e-9, atol=1e-6)


def test_gradients_flow_on_a_gpu(make, tracks):
    f, data = make("fra", learn="all", temperature=1.0).to("cuda"), moved(tracks)
    f(data.z, data.prior, u=data.u).mean.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())
