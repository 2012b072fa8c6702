"""The feedback decision among robust, adaptive and plain branches; Wang et al. (2021), section 2.2, hard and soft."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from oracles.basics import Array, Model, Result, collect
from oracles.cubature import third_degree
from oracles.fading import Fade, faded, no_memory, remember
from oracles.mixture import matched
from oracles.robust import Prior, compare, huber, step, unweighted, weighted


def prior_odds(preference: float, plain: float | None) -> dict[str, float]:
    """Log odds of the branches before the next measurement; no plain branch if that is None."""
    return {"robust": preference, "adaptive": 0.0} | ({} if plain is None else {"plain": plain})


def scores(ahead: dict[str, Prior], odds: dict[str, float], decision: str, row: Row, p: Prior) -> dict[str, float]:
    """How well each branch predicts the next measurement: feedback decision of section 2.2; `p` is of this step."""
    found = {}
    for name in odds:
        score = ahead[name].log_likelihood if decision == "likelihood" else -0.5 * ahead[name].nis
        found[name] = score if math.isfinite(score) else -math.inf
    if row.waits(p, ahead["robust"]):
        found["adaptive"] = -math.inf
        if "plain" in found:
            found["plain"] = min(found["plain"], found["robust"])
    return {name: score + odds[name] for name, score in found.items()}


class Row:
    """Outliers in a row, with which the filter has patience: innovations beyond noise that do not grow by a third."""

    def __init__(self, patience: float, size: int, gate: float) -> None:
        self.patience, self.repeated = patience, patience
        self.far = max(gate, size * (1 - 2 / (9 * size) + 3.2 * math.sqrt(2 / (9 * size))) ** 3)

    def is_far(self, p: Prior) -> bool:
        return bool(p.seen) and p.nis > self.far

    def see(self, p: Prior) -> None:
        """A measurement that is not far off ends the row."""
        if p.seen and not self.is_far(p):
            self.repeated = 0.0

    def waits(self, p: Prior, after: Prior) -> bool:
        """Whether the robust branch is kept whatever predicts better."""
        if not (self.patience and after.seen and self.is_far(p)):
            return False
        before = np.zeros(max(*p.seen, *after.seen, 0) + 1)
        before[p.seen] = p.v
        unit = np.linalg.inv(after.SR)
        whiten = np.linalg.inv(np.linalg.cholesky(unit @ after.at.Pzz @ unit.T))
        n, m = whiten @ before[after.seen], whiten @ after.v
        repeats = (m - n) @ n <= n @ n / 3
        another = (m - n) @ (m - n) > n @ n  # row begins with the next measurement
        self.repeated = 0.0 if another else self.repeated + bool(repeats)
        return bool(repeats and self.repeated < self.patience)


def winner(scored: dict[str, float]) -> str:
    """A tie selects the robust branch, and of the others the adaptive one."""
    return max(scored, key=scored.__getitem__)


def memories(V: Array, p: Prior, psi: Array, memory: str, forgetting: float) -> tuple[Array, Array]:
    """The innovation memory for this step and the one that goes on, "plain" or "weighted" by psi (s,)."""
    now = remember(V, p.v, p.seen, forgetting)
    return now, remember(V, psi * p.v, p.seen, forgetting) if memory == "weighted" else now


def fra(
    z: Array,
    mean0: Array,
    P0: Array,
    model: Model,
    threshold: float | Array = 1.345,
    gate: float = 5.991,
    preference: float = 0.0,
    plain: float | None = None,
    patience: float = 0.0,
    decision: str = "normalised",
    memory: str = "plain",
    provisional: str = "robust",
    final: str = "robust",
    **fade: Any,
) -> Result:
    """Feedback decision among the branches of an abnormal step, section 2.2.

    decision "normalised" or "likelihood"; memory "plain" or "weighted"; provisional, and final (an abnormal last step),
    "robust", "adaptive", "plain" or "likeliest"; options of `Fade`. Besides the usual keys (weights and fading are
    those of what was kept): abnormal (T,), name (T,) of the branch that was kept, provisional (T,n).
    """
    odds = prior_odds(preference, plain)
    rule, options, V = third_degree(len(mean0)), Fade(**fade), no_memory(z)
    steps: list[dict[str, Any]] = []
    row = Row(patience, z.shape[1], gate)
    p = compare(np.array(mean0, dtype=float), np.array(P0, dtype=float), z[0], model, 0, rule)
    for k in range(len(z)):
        psi = huber(p.v, np.broadcast_to(threshold, z.shape[1])[p.seen])
        V_now, V = memories(V, p, psi, memory, options.forgetting)
        kept = shown = unweighted(p)
        abnormal, name, following = bool(p.seen) and not p.nis <= gate, "", None
        row.see(p)
        if abnormal:
            fading = faded(p, V_now, np.ones(len(p.seen)), z[k], model, k, rule, options)
            branches = {"robust": weighted(p, psi), "adaptive": fading, "plain": kept}
            shown = branches[winner(odds) if provisional == "likeliest" else provisional]
            name = winner(odds) if final == "likeliest" else final
            if k + 1 < len(z):
                ahead = {b: compare(*branches[b][:2], z[k + 1], model, k + 1, rule) for b in odds}
                name = winner(scores(ahead, odds, decision, row, p))
                following = ahead[name]
            kept = branches[name]
        flags = {"abnormal": abnormal, "name": name, "provisional": shown[0]}
        steps.append(step(p, kept, z.shape[1]) | flags)
        if k + 1 < len(z):
            p = following or compare(*kept[:2], z[k + 1], model, k + 1, rule)
    return collect(steps)


def sigmoid(x: float) -> float:
    """1 / (1 + exp(-x)), 0 where the exponential would overflow."""
    return 1 / (1 + math.exp(-x)) if x > -700 else 0.0


def softmax(scored: dict[str, float], temperature: float) -> dict[str, float]:
    """Weights that sum to one."""
    top = max(scored.values())
    weights = {name: math.exp((score - top) / temperature) for name, score in scored.items()}
    return {name: w / sum(weights.values()) for name, w in weights.items()}


def soft_fra(
    z: Array,
    mean0: Array,
    P0: Array,
    model: Model,
    temperature: float,
    threshold: float = 1.345,
    gate: float = 5.991,
    preference: float = 0.0,
    plain: float | None = None,
    patience: float = 0.0,
    decision: str = "likelihood",
    memory: str = "weighted",
    provisional: str = "robust",
    **fade: Any,
) -> Result:
    """As `fra`, but every step is a mixture: abnormal by sigmoid((nis - gate) / temperature), and of that each branch
    by the softmax of the scores over the temperature. An abnormal last step is robust. mean, P, provisional only."""
    odds = prior_odds(preference, plain)
    rule, options, V = third_degree(len(mean0)), Fade(**fade), no_memory(z)
    steps: list[dict[str, Any]] = []
    mean, P = np.array(mean0, dtype=float), np.array(P0, dtype=float)
    row = Row(patience, z.shape[1], gate)
    for k in range(len(z)):
        p = compare(mean, P, z[k], model, k, rule)
        psi = huber(p.v, threshold)
        V_now, V = memories(V, p, psi, memory, options.forgetting)
        fading = faded(p, V_now, np.ones(len(p.seen)), z[k], model, k, rule, options)
        branches = {"robust": weighted(p, psi), "adaptive": fading, "plain": unweighted(p)}
        abnormal = sigmoid((p.nis - gate) / temperature)
        row.see(p)

        def mixed(
            shares: dict[str, float], branches: Any = branches, abnormal: float = abnormal
        ) -> tuple[Array, Array]:
            parts = [(1 - abnormal, *branches["plain"][:2])]
            return matched(parts + [(abnormal * w, *branches[name][:2]) for name, w in shares.items()])

        shown, _ = mixed(softmax(odds, temperature) if provisional == "likeliest" else {provisional: 1.0})
        shares = {"robust": 1.0}
        if k + 1 < len(z):
            ahead = {name: compare(*branches[name][:2], z[k + 1], model, k + 1, rule) for name in odds}
            shares = softmax(scores(ahead, odds, decision, row, p), temperature)
        mean, P = mixed(shares)
        steps.append({"mean": mean, "P": P, "provisional": shown})
    return collect(steps)
