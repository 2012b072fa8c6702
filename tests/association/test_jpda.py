"""Joint association around a filter is that of plain loops and of the paper, and names what does not fit."""

import math

import numpy as np
import oracles
import pytest
import torch
from joint import PAPER, flat_prior, make, plane

from torchfra import metrics, presets, scenarios
from torchfra.association import ChiSquare, Clutter, Euclidean
from torchfra.filters import JPDA, SRCKF
from torchfra.motion import Bank, ConstantVelocity
from torchfra.sensors import Bearings, Position
from torchfra.types import Gaussian


@pytest.mark.parametrize(("name", "how"), [("ukf_jpda", None), ("iaukf_jpda", oracles.Tuned())])
@pytest.mark.parametrize("rate", [None, 6.0])
def test_the_whole_filter_is_that_of_plain_loops(crossing, scans, name, how, rate):
    clutter = Clutter(2 * 400.0**3, rate=rate)
    estimate = make(name, crossing, clutter=clutter, **PAPER)(scans.z, scans.prior)
    dt = torch.tensor(1.0, dtype=torch.float64)
    F, root = crossing.motion.cartesian.transition(dt).numpy(), crossing.motion.cartesian.process_noise(dt)
    root = root.expand(2, 6, 3)[0]
    for b in range(len(scans.z)):
        P = (scans.prior.scale_tril[b] @ scans.prior.scale_tril[b].mT).numpy()
        truth = oracles.jpda(
            scans.z[b].numpy(), scans.prior.mean[b].numpy(), P, F, (root @ root.mT).numpy(),
            crossing.sensor.std().numpy() ** 2, PD=0.95, gate=150.0, volume=2 * 400.0**3, how=how, rate=rate,
        )  # fmt: skip
        np.testing.assert_allclose(estimate.info.association[b].movedim(0, 1), truth["association"], atol=1e-6)
        np.testing.assert_allclose(estimate.mean[b].movedim(0, 1), truth["mean"], rtol=1e-6, atol=1e-9)
        scale = np.sqrt(truth["P"].diagonal(axis1=2, axis2=3))
        scale = scale[..., :, None] * scale[..., None, :]
        np.testing.assert_allclose(estimate.covariance[b].movedim(0, 1).numpy() / scale, truth["P"] / scale, atol=1e-5)
        if how is not None:
            R = estimate.info.noise[b].movedim(0, 1).numpy() * crossing.sensor.std().numpy() ** 2
            np.testing.assert_allclose(R, truth["R"], rtol=1e-5)


def test_the_update_is_the_papers_equations_and_so_moment_matching():
    """x + K nu and P - (1 - b0) K S K^T + K (sum b nu nu^T - nu nu^T) K^T, eqs. (28)-(30)."""
    f, prior = plane(), flat_prior((0.0, 0.0), (6.0, 3.0))
    z = torch.tensor([[1.0, 0.5], [4.0, 2.0], [8.0, 5.0], [math.nan, math.nan]], dtype=torch.float64)
    state, _ = f.step(f.init(prior), z)
    beta = f(z.unsqueeze(0), prior).info.association[:, 0]
    F, Q = f.motion.transition(torch.tensor(1.0).double()), f.motion.process_noise(torch.tensor(1.0).double())
    H, R = torch.eye(2, 4).double(), 4.0 * torch.eye(2).double()
    for t in range(2):
        ahead, P = F @ prior.mean[t], F @ prior.covariance[t] @ F.mT + Q @ Q.mT
        S = H @ P @ H.mT + R
        K = P @ H.mT @ S.inverse()
        nu = z[:3] - H @ ahead
        b = beta[t, 1:4]
        bar = b @ nu
        scatter = (b[:, None, None] * nu[:, :, None] * nu[:, None, :]).sum(0) - bar[:, None] * bar
        torch.testing.assert_close(state.belief.mean[t], ahead + K @ bar, rtol=1e-12, atol=1e-12)
        expected = P - b.sum() * K @ S @ K.mT + K @ scatter @ K.mT
        torch.testing.assert_close(state.belief.covariance[t], expected, rtol=1e-11, atol=1e-12)
        assert beta[t, 4] == 0
        assert 0.001 < b.max() < 0.999


@pytest.mark.slow
def test_the_noise_estimate_wins_by_far_where_the_noise_grows_and_costs_nothing_where_it_does_not():
    """100 runs of targets that cross, gates of 150 m: the claims on errors, lost tracks and swaps."""
    for scale, most in ((4.0, 0.35), (1.0, 1.05)):
        s = scenarios.clutter_crossing(noise_scale=scale)
        t = s.simulate(100, 0)
        runs = {}
        for name, gate in (("ukf_jpda", Euclidean(150.0)), ("iaukf_jpda", Euclidean(150.0, probability=0.9999))):
            mean = s.cartesian(make(name, s, gate=gate)(t.z, t.prior)).mean
            runs[name] = metrics.error(mean, t.truth, s.truth_position)[..., 10:].square().mean((1, 2)).sqrt()
        worst = {name: run.square().mean().sqrt() for name, run in runs.items()}
        assert worst["iaukf_jpda"] < most * worst["ukf_jpda"]
        assert (runs["iaukf_jpda"] > 100).sum() == 0
        assert runs["iaukf_jpda"].median() < (17 if scale > 1 else 5)
        assert runs["ukf_jpda"].median().item() == pytest.approx(4.7 if scale == 1 else 39.0, rel=0.2)


def test_what_does_not_fit_is_named(crossing):
    motion, sensor, clutter = crossing.motion, crossing.sensor, crossing.clutter
    flat = ConstantVelocity(1.0, 2)
    for build, said in (
        (
            lambda: JPDA(presets.fra(flat, Position(1.0)), gate=ChiSquare(), clutter=Clutter(1.0)),
            "inner: expected an SRCKF",
        ),
        (lambda: JPDA(SRCKF(Bank([flat, flat]), Position(1.0)), gate=ChiSquare(), clutter=Clutter(1.0)), "inner"),
        (lambda: presets.jpda(flat, Bearings(0.1), clutter=Clutter(1.0)), "sensor: expected one that measures each"),
        (
            lambda: presets.jpda(flat, Bearings(0.1), clutter=Clutter(extent=[1.0, 1.0]), gate=Euclidean()),
            "where the target",
        ),
        (lambda: presets.jpda(flat, Position(1.0), clutter=Clutter(extent=[1.0] * 3)), "extent: expected"),
        (lambda: Clutter(), "volume, extent: .* received neither"),
        (
            lambda: Clutter(volume=1.0, extent=(1.0, 1.0)),
            "volume, extent: .* received both",
        ),
        (lambda: Clutter(-1.0), "volume"),
        (lambda: ChiSquare(1.0), "probability"),
        (lambda: Euclidean(1.0, probability=1.0), "probability"),
        (lambda: presets.ukf_jpda(motion, sensor, clutter=clutter, detection=0.0), "detection: expected a prob"),
        (lambda: presets.ukf_jpda(motion, sensor, clutter=clutter, lost=1.0), "lost"),
        (lambda: presets.ukf_jpda(motion, sensor, clutter=clutter, exact=(8, 12)), "exact"),
        (lambda: presets.ukf_jpda(motion, sensor, clutter=clutter, temperature=-1.0), "temperature"),
        (lambda: scenarios.clutter_straight(detection=0.0), "detection"),
        (lambda: scenarios.clutter_crossing(dt=0.0), "dt"),
        (lambda: scenarios.clutter_straight(std=(1.0, 2.0)), "std"),
    ):
        with pytest.raises(ValueError, match=said):
            build()
    f, mean = presets.iaukf_jpda(motion, sensor, clutter=clutter), crossing.prior.mean
    with pytest.raises(ValueError, match=r"z: expected \(..., T, J, 3\)"):
        f(torch.zeros(5, 3).double(), crossing.prior)
    with pytest.raises(ValueError, match=r"prior.mean: expected \(..., N, 6\), received \(6,\)"):
        f(torch.zeros(5, 2, 3).double(), Gaussian(mean[0], crossing.prior.scale_tril))
    with pytest.raises(ValueError, match="rate: expected a value for each"):
        f(torch.zeros(5, 2, 3).double(), Gaussian(mean[:1], crossing.prior.scale_tril[:1]))
