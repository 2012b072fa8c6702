"""The feedback decision between a robust and an adaptive branch; Wang et al. (2021), section 2.2, hard and soft."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from oracles.basics import Array, Model, Result, collect
from oracles.cubature import third_degree
from oracles.fading import Fade, faded, no_memory, remember
from oracles.mixture import matched
from oracles.robust import Prior, compare, huber, step, unweighted, weighted


def lead(robust: Prior, adaptive: Prior, decision: str, preference: float) -> float:
    """Log odds of the adaptive branch: feedback decision of section 2.2."""
    if decision == "likelihood":
        return adaptive.log_likelihood - robust.log_likelihood - preference
    return 0.5 * (robust.nis - adaptive.nis) - preference


def adaptive_wins(robust: Prior, adaptive: Prior, decision: str, preference: float) -> bool:
    """A tie and a broken-down adaptive branch select the robust one."""
    if not (math.isfinite(robust.nis) and math.isfinite(adaptive.nis)):
        return math.isfinite(adaptive.nis)
    return lead(robust, adaptive, decision, preference) > 0


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
    rule, options, V = third_degree(len(mean0)), Fade(**fade), no_memory(z)
    steps: list[dict[str, Any]] = []
    p = compare(np.array(mean0, dtype=float), np.array(P0, dtype=float), z[0], model, 0, rule)
    for k in range(len(z)):
        psi = huber(p.v, np.broadcast_to(threshold, z.shape[1])[p.seen])
        V_now, V = memories(V, p, psi, memory, options.forgetting)
        kept = provisional = unweighted(p)
        abnormal, adaptive, following = bool(p.seen) and not p.nis <= gate, False, None
        if abnormal:
            provisional = robust = weighted(p, psi)
            fading = faded(p, V_now, np.ones(len(p.seen)), z[k], model, k, rule, options)
            if k + 1 < len(z):
                after_robust = compare(*robust[:2], z[k + 1], model, k + 1, rule)
                after_fading = compare(*fading[:2], z[k + 1], model, k + 1, rule)
                adaptive = adaptive_wins(after_robust, after_fading, decision, preference)
                kept, following = (fading, after_fading) if adaptive else (robust, after_robust)
            else:
                adaptive = final == "adaptive"
                kept = {"robust": robust, "adaptive": fading, "plain": kept}[final]
        flags = {"abnormal": abnormal, "adaptive": adaptive, "provisional": provisional[0]}
        steps.append(step(p, kept, z.shape[1]) | flags)
        if k + 1 < len(z):
            p = following or compare(*kept[:2], z[k + 1], model, k + 1, rule)
    return collect(steps)


def sigmoid(x: float) -> float:
    """1 / (1 + exp(-x)), 0 where the exponential would overflow."""
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
    rule, options, V = third_degree(len(mean0)), Fade(**fade), no_memory(z)
    steps: list[dict[str, Any]] = []
    mean, P = np.array(mean0, dtype=float), np.array(P0, dtype=float)
    for k in range(len(z)):
        p = compare(mean, P, z[k], model, k, rule)
        psi = huber(p.v, threshold)
        V_now, V = memories(V, p, psi, memory, options.forgetting)
        robust = weighted(p, psi)
        fading = faded(p, V_now, np.ones(len(p.seen)), z[k], model, k, rule, options)
        abnormal, adaptive = sigmoid((p.nis - gate) / temperature), 0.0
        if k + 1 < len(z):
            ahead = [compare(*branch[:2], z[k + 1], model, k + 1, rule) for branch in (robust, fading)]
            adaptive = sigmoid(lead(*ahead, decision, preference) / temperature)
        shares = (1 - abnormal, abnormal * (1 - adaptive), abnormal * adaptive)
        branches = (unweighted(p), robust, fading)
        mean, P = matched([(w, *branch[:2]) for w, branch in zip(shares, branches, strict=True)])
        steps.append({"mean": mean, "P": P})
    return collect(steps)
