"""A target that is lost and found again has one identity, and one that only comes near has a new one."""

import math

import pytest
import torch
from joint import plane

from torchfra import presets, tree
from torchfra.association import ChiSquare, Clutter
from torchfra.motion import ConstantVelocity
from torchfra.sensors import RangeBearing
from torchfra.targets import Deletion, MOfN, OnePoint, Stitching, Targets, collect
from torchfra.targets.stitching import Parts
from torchfra.types import Gaussian

GAP = range(10, 18)
"""Scans in which nothing is measured."""


def scans(*starts, steps=30, seed=0, hidden=GAP):
    """Targets ``[x, y, vx, vy]``, 1 s apart, measured to 2 m but for a gap: ``(T, N, 2)``."""
    x, t = torch.tensor(starts).double(), torch.arange(float(steps)).double().reshape(-1, 1, 1)
    z = x[:, :2] + t * x[:, 2:]
    z = z + 2.0 * torch.randn(z.shape, generator=torch.Generator().manual_seed(seed)).double()
    z[list(hidden)] = math.nan
    return z


def manager(stitching=None, misses=3, f=None, **options):
    confirmation = MOfN(3, 4)
    return Targets(
        f or plane(), birth=OnePoint(8.0), confirmation=confirmation, deletion=Deletion(misses), stitching=stitching,
        **options,
    )  # fmt: skip


def run(targets, z, **options):
    state, states = targets.init(), []
    for scan in z:
        state = targets.step(state, scan, **options)
        states.append(state)
    return states


ONE, TWO = (0.0, 0.0, 5.0, 0.0), (0.0, 40.0, 5.0, 0.0)


@pytest.mark.parametrize("misses", [3, 20], ids=["deleted", "still there"])
def test_a_target_that_is_found_again_has_the_identity_that_it_was_lost_with(misses):
    z = scans(ONE, TWO)
    stitched = run(manager(Stitching(12.0, 60.0), misses), z)
    assert sorted(stitched[9].identity.tolist()) == sorted(stitched[-1].identity.tolist()) == [0, 1]
    before, after = (
        dict(zip(s.identity.tolist(), s.confirmed.mean[:, 1], strict=True)) for s in (stitched[9], stitched[-1])
    )
    for identity, y in before.items():
        torch.testing.assert_close(after[identity], y, atol=10.0, rtol=0)
    if misses == 3:
        assert not {*run(manager(), z)[-1].identity.tolist()} & {0, 1}
        assert len(collect(stitched).identity) == 2


def test_a_target_that_is_found_beside_its_own_track_takes_its_place():
    z, f = scans(ONE, steps=34), plane(gate=ChiSquare(0.5))  # narrow, so that it is lost as soon as it has turned
    z[18:, :, 1] += 25.0
    assert len(run(manager(misses=30, f=f), z)[-1].identity) > 1
    states = run(manager(Stitching(20.0, 100.0, probability=0.9999), 30, f), z)
    assert states[9].identity.tolist() == states[-1].identity.tolist() == [0]
    assert states[-1].confirmed.mean[0, 1].item() == pytest.approx(25.0, abs=10.0)


@pytest.mark.parametrize(
    "stitching",
    [Stitching(6.0, 60.0), Stitching(12.0, 1e-3), Stitching(12.0, 60.0, probability=1e-6)],
    ids=["too long ago", "too far", "beyond the gate"],
)
def test_a_target_beyond_a_bound_has_a_new_identity(stitching):
    states = run(manager(stitching), scans(ONE))
    assert states[9].identity.tolist() == [0]
    assert len(states[-1].identity) == 1
    assert states[-1].identity.item() > 0


def test_one_that_was_lost_is_found_once():
    z = torch.cat([scans(ONE), scans((0.0, 6.0, 5.0, 0.0), seed=1)], 1)
    z[:18, 1] = math.nan
    states = run(manager(Stitching(12.0, 100.0)), z)
    assert states[9].identity.tolist() == [0]
    identities = states[-1].identity.tolist()
    assert len(identities) == 2
    assert identities.count(0) == 1


def test_a_target_that_is_measured_still_gives_its_identity_to_nobody():
    z = torch.cat([scans(ONE, hidden=()), scans((0.0, 12.0, 5.0, 0.0), seed=1)], 1)
    z[:18, 1] = math.nan
    states = run(manager(Stitching(100.0, 100.0, probability=1 - 1e-12)), z)
    first = dict(zip(states[-1].identity.tolist(), states[-1].confirmed.mean[:, 1].tolist(), strict=True))
    assert len(first) == 2
    assert first[0] == pytest.approx(0.0, abs=4.0)


def test_as_many_as_possible_are_paired_and_then_the_nearest():
    motion, root = ConstantVelocity(1.0), torch.eye(4).double()

    def parts(*x, seconds):
        mean = torch.tensor([[a, 0.0, 0.0, 0.0] for a in x]).double()
        scene = torch.zeros(len(x), dtype=torch.int64)
        return Parts(Gaussian(mean, root.expand(len(x), 4, 4)), scene, torch.full((len(x),), seconds).double())

    for lost, found, expected in [
        ((0.0, 3.0), (3.5, 6.0), [(0, 0), (1, 1)]),  # the nearest pair alone would leave two
        ((0.0, 3.0), (2.9, 0.2), [(0, 1), (1, 0)]),
        ((0.0, 90.0), (1.0, 2.0, 3.0), [(0, 0)]),
    ]:
        i, j = Stitching(9.0, 4.0)(motion, parts(*lost, seconds=8.0), parts(*found, seconds=2.0))
        assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected


def test_what_was_lost_is_forgotten_and_saved_and_comes_back_with_a_late_scan(tmp_path):
    targets, z = manager(Stitching(12.0, 60.0), lag=3.0), scans(ONE, TWO)
    states = run(targets, z)
    assert len(states[14].ended.identity) == 2
    torch.save(targets.saved(states[14]), tmp_path / "targets.pt")
    state = targets.restored(torch.load(tmp_path / "targets.pt", weights_only=True))
    for k in [*range(15, 19), 20, 19, *range(21, 30)]:  # one scan is late
        state = targets.step(state, z[k], dt={20: 2.0, 19: -1.0}.get(k, 1.0))
    torch.testing.assert_close(state.confirmed, states[-1].confirmed)
    assert state.identity.tolist() == states[-1].identity.tolist()
    for _ in range(30):
        state = targets.step(state, z[10])
    assert len(state.ended.identity) == 0


@pytest.mark.parametrize("inner", [presets.srckf, presets.gpb])
def test_who_was_lost_is_predicted_by_any_filter_and_a_sensor_that_moves(inner):
    f = presets.jpda(
        ConstantVelocity(0.5), RangeBearing(torch.tensor([1.0, 0.01]).double()), detection=0.9, inner=inner,
        clutter=Clutter(extent=[500.0, 6.3], rate=0.5),
    )  # fmt: skip
    place = torch.tensor([-80.0, -60.0]).double()
    truth = torch.stack([5.0 * torch.arange(30.0), torch.zeros(30)], -1).double()
    z = f.sensor(truth, place.expand(30, 2)).unsqueeze(1)
    z[list(GAP)] = math.nan
    states = run(manager(Stitching(12.0, 60.0), f=f), z, u=place)
    assert states[9].identity.tolist() == states[-1].identity.tolist() == [0]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Stitching(0.0, 5.0), "seconds: expected a finite number above 0, received 0.0"),
        (lambda: Stitching(5.0, math.inf), "metres: expected a finite number above 0, received inf"),
        (lambda: Stitching(5.0, 5.0, probability=1.0), "probability: expected a probability above 0 and below 1"),
        (lambda: manager(3.0), "stitching: expected a Stitching of torchfra.targets, received float"),
        (
            lambda: manager(Stitching(5.0, 5.0)).step(manager().init(), scans(ONE)[0]),
            "state: expected one of a manager with stitching, received none",
        ),
        (
            lambda: manager().step(manager(Stitching(5.0, 5.0)).init(), scans(ONE)[0]),
            "state: expected none of a manager with stitching, received one",
        ),
    ],
)
def test_what_cannot_be_is_said(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_without_stitching_a_state_holds_nobody_lost():
    states = run(manager(), scans(ONE))
    assert all(state.ended is None for state in states)
    stitched = run(manager(Stitching(1.0, 1e-3)), scans(ONE))
    for one, other in zip(states, stitched, strict=True):
        assert all(torch.equal(*pair) for pair in zip(tree.flatten(one.track), tree.flatten(other.track), strict=True))
