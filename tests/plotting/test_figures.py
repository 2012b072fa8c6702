"""Figures of comparisons hold what a reader asks for, whatever the filters did; labels never cover each other."""

import numpy as np
import pytest
import torch
from benchmarks.scaling import figure_of
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.text import Text
from papers import figures
from scipy.optimize import least_squares

from torchfra import plotting, presets
from torchfra.catalogue import make_scenario, scenario_filters
from torchfra.evaluation import leaders, mapped_run, measure, results_of
from torchfra.evaluation.fixes import deviations, fixes
from torchfra.evaluation.mapped_run import OUTLYING, typical_run
from torchfra.pictures import APART
from torchfra.plotting.labels import spread_apart
from torchfra.readers import Recording
from torchfra.scenarios import recorded

LIMIT, STEPS = 2000.0, 50


def result(error, spread=2.0, diverged=0):
    """A result of evaluate as far as the figure needs it: errors around one number."""
    rmse = (error * np.linspace(1 / spread, 1, STEPS)).tolist()
    quantiles = {"p05_track_rmse": error / spread, "median_track_rmse": error, "p95_track_rmse": error * spread,
                 "worst_track": error * spread**2 if not diverged else 1e9}  # fmt: skip
    return {"rmse_position": rmse, "mean_rmse_position": float(np.mean(rmse)), "diverged": diverged, **quantiles}


@pytest.fixture(scope="module")
def bearings():
    """Scenario 1 from a good prior: eight runs through three filters, and a flight."""
    scenario = make_scenario("bearings-outliers", initial="truth")
    filters = scenario_filters(["srckf", "rmckf", "rsrckf"], scenario)
    metrics = measure(scenario, filters, runs=8)
    mapped = mapped_run(scenario, filters, [metrics[name].errors() for name in ("srckf", "rmckf")], 0)
    return scenario, results_of(metrics, filters, scenario, 8), mapped


def panels(figure):
    return {axes.get_label(): axes for axes in figure.axes}


def texts(axes):
    return [text.get_text() for text in axes.texts]


def boxes(axes):
    """Of the words in and beside the axes, in pixels, without the thin lines to what they name."""
    axes.figure.draw_without_rendering()
    return [Text.get_window_extent(text) for text in axes.texts]


def overlap(boxes):
    return [(a, b) for i, a in enumerate(boxes) for b in boxes[:i] if a.overlaps(b)]


# ---------------------------------------------------------------- one figure of three panels


@pytest.mark.slow
def test_a_comparison_has_a_map_all_runs_and_errors_over_time(bearings):
    scenario, results, mapped = bearings
    figure = plotting.comparison(results, list(results), scenario.dt, LIMIT, "title", mapped)
    assert panels(figure).keys() == {"map", "runs", "time"}
    assert {"truth", "measured", "srckf", "rmckf", "rsrckf"} <= set(texts(panels(figure)["map"]))
    assert not any(axes.get_legend() for axes in figure.axes)
    assert overlap(boxes(panels(figure)["map"])) == []


def test_rows_are_sorted_by_the_median_with_the_best_on_top():
    results = {f"f{i}": result(error) for i, error in enumerate((30.0, 10.0, 500.0, 20.0))}
    axes = panels(plotting.comparison(results, ["f0"], 1.0, LIMIT, ""))["runs"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["f2", "f0", "f3", "f1"]
    dots = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "o"]
    assert dots == [500.0, 30.0, 20.0, 10.0]
    assert axes.get_xscale() == "log"


def test_lost_runs_are_counted_beside_their_filter_and_leave_the_axis_where_errors_can_be_read():
    results = {"good": result(20.0), "lost": result(25.0, diverged=3), "nan": result(float("nan"), diverged=8)}
    axes = panels(plotting.comparison(results, list(results), 1.0, LIMIT, ""))["runs"]
    assert texts(axes) == ["8 diverged", "3 diverged"]
    low, high = axes.get_xlim()
    assert 5 < low < 10
    assert high < 3 * LIMIT
    beyond = [line for line in axes.lines if line.get_marker() == ">"]
    assert len(beyond) == 2
    assert all(line.get_xdata()[0] <= high for line in axes.lines if line.get_marker() == "o")


def test_as_many_lines_over_time_as_asked_for_each_with_its_name_and_a_colour_of_its_own():
    results = {f"filter {i}": result(20.0 + 0.01 * i) for i in range(22)}
    shown = list(results)[:5]
    axes = panels(plotting.comparison(results, shown, 2.0, LIMIT, ""))["time"]
    assert len(axes.lines) == len({line.get_color() for line in axes.lines}) == 5
    assert sorted(texts(axes)) == sorted(shown)
    assert axes.lines[0].get_xdata()[-1] == 2.0 * STEPS
    assert overlap(boxes(axes)) == []
    assert len(set(APART)) == len(APART)


@pytest.mark.parametrize(("error", "others"), [(float("nan"), 0), (float("inf"), 3), (0.0, 3), (1e12, 0)])
def test_no_error_breaks_the_figure(error, others, tmp_path):
    broken = result(error, diverged=0 if error == 0 else 4)
    results = {"broken": broken} | {f"f{i}": result(20.0 * (i + 1)) for i in range(others)}
    shown = leaders(results)
    figure = plotting.comparison(results, shown, 1.0, LIMIT, "")
    for axes, limits in ((panels(figure)["runs"], "get_xlim"), (panels(figure)["time"], "get_ylim")):
        low, high = getattr(axes, limits)()
        assert 0 < low < high < 3 * LIMIT
    assert set(texts(panels(figure)["time"])) == set(shown)
    assert plotting.save(figure, tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_filter_that_failed_leaves_the_map_of_the_others(bearings):
    _, results, mapped = bearings
    nothing = torch.full_like(mapped.truth, torch.nan)
    estimates = mapped.estimates | {"srckf": nothing, "rsrckf": nothing + torch.inf}
    figure = plotting.comparison(results, list(results), 1.0, LIMIT, "", mapped._replace(estimates=estimates))
    named = texts(panels(figure)["map"])
    assert {"truth", "rmckf"} <= set(named)
    assert "srckf" not in named
    assert "rsrckf" not in named


def test_where_the_position_has_one_dimension_there_is_no_map():
    scenario = make_scenario("growth")
    filters = scenario_filters(["ukf"], scenario)
    assert mapped_run(scenario, filters, [], 0, 0) is None
    figure = plotting.comparison({"ukf": result(5.0)}, ["ukf"], 1.0, LIMIT, "")
    assert panels(figure).keys() == {"runs", "time"}


@pytest.mark.slow
def test_several_targets_in_clutter_are_on_one_map():
    scenario = make_scenario("clutter-crossing")
    mapped = mapped_run(scenario, scenario_filters(["ukf_jpda"], scenario), [torch.arange(1.0, 7.0)], 0)
    steps = len(mapped.time)
    assert mapped.truth.shape == mapped.estimates["ukf_jpda"].shape == (2, steps, 2)
    assert mapped.fixes.shape[:2] == mapped.outlying.shape
    figure = plotting.comparison({"ukf_jpda": result(5.0)}, ["ukf_jpda"], 1.0, LIMIT, "", mapped)
    assert {"truth", "measured", "ukf_jpda"} == set(texts(panels(figure)["map"]))


@given(st.lists(st.floats(-1, 2), min_size=1, max_size=12), st.floats(0.01, 0.3))
@settings(deadline=None, max_examples=60)
def test_labels_are_pushed_apart_no_more_than_they_must(places, gap):
    spread = spread_apart(places, gap)
    order = np.argsort(places, kind="stable")
    steps = np.diff(np.array(spread)[order])
    room = min(gap, 1.0 / max(len(places) - 1, 1))
    assert (steps >= room - 1e-9).all()
    assert min(spread) >= -1e-9
    assert max(spread) <= 1 + 1e-9
    wide = np.diff(np.array(places)[order])
    if (wide >= gap).all() and min(places) >= 0 and max(places) <= 1:
        np.testing.assert_allclose(spread, places, atol=1e-12)


def test_times_have_a_panel_for_each_size_of_a_job_whose_axis_is_logarithmic_where_sizes_are_far_apart():
    figure = figure_of({"batch": [(1, 9.0), (1000, 2.0)], "states": [(2, 3.0), (8, 5.0)]}, "title")
    assert [axes.get_xlabel() for axes in figure.axes] == ["batch", "states"]
    assert [axes.get_xscale() for axes in figure.axes] == ["log", "linear"]
    assert all(axes.get_yscale() == "log" for axes in figure.axes)
    assert figure.axes[1].lines[0].get_ydata().tolist() == [3.0, 5.0]


# ---------------------------------------------------------------- which filters, which run


def test_leaders_are_the_first_the_baseline_own_ones_and_the_best_others_without_copies():
    errors = {"ukf": 40.0, "ekf": 40.0, "srckf": 45.0, "fra": 30.0, "rsrckf": 20.0, "rmckf": float("nan"), "mr_ckf": 20}
    results = {name: result(error) for name, error in errors.items()}
    assert leaders(results) == ["ukf", "srckf", "rsrckf", "fra", "rmckf"]
    assert leaders(results, 3) == ["ukf", "srckf", "rsrckf"]
    assert leaders(results | {"learned": result(99.0)}, 3) == ["ukf", "srckf", "learned"]
    assert leaders({"fra": result(1.0)}) == ["fra"]


def test_the_typical_run_is_one_of_the_middle_runs():
    scenario = make_scenario("bearings-outliers")
    first, second = torch.ones(200), torch.arange(200.0)
    second[0] = torch.inf
    assert 85 <= typical_run(scenario, [first, second], 0) <= 115
    assert 85 <= typical_run(scenario, [second], 0) <= 115
    nothing = torch.full((3,), torch.nan)
    assert typical_run(scenario, [nothing, nothing], 0) in range(3)


def test_a_flight_is_the_run_of_that_number(bearings):
    scenario, _, _ = bearings
    mapped = mapped_run(scenario, scenario_filters(["srckf"], scenario), [], 5, 3)
    tracks = scenario.simulate(4, 5)
    part = slice(int(mapped.time[0]) - 1, int(mapped.time[-1]))
    torch.testing.assert_close(mapped.truth[0], tracks.truth[3, part, :2])
    estimate = presets.srckf(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
    torch.testing.assert_close(mapped.estimates["srckf"][0], estimate.mean[3, part, :2].detach())


# ---------------------------------------------------------------- positions that measurements imply


def straight(sensor):
    """A recorded straight flight of 60 steps, without outliers."""
    time = 5.0 * np.arange(61)
    recording = Recording("a", time, np.stack([80 * time, 30 * time], 1), None, {})
    return recorded([recording], sensor, steps=60, outliers="none")


def test_two_bearings_imply_where_they_cross():
    scenario = straight("bearings")
    tracks = scenario.simulate(2, 0)
    found = fixes(scenario, tracks)[:, :, 0]
    one, two = tracks.u.unflatten(-1, (2, 2)).unbind(-2)
    way, other = (torch.stack([angle.sin(), angle.cos()], -1) for angle in tracks.z.unbind(-1))
    along = torch.linalg.solve(torch.stack([way, -other], -1), (two - one))[..., :1]
    torch.testing.assert_close(found, one + along * way, rtol=1e-9, atol=1e-5)


def test_range_and_bearing_imply_the_polar_fix_and_a_position_itself():
    radar, position = straight("radar"), straight("position")
    tracks = radar.simulate(2, 0)
    torch.testing.assert_close(fixes(radar, tracks)[:, :, 0], tracks.u + radar.sensor.locate(tracks.z))
    tracks = position.simulate(2, 0)
    torch.testing.assert_close(fixes(position, tracks)[:, :, 0], tracks.z)


def test_ranges_imply_the_position_of_the_least_squares_whatever_is_missing_or_short():
    scenario = make_scenario("ranges-outliers")
    tracks = scenario.simulate(1, 0)
    z = tracks.z[:, :8].clone()
    z[0, :, :] = scenario.sensor(tracks.truth[:, :8])[0]
    z[0, 2, 1] = torch.nan
    z[0, 3, 2] -= 3.0
    z[0, 4] = torch.nan
    found = fixes(scenario, tracks._replace(z=z, truth=tracks.truth[:, :8]))[0, :, 0]
    assert found[4].isnan().all()
    exact = [0, 1, 2, 5, 6, 7]
    torch.testing.assert_close(found[exact], tracks.truth[0, exact, :2])
    state = tracks.truth[0, 3].numpy()

    def residual(place):
        return (scenario.sensor(torch.tensor([*place, *state[2:]])) - z[0, 3]).numpy()

    expected = least_squares(residual, state[:2], xtol=1e-12, ftol=1e-12, gtol=1e-12).x
    np.testing.assert_allclose(found[3].numpy(), expected, atol=1e-4)
    assert np.linalg.norm(expected - state[:2]) > 0.5


def test_what_implies_no_position_is_nan():
    scenario = straight("bearings")
    tracks = scenario.simulate(1, 0)
    z = tracks.z.clone()
    z[0, 3, 0] = torch.nan
    z[0, 4] = torch.nan
    z[0, 5, 1] = z[0, 5, 0] + 0.3  # lines of sight that part
    z[0, 5, 0] -= 0.3
    found = fixes(scenario, tracks._replace(z=z))[0, :, 0]
    bad = torch.zeros(60, dtype=torch.bool)
    bad[3:6] = True
    assert torch.equal(found.isnan().all(-1), bad)
    assert torch.equal(found.isnan().any(-1), bad)


def test_a_measurement_is_off_by_the_stated_standard_deviations():
    scenario = straight("radar")
    tracks = scenario.simulate(1, 0)
    z = scenario.sensor(tracks.truth, tracks.u)
    z[0, 7, 1] += 6 * scenario.sensor.std()[1] + 2 * torch.pi
    z[0, 8] = torch.nan
    off = deviations(scenario, tracks._replace(z=z))
    assert off.shape == (1, 60, 1)
    assert off[0, 7, 0] == pytest.approx(6.0)
    assert (off[0, :, 0] > OUTLYING).sum() == 1


# ---------------------------------------------------------------- all figures alike

NAMES = ["gpb", "ukf", "fra"]


def plain_figures():
    """Each figure of the papers, with three lines where it takes several."""
    curve, state = np.geomspace(1, 9, 30).tolist(), torch.rand(30, 2).double()
    rows = [{"iteration": k, "loss": 1.0, "validation": 2.0} | dict.fromkeys(NAMES, 1.0 + k) for k in (1, 2, 3)]
    errors = {"rmse_range": [curve], "rmse_azimuth": [curve], "rmse_elevation": [curve]}
    yield figures.rmse_curves({name: {"rmse_position": curve} for name in NAMES}, "position", 1.0, "")
    yield figures.against([1, 2, 3], {name: [1.0, 2.0, 3.0] for name in NAMES}, "", "", "")
    yield figures.innovations(dict.fromkeys(NAMES, torch.rand(5, 30)), 9.0, 1.0, "")
    yield figures.by_coordinate({name: {"rmse_x": curve, "rmse_y": curve} for name in NAMES}, "rmse", 0.0, 1.0, "")
    yield plotting.tracks(state, {name: state + i for i, name in enumerate(NAMES)}, "")
    yield figures.probabilities({"imm": np.full((30, 3), 1 / 3)}, NAMES, 0.0, 1.0, "")
    yield figures.by_target(dict.fromkeys(NAMES, errors), 1.0, "")
    yield plotting.learning_curve(rows, dict.fromkeys(NAMES, 1.0), "")


@pytest.mark.slow
def test_names_are_beside_lines_of_colours_of_their_own_and_no_legend_covers_data():
    for figure in plain_figures():
        assert not figure.legends
        assert not any(axes.get_legend() for axes in figure.axes)
        axes = figure.axes[-1]
        assert set(NAMES) <= set(texts(axes))
        named = {text.get_text(): text.get_color() for text in axes.texts if text.get_text() in NAMES}
        assert len(set(named.values())) == 3 or axes.collections  # names of areas follow a square in their colour


def test_an_error_far_beyond_the_others_leaves_them_room_and_its_name_at_the_edge():
    curves = {"ukf": np.full(30, 20.0), "fra": np.full(30, 30.0), "iaukf": np.geomspace(30, 1e9, 30)}
    figure = figures.rmse_curves({n: {"rmse_position": c.tolist()} for n, c in curves.items()}, "position", 1.0, "")
    (axes,) = figure.axes
    assert axes.get_ylim()[1] < 1e5
    assert {"ukf", "fra", "iaukf"} == set(texts(axes))
