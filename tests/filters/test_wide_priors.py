"""Wide priors are how people say that they do not know: single precision keeps what later measurements tell."""

import math

import pytest
import torch

from torchfra import Gaussian, presets, tree
from torchfra.gaussian.arguments import LostDigits
from torchfra.linalg.triangular import eliminated, rounding
from torchfra.motion import ConstantAcceleration, ConstantVelocity, Motion, WhiteJerk
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
    "constant velocity": (ConstantVelocity(0.01, continuous=True), Position(0.1)),
    "constant acceleration": (WhiteJerk(0.01), Position(0.1)),
    "seasons": (Seasons(), Sum()),
}
"""Motion and sensor."""


def roots(size, wide):
    """Roots of priors that are so wide in all components: alike, and correlated."""
    return torch.cat([w * torch.stack([torch.eye(size).double(), normal(size, size).tril()]) for w in wide])


def tracks(motion, sensor):
    time = torch.arange(1.0, 31, dtype=torch.float64).unsqueeze(-1)
    truth = torch.cat([time, 2 * time], -1) if sensor.size == 2 else torch.sin(time * math.pi / 2)
    return (truth + 0.1 ** (3 - sensor.size) * normal(*truth.shape)).float().double()


def lost(f, z, root, dt=1.0):
    """How far single precision is from double, in standard deviations of the estimate, smoothed and filtered."""
    prior = Gaussian(torch.zeros(root.shape[:-1]).double(), root)
    single = tree.map_tensors(torch.Tensor.float, (z, prior, dt))
    double = tree.map_tensors(torch.Tensor.double, single)
    both = [f.smooth(*given[:2], dt=given[2]) for given in (double, single)]
    for expected, found in (both, [smoothed.info.filtered for smoothed in both]):
        std = expected.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        yield ((found.mean - expected.mean) / std).abs().max()
        yield (found.covariance.double().diagonal(dim1=-2, dim2=-1).sqrt() / std - 1).abs().max()


@pytest.mark.parametrize("engine", ["eager", "compiled"])
@pytest.mark.parametrize("name", CASES)
def test_however_wide_a_prior_is_single_precision_says_what_double_says(name, engine):
    motion, sensor = CASES[name]
    f, z = presets.srckf(motion, sensor), tracks(motion, sensor)
    f = f if engine == "eager" else f.compile()
    assert max(lost(f, z, roots(motion.size, (1e3, 1e6)))) <= 1e-3


SMOOTHERS = sorted(set(presets.__all__) - {"alphabeta", "jpda", "ukf_jpda", "iaukf_jpda"})
"""Presets that smooth a track of their own."""


def made(name):
    models = [ConstantVelocity(0.01, continuous=True), ConstantVelocity(1.0, continuous=True)]
    several = {"neighbours": ((1,), (0,)), "first": (0, 1)} if name.startswith("vsimm") else {}
    return getattr(presets, name)(models if "imm" in name else models[0], Position(0.1), **several)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "compiled"), [
    *((name, False) for name in SMOOTHERS), *((name, True) for name in ("srckf", "imm", "hghckf1"))
])  # fmt: skip
def test_so_it_is_with_every_smoother_and_with_kernels_at_time_steps_that_differ(name, compiled):
    dt = 0.5 + torch.rand(30, generator=torch.Generator().manual_seed(3)).double()
    f = made(name).compile() if compiled else made(name)
    assert max(lost(f, tracks(*CASES["constant velocity"]), roots(4, (1e2, 1e4, 1e7)), dt)) <= 1e-3


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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gpb", "imm", "imm_fra", "vsimm_srckf"])
def test_moments_of_accelerations_that_are_not_known_yet_lose_digits_beside_a_prior_that_is_warned_of(name):
    z = tracks(*CASES["constant velocity"])
    *smoothed, filtered, variances = lost(several(name, ConstantAcceleration), z, 1e5 * torch.eye(6).double())
    assert max(filtered, variances) <= 1e-3
    assert max(smoothed) <= 2e-3


def several(name, motion):
    """A preset of that motion, or of it and a livelier one."""
    both = {"neighbours": ((1,), (0,)), "first": (0, 1)} if name.startswith("vsimm") else {}
    return getattr(presets, name)([motion(0.01), motion(1.0)] if "imm" in name else motion(0.01), Position(0.1), **both)


@pytest.mark.parametrize("name", ["gpb", "imm", "imm_fra", "vsimm_srckf"])
def test_a_prior_of_what_two_measurements_do_not_tell_brings_a_warning_where_moments_are_mixed(name):
    f, z = several(name, ConstantAcceleration), torch.zeros(2, 2)
    wide = Gaussian(torch.zeros(6), 1e7 * torch.eye(6))
    for run in (f, f.smooth):
        with pytest.warns(LostDigits, match="prior: expected standard deviations below 1e.07 times"):
            run(z, wide)
    f(z.double(), Gaussian(*(x.double() for x in wide)))
    several(name, ConstantVelocity)(z, Gaussian(torch.zeros(4), 1e7 * torch.eye(4)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_prior_beyond_the_digits_of_double_precision_brings_a_warning(dtype):
    z = tracks(*CASES["constant velocity"])[:2].to(dtype)
    for f in (presets.srckf(*CASES["constant velocity"]), presets.srckf(*CASES["constant velocity"]).compile()):
        with pytest.warns(LostDigits, match="prior: expected standard deviations below 1e.12 times"):
            f(z, Gaussian(torch.zeros(4, dtype=dtype), 1e12 * torch.eye(4, dtype=dtype)))
        f(z, Gaussian(torch.zeros(4, dtype=dtype), 1e10 * torch.eye(4, dtype=dtype)))


def test_the_most_precise_step_counts_but_nothing_that_is_missing():
    f, std = presets.srckf(ConstantVelocity(0.01), Position(1.0)), torch.tensor([[1e-3, 1.0], [1e6, 1.0]])
    with pytest.warns(LostDigits, match=r"received 1\.0e\+12 times that of element 0"):
        f(torch.zeros(2, 2), Gaussian(torch.zeros(4), 1.01e9 * torch.eye(4)), std=std)
    z, prior = torch.tensor([[torch.nan, 0.0]]), Gaussian(torch.zeros(4), 2e12 * torch.eye(4))
    f(z, prior, std=torch.tensor([[1.0, 1e6]]))
    f(z, prior, noise=torch.tensor([[[0.0, 0.0], [0.0, 1e6]]]))
