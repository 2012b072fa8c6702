"""Targets that come and go in the plane, by plain loops: joint association, births, confirmation, deletion."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from oracles.basics import Array
from oracles.events import joint_events, joint_visibility
from oracles.extent import decide, take_over, weigh


@dataclass(eq=False)
class Target:
    """One target: what it has been through."""

    identity: int
    mean: Array
    P: Array
    hits: list[bool]
    score: float = 0.0
    best: float = 0.0
    confirmed: bool = False
    history: list[Array] = field(default_factory=list)
    misses: float = 0.0
    since: float = 0.0
    lived: float = 0.0
    gone: float = 0.0
    visible: list[float] = field(default_factory=lambda: [1.0, 1.0])
    host: Target | None = None
    host_identity: int = -1
    scans: float = 0.0
    odds: float = 0.0


def manage(
    scans: list[Array], *, std: float, q: float, dt: float, PD: float, PG: float, limit: float, density: float,
    birth: dict[str, float], confirm: dict[str, Any], misses: int | None, drop: float | None = None,
    looks: list[dict[str, Any]] | None = None, clutter_map: dict[str, float] | None = None,
    stitch: dict[str, float] | None = None, hide: dict[int, dict[str, float]] | None = None,
    extent: dict[str, float] | None = None,
) -> list[list[Target]]:  # fmt: skip
    """After each scan (J, 2) copies of the targets that are there; constant velocity, positions, Poisson clutter.

    ``looks`` has what a scan has of its own: its std, dt, PD or density, the number of its sensor, where that is and
    how far it sees.  ``hide`` has for the number of a sensor how long targets are seen and hidden on end.
    """
    one, none, H, hide = np.eye(2), np.zeros((2, 2)), np.eye(2, 4), hide or {}
    targets: list[Target] = []
    number, shown, own_PD = 0, [], PD
    waiting: dict[int, list[Free]] = {0: [], 1: []}  # of each sensor, measurements from which targets may begin
    seen: list[tuple[Array, float, int]] = []  # of the map: a position, its weight, the sensor
    claims: list[tuple[Array, float, int, Target]] = []  # of the map: what a target has claimed while it was tentative
    counted = [0.0, 0.0]  # scans of each sensor
    over: list[Target] = []  # confirmed targets that were deleted
    for z, look in zip(scans, looks or [{}] * len(scans), strict=True):
        std, dt = look.get("std", std), look.get("dt", dt)
        PD, density = look.get("PD", PD), look.get("density", density)
        F, G = np.block([[one, dt * one], [none, one]]), np.vstack([dt**2 / 2 * one, dt * one])
        R, Q = std**2 * one, q * G @ G.T
        likelihood = np.zeros((len(z), len(targets)))
        for t, target in enumerate(targets):
            target.mean, target.P = F @ target.mean, F @ target.P @ F.T + Q
            S = H @ target.P @ H.T + R
            for j in range(len(z)):
                e = z[j] - H @ target.mean
                nis = e @ np.linalg.solve(S, e)
                if nis <= limit:
                    likelihood[j, t] = math.exp(-nis / 2) / (2 * math.pi * math.sqrt(np.linalg.det(S)))
        excess, sensor, false = np.zeros(len(z)), look.get("sensor", 0), np.full(len(z), density)
        explained = np.zeros(len(targets))
        for s, chain in hide.items():
            for target in targets:
                target.visible[s] = reached(target.visible[s], dt, **chain)
        visible = [t.visible[sensor] for t in targets]
        if "lifetime" in confirm:
            exists = [math.exp(-dt / confirm["lifetime"]) / (1 + math.exp(-t.score)) for t in targets]
            beta, missed, hidden, absent = joint_visibility(likelihood, PD, false, PG, exists, visible)
            beta, missed, hidden = (x / (1 - absent) for x in (beta, missed, hidden))  # given that it exists
            scores = [(math.log(r / (1 - r)), math.log((1 - a) / a)) for r, a in zip(exists, absent, strict=True)]
        else:
            if not hide:
                beta, missed = joint_events(likelihood, PD, false, False, PG)
                hidden = np.zeros(len(targets))
            else:
                beta, missed, hidden, _ = joint_visibility(likelihood, PD, false, PG, [1.0] * len(targets), visible)
            scores = [
                (t.score, t.score + math.log((1 - v * PD * PG) / m))
                for t, v, m in zip(targets, visible, missed + hidden, strict=True)
            ]
        missed = missed + hidden
        if clutter_map is not None:
            left = math.exp(-dt / clutter_map["seconds"])
            seen, counted = [(x, w * left, s) for x, w, s in seen if w * left > 0.01], [n * left for n in counted]
            claims = [(x, w * left, s, t) for x, w, s, t in claims if w * left > 0.01]
            size, scans_of = clutter_map["size"], clutter_map["scans"] + counted[sensor]
            for j in range(len(z)):
                everything = sum(w * kernel(z[j] - x, size) for x, w, s in seen if s == sensor)
                excess[j] = math.log((density + everything / scans_of) / density)
                for t, target in enumerate(targets):
                    own = [(x, w) for x, w, s, of in claims if s == sensor and of is target]
                    whole = sum(w for _, w in own)
                    single = whole * kernel(z[j] - sum(w * x for x, w in own) / whole, size) if own else 0.0
                    others = everything - sum(w * kernel(z[j] - x, size) for x, w in own)
                    explained[t] += beta[j, t] * math.log((density + (others + single) / scans_of) / density)
            free_of = [1 - sum(beta[j, t] for t, x in enumerate(targets) if x.confirmed) for j in range(len(z))]
            seen += [(z[j], free_of[j], sensor) for j in range(len(z))]
            claims += [
                (z[j], min(beta[j, t], free_of[j]), sensor, target)
                for j in range(len(z))
                for t, target in enumerate(targets)
                if beta[j, t] > 0.01 and not target.confirmed
            ]
            counted[sensor] += 1
        outside = []
        for t, target in enumerate(targets):
            update(target, z, beta[:, t], missed[t], H, R)
            hit, (target.score, score) = bool(missed[t] < 0.5), scores[t]
            target.since, target.lived = 0.0 if hit else target.since + dt, target.lived + dt
            if "farthest" in look and not hit and np.linalg.norm(target.mean[:2] - look["place"]) > look["farthest"]:
                outside.append((target, target.host, target.scans, target.odds))
                continue
            target.score, target.visible[sensor] = score - explained[t], 1 - hidden[t]
            target.best = max(target.best, target.score)
            target.hits.append(hit)
            times = math.log(1 - visible[t] * PD * PG) / math.log(1 - own_PD * PG)
            target.misses = 0.0 if hit else target.misses + times
        claimed = beta
        if "lifetime" in confirm:
            claimed = beta / (1 + np.exp([-t.score for t in targets]))
        for target in over:
            target.since, target.gone = target.since + dt, target.gone + dt
        ending = [t for t in targets if ends(t, misses, drop)]
        if extent is not None:
            weigh(targets, missed, PD * PG, dt, extent)
            for target, host, scans_of_it, odds in outside:
                target.host, target.scans, target.odds = host, scans_of_it, odds
            kept = take_over(targets, extent)
            ending = [t for t in ending if t not in kept]
        over += [t for t in ending if t.confirmed]
        targets = [t for t in targets if t not in ending]
        unclaimed = 1 - claimed.sum(1)
        free = [(z[j], R, 0.0, unclaimed[j] * math.exp(-excess[j])) for j in range(len(z)) if unclaimed[j] > 0.5]
        waiting = {s: [(x, S, since + dt, w) for x, S, since, w in old] for s, old in waiting.items()}
        begun, waiting[sensor] = begin(birth, free, waiting[sensor])
        for mean, P, hits, weight in begun:
            first = [1.0 if s == sensor else reached(0.5, math.inf, **hide[s]) if s in hide else 1.0 for s in (0, 1)]
            targets.append(Target(number, mean, P, [True] * hits, lived=dt * (hits - 1), visible=first))
            if "lifetime" in confirm:
                r = weight * confirm["birth"]
                targets[-1].score = targets[-1].best = math.log(r / (1 - r))
            if clutter_map is not None:  # its newest measurement is its own as far as it is no confirmed target's
                claims += [(x, free_of[j], sensor, targets[-1]) for j, x in enumerate(z) if (x == mean[:2]).all()]
            number += 1
        before = [t for t in targets if t.confirmed]
        targets = [t for t in targets if stays(t, confirm)]
        over += [t for t in before if t not in targets]
        if extent is not None:
            decide(targets, before, extent)
        if stitch is not None:
            found = [t for t in targets if t.confirmed and t not in before]
            targets, over = stitched(targets, over, found, q, stitch)
        for t in targets:
            t.host_identity = -1 if t.host is None else t.host.identity
        shown.append([replace(t, hits=list(t.hits), visible=list(t.visible)) for t in targets])
    return shown


def kernel(gap: Array, size: float) -> float:
    """The normal density in the plane."""
    return math.exp(-(gap @ gap) / (2 * size**2)) / (2 * math.pi * size**2)


def reached(visible: float, dt: float, seen: float, hidden: float) -> float:
    """Probability to be visible after ``dt`` seconds: the master equation of the two states, by its exponential."""
    if dt == math.inf:
        return seen / (seen + hidden)
    rates = np.array([[-1 / seen, 1 / hidden], [1 / seen, -1 / hidden]])
    values, vectors = np.linalg.eig(rates)
    return float((vectors @ np.diag(np.exp(values * dt)) @ np.linalg.inv(vectors) @ [visible, 1 - visible])[0])


def stitched(
    targets: list[Target], over: list[Target], found: list[Target], q: float, how: dict[str, float]
) -> tuple[list[Target], list[Target]]:
    """Targets and lost ones, after those ``found`` have taken the identities of lost ones that they agree with."""
    one, none, candidates = np.eye(2), np.zeros((2, 2)), [t for t in targets if t.confirmed and t not in found] + over
    cost: list[list[float | None]] = []
    for lost in candidates:
        dt = lost.gone
        F, G = np.block([[one, dt * one], [none, one]]), np.vstack([dt**2 / 2 * one, dt * one])
        mean, P = F @ lost.mean, F @ lost.P @ F.T + q * G @ G.T
        cost.append([])
        for target in found:
            gap, between = target.mean - mean, lost.since - target.lived
            squared = float(gap @ np.linalg.solve(P + target.P, gap))
            near = np.linalg.norm(gap[:2]) <= how["metres"] and squared <= how["limit"]
            cost[-1].append(squared if near and 0 < between <= how["seconds"] else None)
    for i, j in cheapest(cost, len(found)):
        found[j].identity = candidates[i].identity
        targets = [t for t in targets if t is not candidates[i]]
        over = [t for t in over if t is not candidates[i]]
    return targets, over


def update(target: Target, z: Array, beta: Array, missed: float, H: Array, R: Array) -> None:
    """Bar-Shalom & Fortmann: the Gaussian with the moments of all that may have happened."""
    S = H @ target.P @ H.T + R
    K = target.P @ H.T @ np.linalg.inv(S)
    means = [target.mean] + [target.mean + K @ (z[j] - H @ target.mean) for j in range(len(z))]
    measured = target.P - K @ S @ K.T
    weights = [missed, *beta]
    mean = sum(w * x for w, x in zip(weights, means, strict=True))
    target.P = sum(
        w * ((target.P if i == 0 else measured) + np.outer(x - mean, x - mean))
        for i, (w, x) in enumerate(zip(weights, means, strict=True))
    )
    target.mean = mean


def ends(target: Target, misses: int | None, drop: float | None) -> bool:
    """Missed so improbably often in a row, or a score that has fallen too far."""
    return (misses is not None and target.misses >= misses) or (
        drop is not None and target.score - target.best < math.log(drop)
    )


def stays(target: Target, how: dict[str, Any]) -> bool:
    """Whether a target is confirmed, which is noted, or may yet be."""
    if "lifetime" in how:
        exists = 1 / (1 + math.exp(-target.score))
        target.confirmed = target.confirmed or exists >= how["confirmed"]
        return exists > how["deleted"]
    if target.confirmed:
        return True
    if "m" in how:
        last = target.hits[-how["n"] :]
        target.confirmed = sum(last) >= how["m"]
        possible = sum(not hit for hit in last) <= how["n"] - how["m"]
    else:
        target.confirmed = target.score >= math.log((1 - how["missed"]) / how["false"])
        possible = target.score > math.log(how["missed"] / (1 - how["false"]))
    return target.confirmed or possible


Free = tuple[Array, Array, float, float]  # a position, its covariance, seconds since, and P(nothing else explains it)


def begin(
    how: dict[str, float], free: list[Free], before: list[Free]
) -> tuple[list[tuple[Array, Array, int, float]], list[Free]]:
    """Births (mean, P, measurements, P(nothing else explains them)), and the measurements left for the next scan's."""
    none = np.zeros((2, 2))
    if "velocity" in how:
        spread = how["velocity"] ** 2 * np.eye(2)
        return [(np.r_[z, 0, 0], np.block([[R, none], [none, spread]]), 1, w) for z, R, _, w in free], []
    old, left, begun = [x for x in before if x[2] > 0], [x for x in before if x[2] == 0], []
    reach = [
        [how["speed"] * dt + 3 * (math.sqrt(np.trace(S)) + math.sqrt(np.trace(R))) for _, R, _, _ in free]
        for _, S, dt, _ in old
    ]
    pairs = nearest([x[0] for x in old], [x[0] for x in free], reach)
    for i, j in pairs:
        (x, S, dt, v), (z, R, _, w) = old[i], free[j]
        begun.append((np.r_[z, (z - x) / dt], np.block([[R, R / dt], [R / dt, (R + S) / dt**2]]), 2, v * w))
    return begun, left + [x for j, x in enumerate(free) if j not in {j for _, j in pairs}]


def nearest(before: list[Array], now: list[Array], reach: list[list[float]]) -> list[tuple[int, int]]:
    """As many pairs within reach as possible, and of all such choices the one with the least sum."""
    far = [[float(np.linalg.norm(z - x)) for z in now] for x in before]
    return cheapest(
        [[d if d <= r else None for d, r in zip(*row, strict=True)] for row in zip(far, reach, strict=True)], len(now)
    )


def cheapest(cost: list[list[float | None]], columns: int) -> list[tuple[int, int]]:
    """As many pairs with a cost as possible, and of all such choices the one with the least sum."""
    best: tuple[int, float, list[tuple[int, int]]] = (0, 0.0, [])
    for choice in itertools.product([None, *range(columns)], repeat=len(cost)):
        pairs = [(i, j) for i, j in enumerate(choice) if j is not None]
        costs = [cost[i][j] for i, j in pairs]
        known = [c for c in costs if c is not None]
        allowed = len({j for _, j in pairs}) == len(pairs) == len(known)
        if allowed and (-len(pairs), sum(known)) < (-best[0], best[1]):
            best = (len(pairs), sum(known), pairs)
    return best[2]
