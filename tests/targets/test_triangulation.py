"""Births where the lines of sight of two sensors of bearings cross."""

import math

import numpy as np
import pytest
import torch
from oracles.triangulation import crossing

from torchfra import presets, tree
from torchfra.association import ChiSquare, Clutter
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Bearings, Position
from torchfra.targets import Deletion, Existence, FieldOfView, OnePoint, Targets, Triangulation

STD, RATE, SPEED = 0.005, 0.5, 15.0
PLACES = {"left": (0.0, 0.0), "right": (800.0, 0.0), "third": (400.0, -300.0)}
MOTION = ConstantVelocity(0.5, continuous=True)


def camera(sensor=None):
    clutter = Clutter(extent=[math.pi], rate=RATE)
    return presets.jpda(
        MOTION, sensor or Bearings(STD, count=1), clutter=clutter, detection=0.9, gate=ChiSquare(0.9999)
    )


def manager(names=("left", "right"), *, triangulation=True, seconds=0.5, angle=0.2, **options):
    radar = presets.jpda(MOTION, Position(5.0), clutter=Clutter(1e6, rate=1.0), detection=0.9)
    rule = Triangulation(SPEED, seconds=seconds, angle=angle) if triangulation else None
    return Targets(
        radar, birth=OnePoint(SPEED), confirmation=Existence(), deletion=Deletion(5, spread=40.0),
        sensors={name: camera() for name in names}, triangulation=rule, **options,
    )  # fmt: skip


def bearing(position, place):
    east, north = (torch.as_tensor(position) - torch.tensor(place)).double().unbind(-1)
    return torch.atan2(east, north).reshape(-1, 1)


def scans_of(start, velocity, steps, *, names=("left", "right"), seed=0, detection=0.9):
    """Scans of each station each second: time, name, bearings."""
    g = torch.Generator().manual_seed(seed)
    start, velocity = (torch.tensor(x, dtype=torch.float64).reshape(-1, 2) for x in (start, velocity))
    for t in range(steps):
        for name in names:
            z = bearing(start + t * velocity, PLACES[name])
            z = z + STD * torch.randn(z.shape, generator=g, dtype=torch.float64)
            z = z[torch.rand(len(z), generator=g) < detection]
            count = int(torch.poisson(torch.tensor(RATE), generator=g))
            yield t, name, torch.cat([z, math.pi * (torch.rand(count, 1, generator=g, dtype=torch.float64) - 0.5)])


def run(targets, scans, state=None, last=0):
    state = targets.init() if state is None else state
    with torch.no_grad():
        for t, name, z in scans:
            state = targets.step(state, z, dt=t - last, u=torch.tensor(PLACES[name]), sensor=name)
            last = max(t, last)
    return state


def pair(targets, position=(300.0, 500.0), *, dt=0.0, places=(PLACES["left"], PLACES["right"])):
    """The state after one bearing from each of two places."""
    state = targets.step(targets.init(), bearing(position, places[0]), u=torch.tensor(places[0]), sensor="left")
    return targets.step(state, bearing(position, places[1]), dt=dt, u=torch.tensor(places[1]), sensor="right")


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_target_begins_at_the_crossing_with_its_covariance(dtype):
    targets, z, std = manager(), [0.4, -0.7], [0.005, 0.01]
    state = targets.init(dtype=dtype)
    for name, one, own in zip(("left", "right"), z, std, strict=True):
        u = torch.tensor(PLACES[name]).to(dtype)
        state = targets.step(
            state, torch.tensor([[one]], dtype=dtype), dt=0.0, u=u, sensor=name, std=torch.tensor([[own]], dtype=dtype)
        )
    position, covariance, _ = crossing(np.array([PLACES["left"], PLACES["right"]]), z, std)
    rtol = 1e-9 if dtype is torch.float64 else 1e-4
    belief = state.belief
    torch.testing.assert_close(belief.mean[0].double(), torch.tensor([*position, 0.0, 0.0]), rtol=rtol, atol=0.0)
    found = (belief.scale_tril @ belief.scale_tril.mT)[0].double()
    torch.testing.assert_close(found[:2, :2], torch.tensor(covariance), rtol=10 * rtol, atol=10 * rtol)
    assert found[2:, 2:].diagonal().sqrt().tolist() == pytest.approx([SPEED, SPEED], rel=rtol)


def test_the_target_may_have_moved_since_the_older_line():
    targets, places = manager(), np.array([PLACES["left"], PLACES["right"]])
    state = pair(targets, dt=0.4)
    z = [float(bearing((300.0, 500.0), PLACES[name])) for name in ("left", "right")]
    _, _, ranges = crossing(places, z, [STD, STD])
    _, covariance, _ = crossing(places, z, [math.hypot(STD, SPEED * 0.4 / ranges[0]), STD])
    found = (state.belief.scale_tril @ state.belief.scale_tril.mT)[0, :2, :2]
    torch.testing.assert_close(found, torch.tensor(covariance), rtol=1e-9, atol=1e-9)


def test_a_target_that_no_other_sensor_sees_is_found_among_false_bearings():
    scans = list(scans_of((300.0, 500.0), (5.0, 3.0), 12))
    state = run(manager(), scans)
    assert len(state.identity) == 1
    assert (state.confirmed.mean[0, :2] - torch.tensor([355.0, 533.0])).norm() < 15.0
    assert not len(run(manager(triangulation=False), scans).track.identity)


def test_ghosts_of_false_bearings_end():
    targets, state, begun = manager(), None, 0
    for seed in range(3):
        state = run(targets, scans_of((300.0, 500.0), (0.0, 0.0), 10, seed=seed, detection=0.0))
        begun += int(state.next_identity)
        assert not state.track.confirmed.any()
    assert begun > 3  # there were some


def test_a_third_station_tells_two_new_targets_from_their_ghosts():
    names = ("left", "right", "third")
    state = run(manager(names), scans_of([(250.0, 450.0), (550.0, 650.0)], [(4.0, 2.0), (-5.0, 1.0)], 12, names=names))
    apart = torch.cdist(state.confirmed.mean[:, :2], torch.tensor([[294.0, 472.0], [495.0, 661.0]]).double())
    assert apart.shape == (2, 2)
    assert apart.amin(0).max() < 15.0


@pytest.mark.parametrize(("options", "pairs"), [
    ({}, {"places": ((0.0, 0.0), (0.0, 0.0))}),  # one platform
    ({}, {"position": (2000.0, 3.0)}),  # in line with both
    ({"angle": 1.2}, {"position": (400.0, 700.0)}),
    ({"seconds": 0.5}, {"dt": 0.6}),
    ({"views": {"right": FieldOfView(600.0)}}, {}),
])  # fmt: skip
def test_nothing_begins_where_lines_do_not_cross_well(options, pairs):
    assert len(pair(manager()).track.identity) == 1
    assert not len(pair(manager(**options), **pairs).track.identity)


def test_nothing_begins_behind_a_sensor():
    targets, u = manager(), torch.tensor
    state = targets.step(targets.init(), u([[-0.4]]).double(), u=u(PLACES["left"]), sensor="left")
    state = targets.step(state, u([[0.7]]).double(), dt=0.0, u=u(PLACES["right"]), sensor="right")
    assert not len(state.track.identity)


def test_scans_of_one_sensor_that_moves_begin_nothing_between_them():
    targets = manager()
    state = targets.init()
    for place in (PLACES["left"], PLACES["right"]):
        state = targets.step(state, bearing((300.0, 500.0), place), dt=0.2, u=torch.tensor(place), sensor="left")
    assert not len(state.track.identity)


def test_bearings_of_a_target_that_is_there_begin_no_other():
    targets = manager()
    state = targets.step(targets.init(), torch.tensor([[300.0, 500.0]]).double())
    for name in ("left", "right"):
        z = bearing((300.0, 500.0), PLACES[name])
        state = targets.step(state, z, dt=0.0, u=torch.tensor(PLACES[name]), sensor=name)
    assert int(state.next_identity) == 1


def test_a_line_begins_targets_in_one_scan_only():
    targets = manager(("left", "right", "third"))
    state = pair(targets)
    state = targets.step(state, bearing((300.0, 900.0), PLACES["third"]), dt=0.0, u=torch.tensor(PLACES["third"]),
                         sensor="third")  # fmt: skip
    assert int(state.next_identity) == 1


def test_bearings_alone_track_without_another_sensor():
    left, right = (camera(Bearings(STD, stations=[PLACES[name]])) for name in ("left", "right"))
    targets = Targets(
        left,
        birth=OnePoint(SPEED),
        confirmation=Existence(),
        sensors={"right": right},
        triangulation=Triangulation(SPEED),
    )
    state, last = targets.init(), 0
    for t, name, z in scans_of((300.0, 500.0), (5.0, 3.0), 8):
        state, last = targets.step(state, z, dt=t - last, sensor=None if name == "left" else name), t
    assert len(state.identity) == 1


def test_a_late_bearing_begins_the_target_that_it_would_have_begun():
    scans, targets = list(scans_of((300.0, 500.0), (5.0, 3.0), 4)), manager(seconds=1.5, lag=2.0)
    state, late = run(targets, scans), run(targets, [scans[0], *scans[2:5], scans[1], *scans[5:]])
    assert len(state.belief.mean)
    for one, other in zip(state.belief, late.belief, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_saved_lines_of_sight_go_on_to_the_same_bits():
    scans, targets = list(scans_of((300.0, 500.0), (5.0, 3.0), 4)), manager()
    state = run(targets, scans[:1])
    again = targets.restored(targets.saved(state))
    assert all(
        torch.equal(x, y)
        for x, y in zip(
            tree.flatten(run(targets, scans[1:], state)), tree.flatten(run(targets, scans[1:], again)), strict=True
        )
    )


@pytest.mark.parametrize(("make", "message"), [
    (lambda: manager(("left",)), "triangulation: expected two sensors or more of one bearing each, .* received 1"),
    (lambda: Triangulation(0.0), "speed: expected a finite number above 0, received 0"),
    (lambda: Triangulation(seconds=math.inf), "seconds: expected a finite number above 0"),
    (lambda: Triangulation(angle=1.6), "angle: expected less than a right angle"),
    (lambda: Targets(camera(), birth=OnePoint()), "filter: expected a sensor that measures where a target is"),
    (lambda: manager().step(manager().init(), torch.zeros(1, 1).double(), sensor="left"),
     "u: expected the position of the station"),
    (lambda: manager().step(manager(triangulation=False).init(), torch.zeros(1, 2).double()),
     "state: expected one of a manager with triangulation, received none"),
])  # fmt: skip
def test_what_does_not_fit_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
