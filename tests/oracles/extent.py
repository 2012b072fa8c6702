"""Two targets or one hull, by plain loops over targets that know their hosts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from oracles.basics import Array


def normal(x: Array, P: Array) -> float:
    """Log density of a vector."""
    P = np.atleast_2d(P)
    return float(-0.5 * (x @ np.linalg.solve(P, x)) - 0.5 * math.log(np.linalg.det(2 * math.pi * P)))


def by_place(part: Any, host: Any, how: dict[str, float]) -> float:
    """Log odds of two by where both are and how they move, and what was probable before."""
    x, y = part.mean - host.mean, host.mean[2:]
    P = part.P + host.P
    speed = math.hypot(*y)
    ahead, left = y / speed, np.array([-y[1], y[0]]) / speed
    along, across = x[:2] @ ahead, x[:2] @ left
    course = min(1.0, left @ host.P[2:, 2:] @ left / speed**2)
    width = left @ P[:2, :2] @ left + how["beam"] ** 2 + along**2 * course
    short, long = how["shortest"], how["longest"]
    if abs(along) >= long:
        return math.inf
    density = math.log(long / max(short, abs(along))) / (2 * (long - short))
    hull = math.log(density) + normal(np.array([across]), np.array([[width]]))
    hull += normal(x[2:], P[2:, 2:] + (how["turn"] * along) ** 2 * np.outer(left, left))
    two = -math.log(math.pi * long**2) + normal(x[2:], P[2:, 2:] + how["speed"] ** 2 * np.eye(2))
    return math.log(how["two"] / (1 - how["two"])) + two - hull


def weigh(targets: list[Any], missed: Array, PD: float, dt: float, how: dict[str, float]) -> None:
    """Gives each target the odds after a scan."""
    rate = dict(zip(map(id, targets), missed, strict=True))
    for target in targets:
        target.host = target.host if any(target.host is other for other in targets) else None
    for target in targets:
        if target.host is None:
            target.scans = target.odds = 0.0
            continue
        one, other = rate[id(target)], rate[id(target.host)]
        both, single, none = (1 - one) * (1 - other), one * (1 - other) + other * (1 - one), one * other
        said = both * (math.log(PD**2) - math.log(PD * how["both"]))
        said += single * (math.log(PD * (1 - PD)) - math.log(PD * (1 - how["both"]) / 2))
        said += none * (math.log((1 - PD) ** 2) - math.log(1 - PD))
        target.scans = math.exp(-dt / how["seconds"]) * target.scans + said
        target.odds = target.scans + by_place(target, target.host, how)


def take_over(targets: list[Any], how: dict[str, float]) -> list[Any]:
    """The hosts that no rule ends; a part that is measured where its host is not becomes the host."""
    stays, limit = [], -math.log(how["sure"] / (1 - how["sure"]))
    shown = [t for t in targets if t.host is not None and t.odds < limit and t.misses == 0 and not t.confirmed]
    for part in shown:
        stays.append(part.host)
    last = {id(part.host): part for part in shown if part.host.misses >= 2}
    changes = [(part.host, part) for part in last.values()]
    for host, part in changes:
        for name in ("identity", "confirmed", "score", "best", "scans", "odds"):
            mine, its = getattr(host, name), getattr(part, name)
            setattr(host, name, its)
            setattr(part, name, mine)
        host.host, part.host = part, None
        for other in targets:  # they name their host by its identity
            if other is not host and other.host is host:
                other.host = part
    return stays


def decide(targets: list[Any], before: list[Any], how: dict[str, float]) -> None:
    """Takes back what is not sure, and gives hosts to those that have come near one."""
    confirmed = [t for t in targets if t.confirmed]
    decided = []
    for target in targets:
        was = target in before
        near = [o for o in confirmed if np.hypot(*(o.mean - target.mean)[:2]) <= how["longest"] and o is not target]
        host, held, has = None, False, any(o is target.host for o in near)
        if has:
            limit = math.log(how["sure"] / (1 - how["sure"]))
            host, held = target.host, target.odds < (-limit if was else limit)
        elif not was:
            able = [o for o in near if o in before or o.identity < target.identity]
            if able:
                host = min(able, key=lambda o: float(np.hypot(*(o.mean - target.mean)[:2])))
                held = True
        decided.append((target, host, held, has))
    for target, host, held, has in decided:
        target.host, target.confirmed = host, target.confirmed and not held
        if not has:
            target.scans = target.odds = 0.0
