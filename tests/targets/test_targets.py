"""Targets come and go in streams and batches, around any filter of scans; clusters change nothing."""

import copy
import functools
import math
import operator
import pickle
import sys

import pytest
import torch
from joint import plane

from torchfra import metrics, presets, scenarios, tree
from torchfra.association import ChiSquare, Clutter, Euclidean
from torchfra.gaussian.inputs import Measurements
from torchfra.motion import ConstantAcceleration, ConstantVelocity, RandomWalk, aircraft
from torchfra.sensors import Bearings, Position, RangeBearing, Stacked
from torchfra.steps.checks import check_step
from torchfra.targets import SPRT, Deletion, Merging, MOfN, OnePoint, Targets, TwoPoint, collect
from torchfra.targets.scan import SceneScan, filter_scan
from torchfra.types import Gaussian

WHERE = slice(0, 2)


def moving(starts, steps, std=2.0, seed=0):
    """Truth ``(N, T, 4)`` of constant velocities and positions ``(T, N, 2)`` measured of it."""
    starts = torch.tensor(starts, dtype=torch.float64)
    t = torch.arange(1, steps + 1, dtype=torch.float64).reshape(-1, 1)
    velocity = starts[:, None, 2:].expand(-1, steps, -1)
    truth = torch.cat([starts[:, None, :2] + t * velocity, velocity], -1)
    noise = torch.randn(truth[..., :2].shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return truth, (truth[..., :2] + std * noise).transpose(0, 1)


def with_clutter(z, count, half, seed=1):
    """Scans with false measurements in a square."""
    rng = torch.Generator().manual_seed(seed)
    false = half * (2 * torch.rand(*z.shape[:-2], count, 2, generator=rng, dtype=torch.float64) - 1)
    return torch.cat([z, false], -2)


FOUR = [(0, 0, 5, 0), (0, 60, 5, -2), (100, -80, -3, 1), (-90, 90, 0, -4)]


def run(targets, scans, **options):
    """The states after each scan of a stream."""
    state, states = targets.init(), []
    for z in scans:
        state = targets.step(state, z, **options)
        states.append(state)
    return states


def test_clusters_one_by_one_are_the_whole_scan_at_once():
    """Twelve targets, some close together, some alone, one without any measurement near."""
    f = plane()
    rng = torch.Generator().manual_seed(3)
    mean = torch.cat([60 * torch.rand(12, 2, generator=rng), torch.randn(12, 2, generator=rng)], -1).double()
    mean[0, :2] = 500.0
    state = f.init(Gaussian(mean, torch.diag(torch.tensor([3.0, 3.0, 1.0, 1.0]).double()).expand(12, 4, 4)))
    z = torch.cat([mean[1:, :2] + 2, 60 * torch.rand(8, 2, generator=rng).double()])
    z[3] = math.nan
    frame = f._frames(check_step(f, state, Measurements(z)), 1)[0][0]
    whole, record = f.advance(state, frame)
    scene = torch.zeros(12, dtype=torch.int64)
    parts, log_missed, density, association, groups = filter_scan(
        f, state, scene, SceneScan(z[None], torch.ones(1).double(), None)
    )
    assert len({group.targets.shape[-1] for group in groups}) > 1
    for one, other in zip(tree.flatten(parts), tree.flatten(whole), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(log_missed, record.info.association[..., 0].log(), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(association, record.info.association[..., 1:], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(density, record.density, rtol=1e-9, atol=1e-9)


def test_the_estimate_goes_into_the_metrics_as_it_is():
    truth, z = moving(FOUR, 20)
    estimate = Targets(plane(), birth=TwoPoint(20.0))(with_clutter(z, 3, 150.0))
    gospa = metrics.gospa(estimate.mean, truth, WHERE, cutoff=30.0)
    assert (gospa.missed[8:] == 0).all()
    assert (gospa.localisation[8:] < 2 * 4).all()
    lives = metrics.lives(estimate.mean, truth, WHERE, cutoff=30.0)
    assert lives.switches.sum() == 0
    assert (lives.begun < 6).all()


def test_identities_are_never_used_again():
    _, z = moving([(0, 0, 5, 0)], 40)
    z[12:24] = math.nan
    states = run(Targets(plane(), birth=TwoPoint(20.0), confirmation=MOfN(2, 3), deletion=Deletion(3)), z)
    assert states[11].identity.tolist() == [0]
    assert states[20].identity.tolist() == []
    assert states[-1].identity.tolist() == [1]
    ahead = [s.next_identity.item() for s in states]
    assert ahead == sorted(ahead)


def test_a_scan_without_measurements_is_one_in_which_all_were_missed():
    targets = Targets(plane(), birth=TwoPoint(20.0), confirmation=MOfN(2, 2), deletion=Deletion(2))
    _, z = moving([(0, 0, 5, 0)], 3)
    for empty in (z[:1, :0].squeeze(0), torch.full((4, 2), math.nan).double()):
        state = run(targets, z)[-1]
        state = targets.step(state, empty)
        assert state.track.misses.tolist() == [1]
        expected = run(targets, z)[-1].track.score + math.log(1 - 0.9 * 0.9999)
        torch.testing.assert_close(state.track.score, expected)
        assert len(targets.step(state, empty).identity) == 0


@pytest.mark.slow
def test_a_target_whose_noise_has_grown_is_followed_in_any_order_of_the_rows():
    """The filter has learned a noise four times the nominal; a false measurement far away comes first or last."""
    f = presets.jpda(ConstantVelocity(1e-2), Position(5.0), clutter=Clutter(1e8, rate=1.0), inner=presets.iaukf)
    targets = Targets(f, birth=TwoPoint(60.0))
    steps = torch.arange(100.0).double()[:, None, None]
    truth, z = moving([(0, 0, 10, 3)], 100, std=5.0, seed=4)
    z = z + 3 * ((steps - 20) / 40).clamp(0, 1) * (z - truth[..., :2].transpose(0, 1))
    far = torch.tensor([3e4, -3e4]).double() + 1e3 * steps
    first, last = (run(targets, torch.cat(rows, 1))[-1] for rows in ((far, z), (z, far)))
    assert first.identity.tolist() == last.identity.tolist() == [0]
    assert first.track.misses[first.track.confirmed].tolist() == [0]
    assert torch.equal(first.confirmed.mean, last.confirmed.mean)


def test_scans_without_measurements_count_as_misses_of_a_lost_track():
    targets = Targets(plane(lost=1e-3), birth=TwoPoint(20.0), deletion=Deletion(20))
    states = [run(targets, moving([(0, 0, 5, 0)], 6)[1])[-1]] * 3
    empties = torch.zeros(0, 2).double(), torch.full((2, 2), math.nan).double(), torch.full((1, 2), 1e6).double()
    for _ in range(8):
        states = [targets.step(state, empty) for state, empty in zip(states, empties, strict=True)]
    assert states[0].filter.missed[0] > 8
    for state in states[1:]:
        torch.testing.assert_close(state.filter.missed[0], states[0].filter.missed[0])
        torch.testing.assert_close(state.belief.scale_tril[0], states[0].belief.scale_tril[0])


def test_a_saved_state_of_another_manager_is_refused():
    values = Targets(plane()).saved(Targets(plane()).init())
    with pytest.raises(ValueError, match="values: expected a state of"):
        Targets(plane(), confirmation=MOfN(2, 3)).restored(values)
    with pytest.raises(ValueError, match="values: expected format 4, received None"):
        Targets(plane()).restored({})


@pytest.mark.parametrize(("path", "value", "said"), [
    (("state",), [1.0], "expected what saved gives"),
    (("state", -2), torch.zeros(5).long(), "unassociated: expected as many rows"),
    (("past", 0), 3, "expected what saved gives"),
    (("past", 0, "sensor"), "radar", "sensor: expected one of none"),
    (("past", 1, "scan", "z"), torch.zeros(1, 2, 3).double(), "z: expected floating-point scans"),
    (("past", 1, "scan", "dt"), torch.tensor([-1.0]).double(), "dt: expected 0 s or more"),
])  # fmt: skip
def test_a_saved_state_of_another_form_is_refused(path, value, said):
    targets = Targets(plane(), lag=5.0)
    values = targets.saved(run(targets, moving(FOUR, 4)[1])[-1])
    targets.restored(values)
    *places, last = path
    functools.reduce(operator.getitem, places, values)[last] = value
    with pytest.raises(ValueError, match=f"values: {said}"):
        targets.restored(values)


def test_a_target_ends_when_nobody_knows_any_more_where_it_is():
    _, z = moving([(0, 0, 5, 0)], 6)
    options = {"birth": TwoPoint(20.0), "confirmation": MOfN(2, 2)}
    patient = Targets(plane(), deletion=Deletion(50), **options)
    state, spreads = run(patient, z)[-1], []
    for _ in range(12):
        state = patient.step(state, z[0, :0])
        spreads.append(torch.linalg.matrix_norm(state.belief.scale_tril[0, :2], 2).item())
    limit = (spreads[6] + spreads[7]) / 2
    targets = Targets(plane(), deletion=Deletion(50, spread=limit), **options)
    state = run(targets, z)[-1]
    there = []
    for _ in range(12):
        state = targets.step(state, z[0, :0])
        there.append(len(state.identity))
    assert there == [1] * 7 + [0] * 5


def test_rows_of_nan_and_their_order_change_nothing():
    targets, z = Targets(plane(), birth=TwoPoint(20.0)), with_clutter(moving(FOUR, 12)[1], 3, 150.0)
    padded = torch.cat([torch.full_like(z[:, :2], math.nan), z.flip(1)], 1)
    one, other = run(targets, z)[-1], run(targets, padded)[-1]
    rows = [int((other.confirmed.mean - mean).norm(dim=-1).argmin()) for mean in one.confirmed.mean]
    assert sorted(rows) == list(range(len(rows)))
    torch.testing.assert_close(one.confirmed.mean, other.confirmed.mean[rows])


def test_there_may_be_any_number_of_targets():
    side = 12
    starts = [(100.0 * i, 100.0 * j, 3.0, 1.0) for i in range(side) for j in range(side)]
    _, z = moving(starts, 9)
    f = presets.jpda(ConstantVelocity(0.5), Position(2.0), clutter=Clutter(1.5e6, rate=1.0), detection=0.9)
    states = run(Targets(f, birth=TwoPoint(20.0), deletion=Deletion(1)), [*z[:6], *z[6:, :2]])
    assert [len(s.identity) for s in states[4:]] == [side**2, side**2, 2, 2, 2]


def test_a_target_that_is_faster_than_any_ends():
    _, z = moving([(0, 0, 12.0, 0), (0, 50, 12.0, 9.0)], 12)
    for speed, count in ((13.0, 1), (16.0, 2)):
        states = run(Targets(plane(), birth=TwoPoint(20.0), deletion=Deletion(3, speed=speed)), z)
        assert len(states[-1].identity) == count


def test_two_tracks_of_one_target_become_one_and_targets_that_cross_stay_two():
    f, track = plane(), [(0.0, 0.0, 5.0, 0.0)]
    _, z = moving(track, 12)
    twice = torch.cat([z, z + 0.5], 1)  # as if seen by two devices, for the first five scans
    twice[5:, 1] = math.nan
    apart = run(Targets(f, birth=TwoPoint(20.0), confirmation=MOfN(2, 2)), twice)
    merged = run(Targets(f, birth=TwoPoint(20.0), confirmation=MOfN(2, 2), merging=Merging(1.0)), twice)
    assert len(apart[5].identity) == 2
    assert merged[5].identity.tolist() == [0]
    _, z = moving([(-60, 0, 5, 0), (0, -60, 0, 5)], 24)
    crossing = run(Targets(f, birth=TwoPoint(20.0), merging=Merging()), z)
    assert crossing[-1].identity.tolist() == [0, 1]


@pytest.mark.parametrize("birth", [OnePoint(60.0), TwoPoint(90.0)], ids=["one point", "two points"])
def test_aircraft_in_spherical_coordinates_begin_where_the_sensor_says(birth):
    scenario = scenarios.clutter_many(count=2, clutter=2)
    tracks = scenario.simulate(1, 3)
    f = presets.jpda(scenario.motion, scenario.sensor, clutter=scenario.clutter, detection=scenario.detection)
    estimate = scenario.cartesian(Targets(f, birth=birth)(tracks.z[:, 30:60]))  # both are there
    lives = metrics.lives(estimate.mean, tracks.truth[..., 30:60, :], scenario.truth_position)
    assert (lives.followed[0] >= 20).all()
    assert lives.switches.sum() == 0


class Turned(RangeBearing):
    """A radar whose bearings count from where it heads, the third entry of ``u``."""

    def forward(self, x, u=None):
        return super().forward(x, u) - u[..., 2:] * torch.tensor([0.0, 1.0]).to(x)


def test_a_sensor_that_u_turns_is_refused_by_births():
    f = presets.jpda(ConstantVelocity(0.1), Turned(torch.tensor([2.0, 0.002])), clutter=Clutter(1e6, rate=1.0))
    targets = Targets(f)
    with pytest.raises(ValueError, match="u: expected to tell no more than where the sensor stands"):
        targets.step(targets.init(), torch.tensor([[500.0, 1.0]]).double(), u=torch.tensor([0.0, 0.0, 0.3]).double())


@pytest.mark.parametrize("around", [
    lambda radar: radar, Stacked, lambda radar: Stacked(radar, inputs=[2]),
    lambda radar: Stacked(Position(2.0), radar),
], ids=["alone", "one of one", "with its own inputs", "beside positions"])  # fmt: skip
def test_a_radar_that_moves_says_where_targets_are(around):
    truth, _ = moving([(300.0, 400.0, 10.0, 5.0)], 12)
    sensor = around(RangeBearing(torch.tensor([2.0, 0.002]).double()))
    u = torch.stack([torch.arange(12.0) * 7, torch.full((12,), -50.0)], -1).double()
    z = sensor(truth[0], u).unsqueeze(1)
    f = presets.jpda(
        ConstantVelocity(0.1), sensor, clutter=Clutter(extent=[1e3, 6.0] * (sensor.size // 2), rate=1.0), detection=0.9
    )
    estimate = Targets(f, birth=TwoPoint(30.0))(z, u=u)
    assert (estimate.mean[0, 4:, :2] - truth[0, 4:, :2]).norm(dim=-1).max() < 1.0


@pytest.mark.parametrize("make", [
    lambda s, **o: presets.jpda(aircraft(0.5), s, inner=presets.gpb, **o),
    lambda s, **o: presets.jpda(aircraft(0.5), s, inner=presets.imm_srckf, **o),
    lambda s, **o: presets.jpda(ConstantAcceleration(0.5), s, inner=presets.rsrckf, **o),
    lambda s, **o: presets.iaukf_jpda(ConstantVelocity(0.5), s, **o),
], ids=["gpb", "imm", "robust", "noise estimated"])  # fmt: skip
def test_any_filter_of_scans_has_targets_that_come_and_go(make):
    f = make(Position(2.0), clutter=Clutter(9e4, rate=3.0), detection=0.9)
    truth, z = moving(FOUR, 10)
    estimate = Targets(f, birth=TwoPoint(20.0, more=2.0), merging=Merging())(with_clutter(z, 3, 150.0))
    gospa = metrics.gospa(estimate.mean, truth, WHERE, cutoff=30.0)
    assert (gospa.missed[-3:] == 0).all()


@pytest.mark.parametrize("make", [presets.srckf, presets.rsrckf, presets.imm_srckf])
def test_a_sensor_like_the_filters_own_says_the_same(make):
    _, z = moving(FOUR, 8)
    models = ConstantVelocity(0.5) if make is not presets.imm_srckf else [ConstantVelocity(0.5), ConstantVelocity(5.0)]
    f = presets.jpda(models, Position(2.0), clutter=Clutter(1e4, rate=2.0), detection=0.9, inner=make)
    targets = Targets(f, birth=TwoPoint(10.0), sensors={"other": f})
    own, other = run(targets, z), run(targets, z, sensor="other")
    assert len(own[-1].track.identity) == 4
    for a, b in zip(tree.flatten(own[-1]), tree.flatten(other[-1]), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["deepcopy", "pickle"])
@pytest.mark.parametrize("make", [presets.srckf, presets.gpb])
def test_a_copy_of_a_manager_with_several_sensors_goes_on_like_it(make, copied):
    _, z = moving(FOUR, 6)
    f = presets.jpda(ConstantVelocity(0.5), Position(2.0), clutter=Clutter(1e4, rate=2.0), detection=0.9, inner=make)
    targets = Targets(f, birth=TwoPoint(10.0), sensors={"other": f})
    state, other = run(targets, z)[-1], copied(targets)
    for name in (None, "other"):
        for a, b in zip(*(tree.flatten(x.step(state, z[-1], sensor=name)) for x in (targets, other)), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_sensors_that_cannot_have_the_same_targets_are_named():
    walk = presets.jpda(ConstantAcceleration(1.0), Position(2.0), clutter=Clutter(1e4, rate=2.0))
    with pytest.raises(ValueError, match="sensors: expected the motion of the targets, ConstantVelocity"):
        Targets(plane(), sensors={"other": walk})
    faded = presets.jpda(ConstantVelocity(0.5), Position(2.0), clutter=Clutter(1e4, rate=2.0), inner=presets.asrckf)
    with pytest.raises(ValueError, match="sensors: expected none beside fading factors"):
        Targets(faded, sensors={"other": plane()})


def test_missing_elements_are_marginalised_and_begin_nothing():
    _, z = moving([(0, 0, 5, 0)], 12)
    z[6:8, 0, 1] = math.nan
    states = run(Targets(plane(), birth=TwoPoint(20.0), deletion=Deletion(2)), z)
    assert states[-1].identity.tolist() == [0]
    assert states[-1].next_identity.item() == 1
    assert states[7].track.misses.tolist() == [0]


def test_gates_of_metres_and_soft_gates_are_gates_too():
    _, z = moving(FOUR, 10)
    for options in ({"gate": Euclidean(40.0)}, {"gate": ChiSquare(0.999), "temperature": 0.1}):
        estimate = Targets(plane(**options), birth=TwoPoint(20.0))(with_clutter(z, 3, 150.0))
        assert estimate.confirmed[:, -1].sum() == 4


@pytest.mark.slow
def test_a_compiled_filter_runs_compiled_and_leaves_the_same_targets():
    """Two that fly side by side, in a cluster, and one alone."""
    _, z = moving([(0, 0, 5, 0), (0, 9, 5, 0), (400, 0, 0, 4)], 12)
    z[5, 2] = z[8, 1] = math.nan
    plain = Targets(plane(gate=ChiSquare(0.9999)), birth=TwoPoint(10.0))
    quick = Targets(plane(gate=ChiSquare(0.9999)).compile(), birth=TwoPoint(10.0))
    slow, fast = run(plain, z)[-1], run(quick, z)[-1]
    assert len(slow.identity) == 3
    assert slow.identity.equal(fast.identity)
    for a, b in zip(tree.flatten(slow.filter), tree.flatten(fast.filter), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(slow.track.score, fast.track.score, rtol=1e-10, atol=1e-10)
    (version,) = quick.filter.engine._versions
    assert len(version.kernels) >= 3  # what to expect, clusters of one, clusters of two


def test_single_precision_stays_single():
    estimate = Targets(plane(), birth=TwoPoint(20.0))(with_clutter(moving(FOUR, 8)[1], 3, 150.0).float())
    assert estimate.mean.dtype == estimate.log_likelihood.dtype == torch.float32
    assert estimate.confirmed[:, -1].sum() == 4


def test_nothing_is_found_in_nothing():
    estimate = Targets(plane())(torch.full((2, 5, 3, 2), math.nan).double())
    assert estimate.mean.shape == (2, 0, 5, 4)
    assert estimate.identity.shape == (2, 0)
    assert estimate.log_likelihood.shape == (2, 0, 5)


def test_sequences_may_have_no_measurement_at_all():
    estimate = Targets(plane())(torch.zeros(2, 5, 0, 2).double())
    assert estimate.mean.shape == (2, 0, 5, 4)


def test_without_scipy_it_is_said_what_to_install(monkeypatch):
    for part in ("optimize", "sparse", "sparse.csgraph", "special"):
        monkeypatch.setitem(sys.modules, f"scipy.{part}", None)
    with pytest.raises(ImportError, match=r'targets needs the package scipy: pip install "torchfra\[assignment\]"'):
        run(Targets(plane()), moving(FOUR, 3)[1])


# ---------------------------------------------------------------- what does not fit is named


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Targets(presets.srckf(ConstantVelocity(1.0), Position(1.0))), "filter: expected a JPDA"),
    (lambda: Targets(plane(detection=torch.tensor([[0.9, 0.8]]))), "filter: expected hyperparameters"),
    (lambda: Targets(presets.jpda(ConstantVelocity(1.0, 3), Position(1.0), clutter=Clutter(1e4, rate=1.0))),
     "filter: expected a sensor that locates in 3 dimensions"),
    (lambda: Targets(presets.jpda(RandomWalk(1.0), Position(1.0), clutter=Clutter(1e4, rate=1.0))),
     "filter: expected a motion with position and velocity in its state, received RandomWalk"),
    (lambda: Targets(plane(), birth=MOfN()), "birth: expected a Birth"),
    (lambda: Targets(plane(), confirmation=3), "confirmation: expected a Confirmation"),
    (lambda: Targets(plane(), deletion=MOfN()), "deletion: expected a Deletion"),
    (lambda: Targets(plane(), merging=True), "merging: expected a Merging"),
    (lambda: Targets(plane(), birth_threshold=1.0), "birth_threshold: expected a probability"),
    (lambda: Targets(plane(detection=1.0, gate=Euclidean(10.0))), "filter: expected a detection below 1"),
    (lambda: Targets(plane(clutter=Clutter(1e4))), "expected clutter of a Poisson rate"),
    (
        lambda: Targets(plane(clutter=Clutter(1e4)), confirmation=MOfN(), deletion=Deletion(score_drop=0.1)),
        "Poisson rate",
    ),
    (lambda: OnePoint(0.0), "velocity: expected a finite number above 0"),
    (lambda: OnePoint(more=-1.0), "more: expected a finite number above 0"),
    (lambda: TwoPoint(math.inf), "speed: expected a finite number above 0"),
    (lambda: MOfN(4, 3), "m, n: expected whole numbers"),
    (lambda: MOfN(0, 3), "m, n: expected whole numbers"),
    (lambda: SPRT(0.6, 0.6), "false, missed: expected probabilities"),
    (lambda: SPRT(0.0), "false, missed: expected probabilities"),
    (lambda: Deletion(None), "misses, score_drop, spread, speed: expected at least one"),
    (lambda: Deletion(0), "misses: expected 1 scan or more"),
    (lambda: Deletion(score_drop=2.0), "score_drop: expected a probability"),
    (lambda: Deletion(speed=-1.0), "speed: expected a finite number above 0"),
    (lambda: Deletion(spread=0.0), "spread: expected finite metres above 0"),
    (lambda: Targets(plane(), birth_threshold="x"), "birth_threshold: expected a probability"),
    (lambda: OnePoint("x"), "velocity: expected a finite number above 0, received 'x'"),
    (lambda: OnePoint(torch.ones(2)), "velocity: expected a finite number above 0"),
    (lambda: MOfN(True, True), "m, n: expected whole numbers"),
    (lambda: SPRT("a"), "false, missed: expected probabilities"),
    (lambda: Deletion(score_drop="x"), "score_drop: expected a probability"),
    (lambda: Targets(plane()).init("a"), "scenes: expected 1 or more"),
    (lambda: Targets(plane()).init(1.5), "scenes: expected 1 or more"),
    (lambda: Targets(plane()).init(dtype=torch.float16), "dtype: expected torch.float32 or torch.float64"),
    (lambda: Merging(0.0), "distance: expected a finite number above 0"),
])  # fmt: skip
def test_arguments_that_do_not_fit_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_values_that_leave_no_misses_are_refused_when_they_are_set_later():
    targets = Targets(plane())
    targets.filter.detection.set(1.0)
    targets.filter.gate.probability.set(1.0)
    with pytest.raises(ValueError, match="filter: expected a detection below 1"):
        targets.step(targets.init(), torch.zeros(3, 2).double())


def test_a_sensor_that_does_not_locate_has_no_births():
    sensor = Bearings(0.01, stations=torch.tensor([[0.0, 0.0], [100.0, 0.0]]).double())
    f = presets.jpda(ConstantVelocity(1.0), sensor, clutter=Clutter(extent=[6.28, 6.28], rate=2.0))
    with pytest.raises(ValueError, match="filter: expected a sensor that measures where a target is"):
        Targets(f)


@pytest.mark.parametrize(("z", "options", "message"), [
    (torch.zeros(3, 3).double(), {}, r"z: expected floating-point scans \(J, m\)"),
    (torch.zeros(2).double(), {}, "z: expected floating-point scans"),
    (torch.zeros(2, 3, 2).double(), {}, "z: expected 1 scenes"),
    (torch.full((1, 2), math.inf).double(), {}, "z: expected finite measurements"),
    (torch.zeros(3, 2).double(), {"dt": -1.0}, "dt: expected finite seconds above 0"),
    (torch.zeros(3, 2).double(), {"sensor": "radar"}, "sensor: expected one of none, received 'radar'"),
    (torch.zeros(3, 2).double(), {"std": torch.ones(2)}, r"std: expected \(3, 2\), received \(2,\)"),
    (torch.zeros(3, 2).double(), {"std": torch.zeros(3, 2)}, "std: expected finite numbers above 0"),
    (torch.zeros(3, 2).double(), {"noise": torch.ones(3, 2)}, r"noise: expected \(3, 2, 2\), received \(3, 2\)"),
    (torch.zeros(3, 2).double(), {"dt": math.nan}, "dt: expected finite seconds above 0"),
    (torch.zeros(3, 2).double(), {"dt": "x"}, "dt: expected numbers, received 'x'"),
    (torch.zeros(3, 2).double(), {"dt": None}, "dt: expected numbers, received None"),
    (torch.zeros(3, 2).double(), {"dt": torch.ones(3)}, r"dt: expected a number or \(1,\)"),
    (torch.zeros(3, 2).double(), {"u": torch.full((2,), math.nan)}, "u: expected finite numbers"),
    (torch.zeros(3, 2).double(), {"u": torch.zeros(4, 2)}, "u: expected"),
])  # fmt: skip
def test_scans_that_do_not_fit_are_named(z, options, message):
    targets = Targets(plane())
    with pytest.raises(ValueError, match=message):
        targets.step(targets.init(), z, **options)


def test_a_measurement_that_single_precision_cannot_hold_is_refused_with_the_largest_that_it_can():
    targets = Targets(plane())
    wide = torch.tensor([[1e300, 0.0]], dtype=torch.float64)
    for z, dtype in ((wide.float(), torch.float64), (wide, torch.float32)):
        with pytest.raises(ValueError, match=r"z: expected finite .* \(the largest number of float32 is 3\.4e\+38\)"):
            targets.step(targets.init(dtype=dtype), z)
    assert targets.step(targets.init(), wide).belief.mean.isfinite().all()


def test_sequences_and_states_that_do_not_fit_are_named():
    targets = Targets(plane())
    with pytest.raises(ValueError, match=r"z: expected floating-point scans \(..., T, J, m\)"):
        targets(torch.zeros(3, 2).double())
    with pytest.raises(ValueError, match="z: expected one scene and one scan or more"):
        targets(torch.zeros(0, 3, 2).double())
    with pytest.raises(ValueError, match=r"dt: expected a number or \(5,\)"):
        targets(torch.zeros(5, 3, 2).double(), dt=torch.ones(4))
    with pytest.raises(ValueError, match="state: expected what init or step has returned"):
        targets.step(None, torch.zeros(3, 2).double())
    with pytest.raises(ValueError, match="states: expected one or more, of 2 scenes"):
        collect([targets.init()], (2,))
    with pytest.raises(ValueError, match="states: expected what step has returned, received int"):
        collect([1, 2])
    with pytest.raises(ValueError, match="state: expected hits of the last 1 scans"):
        targets.step(Targets(plane(), confirmation=MOfN(2, 3)).init(), torch.zeros(3, 2).double())
    with pytest.raises(ValueError, match="z: expected floating-point scans"):
        targets(torch.zeros(5, 3, 2).half())
    with pytest.raises(ValueError, match="states: expected one or more"):
        collect([])
    with pytest.raises(ValueError, match="scenes: expected 1 or more"):
        targets.init(0)
