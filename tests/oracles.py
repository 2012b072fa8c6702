"""Independent reference filters: plain numpy, one track, explicit loops, covariance form.

Written straight from the equations of Wang et al. 2021 (J. Air Force Eng. Univ. 22(1):70-76; "eq. (n)" below) and
Arasaratnam & Haykin 2009 (IEEE TAC 54(6):1254-1269). Shapes: n states, m measured elements, T steps. Row k of `z`
(counted from 0) is measured after the transition F(k), Q(k) from the step before (row 0: from the initial state).
NaN elements of `z` are missing. Every filter returns a dict with

    mean (T,n), P (T,n,n), weights (T,m), fading (T,)
    nis (T,), log_likelihood (T,)   of the unweighted innovation, nominal R, unfaded prediction, seen elements only

weights and fading are 1 where nothing was down-weighted or faded; nis and log_likelihood are 0 where nothing is seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Rule = tuple[Array, Array, Array]
Posterior = tuple[Array, Array, Array, float]  # mean, P, weights of the seen elements, fading factor
Result = dict[str, Array]


class Model(NamedTuple):
    """x_k = F x_{k-1} + SQ w, z_k = h(x_k, k) + SR v. F, SQ and SR may also be callables of k."""

    F: Array | Callable[[int], Array]  # (n,n)
    SQ: Array | Callable[[int], Array]  # (n,r), Q = SQ SQ^T
    SR: Array | Callable[[int], Array]  # (m,m) lower triangular, R = SR SR^T
    h: Callable[[Array, int], Array]  # (n,), k -> (m,)
    angles: Array  # (m,) True where the element is an angle


class Measured(NamedTuple):
    """Predicted measurement of the s seen elements."""

    zhat: Array  # (s,)
    Pzz: Array  # (s,s), nominal R included
    Pxz: Array  # (n,s)
    e: Array  # (s,) innovation, angles wrapped
    H: Array  # (s,n) statistical regression
    S: Array  # (n,n) lower Cholesky factor of P


class Prior(NamedTuple):
    """Unfaded prediction of one step, compared with its measurement."""

    mean: Array  # (n,)
    P: Array  # (n,n) = J + Q
    J: Array  # (n,n) = F P F^T
    Q: Array  # (n,n)
    seen: list[int]  # the s seen elements
    SR: Array  # (s,s) noise square root of the seen elements
    at: Measured
    v: Array  # (s,) = SR^-1 e
    nis: float
    log_likelihood: float


class Fade(NamedTuple):
    """Options of the fading factors, eqs. (31)-(34)."""

    weakening: float = 2.0  # beta
    forgetting: float = 0.95  # rho
    rcond: float = 0.1  # singular values up to rcond times the largest are dropped in the pseudo-inverse
    fading_max: float = 1e3
    trace: str = "full"  # or "position"
    groups: tuple[tuple[int, int, float], ...] = ((0, 2, 1.0),)  # first state, one past the last, share of the excess


# ---------------------------------------------------------------------------------------------- small tools and models


def wrap(a: Any) -> Any:
    """Angle(s) into [-pi, pi)."""
    return np.mod(np.asarray(a) + np.pi, 2 * np.pi) - np.pi


def tria(A: Array) -> Array:
    """Lower-triangular S (p,p) with S S^T = A A^T and a non-negative diagonal; A is (p,r), r >= p."""
    S = np.linalg.qr(A.T)[1].T
    return S * np.where(np.diag(S) < 0, -1.0, 1.0)


def ca(dt: float, q: float) -> tuple[Array, Array]:
    """Constant acceleration, eqs. (1)-(5): F (6,6) and SQ (6,2) on [x, y, vx, vy, ax, ay]; q is a variance."""
    F = np.kron(np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]]), np.eye(2))
    return F, math.sqrt(q) * np.kron(np.array([[dt**2 / 2], [dt], [1]]), np.eye(2))


def cv(dt: float, q: float) -> tuple[Array, Array]:
    """Constant velocity: F (4,4) and SQ (4,2) on [x, y, vx, vy]."""
    F = np.kron(np.array([[1, dt], [0, 1]]), np.eye(2))
    return F, math.sqrt(q) * np.kron(np.array([[dt**2 / 2], [dt]]), np.eye(2))


def turn(dt: float, rate: float, q: float) -> tuple[Array, Array]:
    """Coordinated turn of known rate (rad/s, counter-clockwise positive): F (4,4), SQ (4,2) on [x, y, vx, vy]."""
    (F, SQ), s, c = cv(dt, q), math.sin(rate * dt), math.cos(rate * dt)
    if rate != 0:
        less = 2 * math.sin(rate * dt / 2) ** 2  # 1 - c, without cancellation at small rates
        F[:2, 2:] = np.array([[s, -less], [less, s]]) / rate
        F[2:, 2:] = np.array([[c, -s], [s, c]])
    return F, SQ


def bearings(x: Array, stations: Array) -> Array:
    """Bearings (k,) of the position x[:2] from stations (k,2), from +y, clockwise positive, eq. (6)."""
    return np.array([math.atan2(x[0] - sx, x[1] - sy) for sx, sy in stations])


def range_bearing(x: Array, station: Array) -> Array:
    """Distance and bearing (2,) of the position x[:2] from one station (2,)."""
    dx, dy = x[0] - station[0], x[1] - station[1]
    return np.array([math.hypot(dx, dy), math.atan2(dx, dy)])


def position(x: Array) -> Array:
    """The position x[:2]."""
    return np.array(x[:2])


def third_degree(n: int) -> Rule:
    """Cubature points (n,2n), mean weights, covariance weights (Arasaratnam & Haykin 2009)."""
    weights = np.full(2 * n, 1 / (2 * n))
    return math.sqrt(n) * np.hstack([np.eye(n), -np.eye(n)]), weights, weights.copy()


def unscented(n: int, alpha: float = 1.0, beta: float = 0.0, kappa: float = 1.0) -> Rule:
    """Scaled unscented points (n,2n+1), centre first, mean weights, covariance weights."""
    spread = alpha**2 * (n + kappa)
    points = math.sqrt(spread) * np.hstack([np.zeros((n, 1)), np.eye(n), -np.eye(n)])
    mean = np.full(2 * n + 1, 1 / (2 * spread))
    mean[0] = (spread - n) / spread
    cov = mean.copy()
    cov[0] += 1 - alpha**2 + beta
    return points, mean, cov


# -------------------------------------------------------------------------------------------------------- filter steps


def _at(value: Any, k: int) -> Array:
    """A constant, or a callable's value at step k."""
    return np.array(value(k) if callable(value) else value, dtype=float)


def _cholesky(P: Array) -> Array:
    """Lower Cholesky factor, NaN where there is none (a branch that broke down)."""
    try:
        return np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return np.full_like(P, np.nan)


def _seen(z: Array) -> list[int]:
    """Indices of the elements of z (m,) that are not missing."""
    return [i for i, value in enumerate(z) if not math.isnan(value)]


def _noise(model: Model, k: int, seen: list[int]) -> Array:
    """R (s,s) of the seen elements."""
    SR = _at(model.SR, k)
    return (SR @ SR.T)[np.ix_(seen, seen)]


def _difference(a: Array, b: Array, angles: Array) -> Array:
    """a - b, wrapped where it is an angle."""
    return np.where(angles, wrap(a - b), a - b)


def predict(mean: Array, P: Array, model: Model, k: int) -> tuple[Array, Array]:
    """Mean and covariance after the transition to step k, eqs. (8)-(13), which are exact for a linear model."""
    F, SQ = _at(model.F, k), _at(model.SQ, k)
    return F @ mean, F @ P @ F.T + SQ @ SQ.T


def measure(mean: Array, P: Array, z: Array, model: Model, k: int, rule: Rule) -> Measured:
    """Predicted measurement from fresh points, eqs. (14)-(21); z (m,), only its seen elements are kept."""
    points, wm, wc = rule
    seen = _seen(z)
    angles = np.asarray(model.angles, dtype=bool)[seen]
    S = _cholesky(P)
    centre = model.h(mean, k)[seen]
    X = [mean + S @ points[:, j] for j in range(points.shape[1])]
    offsets = [_difference(model.h(x, k)[seen], centre, angles) for x in X]
    shift = np.zeros(len(seen))
    for w, offset in zip(wm, offsets, strict=True):
        shift += w * offset
    Pzz = _noise(model, k, seen)
    Pxz = np.zeros((len(mean), len(seen)))
    for w, x, offset in zip(wc, X, offsets, strict=True):
        Pzz += w * np.outer(offset - shift, offset - shift)
        Pxz += w * np.outer(x - mean, offset - shift)
    zhat = centre + shift
    H = Pxz.T @ np.linalg.inv(P)
    return Measured(zhat, Pzz, Pxz, _difference(np.asarray(z)[seen], zhat, angles), H, S)


def update(mean: Array, P: Array, Pzz: Array, Pxz: Array, e: Array) -> tuple[Array, Array]:
    """Posterior mean and covariance P - W Pzz W^T, eqs. (22)-(24)."""
    W = Pxz @ np.linalg.inv(Pzz)
    P = P - W @ Pzz @ W.T
    return mean + W @ e, (P + P.T) / 2


def _fit(e: Array, Pzz: Array) -> tuple[float, float]:
    """Normalised innovation squared, eq. (35), and Gaussian log density of an innovation."""
    if not np.isfinite(Pzz).all():
        return math.nan, math.nan
    nis = float(e @ np.linalg.inv(Pzz) @ e)
    return nis, -0.5 * (nis + float(np.linalg.slogdet(Pzz)[1]) + len(e) * math.log(2 * math.pi))


def _prior(mean: Array, P: Array, z: Array, model: Model, k: int, rule: Rule) -> Prior:
    """Predict to step k and compare with z (m,)."""
    F, SQ = _at(model.F, k), _at(model.SQ, k)
    J, Q, seen = F @ P @ F.T, SQ @ SQ.T, _seen(z)
    mean, P = predict(mean, P, model, k)
    at = measure(mean, P, z, model, k, rule)
    SR = np.linalg.cholesky(_noise(model, k, seen))
    return Prior(mean, P, J, Q, seen, SR, at, np.linalg.inv(SR) @ at.e, *_fit(at.e, at.Pzz))


def huber(v: Array, threshold: float | Array) -> Array:
    """Weights min(1, threshold / |v|), eqs. (25)-(26); one threshold, or one for each of v."""
    pairs = zip(v, np.broadcast_to(threshold, v.shape), strict=True)
    return np.array([1.0 if abs(a) < c else c / abs(a) for a, c in pairs])


def igg(tau: float, low: float, high: float, variant: str = "distance") -> float:
    """Three-segment weight on d = sqrt(tau), or on tau itself (variant "tau"); thresholds on d^2."""
    d, near, far = (tau, low, high) if variant == "tau" else (math.sqrt(tau), math.sqrt(low), math.sqrt(high))
    if d <= near:
        return 1.0
    return near / d * ((far - d) / (far - near)) ** 2 if d < far else 0.0


def remember(V: Array, v: Array, seen: list[int], forgetting: float) -> Array:
    """Innovation memory V (m,m) in units of the noise, eq. (31), entry by entry; NaN = not met before."""
    V = V.copy()
    for a, i in enumerate(seen):
        for b, j in enumerate(seen):
            product = v[a] * v[b]
            V[i, j] = product if math.isnan(V[i, j]) else (forgetting * V[i, j] + product) / (1 + forgetting)
    return V


def fading_terms(p: Prior, V: Array, weights: Array, fade: Fade) -> tuple[float, float]:
    """tr N and tr J, eqs. (32)-(33), whitened by the noise, which is diag(1 / weights) (s,) in its own units."""
    H = np.linalg.inv(p.SR) @ p.at.H
    if not np.isfinite(H).all():
        return math.nan, math.nan
    G = np.linalg.pinv(H, rcond=fade.rcond)
    N = G @ (V[np.ix_(p.seen, p.seen)] - H @ p.Q @ H.T - fade.weakening * np.diag(1 / weights)) @ G.T
    size = 2 if fade.trace == "position" else len(p.J)
    return float(np.trace(N[:size, :size])), float(np.trace(p.J[:size, :size]))


def _faded(p: Prior, V: Array, weights: Array, z: Array, model: Model, k: int, rule: Rule, fade: Fade) -> Posterior:
    """Fade the position covariance, eqs. (29) and (34), measure again and update with SR diag(1 / weights) SR^T."""
    trN, trJ = fading_terms(p, V, weights, fade)
    factor = min(max(1.0, trN / trJ), fade.fading_max) if math.isfinite(trN) else 1.0
    scales = np.ones(len(p.mean))
    for low, high, share in fade.groups:
        scales[low:high] = math.sqrt(1 + share * (factor - 1))
    L = np.diag(scales)
    P = L @ p.J @ L.T + p.Q
    at = measure(p.mean, P, z, model, k, rule)
    return *update(p.mean, P, _inflated(at.Pzz, p.SR, weights), at.Pxz, at.e), weights, factor


def _inflated(Pzz: Array, SR: Array, weights: Array) -> Array:
    """Pzz with R = SR SR^T replaced by SR diag(1 / weights) SR^T."""
    return np.asarray(Pzz + SR @ np.diag(1 / weights - 1) @ SR.T)


def _weighted(p: Prior, weights: Array) -> Posterior:
    """Update of the unfaded prediction with weights (s,)."""
    return *update(p.mean, p.P, _inflated(p.at.Pzz, p.SR, weights), p.at.Pxz, p.at.e), weights, 1.0


def _result(steps: list[dict[str, Any]]) -> Result:
    """Stack the steps."""
    return {key: np.array([step[key] for step in steps]) for key in steps[0]}


def _step(p: Prior, posterior: Posterior, m: int) -> dict[str, Any]:
    """One step of a result."""
    mean, P, seen_weights, fading = posterior
    weights = np.ones(m)
    weights[p.seen] = seen_weights
    step: dict[str, Any] = {"mean": mean, "P": P, "weights": weights, "fading": fading}
    return step | {"nis": p.nis, "log_likelihood": p.log_likelihood}


# ------------------------------------------------------------------------------------------------------------- filters


def numerical_jacobian(model: Model) -> Callable[[Array, int], Array]:
    """Central differences of h: a function of (x (n,), k) -> (m,n)."""

    def jacobian(x: Array, k: int) -> Array:
        columns = []
        for j in range(len(x)):
            d = np.zeros(len(x))
            d[j] = 6e-6 * max(1.0, abs(x[j]))
            columns.append(_difference(model.h(x + d, k), model.h(x - d, k), model.angles) / (2 * d[j]))
        return np.array(columns).T

    return jacobian


def ekf(
    z: Array, mean0: Array, P0: Array, model: Model, jacobian: Callable[[Array, int], Array] | None = None
) -> Result:
    """Extended Kalman filter; jacobian(x (n,), k) -> (m,n), numerical where it is not given."""
    jacobian = jacobian or numerical_jacobian(model)
    mean, P, steps = np.array(mean0, dtype=float), np.array(P0, dtype=float), []
    for k in range(len(z)):
        mean, P = predict(mean, P, model, k)
        seen = _seen(z[k])
        H = jacobian(mean, k)[seen]
        e = _difference(z[k][seen], model.h(mean, k)[seen], np.asarray(model.angles, dtype=bool)[seen])
        Pzz = H @ P @ H.T + _noise(model, k, seen)
        mean, P = update(mean, P, Pzz, P @ H.T, e)
        nis, ll = _fit(e, Pzz)
        ones = np.ones(len(z[k]))
        steps.append({"mean": mean, "P": P, "nis": nis, "log_likelihood": ll, "weights": ones, "fading": 1.0})
    return _result(steps)


def kalman(z: Array, mean0: Array, P0: Array, model: Model, H: Array | Callable[[int], Array]) -> Result:
    """Kalman filter with z = H x (m,n), or H(k); model.h is not used."""
    linear = model._replace(h=lambda x, k: _at(H, k) @ x)
    return ekf(z, mean0, P0, linear, jacobian=lambda x, k: _at(H, k))


def _run(z: Array, mean0: Array, P0: Array, model: Model, rule: Rule, act: Callable[[Prior, int], Posterior]) -> Result:
    """Filter with one hypothesis; act(prior, k) is its update."""
    mean, P, steps = np.array(mean0, dtype=float), np.array(P0, dtype=float), []
    for k in range(len(z)):
        p = _prior(mean, P, z[k], model, k, rule)
        posterior = act(p, k)
        mean, P = posterior[:2]
        steps.append(_step(p, posterior, z.shape[1]))
    return _result(steps)


def srckf(z: Array, mean0: Array, P0: Array, model: Model) -> Result:
    """Cubature Kalman filter, eqs. (7)-(24)."""
    return _run(z, mean0, P0, model, third_degree(len(mean0)), lambda p, k: _weighted(p, np.ones(len(p.seen))))


def ukf(
    z: Array, mean0: Array, P0: Array, model: Model, alpha: float = 1.0, beta: float = 0.0, kappa: float = 1.0
) -> Result:
    """Unscented Kalman filter, fresh points for the measurement."""
    rule = unscented(len(mean0), alpha, beta, kappa)
    return _run(z, mean0, P0, model, rule, lambda p, k: _weighted(p, np.ones(len(p.seen))))


def rsrckf(z: Array, mean0: Array, P0: Array, model: Model, threshold: float = 1.345) -> Result:
    """Huber-weighted cubature filter, eqs. (25)-(26)."""
    return _run(z, mean0, P0, model, third_degree(len(mean0)), lambda p, k: _weighted(p, huber(p.v, threshold)))


def mr_ckf(
    z: Array, mean0: Array, P0: Array, model: Model, low: float = 5.991, high: float = 1e4, variant: str = "distance"
) -> Result:
    """Cubature filter with one IGG-III weight per step, R / w; w = 0 skips the update."""

    def act(p: Prior, k: int) -> Posterior:
        weights = np.full(len(p.seen), igg(p.nis, low, high, variant))
        return _weighted(p, weights) if weights.all() else (p.mean, p.P, weights, 1.0)

    return _run(z, mean0, P0, model, third_degree(len(mean0)), act)


def rmckf(z: Array, mean0: Array, P0: Array, model: Model, threshold: float = 1.345, **fade: Any) -> Result:
    """Huber weights, eqs. (25)-(26), then fading with the weighted noise, eqs. (29)-(34); options of `Fade`."""
    rule, options = third_degree(len(mean0)), Fade(**fade)
    V = np.full((z.shape[1], z.shape[1]), np.nan)

    def act(p: Prior, k: int) -> Posterior:
        nonlocal V
        V = remember(V, p.v, p.seen, options.forgetting)
        return _faded(p, V, huber(p.v, threshold), z[k], model, k, rule, options)

    return _run(z, mean0, P0, model, rule, act)


def asrckf(z: Array, mean0: Array, P0: Array, model: Model, **fade: Any) -> Result:
    """Strong-tracking cubature filter, eqs. (29)-(34): weights 1 in `rmckf`; options of `Fade`."""
    return rmckf(z, mean0, P0, model, math.inf, **fade)


def _lead(robust: Prior, adaptive: Prior, decision: str, preference: float) -> float:
    """Log odds of the adaptive branch: feedback decision of section 2.2."""
    if decision == "likelihood":
        return adaptive.log_likelihood - robust.log_likelihood - preference
    return 0.5 * (robust.nis - adaptive.nis) - preference


def _adaptive_wins(robust: Prior, adaptive: Prior, decision: str, preference: float) -> bool:
    """A tie and a broken-down adaptive branch select the robust one."""
    if not (math.isfinite(robust.nis) and math.isfinite(adaptive.nis)):
        return math.isfinite(adaptive.nis)
    return _lead(robust, adaptive, decision, preference) > 0


def fra(
    z: Array,
    mean0: Array,
    P0: Array,
    model: Model,
    threshold: float | Array = 1.345,
    gate: float = 5.991,
    preference: float = 0.0,
    decision: str = "normalised",
    memory: str = "plain",
    final: str = "robust",
    **fade: Any,
) -> Result:
    """Feedback decision between the robust and the adaptive branch of an abnormal step, section 2.2.

    decision "normalised" or "likelihood"; memory "plain" or "weighted"; final (an abnormal last step) "robust",
    "adaptive" or "plain"; options of `Fade`. Besides the usual keys (weights and fading are those of what was kept):
    abnormal (T,), adaptive (T,) True where the adaptive branch was kept, provisional (T,n).
    """
    rule, options = third_degree(len(mean0)), Fade(**fade)
    V = np.full((z.shape[1], z.shape[1]), np.nan)
    steps: list[dict[str, Any]] = []
    p = _prior(np.array(mean0, dtype=float), np.array(P0, dtype=float), z[0], model, 0, rule)
    for k in range(len(z)):
        psi, ones = huber(p.v, np.broadcast_to(threshold, z.shape[1])[p.seen]), np.ones(len(p.seen))
        V_now = remember(V, p.v, p.seen, options.forgetting)
        V = remember(V, psi * p.v, p.seen, options.forgetting) if memory == "weighted" else V_now
        kept = provisional = _weighted(p, ones)
        abnormal, adaptive, following = bool(p.seen) and not p.nis <= gate, False, None
        if abnormal:
            provisional = robust = _weighted(p, psi)
            faded = _faded(p, V_now, ones, z[k], model, k, rule, options)
            if k + 1 < len(z):
                after_robust = _prior(*robust[:2], z[k + 1], model, k + 1, rule)
                after_faded = _prior(*faded[:2], z[k + 1], model, k + 1, rule)
                adaptive = _adaptive_wins(after_robust, after_faded, decision, preference)
                kept, following = (faded, after_faded) if adaptive else (robust, after_robust)
            else:
                adaptive = final == "adaptive"
                kept = {"robust": robust, "adaptive": faded, "plain": kept}[final]
        flags = {"abnormal": abnormal, "adaptive": adaptive, "provisional": provisional[0]}
        steps.append(_step(p, kept, z.shape[1]) | flags)
        if k + 1 < len(z):
            p = following or _prior(*kept[:2], z[k + 1], model, k + 1, rule)
    return _result(steps)


def _mixed(parts: list[tuple[float, Posterior]]) -> tuple[Array, Array]:
    """Mean and covariance of a mixture."""
    mean = sum(w * posterior[0] for w, posterior in parts)
    P = sum(w * (posterior[1] + np.outer(posterior[0] - mean, posterior[0] - mean)) for w, posterior in parts)
    return np.asarray(mean), np.asarray(P)


def _sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x)) if x > -700 else 0.0


def soft_fra(
    z: Array,
    mean0: Array,
    P0: Array,
    model: Model,
    temperature: float,
    threshold: float = 1.345,
    gate: float = 5.991,
    preference: float = 0.0,
    decision: str = "likelihood",
    memory: str = "weighted",
    **fade: Any,
) -> Result:
    """As `fra`, but every step is a mixture: abnormal by sigmoid((nis - gate) / temperature), and of that the adaptive
    branch by the sigmoid of its log odds over the temperature. An abnormal last step is robust. mean and P only."""
    rule, options = third_degree(len(mean0)), Fade(**fade)
    V = np.full((z.shape[1], z.shape[1]), np.nan)
    steps: list[dict[str, Any]] = []
    p = _prior(np.array(mean0, dtype=float), np.array(P0, dtype=float), z[0], model, 0, rule)
    for k in range(len(z)):
        psi, ones = huber(p.v, threshold), np.ones(len(p.seen))
        V_now = remember(V, p.v, p.seen, options.forgetting)
        V = remember(V, psi * p.v, p.seen, options.forgetting) if memory == "weighted" else V_now
        robust, faded = _weighted(p, psi), _faded(p, V_now, ones, z[k], model, k, rule, options)
        abnormal, adaptive = _sigmoid((p.nis - gate) / temperature), 0.0
        if k + 1 < len(z):
            ahead = [_prior(*branch[:2], z[k + 1], model, k + 1, rule) for branch in (robust, faded)]
            adaptive = _sigmoid(_lead(*ahead, decision, preference) / temperature)
        parts = [(1 - abnormal, _weighted(p, ones)), (abnormal * (1 - adaptive), robust), (abnormal * adaptive, faded)]
        mean, P = _mixed(parts)
        steps.append({"mean": mean, "P": P})
        if k + 1 < len(z):
            p = _prior(mean, P, z[k + 1], model, k + 1, rule)
    return _result(steps)


def _interacting(
    zk: Array,
    was: list[int],
    now: list[int],
    means: dict[int, Array],
    Ps: dict[int, Array],
    mu: dict[int, float],
    chance: Callable[[int, int], float],
    models: list[Callable[[Array], tuple[Array, Array, Array]]],
    H: Array,
    R: Array,
) -> tuple[dict[int, Array], dict[int, Array], dict[int, float], Array, Array, float]:
    """One cycle of interacting Kalman filters in moment form, models by number; Du & Zhang (2020), (5)-(11)."""
    m, n = H.shape
    new_means, new_Ps, scores = {}, {}, {}
    for j in now:
        c = sum(chance(i, j) * mu[i] for i in was)
        share = {i: chance(i, j) * mu[i] / c for i in was}
        x = sum((share[i] * means[i] for i in was), np.zeros(n))
        P = np.zeros((n, n))
        for i in was:
            P += share[i] * (Ps[i] + np.outer(means[i] - x, means[i] - x))
        F, change, Q = models[j](x)
        x, P = F @ x + change, F @ P @ F.T + Q
        S, e = H @ P @ H.T + R, zk - H @ x
        G = P @ H.T @ np.linalg.inv(S)
        new_means[j], new_Ps[j] = x + G @ e, P - G @ S @ G.T
        density = math.exp(-0.5 * e @ np.linalg.inv(S) @ e) / math.sqrt((2 * math.pi) ** m * np.linalg.det(S))
        scores[j] = c * density
    total = sum(scores.values())
    mu = {j: scores[j] / total for j in now}
    x = sum((mu[j] * new_means[j] for j in now), np.zeros(n))
    P = np.zeros((n, n))
    for j in now:
        P += mu[j] * (new_Ps[j] + np.outer(new_means[j] - x, new_means[j] - x))
    return new_means, new_Ps, mu, x, P, math.log(total)


def imm(
    z: Array,
    mean0: Array,
    P0: Array,
    models: list[Callable[[Array], tuple[Array, Array, Array]]],
    H: Array,
    R: Array,
    transition: Array,
    initial: Array,
) -> dict[str, Array]:
    """Interacting multiple models, one track; Blom & Bar-Shalom (1988).

    models: each gives F, the known change of the state and Q for the mean that a step starts from.
    """
    every = list(range(len(models)))
    means, Ps, mu = dict.fromkeys(every, mean0), dict.fromkeys(every, P0), dict(enumerate(initial))
    out: dict[str, list[Any]] = {"mean": [], "P": [], "weights": [], "log_likelihood": []}
    for zk in z:
        step = _interacting(zk, every, every, means, Ps, mu, lambda i, j: float(transition[i, j]), models, H, R)
        means, Ps, mu, x, P, score = step
        for key, value in (("mean", x), ("P", P), ("weights", [mu[j] for j in every]), ("log_likelihood", score)):
            out[key].append(value)
    return {key: np.array(value) for key, value in out.items()}


def likely_set(mu: dict[int, float], count: int, low: float, high: float, calls: list[list[int]]) -> list[int]:
    """The likely-model set at a fixed number of models; Li & Zhang (2000)."""
    principal = [r for r in mu if mu[r] > high]
    called = [j for r in principal for j in calls[r] if j not in principal]
    kept = sorted((r for r in mu if mu[r] >= low and r not in principal and r not in called), key=lambda r: (-mu[r], r))
    called = sorted(called, key=lambda r: (-mu.get(r, 0.0), r))
    deleted = sorted((r for r in mu if mu[r] < low and r not in called), key=lambda r: (-mu[r], r))
    return sorted((principal + called + kept + deleted)[:count])


def vsimm(
    z: Array,
    mean0: Array,
    P0: Array,
    models: list[Callable[[Array], tuple[Array, Array, Array]]],
    H: Array,
    R: Array,
    calls: list[list[int]],
    first: list[int],
    stay: float = 0.95,
    low: float = 0.05,
    high: float = 0.5,
) -> dict[str, Array]:
    """Interacting models with a set that changes, one track; Du & Zhang (2020), (4)-(11)."""
    active, size = sorted(first), len(first)
    means, Ps, mu = dict.fromkeys(active, mean0), dict.fromkeys(active, P0), dict.fromkeys(active, 1 / size)
    out: dict[str, list[Any]] = {"mean": [], "P": [], "weights": [], "log_likelihood": []}
    for zk in z:
        now = likely_set(mu, size, low, high, calls)

        def chance(i: int, j: int, now: list[int] = now) -> float:
            return 1 / size if i not in now else stay if i == j else (1 - stay) / (size - 1)

        means, Ps, mu, x, P, score = _interacting(zk, active, now, means, Ps, mu, chance, models, H, R)
        active = now
        weights = [mu.get(j, 0.0) for j in range(len(models))]
        for key, value in (("mean", x), ("P", P), ("weights", weights), ("log_likelihood", score)):
            out[key].append(value)
    return {key: np.array(value) for key, value in out.items()}


# --------------------------------------------------------------------------------------------------- Huber, Qin et al.


def huber_score(
    P: Array, H: Array, R: Array, s: Array, gamma: float, eps: float, whitening: str, cov_mode: str
) -> tuple[Array, Array]:
    """Mean and covariance after an innovation s (m,), Qin et al. (2018), eqs. (53)-(59), from mean 0."""
    Pzz, Pxz = H @ P @ H.T + R, P @ H.T
    if whitening == "symmetric":
        power, V = np.linalg.eigh(Pzz)
        L = V @ np.diag(np.sqrt(power)) @ V.T
    else:
        L = np.linalg.cholesky(Pzz)
    eta = np.linalg.inv(L) @ s
    theta = np.diag([1.0 if abs(e) < gamma else gamma / abs(e) for e in eta])
    W = Pxz @ np.linalg.inv(L).T
    if cov_mode == "indicator":
        lost = np.diag([1.0 if abs(e) < gamma else 0.0 for e in eta])
    else:
        lost = (1 - eps) * math.erf(gamma / math.sqrt(2)) * np.eye(len(s))
    return W @ theta @ eta, P - W @ lost @ W.T


def huber_regression(
    P: Array, H: Array, R: Array, s: Array, gamma: float, iterations: int, start: str
) -> tuple[Array, Array]:
    """Mean and covariance by iteratively reweighted regression on measurement and prediction, from mean 0."""
    m, n = H.shape
    T = np.zeros((m + n, m + n))
    T[:m, :m], T[m:, m:] = np.linalg.cholesky(R), np.linalg.cholesky(P)
    y = np.linalg.inv(T) @ np.concatenate([s, np.zeros(n)])
    M = np.linalg.inv(T) @ np.concatenate([H, np.eye(n)])
    delta = P @ H.T @ np.linalg.inv(H @ P @ H.T + R) @ s if start == "posterior" else np.zeros(n)

    def weights(delta: Array) -> Array:
        return np.diag([1.0 if abs(r) < gamma else gamma / abs(r) for r in M @ delta - y])

    for _ in range(iterations):
        psi = weights(delta)
        delta = np.linalg.inv(M.T @ psi @ M) @ M.T @ psi @ y
    return delta, np.linalg.inv(M.T @ weights(delta) @ M)


# ------------------------------------------------------------------------------------------------- the alpha-beta bank


def alphabeta_bank(
    z: Array,
    T: float,
    gains: list[tuple[float, float]],
    sigma: float,
    man: float,
    out: float,
    q: list[float],
    a_max: float,
    n_sigma: float,
    hyst: float = 0.5,
    dwell: int = 3,
    n: int = 2,
    patience: int = 5,
    converged: int = 5,
    flag_on_reject: str = "raw",
) -> dict[str, list[Any]]:
    """One axis, thresholds in metres: two-point start, vote, gate, switched gains, restart."""
    x, v = z[1], (z[1] - z[0]) / T
    count, rej, hist, state, quiet, last = 2, 0, [], False, 0, 0
    said: dict[str, list[Any]] = {key: [] for key in ("x", "v", "level", "vote", "state", "out", "restart")}
    for k in range(2, len(z)):
        xp = x + T * v
        r = z[k] - xp
        conv = count >= converged
        raw = abs(r) > (hyst if state else 1.0) * man
        vote = False
        if conv and len(hist) >= n:
            vote = sum([raw, *hist[-n:]]) > (n + 1) / 2
        if vote:
            quiet, new = 0, True
        else:
            quiet += 1
            new = state and quiet < dwell
        run = 0
        for flag in reversed(hist[-n:]):
            if not flag:
                break
            run += 1
        reach = 1 + rej + (run if rej == 0 else 0)
        outside = abs(r) > (0.5 * a_max * (reach * T) ** 2 + n_sigma * sigma if new else out)
        restart = False
        if outside:
            rej += 1
            if rej > patience:
                x, v, restart = z[k], (z[k] - z[k - 1]) / T, True
                count, rej, hist, quiet, last, new = 2, 0, [], 0, 0, False
            else:
                x = xp
                hist.append(raw if flag_on_reject == "raw" else vote)
        else:
            level = 0
            if conv:
                level = len(gains) - 1
                if new:
                    level = next((i for i, limit in enumerate(q) if abs(r) > limit), len(gains) - 2)
            alpha, beta = gains[level]
            x, v = xp + alpha * r, v + beta / (T * (1 + rej)) * r
            count, rej, last = count + 1, 0, level
            hist.append(raw)
        state = new
        for key, value in zip(said, (x, v, last, vote, state, outside, restart), strict=True):
            said[key].append(value)
    return said


# ------------------------------------------------------- modified spherical coordinates, noise estimate, joint
# association


def msc_axes(azimuth: float, elevation: float) -> tuple[Array, Array, Array]:
    """Unit vectors out, across and up of a line of sight, azimuth from north clockwise."""
    sb, cb, se, ce = math.sin(azimuth), math.cos(azimuth), math.sin(elevation), math.cos(elevation)
    return np.array([ce * sb, ce * cb, se]), np.array([cb, -sb, 0.0]), np.array([-se * sb, -se * cb, ce])


def msc_to_cartesian(xi: Array) -> Array:
    """Chen, Zou & Wu, eq. (1): [omega, elevation rate, d ln r / dt, azimuth, elevation, 1 / r] to Cartesian."""
    out, across, up = msc_axes(xi[3], xi[4])
    r = 1 / xi[5]
    return np.concatenate([r * out, r * (xi[2] * out + xi[0] * across + xi[1] * up)])


def msc_from_cartesian(X: Array) -> Array:
    """Eq. (2), by projections on the line of sight."""
    x, y, z = X[:3]
    azimuth, elevation, r = math.atan2(x, y) % (2 * math.pi), math.atan2(z, math.hypot(x, y)), math.sqrt(X[:3] @ X[:3])
    out, across, up = msc_axes(azimuth, elevation)
    v = X[3:]
    return np.array([v @ across / r, v @ up / r, v @ out / r, azimuth, elevation, 1 / r])


def msc_jacobian(xi: Array) -> Array:
    """Derivatives of eq. (2) by the Cartesian state, row by row from the product rule."""
    omega, climb, opening, azimuth, elevation, s = xi
    out, across, up = msc_axes(azimuth, elevation)
    tangent, nothing = math.tan(elevation), np.zeros(3)
    return np.array([
        np.concatenate([s * (-(opening - climb * tangent) * across - omega * out), s * across]),
        np.concatenate([s * (-opening * up - omega * tangent * across - climb * out), s * up]),
        np.concatenate([s * (omega * across + climb * up - opening * out), s * out]),
        np.concatenate([s / math.cos(elevation) * across, nothing]),
        np.concatenate([s * up, nothing]),
        np.concatenate([-(s**2) * out, nothing]),
    ])  # fmt: skip


class Tuned(NamedTuple):
    """Options of the noise estimate, eq. (19)."""

    b: float = 0.96
    confidence: tuple[float, float] = (0.5, 0.5)  # of infrared (elements 0, 1) and laser (2)
    measured: bool = False  # confidence in what is measured, not in what is known
    lowest: float = 0.25
    highest: float = 1e4
    warmup: int = 5
    residual: bool = False


class Unscented(NamedTuple):
    """A prediction and its measurement, R left out."""

    mean: Array
    P: Array
    zhat: Array
    Pzz: Array
    Pxz: Array


def _msc_moments(points: Array, wm: Array, wc: Array) -> tuple[Array, Array]:
    """Mean and deviations (k,n) of states whose azimuth is component 3, unwrapped around the first point."""
    gap = points - points[0]
    gap[:, 3] = wrap(gap[:, 3])
    mean = points[0] + wm @ gap
    return mean, gap - wm @ gap


def _msc_measured(mean: Array, points: Array, wm: Array, wc: Array) -> tuple[Array, Array]:
    h = np.array([[x[3], x[4], 1 / x[5]] for x in points])
    gap = h - h[0]
    gap[:, 0] = wrap(gap[:, 0])
    return h[0] + wm @ gap, gap - wm @ gap


def msc_predict(mean: Array, P: Array, F: Array, QC: Array, redraw: bool = True) -> Unscented:
    """Eqs. (11)-(18) with alpha 1, kappa 0, psi 2; ``redraw=False`` measures the propagated points, as printed."""
    base, wm, wc = unscented(6, 1.0, 2.0, 0.0)
    start = mean[:, None] + np.linalg.cholesky(P) @ base
    moved = np.array([msc_from_cartesian(F @ msc_to_cartesian(x)) for x in start.T])
    ahead, gap = _msc_moments(moved, wm, wc)
    J = msc_jacobian(ahead)
    P = gap.T @ np.diag(wc) @ gap + J @ QC @ J.T
    if redraw:
        gap = (np.linalg.cholesky(P) @ base).T
        moved = ahead + gap
    zhat, off = _msc_measured(ahead, moved, wm, wc)
    return Unscented(ahead, P, zhat, off.T @ np.diag(wc) @ off, gap.T @ np.diag(wc) @ off)


class MeasurementNoise(NamedTuple):
    """Estimated variances (3,), and updates so far (3,)."""

    R: Array
    count: Array


def sage_husa(noise: MeasurementNoise, R0: Array, target: Array, weight: Array, how: Tuned) -> MeasurementNoise:
    """Eq. (19), element by element; ``target`` (3,) is what the innovation says, ``weight`` (3,) how surely."""
    R, count = noise.R.copy(), noise.count.copy()
    for i in range(3):
        if weight[i] < 0.5:
            continue
        d = (1 - how.b) / (1 - how.b ** (count[i] + 2)) if how.b < 1 else 1 / (count[i] + 2)
        W = how.confidence[0 if i < 2 else 1]
        g = (W if how.measured else 1 - W) * weight[i]
        if count[i] >= how.warmup:
            R[i] = np.clip((1 - g * d) * R[i] + g * d * target[i], how.lowest * R0[i], how.highest * R0[i])
        count[i] += 1
    return MeasurementNoise(R, count)


def iaukf(
    z: Array, mean0: Array, P0: Array, F: Array, QC: Array, R0: Array, how: Tuned | None = None, redraw: bool = True
) -> dict[str, Array]:
    """One target without clutter, z (T,3), NaN missing; ``how=None`` leaves the noise as it is."""
    mean, P, noise, steps = mean0, P0, MeasurementNoise(R0, np.zeros(3)), []
    for row in z:
        u = msc_predict(mean, P, F, QC, redraw)
        seen = _seen(row)
        e = row - u.zhat
        e[0] = wrap(e[0])
        weight = np.array([float(i in seen) for i in range(3)])
        if how is not None and not how.residual:
            noise = sage_husa(noise, R0, e**2 - np.diag(u.Pzz), weight, how)
        mean, P = u.mean, u.P
        if seen:
            S = u.Pzz[np.ix_(seen, seen)] + np.diag(noise.R[seen])
            K = u.Pxz[:, seen] @ np.linalg.inv(S)
            mean, P = mean + K @ e[seen], P - K @ S @ K.T
        if how is not None and how.residual:
            zhat, Pzz = _msc_after(mean, P)
            r = row - zhat
            r[0] = wrap(r[0])
            noise = sage_husa(noise, R0, r**2 + np.diag(Pzz), weight, how)
        mean = mean.copy()
        mean[3] %= 2 * math.pi
        steps.append((mean, P, noise.R))
    return {key: np.array([step[i] for step in steps]) for i, key in enumerate(("mean", "P", "R"))}


def _msc_after(mean: Array, P: Array) -> tuple[Array, Array]:
    """What an updated belief predicts of the measurement, R left out."""
    base, wm, wc = unscented(6, 1.0, 2.0, 0.0)
    points = (mean[:, None] + np.linalg.cholesky(P) @ base).T
    zhat, off = _msc_measured(mean, points, wm, wc)
    return zhat, off.T @ np.diag(wc) @ off


def joint_events(L: Array, PD: float, c: Array, diffuse: bool, PG: float = 1.0) -> tuple[Array, Array]:
    """Marginals (J,N) and (N,) by going through every event of every cluster: eqs. (25)-(27).

    L (J,N) likelihoods, 0 where not gated; c (J,) density of false measurements at each.
    """
    J, N = L.shape
    beta, missed = np.zeros((J, N)), np.zeros(N)
    left = set(range(N))
    while left:
        cluster, edge = set(), {min(left)}
        while edge:
            cluster |= edge
            touched = {j for j in range(J) for t in edge if L[j, t] > 0}
            edge = {t for t in range(N) for j in touched if L[j, t] > 0} - cluster
        left -= cluster
        targets = sorted(cluster)
        gated = [j for j in range(J) if any(L[j, t] > 0 for t in targets)]
        total = 0.0
        for weight, chosen in _every(targets, gated, L, PD, c, PG):
            false = len(gated) - sum(j is not None for j in chosen.values())
            weight *= math.factorial(false) if diffuse else 1.0
            total += weight
            for t, j in chosen.items():
                if j is None:
                    missed[t] += weight
                else:
                    beta[j, t] += weight
        for t in targets:
            beta[:, t] /= total
            missed[t] /= total
    return beta, missed


def _every(
    targets: list[int], free: list[int], L: Array, PD: float, c: Array, PG: float
) -> list[tuple[float, dict[int, int | None]]]:
    """All events: their weight against one of false measurements alone, and the measurement of each target."""
    if not targets:
        return [(1.0, {})]
    t, others = targets[0], targets[1:]
    found = [(w * (1 - PD * PG), {t: None} | rest) for w, rest in _every(others, free, L, PD, c, PG)]
    for j in free:
        if L[j, t] > 0:
            left = [i for i in free if i != j]
            found += [(w * PD * L[j, t] / c[j], {t: j} | rest) for w, rest in _every(others, left, L, PD, c, PG)]
    return found


def jpda(
    z: Array, mean0: Array, P0: Array, F: Array, QC: Array, R0: Array, *, PD: float, gate: float, volume: float,
    how: Tuned | None = None, rate: float | None = None,
) -> dict[str, Array]:  # fmt: skip
    """IAUKF-JPDA, eqs. (10)-(30), on scans z (T,J,3); mean0 (N,6), P0 (N,6,6), F (N,6,6); a gate in metres."""
    N = len(mean0)
    means, Ps, noises = list(mean0), list(P0), [MeasurementNoise(R0, np.zeros(3)) for _ in range(N)]
    steps = []
    for scan in z:
        there = [j for j in range(len(scan)) if not np.isnan(scan[j]).any()]
        us = [msc_predict(means[t], Ps[t], F[t], QC) for t in range(N)]
        nu, L = np.zeros((N, len(scan), 3)), np.zeros((len(scan), N))
        c = np.ones(len(scan))
        for j in there:
            c[j] = (1.0 if rate is None else rate) * scan[j, 2] ** 2 * math.cos(scan[j, 1]) / volume
            for t in range(N):
                nu[t, j] = scan[j] - us[t].zhat
                nu[t, j, 0] = wrap(nu[t, j, 0])
                apart = _spot(scan[j]) - _spot(us[t].zhat)
                if np.linalg.norm(apart) <= gate:
                    S = us[t].Pzz + np.diag(noises[t].R)
                    far = min(0.5 * nu[t, j] @ np.linalg.solve(S, nu[t, j]), 600.0)  # in the gate, if barely possible
                    L[j, t] = math.exp(-far) / math.sqrt(np.linalg.det(2 * math.pi * S))
        beta, missed = joint_events(L, PD, c, rate is None)
        for t in range(N):
            u, b = us[t], beta[:, t]
            whole = 1 - missed[t]
            if how is not None and whole >= 0.5:
                target = (b[:, None] * nu[t] ** 2).sum(0) / b.sum() - np.diag(u.Pzz)
                noises[t] = sage_husa(noises[t], R0, target, np.full(3, b.sum()), how)
            S = u.Pzz + np.diag(noises[t].R)
            K = u.Pxz @ np.linalg.inv(S)
            bar = b @ nu[t]
            scatter = sum((b[j] * np.outer(nu[t, j], nu[t, j]) for j in there), np.zeros((3, 3))) - np.outer(bar, bar)
            means[t] = u.mean + K @ bar
            means[t][3] %= 2 * math.pi
            Ps[t] = u.P - b.sum() * K @ S @ K.T + K @ scatter @ K.T
        steps.append((np.array(means), np.array(Ps), np.vstack([missed, beta]).T, np.array([n.R for n in noises])))
    return {key: np.array([s[i] for s in steps]) for i, key in enumerate(("mean", "P", "association", "R"))}


def _spot(z: Array) -> Array:
    """Where a measurement of azimuth, elevation and range lies."""
    return z[2] * msc_axes(z[0], z[1])[0]
