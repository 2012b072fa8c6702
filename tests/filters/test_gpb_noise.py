"""GPB learns the scale of each block's measurement noise, where it is asked to."""

import math

import pytest
import torch
from alike import close
from gpb_cases import ANCHORS, MOTION, PRIOR, VALUES, measured
from torch.testing import assert_close

from torchfra import metrics, presets, scenarios, tree
from torchfra.association import Clutter
from torchfra.filters.gpb.noise import NoiseScale
from torchfra.sensors import Position, Ranges

RANGES = Ranges(ANCHORS[:2], 2.0)


def learned(sensor=RANGES, **options):
    values = VALUES | {"noise": "learned", "noise_doubt": 0.9, "noise_memory": 8.0}
    return presets.gpb(MOTION, sensor, **values | options)


def seen(runs=3):
    """Ranges of which some are missing."""
    return measured("ranges", runs)[..., :2]


def rmse(estimate, tracks):
    return metrics.rmse(estimate.mean, tracks.truth, slice(0, 2)).mean().item()


@pytest.mark.slow
@pytest.mark.parametrize("stated", [0.5, 2.0])
def test_noise_that_is_stated_twice_off_is_found(stated):
    cell = scenarios.as_stated("velocity", index=0.1, std=stated)
    tracks = cell.simulate(runs=32, seed=71)
    f = presets.gpb(cell.motion, cell.sensor, noise="learned").compile()
    best, found = (g(tracks.z, tracks.prior, dt=cell.dt) for g in (presets.iaukf(cell.motion, cell.sensor), f))
    assert rmse(found, tracks) < 1.08 * rmse(best, tracks)
    assert 0.6 < found.info.noise[:, -1].log().mean().exp() * stated**2 < 1.6


def test_noise_that_is_stated_right_costs_little():
    cell = scenarios.as_stated("velocity", index=0.1)
    tracks = cell.simulate(runs=64, seed=72)
    each = (presets.gpb(cell.motion, cell.sensor, noise=noise).compile() for noise in ("stated", "learned"))
    stated, found = (f(tracks.z, tracks.prior, dt=cell.dt) for f in each)
    assert rmse(found, tracks) < 1.01 * rmse(stated, tracks)
    assert (stated.info.noise == 1).all()


def test_what_is_not_measured_says_nothing_about_the_noise():
    f, z = learned(), seen(1)[0]
    z[5:, 1] = math.nan
    noise = f(z, PRIOR).info.noise
    assert (noise[5:, 1] == noise[4, 1]).all()
    assert noise[-1, 0] != noise[4, 0]


@pytest.mark.slow
def test_a_track_is_its_steps_and_smooths_and_compiles_alike():
    f, z = learned(), seen()
    whole, state = f(z, PRIOR), f.init(tree.map_tensors(lambda x: x.expand(3, *x.shape), PRIOR))
    for k in range(z.shape[-2]):
        state, _ = f.step(state, z[:, k])
    close(state.belief.mean, whole.mean[:, -1])
    close(state.noise.log_scale.exp(), whole.info.noise[:, -1])
    smoothed = f.smooth(z, PRIOR)
    close(smoothed.mean[:, -1], whole.mean[:, -1])
    kernels = learned().compile()
    close(kernels(z, PRIOR).mean, whole.mean)
    close(kernels(z, PRIOR).info.noise, whole.info.noise)
    close(kernels.smooth(z, PRIOR).mean, smoothed.mean)


def test_a_step_of_another_sensor_leaves_what_was_learned_as_it_is():
    f, z = learned(), seen()[:, 0]
    state, _ = f.step(f.init(tree.map_tensors(lambda x: x.expand(3, *x.shape), PRIOR)), z)
    after, _ = f.step(state, z[..., :2] * 0 + 50.0, sensor=Position(5.0))
    assert_close(after.noise, state.noise, rtol=0, atol=0)


def test_a_forecast_has_the_noise_that_was_learned():
    f, z = learned(), seen()
    e = [learned(noise_doubt=doubt)(z, PRIOR) for doubt in (1e-6, 0.9)]
    stated = presets.gpb(MOTION, RANGES, **VALUES)(z, PRIOR)
    assert_close(e[0].nis, stated.nis, rtol=1e-5, atol=1e-5)
    assert_close(e[0].log_likelihood, stated.log_likelihood, rtol=1e-5, atol=1e-5)
    assert (e[1].log_likelihood - stated.log_likelihood).abs().max() > 0.01
    state, louder = f.init(PRIOR), f.init(PRIOR)
    louder = louder._replace(noise=louder.noise._replace(log_scale=louder.noise.log_scale + math.log(4.0)))
    each = [f.predict(x, 1.0).measurement.covariance.diagonal(dim1=-2, dim2=-1) for x in (state, louder)]
    kept = math.exp(-1 / 8.0)
    assert_close(each[1] - each[0], torch.full((2,), (4**kept - 1) * 4.0, dtype=torch.float64))


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences_and_finite_at_extreme_outliers():
    z = seen(1)[0, :5].nan_to_num(nan=100.0)

    def end(z):
        return learned()(z, PRIOR).info.noise[-1].sum()

    assert torch.autograd.gradcheck(end, z.requires_grad_(True), rtol=1e-4, atol=1e-7, fast_mode=True)
    for dtype in (torch.float32, torch.float64):
        far = seen(1)[0].to(dtype).nan_to_num(nan=100.0)
        far[3] = torch.finfo(dtype).max ** 0.45
        far.requires_grad_(True)
        e = learned()(far, tree.map_tensors(lambda x, d=dtype: x.to(d), PRIOR))
        (slope,) = torch.autograd.grad(e.info.noise.sum() + e.mean.sum(), far)
        assert e.info.noise.isfinite().all()
        assert slope.isfinite().all()


def test_in_clutter_each_target_has_learned_noise_of_its_own():
    sensor, prior = Position(5.0), tree.map_tensors(lambda x: x.expand(2, *x.shape), PRIOR)
    f = presets.jpda(MOTION, sensor, clutter=Clutter(1e6), inner=lambda motion, own: learned(own))
    mean = prior.mean.clone()
    mean[1, :2] += 400.0
    path = mean[:, None, :2] + torch.arange(1, 13, dtype=torch.float64)[:, None] * torch.tensor([9.0, 0.0])
    noise = torch.randn(2, 12, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    z = path + noise * torch.tensor([2.0, 12.0])[:, None, None]
    scans = torch.cat([z.transpose(0, 1), z[:1, :, :].transpose(0, 1) + 150.0], 1)  # (12, 3, 2), the last clutter
    state = f.init(prior._replace(mean=mean))
    for scan in scans:
        state, _ = f.step(state, scan)
    assert all(x.isfinite().all() for x in tree.flatten(state))
    known = next(x for x in walk(state) if isinstance(x, NoiseScale))
    assert known.log_scale[0] < 0 < known.log_scale[1]


def walk(x):
    """A tree's named tuples."""
    if isinstance(x, tuple):
        yield x
        for part in x:
            yield from walk(part)


def test_another_word_is_refused():
    with pytest.raises(ValueError, match=r"noise: expected one of \('stated', 'learned'\), received 'known'"):
        presets.gpb(MOTION, RANGES, noise="known")
