"""A check on tracks that are drawn from a filter's own models: where these hold, a Kalman filter is hard to beat."""

from __future__ import annotations

import torch

from torchfra.filters.srckf import SRCKF
from torchfra.linalg.triangular import apply
from torchfra.metrics.errors import error, nees
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.testing.case import Case, SkipCheck, check, drawn
from torchfra.testing.expectations import expect
from torchfra.types import Gaussian

RUNS, LENGTH, FIRST = 100, 60, 20
"""Number of tracks, of their steps, and the first step that counts."""
BEHIND = 0.02
"""Relative increase of the position error over that of ``srckf``, at most."""
CONSISTENT = 0.9, 1.1
"""Bounds of the mean normalised estimation error squared, per component of the state."""


@check("eager")
def where_its_models_hold_it_is_no_worse_than_a_kalman_filter(case: Case) -> None:
    """Position errors at most 2 % above those of ``srckf``, and consistent covariances.

    Skip this check for robust filters that trade some accuracy for robustness.
    """
    f, seconds = case.filter, torch.tensor(case.dt, dtype=torch.float64)
    motions = f.motion[:] if isinstance(f.motion, Bank) else [f.motion]
    if f.scans or len(motions) > 1:
        raise SkipCheck("it is for filters of one target and one motion")
    motion: Motion = motions[0]
    if motion.adaptation(seconds) is not None:
        raise SkipCheck("the process noise of the motion follows the estimate, so that no truth is drawn from it")
    u = None if case.u is None else case.u.flatten(0, -2)[:1].expand(RUNS, -1)
    inputs = None if u is None else u[:1].expand(LENGTH, -1)
    prior = Gaussian(*(x[:1].expand(RUNS, *x.shape[1:]) for x in case.prior))
    generator = torch.Generator().manual_seed(7)
    start = torch.randn(RUNS, motion.size, dtype=torch.float64, generator=generator)
    with torch.no_grad():
        x = prior.mean + apply(prior.scale_tril, start)
        truth, z = drawn(motion, f.sensor, x, seconds, u, LENGTH, generator, process_noise=True)
        plain, found = (g(z, prior, dt=case.dt, u=inputs) for g in (SRCKF(motion, f.sensor), f))
        errors = (error(e.mean, truth, motion.position)[:, FIRST:] for e in (found, plain))
        squares, of_plain = (e.square().mean(-1) for e in errors)  # mean square position error of each track, (RUNS,)
        consistency, plain_consistency = (float(nees(e, truth)[:, FIRST:].mean()) / motion.size for e in (found, plain))
    ratio = float(squares.mean() / of_plain.mean())
    margin = 3 * float((squares - ratio * of_plain).std() / of_plain.mean()) / RUNS**0.5
    limit = (1 + BEHIND) ** 2 + margin
    what = "position error where its models hold"
    expect(ratio <= limit, what, f"at most {limit**0.5:.3f} times that of srckf", f"{ratio**0.5:.3f} times")
    low, high = (function(x, x * plain_consistency) for function, x in zip((min, max), CONSISTENT, strict=True))
    what = "normalised estimation error squared per component where its models hold"
    expect(low <= consistency <= high, what, f"from {low:.2f} to {high:.2f}", f"{consistency:.2f}")
