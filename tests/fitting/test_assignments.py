"""What a user writes to set or to learn a value either does so or says what would."""

import re

import pytest
import torch
from torch import nn
from torch.distributions import constraints

from torchfra import Gaussian, Hyper, learnable, presets
from torchfra.association import Clutter
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

MOTION, SENSOR = ConstantVelocity(1.0), Position(2.0)
REFUSED = {
    "a parameter": lambda: presets.rsrckf(MOTION, SENSOR, threshold=nn.Parameter(torch.tensor(2.0))),
    "a function of one": lambda: presets.gpb(MOTION, SENSOR, prior_outlier=torch.ones(1, requires_grad=True) / 2),
    "a parameter of a motion": lambda: ConstantVelocity(nn.Parameter(torch.tensor(1.0))),
    "a parameter to set": lambda: Hyper(1.0).set(nn.Parameter(torch.tensor(2.0))),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_a_value_with_a_gradient_is_no_fixed_copy(what):
    with pytest.raises(ValueError, match=r"expected numbers, as a filter learns its own copy: learn="):
        REFUSED[what]()


@pytest.mark.parametrize("value", [9.0, 9, torch.tensor(9.0), nn.Parameter(torch.tensor(9.0)), (9.0, 8.0)])
def test_an_assignment_to_the_name_of_a_hyperparameter_says_what_sets_it(value):
    f = presets.rsrckf(MOTION, SENSOR)
    with pytest.raises(ValueError, match=re.escape("threshold: expected .robust.threshold.set(...)")):
        f.threshold = value
    with pytest.raises(ValueError, match=re.escape("threshold: expected .threshold.set(...)")):
        f.robust.threshold = value
    with pytest.raises(ValueError, match=re.escape("std: expected .sensor.std.set(...)")):
        f.std = value
    assert f.robust.threshold() == pytest.approx(1.345)


def test_a_name_of_several_hyperparameters_lists_them_all():
    f = presets.gpb([MOTION, ConstantVelocity(2.0)], SENSOR)
    with pytest.raises(ValueError, match=re.escape(".motion.models.0.q.set(...) or .motion.models.1.q.set(...)")):
        f.q = 3.0


def test_attributes_that_are_no_hyperparameters_are_set_as_ever():
    f = presets.fra(MOTION, SENSOR)
    f.temperature, f.robust, f.remark = 0.5, presets.fra(MOTION, SENSOR, threshold=2.0).robust, "mine"
    assert (f.temperature, f.robust.threshold().item(), f.remark) == (0.5, pytest.approx(2.0), "mine")


def test_requires_grad_learns_a_value_and_is_refused_where_nothing_would_learn():
    f = presets.rsrckf(MOTION, SENSOR)
    with pytest.raises(ValueError, match=r"requires_grad_: expected values to learn: torchfra.learnable"):
        f.requires_grad_(True)
    assert f.requires_grad_(False) is f
    f.robust.threshold.requires_grad_()
    assert [name for name, _ in f.named_parameters()] == ["robust.threshold.raw"]
    assert not f.requires_grad_(False).robust.threshold.raw.requires_grad
    assert f.requires_grad_(True).robust.threshold.raw.requires_grad


INTERVALS = {
    constraints.unit_interval: (0.0, 1.0),
    constraints.interval(-1.0, 3.0): (-1.0, 3.0),
    constraints.half_open_interval(0.5, 1.0): (0.5,),
    constraints.nonnegative: (0.0,),
    constraints.greater_than_eq(1.0): (1.0,),
    constraints.positive: (torch.inf,),
}


@pytest.mark.parametrize("constraint", INTERVALS, ids=str)
def test_nothing_learns_from_the_edge_of_its_range(constraint):
    for edge in INTERVALS[constraint]:
        with pytest.raises(ValueError, match="expected a value inside its range, to learn it"):
            Hyper(edge, constraint, learn=True)
        fixed = Hyper(edge, constraint)
        assert not fixed.interior
        assert fixed().item() == pytest.approx(edge)


def test_presets_refuse_to_learn_from_the_edge_and_all_leaves_it_out():
    with pytest.raises(ValueError, match=r"fading.forgetting: expected a value inside its range, to learn it"):
        presets.asrckf(MOTION, SENSOR, forgetting=1.0, learn=("forgetting",))
    with pytest.raises(ValueError, match=r"detection: expected a value inside its range, to learn it"):
        presets.jpda(MOTION, SENSOR, clutter=Clutter(1e-4), detection=1.0, learn=("detection",))
    with pytest.raises(ValueError, match=r"transition: expected a value inside its range, to learn it"):
        presets.imm([MOTION, MOTION], SENSOR, transition=[[1.0, 0.0], [0.5, 0.5]],
                    learn=("transition",))  # fmt: skip
    f = learnable(presets.asrckf(MOTION, SENSOR, forgetting=1.0), "all")
    assert "fading.forgetting.raw" not in dict(f.named_parameters())
    assert "fading.weakening.raw" in dict(f.named_parameters())


def test_a_value_just_inside_its_range_learns():
    assert Hyper(1 - 1e-12, constraints.unit_interval, learn=True).raw.requires_grad
    assert Hyper([[0.2, 0.8], [0.5, 0.5]], constraints.simplex, event_dim=2, learn=True).raw.requires_grad


META = {
    "a motion": lambda: ConstantVelocity(1.0),
    "a sensor": lambda: Position(2.0),
    "a filter": lambda: presets.srckf(MOTION, SENSOR),
    "a filter of hypotheses": lambda: presets.gpb(MOTION, SENSOR),
}


@pytest.mark.parametrize("what", META)
def test_what_is_built_on_the_meta_device_says_that_it_has_no_numbers(what):
    with torch.device("meta"), pytest.raises(ValueError, match="meta"):
        META[what]()


@pytest.mark.parametrize("compiled", [False, True])
def test_measurements_on_the_meta_device_are_refused(compiled):
    f = presets.rsrckf(MOTION, SENSOR)
    f = f.compile() if compiled else f
    z, prior = torch.zeros(5, 2, device="meta"), Gaussian(torch.zeros(4), torch.eye(4))
    state = f.init(prior)
    for call in (lambda: f(z, prior), lambda: f.smooth(z, prior), lambda: f.step(state, z[0])):
        with pytest.raises(ValueError, match="z: expected a tensor with numbers, received one on the meta device"):
            call()
    with pytest.raises(ValueError, match=r"prior.mean: expected a tensor with numbers"):
        f.init(Gaussian(*(x.to("meta") for x in prior)))
