"""Targets of a scan are smoothed each for itself; constant gains are not smoothed, and say why."""

import numpy as np
import oracles
import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.association import Clutter, Euclidean
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

nan = float("nan")
MOTION, SENSOR = ConstantVelocity(0.5), Position(2.0)
ROOT = torch.tensor([5.0, 5.0, 3.0, 3.0]).double().diag()
STARTS = torch.tensor([[0.0, 0.0, 10.0, 0.0], [500.0, 0.0, -10.0, 3.0]]).double()


def apart(steps=12, seed=0):
    """Two targets far apart, and scans of both in an order that changes."""
    rng = torch.Generator().manual_seed(seed)
    t = torch.arange(1, steps + 1).double()[:, None, None]
    z = STARTS[:, :2] + t * STARTS[:, 2:] + 2 * torch.randn(steps, 2, 2, generator=rng).double()
    z[3, 1] = nan
    scans = z.clone()
    scans[1::2] = scans[1::2].flip(-2)
    return z.movedim(1, 0), scans


def jpda(**options):
    return presets.jpda(MOTION, SENSOR, clutter=Clutter(1e6, rate=1e-9), gate=Euclidean(100.0), **options)


@pytest.mark.parametrize("lag", [None, 3])
def test_targets_that_are_told_apart_are_smoothed_as_alone(lag):
    tracks, scans = apart()
    both = jpda(detection=1.0).smooth(scans, Gaussian(STARTS, ROOT), lag=lag)
    alone = presets.ukf(MOTION, SENSOR).smooth(tracks, Gaussian(STARTS, ROOT), lag=lag)
    assert both.mean.shape == (2, 12, 4)
    seen = [k for k in range(12) if k != 3]  # where a target is missed the others' measurements are weighed too
    torch.testing.assert_close(both.mean[0], alone.mean[0], rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(both.mean[1, seen], alone.mean[1, seen], rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(both.covariance[0], alone.covariance[0], rtol=1e-6, atol=1e-4)


def test_a_target_that_seemed_lost_goes_back_through_the_wider_prediction():
    tracks, scans = apart()
    scans = tracks[:1].movedim(1, 0).clone()  # one target
    scans[4:9] = 1e4  # something else, far away
    f, prior = jpda(detection=0.9, lost=0.05), Gaussian(STARTS[:1], ROOT)
    smoothed = f.smooth(scans, prior)
    state, inflations = f.init(prior), [0.0]
    for scan in scans:
        state, _ = f.step(state, scan)
        inflations.append(state.inflations.item())
    times = 4 ** np.diff(inflations).clip(0)
    assert times.max() > 2
    dt = torch.tensor(1.0).double()
    F, SQ = MOTION.transition(dt).numpy(), MOTION.process_noise(dt).numpy()

    def ahead(mean, P, k):
        return F @ mean, times[k] * (F @ P @ F.T + SQ @ SQ.T), times[k] ** 0.5 * P @ F.T

    filtered = smoothed.info.filtered
    expected = oracles.smoother(filtered.mean[0].numpy(), filtered.covariance[0].numpy(), ahead)
    np.testing.assert_allclose(smoothed.mean[0], expected["mean"], rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(smoothed.covariance[0], expected["P"], rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_batches_vmap_and_lags_give_the_same(crossing, scans):
    f = presets.iaukf_jpda(
        crossing.motion, crossing.sensor, clutter=crossing.clutter, gate=Euclidean(150.0, probability=0.9999)
    )

    def smooth(z, mean, root, **options):
        return tuple(f.smooth(z, Gaussian(mean, root), **options)[:2])

    together = smooth(scans.z, *scans.prior)
    one = smooth(scans.z[1], *(x[1] for x in scans.prior))
    torch.testing.assert_close(one, tuple(x[1] for x in together), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(torch.func.vmap(smooth)(scans.z, *scans.prior), together, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(smooth(scans.z, *scans.prior, lag=24), together, rtol=1e-12, atol=1e-12)
    filtered, lagged = f(scans.z, scans.prior), smooth(scans.z, *scans.prior, lag=4)
    whole = f.smooth(scans.z[:, :15], scans.prior)
    torch.testing.assert_close(lagged[0][:, :, 10], whole.mean[:, :, 10], rtol=1e-9, atol=1e-9)
    for estimate in (filtered, f(scans.z, scans.prior, past=True)):
        reused = f.smooth(scans.z, scans.prior, estimate=estimate)
        torch.testing.assert_close(reused.mean, together[0], rtol=0, atol=0)


def test_constant_gains_are_not_smoothed_and_say_why():
    f = presets.alphabeta(MOTION, SENSOR)
    with pytest.raises(NotImplementedError, match=r"AlphaBetaBank: constant gains have no process noise"):
        f.smooth(torch.zeros(5, 2).double(), Gaussian(STARTS[0], ROOT))
