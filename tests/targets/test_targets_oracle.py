"""Births, confirmation, deletion and identities are those of plain loops, scan by scan."""

import math

import numpy as np
import pytest
import torch
from oracles.targets import manage

from torchfra import presets
from torchfra.association import ChiSquare, Clutter
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.targets import (
    SPRT,
    ClutterMap,
    Deletion,
    Existence,
    Extent,
    FieldOfView,
    MOfN,
    OnePoint,
    Stitching,
    Targets,
    TwoPoint,
)

STD, Q, DT, PD, PG, WIDTH, RATE = 2.0, 0.25, 2.0, 0.8, 0.99, 150.0, 1.5
BIRTHS = {"one point": (OnePoint(4.0), {"velocity": 4.0}), "two points": (TwoPoint(12.0), {"speed": 12.0})}
CONFIRMATIONS = {
    "3 of 5": (MOfN(3, 5), {"m": 3, "n": 5}),
    "2 of 2": (MOfN(2, 2), {"m": 2, "n": 2}),
    "score": (SPRT(1e-3, 0.02), {"false": 1e-3, "missed": 0.02}),
    "existence": (
        Existence(60.0, 0.2, confirmed=0.98, deleted=0.02),
        {"lifetime": 60.0, "birth": 0.2, "confirmed": 0.98, "deleted": 0.02},
    ),
}
DELETIONS = {
    "misses": (Deletion(3), {"misses": 3}),
    "drop": (Deletion(4, score_drop=0.01), {"misses": 4, "drop": 0.01}),
}


def scans(seed, steps=30):
    """Two targets, one of which goes and one of which comes, missed now and then, among false measurements."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(steps):
        there = [(-40 + 4 * k, 10 + k)] if k < 20 else []
        there += [(50 - 3 * k, -30 + 2 * k)] if k >= 6 else []
        z = [np.array(x) + STD * rng.standard_normal(2) for x in there if rng.random() < PD]
        z += list(rng.uniform(-WIDTH / 2, WIDTH / 2, (rng.poisson(RATE), 2)))
        found.append(rng.permutation(np.array(z).reshape(-1, 2)))
    return found


def manager(birth, confirmation, deletion, **options):
    f = presets.jpda(
        ConstantVelocity(Q), Position(STD), clutter=Clutter(WIDTH**2, rate=RATE), detection=PD, gate=ChiSquare(PG),
        exact=(6, 6),
    )  # fmt: skip
    return Targets(f, birth=birth, confirmation=confirmation, deletion=deletion, **options)


@pytest.mark.parametrize("confirmation", CONFIRMATIONS)
@pytest.mark.parametrize(("birth", "deletion"), list(zip(BIRTHS, DELETIONS, strict=True)))
def test_every_scan_leaves_the_targets_of_plain_loops(birth, confirmation, deletion):
    (birth, born), (confirmation, how), (deletion, when) = (
        BIRTHS[birth], CONFIRMATIONS[confirmation], DELETIONS[deletion],
    )  # fmt: skip
    z = scans(0)
    expected = manage(
        z, std=STD, q=Q, dt=DT, PD=PD, PG=PG, limit=-2 * math.log(1 - PG), density=RATE / WIDTH**2, birth=born,
        confirm=how, **when,
    )  # fmt: skip
    targets = manager(birth, confirmation, deletion)
    follow(targets, z, expected, [{"dt": DT}] * len(z))


@pytest.mark.parametrize("birth", BIRTHS)
def test_scans_of_two_sensors_at_one_instant_are_two_scans_of_plain_loops(birth):
    """The second looks half a second after the first, then at the same instant; its noise comes with its scans."""
    z, two = [scan for pair in zip(scans(0), scans(1), strict=True) for scan in pair], 2 * len(scans(0))
    own, more = {"std": STD, "PD": PD, "density": RATE / WIDTH**2}, {"PD": 0.6, "density": 0.7 / WIDTH**2, "sensor": 1}
    gaps = [(DT, 0.0) if k % 3 else (DT - 0.5, 0.5) for k in range(two // 2)]
    looks = [one for first, second in gaps for one in ({"dt": first, **own}, {"dt": second, "std": 3.0, **more})]
    (how, born), (confirmation, when) = BIRTHS[birth], CONFIRMATIONS["score"]
    expected = manage(
        z, std=STD, q=Q, dt=DT, PD=PD, PG=PG, limit=-2 * math.log(1 - PG), density=RATE / WIDTH**2, birth=born,
        confirm=when, misses=6, looks=looks,
    )  # fmt: skip
    other = presets.jpda(
        ConstantVelocity(Q), Position(1.0), clutter=Clutter(WIDTH**2, rate=0.7), detection=0.6, gate=ChiSquare(PG),
        exact=(6, 6),
    )  # fmt: skip
    targets = manager(how, confirmation, Deletion(6), sensors={"other": other})
    options = [{"dt": look["dt"]} for look in looks]
    for k in range(1, two, 2):
        options[k] |= {"sensor": "other"}
        if k % 4 == 1:
            options[k] |= {"std": torch.full(z[k].shape, 3.0).double()}
        else:
            options[k] |= {"noise": 3.0 * torch.eye(2).double().expand(len(z[k]), 2, 2)}
    follow(targets, z, expected, options)


LEARNED = {"size": 4.0, "seconds": 30.0, "scans": 1.5}
"""Values of a map of clutter."""
HASTY = {  # few targets at a time: clusters stay exact
    "score": (SPRT(1e-3, 0.2), {"false": 1e-3, "missed": 0.2}),
    "existence": (
        Existence(60.0, 0.2, confirmed=0.98, deleted=0.03),
        {"lifetime": 60.0, "birth": 0.2, "confirmed": 0.98, "deleted": 0.03},
    ),
}


@pytest.mark.parametrize(
    ("birth", "confirmation"), [("one point", "score"), ("two points", "score"), ("two points", "existence")]
)
def test_a_map_of_clutter_and_a_field_of_view_are_those_of_plain_loops(birth, confirmation):
    """Two things stay where they are beside the targets; the second sensor sees 60 m far, from a place that moves."""
    still = np.array([[60.0, 55.0], [-65.0, -50.0]])
    rng = np.random.default_rng(5)
    z = [np.concatenate([scan, still + STD * rng.standard_normal((2, 2))]) for scan in scans(2)]
    place = [np.array([-20.0 + 2 * k, 5.0]) for k in range(len(z))]
    own, more = {"std": STD, "PD": PD, "density": RATE / WIDTH**2}, {"PD": 0.6, "density": 0.7 / WIDTH**2, "std": 1.0}
    looks = [{"dt": DT, "sensor": k % 2, **(own if k % 2 == 0 else more)} for k in range(len(z))]
    for k in range(1, len(z), 2):
        looks[k] |= {"place": place[k], "farthest": 60.0}
    (how, born), (confirmation, when) = BIRTHS[birth], HASTY[confirmation]
    expected = manage(
        z, std=STD, q=Q, dt=DT, PD=PD, PG=PG, limit=-2 * math.log(1 - PG), density=RATE / WIDTH**2, birth=born,
        confirm=when, misses=4, drop=0.001, looks=looks, clutter_map=LEARNED,
    )  # fmt: skip
    other = presets.jpda(
        ConstantVelocity(Q), Position(1.0), clutter=Clutter(extent=(WIDTH, WIDTH), rate=0.7), detection=0.6,
        gate=ChiSquare(PG), exact=(6, 6),
    )  # fmt: skip
    targets = manager(
        how, confirmation, Deletion(4, score_drop=0.001), sensors={"other": other}, clutter_map=ClutterMap(**LEARNED),
        views={"other": FieldOfView(60.0)},
    )  # fmt: skip
    options = [
        {"dt": DT} | ({"sensor": "other", "u": torch.from_numpy(place[k])} if k % 2 else {}) for k in range(len(z))
    ]
    follow(targets, z, expected, options)
    assert any(t.confirmed for t in expected[-1])
    plain = manager(how, confirmation, Deletion(4, score_drop=0.001), sensors={"other": other})
    state = plain.init()
    for scan, option in zip(z, options, strict=True):
        state = plain.step(state, torch.from_numpy(scan), **option)
    assert len(state.identity) > sum(t.confirmed for t in expected[-1])  # it takes what stays for targets


@pytest.mark.parametrize(
    ("confirmation", "misses", "learned"),
    [("score", 3, None), ("score", 9, None), ("existence", 3, None), ("existence", 9, None), ("score", 3, LEARNED)],
)
def test_broken_tracks_are_stitched_as_in_plain_loops(confirmation, misses, learned):
    """Three targets side by side, which nobody sees for a while: after three misses they are lost, after nine not.

    What a target claimed of a map of clutter before it got the identity of a lost one stays its own.
    """
    rng, z = np.random.default_rng(7), []
    for k in range(26):
        there = [(4.0 * k - 50, y) for y in (-10.0, 12.0, 40.0)] if not 9 <= k < 13 else []
        there += [(rng.uniform(-75, 75), rng.uniform(-75, 75))]
        z.append(rng.permutation(np.array(there) + STD * rng.standard_normal((len(there), 2))))
    born, (confirmation, when) = BIRTHS["two points"][1], CONFIRMATIONS[confirmation]
    bounds = {"seconds": 14.0, "metres": 60.0}
    expected = manage(
        z, std=STD, q=Q, dt=DT, PD=PD, PG=PG, limit=-2 * math.log(1 - PG), density=RATE / WIDTH**2, birth=born,
        confirm=when, misses=misses, stitch=bounds | {"limit": 13.276704135987623}, clutter_map=learned,
    )  # fmt: skip
    targets = manager(
        TwoPoint(12.0), confirmation, Deletion(misses), stitching=Stitching(**bounds, probability=0.99),
        clutter_map=None if learned is None else ClutterMap(**learned),
    )  # fmt: skip
    follow(targets, z, expected, [{"dt": DT}] * len(z))
    first, last = ({t.identity for t in expected[k] if t.confirmed} for k in (8, -1))
    assert len(first) == 3
    assert first == last


HULL = {
    "longest": 30.0,
    "shortest": 5.0,
    "beam": 2.5,
    "both": 0.3,
    "speed": 1.5,
    "seconds": 25.0,
    "two": 0.4,
    "sure": 0.8,
}


def beside(seed, steps=40):
    """A ship that shows its bow, its stern, both or nothing, and then turns; two boats side by side."""
    rng, found = np.random.default_rng(seed), []
    for k in range(steps):
        course = 0.05 * max(0, k - 20)
        ahead = np.array([math.cos(course), math.sin(course)])
        middle = np.array([-60.0 + 5 * k, -30.0])
        ends = [(1,), (-1,), (1, -1), ()][rng.choice(4, p=[0.4, 0.4, 0.15, 0.05]) if k > 8 else 0]
        z = [middle + 9 * s * ahead for s in ends]
        z += [np.array([60.0 - 4 * k, y]) for y in (40.0, 54.0) if rng.random() < PD]
        z = [x + 0.7 * STD * rng.standard_normal(2) for x in z]
        found.append(rng.permutation(np.array(z).reshape(-1, 2)))
    return found


@pytest.mark.parametrize("stitch", [None, {"seconds": 20.0, "metres": 30.0, "probability": 0.99}])
def test_two_boats_and_the_ends_of_a_hull_are_those_of_plain_loops(stitch):
    z, confirmation, how = beside(3), *HASTY["score"]
    limit = 13.2767041  # of the whole state, 0.99
    expected = manage(
        z, std=STD, q=Q, dt=DT, PD=PD, PG=PG, limit=-2 * math.log(1 - PG), density=RATE / WIDTH**2,
        birth=BIRTHS["one point"][1], confirm=how, misses=3, extent=HULL | {"turn": 0.05},
        stitch=None if stitch is None else stitch | {"limit": limit},
    )  # fmt: skip
    targets = manager(
        BIRTHS["one point"][0], confirmation, Deletion(3), extent=Extent(**HULL),
        stitching=None if stitch is None else Stitching(**stitch),
    )  # fmt: skip
    states = follow(targets, z, expected, [{"dt": DT}] * len(z))
    shared, parts = 0, 0
    for state, there in zip(states, expected, strict=True):
        assert state.track.beside.host.tolist() == [t.host_identity for t in there]
        np.testing.assert_allclose(state.track.beside.odds, [t.odds for t in there], rtol=1e-7, atol=1e-7)
        shared += sum(t.host is not None and t.confirmed for t in there)
        parts += sum(t.host is not None and t.odds < 0 for t in there)
    assert shared > 5  # two boats were found to be two
    assert parts > 5


def follow(targets, z, expected, options):
    """The manager beside the oracle: its states."""
    state, most, confirmed, states = targets.init(), 0, set(), []
    for scan, there, option in zip(z, expected, options, strict=True):
        state = targets.step(state, torch.from_numpy(scan), **option)
        assert state.track.identity.tolist() == [t.identity for t in there]
        assert state.track.confirmed.tolist() == [t.confirmed for t in there]
        np.testing.assert_allclose(state.track.score, [t.score for t in there], rtol=1e-9, atol=1e-9)
        if there:
            np.testing.assert_allclose(state.belief.mean, [t.mean for t in there], rtol=1e-8, atol=1e-8)
            np.testing.assert_allclose(state.belief.covariance, [t.P for t in there], rtol=1e-7, atol=1e-7)
        most, confirmed = max(most, len(there)), confirmed | set(state.identity.tolist())
        states.append(state)
    assert most >= 3  # there was something to decide
    assert len(confirmed) >= 2
    return states
