"""Joint association by going through every event; Fortmann, Bar-Shalom & Scheffe (1983); Chen, Zou & Wu, (25)-(27)."""

from __future__ import annotations

import itertools
import math

import numpy as np

from oracles.basics import Array


def joint_events(L: Array, PD: float, c: Array, diffuse: bool, PG: float = 1.0) -> tuple[Array, Array]:
    """Marginals (J,N) and (N,) by going through every event of every cluster: eqs. (25)-(27).

    L (J,N) likelihoods, 0 outside the gate; c (J,) density of false measurements at each; PD, PG probabilities of
    detection and of the gate; ``diffuse`` takes the number of false measurements as unknown, otherwise it is Poisson.
    """
    beta, missed = np.zeros(L.shape), np.zeros(L.shape[1])
    for targets, gated in clusters(L):
        total = 0.0
        for weight, chosen in every_event(targets, gated, L, PD, c, PG):
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


def clusters(L: Array) -> list[tuple[list[int], list[int]]]:
    """Targets that share measurements, directly or through others, and the measurements in their gates."""
    J, N = L.shape
    found, left = [], set(range(N))
    while left:
        cluster, edge = set(), {min(left)}
        while edge:
            cluster |= edge
            touched = {j for j in range(J) for t in edge if L[j, t] > 0}
            edge = {t for t in range(N) for j in touched if L[j, t] > 0} - cluster
        left -= cluster
        found.append((sorted(cluster), [j for j in range(J) if any(L[j, t] > 0 for t in cluster)]))
    return found


def joint_existence(L: Array, PD: float, c: Array, PG: float, exists: list[float]) -> tuple[Array, Array, Array]:
    """JIPDA, Musicki & Evans (2004): as below, of targets that are always visible."""
    beta, missed, _, absent = joint_visibility(L, PD, c, PG, exists, [1.0] * len(exists))
    return beta, missed, absent


def joint_visibility(
    L: Array, PD: float, c: Array, PG: float, exists: list[float], visible: list[float]
) -> tuple[Array, Array, Array, Array]:
    """Brekke, Hem & Tokle (2021), of one model, by going through everything that may be true of every cluster.

    Arguments as above, the probability that each target exists, and that it is visible then.  Probabilities (J,N) that
    a target exists and has a measurement, (N,) that it is visible and was missed, (N,) that it exists and is hidden,
    and (N,) that it does not exist.
    """
    beta, (missed, hidden, absent) = np.zeros(L.shape), np.zeros((3, L.shape[1]))
    for targets, gated in clusters(L):
        total = 0.0
        for how in itertools.product(["absent", "hidden", "visible"], repeat=len(targets)):
            is_now = dict(zip(targets, how, strict=True))
            prior = math.prod(
                {"absent": 1 - r, "hidden": r * (1 - v), "visible": r * v}[is_now[t]]
                for t, r, v in ((t, exists[t], visible[t]) for t in targets)
            )
            seen = [t for t in targets if is_now[t] == "visible"]
            for weight, chosen in every_event(seen, gated, L, PD, c, PG):
                total += prior * weight
                for t in targets:
                    if is_now[t] == "absent":
                        absent[t] += prior * weight
                    elif is_now[t] == "hidden":
                        hidden[t] += prior * weight
                    elif chosen[t] is None:
                        missed[t] += prior * weight
                    else:
                        beta[chosen[t], t] += prior * weight
        for t in targets:
            for chances in (beta.T, missed, hidden, absent):
                chances[t] /= total
    return beta, missed, hidden, absent


def every_event(
    targets: list[int], free: list[int], L: Array, PD: float, c: Array, PG: float
) -> list[tuple[float, dict[int, int | None]]]:
    """All events: their weight against one of false measurements alone, and the measurement of each target."""
    if not targets:
        return [(1.0, {})]
    t, others = targets[0], targets[1:]
    events = [(w * (1 - PD * PG), {t: None} | rest) for w, rest in every_event(others, free, L, PD, c, PG)]
    for j in free:
        if L[j, t] > 0:
            left = [i for i in free if i != j]
            events += [(w * PD * L[j, t] / c[j], {t: j} | rest) for w, rest in every_event(others, left, L, PD, c, PG)]
    return events
