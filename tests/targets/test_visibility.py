"""Targets that a sensor does not see for a while: visibility as a Markov chain in the state of each track."""

import math

import numpy as np
import pytest
import torch
from joint import plane
from oracles.events import joint_visibility
from oracles.targets import manage
from test_existence import check_gradients
from test_targets_oracle import BIRTHS, DT, HASTY, PD, PG, RATE, STD, WIDTH, Q, follow, manager, scans

from torchfra import presets
from torchfra.association import ChiSquare, Clutter
from torchfra.association.gates import Candidates
from torchfra.filters.scans.scan import Scan
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.targets import Deletion, Existence, FieldOfView, MOfN, OnePoint, Targets, TwoPoint, Visibility, collect
from torchfra.targets.visibility import Chains

CHAINS = {None: Visibility(20.0, 8.0), "other": Visibility(30.0, 15.0)}
CHAINS_OF_ONE = {None: CHAINS[None]}
HIDE = {0: {"seen": 20.0, "hidden": 8.0}, 1: {"seen": 30.0, "hidden": 15.0}}


def two_sensors(birth, confirmation, **options):
    other = presets.jpda(
        ConstantVelocity(Q), Position(1.0), clutter=Clutter(WIDTH**2, rate=0.7), detection=0.6, gate=ChiSquare(PG),
        exact=(6, 6),
    )  # fmt: skip
    return manager(birth, confirmation, Deletion(5), sensors={"other": other}, **options)


def lone(*, visibility=None, compile=False, **options):
    f = plane(Clutter(WIDTH**2, rate=RATE), detection=0.95, gate=ChiSquare(0.999), **options)
    f = f.compile() if compile else f
    return Targets(f, birth=OnePoint(4.0), confirmation=Existence(confirmed=0.98), visibility=visibility)


def states_of(targets, z):
    state, states = targets.init(), []
    for scan in z:
        state = targets.step(state, torch.as_tensor(scan))
        states.append(state)
    return states


@pytest.mark.parametrize("confirmation", HASTY)
@pytest.mark.parametrize("hidden", [{0}, {0, 1}], ids=["from one", "from both"])
def test_targets_that_are_hidden_from_sensors_are_those_of_plain_loops(hidden, confirmation):
    """The second sensor sees 60 m far: beyond that its scans tell nothing of who is visible."""
    (confirmation, when), place = HASTY[confirmation], np.array([0.0, 0.0])
    own, more = {"std": STD, "PD": PD, "density": RATE / WIDTH**2}, {"PD": 0.6, "density": 0.7 / WIDTH**2, "std": 1.0}
    z = scans(3)
    looks = [{"dt": DT, "sensor": k % 2, **(own if k % 2 == 0 else more)} for k in range(len(z))]
    for k in range(1, len(z), 2):
        looks[k] |= {"place": place, "farthest": 60.0}
    expected = manage(
        z, std=STD, q=Q, dt=DT, PD=PD, PG=PG, limit=-2 * math.log(1 - PG), density=RATE / WIDTH**2,
        birth=BIRTHS["two points"][1], confirm=when, misses=5, looks=looks, hide={s: HIDE[s] for s in hidden},
    )  # fmt: skip
    chains = {name: chain for s, (name, chain) in enumerate(CHAINS.items()) if s in hidden}
    targets = two_sensors(TwoPoint(12.0), confirmation, visibility=chains, views={"other": FieldOfView(60.0)})
    options = [{"dt": DT} | ({"sensor": "other", "u": torch.from_numpy(place)} if k % 2 else {}) for k in range(len(z))]
    states = follow(targets, z, expected, options)
    for state, there in zip(states, expected, strict=True):
        visible = np.array([t.visible for t in there]).reshape(-1, 2)
        np.testing.assert_allclose(state.track.visible, visible, rtol=1e-9, atol=1e-9)
    assert min(float(state.track.visible.min()) for state in states if len(state.track.visible)) < 0.5


def test_association_is_the_sum_over_who_exists_who_is_visible_and_who_is_measured():
    rng, targets = np.random.default_rng(0), plane(Clutter(10.0, rate=3.0), detection=0.8, gate=ChiSquare(0.9))
    for _ in range(20):
        near, density = rng.random((4, 3)) * (rng.random((4, 3)) < 0.6), np.full(4, 0.3)
        exists, visible = rng.uniform(0.001, 0.999, (2, 3))
        beta, missed, hidden, absent = joint_visibility(near, 0.8, density, 0.9, exists, visible)
        with np.errstate(divide="ignore"):
            fit = torch.from_numpy(np.log(near.T))
        z = torch.zeros(1, 4, 2).double()
        scan = Scan(None, None, None, Candidates(z, z, torch.ones_like(z), fit), fit)
        inside = torch.where(fit > -math.inf, 0.0, -math.inf).double()
        miss = torch.tensor(math.log(1 - 0.8 * 0.9), dtype=torch.float64)
        found = targets.associate(scan, inside, miss, torch.from_numpy(exists), torch.from_numpy(visible))
        there = 1 - absent
        np.testing.assert_allclose(found.probabilities.mT, beta / there, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.log_weights[:, 0].exp(), (missed + hidden) / there, rtol=1e-9)
        now = Chains((Visibility(1.0, 1.0),)).updated(
            torch.from_numpy(visible)[:, None], 0, found.log_weights[:, 0], miss
        )
        np.testing.assert_allclose(now[:, 0], 1 - hidden / there, rtol=1e-9)


def test_a_target_that_is_hidden_for_a_while_is_kept_and_one_that_has_ended_is_not():
    """Existence alone takes the misses of a hidden target for its end."""
    z = torch.stack([50.0 + 3.0 * torch.arange(8.0)] * 2, -1).double().reshape(8, 1, 2)
    nothing = torch.full((1, 2), math.nan).double()
    for visibility, there in ((None, 0), ({None: Visibility(60.0, 10.0)}, 1)):
        targets = lone(visibility=visibility)
        state = states_of(targets, z)[-1]
        for _ in range(8):
            state = targets.step(state, nothing)
        assert len(state.identity) == there
    for _ in range(200):
        state = targets.step(state, nothing)
    assert len(state.identity) == 0


def test_a_sensor_that_seldom_sees_targets_does_not_delete_what_another_sees():
    """A scan of the own sensor in six; the other one has a tenth of its detection and sees nothing."""
    z = torch.stack([50.0 + 3.0 * torch.arange(6.0)] * 2, -1).double().reshape(6, 1, 2)
    nothing = torch.full((1, 2), math.nan).double()
    for detection, there in ((0.09, True), (0.9, False)):
        f, other = (plane(detection=x) for x in (0.9, detection))
        targets = Targets(
            f, birth=TwoPoint(9.0), confirmation=MOfN(1, 1), deletion=Deletion(3), sensors={"other": other}
        )
        state = targets.init()
        for scan in z:
            for _ in range(5):
                state = targets.step(state, nothing, dt=0.1, sensor="other")
            state = targets.step(state, scan, dt=0.5)
        assert (state.track.identity.tolist() == [0]) == there


def test_misses_by_a_sensor_from_which_a_target_is_hidden_soon_count_no_more():
    z = torch.stack([50.0 + 3.0 * torch.arange(4.0)] * 2, -1).double().reshape(4, 1, 2)
    nothing, missed = torch.full((1, 2), math.nan).double(), []
    for visibility in (None, {None: Visibility(60.0, 600.0)}):
        targets = Targets(plane(), birth=OnePoint(4.0), deletion=Deletion(50), visibility=visibility)
        state = states_of(targets, z)[-1]
        for _ in range(10):
            state = targets.step(state, nothing)
        missed.append(float(state.track.misses[0]))
    assert missed[0] == 10
    assert missed[1] < 2


def test_a_target_is_visible_to_the_sensor_that_found_it_and_to_others_as_often_as_any():
    targets = two_sensors(OnePoint(4.0), Existence(), visibility=CHAINS)
    z = torch.tensor([[3.0, 4.0]]).double()
    for sensor, expected in ((None, [1.0, 2 / 3]), ("other", [20 / 28, 1.0])):
        state = targets.step(targets.init(), z, sensor=sensor)
        torch.testing.assert_close(state.track.visible, torch.tensor([expected]).double())


def test_a_late_scan_leaves_what_scans_in_the_order_of_their_times_leave():
    targets, z = two_sensors(OnePoint(4.0), Existence(60.0), visibility=CHAINS, lag=3.0), scans(0, 3)
    first, second, third = map(torch.from_numpy, z)
    state = targets.step(targets.init(), first)
    in_order = targets.step(targets.step(state, second, dt=1.0, sensor="other"), third, dt=1.0)
    late = targets.step(targets.step(state, third, dt=2.0), second, dt=-1.0, sensor="other")
    torch.testing.assert_close(late.track.visible, in_order.track.visible, rtol=1e-12, atol=1e-12)


def test_gradients_are_those_of_finite_differences():
    z = torch.stack([torch.from_numpy(scan[:3]) for scan in scans(1, 8) if len(scan) >= 3]).unsqueeze(0)
    targets = lone(learn=("detection", "q", "std"), visibility={None: Visibility(5.0, 3.0)})
    check_gradients(targets, z)


@pytest.mark.slow
def test_a_compiled_filter_leaves_the_same_targets():
    slow, fast = (
        states_of(lone(visibility={None: Visibility(20.0, 8.0)}, compile=compile), scans(0))
        for compile in (False, True)
    )
    assert len(slow[-1].track.visible)
    torch.testing.assert_close(collect(fast), collect(slow), rtol=1e-9, atol=1e-9, equal_nan=True)
    torch.testing.assert_close(fast[-1].track.visible, slow[-1].track.visible, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Visibility(0.0, 1.0), "seen: expected seconds above 0, received 0.0"),
    (lambda: Visibility(1.0, math.inf), "hidden: expected finite seconds above 0, received inf"),
    (lambda: lone(visibility=Visibility(1.0, 1.0)), "visibility: expected a dict by the name of a sensor, received"),
    (lambda: lone(visibility={"radar": CHAINS[None]}), "visibility: expected some of None, received 'radar'"),
    (lambda: lone(visibility={None: 0.5}), "visibility: expected a Visibility of None, received float"),
    (lambda: lone().step(lone(visibility=CHAINS_OF_ONE).init(), torch.zeros(1, 2)),
     "state: expected none of a manager with visibility, received one"),
])  # fmt: skip
def test_arguments_that_do_not_fit_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
