"""Joint association around filters of several hypotheses: Chen & Tugnait (2001) for interacting models, and for GPB2.

Every measurement in a target's gate, and that there is none, leads to a state of its own, in plain loops; what a filter
keeps apart (models; outlier modes and motions) is merged apart, weighted by the probabilities of association.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from oracles import gpb
from oracles.basics import Array, Result, collect
from oracles.events import joint_events
from oracles.imm import Beliefs, Motion, cycle
from oracles.mixture import matched


class Target(NamedTuple):
    """How one target is followed."""

    start: Any  # state
    step: Callable[[Any, Array, int], tuple[Any, float, Array, Array]]  # state, z, k -> state, score, mean, P
    merge: Callable[[list[tuple[float, Any]]], Any]  # (probability, state), several -> state


def follow(z: Array, targets: list[Target], *, PD: float, density: float, gate: float, diffuse: bool) -> Result:
    """Scans z (T,J,m) of positions; gates in metres around the predicted position."""
    states, steps = [t.start for t in targets], []
    for k, scan in enumerate(z):
        J, N = len(scan), len(targets)
        nothing = np.full(scan.shape[-1], np.nan)
        found = [[t.step(s, zj, k) for zj in [nothing, *scan]] for t, s in zip(targets, states, strict=True)]
        L = np.zeros((J, N))
        for i in range(N):
            for j in range(J):
                if np.linalg.norm(scan[j] - found[i][0][2][:2]) <= gate:  # NaN is in no gate
                    L[j, i] = math.exp(found[i][j + 1][1])
        beta, missed = joint_events(L, PD, np.full(J, density), diffuse)
        means, covariances = [], []
        for i, t in enumerate(targets):
            weights = [missed[i], *beta[:, i]]
            some = [(w, f) for w, f in zip(weights, found[i], strict=True) if w > 0]
            states[i] = t.merge([(w, f[0]) for w, f in some])
            mean, P = matched([(w, f[2], f[3]) for w, f in some])
            means.append(mean)
            covariances.append(P)
        association = np.vstack([missed, beta]).T
        probabilities = np.array([told(s) for s in states])
        steps.append({"mean": np.array(means), "P": np.array(covariances), "association": association,
                      "probabilities": probabilities})  # fmt: skip
    return collect(steps)


def told(state: Any) -> Array:
    """Probabilities of the models, or of the regimes."""
    if isinstance(state, gpb.State):
        return np.exp(state.log_regimes).sum(0)
    return np.array([state[1][j] for j in sorted(state[1])])


def models(
    mean: Array, P: Array, motions: list[Motion], H: Array, R: Array, transition: Array, initial: Array
) -> Target:
    """Interacting models; a state is their beliefs and their probabilities."""
    every = list(range(len(motions)))

    def step(state: Any, z: Array, k: int) -> tuple[Any, float, Array, Array]:
        seen = [i for i in range(len(z)) if not math.isnan(z[i])]
        chance = lambda i, j: float(transition[i, j])  # noqa: E731
        beliefs, mu, score = cycle(z[seen], *state, every, chance, motions, H[seen], R[np.ix_(seen, seen)])
        return (beliefs, mu), score, *matched([(mu[j], *beliefs[j]) for j in every])

    def merge(parts: list[tuple[float, Any]]) -> Any:
        mu = {j: sum(w * s[1][j] for w, s in parts) for j in every}
        beliefs: Beliefs = {j: matched([(w * s[1][j] / mu[j], *s[0][j]) for w, s in parts]) for j in every}
        return beliefs, mu

    return Target((dict.fromkeys(every, (mean, P)), dict(enumerate(initial))), step, merge)


def regimes(
    mean: Array, P: Array, motions: list[gpb.Propagate], model: Any, r: gpb.Regimes, q: gpb.OutlierModes,
    prior_outlier: float, prior_inflation: float,
) -> Target:  # fmt: skip
    """GPB2 over regimes and outlier modes."""
    motion = r.beliefs

    def step(state: Any, z: Array, k: int) -> tuple[Any, float, Array, Array]:
        after, output, _ = gpb.step(state, z, motions, model, r, q, slice(0, 2), k)
        return after, output["log_likelihood"], output["mean"], output["P"]

    def merge(parts: list[tuple[float, Any]]) -> Any:
        chances = sum(w * np.exp(s.log_regimes) for w, s in parts)  # of mode and regime
        beliefs = {}
        for mode, m in parts[0][1].beliefs:
            of = [i for i in range(len(motion)) if motion[i] == m]
            each = [w * np.exp(s.log_regimes[mode, of]).sum() for w, s in parts]
            found = [s.beliefs[mode, m] for _, s in parts]
            parts_of = [w / sum(each) for w in each] if sum(each) else [1.0, *[0.0] * (len(each) - 1)]
            beliefs[mode, m] = matched([(w, *b) for w, b in zip(parts_of, found, strict=True)])
        dirty = [w * np.exp(s.log_regimes[1]).sum() for w, s in parts]
        outlier = sum(w / sum(dirty) * s.outlier for w, (_, s) in zip(dirty, parts, strict=True))
        modes = np.array([w * np.exp(s.log_regimes).sum(1) for w, s in parts])
        unreliable = sum(w[:, None] * s.unreliable for w, (_, s) in zip(modes / modes.sum(0), parts, strict=True))
        nothing = np.full_like(parts[0][1].last, np.nan)  # no measurement is one target's alone
        count = -np.log2(sum(w * 0.5**s.count for w, s in parts))
        since, wider = (sum(w * getattr(s, name) for w, s in parts) for name in ("since", "wider"))
        with np.errstate(divide="ignore"):
            logs = np.log(chances)
        outlier, unreliable = np.asarray(outlier), np.asarray(unreliable)
        return gpb.State(beliefs, logs, outlier, nothing, unreliable, since=since, count=count, wider=wider)

    return Target(gpb.start(mean, P, r, q, prior_outlier, prior_inflation), step, merge)
