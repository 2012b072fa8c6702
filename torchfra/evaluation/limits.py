"""The error above which a run has diverged, where nobody has said it: a multiple of what a measurement alone is off."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.evaluation.fixes import fixes
from torchfra.numbers import as_number
from torchfra.scenarios import Scenario, Tracks

TIMES = 10.0
"""A run has diverged if its error is so many times that of the positions that single measurements imply."""
RUNS = 32
"""Among which that is looked for."""


def check_limit(limit: float | None) -> None:
    """Checks a limit that a user gave; None means that none was given.

    Raises:
        ValueError: no number above 0.
    """
    if limit is not None and not as_number(limit) > 0:
        raise ValueError(f"limit: expected metres above 0, received {limit!r}")


def divergence_limit(scenario: Scenario) -> float:
    """The position error, root mean square over time, above which a run of a scenario has diverged, m.

    It is that of the scenario, ``Scenario.limit``; where it has none, ``TIMES`` the median distance from the truth of
    the positions that single measurements imply, or where they imply none the standard deviation of the prior.  By the
    median outliers do not count.
    """
    if scenario.limit is not None:
        return scenario.limit
    tracks = scenario.simulate(min(RUNS, len(scenario.recordings) or RUNS))
    off = _off(scenario, tracks)
    known = off[off.isfinite()]
    if len(known):
        return TIMES * float(known.median())
    root = tracks.prior.scale_tril[..., scenario.motion.position, :]
    return TIMES * float(root.square().sum((-1, -2)).sqrt().median())


def _off(scenario: Scenario, tracks: Tracks) -> Tensor:
    """Distance of the position that a measurement implies from the truth; in scans, the nearest one to each target."""
    truth = tracks.truth[..., scenario.truth_position]
    targets = truth.unsqueeze(1) if truth.dim() == 3 else truth  # (B, N, T, d)
    off = (fixes(scenario, tracks).unsqueeze(1) - targets.unsqueeze(3)).norm(dim=-1)
    return torch.where(off.isnan(), torch.inf, off).amin(-1)
