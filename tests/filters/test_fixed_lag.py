"""Streaming with a lag hands out what smoothing whole tracks with that lag gives, a step at a time."""

import pytest
import torch
from test_smoothing_models import STD, turning

from torchfra import Gaussian, presets
from torchfra.association import Euclidean
from torchfra.filters import FixedLag
from torchfra.motion import ConstantAcceleration, aircraft
from torchfra.sensors import Position

SENSOR = Position(STD)


def filters():
    one = ConstantAcceleration(0.3)
    named = {name: getattr(presets, name)(one, SENSOR) for name in ("rsrckf", "asrckf", "fra", "gpb")}
    named["fra, adaptive first"] = presets.fra(one, SENSOR, provisional="adaptive", plain=0.0)
    return named | {
        name: getattr(presets, name)(aircraft(), SENSOR) for name in ("imm_srckf", "imm_fra", "vsimm_srckf")
    }


def close(a, b):
    torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(("name", "lag"), [*((name, 4) for name in filters()), ("gpb", 1), ("fra", 1)])
def test_each_step_hands_out_the_estimate_of_so_many_steps_back(name, lag):
    f, (prior, z) = filters()[name], turning()
    stream, whole = FixedLag(f, lag), f.smooth(z, prior, dt=0.8, lag=lag)
    state = stream.init(Gaussian(prior.mean.expand(2, 6), prior.scale_tril))
    close(state.lagged, state.belief)
    inner = state.inner
    for k in range(z.shape[-2] - 1):
        state, innovation = stream.step(state, z[:, k], dt=0.8)
        inner, expected = f.step(inner, z[:, k], dt=0.8)
        close(innovation, expected)
        close(state.belief, inner.belief)
        if k >= lag:
            close(state.lagged.mean, whole.mean[:, k - lag])
            close(state.lagged.covariance, whole.covariance[:, k - lag])


def test_until_there_are_enough_it_is_the_first_step():
    f, (prior, z) = presets.srckf(ConstantAcceleration(0.3), SENSOR), turning()
    stream = FixedLag(f, 5)
    state = stream.init(prior)
    for k in range(5):
        state, _ = stream.step(state, z[0, k])
        close(state.lagged.mean, f.smooth(z[0, : k + 1], prior).mean[0])


def test_a_bank_tells_its_probabilities_and_a_compiled_filter_does_the_same():
    f, (prior, z) = presets.gpb(ConstantAcceleration(0.3), SENSOR), turning()
    for one in (f, presets.srckf(ConstantAcceleration(0.3), SENSOR).compile()):
        stream, smoothed = FixedLag(one, 2), one.smooth(z, prior, lag=2)
        state = stream.init(Gaussian(prior.mean.expand(2, 6), prior.scale_tril))
        for k in range(5):
            state, _ = stream.step(state, z[:, k])
        close(state.lagged.mean, smoothed.mean[:, 2])
        if one is f:
            close(state.smoothed.probabilities, smoothed.info.probabilities[:, 2])
            close(state.smoothed.outlier, smoothed.info.outlier[:, 2])


def test_scans_come_one_at_a_time_too(crossing, scans):
    gate = Euclidean(150.0, probability=0.9999)
    f = presets.iaukf_jpda(crossing.motion, crossing.sensor, clutter=crossing.clutter, gate=gate)
    stream, whole = FixedLag(f, 3), f.smooth(scans.z[:, :8], scans.prior, lag=3)
    state = stream.init(scans.prior)
    for k in range(8):
        state, _ = stream.step(state, scans.z[:, k])
    close(state.lagged.mean, whole.mean[:, :, 4])


def test_gradients_flow_back_through_the_window():
    f, (prior, z) = presets.rsrckf(ConstantAcceleration(0.3), SENSOR, learn=("q",)), turning()

    def last(z, mean):
        stream = FixedLag(f, 2)
        state = stream.init(Gaussian(mean, prior.scale_tril))
        for one in z:
            state, _ = stream.step(state, one)
        return tuple(state.lagged)

    inputs = (z[1, :5].clone().requires_grad_(), prior.mean.clone().requires_grad_())
    assert torch.autograd.gradcheck(last, inputs, eps=1e-6, rtol=1e-4, atol=1e-5, fast_mode=True)
    assert list(FixedLag(f, 2).parameters()) == list(f.parameters())


@pytest.mark.parametrize(("make", "error", "message"), [
    (lambda f: FixedLag(SENSOR, 2), ValueError, r"filter: expected one of torchfra.filters, received Position"),
    (lambda f: FixedLag(f, 0), ValueError, r"lag: expected at least 1 step, received 0"),
    (lambda f: FixedLag(presets.alphabeta(f.motion, SENSOR), 2), NotImplementedError, r"constant gains"),
])  # fmt: skip
def test_what_does_not_fit_is_named(make, error, message):
    with pytest.raises(error, match=message):
        make(presets.srckf(ConstantAcceleration(0.3), SENSOR))
