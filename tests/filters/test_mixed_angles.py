"""Angles of states mix by wrapping: nothing depends on where the circle is cut."""

import copy
import math

import pytest
import torch

from torchfra import presets
from torchfra.angles import near, turned, wrap
from torchfra.coordinates import from_cartesian
from torchfra.gaussian import moment_match
from torchfra.motion import Bank, Bicycle, ConstantVelocity, CoordinatedTurn, Spherical
from torchfra.sensors import InfraredLaser, Position, Sensor
from torchfra.types import Gaussian

HALF = math.pi


def tensor(*rows):
    return torch.tensor(rows, dtype=torch.float64)


class Heading(ConstantVelocity):
    """``[heading, rate]``, the heading in [0, 2 pi)."""

    def __init__(self, q):
        super().__init__(q, 1)
        self.angles = (0,)

    def canonical(self, mean):
        return torch.cat([turned(mean[..., :1]), mean[..., 1:]], -1)


class Compass(Sensor):
    """The heading."""

    def __init__(self):
        super().__init__(1, [True], 0.05)

    def forward(self, x, u=None):
        return x[..., :1]


# ---------------------------------------------------------------- moments


def some(k=3, spread=0.7, seed=0):
    rng = torch.Generator().manual_seed(seed)
    mean = spread * (torch.rand(k, 20, 3, dtype=torch.float64, generator=rng) - 0.5)
    root = 0.1 * torch.randn(k, 20, 3, 3, dtype=torch.float64, generator=rng).tril()
    return Gaussian(mean, root), torch.log_softmax(torch.randn(k, 20, generator=rng, dtype=torch.float64), 0)


@pytest.mark.parametrize("turn", [0.0, 3.0, -3.1, 40.0])
def test_angles_within_half_the_circle_have_the_moments_of_numbers_wherever_it_is_cut(turn):
    each, weights = some(spread=3.0)
    plain = moment_match(each, weights)
    mean = torch.cat([each.mean[..., :1], wrap(each.mean[..., 1:2] + turn), each.mean[..., 2:]], -1)
    mixed = moment_match(Gaussian(mean, each.scale_tril), weights, (1,))
    torch.testing.assert_close(mixed.covariance, plain.covariance)
    torch.testing.assert_close(wrap(mixed.mean - plain.mean - tensor(0, turn, 0)), torch.zeros(20, 3).double())
    assert torch.equal(mixed.mean[:, ::2], plain.mean[:, ::2])


def test_angles_count_from_the_likeliest_belief():
    each = Gaussian(tensor([0.1], [HALF + 0.2], [-6.1]), torch.zeros(3, 1, 1).double())
    for weights, expected in (
        (tensor(0.5, 0.2, 0.3), 0.5 * 0.1 + 0.2 * (0.2 - HALF) + 0.3 * (2 * HALF - 6.1)),
        (tensor(0.2, 0.5, 0.3), 0.2 * (0.1 + 2 * HALF) + 0.5 * (HALF + 0.2) + 0.3 * (4 * HALF - 6.1)),
    ):
        assert moment_match(each, weights.log(), (0,)).mean.item() == pytest.approx(expected, abs=1e-12)


def test_beliefs_without_weight_do_not_count_and_gradients_are_those_of_finite_differences():
    each, weights = some()
    each = Gaussian(each.mean[:, 0] + tensor(0, HALF, 0), each.scale_tril[:, 0])
    each.mean[0] = torch.nan
    weights = tensor(-torch.inf, 0.6, 0.4).log_softmax(0)
    assert moment_match(each, weights, (1,)).mean.isfinite().all()
    mean = each.mean[1:].clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda m: moment_match(Gaussian(m, each.scale_tril[1:]), weights[1:], (1,)).mean, mean
    )


def test_an_angle_that_is_near_already_stays_as_it_is():
    angle = torch.linspace(-3, 3, 101).double()
    assert torch.equal(near(angle, 0.1 * angle), angle)
    assert (near(angle + 40, angle) - angle).abs().max() <= HALF + 1e-9


# ---------------------------------------------------------------- filters


def headings(offset, steps=30, tracks=4):
    """Compass readings of targets that turn at times, all turned by an offset."""
    rng = torch.Generator().manual_seed(3)
    rate = torch.where(torch.arange(steps) % 20 < 10, 0.0, 0.3)
    z = rate.cumsum(0) + 0.05 * torch.randn(tracks, steps, generator=rng, dtype=torch.float64)
    prior = Gaussian(tensor(0.2 + offset, 0.0), tensor(0.2, 0.1).diag())
    return wrap(z + offset).unsqueeze(-1), prior


BANK = Bank([Heading(1e-4), Heading(0.3)])
FILTERS = {
    "imm_srckf": lambda: presets.imm_srckf(BANK, Compass(), self_transition=0.9),
    "imm_fra": lambda: presets.imm_fra(BANK, Compass(), self_transition=0.9),
    "gpb": lambda: presets.gpb(BANK, Compass()),
    "gpb of one": lambda: presets.gpb(Heading(1e-3), Compass()),
    "vsimm": lambda: presets.vsimm_srckf(
        Bank([Heading(1e-4), Heading(0.3), Heading(0.01)], neighbours=((1,), (2,), (0,)), first=(0, 1)), Compass()
    ),
    "fra, soft": lambda: presets.fra(Heading(1e-3), Compass(), temperature=1.0),
}


@pytest.mark.parametrize("smooth", [False, True], ids=["filtered", "smoothed"])
@pytest.mark.parametrize("name", FILTERS)
def test_no_filter_of_several_hypotheses_depends_on_where_the_circle_is_cut(name, smooth):
    offsets = (0.5 - HALF, HALF + 0.01, 2 * HALF - 1.0)
    z, priors = zip(*map(headings, offsets), strict=True)
    prior = Gaussian(torch.stack([p.mean for p in priors]).unsqueeze(1), priors[0].scale_tril)
    f = FILTERS[name]()
    with torch.no_grad():
        estimate = (f.smooth if smooth else f)(torch.stack(z), prior)
    (first, *others), (covariance, *more) = estimate.mean, estimate.covariance
    for offset, mean in zip(offsets[1:], others, strict=True):
        gap = BANK.difference(mean - tensor(offset - offsets[0], 0.0), first)
        torch.testing.assert_close(gap, torch.zeros_like(gap), rtol=0, atol=1e-9)
    for other in more:
        torch.testing.assert_close(other, covariance, rtol=1e-7, atol=1e-12)
    assert ((first[..., 0] >= 0) & (first[..., 0] < 2 * HALF)).all() or "fra" in name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["imm_srckf", "gpb of one"])
def test_a_compiled_filter_mixes_angles_alike(name):
    z, prior = headings(HALF)
    f = FILTERS[name]()
    with torch.no_grad():
        slow, fast = (g(z, prior) for g in (f, copy.deepcopy(f).compile()))
    torch.testing.assert_close(fast.mean, slow.mean, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_bank_of_bicycles_follows_a_vehicle_round_and_round():
    truth, dt = [tensor(0, 0, 8, 3.0, 0.15)], torch.tensor(0.2, dtype=torch.float64)
    for _ in range(150):
        truth.append(Bicycle(2.7, 0.0, 0.0)(truth[-1], dt))
    truth = torch.stack(truth[1:])
    assert truth[:, 3].max() > 4 * HALF  # two turns
    rng = torch.Generator().manual_seed(0)
    z = truth[:, :2] + 0.3 * torch.randn(5, 150, 2, generator=rng, dtype=torch.float64)
    prior = Gaussian(tensor(0, 0, 8, -3.2, 0.0), tensor(1, 1, 1, 0.2, 0.1).diag())
    bank = Bank([Bicycle(2.7, 0.1, 1e-4), Bicycle(2.7, 4.0, 0.1)])
    with torch.no_grad():
        for f in (presets.imm_srckf(bank, Position(0.3), self_transition=0.95), presets.gpb(bank, Position(0.3))):
            mean = f(z, prior, dt=dt).mean
            assert (mean - truth)[:, 20:, :2].norm(dim=-1).mean() < 0.3
            assert wrap(mean - truth)[:, 50:, 3].abs().max() < 0.2


def test_a_bank_of_modified_spherical_coordinates_maps_the_noise_of_each_motion():
    bank = Bank([Spherical(ConstantVelocity(0.3, 3)), Spherical(CoordinatedTurn(0.1, 0.1, 3))])
    mean = from_cartesian(tensor([300, 400, 120, 10, -5, 1], [-300, 400, 120, 10, 5, 1])).unsqueeze(0).expand(4, 2, -1)
    dt = torch.tensor(0.5).double()
    every = bank.process_noise_at(bank.process_noise(dt), mean, dt)
    for k, motion in enumerate(bank):
        own = motion.process_noise_at(motion.process_noise(dt), mean[:, k], dt)
        torch.testing.assert_close(every[:, k] @ every[:, k].mT, own @ own.mT)
    z = InfraredLaser(tensor(0.01, 0.01, 5.0))(mean[:, 0]).unsqueeze(1)
    estimate = presets.imm_srckf(bank, InfraredLaser(tensor(0.01, 0.01, 5.0)))(
        z, Gaussian(mean[0, 0], 1e-3 * torch.eye(6).double())
    )
    assert estimate.mean.isfinite().all()
