"""The closed form that cleans tracks and the module ``GPB`` are one filter."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchfra
from torchfra.cleaning.as_module import as_gpb
from torchfra.cleaning.closed_form import Fixes, Levels, OutlierModel
from torchfra.cleaning.two_filters import filtered
from torchfra.filters import GPB
from torchfra.linalg.triangular import tria
from torchfra.types import Gaussian

TRACKS, STEPS, SIGMA = 4, 60, 4.0
MODEL = OutlierModel(after_inlier=torch.full((TRACKS,), 0.03, dtype=torch.float64), after_outlier=0.6, same_offset=0.4)


class Alike(GPB):
    """Covariances are the mean of those of the axes, as in the closed form, after every merge."""

    def mix(self, before, switching):
        mixed, mixing = super().mix(alike(before), switching)
        return alike(mixed), mixing


def alike(belief):
    mean, root = belief
    d = mean.shape[-1] // 2
    one = tria(torch.cat([root[..., axis::d, :] for axis in range(d)], -1) / d**0.5)
    return Gaussian(mean, torch.kron(one, torch.eye(d, dtype=root.dtype)))


def levels():
    q, share, last, walk = torch.tensor([
        [1e-3, 0.1, 5.0, 80.0, 1e-3], [0.4, 0.3, 0.2, 0.1, 0.1], [300.0, 90.0, 40.0, 15.0, 200.0],
        [0.0, 0.0, 0.0, 0.0, 900.0],
    ]).double()  # fmt: skip
    share = share / share.sum()
    return Levels(*(x[:, None].expand(-1, TRACKS) for x in (q, share.log(), last, walk)))


@pytest.fixture
def fixes(request):
    """Tracks with turns, gaps, missing fixes, outliers and bursts, of which some have one offset."""
    g, d = torch.Generator().manual_seed(11), request.param

    def normal(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=g)

    gap = 0.3 + 4 * torch.rand(STEPS, TRACKS, dtype=torch.float64, generator=g)
    gap[30] = 90.0
    velocity = 20 + (
        normal(STEPS, d, TRACKS) * torch.where(torch.arange(STEPS) % 20 < 5, 9.0, 0.1)[:, None, None]
    ).cumsum(0)
    z = (gap.unsqueeze(1) * velocity).cumsum(0) + SIGMA * normal(STEPS, d, TRACKS)
    z[8] += 300
    z[16:21] += 500 * normal(d, TRACKS)
    z[40:43, :, :2] += 300 * normal(3, d, 2)
    z[12, :, 0] = z[18, :, 1] = z[25:28, :, 2] = torch.nan
    return Fixes(z, gap, torch.full_like(gap, SIGMA**2), torch.zeros_like(gap))


def run(f, fixes, track):
    """What a module says of one track, with a step for each fix."""
    there = (~fixes.missing[:, track]).nonzero()[:, 0].tolist()
    first = fixes.z[there[:9], :, track]
    middle = first.nanquantile(0.5, dim=0)
    d = len(middle)
    std = torch.cat([(1e8 + (first - middle).abs().mean() ** 2).sqrt().expand(d), middle.new_full((d,), 1e5**0.5)])
    state = f.init(Gaussian(torch.cat([middle, torch.zeros_like(middle)]).expand(TRACKS, -1), std.diag()))
    state = state._replace(outlier=torch.ones_like(state.outlier))  # outliers are as likely as in the long run
    for k in there:
        state, innovation = f.step(state, fixes.z[k, :, track].expand(TRACKS, -1), dt=fixes.elapsed[k, track])
        yield k, tuple(x[track] for x in (state.belief.mean, state.belief.covariance, state.log_weights.exp(),
                                          innovation.log_likelihood))  # fmt: skip


@pytest.mark.parametrize(("fixes", "track"), [(1, 0), (1, 2), (2, 1), (2, 3)], indirect=["fixes"])
def test_beliefs_probabilities_and_likelihoods_are_the_same(fixes, track):
    known = filtered(fixes, levels(), MODEL)
    d = fixes.z.shape[1]
    f = as_gpb(levels(), torch.full((TRACKS,), SIGMA, dtype=torch.float64), MODEL, d)
    f.__class__ = Alike
    burst = 0.0
    for k, (mean, covariance, weights, log_likelihood) in run(f, fixes, track):
        belief = known.belief
        position, velocity = belief.position[:, k, track], belief.velocity[:, k, track]
        assert_close(mean, torch.cat([position, velocity]), rtol=1e-9, atol=1e-9)
        parts = covariance.reshape(2, d, 2, d).diagonal(dim1=1, dim2=3).mean(-1)
        pp, pv, vv = (x[k, track] for x in belief[2:])
        assert_close(parts, torch.stack([torch.stack([pp, pv]), torch.stack([pv, vv])]), rtol=1e-9, atol=1e-9)
        assert_close(weights[1].sum(), known.outlier[k, track], rtol=1e-9, atol=1e-9)
        assert_close(weights.sum(0), known.levels[k, :, track], rtol=1e-9, atol=1e-9)
        assert_close(log_likelihood, known.predictions.log_likelihood[k, track], rtol=1e-9, atol=1e-9)
        burst = max(burst, weights[1].sum().item())
    assert burst > 0.99


@pytest.mark.parametrize("dims", [2, 3])
def test_a_cleaned_track_gives_its_filters_which_track_on_from_its_end(dims):
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 160.0, 2.0)
    path = np.outer(time, [30.0, 10.0, 2.0][:dims])
    cleaned = torchfra.clean((time, path + 10 * rng.standard_normal(path.shape)), bank="aircraft")
    parts = [[0, 1, dims, dims + 1], [2, 5]][: dims - 1]
    assert len(cleaned.filters()) == len(parts)
    for f, part in zip(cleaned.filters(), parts, strict=True):
        root = np.linalg.cholesky(cleaned.covariance[-1][np.ix_(part, part)])
        state = f.init(Gaussian(torch.from_numpy(cleaned.mean[-1:, part]), torch.from_numpy(root[None])))
        axes = part[: len(part) // 2]
        ahead = torch.from_numpy(path[-1:, axes] + np.array([60.0, 20.0, 4.0])[axes])
        good, wrong = (f.faulty(f.step(state, ahead + off, dt=2.0)[0]).item() for off in (0.0, 900.0))
        assert good < 0.05
        assert wrong > 0.95


@pytest.mark.parametrize("value", [lambda x: x.sigma, lambda x: x.levels.q, lambda x: x.model.after_inlier])
def test_gradients_flow_through_what_a_track_was_cleaned_with(value):
    time = np.arange(0.0, 40.0, 2.0)
    (used,) = torchfra.clean((time, np.outer(time, [30.0, 10.0])), bank="aircraft").parameters
    factor = torch.ones(1, dtype=torch.float64, requires_grad=True)
    (factor * value(used)).sum().backward()
    assert_close(factor.grad, value(used).sum().reshape(1))


def test_other_filters_give_none():
    time = np.arange(20.0)
    assert torchfra.clean((time, np.outer(time, [3.0, 1.0])), filter="srckf", bank="person").filters() == ()


def test_fixes_that_state_how_good_they_are_give_a_sensor_in_metres(tmp_path):
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 400.0, 2.0)
    x, y = np.outer(time, [3.0, 1.0]).T + 30 * rng.standard_normal((2, len(time)))
    rows = [f"{t},{a},{b},30.0" for t, a, b in zip(time, x, y, strict=True)]
    file = tmp_path / "track.csv"
    file.write_text("\n".join(["time,x,y,accuracy", *rows]))
    (cleaned,) = torchfra.clean(file, bank="person")
    assert cleaned.found.stated
    assert 15 < cleaned.parameters[0].sigma.item() < 45
