"""A linear model by its matrices is filtered and smoothed as plain numpy does it, wherever the matrices come from."""

import math
import re
from pathlib import Path

import numpy as np
import oracles
import pytest
import torch
from oracles.gpb import exponential
from torch.distributions import constraints

from torchfra import Gaussian, Hyper, check_model, presets, sensors
from torchfra.linalg import covariance_root
from torchfra.motion import Augmented, Bank, Linear, RandomWalk

N, M, T = 3, 2, 9
RNG = np.random.default_rng(0)
F, H, B = 0.5 * RNG.normal(size=(T, N, N)), RNG.normal(size=(T, M, N)), RNG.normal(size=(N, 1))
SHOCK, R = RNG.normal(size=(T, N, 2)), np.array([[1.0, 0.3], [0.3, 0.5]])
Q = SHOCK @ SHOCK.transpose(0, 2, 1)
Z, CONTROL = torch.from_numpy(RNG.normal(size=(T, M))), torch.from_numpy(RNG.normal(size=(T, 1)))
PRIOR = Gaussian(torch.zeros(N).double(), torch.eye(N).double())


def expected(F, shock, R, H, z=Z, mean=None, P=None):
    """The Kalman filter in numpy; matrices are fixed or functions of the step."""
    n = oracles.basics.at(F, 0).shape[0]
    H = H if callable(H) else lambda k, fixed=H: fixed
    root = np.linalg.cholesky(R)
    model = oracles.Model(F, shock, root, lambda x, k: H(k) @ x, np.zeros(len(R), dtype=bool))
    mean, P = np.zeros(n) if mean is None else mean, np.eye(n) if P is None else P
    return model, oracles.kalman(np.asarray(z), mean, P, model, H)


def agree(estimate, found, tolerance=1e-9):
    """Mean and covariance, and the log likelihood, step by step."""
    np.testing.assert_allclose(estimate.mean, found["mean"], rtol=0, atol=tolerance)
    np.testing.assert_allclose(estimate.covariance, found["P"], rtol=0, atol=tolerance)
    if "log_likelihood" in found:
        np.testing.assert_allclose(estimate.log_likelihood, found["log_likelihood"], rtol=0, atol=tolerance)


# ---------------------------------------------------------------- matrices


@pytest.mark.parametrize("kind", ["numpy", "lists", "root"])
def test_fixed_matrices_filter_and_smooth_as_in_numpy(kind):
    as_kind = (lambda x: x.tolist()) if kind == "lists" else (lambda x: x)
    motion = Linear(as_kind(F[0]), **({"root": SHOCK[0]} if kind == "root" else {"Q": as_kind(Q[0])}))
    f = presets.srckf(motion, sensors.Linear(as_kind(H[0]), as_kind(R)))
    model, found = expected(F[0], SHOCK[0], R, H[0])
    agree(f(Z, PRIOR), found)
    agree(f.smooth(Z, PRIOR), oracles.whole_track(Z.numpy(), np.zeros(N), np.eye(N), model), 1e-8)


def test_matrices_of_each_step_and_a_control_filter_smooth_and_stream_as_in_numpy():
    motion, sensor = Linear(F, Q, B=B), sensors.Linear(H, R)
    u = torch.cat([motion.inputs(CONTROL), sensor.inputs()], -1)
    moved = np.concatenate([F, B @ CONTROL.numpy()[:, None]], 2)  # the control as a component that is 1
    moved = np.concatenate([moved, np.tile(np.eye(N + 1)[-1:], (T, 1, 1))], 1)
    shock, seen = np.pad(SHOCK, ((0, 0), (0, 1), (0, 0))), np.pad(H, ((0, 0), (0, 0), (0, 1)))
    mean, P = np.eye(N + 1)[-1], np.diag([1.0, 1.0, 1.0, 0.0])
    model, found = expected(moved.__getitem__, shock.__getitem__, R, seen.__getitem__, mean=mean, P=P)
    whole = oracles.whole_track(Z.numpy(), mean, P, model)
    found = {"mean": found["mean"][:, :N], "P": found["P"][:, :N, :N], "log_likelihood": found["log_likelihood"]}
    f = presets.srckf(motion, sensor)
    agree(f(Z, PRIOR, u=u), found)
    agree(f.smooth(Z, PRIOR, u=u), {"mean": whole["mean"][:, :N], "P": whole["P"][:, :N, :N]}, 1e-8)
    state = f.init(PRIOR)
    for k in range(T):
        state, _ = f.step(state, Z[k], u=u[k])
        np.testing.assert_allclose(state.belief.mean, found["mean"][k], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_matrices_of_each_step_are_inputs_of_kernels_too():
    motion, sensor = Linear(F, Q, B=B), sensors.Linear(H, R)
    u, dt = torch.cat([motion.inputs(CONTROL), sensor.inputs()], -1), torch.tensor([0.0, 1.0, 2.0] * 3).double()
    f, compiled = presets.srckf(motion, sensor), presets.srckf(motion, sensor).compile()
    for method in ("forward", "smooth"):
        found, plain = getattr(compiled, method)(Z, PRIOR, u=u, dt=dt), getattr(f, method)(Z, PRIOR, u=u, dt=dt)
        torch.testing.assert_close(found.mean, plain.mean, rtol=0, atol=1e-12)
        torch.testing.assert_close(found.covariance, plain.covariance, rtol=0, atol=1e-12)


def white_acceleration(dt):
    """The covariance of a position and a velocity after ``dt``."""
    rows = [[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


@pytest.mark.parametrize("noise", [[[0.25, 0.5], [0.5, 1.0]], white_acceleration], ids=["fixed", "of dt"])
def test_fixed_matrices_and_covariances_of_any_time_step_run_in_kernels(noise):
    f = presets.srckf(Linear([[1, 1], [0, 1]], noise), sensors.Linear([[1, 0]], 0.5))
    z, prior, dt = Z[:, :1], Gaussian.from_std([0, 0], 3.0), torch.linspace(0.1, 2.0, T).double()
    plain = f(z, prior, dt=dt)
    found = f.compile()(z, prior, dt=dt)
    torch.testing.assert_close(found.mean, plain.mean, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.covariance, plain.covariance, rtol=0, atol=1e-12)


def test_each_track_may_have_matrices_of_its_own():
    several = np.stack([F, F[::-1]])
    motion = Linear(several, Q)
    f = presets.srckf(motion, sensors.Linear(H[0], R))
    estimate = f(Z.expand(2, T, M), PRIOR, u=motion.inputs())
    for i in range(2):
        _, found = expected(several[i].__getitem__, SHOCK.__getitem__, R, H[0])
        np.testing.assert_allclose(estimate.mean[i], found["mean"], rtol=0, atol=1e-9)


def test_functions_of_time_are_those_of_a_process_in_continuous_time():
    A, G, dt = np.array([[0.0, 1.0], [-0.3, -0.2]]), np.array([[0.0], [1.0]]), np.array([0.5, 2.0, 0.1, 1.0])

    def noise(seconds):  # Van Loan (1978)
        both = torch.linalg.matrix_exp(
            torch.from_numpy(np.block([[-A, G @ G.T], [np.zeros((2, 2)), A.T]])) * seconds[..., None, None]
        )
        return both[..., 2:, 2:].mT @ both[..., :2, 2:]

    motion = Linear(lambda dt: torch.linalg.matrix_exp(torch.from_numpy(A) * dt[..., None, None]), noise)
    steps = [exponential(A * s) for s in dt]
    roots = []
    for s in dt:  # the integral of the covariance by Simpson's rule
        each = np.array([exponential(A * t) @ G for t in np.linspace(0, s, 401)])
        values = each @ each.transpose(0, 2, 1)
        total = values[0] + 4 * values[1:-1:2].sum(0) + 2 * values[2:-1:2].sum(0) + values[-1]
        roots.append(np.linalg.cholesky(s / 1200 * total))
    _, found = expected(steps.__getitem__, roots.__getitem__, np.eye(1), np.array([[1.0, 0.0]]), Z[:4, :1])
    f = presets.srckf(motion, sensors.Linear([[1.0, 0.0]], 1.0))
    agree(f(Z[:4, :1], Gaussian.from_std([0, 0], 1.0), dt=dt), found)


def test_after_no_time_the_state_is_as_it_was():
    motion = Linear(F[0], Q[0], B=B)
    f = presets.srckf(motion, sensors.Linear(H[0], R))
    dt = [0.0] + [1.0] * (T - 1)
    _, found = expected(
        lambda k: F[0] if k else np.eye(N), lambda k: SHOCK[0] * (k > 0), R, H[0]
    )  # which measures at the time of the prior, as statisticians do
    agree(f(Z, PRIOR, dt=dt, u=torch.zeros(T, 1).double()), found)
    assert motion.shift(torch.tensor(0.0).double(), torch.ones(1).double()).eq(0).all()


def test_a_sensor_with_another_function_is_no_longer_linear():
    class Squared(sensors.Linear):
        def forward(self, x, u=None):
            return super().forward(x, u).square()

    assert sensors.Linear([[1.0]], 1.0).linear
    assert not Squared([[1.0]], 1.0).linear


# ---------------------------------------------------------------- learning


def autoregression(phi=0.7):
    coefficient = Hyper(phi, constraints.interval(-1, 1), learn=True)
    motion = Linear([[coefficient, 0.0], [0.0, 1.0]], [Hyper(0.5, learn=True), 0.0])
    return motion, presets.srckf(
        motion, sensors.Linear([[1.0, Hyper(0.4, constraints.real, learn=True)]], [0.3]), learn=("std",)
    )


def test_the_gradient_by_an_entry_is_that_of_small_differences():
    _, f = autoregression()
    z = Z[:, :1]
    prior = Gaussian.from_std([0.0, 1.0], [1.0, 0.5])
    f(z, prior).log_likelihood.sum().backward()
    names = [name for name, _ in f.named_parameters()]
    assert names == ["motion.F.0,0.raw", "motion.root.variances.0.raw", "sensor.std.raw", "sensor.H.0,1.raw"]
    for _, raw in f.named_parameters():
        values = []
        for step in (1e-6, -1e-6):
            with torch.no_grad():
                raw += step
                values.append(f(z, prior).log_likelihood.sum())
                raw -= step
        assert float(raw.grad) == pytest.approx(float((values[0] - values[1]) / 2e-6), rel=1e-6, abs=1e-8)


def test_an_entry_keeps_its_constraint():
    with pytest.raises(ValueError, match=r"value: expected a value in .*1.*, received 1\.2"):
        autoregression(1.2)
    motion, _ = autoregression()
    with torch.no_grad():
        next(motion.parameters()).fill_(30.0)
    assert float(motion.transition(torch.tensor(1.0).double())[0, 0].detach()) <= 1.0


# ---------------------------------------------------------------- where a state starts


def test_a_wide_prior_is_the_exact_diffuse_start():
    """Without knowledge of level and slope the estimate is that of generalised least squares of all measurements."""
    T, z = 6, np.random.default_rng(1).normal(size=(6, 1)).cumsum(0)
    step, shock = np.array([[1.0, 1.0], [0.0, 1.0]]), np.diag([0.3, 0.1])
    f = presets.srckf(Linear(step, root=shock), sensors.Linear([[1.0, 0.0]], 0.5))
    wide = f(z, Gaussian.from_std([0, 0], 1e8), dt=[0.0] + [1.0] * (T - 1))
    powers = [np.linalg.matrix_power(step, k) for k in range(T)]
    X = np.array([p[0] for p in powers])  # measurements by the state at the first of them
    V = 0.5 * np.eye(T)
    for j in range(1, T):
        reach = np.array([powers[k - j][0] @ shock if k >= j else np.zeros(2) for k in range(T)])
        V = V + reach @ reach.T
    weight = np.linalg.inv(V)
    P = np.linalg.inv(X.T @ weight @ X)
    first = P @ X.T @ weight @ z[:, 0]
    smoothed = f.smooth(z, Gaussian.from_std([0, 0], 1e8), dt=[0.0] + [1.0] * (T - 1))
    np.testing.assert_allclose(smoothed.mean[0], first, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(smoothed.covariance[0], P, rtol=1e-9, atol=1e-9)
    gap = z[:, 0] - X @ first  # the diffuse likelihood, Durbin & Koopman (2012), section 7.2.2
    diffuse = -0.5 * (
        (T - 2) * math.log(2 * math.pi) + np.linalg.slogdet(V)[1] + np.linalg.slogdet(X.T @ weight @ X)[1]
        + gap @ weight @ gap
    )  # fmt: skip
    lost = 2 * math.log(1e8) + math.log(2 * math.pi)  # of the two components that nothing was known of
    assert float(wide.log_likelihood.sum()) + lost == pytest.approx(diffuse, abs=1e-7)


# ---------------------------------------------------------------- correlated noise


@pytest.mark.parametrize("following", [False, True])
def test_measurement_noise_that_is_correlated_with_process_noise_is_filtered_exactly(following):
    """The whole track as one Gaussian vector, whose noise has the cross-covariance written into its covariance."""
    half = np.random.default_rng(2).normal(size=(5, 5))
    joint = half @ half.T
    Q, S, R = joint[:3, :3], joint[:3, 3:], joint[3:, 3:]
    models = sensors.cross_correlated(F[0], Q, H[0], R, S, following=following)
    estimate = presets.srckf(models.motion, models.sensor)(Z, models.prior(PRIOR))
    # [x0, w1, ..., wT, v1, ..., vT]; x_k = F x_{k-1} + w_k
    size = N + T * (N + M)
    P, X, measured = np.zeros((size, size)), np.zeros((T, N, size)), np.zeros((T, M, size))
    P[:N, :N] = np.eye(N)
    state = np.eye(N, size)
    for k in range(T):
        w, v = slice(N + k * N, N + (k + 1) * N), slice(N + T * N + k * M, N + T * N + (k + 1) * M)
        P[w, w], P[v, v] = Q, R
        pair = slice(N + (k + 1) * N, N + (k + 2) * N) if following else w
        if pair.stop <= N + T * N:
            P[pair, v], P[v, pair] = S, S.T
        state = F[0] @ state
        state[:, w] += np.eye(N)
        X[k] = state
        measured[k] = H[0] @ state
        measured[k][:, v] += np.eye(M)
    found = models.state(estimate)
    for k in range(T):
        seen = measured[: k + 1].reshape(-1, size)
        gain = X[k] @ P @ seen.T @ np.linalg.inv(seen @ P @ seen.T)
        np.testing.assert_allclose(found.mean[k], gain @ Z[: k + 1].flatten().numpy(), rtol=0, atol=1e-9)
        left = X[k] @ P @ X[k].T - gain @ seen @ P @ X[k].T
        np.testing.assert_allclose(found.covariance[k], left, rtol=0, atol=1e-9)


# ---------------------------------------------------------------- checks


@pytest.mark.parametrize(
    "motion",
    [
        Linear([[0.5, -0.3], [1.0, 0.0]], [1.0, 0.0]),
        Linear([[1, 1], [0, 1]], [0.1, 0.01], dims=1),
        Linear(
            lambda dt: torch.exp(-dt)[..., None, None] * torch.eye(2).to(dt),
            lambda dt: dt[..., None, None] * torch.eye(2).to(dt),
        ),
        autoregression()[0],
        Augmented(Linear([[1.0]], [1.0]), RandomWalk(1.0, 1, kind="bias")),
        Bank([Linear([[0.5, 0], [0, 1]], [1, 1]), Linear([[0.9, 0], [0, 1]], [1, 1])]),
    ],
)  # fmt: skip
def test_models_in_discrete_time_pass_the_check_of_models(motion):
    report = check_model(motion, sensors.Linear(np.eye(1, motion.size), 1.0))
    assert report.ok, report


@pytest.mark.parametrize(("dims", "orders"), [(None, 1), (1, 6), (2, 3), (3, 2), (6, 1)])
def test_a_state_with_positions_has_as_many_velocities_and_so_on(dims, orders):
    motion = Linear(np.eye(6), np.eye(6), dims=dims)
    assert motion.orders == orders
    assert motion.kinds.count("position") == (dims or 0)


def test_a_covariance_of_any_rank_has_a_root_and_what_is_none_is_refused():
    half = np.random.default_rng(0).standard_normal((4, 2))
    for covariance in (half @ half.T, np.diag([4.0, 0.0, 1.0, 0.0]), np.eye(3)):
        root = covariance_root(torch.from_numpy(covariance))
        np.testing.assert_allclose(root @ root.mT, covariance, atol=1e-12)
        assert not root.triu(1).any()
    indefinite, shape = "symmetric positive semidefinite", r"covariance \(\.\.\., n, n\)"
    for bad, said in (
        ([[1.0, 0.0], [0.0, -1.0]], indefinite),
        ([[1.0, 2.0], [0.0, 1.0]], indefinite),
        ([[1.0, 0.1], [0.1, 0.0]], indefinite),
        ([[1.0, 1e-6], [0.0, 0.0]], indefinite),
        ([[1.0, 0.0], [1e-6, 0.0]], indefinite),
        ([[1.0, 2.0]], shape),
        ([[math.nan]], "finite numbers"),
    ):
        with pytest.raises(ValueError, match=f"Q: expected a? ?{said}"):
            covariance_root(torch.tensor(bad), "Q")
    several = torch.eye(2).repeat(2, 3, 1, 1)
    several[1, 0, 1, 1] = -1.0
    with pytest.raises(ValueError, match=r"received \[\[1\.0, 0\.0\], \[0\.0, -1\.0\]\]$"):
        covariance_root(several)


def test_a_root_does_not_depend_on_the_other_covariances_of_its_batch():
    half = torch.from_numpy(np.random.default_rng(0).standard_normal((4, 6)))
    regular, singular = half @ half.mT, half[:, :2] @ half[:, :2].mT
    root = covariance_root(torch.stack([regular, singular, torch.diag(torch.tensor([4.0, 0, 1, 0]).double())]))
    assert root[0].equal(torch.linalg.cholesky(regular))
    assert root[2].equal(torch.diag(torch.tensor([2.0, 0, 1, 0]).double()))
    torch.testing.assert_close(root[1] @ root[1].mT, singular)


def test_while_traced_a_covariance_of_any_rank_has_its_root_and_what_is_none_has_nan():
    half = np.random.default_rng(0).standard_normal((4, 2))
    for covariance in (half @ half.T, np.diag([4.0, 0.0, 1.0, 0.0]), np.eye(3), np.diag([1e12, 1e-12])):
        (root,) = torch.vmap(covariance_root)(torch.from_numpy(covariance)[None])
        std = np.sqrt(covariance.diagonal().clip(1e-300))
        error = ((root @ root.mT).numpy() - covariance) / std / std[:, None]
        np.testing.assert_allclose(error, 0.0, atol=1e-10)
        assert not root.triu(1).any()
    for bad in ([[1, 0], [0, -1]], [[1, 2], [2, 1]], [[0, 0.1], [0.1, 1]], [[math.nan]], [[math.inf, 0], [0, 1]]):
        assert torch.vmap(covariance_root)(torch.tensor([bad]).double()).isnan().any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Linear([[1, 1]], [1, 1]), r"F: expected \(2, 2\), received \(1, 2\)"),
        (lambda: Linear([1, 1], [1]), r"F: expected a matrix, received \(2,\)"),
        (lambda: Linear([[1, math.inf], [0, 1]], [1, 1]), r"F: expected finite numbers"),
        (lambda: Linear(np.eye(2)), r"Q, root: expected one of them, received none"),
        (lambda: Linear(np.eye(2), [1, 1, 1]), r"Q: expected \(2, 2\) or \(2,\) variances, received \(3,\)"),
        (lambda: Linear(np.eye(2), np.eye(3)), r"Q: expected \(2, r\), received \(3, 3\)"),
        (lambda: Linear(np.eye(2), -np.eye(2)), r"Q: expected a symmetric positive semidefinite matrix"),
        (lambda: Linear(np.eye(2), [1, -1]), r"Q: expected a value of 0 or more, received -1"),
        (lambda: Linear(np.eye(2), [[Hyper(1.0), 0], [0, 1]]), r"Q: expected numbers in a covariance: take root="),
        (lambda: Linear(np.eye(2), [1, 1], B=[[1.0]]), r"B: expected \(2, r\), received \(1, 1\)"),
        (lambda: Linear(F, Q[:4]), r"F, Q: expected as many steps in both, received 9 and 4"),
        (lambda: Linear([[Hyper(torch.ones(2))]], [1]), r"F\[0, 0\]: expected a single value, received \(2,\)"),
        (lambda: Linear(lambda dt, u: u, [1]), r"size: expected the number of components where F is a function of u"),
        (lambda: Linear(np.eye(2), [1, 1]).inputs(), r"inputs: expected F or Q with one matrix for each step"),
        (lambda: sensors.Linear([1, 0], 1), r"H: expected a matrix \(m, n\), received \(2,\)"),
        (lambda: sensors.Linear(H, R[:1]), r"R: expected \(2, 2\), \(2,\) variances or a number, received \(1, 2\)"),
        (lambda: sensors.Linear(H, np.tile(R, (T, 1, 1))), r"R: .*pass std= or noise= to the filter"),
        (lambda: sensors.Linear([[1.0]], 0.0), r"R: expected variances above 0, received 0"),
        (lambda: sensors.Linear(H[0], R).inputs(), r"inputs: expected H with one matrix for each step"),
        (lambda: presets.srckf(Linear(F, Q), sensors.Linear(H[0], R))(Z, PRIOR), r"u: .*motion\.inputs\(\)"),
        (lambda: presets.srckf(Linear(F[0], Q[0]), sensors.Linear(H, R))(Z, PRIOR), r"u: .*sensor\.inputs\(\)"),
        (lambda: presets.srckf(Linear(F[0], Q[0], B=B), sensors.Linear(H[0], R))(Z, PRIOR), r"u: expected \(.*, 1\)"),
        (lambda: sensors.cross_correlated(F[0], np.eye(3), H[0], R, 5 * np.ones((3, 2))), r"Q, S, R: expected a symm"),
        (lambda: sensors.cross_correlated(F[0], np.eye(3), H[0, 0], R, np.ones((3, 2))), r"H: expected a matrix"),
        (lambda: sensors.cross_correlated(F[0], np.eye(3), H[0], R, np.ones((2, 3))), r"S: expected \(3, 2\)"),
    ],
)  # fmt: skip
def test_matrices_that_do_not_fit_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_missing_matrix_of_a_step_fails_the_track_and_is_not_replaced():
    motion = Linear(F, Q)
    u = motion.inputs()
    u[3, 0] = math.nan
    estimate = presets.srckf(motion, sensors.Linear(H[0], R))(Z, PRIOR, u=u)
    assert bool(estimate.failed)
    assert int(estimate.failure.step) == 3


# ---------------------------------------------------------------- lines from other libraries to here

PAGE = (Path(__file__).parents[2] / "torchfra/motion/README.md").read_text(encoding="utf-8")
LINES = re.findall(r"^\| (\S+) \| `(.*?)` \| `(.*?)` \|$", PAGE, re.M)
NAMES = {
    "filterpy": "from filterpy.kalman import KalmanFilter",
    "torch-kf": "from torch_kf import GaussianState, KalmanFilter",
    "pykalman": "from pykalman import KalmanFilter",
    "statsmodels": "from statsmodels.tsa.statespace.kalman_filter import KalmanFilter",
}


def results(library, names):
    """Mean and covariance ``(T, ...)`` after the lines of a library."""
    if library == "torch-kf":
        return names["states"].mean[..., 0].numpy(), names["states"].covariance.numpy()
    if library == "statsmodels":
        found = names["result"]
        return found.filtered_state.T, found.filtered_state_cov.transpose(2, 0, 1)
    covariance = np.asarray(names["covariance"])
    return np.asarray(names["mean"]).reshape(len(covariance), -1), covariance


@pytest.mark.parametrize(("library", "there", "here"), LINES, ids=[f"{line[0]} {i}" for i, line in enumerate(LINES)])
def test_a_line_of_another_library_and_the_line_here_give_the_same(library, there, here):
    P = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 1.5]])
    Q0 = Q[0] + 0.1 * np.eye(N)
    given = {"F": F[0], "H": H[0], "Q": Q0, "R": R, "x": np.array([1.0, -0.5, 0.3]), "P": P, "z": Z.numpy(), "np": np}
    names = given | {"presets": presets, "Linear": Linear, "sensors": sensors, "Gaussian": Gaussian}
    exec(here, names)
    now = library != "filterpy"  # measured at the time of the prior
    root = np.linalg.cholesky(Q0)
    steps = (lambda k: F[0] if k else np.eye(N), lambda k: root * (k > 0)) if now else (F[0], root)
    model, found = expected(*steps, R, H[0], mean=given["x"], P=P)
    if "smooth" in there:
        found = oracles.whole_track(Z.numpy(), given["x"], P, model)
    agree(names["estimate"], {"mean": found["mean"], "P": found["P"]})
    try:
        exec(NAMES[library], names)
    except ModuleNotFoundError as error:
        pytest.skip(f"the line here is that of numpy; {error}")
    kind = torch.from_numpy if library == "torch-kf" else np.array
    names |= {name: kind(value) for name, value in given.items() if name != "np"}
    exec(there, names)
    for ours, theirs in zip((found["mean"], found["P"]), results(library, names), strict=True):
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-9)


def test_every_library_of_the_table_has_its_lines():
    assert {line[0] for line in LINES} == set(NAMES)
