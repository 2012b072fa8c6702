"""No filter's errors are below the Cramer-Rao bound, and where a filter is best they are the bound."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles.bounds import from_shocks, mixture_information, whole_trajectory

from torchfra import catalogue, metrics, presets, scenarios
from torchfra.catalogue import scenario_filters
from torchfra.evaluation import measure
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.scenarios import Law, Scenario, bound
from torchfra.scenarios.base import BLOCK
from torchfra.scenarios.law import burst_information
from torchfra.scenarios.outliers import burst_factors
from torchfra.sensors import Position
from torchfra.types import Gaussian

ROOT = torch.tensor([30.0, 30.0, 5.0, 5.0]).double().diag()


def linear(q=0.5, steps=30, **law):
    """Constant velocity with process noise, positions, a consistent prior."""
    motion, sensor = ConstantVelocity(q), Position(10.0)
    one = torch.tensor(1.0).double()
    matrix, root = motion.transition(one), motion.process_noise(one)

    def block(rng, numbers):
        state = torch.from_numpy(rng.standard_normal((BLOCK, 4))) @ ROOT
        states = []
        for shock in torch.from_numpy(rng.standard_normal((steps, BLOCK, 2))):
            state = state @ matrix.mT + shock @ root.mT
            states.append(state)
        truth = torch.stack(states, 1)
        z = truth[..., :2] + 10 * torch.from_numpy(rng.standard_normal((BLOCK, steps, 2)))
        return scenarios.Tracks(truth, z, None, Gaussian(torch.zeros(BLOCK, 4).double(), ROOT))

    prior = Gaussian(torch.zeros(4).double(), ROOT)
    law = Law(**{"start": ROOT, "motion": motion, "sensor": sensor, "std": 10.0, "process_noise": root, **law})
    return Scenario("linear", motion, sensor, prior, 1.0, steps, block, {}, law=law)


# ---------------------------------------------------------------- closed forms


def test_of_a_linear_scenario_the_bound_is_the_covariance_of_the_kalman_filter():
    scenario = linear()
    tracks = scenario.simulate(3)
    estimate = presets.srckf(scenario.motion, scenario.sensor)(tracks.z, tracks.prior)
    found = bound(scenario, runs=3)
    assert found.kind == "posterior"
    torch.testing.assert_close(found.covariance, estimate.covariance[0], rtol=1e-10, atol=1e-10)


def test_a_fixed_path_without_process_noise_has_the_covariance_of_its_start_refined():
    found = bound(linear(process_noise=None), runs=2)
    assert found.kind == "parametric"
    times = np.arange(1, 31)
    design = np.stack([np.ones(30), times], 1)
    information = np.diag([1 / 30.0**2, 1 / 5.0**2]) + design.T @ design / 10.0**2
    last = np.array([1.0, 30.0])
    assert float(found.rmse(slice(0, 1))[-1]) == pytest.approx(np.sqrt(last @ np.linalg.inv(information) @ last))


def test_steps_without_a_measurement_add_nothing():
    scenario = linear()
    tracks = scenario.simulate(2)
    z = torch.where(torch.arange(30).view(1, -1, 1) % 3 == 0, torch.nan, tracks.z)
    estimate = presets.srckf(scenario.motion, scenario.sensor)(z, tracks.prior)
    given = scenarios.of_tracks(tracks._replace(z=z), scenario.motion, scenario.sensor)
    torch.testing.assert_close(
        bound(replace(given, law=scenario.law), runs=2).covariance, estimate.covariance[0], rtol=1e-10, atol=1e-10
    )


# ---------------------------------------------------------------- independent oracles


def slopes(runs, steps, n, m, seed):
    rng = np.random.default_rng(seed)
    spread = 0.3 * rng.standard_normal((runs, steps, n, n))
    return np.eye(n) + spread, rng.standard_normal((runs, steps, m, n))


def test_the_recursion_is_the_inverse_of_the_information_of_whole_trajectories():
    F, H = slopes(5, 7, 3, 2, seed=1)
    half = np.random.default_rng(2).standard_normal((3, 3))
    Q, P0, R = half @ half.T + 0.1 * np.eye(3), np.diag([1.0, 4.0, 0.5]), np.diag([0.3, 2.0])
    whitened = torch.from_numpy(H / np.sqrt(np.diag(R))[:, None])
    found = metrics.cramer_rao(
        torch.from_numpy(np.sqrt(P0)), torch.from_numpy(F), torch.from_numpy(np.linalg.cholesky(Q)), whitened
    )
    np.testing.assert_allclose(found.numpy(), whole_trajectory(P0, F, Q, H, R), rtol=1e-9)


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_process_noise_may_have_any_rank(rank):
    F, H = slopes(1, 6, 3, 1, seed=3)
    G = np.random.default_rng(4).standard_normal((3, rank))
    P0, R = np.diag([1.0, 4.0, 0.5]), np.eye(1)
    found = metrics.cramer_rao(
        torch.from_numpy(np.sqrt(P0)), torch.from_numpy(F), torch.from_numpy(G) if rank else None, torch.from_numpy(H)
    )
    np.testing.assert_allclose(found.numpy(), from_shocks(P0, F[0], G, H[0], R), rtol=1e-9, atol=1e-12)


def test_singular_process_noise_is_the_limit_of_noise_with_an_inverse():
    F, H = slopes(4, 5, 3, 2, seed=5)
    F[:, :, 2] = [0.0, 0.0, 1.0]  # a parameter without noise: the same slope for all truths
    root = torch.tensor([[1.0, 0.2], [0.0, 0.7], [0.0, 0.0]]).double()
    small = torch.cat([root, 1e-5 * torch.eye(3).double()], -1)
    start = torch.diag(torch.tensor([1.0, 2.0, 0.5]).double())
    exact, near = (metrics.cramer_rao(start, torch.from_numpy(F), g, torch.from_numpy(H)) for g in (root, small))
    torch.testing.assert_close(exact, near, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(("weights", "factors", "size"), [
    ([0.7, 0.3], [1.0, 15**0.5], 1), ([0.95, 0.05], [1.0, 10.0], 2), ([0.5, 0.3, 0.2], [1.0, 3.0, 8.0], 3),
])  # fmt: skip
def test_what_a_measurement_with_outliers_tells_is_the_mean_squared_score_of_its_mixture(weights, factors, size):
    drawn = mixture_information(np.array(weights), np.array(factors), size, 200_000, seed=6)
    assert metrics.outlier_information(weights, factors, size) == pytest.approx(drawn, rel=0.01)


def test_measurements_without_outliers_tell_all_and_outliers_less():
    assert metrics.outlier_information([1.0], [1.0], 2) == pytest.approx(1.0, rel=1e-9)
    assert metrics.outlier_information([1.0], [3.0], 2) == pytest.approx(1 / 9, rel=1e-9)
    assert 0.9 < metrics.outlier_information([0.95, 0.05], [1.0, 1e4]) < 0.95 + 1e-3


def test_bursts_tell_what_the_share_of_their_steps_leaves():
    drawn = burst_factors(np.random.default_rng(7), 100_000, 8).squeeze(-1)
    torch.testing.assert_close(burst_information(8), drawn.square().reciprocal().mean(0), rtol=3e-3, atol=0.0)


# ---------------------------------------------------------------- scenarios


def test_of_a_nonlinear_fixed_path_the_bound_is_the_linearised_filter_at_the_truth():
    scenario = scenarios.bearings_outliers("none", initial="truth")
    tracks = scenario.simulate(1)
    motion = ConstantAcceleration(0.0)
    F = motion.transition(torch.tensor(1.0).double()).numpy()
    truth, u = tracks.truth[0], tracks.u
    H = torch.stack([torch.func.jacfwd(lambda x, s=s: scenario.sensor(x, s))(x) for x, s in zip(truth, u, strict=True)])
    P0 = (tracks.prior.scale_tril @ tracks.prior.scale_tril.mT).numpy()
    expected = from_shocks(P0, np.stack([F] * 100), np.zeros((6, 0)), H.numpy(), np.eye(2) * np.radians(1.0) ** 2)
    np.testing.assert_allclose(bound(scenario, runs=1).covariance.numpy(), expected, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in catalogue.SCENARIOS if name not in ("growth", "ranges-outliers")])
def test_the_bound_is_below_the_errors_of_a_filter(name):
    scenario = catalogue.make_scenario(name)
    names = ["srckf"] if scenario.clutter is None else ["iaukf_jpda"]
    least = bound(scenario, runs=10).rmse(scenario.truth_position).nanmean().item()
    (of,) = measure(scenario, scenario_filters(names, scenario), runs=10, reference=False).values()
    assert 0 < least < of.summary(1.0)["mean_rmse_position"]


def test_a_bound_says_what_it_takes_as_known():
    found = bound(scenarios.bearings_manoeuvre(), runs=1)
    assert str(found) == "parametric Cramer-Rao bound, manoeuvres known, outliers known"
    assert bound(scenarios.bearings_outliers(truth_noise=0.01, initial="truth"), runs=3).kind == "posterior"


def test_a_scenario_without_a_law_has_no_bound():
    with pytest.raises(ValueError, match="scenario: expected one with a law"):
        bound(scenarios.clutter_many())
    with pytest.raises(ValueError, match="scenario: expected a Scenario, received int"):
        bound(3)
    with pytest.raises(ValueError, match="runs, seed, first: expected whole numbers"):
        bound(scenarios.bearings_outliers(), runs=1.5)


def test_sizes_that_do_not_fit_are_refused():
    eye = torch.eye(3).double()
    with pytest.raises(ValueError, match="transition, slope: expected"):
        metrics.cramer_rao(eye, eye.expand(1, 2, 3, 3), None, eye.expand(1, 3, 3, 3))
    with pytest.raises(ValueError, match="weights, factors: expected probabilities"):
        metrics.outlier_information([0.5, 0.4], [1.0, 2.0])
