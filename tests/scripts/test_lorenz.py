"""The attractor of Lorenz beside a network that learns the gain: model, settings, network and command."""

import json
import math

import lorenz
import numpy as np
import pytest
import torch
from learned.gaussian_sum import followed, split
from learned.kalmannet import KalmanNet, trained
from learned.lorenz import DEGREE, DT, SETTINGS, Lorenz, models, rotation, simulate

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

SMALL = ["--runs", "3", "--fit", "", "--filters", "srckf", "--network", "1", "--variances", "1"]


def by_hand(x, angle, order):
    """One step of one state: the truncated exponential of a matrix, times the state."""
    axes = [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]]
    x_turn, y_turn, z_turn = torch.linalg.matrix_exp(angle * torch.tensor(axes, dtype=torch.float64)).numpy()
    matrix = z_turn @ y_turn @ x_turn @ np.array([[-10, 10, 0], [28, -1, -x[0]], [0, x[0], -8 / 3]]) * DT
    powers = [np.linalg.matrix_power(matrix, j) / math.factorial(j) for j in range(order + 1)]
    return sum(powers) @ x


@pytest.mark.parametrize(("angle", "order"), [(0.0, 5), (DEGREE, 5), (0.0, 2)])
def test_a_step_is_the_series_of_the_matrix_exponential(angle, order):
    x = 10 * torch.randn(2, 4, 3, dtype=torch.float64)
    after = Lorenz(order=order, angle=angle)(x, torch.full((2, 4), DT, dtype=torch.float64))
    wanted = [by_hand(state, angle, order) for state in x.reshape(-1, 3).numpy()]
    torch.testing.assert_close(after.reshape(-1, 3), torch.from_numpy(np.stack(wanted)))


def test_where_models_hold_the_error_is_a_third_of_the_noise_and_honest():
    setting = SETTINGS["as stated"]
    tracks = simulate(setting, 1.0, 40, 0)
    estimate = presets.ukf(*models(setting, 1.0))(tracks.z, tracks.prior, dt=DT)
    error = estimate.mean - tracks.truth
    assert error.square().mean().sqrt() < 0.35
    nees = torch.linalg.solve_triangular(estimate.scale_tril, error.unsqueeze(-1), upper=False).square().mean()
    assert 0.85 < nees < 1.15


def test_one_step_ahead_the_last_state_is_predicted_and_the_first_known():
    setting = SETTINGS["one step ahead"]
    tracks = simulate(setting, 1.0, 2, 0)
    assert tracks.z.shape == (2, 99, 3)
    motion, _ = models(setting, 1.0)
    asked = tracks.asked(tracks.truth[:, :-1], motion)
    assert asked[:, 0].eq(0.0).all()
    assert (asked - tracks.truth).square().mean().sqrt() == pytest.approx(0.01, rel=0.2)  # the process noise


def test_the_parts_of_a_belief_have_its_mean_and_covariance():
    root = torch.linalg.cholesky(torch.tensor([[4.0, 1, 0], [1, 2, 0.5], [0, 0.5, 1]]).double())
    belief = Gaussian(torch.tensor([[1.0, -2, 3]]).double(), root)
    parts, log_weight = split(belief, 61)
    weight = log_weight.exp()
    assert float(weight.sum()) == pytest.approx(1.0)
    mean = (weight[:, None] * parts.mean[0]).sum(0)
    off = parts.mean[0] - mean
    spread = (weight[:, None, None] * (parts.covariance[0] + off.unsqueeze(-1) * off.unsqueeze(-2))).sum(0)
    torch.testing.assert_close(mean, belief.mean[0])
    torch.testing.assert_close(spread, belief.covariance, rtol=0.03, atol=0.03)


def test_where_models_are_linear_the_parts_together_are_the_filter():
    rng = torch.Generator().manual_seed(0)
    z = torch.randn(2, 12, 2, generator=rng, dtype=torch.float64).cumsum(1)
    prior = Gaussian(torch.zeros(4).double(), 3 * torch.eye(4).double())
    f = presets.srckf(ConstantVelocity(q=0.1), Position(2.0))
    means, weight = followed(f, z, prior, 1.0, first=2, parts=41)
    torch.testing.assert_close(weight.sum(0), torch.ones(2, 12).double())
    torch.testing.assert_close((weight.unsqueeze(-1) * means).sum(0), f(z, prior, dt=1.0).mean, rtol=0.02, atol=0.02)


@pytest.mark.slow
def test_from_a_point_where_paths_part_a_sum_predicts_better_than_one_belief():
    setting = SETTINGS["one step ahead"]
    motion, sensor = models(setting, 1000.0)
    tracks = simulate(setting, 1000.0, 40, 7)
    one = lorenz.estimated(presets.ukf(motion, sensor), tracks, motion)
    many = lorenz.summed(presets.ukf(motion, sensor), tracks, motion)
    assert lorenz.error(many, tracks, 1.0) < 0.9 * lorenz.error(one, tracks, 1.0)


def test_settings_change_what_they_say_alone():
    plain, turned, outlying, one = (
        simulate(SETTINGS[name], 1.0, 30, 0)
        for name in ("as stated", "sensor turned by 1 degree", "5 % outliers", "x alone measured")
    )
    assert plain.truth.equal(turned.truth)
    assert one.z.equal(plain.z[..., :1])
    torch.testing.assert_close(turned.z - plain.z, plain.truth @ rotation(DEGREE).mT - plain.truth)
    factors = (outlying.z - plain.truth) / (plain.z - plain.truth)
    large = (factors > 5).double().mean()
    assert 0.03 < large < 0.07
    torch.testing.assert_close(factors[factors > 5], torch.full_like(factors[factors > 5], 10.0))


def test_before_it_has_learned_the_network_predicts_and_gradients_reach_all_of_it_soon():
    setting = SETTINGS["as stated"]._replace(steps=5)
    motion, sensor = models(setting, 1.0)
    tracks, network = simulate(setting, 1.0, 4, 0), KalmanNet(motion, sensor)
    state = tracks.prior.mean
    for mean in network.estimated(tracks).unbind(1):
        state = motion(state, torch.full((4,), DT, dtype=torch.float64))
        torch.testing.assert_close(mean.double(), state, rtol=1e-4, atol=1e-4)
    trained(network, lambda number: tracks, 2)
    network.estimated(tracks).square().mean().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


def test_the_table_and_the_json_have_an_error_for_each_filter(tmp_path, capsys):
    out = tmp_path / "r.json"
    assert lorenz.main([*SMALL, "--settings", "as stated", "--json", str(out)]) == 0
    errors = json.loads(out.read_text())["errors"]["as stated"]["1"]
    assert errors.keys() == {"srckf", "KalmanNet, small"}
    assert errors["srckf"] < 0.4
    printed = capsys.readouterr().out
    assert "| srckf" in printed
    assert "as stated, 1" in printed


def test_where_there_are_outliers_another_network_learns_without(tmp_path, monkeypatch):
    batches, out = [], tmp_path / "r.json"
    monkeypatch.setattr(lorenz, "trained", lambda network, tracks, iterations: batches.append(tracks(0)))
    assert lorenz.main([*SMALL, "--settings", "5 % outliers", "--json", str(out), "--quiet"]) == 0
    errors = json.loads(out.read_text())["errors"]["5 % outliers"]["1"]
    assert errors.keys() == {"srckf", "KalmanNet, small", "KalmanNet, small, learned without outliers"}
    largest = [(batch.z - batch.truth).abs().max() for batch in batches]  # in standard deviations
    assert largest[0] > 10
    assert largest[1] < 7


@pytest.mark.slow
def test_noise_fitted_to_truth_makes_up_for_a_part_of_a_turn_that_no_filter_knows(tmp_path, monkeypatch):
    monkeypatch.setattr(lorenz, "LEARNED_FROM", 16)
    monkeypatch.setattr(lorenz, "LOSSES", {"fitted to truth": "mse"})
    out, name = tmp_path / "r.json", "sensor turned by 1 degree"
    options = ["--runs", "20", "--fit", "ekf", "--filters", "ekf", "--network", "0", "--variances", "0.001"]
    assert lorenz.main([*options, "--settings", name, "--json", str(out), "--quiet"]) == 0
    errors = json.loads(out.read_text())["errors"][name]["0.001"]
    assert errors["ekf, fitted to truth"] < 0.5 * errors["ekf"]
