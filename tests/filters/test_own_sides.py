"""A filter of one's own choice is one line: its sides, their states and what learns."""

from functools import partial

import pytest
import torch

from torchfra import Gaussian, Hyper, learnable, presets
from torchfra.adaptive import Fading
from torchfra.filters import FRA, SRCKF
from torchfra.motion import Bank, ConstantVelocity, Spherical
from torchfra.robust import Huber, Weights
from torchfra.sensors import InfraredLaser, Position

MOTION, SENSOR = ConstantVelocity(0.1, 3), Position(1.0, dims=3)
PRIOR = Gaussian(torch.zeros(6).double(), 5 * torch.eye(6).double())
TIME = torch.arange(1, 31).double().unsqueeze(-1)
Z = TIME * torch.tensor([1.0, -1.0, 2.0]).double() + torch.randn(4, 30, 3, generator=torch.Generator().manual_seed(0))
Z[:, 15:, 2] += 40.0  # it climbs at once
Z[:, 7] += 30.0


class Cauchy(Weights):
    def __init__(self, scale=2.385):
        super().__init__()
        self.scale = Hyper(scale, name="scale")

    def forward(self, residual, nis):
        return 1 / (1 + (residual / self.scale.elements(residual)).square())


class Twice(Fading):
    def forward(self, prediction, whitened, memory, weights):
        return 2 * super().forward(prediction, whitened, memory, weights) - 1


def same(a, b):
    with torch.no_grad():
        torch.testing.assert_close(a(Z, PRIOR).mean, b(Z, PRIOR).mean, rtol=0, atol=1e-12)


def test_without_sides_a_filter_of_the_class_is_that_of_the_preset():
    same(FRA(MOTION, SENSOR), presets.fra_srckf(MOTION, SENSOR))
    same(FRA(MOTION, SENSOR, robust=Cauchy()), presets.fra_srckf(MOTION, SENSOR, robust=Cauchy()))
    same(SRCKF(MOTION, SENSOR, fading=Fading()), presets.asrckf(MOTION, SENSOR))
    same(SRCKF(MOTION, SENSOR, robust=Huber(), fading=Fading()), presets.rmckf(MOTION, SENSOR))


def test_factors_are_for_the_position_of_the_motion_wherever_that_is():
    spherical = Spherical(ConstantVelocity(0.1, 3))
    eye = InfraredLaser(1e-3)
    fading, shared = Fading(), Fading(share=(1.0, 0.1))
    for make in (partial(SRCKF, spherical, eye), partial(FRA, spherical, eye)):
        assert make(fading=fading).fading.states == (slice(3, 6),)
        assert make(fading=shared).fading.states == (slice(3, 6), slice(0, 3))
        assert make(fading=Fading(states=slice(0, 1))).fading.states == (slice(0, 1),)
    assert SRCKF(MOTION, SENSOR, fading=fading).fading.states == (slice(0, 3),)
    with pytest.raises(ValueError, match=r"share: expected \(\.\.\., 2\), received \(3,\)"):
        SRCKF(MOTION, SENSOR, fading=Fading(share=(1.0, 0.1, 0.1)))


def test_sides_of_ones_own_fit_every_filter_and_learn():
    bank = Bank([MOTION, ConstantVelocity(5.0, 3)])
    for f in (
        FRA(MOTION, SENSOR, robust=Cauchy(), fading=Twice(weakening=3.0)),
        SRCKF(MOTION, SENSOR, robust=Cauchy(), fading=Twice()),
        presets.imm(bank, SENSOR, inner=partial(FRA, robust=Cauchy(), fading=Twice())),
    ):
        learned = learnable(f, ("scale", "weakening"))
        learned(Z, PRIOR).log_likelihood.sum().backward()
        assert all(p.grad.isfinite().all() for p in learned.parameters())
        assert len(list(learned.parameters())) == 2


def test_a_filter_and_the_factors_that_it_was_made_of_share_their_values():
    fading = Fading()
    f = SRCKF(MOTION, SENSOR, fading=fading)
    fading.weakening.set(7.0)
    assert f.fading.weakening().item() == pytest.approx(7.0)
    assert fading.states == (slice(0, 2),)
