"""Sensors made of others measure, err and miss as their parts do."""

import copy
import math

import numpy as np
import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.motion import (
    Augmented,
    Bank,
    Bicycle,
    Clock,
    ConstantAcceleration,
    ConstantVelocity,
    Motion,
    RandomWalk,
    Spherical,
)
from torchfra.sensors import (
    Bearings,
    Biased,
    Camera,
    InfraredLaser,
    Position,
    Pseudoranges,
    RangeBearing,
    RangeRates,
    Ranges,
    Sensor,
    Stacked,
    TimeDifferences,
)


def tensor(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


ANCHORS = tensor([0, 0], [60, 0], [60, 80], [0, 80])
RANGES = Ranges(ANCHORS, 0.3)
MOTION = ConstantVelocity(0.1)
PRIOR = Gaussian(tensor(20, 30, 1, 2), tensor(5, 5, 1, 1).diag())
TRUTH = tensor(20, 30, 1, 2) + torch.arange(1, 21).double()[:, None] * tensor(1, 2, 0, 0)


# ---------------------------------------------------------------- range rates


def test_a_range_rate_is_the_derivative_of_the_range_also_from_anchors_that_move():
    x = torch.cat([30 * noise(5, 2), 4 * noise(5, 2, seed=1)], -1)
    moving = torch.cat([ANCHORS.flatten(), noise(8, seed=2)]).expand(5, -1)
    for sensor, u in ((RangeRates(ANCHORS, 0.1), None), (RangeRates(count=4, std=0.1), moving)):
        velocity = 0 * ANCHORS if u is None else moving[0, 8:].unflatten(0, (4, 2))

        def distance(t, x=x, velocity=velocity):
            return ((x[:, None, :2] + t * x[:, None, 2:]) - (ANCHORS + t * velocity)).norm(dim=-1)

        expected = torch.func.jvp(distance, (torch.tensor(0.0).double(),), (torch.tensor(1.0).double(),))[1]
        torch.testing.assert_close(sensor(x, u), expected)
    above = RangeRates(torch.cat([ANCHORS, ANCHORS[:, :1] + 3], -1), 0.1, height=1.0)
    ranges = Ranges(above.anchors, 0.1, height=1.0)
    expected = torch.func.jvp(ranges, (x,), (torch.cat([x[:, 2:], 0 * x[:, 2:]], -1),))[1]
    torch.testing.assert_close(above(x), expected)


def test_on_an_anchor_a_range_rate_is_zero_with_a_finite_gradient():
    x = tensor(0, 0, 3, 4).requires_grad_()
    rate = RangeRates(tensor([0, 0], [3, 0]), 0.1)(x)
    assert rate.tolist() == [0, -3]
    rate.sum().backward()
    assert x.grad.isfinite().all()


# ---------------------------------------------------------------- several as one


def test_a_stack_measures_what_its_parts_measure():
    parts = Bearings(0.01, stations=ANCHORS[:2]), Ranges(ANCHORS, 0.3), Position(tensor(1.0, 2.0))
    both, x = Stacked(*parts), 30 * noise(7, 4)
    torch.testing.assert_close(both(x), torch.cat([part(x) for part in parts], -1))
    assert (both.size, both.reads, both.dims) == (8, 2, 2)
    assert both.angles.tolist() == [True, True] + [False] * 6
    assert both.blocks == ((0, 1), (2,), (3,), (4,), (5,), (6, 7))
    assert both.locates
    torch.testing.assert_close(both.locate(both(x)), x[:, :2])
    a, b = both(x), both(-x)
    torch.testing.assert_close(both.difference(a, b)[:, :2], parts[0].difference(a[:, :2], b[:, :2]))
    assert Stacked(Position(1.0), Position(2.0)).linear
    assert not both.linear
    assert both.describe().startswith("bearings and ranges from 4 anchors and ")


def correlated():
    return torch.tensor([[0.5, 0.0], [0.4, 0.6]], dtype=torch.float64)


@pytest.mark.parametrize("given", [None, "std", "noise"])
def test_its_noise_is_that_of_its_parts_side_by_side_also_where_elements_are_missing(given):
    parts = Ranges(ANCHORS, tensor(0.1, 0.2, 0.3, 0.4)), Position(noise=correlated())
    both = Stacked(*parts)
    root = torch.block_diag(parts[0].std().diag(), correlated())
    z = both(TRUTH)
    z[3, 1] = z[5, 4] = z[6, :] = z[8, 4:] = math.nan
    plain = Biased(both, [None] * 6)
    dense = copy.copy(both)
    std = torch.full((6,), 0.2).double().expand(20, 6)
    options = {None: {}, "std": {"std": std}, "noise": {"root": (2 * root).expand(20, 6, 6)}}[given]
    own = both.measurement_noise(z, **options)
    whole = Position.measurement_noise(dense, z, **options or {"root": root.expand(20, 6, 6)})
    same = {"rtol": 1e-12, "atol": 1e-12}
    torch.testing.assert_close(own.log_norm, whole.log_norm, **same)
    x = noise(20, 6, 3)
    torch.testing.assert_close(own.whiten(x), whole.whiten(x), **same)
    torch.testing.assert_close(own.whiten(own.colour(own.whiten(x))), own.whiten(x), **same)
    torch.testing.assert_close(plain.measurement_noise(z, **options).whiten(x), own.whiten(x), **same)
    torch.testing.assert_close(both.root @ both.root.mT, root @ root.mT)


def test_a_root_of_its_noise_is_that_of_its_parts_also_of_biased_ones():
    correlated = Position(noise=tensor([1.0, 0.0], [0.5, 2.0]))
    root = Stacked(Biased(Position((3.0, 4.0)), 4), correlated).root
    expected = np.diag([9.0, 16.0, 1.0, 4.25])
    expected[2, 3] = expected[3, 2] = 0.5
    np.testing.assert_allclose(root @ root.mT, expected, rtol=1e-14)


def test_one_part_may_have_a_batch_of_values_and_the_others_one():
    stds = tensor([1, 1], [2, 2], [5, 1])
    every, *alone = [Stacked(Position(std), RANGES) for std in (stds, *stds)]
    z = every(TRUTH) + noise(20, 6)
    means = presets.ekf(MOTION, every)(z, PRIOR).mean
    torch.testing.assert_close(means, torch.stack([presets.ekf(MOTION, each)(z, PRIOR).mean for each in alone]))


def test_one_stacked_measurement_is_as_good_as_one_after_the_other():
    sensors = Position(2.0), Ranges(ANCHORS, 0.5)
    z = Stacked(*sensors)(TRUTH) + noise(20, 6)
    together = presets.ekf(MOTION, Stacked(*sensors))(z, PRIOR)
    parts = [presets.ekf(MOTION, sensor) for sensor in sensors]
    still = presets.ekf(RandomWalkOfStates(), sensors[1])
    belief = PRIOR
    for k in range(20):
        first = parts[0](z[k : k + 1, :2], belief)
        second = still(z[k : k + 1, 2:], Gaussian(first.mean[0], first.scale_tril[0]))
        belief = Gaussian(second.mean[0], second.scale_tril[0])
    torch.testing.assert_close(belief.mean, together.mean[-1], rtol=1e-4, atol=1e-2)  # linearised at other points


class RandomWalkOfStates(RandomWalk):
    """A state that stays as it is."""

    def __init__(self):
        super().__init__(0.0, 4)
        self.dims = 2


def test_parts_share_the_inputs_or_split_them():
    x, stations, pose = 30 * noise(5, 3), noise(5, 4), noise(5, 12)
    split = Stacked(Bearings(0.1, count=2), Camera(800.0, 1.0), Position(1.0, dims=3), inputs=(4, 12, 0))
    expected = torch.cat([Bearings(0.1, count=2)(x, stations), Camera(800.0, 1.0)(x, pose), x], -1)
    torch.testing.assert_close(split(x, torch.cat([stations, pose], -1)), expected)
    shared = Stacked(Ranges(count=2, std=0.1), Bearings(0.1, count=2))
    expected = torch.cat([Ranges(count=2, std=0.1)(x, stations), Bearings(0.1, count=2)(x, stations)], -1)
    torch.testing.assert_close(shared(x, stations), expected)
    with pytest.raises(ValueError, match=r"u: expected \(\.\.\., 16\), \(4, 12, 0\) of each sensor, received None"):
        split(x)


def test_a_stack_of_satellites_or_correlated_parts_runs_in_robust_filters_and_learns():
    both = Stacked(RangeBearing(tensor(1.0, 0.02)), RangeRates(tensor([0, 0]), 0.2), Position(noise=correlated()))
    z = both(TRUTH) + torch.cat([noise(20, 1), 0.02 * noise(20, 1), 0.2 * noise(20, 1), 0.5 * noise(20, 2)], -1)
    z[5, 0] = z[7, 3] = math.nan
    z[9, 0] += 50
    for preset in (presets.gpb, presets.rsrckf, presets.fra, presets.iaukf):
        f = preset(MOTION, both)
        assert (f(z, PRIOR).mean - TRUTH)[5:, :2].norm(dim=-1).max() < 2.0
    f = presets.srckf(MOTION, both, learn=("std",))
    assert [name for name, _ in f.named_parameters()] == ["sensor.parts.0.std.raw", "sensor.parts.1.std.raw"]
    f(z, PRIOR).log_likelihood.sum().backward()
    assert all(p.grad.abs().sum() > 0 for p in f.parameters())


# ---------------------------------------------------------------- biases and clocks


def test_a_bias_in_the_state_is_added_to_what_is_measured_and_found():
    motion = Augmented(MOTION, RandomWalk(1e-4, 1, kind="bias"))
    biased = Biased(Ranges(ANCHORS, 0.3), 4)
    x = torch.cat([TRUTH, torch.full((20, 1), 3.0).double()], -1)
    torch.testing.assert_close(biased(x), Ranges(ANCHORS, 0.3)(TRUTH) + 3)
    assert (biased.reads, biased.blocks, biased.dims) == (5, ((0,), (1,), (2,), (3,)), 2)
    each = Biased(Ranges(ANCHORS, 0.3), (4, None, 4, None))
    torch.testing.assert_close(each(x), Ranges(ANCHORS, 0.3)(TRUTH) + tensor(3, 0, 3, 0))
    z = biased(x) + 0.3 * noise(6, 20, 4)
    wide = Gaussian(torch.cat([PRIOR.mean, tensor(0)]), tensor(5, 5, 1, 1, 5).diag())
    with torch.no_grad():
        f = presets.srckf(motion, biased)
        found = f(z, wide).mean
        fast = copy.deepcopy(f).compile()(z, wide).mean
        blind = presets.srckf(MOTION, biased.unbiased)(z, PRIOR).mean
    torch.testing.assert_close(fast, found, rtol=0, atol=1e-10)
    assert (found[:, -1, 4] - 3).abs().max() < 0.6
    assert (found - x)[:, 5:, :2].norm(dim=-1).mean() < 0.7 * (blind - TRUTH)[:, 5:, :2].norm(dim=-1).mean()


def test_a_receiver_finds_where_it_is_and_how_its_clock_drifts():
    angle, tilt = torch.linspace(0, 5.2, 6).double(), tensor(0.3, 0.6, 0.9, 1.2, 0.5, 1.0)
    places = 2.2e7 * torch.stack([angle.cos() * tilt.cos(), angle.sin() * tilt.cos(), tilt.sin()], -1)
    velocity = 3000 * torch.stack([-angle.sin(), angle.cos(), 0 * angle], -1)
    time = torch.arange(1, 31).double()[:, None]
    u = torch.cat([(places + time[..., None] * velocity).flatten(1), velocity.flatten().expand(30, -1)], -1)
    truth = torch.cat([tensor(100, -50, 20) + time * tensor(5, 2, 0.5), tensor(5, 2, 0.5).expand(30, 3),
                       3000 + 40 * time, torch.full((30, 1), 40.0).double()], -1)  # fmt: skip
    sensor = Pseudoranges(6, 3.0, 0.1)
    exact = (truth[:, None, :3] - u[:, :18].unflatten(-1, (6, 3))).norm(dim=-1) + truth[:, 6:7]
    z = sensor(truth, u)
    torch.testing.assert_close(z[:, :6], exact, rtol=0, atol=1e-6)
    torch.testing.assert_close(Pseudoranges(6, 3.0)(truth, u), z[:, :6])
    torch.testing.assert_close(z[1:, 6:], exact[1:] - exact[:-1], rtol=0, atol=1.0)
    z = z + torch.cat([3 * noise(4, 30, 6), 0.1 * noise(4, 30, 6, seed=1)], -1)
    z[0, 10:, 5] = z[0, 10:, 11] = math.nan  # one satellite sets
    motion = Augmented(ConstantVelocity(0.01, 3), Clock(0.1, 0.01))
    assert motion.components[6:] == ("clock", "drift")
    prior = Gaussian(torch.zeros(8).double(), tensor(500, 500, 500, 10, 10, 10, 1e4, 100).diag())
    with torch.no_grad():
        mean = presets.srckf(motion, sensor)(z, prior, u=u).mean
    assert (mean - truth)[:, -1, :3].norm(dim=-1).max() < 10
    assert (mean - truth)[:, -1, 6:].abs().max() < 10
    assert (mean - truth)[:, -1, 7].abs().max() < 0.5


# ---------------------------------------------------------------- differences


def test_time_differences_are_those_of_distances_and_their_noise_shares_the_first_arrival():
    sensor = TimeDifferences(ANCHORS, 0.3)
    away = Ranges(ANCHORS, 0.3)(TRUTH)
    torch.testing.assert_close(sensor(TRUTH), away[:, 1:] - away[:, :1])
    expected = 0.09 * (torch.eye(3) + torch.ones(3, 3)).double()
    torch.testing.assert_close(sensor.root @ sensor.root.mT, expected)
    each = TimeDifferences(ANCHORS, tensor(0.1, 0.2, 0.3, 0.4))
    expected = tensor(0.04, 0.09, 0.16).diag() + 0.01
    torch.testing.assert_close(each.root @ each.root.mT, expected)
    unit = each.measurement_noise(torch.zeros(1, 3).double())
    torch.testing.assert_close(unit.root[0] @ unit.root[0].mT, expected)


def test_differences_say_what_ranges_with_an_unknown_clock_say():
    """An offset of which nothing is known, anew at each step, leaves of ranges their differences."""
    arrivals = Ranges(ANCHORS, 0.3)(TRUTH) + 0.3 * noise(20, 4)
    motion = Augmented(MOTION, RandomWalk(1e10, 1, kind="clock"))
    wide = Gaussian(torch.cat([PRIOR.mean, tensor(0)]), tensor(5, 5, 1, 1, 1e5).diag())
    with torch.no_grad():
        offset = presets.ekf(motion, Biased(Ranges(ANCHORS, 0.3), 4))(arrivals, wide)
        differences = presets.ekf(MOTION, TimeDifferences(ANCHORS, 0.3))(arrivals[:, 1:] - arrivals[:, :1], PRIOR)
    torch.testing.assert_close(offset.mean[:, :4], differences.mean, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(offset.covariance[:, :4, :4], differences.covariance, rtol=1e-4, atol=1e-6)


# ---------------------------------------------------------------- what is handed in


@pytest.mark.parametrize("form", [list, np.asarray, torch.tensor], ids=["list", "array", "tensor"])
def test_values_for_each_element_may_be_a_list_an_array_or_a_tensor(form):
    each = form([0.5, 0.25])
    stations = form([[0.0, 0.0], [60.0, 0.0]])
    for sensor in (Position(each), RangeBearing(each), Ranges(stations, each), Bearings(each, stations=stations)):
        torch.testing.assert_close(sensor.std().double(), tensor(0.5, 0.25))
        assert presets.srckf(MOTION, sensor)(torch.ones(3, 2).double(), PRIOR).mean.shape == (3, 4)
    torch.testing.assert_close(Pseudoranges(2, each, each).unbiased.parts[1].std().double(), tensor(0.5, 0.25))
    torch.testing.assert_close(TimeDifferences(stations, each).root.double(), tensor([-0.5, 0.25]))
    assert Camera(form([500.0, 400.0]), 1.0).focal.batch_rank == 0
    root = Position(noise=form([[1.0, 0.0], [0.5, 2.0]])).root
    torch.testing.assert_close(root.double().abs(), tensor([1, 0], [0.5, 2]))


def test_a_radar_stands_where_it_is_told_whatever_the_inputs_are_of():
    radar, moving = RangeBearing([1.0, 0.01], position=[20.0, 0.0]), RangeBearing([1.0, 0.01])
    expected = moving(TRUTH, tensor(20, 0).expand(20, -1))
    for u in (None, torch.full((20, 12), math.nan).double()):
        torch.testing.assert_close(radar(TRUTH, u), expected)
    torch.testing.assert_close(expected[:, 0], (TRUTH[:, :2] - tensor(20, 0)).norm(dim=-1))
    torch.testing.assert_close(radar.locate(expected), TRUTH[:, :2])
    assert not radar.state_dict().keys() & {"position"}


# ---------------------------------------------------------------- what components are

SPACE = ConstantVelocity(1.0, 3)
SPHERICAL = Spherical(SPACE)
SATELLITES = Pseudoranges(2, 1.0, 0.1)


class Own(Motion):
    """States [x, y, speed, bias], of which it says nothing."""

    def __init__(self, **options):
        super().__init__(2, 2, 1.0, **options)

    def forward(self, x, dt, u=None):
        return x + 0 * dt.unsqueeze(-1)


class OwnRanges(Ranges):
    def forward(self, x, u=None):
        return x[..., 2:3] + 0 * super().forward(x, u)


@pytest.mark.parametrize(
    ("motion", "sensor", "said"),
    [
        (
            SPACE,
            RangeRates([[0, 0]], 0.1),
            "range rates from 1 anchor: expected a motion whose component 2 is velocity",
        ),
        (Bicycle(2.7, 1.0, 0.1), RangeRates([[0, 0]], 0.1), "component 3 is velocity, received 'heading', angle, in"),
        (SPHERICAL, Position(1.0), "position: expected a motion whose component 0 is position, received 'omega', rate"),
        (SPHERICAL, RANGES, "component 0 is position"),
        (SPHERICAL, Stacked(TimeDifferences(ANCHORS, 0.1), Camera(1.0, 1.0)), "component 0 is position"),
        (Bank([SPACE, SPACE]), InfraredLaser(1.0), "component 3 is angle, received 'vx', velocity"),
        (Augmented(ConstantAcceleration(1.0, 3), Clock(1.0, 1.0)), SATELLITES, "component 6 is clock, received 'ax'"),
        (MOTION, Biased(RANGES, 1), "component 1 is bias or clock or angle or rate, received 'y', position"),
        (Own(kinds=("position", "position", "velocity", "bias")), RangeRates([[0, 0]], 0.1), "3 is velocity"),
    ],
)
def test_a_sensor_that_would_read_something_else_is_refused(motion, sensor, said):
    with pytest.raises(ValueError, match=said):
        presets.gpb(motion, sensor)


@pytest.mark.parametrize(
    ("motion", "sensor"),
    [
        (SPHERICAL, InfraredLaser(1.0)),
        (Augmented(SPACE, Clock(1.0, 1.0)), SATELLITES),
        (Augmented(MOTION, RandomWalk(1.0, 1, kind="angle")), Biased(Bearings(0.1), np.int64(4))),
        (MOTION, RangeRates([[0, 0]], 0.1)),
        (Own(), Biased(RANGES, 3)),
        (Own(), RangeRates([[0, 0]], 0.1)),
        (Augmented(Own(), Clock(1.0, 1.0)), Biased(RANGES, 3)),
        (Bank([Own(), MOTION]), Biased(RANGES, 3)),
        (Own(kinds=("position", "position", "velocity", "other")), Biased(RANGES, 3)),
        (SPHERICAL, OwnRanges(ANCHORS, 1.0)),
    ],
)
def test_a_sensor_goes_with_a_motion_that_states_nothing_else(motion, sensor):
    presets.srckf(motion, sensor)


@pytest.mark.parametrize("angles", [[0, 1], [1]])
def test_angles_of_a_sensor_are_flags_and_not_numbers_of_elements(angles):
    with pytest.raises(ValueError, match=r"angles: expected True or False for each element of a measurement, received"):
        Sensor(2, angles, std=1.0)
    assert Sensor(2, np.array([False, True]), std=1.0).angles.tolist() == [False, True]


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Stacked(), "sensors: expected one or more, received none"),
        (lambda: Stacked(MOTION), "sensors: expected one or more, received ConstantVelocity"),
        (lambda: Stacked(Position(1.0), inputs=(1, 2)), r"inputs: expected entries of u for each of 1 sensors"),
        (lambda: Biased(Position(1.0), -1), "bias: expected a component of the state, or one for each of 2 elements"),
        (lambda: Biased(Position(1.0), (4,)), r"bias: expected a component .* received \(4,\)"),
        (lambda: Pseudoranges(0, 1.0), "count: expected 1 or more anchors, received 0"),
        (lambda: TimeDifferences(ANCHORS[:1], 1.0), "anchors: expected 2 or more for a difference, received 1"),
        (lambda: TimeDifferences(ANCHORS, torch.ones(3)), r"std: expected a number or \(\.\.\., 4\)"),
        (lambda: Stacked([Position(1.0), RANGES]), r"sensors: expected them one by one, Stacked\(\*sensors\)"),
        (lambda: Biased(3, 4), "sensor: expected a sensor, received int"),
        (lambda: Biased(Position(1.0), 4.0), "bias: expected a component .* received 4.0"),
        (lambda: Biased(Position(1.0), True), "bias: expected a component .* received True"),
        (lambda: RangeRates(ANCHORS, -1.0), "std: expected a value above 0"),
        (lambda: RangeBearing([5.0, 0.01, 1.0]), r"std: expected a number or \(\.\.\., 2\), received \(3,\)"),
        (lambda: Position("a"), "std: expected numbers, received 'a'"),
        (lambda: Position(noise=[1.0, 1.0]), r"noise: expected \(\.\.\., 2, r\), received \(2,\)"),
        (lambda: RangeBearing(1.0, position=[1.0]), r"position: expected finite numbers \(2,\), received \(1,\)"),
        (lambda: RangeBearing(1.0)(torch.ones(4), torch.ones(1)), r"u: expected where the sensor stands, .*2\)"),
        (lambda: Bearings(1.0, stations=[0.0, 0.0]), r"stations: expected \(m, 2\), received \(2,\)"),
        (
            lambda: presets.srckf(MOTION, Biased(Position(1.0), 4)),
            r"at most 4 states \[x, y, vx, vy\], received one that reads 5",
        ),
        (lambda: RangeRates(count=2, std=1.0)(torch.ones(4)), r"u: expected the positions and velocities of 2 anchors"),
    ],
)
def test_what_does_not_fit_is_named(make, said):
    with pytest.raises(ValueError, match=said):
        make()
