"""The numbered examples run, and print what they promise."""

import re
import warnings

import numpy as np
import pytest
import torch
from numbered_examples import EXAMPLES, load
from two_processes import run_in_two

from torchfra import presets

pytestmark = pytest.mark.usefixtures("rough_figures")


def numbers(pattern, text):
    """Numbers in a text, where the pattern has groups."""
    return [float(x) for match in re.findall(pattern, text) for x in ([match] if isinstance(match, str) else match)]


def test_the_examples_are_numbered():
    assert [int(name[:2]) for name in EXAMPLES] == [*range(1, 20)]


def test_the_first_filter_is_beaten_by_the_robust_adaptive_one(capsys, tmp_path):
    load("01_first_filter").main(["--runs", "5", "--plot", str(tmp_path / "first.png")])
    plain, _, fra = numbers(r"position RMSE +([\d.]+) m", capsys.readouterr().out)
    assert fra < plain / 2
    assert (tmp_path / "first.png").stat().st_size > 10_000


def test_learning_lowers_the_error_on_unseen_tracks(capsys):
    load("02_learning").main(["--iterations", "8", "--tracks", "8", "--steps", "20"])
    before, after = numbers(r"([\d.]+) m before, ([\d.]+) m after", capsys.readouterr().out)
    assert after < 0.9 * before


def test_gradients_reach_the_first_layer_of_the_network():
    example = load("03_network_in_front")
    torch.manual_seed(0)
    model = example.Weighted()
    model(example.simulate(4, 10, 0))[0].square().mean().backward()
    assert (model.network[0].weight.grad != 0).all()
    assert model.network[0].weight.grad.isfinite().all()


@pytest.mark.slow
def test_the_network_learns_what_a_glint_is_and_beats_the_fixed_filter():
    example = load("03_network_in_front")
    model, data = example.learn(40), example.simulate(100, 25, 999)
    with torch.no_grad():
        learned, std = model(data)
        fixed = presets.srckf(example.MOTION, example.SENSOR)(data.z, data.prior).mean
    factor = std / example.STD
    assert factor[data.glint].median() > 4
    assert factor[~data.glint].median() < 2
    error, error_fixed = ((x - data.truth)[..., :2].square().sum(-1).mean().sqrt() for x in (learned, fixed))
    assert error < 0.6 * error_fixed


@pytest.mark.slow
def test_a_model_of_the_turn_beats_constant_velocity(capsys):
    load("04_own_model").main(["--steps", "25"])
    output = capsys.readouterr().out
    assert output.startswith("UnknownTurn and DopplerRadar: no problems\n")
    pairs = numbers(r"RMSE +([\d.]+) m with.*, +([\d.]+) m without", output)
    assert len(pairs) == 6
    assert all(own < other for own, other in zip(pairs[::2], pairs[1::2], strict=True))


def test_streaming_gives_what_one_call_gives(capsys):
    load("05_streaming").main([])
    output = capsys.readouterr().out
    assert output.count("nan") == 7
    assert numbers(r"from one call: ([\d.e+-]+)", output)[0] < 1e-9


@pytest.mark.slow
def test_the_filter_that_estimates_the_measurement_noise_tracks_crossing_targets_better(capsys):
    load("06_several_targets").main(["--runs", "6"])
    output = capsys.readouterr().out
    fixed, _, estimated, _ = numbers(r"median +([\d.]+) m, largest +([\d.]+) m", output)
    assert estimated < 0.7 * fixed
    assert output.count("missed") == 2


@pytest.mark.slow
def test_late_measurements_of_a_camera_help_a_radar_where_they_belong(capsys):
    load("07_fusion").main(["--seconds", "10"])
    output = capsys.readouterr().out
    alone, left_out, both = numbers(r"RMSE +([\d.]+) m", output)
    assert both < 0.7 * min(alone, left_out)
    assert "to the last bit: True" in output


@pytest.mark.slow
def test_a_filter_that_knows_the_delay_and_how_a_vehicle_rolls_is_the_best(capsys):
    load("08_ranges_on_a_vehicle").main(["--runs", "2", "--steps", "45"])
    output = capsys.readouterr().out
    blind, straight, turning, rolling = numbers(r"position RMSE ([\d.]+) m", output)
    assert blind > 5 * straight
    assert max(turning, rolling) < straight
    assert all(abs(delay - 0.6) < 0.05 for delay in numbers(r"delay ([\d.]+) m", output))
    assert "Augmented and Biased: no problems" in output


@pytest.mark.slow
def test_ten_targets_are_followed_without_a_switch(capsys):
    load("09_ten_targets").main([])
    output = capsys.readouterr().out
    lives = numbers(r"there for +(\d+) scans, followed for +(\d+), found after (\d+), switches (\d+)", output)
    assert len(lives) == 40
    assert sum(lives[1::4]) > 0.9 * sum(lives[::4])
    assert sum(lives[3::4]) == 0
    assert output.count("confirmed") >= 10
    assert numbers(r"GOSPA ([\d.]+) m", output)[0] < 60


@pytest.mark.slow
def test_a_problem_of_ones_own_is_fitted_and_compared(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(presets, "gpb", presets.rsrckf)  # whose kernel takes the compiler half a minute
    load("10_own_problem").main(["--tracks", "12", "--iterations", "0", "--out", str(tmp_path)])
    output = capsys.readouterr().out
    srckf, gpb = (text for text in output.split("gpb\n")[:2])
    assert "sensor.std[1]" in srckf
    assert "sensor.std[1]" in gpb
    assert len(list(tmp_path.glob("track-*.csv"))) == 12
    assert (tmp_path / "gpb.json").exists()
    assert (tmp_path / "gpb.png").exists()


def test_lightning_trains_a_filter(capsys):
    pytest.importorskip("lightning")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Lightning's own
        load("11_lightning").main(["--epochs", "2", "--tracks", "32"])
    before, after = numbers(r"tracks ([-\d.]+), then ([-\d.]+);", capsys.readouterr().out)
    assert after < before


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_two_processes_learn_what_one_learns(capsys, tmp_path):
    example, small = load("12_several_processes"), ["--iterations", "2", "--tracks", "4"]
    example.main(small)
    alone = numbers(r" ([\d.]+)", capsys.readouterr().out)
    run_in_two(example.main, small, tmp_path / "out")
    assert numbers(r" ([\d.]+)", (tmp_path / "out").read_text()) == pytest.approx(alone, rel=1e-6)
    assert len(alone) == 4


@pytest.mark.slow
def test_a_filter_of_three_functions_smooths_lags_learns_and_compiles(capsys):
    load("13_own_filter").main()
    text = capsys.readouterr().out
    error = dict(re.findall(r"(\S.*?) +position RMSE +([\d.]+) m", text))
    assert error["own"] == error["vmap"] == error["compiled"]
    plain, own, smoothed, lag, learned = (float(error[k]) for k in ("srckf", "own", "smoothed", "lag of 5", "learned"))
    assert max(smoothed, lag) < 0.7 * own < 0.6 * plain
    assert learned <= own
    assert float(text.split()[-1]) < 1e-9


@pytest.mark.slow
def test_faults_that_last_are_found_and_leave_the_robot_in_its_place(capsys):
    load("14_faults_that_last").main(["--runs", "6", "--steps", "200"])
    text = capsys.readouterr().out
    white, robust, lasting = (float(x) for x in re.findall(r"RMSE +([\d.]+) m", text))
    assert lasting < 0.4 * min(white, robust)
    *_, consistency = (float(x) for x in re.findall(r"dimension +([\d.]+)", text))
    assert 0.5 < consistency < 2.0
    found, false = numbers(r"([\d.]+)%", text)
    assert found > 80.0
    assert false < 10.0


def test_a_ride_is_cleaned_of_its_noise_and_its_outliers_by_one_call(capsys, tmp_path):
    load("15_a_ride_cleaned").main(["--seconds", "200", "--plot", str(tmp_path / "ride.png")])
    before, after, found, outliers, others = numbers(
        r"([\d.]+) m off before, ([\d.]+) m after; (\d+) of (\d+) outliers found, (\d+) others", capsys.readouterr().out
    )
    assert after < 0.3 * before
    assert found >= outliers - 1
    assert others <= 1
    assert (tmp_path / "ride.png").stat().st_size > 10_000


@pytest.mark.slow
def test_who_knows_the_road_knows_better_where_cars_are(capsys):
    load("16_on_a_road").main(["--runs", "6"])
    text = capsys.readouterr().out
    plain, plain_road, robust, robust_road = numbers(r"RMSE +([\d.]+) m", text)
    assert plain_road < 0.85 * plain
    assert robust_road < 0.85 * robust
    assert 0.7 < numbers(r"dimension +([\d.]+)", text)[-1] < 1.7


@pytest.mark.slow
def test_every_sensor_of_the_harbour_brings_the_boats_nearer(capsys):
    load("17_a_harbour").main(["--seed", "0"])
    text = capsys.readouterr().out
    radar, with_lidar, with_camera = numbers(r"GOSPA ([\d.]+) m", text)
    assert with_camera < with_lidar < radar < 10.0
    assert numbers(r"(\d+) false tracks", text) == [0, 0, 0]
    assert min(numbers(r"followed (\d+) %", text)) > 70


@pytest.mark.slow
def test_keypoints_are_cleaned_to_less_than_six_tenths_of_the_error_of_usual_filters(capsys):
    pytest.importorskip("xarray")
    pytest.importorskip("llvmlite")
    load("18_keypoints").main(["--frames", "600"])
    _, *usual, cleaned = numbers(r"error +([\d.]+) pixels", capsys.readouterr().out)
    assert cleaned < 0.6 * min(usual)


@pytest.mark.slow
def test_draws_from_the_posterior_are_about_the_true_values(capsys):
    pytest.importorskip("llvmlite")
    load("19_posterior").main(60)
    low, high, true = zip(*re.findall(r"(\S+) to +(\S+), true +(\S+)", capsys.readouterr().out), strict=True)
    inside = [float(a) < float(x) < float(b) for a, b, x in zip(low, high, true, strict=True)]
    assert sum(inside) >= 4
    assert len(inside) == 5


def test_nuts_draws_as_often_from_each_part_of_a_distribution_as_it_has_mass():
    """A posterior with a known covariance."""
    example, rng = load("19_posterior"), np.random.default_rng(0)
    root = np.tril(rng.normal(size=(5, 5))) + 2 * np.eye(5)
    precise = np.linalg.inv(root @ root.T)  # of the likelihood, beside the prior

    def likelihood(raw):
        return -0.5 * ((raw @ precise) * raw).sum(-1), -raw @ precise

    found = example.draws(likelihood, 1000, rng)
    covariance = np.linalg.inv(precise + np.eye(5) / example.WIDE**2)
    mean = covariance @ example.USUAL / example.WIDE**2
    white = np.linalg.solve(np.linalg.cholesky(covariance), (found - mean).T)
    assert np.abs(white.mean(1)).max() < 0.15
    np.testing.assert_allclose(np.cov(white), np.eye(5), atol=0.2)
