"""Interacting Kalman filters in moment form; Blom & Bar-Shalom (1988), IEEE TAC 33(8):780-783."""

from __future__ import annotations

import math
from collections.abc import Callable

from oracles.basics import Array, Result, collect
from oracles.kalman import fit, update
from oracles.mixture import matched

Motion = Callable[[Array], tuple[Array, Array, Array]]  # mean (n,) -> F (n,n), known change of the state (n,), Q (n,n)
Chance = Callable[[int, int], float]  # P(model j now | model i was)
Beliefs = dict[int, tuple[Array, Array]]  # by number of the model: mean, covariance


def cycle(
    zk: Array, was: Beliefs, mu: dict[int, float], now: list[int], chance: Chance,
    models: list[Motion], H: Array, R: Array,
) -> tuple[Beliefs, dict[int, float], float]:  # fmt: skip
    """From the models that ran, with probabilities mu, to those that run now; Du & Zhang (2020), (5)-(11)."""
    after, scores = {}, {}
    for j in now:
        c = sum(chance(i, j) * mu[i] for i in was)
        x, P = matched([(chance(i, j) * mu[i] / c, *was[i]) for i in was])
        F, change, Q = models[j](x)
        x, P = F @ x + change, F @ P @ F.T + Q
        S, e = H @ P @ H.T + R, zk - H @ x
        after[j], scores[j] = update(x, P, S, P @ H.T, e), c * math.exp(fit(e, S)[1])
    total = sum(scores.values())
    return after, {j: scores[j] / total for j in now}, math.log(total)


def run(
    z: Array, mean0: Array, P0: Array, models: list[Motion], H: Array, R: Array, first: dict[int, float],
    select: Callable[[dict[int, float]], tuple[list[int], Chance]],
) -> Result:  # fmt: skip
    """One track from models with probabilities `first`; select(mu) is the models of the next step and their chances."""
    beliefs, mu, steps = dict.fromkeys(first, (mean0, P0)), first, []
    for zk in z:
        beliefs, mu, score = cycle(zk, beliefs, mu, *select(mu), models, H, R)
        x, P = matched([(mu[j], *beliefs[j]) for j in mu])
        probabilities = [mu.get(j, 0.0) for j in range(len(models))]
        steps.append({"mean": x, "P": P, "probabilities": probabilities, "log_likelihood": score})
    return collect(steps)


def imm(
    z: Array, mean0: Array, P0: Array, models: list[Motion], H: Array, R: Array, transition: Array, initial: Array
) -> Result:
    """Interacting multiple models, one track; transition[i, j] = P(now j | was i), initial probabilities."""
    every = list(range(len(models)))
    chance = lambda i, j: float(transition[i, j])  # noqa: E731
    return run(z, mean0, P0, models, H, R, dict(enumerate(initial)), lambda mu: (every, chance))
