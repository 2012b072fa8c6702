"""Two boats side by side are two, both ends of a hull are one, and boats that meet stay what they are."""

import math

import numpy as np
import pytest
import torch
from joint import plane

from torchfra import presets
from torchfra.association import Clutter
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.targets import Deletion, Extent, OnePoint, Stitching, Targets, Visibility
from torchfra.targets.state import Beside
from torchfra.types import Gaussian

STD, P = 2.0, 0.9


def manager(**options):
    sensor, clutter = Position(STD), Clutter(600.0**2, rate=1.0)
    f = presets.jpda(ConstantVelocity(0.3, continuous=True), sensor, clutter=clutter, detection=P)
    return Targets(f, birth=OnePoint(5.0), deletion=Deletion(4), extent=Extent(), **options)


def run(targets, scans):
    """The states after each scan of a stream."""
    state, states = targets.init(), []
    for z in scans:
        state = targets.step(state, torch.from_numpy(z), dt=1.5)
        states.append(state)
    return states


def scans(paths, seed, steps=40, shown=lambda rng, k: rng.random(2) < P):
    """Scans of two points, each seen where ``shown`` says so."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(steps):
        seen = shown(rng, k)
        z = [x + 0.5 * STD * rng.standard_normal(2) for x, sees in zip(paths(k), seen, strict=True) if sees]
        found.append(rng.permutation(np.array(z).reshape(-1, 2)))
    return found


def beside(apart):
    return lambda k: np.array([[4.0 * k, 0.0], [4.0 * k, apart]])


def hull(turning=0.0):
    """Bow and stern of a ship of 24 m."""

    def ends(k):
        course = turning * max(0, k - 15)
        ahead = np.array([math.cos(course), math.sin(course)])
        middle = np.array([4.0 * min(k, 15), 0.0])
        for i in range(16, k + 1):
            middle = middle + 4.0 * np.array([math.cos(turning * (i - 15)), math.sin(turning * (i - 15))])
        return np.stack([middle + 12 * ahead, middle - 12 * ahead])

    return ends


def in_turn(rng, k):
    """Bow and stern, mostly one of them; each for some scans on end."""
    bow = (k // 4) % 2 == 0
    return [rng.random() < (0.9 if sees else 0.1) for sees in (bow, not bow)]


@pytest.mark.parametrize("apart", [10.0, 15.0, 35.0])
def test_two_boats_side_by_side_are_two_from_soon_on(apart):
    for seed in range(2):
        states = run(manager(), scans(beside(apart), seed))
        assert all(len(state.identity) == 2 for state in states[20:])
        assert len({i for state in states for i in state.identity.tolist()}) == 2


@pytest.mark.parametrize("turning", [0.0, 0.06])
def test_a_hull_that_shows_its_ends_in_turn_is_one_target(turning):
    for seed in range(2):
        states = run(manager(), scans(hull(turning), seed, shown=in_turn))
        assert all(len(state.identity) == 1 for state in states[8:])
        assert {i for state in states for i in state.identity.tolist()} == set(states[8].identity.tolist())


def test_a_part_takes_over_where_its_host_is_seen_no_more():
    """After 15 scans of the stern alone the ship shows its bow alone: the track goes there and keeps its name."""
    states = run(manager(), scans(hull(), 0, shown=lambda rng, k: (k >= 15, k < 15)))
    (identity,) = states[14].identity.tolist()
    assert all(state.identity.tolist() == [identity] for state in states[14:])
    before, after = (states[k].confirmed.mean[0, 0].item() for k in (14, 30))
    assert (before, after) == pytest.approx((4.0 * 14 - 12, 4.0 * 30 + 12), abs=3.0)


def test_boats_that_meet_stay_two_in_line_at_one_speed():
    """One comes from behind and stays 15 m astern, as the stern of a hull would."""
    states = run(manager(), scans(lambda k: np.array([[3 * k, 0.0], [3 * k - 15 - 3 * max(0, 20 - k), 0.0]]), 1, 60))
    assert len(states[14].identity) == 2
    assert all(state.identity.tolist() == states[14].identity.tolist() for state in states[14:])


def test_boats_that_are_hidden_stay_two():
    """A shadow of 18 s says nothing about one hull or two boats, if targets may be hidden."""
    for seed in range(3):
        targets = manager(visibility={None: Visibility(60.0, 20.0)})
        states = run(targets, scans(beside(15.0), seed, 36, lambda rng, k: [not 20 <= k < 32] * 2))
        assert all(len(state.identity) == 2 for state in states[20:])
        assert all(state.track.beside.odds.max() > 0 for state in states[20:])


@pytest.mark.parametrize(("odds", "missed", "kept"), [(-3.0, 0, True), (-2.0, 0, False), (-3.0, 1, False)])
def test_a_hull_is_not_ended_while_its_part_is_measured(odds, missed, kept):
    """Of two targets the second is a part of the first; a rule ends the first, which has one miss."""
    track = run(manager(), scans(beside(15.0), 0, 20))[-1].track
    hull, zero = track.identity[0], torch.zeros(2).double()
    track = track._replace(
        confirmed=torch.tensor([True, False]), misses=torch.tensor([1.0, missed]).double(),
        beside=Beside(torch.tensor([-1, hull]), zero, torch.tensor([0.0, odds]).double()),
    )  # fmt: skip
    after, stays = Extent(sure=0.9).kept(track, torch.tensor([False, True]))
    assert stays.tolist() == [kept, True]
    assert torch.equal(after.identity, track.identity)


def test_a_sensor_that_never_misses_leaves_odds():
    """Of two targets side by side both are measured: none of what a detection of 1 excludes has a share."""
    targets = manager()
    state = run(targets, scans(beside(15.0), 0, 20))[-1]
    hull, zero = state.track.identity[0], torch.zeros(2).double()
    track = state.track._replace(beside=Beside(torch.tensor([-1, hull]), zero, zero))
    never = torch.full((2,), -torch.inf, dtype=torch.float64)
    one = torch.ones((), dtype=torch.float64)
    after = Extent().weighed(targets.filter.motion, state.belief, track, never, one, zero + 1.5)
    assert after.beside.odds.isfinite().all()


def test_a_target_of_one_scene_is_no_part_of_one_in_another():
    targets = manager()
    z = torch.stack([torch.from_numpy(x) for x in scans(beside(15.0), 0, 16, lambda rng, k: (True, True))])
    alone = targets(z)
    later = torch.full_like(z, math.nan)
    later[4:] = z[4:]
    both = targets(torch.stack([z, later]))
    torch.testing.assert_close(both.mean[0, :2], alone.mean, equal_nan=True, rtol=1e-9, atol=1e-9)


def test_a_stream_with_parts_goes_on_from_what_was_saved():
    targets, z = manager(stitching=Stitching(20.0, 50.0)), scans(hull(), 2, shown=in_turn)
    states = run(targets, z)
    state = targets.restored(targets.saved(states[19]))
    for scan in z[20:]:
        state = targets.step(state, torch.from_numpy(scan), dt=1.5)
    assert torch.equal(state.track.beside.odds, states[-1].track.beside.odds)
    assert (torch.stack([(s.track.beside.host >= 0).any() for s in states])).any()


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Extent(0.0), "longest: expected finite metres above 0"),
    (lambda: Extent(4.0, 4.0), "shortest, longest: expected shortest < longest, received 4.0, 4.0"),
    (lambda: Extent(beam=-1.0), "beam: expected finite metres above 0"),
    (lambda: Extent(both=1.0), "both: expected a probability"),
    (lambda: Extent(speed=0.0), "speed: expected a finite number above 0"),
    (lambda: Extent(seconds=math.inf), "seconds: expected a finite number above 0"),
    (lambda: Extent(two=0.0), "two: expected a probability"),
    (lambda: Extent(sure=0.4), r"sure: expected a probability in \[0.5, 1\), received 0.4"),
    (lambda: Targets(plane(), extent=20.0), "extent: expected a Extent"),
    (lambda: Targets(presets.jpda(ConstantVelocity(1.0, 3), Position(1.0, dims=3), clutter=Clutter(1e6, rate=1.0)),
                     extent=Extent()), "extent: expected targets in the plane, received 3 dimensions"),
    (lambda: manager().step(Targets(plane()).init(), torch.zeros(1, 2).double()), "state: expected one of a manager"),
])  # fmt: skip
def test_what_does_not_fit_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_tracks_of_boats_side_by_side_move_together_only_where_all_permutations_count():
    """6 m apart for 80 scans, where the noise is 2 m; the worst of five runs."""
    nearest = {}
    for permutations in (False, True):
        found = []
        for seed in range(5):
            rng = np.random.default_rng(seed)
            f = presets.jpda(
                ConstantVelocity(0.3, continuous=True), Position(STD), clutter=Clutter(600.0**2, rate=1.0),
                detection=P, permutations=permutations,
            )  # fmt: skip
            truth = np.array([[[0.0, 3.0 * k], [6.0, 3.0 * k]] for k in range(80)])
            z = torch.from_numpy(truth + STD * rng.standard_normal(truth.shape))
            mean = torch.tensor([[0.0, 0.0, 0.0, 2.0], [6.0, 0.0, 0.0, 2.0]], dtype=torch.float64)
            estimate = f(z, Gaussian(mean, 0.5 * torch.eye(4, dtype=torch.float64).expand(2, -1, -1)), dt=1.5)
            found.append(float((estimate.mean[0, :, :2] - estimate.mean[1, :, :2]).norm(dim=-1)[20:].mean()))
        nearest[permutations] = min(found)
    assert nearest[False] > 5.0 > nearest[True] + 1.0
