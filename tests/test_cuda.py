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
    there = there.compile() if compiled else there
    data = moved(tracks)
    with torch.no_grad():
        here, far = f(tracks.z, tracks.prior, u=tracks.u), there(data.z, data.prior, u=data.u)
    assert far.mean.is_cuda
    torch.testing.assert_close(far.mean.cpu(), here.mean, rtol=1e-9, atol=1e-6)


def test_gradients_flow_on_a_gpu(make, tracks):
    f, data = make("fra", learn="all", temperature=1.0).to("cuda"), moved(tracks)
    f(data.z, data.prior, u=data.u).mean.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())


@pytest.mark.parametrize("name", ["srckf", "fra"])
def test_gradients_of_kernels_on_a_gpu_are_those_of_kernels_on_the_cpu(name, make, tracks):
    f, data, found = make(name, learn=("q",)), moved(tracks), []
    for g, t in ((f, tracks), (copy.deepcopy(f).to("cuda"), data)):
        g = g.compile()
        loss = g(t.z, t.prior, u=t.u).mean.square().mean()
        found += [x.cpu() for x in torch.autograd.grad(loss, list(g.parameters()))]
    torch.testing.assert_close(found[1], found[0], rtol=1e-9, atol=0)


def test_single_steps_run_on_a_gpu(make, tracks):
    f, data = make("srckf"), moved(tracks)
    there = copy.deepcopy(f).to("cuda").compile()
    state, far = f.init(tracks.prior), there.init(data.prior)
    for k in range(3):
        state, _ = f.step(state, tracks.z[:, k], u=tracks.u[k])
        far, _ = there.step(far, data.z[:, k], u=data.u[k])
    torch.testing.assert_close(far.belief.mean.cpu(), state.belief.mean, rtol=1e-9, atol=1e-6)
