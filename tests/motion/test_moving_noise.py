"""Process noise that follows the state is the integral of what each disturbance leaves, to many digits."""

import copy

import mpmath
import pytest
import torch
from mpmath import mpf
from numpy.polynomial.legendre import leggauss

from torchfra import Gaussian, presets
from torchfra.hyper import learnable
from torchfra.motion import (
    Bicycle,
    Clock,
    ConstantSpeed,
    GaussMarkov,
    IntegratedOrnsteinUhlenbeck,
    Level,
    Odometry,
    RandomWalk,
    Singer,
    UnknownTurn,
    WhiteJerk,
)
from torchfra.sensors import Position

STEP = 1.5


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def covariance(motion, dt=STEP, mean=None):
    dt = torch.tensor(dt, dtype=torch.float64)
    root = motion.process_noise(dt)
    root = root if mean is None else motion.process_noise_at(root, mean, dt)
    return root @ root.mT


def turning(x):
    _, _, vx, vy, rate = x
    return [vx, vy, -rate * vy, rate * vx, mpf(0)]


def rolling(rear):
    def speeds(x):
        _, _, speed, heading, steering = x
        slip = mpmath.atan(rear / mpf(2.7) * mpmath.tan(steering))
        rate = speed * mpmath.cos(slip) * mpmath.tan(steering) / mpf(2.7)
        return [speed * mpmath.cos(heading + slip), speed * mpmath.sin(heading + slip), mpf(0), rate, mpf(0)]

    return speeds


def flow(speeds, x, time, steps=24):
    """The state after some time, by Gragg's midpoint rule extrapolated four times: errors of some 1e-15 here."""
    table = []
    for row, count in enumerate((steps, 2 * steps, 4 * steps, 8 * steps, 16 * steps)):
        h = mpf(time) / count
        before, now = x, [a + h * b for a, b in zip(x, speeds(x), strict=True)]
        for _ in range(count - 1):
            before, now = now, [a + 2 * h * b for a, b in zip(before, speeds(now), strict=True)]
        end = [(a + b + h * c) / 2 for a, b, c in zip(now, before, speeds(now), strict=True)]
        table.append([end])
        for k in range(row):
            last, other = table[row][k], table[row - 1][k]
            table[row].append([a + (a - b) / (4 ** (k + 1) - 1) for a, b in zip(last, other, strict=True)])
    return table[-1][-1]


def exact(speeds, mean, inputs, densities, *, continuous):
    """Covariance that disturbances of some components leave, linearised along the way to a mean, by quadrature."""
    with mpmath.workdps(30):
        end, small = [mpf(float(v)) for v in mean], mpf(10) ** -8
        columns = {i: [] for i in inputs}
        weights = []
        for node, weight in zip(*(v.tolist() for v in leggauss(10)), strict=True):
            ago = STEP * (node + 1) / 2
            start = flow(speeds, end, -ago, 4)
            weights.append(mpf(weight) * STEP / 2)
            for i in inputs:
                up, down = ([v + sign * small * (j == i) for j, v in enumerate(start)] for sign in (1, -1))
                ends = (flow(speeds, x, ago, 4) for x in (up, down))
                columns[i].append([(a - b) / (2 * small) for a, b in zip(*ends, strict=True)])
        total = mpmath.zeros(len(end))
        for i, q in zip(inputs, densities, strict=True):
            if continuous:
                for w, c in zip(weights, columns[i], strict=True):
                    total += q * w * mpmath.matrix(c) * mpmath.matrix(c).T
            else:
                c = sum(
                    (w * mpmath.matrix(c) for w, c in zip(weights, columns[i], strict=True)), mpmath.zeros(len(end), 1)
                )
                total += q * c * c.T
        return tensor(*[[float(v) for v in total[i, :]] for i in range(len(end))])


@pytest.mark.parametrize("rate", [0.0, 0.3, -1.2])
def test_the_noise_of_a_turn_whose_rate_drifts_is_its_integral_along_the_turn(rate):
    mean = tensor(3, 4, 12, -5, rate)
    motion = UnknownTurn(0.7, 0.02, continuous=True)
    expected = exact(turning, mean, (2, 3, 4), (0.7, 0.7, 0.02), continuous=True)
    torch.testing.assert_close(covariance(motion, mean=mean), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("rear", "steering", "continuous"), [(0.0, 0.0, True), (1.3, 0.25, True), (0.4, -0.4, False)])
def test_the_noise_of_a_bicycle_is_its_integral_along_the_arc(rear, steering, continuous):
    mean = tensor(3, 4, 7, 2.0, steering)
    motion = Bicycle(2.7, 0.7, 0.02, rear=rear, continuous=continuous)
    expected = exact(rolling(rear), mean, (2, 4), (0.7, 0.02), continuous=continuous)
    torch.testing.assert_close(covariance(motion, mean=mean), expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("motion", "speeds", "x"),
    [
        (UnknownTurn(0.1, 0.1), turning, tensor(1, 2, 10, -5, 0.4)),
        (UnknownTurn(0.1, 0.1), turning, tensor(1, 2, 10, -5, 0.0)),
        (Bicycle(2.7, 0.1, 0.1, rear=1.3), rolling(1.3), tensor(1, 2, 9, -2.0, 0.3)),
        (Bicycle(2.7, 0.1, 0.1), rolling(0.0), tensor(1, 2, 9, -2.0, 0.0)),
    ],
)
def test_states_follow_the_differential_equation(motion, speeds, x):
    expected = [float(v) for v in flow(speeds, [mpf(float(v)) for v in x], STEP)]
    torch.testing.assert_close(motion(x, torch.tensor(STEP).double()), tensor(*expected), rtol=0, atol=1e-10)


@pytest.mark.parametrize("motion", [
    UnknownTurn(0.7, 0.02, continuous=True), UnknownTurn(0.7, 0.02, 3, continuous=True),
    Bicycle(2.7, 0.7, 0.02, rear=1.0, continuous=True), ConstantSpeed(0.7, 0.02, continuous=True),
])  # fmt: skip
def test_two_half_steps_are_one_whole(motion):
    x = tensor(1, 2, 3, 10, -5, 4, 0.3)[: motion.size]
    x = tensor(1, 2, 10, -0.5, 0.3) if motion.size == 5 else x
    h = torch.tensor(STEP / 2).double()
    middle = motion(x, h)
    on = torch.func.jacrev(lambda y: motion(y, h))(middle)
    both = on @ covariance(motion, STEP / 2, middle) @ on.mT + covariance(motion, STEP / 2, motion(middle, h))
    torch.testing.assert_close(both, covariance(motion, STEP, motion(x, 2 * h)), rtol=1e-11, atol=1e-12)


def test_the_direction_wanders_across_the_velocity_and_the_speed_along_it():
    velocity, q, wander = tensor(3, -4, 12), 0.5, 0.02
    along = torch.outer(velocity, velocity) / 169
    acceleration = q * torch.eye(3).double() + wander * 169 * (torch.eye(3).double() - along)
    mean = torch.cat([tensor(1, 2, 3), velocity])
    gain = tensor([STEP**2 / 2], [STEP])
    constant = torch.kron(gain @ gain.mT, acceleration)
    white = torch.kron(tensor([STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]), acceleration)
    torch.testing.assert_close(covariance(ConstantSpeed(q, wander), mean=mean), constant)
    torch.testing.assert_close(covariance(ConstantSpeed(q, wander, continuous=True), mean=mean), white)
    at_rest = ConstantSpeed(q, wander)
    torch.testing.assert_close(covariance(at_rest, mean=torch.zeros(6).double()), covariance(at_rest))
    x = torch.zeros(6).double().requires_grad_()
    dt = torch.tensor(STEP).double()
    assert torch.autograd.gradcheck(lambda m: at_rest.process_noise_at(at_rest.process_noise(dt), m, dt), x)


@pytest.mark.parametrize("product", [1e-8, 0.1, 1.0, 16.0, 1e3, 1e8])
def test_a_velocity_that_forgets_has_its_known_noise_however_short_or_long_the_memory(product):
    with mpmath.workdps(60):
        a, t = mpf(product) / mpf(STEP), mpf(STEP)
        e = mpmath.exp(-a * t)
        vv, pv = 1 - e**2, (1 - e) ** 2 / a
        pp = (2 * a * t - 3 + 4 * e - e**2) / a**2
        expected = tensor([float(pp), float(pv)], [float(pv), float(vv)])
        moved = float((1 - e) / a)
    motion = IntegratedOrnsteinUhlenbeck(2.0, float(a), 1)
    torch.testing.assert_close(covariance(motion), 2 * expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(motion.transition(torch.tensor(STEP).double()), tensor([1, moved], [0, float(e)]))


def test_axes_in_space_are_alike_and_independent():
    for motion in (Singer(0.7, 0.2, 3), IntegratedOrnsteinUhlenbeck(0.7, 0.2, 3)):
        alone = type(motion)(0.7, 0.2, 1)
        torch.testing.assert_close(covariance(motion), torch.kron(covariance(alone), torch.eye(3).double()))


def test_walks_and_clocks_have_their_known_noise():
    torch.testing.assert_close(covariance(RandomWalk(0.3, 2)), 0.3 * STEP * torch.eye(2).double())
    steady = tensor([0.3 * STEP + 0.02 * STEP**3 / 3, 0.02 * STEP**2 / 2], [0.02 * STEP**2 / 2, 0.02 * STEP])
    torch.testing.assert_close(covariance(Clock(0.3, 0.02)), steady)
    assert Clock(0.3, 0.02).transition(torch.tensor(STEP).double()).tolist() == [[1, STEP], [0, 1]]


def test_an_unknown_turn_has_the_noise_of_a_straight_step_and_of_its_rate():
    straight = torch.kron(tensor([STEP**4 / 4, STEP**3 / 2], [STEP**3 / 2, STEP**2]), 0.7 * torch.eye(2).double())
    expected = torch.block_diag(straight, tensor([0.02 * STEP**2]))
    torch.testing.assert_close(covariance(UnknownTurn(0.7, 0.02), mean=tensor(1, 2, 10, -5, 0.4)), expected)
    white = UnknownTurn(0.7, 0.02, continuous=True)
    torch.testing.assert_close(covariance(white), covariance(white, mean=torch.zeros(5).double()))


@pytest.mark.parametrize("make", [
    lambda x: UnknownTurn(0.7 * x, 0.02 * x), lambda x: UnknownTurn(0.7 * x, 0.02 * x, continuous=True),
    lambda x: Bicycle(2.7, 0.7 * x, 0.02 * x), lambda x: Bicycle(2.7, 0.7 * x, 0.02 * x, continuous=True),
    lambda x: ConstantSpeed(0.7 * x, 0.02 * x), lambda x: ConstantSpeed(0.7 * x, 0.02 * x, continuous=True),
    lambda x: Level(UnknownTurn(0.7 * x, 0.02 * x), 0.3 * x), lambda x: Odometry(0.1 * x, 0.02 * x, 1e-3 * x),
    lambda x: Singer(0.7 * x, 0.2), lambda x: WhiteJerk(0.7 * x), lambda x: GaussMarkov(0.7 * x**0.5, 5.0),
], ids=lambda make: make(1.0).describe())  # fmt: skip
def test_values_of_process_noise_are_variances(make):
    mean = tensor(1, 2, 10, 0.4, 0.1, 3)[: make(1.0).size]
    torch.testing.assert_close(covariance(make(9.0), mean=mean), 9 * covariance(make(1.0), mean=mean))


@pytest.mark.parametrize("time", [1e-3, 2.0, 1e9])
def test_a_correlated_error_keeps_its_standard_deviation_and_is_forgotten_over_its_time(time):
    motion = GaussMarkov(3.0, time, 2)
    kept = motion.transition(torch.tensor(STEP).double())
    torch.testing.assert_close(kept, torch.eye(2).double() * float(mpmath.exp(-mpf(STEP) / mpf(time))))
    stays = 9 * kept @ kept.mT + covariance(motion)
    torch.testing.assert_close(stays, 9 * torch.eye(2).double())
    with mpmath.workdps(60):
        added = float(9 * (1 - mpmath.exp(-2 * mpf(STEP) / mpf(time))))
    torch.testing.assert_close(covariance(motion), added * torch.eye(2).double(), rtol=1e-12, atol=0)


@pytest.mark.parametrize("motion", [
    GaussMarkov(0.3, 5.0, 3), Odometry(0.1, 0.02, 1e-3), RandomWalk(0.3), Clock(0.3, 0.02),
    IntegratedOrnsteinUhlenbeck(0.3, 0.1), ConstantSpeed(0.3, 0.1, continuous=True),
    UnknownTurn(0.7, 0.02), UnknownTurn(0.7, 0.02, continuous=True), Bicycle(2.7, 0.7, 0.02),
    Bicycle(2.7, 0.7, 0.02, continuous=True),
], ids=lambda motion: motion.describe())  # fmt: skip
def test_a_step_of_no_time_leaves_the_state_and_adds_no_noise_with_finite_gradients(motion):
    motion = learnable(copy.deepcopy(motion), "all")
    dt, mean = tensor(1.0, 0.0, 1.0), tensor(1, 2, 3, 0.4, 0.1, 3)[: motion.size].expand(3, -1)
    torch.testing.assert_close(motion(mean, dt, tensor(3.0, 0.2))[1], mean[1])
    root = motion.process_noise(dt)
    root = root if motion.linear else motion.process_noise_at(root, mean, dt)
    assert (root[1] == 0).all()
    root.square().sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in motion.parameters())


def test_points_that_go_through_motion_and_sensor_alike_have_the_same_noise():
    prior = Gaussian(tensor(0.0, 0.0, 12.0, 5.0, 0.1), tensor(9.0, 7.0, 2.0, 2.0, 0.05).diag())
    missing = torch.full((1, 2), torch.nan).double()
    motion = UnknownTurn(1.0, 0.05, continuous=True)
    alike, apart = (presets.ukf(motion, Position(2.0), redraw=x)(missing, prior) for x in (False, True))
    torch.testing.assert_close(alike.covariance, apart.covariance)
