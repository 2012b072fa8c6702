"""Ranges from anchors: what the sensor measures, how filters use it, and recorded ranges as a scenario."""

import copy
import math

import numpy as np
import pytest
import torch

from torchfra import metrics, presets, readers, scenarios
from torchfra.catalogue import filters_for, scenario_filters
from torchfra.evaluation import evaluate
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.sensors import Ranges
from torchfra.types import Gaussian


def tensor(*rows):
    return torch.tensor(rows, dtype=torch.float64)


ANCHORS = tensor([0, 0, 2], [6, 0, 2], [6, 8, 1], [0, 8, 1])
PRIOR = Gaussian(tensor(3.0, 3.0, 0, 0, 0, 0), torch.eye(6, dtype=torch.float64))


def walk(steps=40, dt=0.1):
    """Positions on a circle of 2 m at 1 m/s."""
    angle = dt * torch.arange(steps, dtype=torch.float64) / 2
    return torch.stack([3 + 2 * angle.cos(), 4 + 2 * angle.sin()], -1)


# ---------------------------------------------------------------- the sensor


def test_ranges_are_distances_in_the_plane_in_space_and_at_a_known_height():
    plane = Ranges(tensor([0, 0], [3, 0]), 0.1)
    torch.testing.assert_close(plane(tensor([0, 4, 9], [3, 4, 9])), tensor([4, 5], [5, 4]))
    space = Ranges(tensor([0, 0, 0], [3, 0, 1]), 0.1)
    torch.testing.assert_close(space(tensor(2, 3, 6)), tensor(7, math.sqrt(1 + 9 + 25)))
    above = Ranges(tensor([0, 0, 0], [3, 0, 1]), 0.1, height=6.0)
    torch.testing.assert_close(above(tensor(2, 3, 99)), tensor(7, math.sqrt(1 + 9 + 25)))
    assert (plane.dims, space.dims, above.dims) == (2, 3, 2)
    assert Ranges(tensor([0], [5]), 0.1)(tensor(2)).tolist() == [2, 3]


def test_anchors_may_come_with_each_step_and_each_track():
    x = torch.rand(5, 2, dtype=torch.float64)
    places = ANCHORS + torch.arange(5, dtype=torch.float64)[:, None, None]
    moving = Ranges(count=4, std=0.1, height=0.5)(x, places.flatten(1))
    each = torch.stack([Ranges(a, 0.1, height=0.5)(row) for a, row in zip(places, x, strict=True)])
    torch.testing.assert_close(moving, each)
    torch.testing.assert_close(Ranges(count=4, std=0.1)(x, places[..., :2].flatten(1)),
                               (x[:, None] - places[..., :2]).norm(dim=-1))  # fmt: skip
    torch.testing.assert_close(Ranges(count=4, std=0.1, dims=3)(torch.cat([x, x], -1), places.flatten(1)),
                               (torch.cat([x, x], -1)[:, None, :3] - places).norm(dim=-1))  # fmt: skip


def test_every_range_comes_from_a_device_of_its_own():
    assert Ranges(ANCHORS, 0.1).blocks == ((0,), (1,), (2,), (3,))
    estimate = presets.iaukf(ConstantAcceleration(0.3), Ranges(ANCHORS[:, :2], 0.1), confidence=torch.ones(4) * 0.9)
    assert estimate(torch.full((5, 4), 5.0), PRIOR).mean.isfinite().all()


def test_gradients_are_those_of_finite_differences_and_zero_on_an_anchor():
    x = torch.rand(3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(Ranges(ANCHORS, 0.1, height=0.5), x)
    assert torch.autograd.gradgradcheck(Ranges(ANCHORS[:, :2], 0.1), x)
    on = tensor(0, 0).requires_grad_()
    away = Ranges(tensor([0, 0], [3, 4]), 0.1)(on)
    assert away.tolist() == [0, 5]
    away.sum().backward()
    torch.testing.assert_close(on.grad, tensor(-0.6, -0.8))
    assert Ranges(ANCHORS, 0.1, height=0.5)(tensor(math.nan, 0)).isnan().all()


def test_values_learned_with_some_anchors_go_to_others():
    learned = presets.rsrckf(ConstantAcceleration(0.3), Ranges(ANCHORS, 0.4, height=0.5))
    other = presets.rsrckf(ConstantAcceleration(0.1), Ranges(ANCHORS[:3] + 1, 0.1, height=0.0))
    other.load_state_dict(learned.state_dict())
    assert other.sensor.std().item() == pytest.approx(0.4)
    torch.testing.assert_close(other.sensor.anchors, ANCHORS[:3] + 1)


@pytest.mark.slow
def test_where_anchors_move_a_compiled_filter_gives_the_same_and_follows_the_target():
    truth = walk().expand(3, -1, -1)
    rng = torch.Generator().manual_seed(1)
    sensor = Ranges(count=4, std=0.15, height=0.5)
    u = ANCHORS.flatten().expand(40, -1)
    z = sensor(truth, u.expand(3, -1, -1))
    z = z + 0.15 * torch.randn(z.shape, dtype=torch.float64, generator=rng)
    z[1, 10:20, 2] = math.nan
    f = presets.rsrckf(ConstantAcceleration(0.3), sensor)
    with torch.no_grad():
        slow, fast = (g(z, PRIOR, u=u, dt=0.1).mean for g in (f, copy.deepcopy(f).compile()))
    torch.testing.assert_close(fast, slow, rtol=0, atol=1e-11)
    assert metrics.track_rmse(slow, truth, slice(0, 2))[:, None].max() < 0.3


def test_a_range_does_not_locate():
    sensor = Ranges(ANCHORS, 0.15, height=0.5)
    assert not sensor.locates
    with pytest.raises(ValueError, match=r"received ranges from 4 anchors at a height of 0\.5 m"):
        sensor.locate(tensor(1, 1, 1, 1))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "anchors, count: expected exactly one of the two, received None, None"),
        ({"anchors": ANCHORS, "count": 4}, "anchors, count: expected exactly one"),
        ({"count": 0}, "count: expected 1 or more anchors, received 0"),
        ({"anchors": torch.zeros(4)}, r"anchors: expected finite positions \(m, 2\) or \(m, 3\), received \(4,\)"),
        ({"anchors": torch.zeros(2, 4)}, r"received \(2, 4\)"),
        ({"anchors": torch.zeros(0, 2)}, r"received \(0, 2\)"),
        ({"anchors": tensor([0, math.nan])}, r"received \[\[0.0, nan\]\]"),
        ({"anchors": ANCHORS, "height": math.inf}, "height: expected finite metres, for states in the plane"),
        ({"anchors": ANCHORS, "height": 1.0, "dims": 3}, "height: expected .* received 1.0, dims 3"),
        ({"anchors": ANCHORS[:, :2], "height": 1.0}, r"anchors: expected \(m, 3\) of anchors in space with a height"),
        ({"anchors": ANCHORS, "dims": 2}, r"anchors: expected \(m, 2\), received \(m, 3\) and height None"),
        ({"count": 3, "dims": 4}, "dims: expected 1, 2 or 3, received 4"),
        ({"anchors": ANCHORS, "std": torch.ones(3)}, r"std: expected a number or \(\.\.\., 4\)"),
        ({"anchors": ANCHORS, "std": -1.0}, "std: expected a value above 0"),
    ],
)
def test_what_does_not_fit_a_sensor_is_named(options, said):
    with pytest.raises(ValueError, match=said):
        Ranges(**{"std": 0.1} | options)


def test_what_does_not_fit_a_filter_is_named():
    with pytest.raises(ValueError, match="sensor: expected one of at most 2 dimensions of space, received 3"):
        presets.srckf(ConstantVelocity(1.0), Ranges(ANCHORS, 0.1))
    f = presets.srckf(ConstantAcceleration(1.0), Ranges(count=4, std=0.1, height=0.0))
    for u, said in ((None, "None"), (torch.zeros(5, 8, dtype=torch.float64), r"\(.*8\)")):
        with pytest.raises(ValueError, match=rf"u: expected .* of 4 anchors, \(\.\.\., 12\), received {said}"):
            f(torch.ones(5, 4, dtype=torch.float64), PRIOR, u=u)


# ---------------------------------------------------------------- the simulated walks


def test_walks_are_those_of_someone_who_walks():
    scenario = scenarios.ranges_outliers()
    truth = scenario.simulate(64, 3).truth
    position, velocity, push = truth.split(2, -1)
    assert (position.amin((0, 1)) > tensor(-1, -6)).all()
    assert (position.amax((0, 1)) < tensor(51, 6)).all()
    speed = velocity.norm(dim=-1)
    assert 0.8 < speed.median() < 1.2
    assert speed.max() <= 1.6
    assert (speed < 0.05).double().mean() > 0.01
    assert push.norm(dim=-1).max() <= 2 + 1e-9
    moved = scenario.motion(truth[:, :-1], torch.tensor(scenario.dt).double().expand(64, 999))
    torch.testing.assert_close(moved[..., :4], truth[:, 1:, :4])


@pytest.mark.parametrize(("outliers", "side"), [("short", {-1.0}), ("nlos", {1.0}), ("both", {-1.0, 1.0})])
def test_outliers_come_in_runs_of_one_anchor_with_the_same_offset(outliers, side):
    calm, wild = (scenarios.ranges_outliers(o, missing=0.0).simulate(100, 5) for o in ("none", outliers))
    offset = wild.z - calm.z
    off = offset != 0
    assert off.double().mean() == pytest.approx(0.005, rel=0.1)
    assert set(offset[off].sign().tolist()) == side
    whole = wild.z > 0.1
    assert offset[off & whole].abs().mean() == pytest.approx(8.0, rel=0.15)
    inside = (off[:, 1:] & off[:, :-1]) & whole[:, 1:] & whole[:, :-1]
    same = (offset[:, 1:] - offset[:, :-1]).abs()[inside] < 1e-9
    assert same.double().mean() > 0.97  # else another run follows at once
    begins = off & ~torch.nn.functional.pad(off[:, :-1], (0, 0, 1, 0))
    assert off.sum() / begins.sum() == pytest.approx(3.0, rel=0.05)


def test_a_share_of_the_ranges_is_missing_and_the_others_have_the_stated_noise():
    scenario = scenarios.ranges_outliers("none")
    tracks = scenario.simulate(50, 5)
    assert tracks.z.isnan().double().mean() == pytest.approx(0.1, rel=0.1)
    error = tracks.z - scenario.sensor(tracks.truth)
    seen = ~error.isnan()
    assert error[seen].std().item() == pytest.approx(0.15, rel=0.02)
    off = (tracks.prior.mean - tracks.truth[:, 0])[:, :4]  # of which a step moves 2 cm and 0.2 m/s at most
    assert off.std().item() == pytest.approx(1.0, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("anchors", ["together", "around"])
def test_a_robust_filter_keeps_the_walker_where_the_plain_one_is_thrown_off(anchors):
    scenario = scenarios.ranges_outliers(anchors=anchors)
    tracks = scenario.simulate(20, 1)
    error = {}
    for name, f in scenario_filters(["srckf", "rsrckf"], scenario).items():
        with torch.no_grad():
            mean = f(tracks.z, tracks.prior, dt=scenario.dt).mean
        error[name] = metrics.track_rmse(mean, tracks.truth, scenario.position)
    assert error["rsrckf"].max() < 2.0
    assert error["srckf"].mean() > 2 * error["rsrckf"].mean()


def test_losses_count_from_20_metres():
    scenario = scenarios.recorded_ranges([recording()])
    assert scenario.limit == scenarios.ranges_outliers().limit == 20.0
    assert scenarios.bearings_outliers().limit == 2000.0
    far = presets.rsrckf(scenario.motion, Ranges(ANCHORS + 30, 0.15, height=0.5))  # thinks that it is elsewhere
    assert evaluate(scenario, {"far": far}, runs=1)["far"]["divergence_rate"] == 1.0
    assert evaluate(scenario, {"far": far}, runs=1, limit=1e6)["far"]["divergence_rate"] == 0.0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"outliers": "std"}, r"outliers: expected one of \('short', 'nlos', 'both', 'none'\), received 'std'"),
        ({"anchors": "far"}, r"anchors: expected one of \('together', 'around'\), received 'far'"),
        ({"share": 1.0}, "share: expected a share from 0 to below 1, received 1.0"),
        ({"missing": -0.1}, "missing: expected a share from 0 to below 1, received -0.1"),
        ({"size": 0.0}, "size, length: expected a size above 0 m and a length of 1 step or more, received 0.0, 3"),
        ({"length": 0}, "size, length: expected a size above 0 m and a length of 1 step or more, received 8.0, 0"),
    ],
)
def test_what_does_not_fit_the_simulated_walks_is_named(options, said):
    with pytest.raises(ValueError, match=said):
        scenarios.ranges_outliers(**options)


# ---------------------------------------------------------------- recorded ranges


def recording(name="a", steps=120, anchors=ANCHORS, height=0.5, **more):
    """A walk of some seconds at 10 Hz, with ranges that come a little late."""
    time = 1.7e9 + 0.1 * np.arange(steps)
    path = walk(steps).numpy()
    level = np.full((steps, 1), height)
    ranges = Ranges(anchors, 0.1, height=height)(torch.from_numpy(path)) if anchors.shape[1] == 3 else (
        Ranges(anchors, 0.1)(torch.from_numpy(path)))  # fmt: skip
    names = tuple(f"A{i}" for i in range(len(anchors)))
    reference = readers.Recording(name, time, np.concatenate([path, level], 1), None, {})
    late = tuple(time + 0.01 * i for i in range(len(anchors)))
    fields = {"times": late, "ranges": tuple(ranges.numpy().T), "reference": reference}
    return readers.RangeRecording(name, names, anchors.numpy(), **fields | more, repairs={})


def test_run_i_is_recording_i_whatever_the_seed():
    scenario = scenarios.recorded_ranges([recording(), recording("b", 60, ANCHORS[:3])])
    tracks, other = scenario.simulate(2, 0), scenario.simulate(2, 7)
    torch.testing.assert_close(tracks.z, other.z, rtol=0, atol=0, equal_nan=True)
    assert tracks.z.shape == (2, 120, 4)
    assert not tracks.z[0].isnan().any()
    assert tracks.z[1, 60:].isnan().all()
    assert tracks.z[1, :, 3].isnan().all()
    assert tracks.truth[1, 60:].isnan().all()
    torch.testing.assert_close(scenario.simulate(1, first=1).z[0], tracks.z[1], rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(tracks.prior.mean[:, :2], tracks.truth[:, 0, :2])
    torch.testing.assert_close(tracks.truth[0, 1:-1, 2:4].norm(dim=-1), torch.ones(118).double(), rtol=1e-3, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize(("anchors", "names"), [(ANCHORS, None), (ANCHORS[:, :2], ["srckf"])], ids=["space", "plane"])
def test_every_filter_finds_the_path_again(anchors, names):
    scenario = scenarios.recorded_ranges([recording(anchors=anchors), recording("b", 60, anchors)])
    tracks = scenario.simulate(2, 0)
    for name, f in scenario_filters(names or filters_for(scenario), scenario).items():
        with torch.no_grad():
            estimate = f(tracks.z[:, :60], tracks.prior, u=tracks.u[..., :60, :], dt=scenario.dt)
        lost = metrics.diverged(estimate.mean, tracks.truth[:, :60], scenario.position, scenario.limit)
        error = metrics.track_rmse(estimate.mean, tracks.truth[:, :60], scenario.position)
        assert not lost.any(), name
        assert error.max() < 0.3, (name, error)


def test_the_height_of_the_path_is_its_median_unless_given():
    one = recording(height=0.5)
    for options in ({}, {"height": 0.5}):
        tracks = scenarios.recorded_ranges([one], **options).simulate(1)
        torch.testing.assert_close(tracks.u[0, 7].view(4, 3), ANCHORS - tensor(0, 0, 0.5))
    higher = scenarios.recorded_ranges([one], height=1.5).simulate(1).u
    torch.testing.assert_close(higher[0, 7].view(4, 3), ANCHORS - tensor(0, 0, 1.5))


@pytest.mark.parametrize(
    ("recordings", "options", "said"),
    [
        ([], {}, "recordings: expected one or more, received none"),
        ([recording(reference=None)], {}, "recordings: expected a reference path for each, received none for a"),
        (
            [recording(anchors=ANCHORS[:, :2])],
            {"height": 1.0},
            "height: expected anchors in space beside it, received 1.0",
        ),
        ([recording()], {"dt": 0.0}, "dt: expected seconds above 0, received 0.0"),
        ([recording()], {"dt": 60.0}, "recordings: expected 2 steps or more of 60 s, received 1 for a"),
        ([recording()], {"std": 0.0}, "std: expected a value above 0"),
        ([recording()], {"q": -1.0}, "q: expected"),
    ],
)
def test_what_does_not_fit_recorded_ranges_is_named(recordings, options, said):
    with pytest.raises(ValueError, match=said):
        scenarios.recorded_ranges(recordings, **options)


def test_a_path_without_height_needs_one_given():
    one = recording()
    flat = readers.Recording("a", one.reference.time, one.reference.position[:, :2], None, {})
    with pytest.raises(ValueError, match=r"height: expected metres, as the path of a has no z, received None"):
        scenarios.recorded_ranges([recording(reference=flat)])
    scenarios.recorded_ranges([recording(reference=flat)], height=0.5)


def test_what_was_repaired_is_among_the_settings():
    first = recording()
    times = (np.sort(np.append(first.times[0], first.times[0][5] + 0.001)), *first.times[1:])
    ranges = (np.insert(first.ranges[0], 5, 3.0), *first.ranges[1:])
    scenario = scenarios.recorded_ranges([first, recording("b", times=times, ranges=ranges)])
    assert scenario.settings["repairs"] == [{}, {"ranges dropped for a later one in the same step": 1}]


@pytest.mark.parametrize(
    ("wrong", "kind"),
    [(["a.csv"], "str"), ("a.csv", "str"), (recording(), "RangeRecording")],
    ids=["files", "file", "one"],
)
def test_what_is_no_list_of_recorded_ranges_is_refused(wrong, kind):
    said = rf"recordings: expected a list of what torchfra\.readers\.read_ranges returns, received {kind}"
    with pytest.raises(TypeError, match=said):
        scenarios.recorded_ranges(wrong)
