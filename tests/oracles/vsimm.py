"""Interacting models with a set that changes; Du & Zhang (2020), (4)-(11); likely-model set: Li & Zhang (2000)."""

from __future__ import annotations

from oracles.basics import Array, Result
from oracles.imm import Chance, Motion, run


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
    models: list[Motion],
    H: Array,
    R: Array,
    calls: list[list[int]],
    first: list[int],
    stay: float = 0.95,
    low: float = 0.05,
    high: float = 0.5,
) -> Result:
    """Interacting models with a set that changes, one track; Du & Zhang (2020), (4)-(11)."""
    size = len(first)

    def select(mu: dict[int, float]) -> tuple[list[int], Chance]:
        now = likely_set(mu, size, low, high, calls)
        return now, lambda i, j: 1 / size if i not in now else stay if i == j else (1 - stay) / (size - 1)

    return run(z, mean0, P0, models, H, R, dict.fromkeys(sorted(first), 1 / size), select)
