"""The same filters on a GPU, where there is one: whatever runs on the CPU runs there, and says the same."""

import copy

import pytest
import torch
from conftest import PRESETS
from torch.autograd import forward_ad

import torchfra
from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

pytestmark = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]
CLOSE = {"rtol": 1e-9, "atol": 1e-6}
KERNELS = pytest.mark.parametrize("compiled", [False, True])


def moved(x, device="cuda"):
    if isinstance(x, tuple):
        return type(x)(*(moved(y, device) for y in x))
    return x if x is None else x.to(device)


def there(f, compiled=True):
    """A copy of a filter on the GPU."""
    g = copy.deepcopy(f).to("cuda")
    return g.compile() if compiled else g


def close(far, here, **tolerance):
    """What a GPU says is what the CPU says."""
    assert far.is_cuda
    torch.testing.assert_close(far.cpu(), here, **(tolerance or CLOSE), equal_nan=True)


@pytest.mark.parametrize("name", PRESETS)
@KERNELS
def test_a_gpu_gives_what_the_cpu_gives(name, compiled, make, tracks):
    f, data = make(name), moved(tracks)
    with torch.no_grad():
        here, far = f(tracks.z, tracks.prior, u=tracks.u), there(f, compiled)(data.z, data.prior, u=data.u)
    for field in ("mean", "scale_tril", "nis", "log_likelihood"):
        close(getattr(far, field), getattr(here, field))


@pytest.mark.parametrize("name", ["imm_srckf", "imm_fra", "vsimm_srckf"])
def test_interacting_models_too(name, scenario, tracks):
    f, data = getattr(presets, name)(scenario.bank, scenario.sensor), moved(tracks)
    with torch.no_grad():
        here, far = f(tracks.z, tracks.prior, u=tracks.u), there(f)(data.z, data.prior, u=data.u)
    close(far.mean, here.mean, rtol=1e-7, atol=1e-4)  # interacting models amplify rounding


@KERNELS
def test_scans_of_several_targets_too(compiled, crossing, scans):
    f, data = presets.ukf_jpda(crossing.motion, crossing.sensor, clutter=crossing.clutter), moved(scans)
    with torch.no_grad():
        here, far = f(scans.z, scans.prior), there(f, compiled)(data.z, data.prior)
    close(far.mean, here.mean)


@pytest.mark.parametrize("name", ["srckf", "gpb"])
@KERNELS
def test_the_backward_pass_too(name, compiled, make, tracks):
    f, data = make(name), moved(tracks)
    with torch.no_grad():
        here = f.smooth(tracks.z, tracks.prior, u=tracks.u)
        far = there(f, compiled).smooth(data.z, data.prior, u=data.u)
    close(far.mean, here.mean)


def test_float32_is_as_near_as_on_the_cpu(make, tracks):
    f, errors = make("fra"), []
    with torch.no_grad():
        exact = f(tracks.z, tracks.prior, u=tracks.u).mean
        for device in ("cpu", "cuda"):
            data = moved(tracks, device)
            prior = Gaussian(*(x.float() for x in data.prior))
            g = copy.deepcopy(f).to(device).float().compile()
            errors.append((g(data.z.float(), prior, u=data.u.float()).mean.cpu() - exact).abs().max())
    assert errors[1] < 4 * errors[0] + 1e-2


def test_a_hundred_thousand_tracks_say_what_a_few_say_and_none_say_nothing(make, tracks):
    f, data, count = there(make("fra")), moved(tracks), 25_000
    many = data.prior._replace(mean=data.prior.mean.repeat(count, 1))
    with torch.no_grad():
        few, all_of_them = f(data.z, data.prior, u=data.u), f(data.z.repeat(count, 1, 1), many, u=data.u)
        none = f(data.z[:0], data.prior._replace(mean=data.prior.mean[:0]), u=data.u)
    torch.testing.assert_close(all_of_them.mean, few.mean.repeat(count, 1, 1), rtol=0, atol=0, equal_nan=True)
    assert none.mean.shape == (0, *few.mean.shape[1:])


def test_a_track_that_fails_is_told_apart_and_the_others_go_on(make, tracks):
    f, data = make("srckf"), moved(tracks)
    root = data.prior.scale_tril.expand(len(data.z), -1, -1).clone()
    root[1] = torch.nan
    with torch.no_grad():
        far = there(f)(data.z, data.prior._replace(scale_tril=root), u=data.u)
        alone = there(f)(data.z, data.prior, u=data.u)
    failed = far.failure.step.cpu()
    assert failed[1] >= 0
    assert (failed[[0, 2, 3]] < 0).all()
    torch.testing.assert_close(far.mean[[0, 2, 3]], alone.mean[[0, 2, 3]], rtol=1e-12, atol=1e-9)


def test_what_lies_in_memory_in_any_way_and_calls_again_say_the_same(make, tracks):
    f, data = there(make("srckf")), moved(tracks)
    turned = data.z.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    with torch.no_grad():
        once = [f(z, data.prior, u=data.u).mean for z in (data.z, turned, data.z, data.z)]
    assert all(torch.equal(once[0].nan_to_num(), x.nan_to_num()) for x in once)


def test_kernels_run_on_the_stream_that_is_current(make, tracks):
    f, data = there(make("srckf")), moved(tracks)
    with torch.no_grad():
        expected = f(data.z, data.prior, u=data.u).mean
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            torch.cuda._sleep(50_000_000)  # what was begun on the stream must be done first
            z = data.z + 0
            found = f(z, data.prior, u=data.u).mean
        stream.synchronize()
    assert torch.equal(found.nan_to_num(), expected.nan_to_num())


# ---------------------------------------------------------------- derivatives and learning


@KERNELS
def test_gradients_flow(compiled, make, tracks):
    f, data = there(make("fra", learn="all", temperature=1.0), compiled), moved(tracks)
    f(data.z, data.prior, u=data.u).mean.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())


@pytest.mark.parametrize(("name", "learn"), [("srckf", ("q",)), ("fra", ("q",)), ("gpb", ("noise_levels",))])
def test_gradients_of_kernels_are_those_on_the_cpu(name, learn, make, tracks):
    f, data, found = make(name, learn=learn), moved(tracks), []
    for g, t in ((copy.deepcopy(f).compile(), tracks), (there(f), data)):
        loss = g(t.z, t.prior, u=t.u).mean.square().mean()
        found.append(torch.cat([x.flatten().cpu() for x in torch.autograd.grad(loss, list(g.parameters()))]))
    torch.testing.assert_close(found[1], found[0], rtol=1e-8, atol=0)


def test_derivatives_forwards_are_those_on_the_cpu(make, tracks):
    f, rates = make("srckf").compile(), []
    for g, t in ((f, tracks), (there(f), moved(tracks))):
        with torch.no_grad(), forward_ad.dual_level():
            z = forward_ad.make_dual(t.z.nan_to_num(), torch.ones_like(t.z))
            rates.append(forward_ad.unpack_dual(g(z, t.prior, u=t.u).mean).tangent)
    close(rates[1], rates[0])


@KERNELS
def test_single_steps_run(compiled, make, tracks):
    f, data = make("srckf"), moved(tracks)
    far_filter = there(f, compiled)
    state, far = f.init(tracks.prior), far_filter.init(data.prior)
    for k in range(3):
        state, _ = f.step(state, tracks.z[:, k], u=tracks.u[k])
        far, _ = far_filter.step(far, data.z[:, k], u=data.u[k])
    close(far.belief.mean, state.belief.mean)


@pytest.mark.parametrize("loss", ["likelihood", "smoothed", "robust"])
def test_values_are_fitted_there_to_tracks_from_the_cpu(loss):
    rng = torch.Generator().manual_seed(0)
    truth = torch.randn(120, 30, 4, dtype=torch.float64, generator=rng).cumsum(1)
    prior = Gaussian(torch.zeros(4, dtype=torch.float64), 10 * torch.eye(4, dtype=torch.float64))
    data = {
        "z": truth[..., :2] + 2 * torch.randn(120, 30, 2, dtype=torch.float64, generator=rng),
        "prior": prior,
        "truth": truth,
    }
    found = []
    for device in ("cpu", "cuda"):
        f = presets.srckf(ConstantVelocity(0.5), Position(6.0), learn=("q", "std")).to(device)
        fitted = torchfra.fit(f, data, loss=loss, iterations=4, seed=0, quiet=True)
        assert next(fitted.filter.buffers()).device.type == device
        profile = fitted.profile("sensor.std", points=3).growth
        errors = [fitted.errors, fitted.bootstrap(10).errors]
        found.append([*fitted.learned.values(), *profile, *(x for table in errors for x in table.values())])
    assert found[1] == pytest.approx(found[0], rel=1e-4, abs=1e-6)
