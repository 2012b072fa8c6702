"""How far off the position can be: a radius that errors exceed no more often than it says."""

import math

import numpy as np
import pytest
import torch
from oracles import protection as oracle

from torchfra import Gaussian, presets
from torchfra.filters import protection_level
from torchfra.motion import Clock, ConstantVelocity, CoordinatedTurn, Spherical
from torchfra.sensors import Correlated, Position, Sensor
from torchfra.stream import Tracker

F64 = {"dtype": torch.float64}
DT = torch.tensor([1.0, 1, 2, 1, 1, 1], **F64)


def motion(dims=2):
    return ConstantVelocity(0.5, dims)


def prior(dims=2):
    return Gaussian(torch.zeros(2 * dims, **F64), torch.diag(torch.tensor([9.0] * dims + [4.0] * dims, **F64)))


def measured(dims=2):
    z = 3 * torch.randn(len(DT), dims, generator=torch.Generator().manual_seed(2), **F64)
    z[3] += 40.0
    z[4] = torch.nan
    return z


FILTERS = {
    "srckf": lambda: presets.srckf(motion(), Position(2.0)),
    "gpb": lambda: presets.gpb(motion(), Position(2.0)),
    "bank": lambda: presets.gpb([motion(), CoordinatedTurn(0.3, 0.5)], Position(2.0)),
    "imm": lambda: presets.imm([motion(), CoordinatedTurn(0.3, 0.5)], Position(2.0)),
    "lasting": lambda: presets.gpb(motion(), Correlated(Position(2.0), 3.0, 30.0)),
}


@pytest.mark.parametrize("fault", [None, (0.05, 12.0)])
@pytest.mark.parametrize("name", FILTERS)
def test_it_is_the_quantile_of_all_hypotheses_that_a_filter_holds(name, fault):
    f = FILTERS[name]()
    estimate = f(measured(), prior(), dt=DT, past=True)
    beliefs, log_weights = f.hypotheses(estimate.past)
    found = protection_level(f, estimate, risk=1e-3, fault=fault)
    for k in range(len(DT)):
        probability = oracle.of_mixture(
            found[k].item(), beliefs.mean[k, :, :2].numpy(), beliefs.covariance[k, :, :2, :2].numpy(),
            log_weights[k].exp().numpy(), estimate.mean[k, :2].numpy(), fault or (0.0, 0.0),
        )  # fmt: skip
        assert probability == pytest.approx(1e-3, rel=1e-9)


@pytest.mark.parametrize("dims", [1, 2, 3])
def test_in_any_space_it_is_the_quantile_of_the_length_of_an_error(dims):
    f = presets.srckf(motion(dims), Position(2.0, dims=dims))
    estimate = f(measured(dims), prior(dims), past=True)
    (std,) = estimate.covariance[-1, :dims, :dims].diagonal().sqrt().unique(sorted=True)[-1:].tolist()
    found = protection_level(f, estimate, risk=1e-2)[-1].item()
    assert oracle.beyond(found / std, dims) == pytest.approx(1e-2, rel=1e-6)


@pytest.mark.parametrize("name", FILTERS)
def test_hypotheses_of_a_state_are_those_of_the_last_step_of_an_estimate(name):
    f = FILTERS[name]()
    estimate, state = f(measured(), prior(), dt=DT, past=True), f.init(prior())
    for z, dt in zip(measured(), DT, strict=True):
        state, _ = f.step(state, z, dt=dt)
    torch.testing.assert_close(protection_level(f, state), protection_level(f, estimate)[-1])
    together = (f.hypotheses(state)[1].exp().unsqueeze(-1) * f.hypotheses(state)[0].mean).sum(-2)
    torch.testing.assert_close(together, state.belief.mean, rtol=1e-9, atol=1e-9)


def test_errors_exceed_it_no_more_often_than_it_says():
    rng, f = torch.Generator().manual_seed(7), presets.srckf(motion(), Position(2.0))
    x = prior().scale_tril @ torch.randn(20000, 4, 1, generator=rng, **F64)
    steps = [x.squeeze(-1)]
    one = torch.tensor(1.0, **F64)
    for _ in range(3):
        noise = f.motion.process_noise(one) @ torch.randn(20000, 2, 1, generator=rng, **F64)
        steps.append(f.motion(steps[-1], one) + noise.squeeze(-1))
    truth = torch.stack(steps[1:], 1)[..., :2]
    z = truth + 2 * torch.randn(truth.shape, generator=rng, **F64)
    estimate = f(z, prior(), past=True)
    share = ((estimate.mean[..., :2] - truth).norm(dim=-1) > protection_level(f, estimate, risk=0.01)).double().mean()
    assert 0.006 < share < 0.0105  # the largest direction bounds the others


def test_a_doubtful_jump_widens_it_far_beyond_the_covariance_of_what_is_likely():
    f = FILTERS["gpb"]()
    level = protection_level(f, f(measured(), prior(), dt=DT, past=True))
    assert level[3] > 3 * level[2]


def test_tracks_of_a_batch_are_apart_and_one_that_failed_has_none():
    f, z = FILTERS["gpb"](), measured().expand(2, -1, -1).clone()
    z[1, 2] = torch.inf
    level = protection_level(f, f(z, prior(), dt=DT, past=True))
    alone = protection_level(f, f(z[0], prior(), dt=DT, past=True))
    torch.testing.assert_close(level[0], alone)
    assert level[1, 2:].isnan().all()


def test_a_tracker_has_it():
    f = FILTERS["gpb"]()
    t = Tracker(f, prior())
    t.update(1.0, [1.0, 2.0])
    torch.testing.assert_close(t.protection_level(fault=(0.1, 5.0)), protection_level(f, t.state, fault=(0.1, 5.0)))


class Reading(Sensor):
    """The first component of a state."""

    def __init__(self):
        super().__init__(1, [False], 1.0)

    def forward(self, x, u=None):
        return x[..., :1]


@pytest.mark.parametrize("motion", [Spherical(motion(3)), Clock(1.0, 1.0)], ids=["angles", "clock"])
def test_a_state_without_a_position_in_metres_is_refused(motion):
    f = presets.srckf(motion, Reading())
    with pytest.raises(ValueError, match=r"f: expected a filter of a motion with a position in metres, .* received"):
        protection_level(f, f.init(Gaussian(torch.ones(motion.size, **F64), torch.eye(motion.size, **F64))))


def test_an_estimate_without_its_past_and_what_is_neither_are_refused():
    f = FILTERS["srckf"]()
    with pytest.raises(ValueError, match="estimate: expected one made with past=True"):
        protection_level(f, f(measured(), prior()))
    with pytest.raises(
        ValueError, match="estimate: expected an estimate or a state that step has returned, received Tensor"
    ):
        protection_level(f, measured())


@pytest.mark.parametrize(("wrong", "message"), [
    ({"risk": 0.0}, "risk: expected a probability between 0 and 1, received 0.0"),
    ({"risk": math.nan}, "risk: expected a probability"),
    ({"fault": (1.5, 3.0)}, r"fault: expected a share from 0 to 1 and metres of 0 or more, received \(1.5, 3.0\)"),
    ({"fault": (0.1, -3.0)}, "fault: expected a share"),
    ({"fault": (0.1, np.inf)}, "fault: expected a share"),
])  # fmt: skip
def test_what_is_out_of_its_range_is_named(wrong, message):
    f = FILTERS["srckf"]()
    with pytest.raises(ValueError, match=message):
        protection_level(f, f.init(prior()), **wrong)
