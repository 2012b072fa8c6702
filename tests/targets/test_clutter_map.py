"""A map of clutter keeps what stays from being taken for a target, and who is out of sight was not missed."""

import math

import pytest
import torch
from joint import plane

from torchfra import presets, tree
from torchfra.association import Clutter
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Bearings
from torchfra.targets import ClutterMap, FieldOfView, MOfN, OnePoint, Targets

BUOY = torch.tensor([40.0, -20.0]).double()


def scans(seed, steps=40):
    """A target that passes a buoy, and two false measurements anywhere."""
    rng = torch.Generator().manual_seed(seed)
    boat = torch.tensor([[-60.0 + 5.0 * k, 10.0] for k in range(steps)]).double()
    z = torch.stack([boat, BUOY.expand(steps, 2)], 1) + 2.0 * torch.randn(steps, 2, 2, generator=rng).double()
    return torch.cat([z, 300.0 * torch.rand(steps, 2, 2, generator=rng).double() - 150.0], 1)


def manager(**options):
    return Targets(plane(), birth=OnePoint(5.0), **options)


def test_a_target_that_moves_is_confirmed_and_a_buoy_is_not():
    mapped = manager(clutter_map=ClutterMap(2.0))(scans(0))
    plain = manager()(scans(0))
    assert len(mapped.identity) == 1
    assert (mapped.mean[0, -1, :2] - torch.tensor([135.0, 10.0])).norm() < 5.0
    assert ((plain.mean[:, -1, :2] - BUOY).norm(dim=-1) < 5.0).any()


def test_a_boat_that_hardly_moves_between_scans_is_confirmed_all_the_same():
    """At 1 m a scan, with kernels of 2 m, its last measurements explain the next: they are its own, and one thing."""
    rng = torch.Generator().manual_seed(0)
    boat = torch.tensor([[1.0 * k, 10.0] for k in range(40)]).double()
    z = torch.stack([boat, BUOY.expand(40, 2)], 1) + 0.7 * torch.randn(40, 2, 2, generator=rng).double()
    mean = manager(clutter_map=ClutterMap(2.0, seconds=30.0))(z).mean
    assert len(mean) == 1
    since = (~mean[0, :, 0].isnan()).nonzero()[0].item()
    assert since < 15
    torch.testing.assert_close(mean[0, since:, :2], boat[since:], atol=5.0, rtol=0)


def test_what_goes_with_the_platform_is_clutter_in_the_frame_of_the_platform():
    rng = torch.Generator().manual_seed(1)
    ferry = torch.tensor([[6.0 * k - 100.0, 30.0] for k in range(30)]).double()
    z = ferry.unsqueeze(1) + torch.tensor([[12.0, -5.0]]).double() + torch.randn(30, 1, 2, generator=rng).double()
    found = {
        frame: manager(clutter_map=ClutterMap(2.0, frame=frame))(z, u=ferry).mean for frame in ("fixed", "platform")
    }
    assert len(found["fixed"]) == 1
    assert len(found["platform"]) == 0


def test_measurements_are_forgotten():
    targets = manager(clutter_map=ClutterMap(2.0, seconds=3.0))
    state = targets.init()
    for z in scans(4, 30):
        state = targets.step(state, z)
    assert len(state.clutter.weight) <= 4 * 14  # of the last 3 log(100) s
    assert state.clutter.scans.item() == pytest.approx(1 / (1 - math.exp(-1 / 3)), rel=1e-4)


@pytest.mark.parametrize(("farthest", "there"), [(30.0, True), (1000.0, False)])
def test_who_is_out_of_sight_is_not_deleted_for_not_being_measured(farthest, there):
    f = plane()
    targets = Targets(f, birth=OnePoint(5.0), confirmation=MOfN(2, 3), views={None: FieldOfView(farthest)})
    state, ferry = targets.init(), torch.tensor([-60.0, 0.0]).double()
    for z in scans(6)[:4, :1]:
        state = targets.step(state, z, u=ferry)
    assert len(state.identity) == 1
    for _ in range(10):
        state = targets.step(state, torch.zeros(0, 2).double(), u=ferry - 100.0)
    assert (len(state.identity) == 1) == there
    if there:
        torch.testing.assert_close(state.belief.mean[0, 0], torch.tensor(5.0).double(), atol=15.0, rtol=0)


def test_bearings_alone_say_more_of_targets_and_begin_none():
    camera = presets.jpda(
        ConstantVelocity(1.0), Bearings(0.005, count=1), clutter=Clutter(extent=[6.3], rate=0.5), detection=0.9
    )  # fmt: skip
    targets = manager(sensors={"camera": camera}, clutter_map=ClutterMap(2.0))
    ferry, state = torch.tensor([0.0, -80.0]).double(), targets.init()
    look = {"dt": 0.0, "sensor": "camera", "u": ferry}
    assert len(targets.step(state, torch.zeros(3, 1).double(), **look).track.identity) == 0
    for z in scans(7)[:8]:
        state = targets.step(state, z[:1])
    off = state.belief.mean[0, :2] - ferry
    seen = targets.step(state, torch.atan2(off[0], off[1]).reshape(1, 1), **look)
    spread, before = (x.belief.covariance[0, :2, :2].diagonal().sum() for x in (seen, state))
    assert spread < 0.7 * before
    assert len(seen.clutter.weight) <= len(state.clutter.weight)


def test_beside_a_map_scores_are_of_sensors_from_which_the_map_learns():
    """A camera sees land again and again too, and no map says so."""
    camera = presets.jpda(ConstantVelocity(1.0), Bearings(0.05, count=1), clutter=Clutter(extent=[6.3], rate=0.5))
    z, ferry = scans(7)[:3, :1], torch.tensor([0.0, -80.0]).double()
    for clutter_map, same in ((ClutterMap(2.0), True), (None, False)):
        targets = manager(sensors={"camera": camera}, clutter_map=clutter_map)
        state = targets.init()
        for scan in z:
            state = targets.step(state, scan)
        off = state.belief.mean[0, :2] - ferry
        seen = targets.step(state, torch.atan2(off[0], off[1]).reshape(1, 1), dt=0.0, sensor="camera", u=ferry)
        assert bool(seen.track.score[0] == state.track.score[0]) == same


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: ClutterMap(0.0), "size: expected a finite number above 0, received 0.0"),
        (lambda: ClutterMap(seconds=float("inf")), "seconds: expected a finite number above 0, received inf"),
        (lambda: ClutterMap(frame="boat"), r"frame: expected one of \('fixed', 'platform'\), received 'boat'"),
        (
            lambda: manager(clutter_map=ClutterMap(frame="platform"))(scans(0)),
            "u: expected the place of the platform, 2 numbers, as its map of clutter needs, received none",
        ),
        (
            lambda: manager(clutter_map=ClutterMap()).step(
                manager(clutter_map=ClutterMap(frame="platform")).init(), scans(0)[0]
            ),
            "state: expected a map of clutter in the frame 'fixed', received 'platform'",
        ),
        (lambda: manager(clutter_map=3.0), "clutter_map: expected a ClutterMap of torchfra.targets, received float"),
        (lambda: FieldOfView(10.0, nearest=20.0), "expected 0 <= nearest < farthest, received 20.0, 10.0"),
        (lambda: FieldOfView(10.0, place=[0.0, float("nan")]), r"place: expected \(dims,\) finite metres"),
        (lambda: manager(views={"radar": FieldOfView(9.0)}), "views: expected some of None, received 'radar'"),
        (lambda: manager(views={None: 9.0}), "views: expected a FieldOfView of None, received float"),
        (lambda: manager(views={None: FieldOfView(9.0, place=[0.0] * 3)}), "expected a place of 2 dimensions of None"),
        (lambda: manager(sensors={"r": 3.0}), r"sensors\['r'\]: expected a JPDA around a filter of one target"),
        (
            lambda: manager(views={None: FieldOfView(9.0)})(scans(0)),
            "u: expected the place of the sensor, 2 numbers, as its field of view needs, received none",
        ),
        (
            lambda: manager(clutter_map=ClutterMap()).step(manager().init(), scans(0)[0]),
            "state: expected one of a manager with a map of clutter, received none",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_is_said(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_without_a_map_a_state_holds_none():
    assert manager().init().clutter is None
    assert len(tree.flatten(manager(clutter_map=ClutterMap()).init())) == len(tree.flatten(manager().init())) + 11
