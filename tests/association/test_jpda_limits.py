"""Joint association becomes the filter inside where nothing is in doubt, and survives what cannot be."""

import math
from functools import partial

import pytest
import torch
from joint import STEPS, flat_prior, make, plane

from torchfra import presets, scenarios
from torchfra.association import ChiSquare, Clutter, Euclidean
from torchfra.filters.scans.lost_tracks import lost_inflation
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.types import Gaussian


@pytest.mark.slow
@pytest.mark.parametrize("inner", [presets.ekf, presets.ghckf, presets.rsrckf, presets.hghckf2, presets.iaukf])
def test_without_false_measurements_and_always_detected_it_is_the_filter_itself(inner):
    s = scenarios.noise_change()
    t = s.simulate(3, 0)
    t = t._replace(z=t.z[:, :30])
    plain = inner(s.motion, s.sensor)(t.z, t.prior)
    around = presets.jpda(s.motion, s.sensor, clutter=Clutter(1e9), inner=inner, detection=1.0, gate=Euclidean(1e7))
    prior = Gaussian(t.prior.mean.unsqueeze(1), t.prior.scale_tril.unsqueeze(1))
    joint = around(t.z.unsqueeze(-2), prior)
    torch.testing.assert_close(joint.mean[:, 0], plain.mean, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(joint.scale_tril[:, 0], plain.scale_tril, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(joint.nis[:, 0], plain.nis, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("inner", [presets.asrckf, presets.rmckf, presets.mr_ckf])
def test_fading_factors_are_those_of_the_filter_itself_too(inner):
    """A target that turns away from its model, with missing elements."""
    t = torch.arange(1, 31, dtype=torch.float64)
    z = torch.stack([t, 0.2 * (t - 12).clamp_min(0) ** 2], -1)
    z = z + 2 * torch.randn(30, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    z[7, 0], z[9], prior = math.nan, math.nan, flat_prior((0.0, 0.0))
    plain = inner(ConstantVelocity(0.01, 2), Position(2.0))(z, Gaussian(prior.mean[0], prior.scale_tril[0]))
    around = presets.jpda(ConstantVelocity(0.01, 2), Position(2.0), inner=inner, detection=1.0, clutter=Clutter(1e9),
                          gate=Euclidean(1e4))  # fmt: skip
    joint = around(z.unsqueeze(1), prior)
    torch.testing.assert_close(joint.mean[0], plain.mean, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(joint.scale_tril[0], plain.scale_tril, rtol=1e-8, atol=1e-10)
    if inner is not presets.mr_ckf:
        assert plain.info.fading.max() > 2
        torch.testing.assert_close(joint.info.fading[0], plain.info.fading, rtol=1e-8, atol=1e-8)
        both = around(z.unsqueeze(1), flat_prior((0.0, 0.0), (1e5, 1e5)))
        torch.testing.assert_close(both.mean[0], joint.mean[0])


def test_a_missed_target_does_not_fade_whatever_else_was_measured_in_a_batch_too():
    rng = torch.Generator().manual_seed(0)
    own = 60 * torch.randn(16, 1, 2, dtype=torch.float64, generator=rng)
    own[10:12] = math.nan
    far = torch.full((16, 1, 2), 5e4).double()
    f = presets.jpda(ConstantVelocity(0.1, 2), Position(10.0), inner=partial(presets.asrckf, weakening=1.0),
                     clutter=Clutter(1e8), gate=Euclidean(1000.0))  # fmt: skip
    one, other = (f(torch.cat(scan, 1), flat_prior((0.0, 0.0))) for scan in ((own, far), (far, own)))
    assert one.info.fading.max() > 2
    assert (one.info.fading[0, 10:12] == 1).all()
    torch.testing.assert_close(one.mean, other.mean)
    both = f(torch.stack([torch.cat(scan, 1) for scan in ((own, far), (far, own))]), flat_prior((0.0, 0.0)))
    torch.testing.assert_close(both.mean, torch.stack([one.mean, other.mean]))


@pytest.mark.slow
def test_a_measurement_that_cannot_be_lets_all_others_count(crossing, scans):
    """An elevation beyond the vertical, a range below 0 and one of 0."""
    f, z = make("iaukf_jpda", crossing, learn=("detection", "volume")), scans.z.clone()
    plain = f(torch.cat([z, torch.full((3, STEPS, 1, 3), math.nan).double()], 2), scans.prior).mean
    for outlying in ([1.0, 1.7, 2000.0], [1.0, 0.5, -3.0], [1.0, 0.5, 0.0]):
        more = torch.tensor(outlying).double().expand(3, STEPS, 1, 3)
        estimate = f(torch.cat([z, more], 2), scans.prior)
        torch.testing.assert_close(estimate.mean, plain)
        gradients = torch.autograd.grad(estimate.log_likelihood.sum(), list(f.parameters()))
        assert all(gradient.isfinite() for gradient in gradients)


@pytest.mark.parametrize("far", [30.0, 300.0, 3000.0])
def test_a_target_that_is_always_measured_follows_however_far_its_measurement_is(far):
    f = plane(detection=1.0, gate=Euclidean(1e9), clutter=Clutter(1e9))
    z = torch.tensor([[[far, 0.0]]], dtype=torch.float64)
    plain = presets.srckf(ConstantVelocity(0.5, 2), Position(2.0))(z[0], flat_prior((0.0, 0.0))._replace(
        mean=flat_prior((0.0, 0.0)).mean[0], scale_tril=flat_prior((0.0, 0.0)).scale_tril[0]))  # fmt: skip
    estimate = f(z, flat_prior((0.0, 0.0)))
    torch.testing.assert_close(estimate.mean[0], plain.mean)
    assert estimate.info.association[0, 0].tolist() == [0.0, 1.0]


def test_targets_far_apart_are_filtered_alone():
    near, far = (0.0, 0.0), (1e4, 0.0)
    z = torch.randn(10, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 4
    z[:, 2] += torch.tensor(far)
    f = plane()
    both = f(z, flat_prior(near, far))
    one, two = f(z, flat_prior(near)), f(z, flat_prior(far))
    torch.testing.assert_close(both.mean, torch.cat([one.mean, two.mean]))
    torch.testing.assert_close(both.log_likelihood, torch.cat([one.log_likelihood, two.log_likelihood]))


def test_a_row_of_nan_and_the_order_of_measurements_do_not_matter(crossing, scans):
    f = make("iaukf_jpda", crossing)
    plain = f(scans.z, scans.prior)
    order = [3, 1, 7, 0, 2, 6, 5, 4]
    padded = torch.cat([scans.z[:, :, order], torch.full((3, STEPS, 2, 3), math.nan).double()], 2)
    other = f(padded, scans.prior)
    torch.testing.assert_close(other.mean, plain.mean, rtol=1e-9, atol=1e-11)
    moved = other.info.association[..., 1:9]
    torch.testing.assert_close(moved, plain.info.association[..., 1:][..., order], rtol=1e-6, atol=1e-9)
    assert (other.info.association[..., 9:] == 0).all()


def test_a_lost_track_searches_and_finds_and_a_dead_one_stays_finite():
    """A start 60 m off, of a track that believes in 3 m: within 15 scans it is back with its target."""
    f = {lost: plane(lost=lost, gate=ChiSquare(0.99), clutter=Clutter(1e5, rate=0.5)) for lost in (0.0, 1e-3)}
    for g in f.values():
        g.motion.q.set(1e-3)
    t = torch.arange(1, 41, dtype=torch.float64)
    truth = torch.stack([60 + t, 0 * t], -1)
    z = truth.unsqueeze(1) + torch.randn(40, 1, 2, generator=torch.Generator().manual_seed(0)).double()
    far = {lost: (g(z, flat_prior((0.0, 0.0))).mean[0, :, :2] - truth).norm(dim=-1) for lost, g in f.items()}
    assert far[0.0][:15].min() > 20
    assert far[1e-3][15:].max() < 5
    z[10:] = 1e4  # another place altogether
    assert f[1e-3](z, flat_prior((60.0, 0.0))).scale_tril.isfinite().all()


def test_a_track_that_searches_does_not_widen_further_while_nothing_is_measured_at_all():
    f = plane(lost=1e-2, gate=ChiSquare(0.99))
    z = torch.full((30, 1, 2), math.nan).double()
    z[:5] = 1e4
    searching, patient = (g(z, flat_prior((0.0, 0.0))) for g in (f, plane(gate=ChiSquare(0.99))))
    ratio = (searching.scale_tril[0, :, 0, 0] / patient.scale_tril[0, :, 0, 0]).log2()
    assert ratio[4] > 1
    assert ratio.max() < 5.5


@pytest.mark.parametrize("name", ["jpda", "ukf_jpda", "iaukf_jpda"])
def test_an_infinite_false_measurement_is_no_target_s(name):
    start = torch.tensor([[0.0, 0, 1, 0], [500, 0, 1, 0]]).double()
    rng = torch.Generator().manual_seed(0)
    z = start[:, :2] + torch.arange(1, 11)[:, None, None] * start[:, 2:] + torch.randn(10, 2, 2, generator=rng)
    z = torch.cat([z, torch.full((10, 1, 2), torch.nan)], 1).double()
    other = z.clone()
    other[5, 2] = torch.tensor([torch.inf, 0.0])
    f = getattr(presets, name)(ConstantVelocity(1.0), Position(1.0), clutter=Clutter(1e6, rate=1.0))
    prior = Gaussian(start, torch.diag(torch.tensor([5.0, 5, 2, 2]).double()))
    estimate = f(other, prior)
    assert not estimate.failed.any()
    torch.testing.assert_close(estimate.mean, f(z, prior).mean, rtol=1e-4, atol=1e-3)


def test_roots_of_other_targets_than_the_means_are_refused():
    with pytest.raises(
        ValueError, match=r"^prior\.scale_tril: expected one for each of 3 targets, received \(2, 4, 4\)$"
    ):
        plane()(torch.zeros(5, 3, 2), Gaussian(torch.zeros(3, 4), torch.eye(4).expand(2, 4, 4)))


def test_a_track_is_lost_from_the_misses_on_that_are_less_probable_than_stated():
    missed, none = torch.tensor([2.0, 3.0, 4.0, 5.5]), torch.zeros(4)
    factor, times = lost_inflation(missed, none, torch.tensor(0.1).log(), 1e-3)  # three in a row are as probable
    torch.testing.assert_close(times, torch.tensor([0.0, 0.0, 1.0, 2.5]))
    torch.testing.assert_close(factor, 2.0**times)
