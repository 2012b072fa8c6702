"""A scan that comes late changes targets as if it had come in turn, and no identity changes for it."""

import math

import pytest
import torch
from joint import plane

from torchfra import presets, tree
from torchfra.association import Clutter
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.targets import SPRT, ClutterMap, Deletion, Existence, FieldOfView, MOfN, OnePoint, Targets, TwoPoint

LAG = 2.0
CLOSE = {"rtol": 1e-9, "atol": 1e-9}


def looks(seed, steps=20, scenes=1):
    """Scans of two sensors in turn, ``(time (R,), name, z (R, J, 2))``: two targets, one comes, false ones anywhere."""
    rng = torch.Generator().manual_seed(seed)
    found = []
    for k in range(steps):
        t = 0.5 * k + 0.3 * torch.rand(scenes, 1, generator=rng).double()
        there = [torch.cat([-40 + 4 * t, 10 + t], -1), torch.cat([50 - 3 * t, -30 + 2 * t], -1)]
        if k >= 6:
            there.append(torch.cat([20 + 0 * t, 60 - 4 * t], -1))
        z = torch.stack(there, 1) + 2.0 * torch.randn(scenes, len(there), 2, generator=rng).double()
        z[torch.rand(z.shape[:-1], generator=rng) > 0.9] = math.nan
        false = 200.0 * torch.rand(scenes, 2, 2, generator=rng).double() - 100.0
        found.append((t[:, 0], "other" if k % 2 else None, torch.cat([z, false], 1)))
    return found


def fed(targets, scans):
    """The states of scans that come in this order, whatever their times are."""
    state, newest, states = targets.init(len(scans[0][0])), scans[0][0], []
    for time, sensor, z in scans:
        state = targets.step(state, z, dt=time - newest, sensor=sensor, u=torch.tensor([-20.0, 5.0]).double())
        newest = torch.maximum(newest, time)
        states.append(state)
    return states


def shuffled(scans, seed, lag=LAG):
    """The scans in the order in which they come after delays of less than ``lag`` seconds."""
    rng = torch.Generator().manual_seed(seed)
    delays = lag * torch.rand(len(scans), generator=rng).double()
    return [scans[i] for i in torch.stack([x[0][0] for x in scans]).add(delays).argsort().tolist()]


def manager(inner=presets.srckf, **options):
    other = presets.jpda(
        ConstantVelocity(0.5), Position(3.0), clutter=Clutter(1e4, rate=1.0), detection=0.7, inner=inner
    )
    return Targets(plane(inner=inner), sensors={"other": other}, **{"lag": LAG, "birth": OnePoint(5.0)} | options)


SETTINGS = {
    "score": lambda: manager(),
    "two points, 2 of 3": lambda: manager(birth=TwoPoint(20.0), confirmation=MOfN(2, 3)),
    "existence, map and view": lambda: manager(
        confirmation=Existence(60.0), clutter_map=ClutterMap(3.0), views={"other": FieldOfView(60.0)}
    ),
    "regimes": lambda: manager(presets.gpb),
}


def without_identities(state):
    """A state's tensors; in the place of an identity that a map of clutter knows, the row of the target."""
    track, clutter = state.track._replace(identity=None), state.clutter
    if clutter is not None:
        same = clutter.claimed.identity[:, None] == state.track.identity
        row = (same * torch.arange(1, 1 + same.shape[-1])).sum(-1)  # 0 if it is gone
        clutter = clutter._replace(claimed=clutter.claimed._replace(identity=row))
    return tree.flatten(state._replace(track=track, past=(), next_identity=None, clutter=clutter))


@pytest.mark.parametrize("name", SETTINGS)
def test_scans_in_any_order_leave_what_they_leave_in_turn(name):
    targets, scans = SETTINGS[name](), looks(0)
    mixed = shuffled(scans, 1)
    assert [x[0] for x in mixed] != [x[0] for x in scans]
    late, expected = fed(targets, mixed)[-1], fed(targets, scans)[-1]
    assert len(expected.identity) >= 3
    for one, other in zip(without_identities(late), without_identities(expected), strict=True):
        torch.testing.assert_close(one, other, **CLOSE)
    identities = late.track.identity
    assert len(identities.unique()) == len(identities)
    assert (identities < late.next_identity).all()


def test_scenes_side_by_side_have_times_of_their_own():
    targets, scans = manager(), looks(2, scenes=3)
    late, expected = fed(targets, shuffled(scans, 3, 1.5))[-1], fed(targets, scans)[-1]
    for one, other in zip(without_identities(late), without_identities(expected), strict=True):
        torch.testing.assert_close(one, other, **CLOSE)


def test_confirmed_targets_keep_their_identities_when_a_late_scan_brings_others_before_them():
    targets, near = manager(lag=3.0, confirmation=MOfN(3, 6)), [0.0, 0.0]
    far = torch.tensor([[[300.0, 0.0], [0.0, 300.0]]]).double()
    scans = [(torch.tensor([float(k)]).double(), None, torch.tensor([[near] * (k > 0)]).double()) for k in range(4)]
    scans[0] = (*scans[0][:2], torch.zeros(1, 0, 2).double())
    state = fed(targets, scans)[-1]
    assert state.identity.tolist() == [0]
    state = targets.step(state, far, dt=-2.5, sensor="other")
    assert state.track.identity.tolist() == [1, 2, 0]
    assert state.identity.tolist() == [0]
    again = targets.step(state, -far, dt=-2.4, sensor="other")  # goes on from what was kept
    assert again.identity.tolist() == [0]
    assert again.next_identity.item() > again.track.identity.amax()


def test_a_scan_before_the_very_first_one_is_put_in_too():
    targets, scans = manager(), looks(4, 8)
    late = fed(targets, [scans[1], scans[0], *scans[2:]])[-1]
    for one, other in zip(without_identities(late), without_identities(fed(targets, scans)[-1]), strict=True):
        torch.testing.assert_close(one, other, **CLOSE)


def test_a_late_scan_of_an_instant_comes_after_the_others_of_it():
    targets, ((t, _, z), (_, _, more), *_) = manager(), looks(5, 4)
    scans = [(t, None, z), (t, "other", more), (t + 1.0, None, z)]
    late = fed(targets, [scans[0], scans[2], scans[1]])[-1]
    for one, other in zip(without_identities(late), without_identities(fed(targets, scans)[-1]), strict=True):
        torch.testing.assert_close(one, other, **CLOSE)


def test_no_more_scans_are_kept_than_may_be_late():
    states = fed(manager(lag=1.0), looks(6, 20))
    assert all(2 <= len(state.past) <= 4 for state in states[4:])  # two a second, and the one before
    assert all(x.before.past == () for x in states[-1].past)
    assert fed(manager(lag=0.0), looks(6, 20))[-1].past == ()


def test_a_stream_that_was_saved_takes_late_scans_still(tmp_path):
    targets, scans = manager(), shuffled(looks(7), 8)
    states = fed(targets, scans)
    late = max(k for k in range(1, len(scans)) if scans[k][0] < scans[k - 1][0])
    torch.save(targets.saved(states[late - 1]), tmp_path / "targets.pt")
    state = targets.restored(torch.load(tmp_path / "targets.pt", weights_only=True))
    newest = max(x[0] for x in scans[:late])
    time, sensor, z = scans[late]
    state = targets.step(state, z, dt=time - newest, sensor=sensor, u=torch.tensor([-20.0, 5.0]).double())
    for one, other in zip(tree.flatten(state), tree.flatten(states[late]), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def test_gradients_flow_through_what_is_filtered_again():
    f = plane(learn=["std"])
    targets = Targets(f, birth=OnePoint(5.0), lag=LAG)
    state = fed(targets, [x for x in shuffled(looks(9, 20), 9) if x[1] is None])[-1]
    state.confirmed.mean.sum().backward()
    assert all(p.grad.isfinite().all() and p.grad.abs().sum() > 0 for p in targets.parameters())


@pytest.mark.parametrize(
    ("lag", "dt", "said"),
    [
        (
            2.0,
            -2.5,
            r"dt: expected finite seconds above 0 or 0, and -2 at least of a late scan, received -2.5",
        ),
        (0.0, -0.5, r"dt: expected finite seconds above 0 or 0, received -0.5"),
        (2.0, [-0.5, 0.5], r"dt: expected a scan that is late in every scene.*received \[-0.5, 0.5\]"),
        (2.0, [-0.6, -1.4], "dt: expected a scan that is late in every scene, between the same two"),
    ],
)
def test_a_scan_that_is_too_late_is_refused_and_no_target_is_lost(lag, dt, said):
    targets, scans = manager(lag=lag), looks(10, scenes=2)
    scans = [(torch.full_like(t, float(k)), sensor, z) for k, (t, sensor, z) in enumerate(scans)]
    state = fed(targets, scans)[-1]
    before = [x.clone() for x in tree.flatten(state)]
    assert len(state.identity)
    with pytest.raises(ValueError, match=said):
        targets.step(state, scans[0][2], dt=torch.tensor(dt).double())
    torch.testing.assert_close(before, tree.flatten(state), rtol=0, atol=0, equal_nan=True)
    assert len(targets.step(state, scans[0][2][:, :0]).identity) == len(state.identity)


def test_a_first_scan_cannot_be_late():
    targets = manager()
    with pytest.raises(ValueError, match=r"dt: expected 0 or more before any scan has come, received \[-1.0\]"):
        targets.step(targets.init(), torch.zeros(1, 2).double(), dt=-1.0)


@pytest.mark.parametrize("lag", [-1.0, math.inf, "x"])
def test_a_lag_is_a_number_of_seconds(lag):
    with pytest.raises(ValueError, match="lag: expected finite seconds of 0 or more, received"):
        manager(lag=lag, confirmation=SPRT(), deletion=Deletion())
