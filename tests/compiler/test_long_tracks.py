"""One long track runs in pieces, at once, and says what it would step after step."""

import pytest
import torch
from gpb_cases import FEWER

from torchfra import Gaussian, motion, presets, sensors
from torchfra.compiler import pieces

MOTION, SENSOR = motion.ConstantVelocity(1.0), sensors.Position(1.0)
PRIOR = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
STEPS = 9000
APART = 1e-8
"""Standard deviations: seams are within 1e-9 of these, and what is scored is a square."""


@pytest.fixture(autouse=True)
def pieces_that_ran(monkeypatch):
    """How many pieces each long track had, and how many of these had to run on their own; None if it had none."""
    ran = []

    class Counted(pieces.Pieces):
        def __call__(self):
            self.alone = 0
            done = super().__call__()
            ran.append(None if done is None else (self.lanes, self.alone))
            return done

        def _alone(self, *arguments):
            self.alone += arguments[-1] == self.length
            return super()._alone(*arguments)

    monkeypatch.setattr("torchfra.compiler.run.Pieces", Counted)
    return ran


def track(steps=STEPS, seed=0):
    """Positions along a winding course, with noise of 1 m."""
    t = torch.arange(steps, dtype=torch.float64)
    course = torch.stack([500 * torch.sin(0.02 * t) + 200 * torch.sin(0.046 * t), 500 * torch.cos(0.02 * t)], 1)
    return course + torch.randn(steps, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def in_a_batch(x):
    """The same track twice: batches do not run in pieces."""
    return torch.stack([x, x])


def check_same(one, other):
    std = other.scale_tril.norm(dim=-1)
    assert ((one.mean - other.mean).abs() / std).max() < APART
    assert ((one.scale_tril - other.scale_tril).abs().amax(-1) / std).max() < APART
    torch.testing.assert_close(one.nis, other.nis, rtol=APART, atol=APART)
    torch.testing.assert_close(one.log_likelihood, other.log_likelihood, rtol=APART, atol=APART)


def batched(estimate):
    """That of the first track of a batch."""
    first = {name: getattr(estimate, name)[0] for name in ("mean", "scale_tril", "nis", "log_likelihood")}
    return estimate._replace(**first)


@pytest.mark.parametrize(("name", "steps"), [("srckf", STEPS), ("rsrckf", 4 * STEPS), ("imm_srckf", STEPS)])
def test_a_long_track_is_filtered_and_smoothed_as_one_of_a_batch_is(name, steps, pieces_that_ran):
    models = [MOTION, motion.ConstantVelocity(9.0)] if name.startswith("imm") else MOTION
    f, z = getattr(presets, name)(models, SENSOR).compile(), track(steps)
    z[::50] = torch.nan
    check_same(f(z, PRIOR), batched(f(in_a_batch(z), PRIOR)))
    check_same(f.smooth(z, PRIOR), batched(f.smooth(in_a_batch(z), PRIOR)))
    assert len(pieces_that_ran) == 3  # the filter twice, and backwards
    for lanes, again in pieces_that_ran:
        assert lanes >= 16
        assert again <= lanes / 5


def test_pieces_that_began_otherwise_than_the_one_before_ended_run_again(pieces_that_ran):
    f, z = presets.srckf(MOTION, SENSOR).compile(), track()
    z[::50] = torch.nan
    z[2400:2700] = torch.nan  # what is early of one piece sees nothing
    check_same(f(z, PRIOR), batched(f(in_a_batch(z), PRIOR)))
    ((lanes, again),) = pieces_that_ran
    assert lanes == 17
    assert again in (1, 2)


def test_a_filter_that_remembers_all_runs_step_after_step(pieces_that_ran):
    f, z = presets.srckf(motion.ConstantVelocity(1e-12), SENSOR).compile(), torch.zeros(STEPS, 2).double()
    torch.testing.assert_close(f(z, PRIOR).mean, batched(f(in_a_batch(z), PRIOR)).mean, rtol=0, atol=1e-12)
    assert pieces_that_ran == [None]


def test_gradients_of_a_long_track_are_those_of_one_of_a_batch(pieces_that_ran):
    f, z = presets.srckf(MOTION, SENSOR, learn=("q", "std")).compile(), track()
    one, two = z.clone().requires_grad_(), z.clone().requires_grad_()
    f(one, PRIOR).log_likelihood.sum().backward()
    slopes = [p.grad.clone() for p in f.parameters()]
    f.zero_grad()
    batched(f(in_a_batch(two), PRIOR)).log_likelihood.sum().backward()
    torch.testing.assert_close(one.grad, two.grad, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(slopes, [p.grad for p in f.parameters()], rtol=1e-7, atol=1e-7)
    assert pieces_that_ran == [(17, 0)]


@pytest.mark.slow
def test_hypotheses_forget_within_a_thousand_steps(pieces_that_ran):
    f, z = presets.gpb(motion.ConstantVelocity(0.1), SENSOR, **FEWER).compile(), track(140_000)
    z[::37] += 30.0
    check_same(f(z, PRIOR), batched(f(in_a_batch(z), PRIOR)))
    ((lanes, again),) = pieces_that_ran
    assert lanes == 17  # begun 1024 steps early
    assert again <= 2
