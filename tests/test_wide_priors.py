"""Wide priors are how people say that they do not know: single precision keeps what later measurements tell."""

import math

import pytest
import torch

from torchfra import Gaussian, presets, tree
from torchfra.linalg.triangular import eliminated, rounding
from torchfra.motion import ConstantVelocity, Motion, WhiteJerk
from torchfra.sensors import Position, RangeBearing, Sensor


class Seasons(Motion):
    """A level and a season of four steps."""

    linear = True

    def __init__(self):
        super().__init__(1, 1, None, size=4, velocity=slice(0, 0))

    def transition(self, dt):
        rows = [[1.0, 0, 0, 0], [0, -1, -1, -1], [0, 1, 0, 0], [0, 0, 1, 0]]
        return dt.new_tensor(rows).expand(*dt.shape, 4, 4)

    def process_noise(self, dt):
        rows = [[0.01, 0], [0, 0.01], [0, 0], [0, 0]]
        return dt.new_tensor(rows).expand(*dt.shape, 4, 2)


class Sum(Sensor):
    """The level and the season of now."""

    def __init__(self):
        super().__init__(2, [False], 0.01)

    def forward(self, x, u=None):
        return x[..., :1] + x[..., 1:2]


def normal(*shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


CASES = {
    "constant velocity": (ConstantVelocity(0.01, continuous=True), Position(0.1), 1e6, 1e-4),
    "constant acceleration": (WhiteJerk(0.01), Position(0.1), 1e5, 1e-3),
    "seasons": (Seasons(), Sum(), 1e3, 1e-2),
    "seasons that nobody knows": (Seasons(), Sum(), 1e4, 5e-2),
}
"""Motion, sensor, standard deviations of the prior, and how many of those of the estimate rounding may move it."""


def tracks(motion, sensor, wide):
    time = torch.arange(1.0, 31, dtype=torch.float64).unsqueeze(-1)
    truth = torch.cat([time, 2 * time], -1) if sensor.size == 2 else torch.sin(time * math.pi / 2)
    z = truth + 0.1 ** (3 - sensor.size) * normal(*truth.shape)
    return z, Gaussian(torch.zeros(motion.size).double(), wide * torch.eye(motion.size).double())


@pytest.mark.parametrize("engine", ["eager", "compiled"])
@pytest.mark.parametrize("name", CASES)
def test_smoothing_in_single_precision_is_that_in_double(name, engine):
    motion, sensor, wide, tolerance = CASES[name]
    tolerance = tolerance if engine == "eager" else max(tolerance, 3e-2)  # of the points that the filter took before
    z, prior = tracks(motion, sensor, wide)
    f = presets.srckf(motion, sensor)
    f = f if engine == "eager" else f.compile()
    expected = f.smooth(z, prior)
    found = f.smooth(z.float(), Gaussian(*(x.float() for x in prior)))
    variance = expected.covariance.diagonal(dim1=-2, dim2=-1)
    assert ((found.mean - expected.mean).abs() <= tolerance * variance.sqrt()).all()
    ratio = found.covariance.double().diagonal(dim1=-2, dim2=-1) / variance
    assert ((ratio - 1).abs() <= 2 * tolerance).all()


SMOOTHERS = sorted(set(presets.__all__) - {"alphabeta", "jpda", "ukf_jpda", "iaukf_jpda"})
"""Presets that smooth a track of their own."""

DETERMINED = 1e4
"""Widest prior of ``hghckf1`` in single precision: beyond, what is known well looks like a rounding error to it."""


def between(f, wide, dt):
    """How far single precision is from double, in standard deviations of the estimate, smoothed and filtered."""
    z, _ = tracks(ConstantVelocity(1.0), Position(0.1), 1.0)
    prior = Gaussian(torch.zeros(4).double(), wide * torch.tensor([1, 0.3, 0.7, 2.1]).double().diag())
    single = tree.map_tensors(torch.Tensor.float, (z, prior, dt))
    for run in (f.smooth, f):
        expected, found = run(z, prior, dt=dt), run(*single[:2], dt=single[2])
        std = expected.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        yield ((found.mean - expected.mean) / std).abs().max()
        yield (found.covariance.double().diagonal(dim1=-2, dim2=-1).sqrt() / std - 1).abs().max()


def made(name):
    models = [ConstantVelocity(0.01, continuous=True), ConstantVelocity(1.0, continuous=True)]
    several = {"neighbours": ((1,), (0,)), "first": (0, 1)} if name.startswith("vsimm") else {}
    return getattr(presets, name)(models if "imm" in name else models[0], Position(0.1), **several)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOOTHERS)
def test_every_smoother_loses_the_digits_between_prior_and_measurement_at_most(name):
    f, dt = made(name), 0.5 + torch.rand(30, generator=torch.Generator().manual_seed(3)).double()
    for wide in (1e2, 1e3, 1e4, 1e5, 1e6):
        if name == "hghckf1" and wide > DETERMINED:
            break
        lost = 1e-3 + torch.finfo(torch.float32).eps * wide / 0.1
        assert all(x <= lost for x in between(f, wide, dt)), wide


@pytest.mark.slow
@pytest.mark.parametrize("name", ["srckf", "imm"])
def test_kernels_keep_as_many(name):
    f, dt = made(name).compile(), 0.5 + torch.rand(30, generator=torch.Generator().manual_seed(3)).double()
    for wide in (1e2, 1e4, 1e5, 1e6):
        assert all(x <= max(2e-4, 5e-8 * wide) for x in between(f, wide, dt)), wide


def test_what_is_known_well_beside_what_is_not_is_no_rounding_error():
    """Two places of which only the difference is known; and two that are the same."""
    for apart, depends in ((0.1, False), (0.0, True)):
        rows = torch.tensor([[0.2, 7e5], [0.2 + apart, 7e5]])
        root, _, _, dependent = eliminated(rows, 2, rounding(2, torch.float32), graded=True)
        assert bool(dependent[1]) == depends
        assert not bool(dependent[0])
        if not depends:
            torch.testing.assert_close(root[1, 1], torch.tensor(0.1), rtol=1e-5, atol=0)


def test_points_too_near_the_centre_for_the_precision_are_refused():
    f = presets.ukf(ConstantVelocity(1.0), RangeBearing((2.0, 0.01)), alpha=1e-3)
    z, prior = torch.tensor([[1e4, 0.5]]), Gaussian(torch.tensor([8775.0, 4794.0, 0, 0]), torch.eye(4))
    for run in (f, presets.ukf(ConstantVelocity(1.0), RangeBearing((2.0, 0.01)), alpha=1e-3).compile()):
        with pytest.raises(ValueError, match=r"rule: expected weights whose sum leaves four digits in torch.float32"):
            run(z, prior)
    assert not f(z.double(), Gaussian(*(x.double() for x in prior))).failed.any()
