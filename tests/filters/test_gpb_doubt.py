"""Spikes, bursts, jumps and priors of any size: what GPB believes, and when."""

import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.scenarios import OpenCell
from torchfra.sensors import Position

RUNS, STEPS, STD, MIDDLE = 20, 40, 2.0, 25
INDEX = 0.1
"""Process noise of a step by the measurement noise, as standard deviations."""
MOTION, SENSOR = ConstantVelocity((INDEX * STD) ** 2, continuous=True), Position(STD)
SIZES = (10.0, 30.0, 1e3, 1e5)
"""Standard deviations of the measurement noise."""


def tracks(confident=1.0):
    """Truth ``(B, T, 4)``, measurements and a prior, all as stated; a confident prior is as much closer."""
    g = torch.Generator().manual_seed(0)
    second = torch.tensor(1.0, dtype=torch.float64)
    F, L = MOTION.transition(second), MOTION.process_noise(second)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    spread = confident * torch.tensor([STD, STD, 1.0, 1.0], dtype=torch.float64)
    first = 10 * normal(RUNS, 4)
    x, truth = first, []
    for _ in range(STEPS):
        x = x @ F.mT + normal(RUNS, L.shape[-1]) @ L.mT
        truth.append(x)
    truth = torch.stack(truth, 1)
    z = truth[..., :2] + STD * normal(RUNS, STEPS, 2)
    return truth, z, Gaussian(first + spread * normal(RUNS, 4), spread.diag())


def ways():
    """A direction for each run."""
    angle = torch.linspace(0, 6, RUNS, dtype=torch.float64)
    return torch.stack([angle.cos(), angle.sin()], -1)


def errors(truth, z, prior, **options):
    """Root mean square position errors of each step ``(T,)``, in standard deviations of the measurement noise."""
    estimate = presets.gpb(MOTION, SENSOR, **options)(z, prior)
    return (estimate.mean - truth)[..., :2].square().sum(-1).mean(0).sqrt().detach() / STD


@pytest.mark.parametrize("size", SIZES)
def test_spikes_of_any_size_cost_what_they_cost_without_manoeuvres(size):
    truth, z, prior = tracks()
    for step in (6, 7, 15, 20, 22, 30):
        z[:, step] += size * STD * ways() * (-1) ** step
    known, some = (errors(truth, z, prior, manoeuvres=m).square().mean().sqrt() for m in ("none", "some"))
    assert some < 1.02 * known


@pytest.mark.parametrize("size", SIZES[1:])  # ten standard deviations may be a turn as well
def test_four_equal_outliers_are_a_burst_and_a_fifth_makes_them_a_jump(size):
    truth, z, prior = tracks()
    plain = errors(truth, z, prior)
    away = size * STD * ways().unsqueeze(1)
    burst, moved, there = z.clone(), z.clone(), truth.clone()
    burst[:, MIDDLE : MIDDLE + 4] += away
    moved[:, MIDDLE:] += away
    there[:, MIDDLE:, :2] += away
    assert (errors(truth, burst, prior)[MIDDLE : MIDDLE + 4] < size / 2).all()
    followed = errors(there, moved, prior)[MIDDLE + 4 :]
    assert followed[0] < size / 2
    assert (followed[1:] < 2.5 * plain[MIDDLE + 5 :]).all()


def test_a_shorter_burst_makes_a_jump_earlier():
    truth, z, prior = tracks()
    away = 100 * STD * ways().unsqueeze(1)
    z[:, MIDDLE:] += away
    truth[:, MIDDLE:, :2] += away
    followed = errors(truth, z, prior, burst=2.0)[MIDDLE:] < 50
    assert followed.tolist() == [False] * 2 + [True] * (STEPS - MIDDLE - 2)


@pytest.mark.parametrize("away", [250.0, 2500.0, 25000.0])
@pytest.mark.parametrize("confident", [0.05, 1.0])
def test_a_prior_that_is_off_by_any_distance_is_left_within_three_measurements(away, confident):
    truth, z, prior = tracks(confident)
    off = torch.cat([ways(), ways()], -1) @ prior.scale_tril.mT
    found = errors(truth, z, Gaussian(prior.mean + away * off, prior.scale_tril))
    assert (found[2:] < 1.5 * 2**0.5).all()  # of a fix alone it is the root of 2


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES[:-1])
@pytest.mark.parametrize("step", [0, 1, 2])
def test_an_outlier_after_a_confident_prior_costs_no_more_than_one_later(size, step):
    truth, z, prior = tracks(0.05)

    def cost(at):
        hit = z.clone()
        hit[:, at] += size * STD * ways()
        return (errors(truth, hit, prior)[at] / errors(truth, z, prior)[at]).item()

    assert cost(step) < 1.05 * cost(MIDDLE)


@pytest.mark.parametrize("size", [1e3, 1e4])
def test_a_target_that_was_carried_elsewhere_may_move_as_fast_in_another_direction(size):
    truth, z, prior = tracks()
    speed, turned = 30 * STD * ways(), 30 * STD * ways().flip(-1)
    seconds = torch.arange(1.0, STEPS + 1, dtype=torch.float64).reshape(-1, 1)
    since = (seconds - MIDDLE).clamp_min(0.0)
    moved = (seconds - since) * speed.unsqueeze(1) + since * turned.unsqueeze(1)
    moved = moved + size * STD * ways().unsqueeze(1) * (since > 0)
    start = torch.cat([torch.zeros_like(speed), speed], -1)
    found = errors(truth + torch.cat([moved, moved], -1), z + moved, Gaussian(prior.mean + start, prior.scale_tril))
    assert (found[MIDDLE + 7 :] < 3).all()


def test_a_confused_start_does_not_take_a_heading_away():
    scenario = OpenCell("half", motion="gyroscope", size=2000.0, index=0.3, one_sided=True).scenario(steps=30)
    tracks = scenario.simulate(20, 1)
    estimate = presets.gpb(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
    off = (estimate.mean - tracks.truth)[..., :2].norm(dim=-1)
    assert (off[:, -10:].mean(-1) < 20 * scenario.sensor.std()).all()


def test_three_outliers_at_the_beginning_that_disagree_are_no_prior_that_is_off():
    """With a wide acceleration any three places would agree, where the third comes later."""
    scenario = OpenCell(motion="acceleration", index=0.015, dt=4.0).scenario(steps=40)
    tracks, steps = scenario.simulate(100, 1), [0, 1, *range(12, 20)]
    dt = torch.full((len(steps),), 4.0, dtype=torch.float64)
    dt[2] = 44.0
    z, truth = tracks.z[:, steps].clone(), tracks.truth[:, steps, :2]
    angle = 6.28 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    z[:, :3] += 3e4 * torch.stack([angle.cos(), angle.sin()], -1)
    found = presets.gpb(scenario.motion, scenario.sensor)(z, tracks.prior, dt=dt).mean
    assert (found[..., :2] - truth).norm(dim=-1).max() < 3000
