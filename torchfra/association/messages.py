"""Joint association by belief propagation."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.association.clusters import Association, Clusters
from torchfra.linalg.tracing import is_traced

_SURE, _NOTHING = -30.0, -1e3
"""In messages, log weights against the largest of a target: to miss one that is always measured, and what cannot be."""


_SETTLED = 1e-10
"""Change of a message, in logs, that is none."""


def propagate(log_ratio: Tensor, log_miss: Tensor, within: Clusters, *, diffuse: bool, iterations: int) -> Association:
    """Belief propagation between targets ``N`` and measurements ``J``: exact for single targets, close for clusters.

    Args:
        log_ratio: ``(R, N, J)``.
        log_miss: ``(R, N)``.
        within: clusters of the targets.
        diffuse: counted as Poisson with the rate that gives the same odds to as many detections as there are targets.
        iterations: of messages both ways, at most.

    Against the sum over all events, 4 targets with up to 10 measurements in shared gates (drawn at random),
    probabilities are off by 0.001 to 0.003 on average and by less than 0.04 in 99 of 100; the worst of 22,000 by 0.2;
    evidence is off by less than 0.1.  Targets that are always measured and alike converge worst.

    Source: Williams & Lau (2014), "Approximate evaluation of marginal association probabilities with belief
    propagation".
    """
    gated = log_ratio > -torch.inf
    if diffuse:
        found = torch.minimum(within.size.to(log_ratio), within.counted)
        some = found > 0
        rate = torch.lgamma(within.counted + 1) - torch.lgamma(within.counted - found + 1)
        log_ratio = log_ratio - torch.where(some, rate / torch.where(some, found, 1.0), 0.0).unsqueeze(-1)
    certain, alone = log_miss == -torch.inf, within.size == 1
    every = torch.cat([torch.where(certain, torch.where(gated.any(-1), -torch.inf, 0.0), log_miss).unsqueeze(-1),
                       log_ratio], -1)  # fmt: skip
    # Those always measured are missed with a weight that is below all else that may happen in their cluster, and the
    # same for all of it, so that it decides nothing but that.
    low = _lowest(within.together, gated, log_ratio.detach())
    forced = torch.where(low.isfinite(), low + _SURE, 0.0)
    miss = torch.where(certain, forced, log_miss).unsqueeze(-1)
    least = torch.minimum(miss.detach(), torch.where(low.isfinite(), low, 0.0).unsqueeze(-1))
    weight = torch.where(gated, log_ratio, least + _NOTHING)
    back = torch.zeros_like(weight)  # log of nu, from measurement to target
    for k in range(iterations):
        ahead = weight - torch.logaddexp(miss, _others(weight + back))
        before, back = back, -torch.nn.functional.softplus(_others(ahead.mT).mT)
        if k % 10 == 9 and not is_traced(back) and bool((back - before).abs().amax() < _SETTLED):
            break
    told = torch.cat([miss, weight + back], -1)
    whole = told.logsumexp(-1)
    log_weights = torch.where(pad(gated, (1, 0), value=True), told - whole.unsqueeze(-1), -torch.inf)
    # The Bethe approximation of the sum over all events, each measurement's part shared by the targets that gate it.
    ahead = weight - torch.logaddexp(miss, _others(weight + back))
    of_measurement = torch.nn.functional.softplus(ahead.logsumexp(-2)) / gated.sum(-2).clamp_min(1)
    own = whole + (gated * of_measurement.unsqueeze(-2) - torch.nn.functional.softplus(ahead + back)).sum(-1)
    own = own - torch.where(certain, forced * log_weights[..., 0].exp(), 0.0)  # which counts as 0 among events
    evidence = (within.together.to(own) @ own.unsqueeze(-1)).squeeze(-1) / within.size
    single = every.logsumexp(-1)  # of a target alone there is nothing to tell others
    return Association(
        torch.where(alone.unsqueeze(-1), every - single.unsqueeze(-1), log_weights),
        torch.where(alone, single, evidence),
    )


def _lowest(together: Tensor, gated: Tensor, log_ratio: Tensor) -> Tensor:
    """Of every target ``(R, N)`` the smallest log ratio in its cluster, infinite if there is none."""
    own = torch.where(gated, log_ratio, torch.inf).amin(-1)
    return torch.where(together, own.unsqueeze(-2), torch.inf).amin(-1)


def _others(x: Tensor) -> Tensor:
    """Log of the sum over all other entries of the last dimension, for each of ``x (..., n)``."""
    n = x.shape[-1]
    if n == 1:
        return torch.full_like(x, -torch.inf)
    own = torch.eye(n, dtype=torch.bool, device=x.device)
    return torch.where(own, -torch.inf, x.unsqueeze(-2)).logsumexp(-1)
