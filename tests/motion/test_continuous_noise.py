"""Process noise of a density is its integral, to many digits and in the precision of the step."""

import math
from functools import partial
from itertools import permutations

import mpmath
import pytest
import torch

from torchfra.motion import (
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    Singer,
    UnknownTurn,
    WhiteJerk,
    aircraft,
    people,
    ships,
    vehicles,
)

MOTIONS = {
    "constant velocity": ConstantVelocity(0.7, 3, continuous=True),
    "with an acceleration": ConstantVelocity(0.7, 2, orders=3, continuous=True),
    "constant acceleration": ConstantAcceleration(0.7, 2, continuous=True),
    "turn": CoordinatedTurn(0.2, 0.7, 3, continuous=True),
    "turn with an acceleration": CoordinatedTurn(-0.4, 0.7, 2, orders=3, continuous=True),
    "turn of no rate": CoordinatedTurn(0.0, 0.7, 2, continuous=True),
    "white jerk": WhiteJerk(0.7),
    "Singer": Singer(2.0, 0.3),
}


def covariance(motion, dt):
    root = motion.process_noise(torch.as_tensor(dt, dtype=torch.float64))
    return root @ root.mT


@pytest.mark.parametrize("rate", [1e-7, 0.05, 0.5])
def test_the_noise_of_a_turn_is_its_integral_to_many_digits(rate):
    dt, q = 7.0, 0.7
    with mpmath.workdps(40):
        w = mpmath.mpf(rate)

        def response(s):  # of position and velocity to a velocity along x that came s seconds ago
            return mpmath.sin(w * s) / w, (1 - mpmath.cos(w * s)) / w, mpmath.cos(w * s), mpmath.sin(w * s)

        def along(i, j):
            return float(q * mpmath.quad(lambda s: response(s)[i] * response(s)[j], [0, dt]))

        x = [[along(i, j) for j in range(4)] for i in range(4)]
    turned = torch.tensor([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]], dtype=torch.float64)
    of_x = torch.tensor(x, dtype=torch.float64)
    expected = of_x + turned @ of_x @ turned.mT
    torch.testing.assert_close(
        covariance(CoordinatedTurn(rate, q, continuous=True), dt), expected, rtol=1e-12, atol=1e-12
    )


def test_white_noise_has_its_closed_form():
    expected = 0.7 * torch.tensor([[2.0**3 / 3, 2.0**2 / 2], [2.0**2 / 2, 2.0]], dtype=torch.float64)
    torch.testing.assert_close(covariance(ConstantVelocity(0.7, 1, continuous=True), 2.0), expected)


def test_the_form_of_the_papers_stays_the_default():
    root = ConstantVelocity(4.0, 1).process_noise(torch.tensor(3.0, dtype=torch.float64))
    torch.testing.assert_close(root, 2 * torch.tensor([[4.5], [3.0]], dtype=torch.float64))
    x, dt = torch.tensor([0.0, 0.0, 7.0, 0.0, 0.3]).double(), torch.tensor(1.0).double()
    for make in (aircraft, ships, vehicles, people, partial(CoordinatedTurn, 0.3, 1.0), partial(UnknownTurn, 1.0, 0.1)):
        usual, constant, white = (make(**options) for options in ({}, {"continuous": False}, {"continuous": True}))
        usual, constant, white = (
            m.process_noise_at(m.process_noise(dt), x[: m.size], dt) for m in (usual, constant, white)
        )
        assert usual.equal(constant)
        assert usual.shape != white.shape or not usual.equal(white)


@pytest.mark.parametrize(("make", "q", "slow", "fast", "limit"), [
    (aircraft, 4.0, 3.0, 12.0, 9.8), (ships, 0.01, 0.5, 2.0, 0.5), (vehicles, 2.0, 8.0, 25.0, 6.0),
    (people, 0.5, 20.0, 60.0, 3.0),
])  # fmt: skip
def test_banks_have_the_turns_and_the_largest_acceleration_that_they_name(make, q, slow, fast, limit):
    for bank, of in ((make(), q), (make(7.0), 7.0)):
        turns = [model for model in bank if isinstance(model, CoordinatedTurn)]
        rates = sorted(math.degrees(turn.rate()) for turn in turns)
        assert rates == pytest.approx([-fast, -slow, slow, fast])
        assert [model.q().item() for model in (bank[0], bank[1], *turns)] == pytest.approx([of / 40, *[of] * 5])
        assert bank[2].limit().item() == pytest.approx(limit)
    assert make(7.0, continuous=True)[1].q().item() == pytest.approx(0.07)


@pytest.mark.parametrize("make", [aircraft, ships, vehicles, people])
def test_banks_are_the_same_from_either_side_and_every_manoeuvre_leads_back_to_straight_flight(make):
    bank = make()
    other = list(range(len(bank)))  # of each motion, that which turns the other way
    for i, j in permutations(other, 2):
        if isinstance(bank[i], CoordinatedTurn) and isinstance(bank[j], CoordinatedTurn):
            other[i] = j if bank[i].rate() == -bank[j].rate() else other[i]
    for i, those in enumerate(bank.neighbours):
        assert {other[j] for j in those} == set(bank.neighbours[other[i]])
        assert i not in those
        assert 0 in {i, *those, *(k for j in those for k in bank.neighbours[j])}
    assert {other[i] for i in bank.first} == set(bank.first)


@pytest.mark.parametrize("make", [aircraft, ships, vehicles, people])
def test_banks_are_of_one_state_and_take_densities_of_a_batch(make):
    bank = make(torch.tensor([1.0, 2.0], dtype=torch.float64), 3, continuous=True)
    assert (len(bank), bank.size) == (7, 9)
    assert bank.process_noise(torch.ones(2, dtype=torch.float64)).shape[:3] == (2, 7, 9)
    rates = sorted(abs(math.degrees(model.rate())) for model in bank if isinstance(model, CoordinatedTurn))
    assert rates[0] < rates[-1]


@pytest.fixture
def double_by_default():
    """Tensors of Python's numbers are double, as some programs set it."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.mark.usefixtures("double_by_default")
@pytest.mark.parametrize("name", MOTIONS)
def test_the_noise_has_the_precision_of_the_step_whatever_the_default_is(name):
    for dtype in (torch.float32, torch.float64):
        assert MOTIONS[name].process_noise(torch.tensor([0.5, 2.0], dtype=dtype)).dtype == dtype
