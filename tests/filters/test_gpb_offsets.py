"""Outliers that say nothing of the state, and several in a row with one offset, are what the oracle says."""

from functools import partial

import numpy as np
import pytest
import torch
from gpb_cases import FEWER, SENSORS
from gpb_loops import PRIOR, bank, carried, expected, position, regimes, same, tensor
from oracles import gpb as oracle
from torch.testing import assert_close

from torchfra import presets
from torchfra.association import Clutter
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.sensors import Position
from torchfra.types import Gaussian

VALUES = (0.9, 0.8, 0.7, 0.6, 0.1), (0.4, 0.3, 0.15, 0.1, 0.05), (0.1, 1.0), (200.0,)


def with_bursts(case):
    """Outliers in a row with one offset: in both elements, and where the position before is missing in part."""
    rng = np.random.default_rng(4)
    case.z[4:8] = np.array([9.0, 0]) * np.arange(5, 9)[:, None] + [800.0, 300] + 3 * rng.standard_normal((4, 2))
    case.z[6, 0] = np.nan
    return case


def transition(motion, k=0):
    return motion.transition(tensor(1.0)).numpy()


def expected_with(case, motions, r, **more):
    transitions = [lambda k, m=motion: transition(m) for motion in motions]
    return expected(case, [carried(motion, 1.0) for motion in motions], r, transitions=transitions, **more)


def patient(options, r):
    """The same regimes, with jumps rarer than some outliers in a row, so that both have their say."""
    return options | {"burst": 1.5}, r._replace(burst=1.5)


@pytest.mark.parametrize(("inform", "offset"), [(True, 0.4), (False, 0.0)])
def test_one_motion_with_levels_manoeuvres_and_jumps(inform, offset):
    case, motion = with_bursts(position()), ConstantAcceleration(0.05)
    options, r = patient(*regimes(*VALUES, manoeuvres=(3.0,)))
    f = presets.gpb(motion, case.sensor, outliers_update=inform, same_offset=offset, **options)
    expected = expected_with(case, [motion], r, inform=inform, same_offset=offset)
    same(f(tensor(case.z), PRIOR), expected)


@pytest.mark.slow
def test_a_bank_and_elements_that_are_outliers_each_by_itself():
    case, motions = with_bursts(position()), bank()
    case.model = case.model._replace(SR=np.diag([5.0, 4.0]))
    case.blocks = [[0], [1]]
    case.sensor = Position(tensor([5.0, 4.0]))
    case.sensor.blocks = ((0,), (1,))
    options, r = patient(*regimes(*VALUES, motions=3, manoeuvres=(3.0,)))
    f = presets.gpb(motions, case.sensor, outliers_update=False, same_offset=0.4, **options)
    same(f(tensor(case.z), PRIOR), expected_with(case, motions, r, inform=False, same_offset=0.4))


def test_other_motions_may_last_and_begin_each_in_its_own_way():
    case, motions = position(), bank()
    stay, restart = [0.9, 0.8, 0.7, 0.5, 0.1], [0.3, 0.3, 0.2, 0.15, 0.05]
    options, r = regimes((0.9, 0.8, 0.7, 0.1), (0.3, 0.3, 0.3, 0.1), (0.1, 1.0), motions=3)
    chain = oracle.restart_transition(stay, restart)
    r = r._replace(
        transition=chain,
        unmeasured=oracle.unmeasured_transition(stay, restart, range(2, 4)),
        first=oracle.stationary(chain),
    )
    f = presets.gpb(motions, case.sensor, **options | {"self_transition": stay, "restart": restart})
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0) for motion in motions], r))


def test_several_motions_with_values_for_neither_kinds_nor_regimes_are_named():
    values = regimes((0.9, 0.8, 0.7, 0.1), (0.3, 0.3, 0.3, 0.1), (0.1, 1.0), motions=3)[0]
    with pytest.raises(
        ValueError, match=r"restart: expected \(..., 4\), or of each regime \(..., 5\), received \(3,\)"
    ):
        presets.gpb(bank(), Position(5.0), **values | {"restart": (0.5, 0.3, 0.2)})


def test_the_offset_of_a_sensor_that_is_not_linear_is_refused():
    with pytest.raises(ValueError, match="same_offset: expected None or a linear sensor, received Bearings"):
        presets.gpb(ConstantAcceleration(0.05), SENSORS["bearings"], same_offset=0.5)


def burst(steps=20, length=5):
    """A target at a constant velocity, and a burst of fixes beside it by one offset."""
    z = tensor([[9.0 * k, 0.0] for k in range(1, steps + 1)])
    z = z + 3 * torch.randn(z.shape, dtype=z.dtype, generator=torch.Generator().manual_seed(2))
    z[8 : 8 + length] += tensor([500.0, 300.0])
    return z, Gaussian(torch.zeros(4).double() + tensor([0, 0, 9, 0]), torch.diag(tensor([20, 20, 8, 8])))


@pytest.mark.parametrize("offset", [None, 0.5])
def test_a_long_burst_of_one_offset_is_a_jump_there_and_back_unless_outliers_may_have_the_same(offset):
    z, prior = burst(30, length=12)
    often = {"outlier_transition": ((0.98, 0.02), (0.4, 0.6)), "outliers_update": False}
    estimate = presets.gpb(ConstantVelocity(0.1), Position(3.0), same_offset=offset, **often).smooth(z, prior)
    wrong = torch.zeros(len(z), dtype=torch.bool)
    wrong[8:20] = offset is not None
    told = torch.ones(len(z), dtype=torch.bool)
    told[8:11] = offset is not None  # up to four are taken for outliers, where these have no offset
    assert_close(estimate.info.outlier[told, 0].round(), wrong[told].double())


def test_the_gradient_of_the_probability_is_that_of_small_differences():
    z, prior = burst()

    def likelihood(probability):
        f = presets.gpb(ConstantVelocity(0.1), Position(3.0), same_offset=probability, learn=("same_offset",))
        total = f(z, prior).log_likelihood.sum()
        return f.outliers.same_offset, total

    hyper, total = likelihood(0.4)
    (slope,) = torch.autograd.grad(total, hyper.raw)
    up, down = (likelihood(0.4 + step)[1].item() for step in (1e-6, -1e-6))
    (unit,) = torch.autograd.grad(hyper(), hyper.raw)
    assert (slope / unit).item() == pytest.approx((up - down) / 2e-6, rel=1e-5)


@pytest.mark.slow
def test_compiled_it_says_the_same():
    z, prior = burst()
    f = presets.gpb(ConstantVelocity(0.1), Position(3.0), same_offset=0.4, outliers_update=False, **FEWER)
    eager, g = f.smooth(z, prior), f.compile()
    compiled = g.smooth(z, prior)
    assert_close(compiled.mean, eager.mean, rtol=1e-9, atol=1e-9)
    assert_close(compiled.info.outlier, eager.info.outlier, rtol=1e-9, atol=1e-9)


def test_each_of_two_targets_in_a_scan_may_have_outliers_of_one_offset():
    inner = partial(presets.gpb, same_offset=0.4)
    f = presets.jpda(ConstantVelocity(0.1), Position(3.0), clutter=Clutter(1e6, rate=1.0), inner=inner)
    start = tensor([[0.0, 0, 9, 0], [500, 0, -9, 0]])
    z = torch.stack([start[:, :2] + k * start[:, 2:] for k in range(1, 4)])
    estimate = f(z, Gaussian(start, torch.diag(tensor([9, 9, 4, 4]))))
    assert_close(estimate.mean[:, -1, :2], z[-1], rtol=0, atol=1.0)
