"""Smoothing keeps every promise of a filter: batches, dtypes, gradients, vmap, checkpoints, compiled filters."""

import pytest
import torch
from conftest import STEPS

from torchfra import Gaussian, presets, scenarios
from torchfra.compiler import backward
from torchfra.filters.whole_tracks import WholeTracks
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

NAMES = ["ekf", "srckf", "rsrckf", "asrckf", "rmckf", "iaukf", "ghckf", "hghckf1", "hghckf2", "fra"]
LAGS = [None, 3]
MOTION, SENSOR = ConstantVelocity(1.0), Position(2.0)
PRIOR = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
Z = torch.zeros(6, 2).double()
DT = torch.linspace(0.5, 1.5, 4 * STEPS).double().reshape(4, STEPS)


def close(a, b, tol=1e-9):
    torch.testing.assert_close(tuple(a[:2]), tuple(b[:2]), rtol=tol, atol=tol)


@pytest.mark.parametrize(("name", "lag"), [("iaukf", 3), ("hghckf2", 3), ("fra", None), ("fra", 3)])
def test_a_batch_and_vmap_are_a_loop_over_tracks(make, tracks, name, lag):
    f, root = make(name), tracks.prior.scale_tril

    def smooth(z, mean):
        return tuple(f.smooth(z, Gaussian(mean, root), u=tracks.u, lag=lag)[:2])

    together = smooth(tracks.z, tracks.prior.mean)
    alone = [torch.stack(x) for x in zip(*map(smooth, tracks.z, tracks.prior.mean), strict=True)]
    close(together, alone)
    close(torch.func.vmap(smooth)(tracks.z, tracks.prior.mean), together)


@pytest.mark.parametrize("name", ["srckf", "iaukf", "fra"])
def test_what_the_filter_said_is_handed_on_and_can_be_handed_in(make, tracks, name, monkeypatch):
    f = make(name)
    kept = f(tracks.z, tracks.prior, u=tracks.u, past=True)
    smoothed, filtered = f.smooth(tracks.z, tracks.prior, u=tracks.u), f(tracks.z, tracks.prior, u=tracks.u)
    torch.testing.assert_close(smoothed.info.filtered, filtered, equal_nan=True)
    assert torch.equal(smoothed.nis, filtered.nis)
    assert torch.equal(smoothed.log_likelihood, filtered.log_likelihood)
    close(f.smooth(tracks.z, tracks.prior, u=tracks.u, estimate=filtered), smoothed, tol=0)
    monkeypatch.setattr(WholeTracks, "_run", None)  # whoever has the past need not run the filter again
    close(f.smooth(tracks.z, tracks.prior, u=tracks.u, estimate=kept), smoothed, tol=0)
    assert torch.equal(smoothed.mean[:, -1], filtered.mean[:, -1])


@pytest.mark.parametrize("lag", LAGS)
def test_compiled_tracks_may_have_values_of_their_own(lag):
    """Of as many tracks as there are windows of a lag, so that one might be taken for the other."""
    f = presets.srckf(ConstantVelocity(torch.tensor([0.5, 1.0, 2.0]).double()), Position(2.0))
    z = torch.randn(3, 6, 2, generator=torch.Generator().manual_seed(1)).double()
    prior = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
    close(f.smooth(z, prior, lag=lag)[:4], f.compile().smooth(z, prior, lag=lag)[:4], tol=1e-10)


@pytest.mark.parametrize("lag", LAGS)
def test_time_steps_may_differ_by_step_and_by_track(tracks, lag):
    f, dt = presets.srckf(MOTION, SENSOR), 0.5 + torch.rand(3, 6).double()
    z = 3 * torch.randn(3, 6, 2).double()
    together = f.smooth(z, PRIOR, dt=dt, lag=lag)
    for b in range(3):
        close([x[b] for x in together[:2]], f.smooth(z[b], PRIOR, dt=dt[b], lag=lag))


def test_float32_is_float64_to_its_rounding(make, tracks):
    single = [x.float() for x in (tracks.z, *tracks.prior, tracks.u)]
    for name in NAMES[:3]:
        double = make(name).smooth(tracks.z, tracks.prior, u=tracks.u)
        z, mean, root, u = single
        low = make(name).smooth(z, Gaussian(mean, root), u=u)
        assert low.mean.dtype == torch.float32
        size = double.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        assert ((low.mean - double.mean) / size).abs().max() < 0.02
        assert (low.covariance.diagonal(dim1=-2, dim2=-1).sqrt() / size - 1).abs().max() < 0.02


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize(("name", "learn"), [("srckf", ("q",)), ("rsrckf", ("threshold",)), ("asrckf", ("weakening",))])
def test_gradients_are_exact(make, tracks, name, learn, lag):
    f = make(name, learn=learn)
    names = [path for path, _ in f.named_parameters()]

    def smooth(z, mean, *values):
        arguments = (z, Gaussian(mean, tracks.prior.scale_tril)), {"u": tracks.u[:6], "lag": lag}
        smoothed = torch.func.functional_call(_Smooth(f), {f"f.{n}": v for n, v in zip(names, values, strict=True)},
                                              *arguments)  # fmt: skip
        return tuple(x / 100 for x in smoothed[:2])

    z = tracks.z[:1, :6].clone()
    z = torch.where(z.isnan(), torch.nan, z)
    values = [p.detach().clone().requires_grad_() for p in f.parameters()]
    inputs = (z.requires_grad_(), tracks.prior.mean[:1].clone().requires_grad_(), *values)
    assert torch.autograd.gradcheck(smooth, inputs, eps=1e-6, rtol=1e-4, atol=1e-5, fast_mode=True)


class _Smooth(torch.nn.Module):
    """A filter whose call is to smooth."""

    def __init__(self, f):
        super().__init__()
        self.f = f

    def forward(self, *args, **options):
        return self.f.smooth(*args, **options)


@pytest.mark.parametrize("lag", LAGS)
def test_checkpoints_leave_the_gradient(make, tracks, lag):
    f = make("fra", learn="all")

    def gradient(**options):
        smoothed = f.smooth(tracks.z, tracks.prior, u=tracks.u, lag=lag, **options)
        loss = smoothed.mean.square().sum() + smoothed.scale_tril.square().sum()
        return torch.autograd.grad(loss, list(f.parameters()), allow_unused=True)

    torch.testing.assert_close(gradient(checkpoint=3), gradient(), rtol=1e-9, atol=0.0)


def test_a_prior_without_uncertainty_and_a_motion_without_noise_have_finite_gradients():
    f = presets.srckf(ConstantVelocity(0.0), SENSOR)
    mean = torch.ones(4).double().requires_grad_()
    smoothed = f.smooth(torch.randn(5, 2).double(), Gaussian(mean, torch.zeros(4, 4).double()))
    (gradient,) = torch.autograd.grad(smoothed.mean[:, :2].sum() + smoothed.scale_tril.sum(), mean)
    torch.testing.assert_close(gradient, torch.tensor([5.0, 5.0, 15.0, 15.0]).double())


def test_values_may_differ_by_track(make, tracks):
    thresholds = torch.tensor([[0.8], [1.5], [3.0]]).double()
    f, together = make("rsrckf"), make("rsrckf", threshold=thresholds)
    smoothed = together.smooth(tracks.z, tracks.prior, u=tracks.u)
    assert smoothed.mean.shape == (3, 4, STEPS, 4)
    for i, threshold in enumerate(thresholds[:, 0]):
        f.robust.threshold.set(threshold)
        close([x[i] for x in smoothed[:2]], f.smooth(tracks.z, tracks.prior, u=tracks.u))


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"lag": 3}, {"dt": DT}, {"dt": DT, "lag": 3}])
def test_a_compiled_filter_smooths_as_one_that_is_not(make, tracks, options):
    f, fast = make("rsrckf"), make("rsrckf").compile()
    slow = f.smooth(tracks.z, tracks.prior, u=tracks.u, **options)
    close(fast.smooth(tracks.z, tracks.prior, u=tracks.u, **options), slow)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"dt": 0.5 + torch.rand(4, 1).double()}])
def test_with_a_lag_a_compiled_filter_that_decides_late_smooths_as_one_that_is_not(make, tracks, options, monkeypatch):
    """Also where not all windows are taken at once."""
    monkeypatch.setattr(backward, "_AT_ONCE", 80)
    f, fast, z = make("fra"), make("fra").compile(), tracks.z.clone()
    z[:, 7] += 0.4
    for lag in (1, 4, 11):
        slow = f.smooth(z, tracks.prior, u=tracks.u, lag=lag, **options)
        quick = fast.smooth(z, tracks.prior, u=tracks.u, lag=lag, **options)
        close(quick, slow, tol=1e-10)
    assert slow.info.filtered.info.abnormal[:, 7].any()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "learn", "lag"), [("asrckf", ("weakening", "q"), None), ("fra", ("q",), 3)])
def test_gradients_of_a_compiled_filter_are_the_same(make, tracks, name, learn, lag):
    slow, fast = make(name, learn=learn), make(name, learn=learn).compile()
    losses, inputs = [], []
    for f in (slow, fast):
        z = tracks.z.clone().requires_grad_()
        smoothed = f.smooth(z, tracks.prior, u=tracks.u, lag=lag)
        losses.append(smoothed.mean.square().sum() + smoothed.scale_tril.square().sum())
        inputs.append([z, *f.parameters()])
    torch.testing.assert_close(*losses, rtol=1e-9, atol=0.0)
    gradients = [torch.autograd.grad(loss, values) for loss, values in zip(losses, inputs, strict=True)]
    torch.testing.assert_close(*gradients, rtol=1e-8, atol=1e-8)


def test_a_compiled_motion_that_is_not_linear_goes_back_too():
    scenario = scenarios.growth()
    tracks = scenario.simulate(3, 0)
    f = presets.ghckf(scenario.motion, scenario.sensor)
    given = (tracks.z[:, :10], tracks.prior), {"u": tracks.u[..., :10, :], "dt": scenario.dt}
    slow, fast = f.smooth(*given[0], **given[1]), f.compile().smooth(*given[0], **given[1])
    close(fast, slow, tol=1e-7)


def test_a_track_of_one_step_is_filtered():
    f = presets.srckf(MOTION, SENSOR)
    close(f.smooth(Z[:1], PRIOR), f(Z[:1], PRIOR), tol=0)
    close(f.smooth(Z[:1], PRIOR, lag=2), f(Z[:1], PRIOR), tol=0)


def test_a_track_that_fails_fails_alone():
    f, z = presets.srckf(MOTION, SENSOR), torch.randn(2, 6, 2).double()
    z[0, 3] = torch.inf
    smoothed = f.smooth(z, PRIOR)
    assert smoothed.failed.tolist() == [True, False]
    close([x[1] for x in smoothed[:2]], f.smooth(z[1], PRIOR))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f: f.smooth(Z, PRIOR, lag=0), r"lag: expected at least 1 step, received 0"),
        (lambda f: f.smooth(Z, PRIOR, dt=-1.0), r"dt: expected seconds above 0"),
        (lambda f: f.smooth(Z, PRIOR, estimate=f(Z[:4], PRIOR)), r"estimate: .*\(6, 4\), received \(4, 4\)"),
        (lambda f: f.smooth(Z, PRIOR, estimate=f(Z, PRIOR), dt=-1.0), r"dt: expected seconds above 0"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(presets.srckf(MOTION, SENSOR))


def test_compiled_a_certain_direction_tells_nothing_either():
    f = presets.srckf(ConstantVelocity(0.0), SENSOR)  # no noise: velocities stay what they were
    root = torch.diag(torch.tensor([3.0, 0.0, 0.5, 0.0])).double()  # nothing is uncertain along y
    z = torch.randn(5, 6, 2, generator=torch.Generator().manual_seed(0)).double()
    eager = f.smooth(z, Gaussian(PRIOR.mean, root))
    fast = f.compile().smooth(z, Gaussian(PRIOR.mean, root))
    close(fast, eager)
    assert (fast.scale_tril[..., 1, :].abs() < 1e-12).all()
