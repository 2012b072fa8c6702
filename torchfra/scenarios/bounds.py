"""Cramer-Rao bounds on the errors of filters, of a scenario whose law is known."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfra.metrics.bounds import cramer_rao
from torchfra.motion.base import Motion
from torchfra.scenarios.base import Scenario, Tracks
from torchfra.scenarios.law import Law, Measured

RUNS = 200
"""Number of truths that approximate an expectation."""


@dataclass(frozen=True)
class Bound:
    """The Cramer-Rao bound of a scenario."""

    kind: str
    """``"posterior"``: for all estimators, with random truths by process noise.  ``"parametric"``: for unbiased
    estimators, with paths that are fixed, or taken as known except for their start."""
    known: tuple[str, ...]
    """Quantities taken as known although no filter knows them: the bound may be far below every filter."""
    covariance: Tensor
    """``(T, n, n)`` bound on the covariance of the errors, in the coordinates of the truth, mean over the runs."""

    def rmse(self, states: slice) -> Tensor:
        """Bound on the root mean square error ``(T,)`` in some components, ``scenario.truth_position`` say."""
        return self.covariance[:, states, states].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()

    def __str__(self) -> str:
        return ", ".join([f"{self.kind} Cramer-Rao bound", *(f"{what} known" for what in self.known)])


def bound(scenario: Scenario, *, runs: int = RUNS, seed: int = 0) -> Bound:
    """The bound on the errors of every filter of a scenario.

    Args:
        scenario: with a ``law``.
        runs: truths to take expectations over; where each run has a path of its own, as many as there are errors to
            compare with.
        seed: of the random numbers.

    Raises:
        ValueError: no scenario, or one without a law; ``runs`` or ``seed`` out of range.
    """
    if not isinstance(scenario, Scenario):
        raise ValueError(f"scenario: expected a Scenario, received {type(scenario).__name__}")
    if scenario.law is None:
        raise ValueError(f"scenario: expected one with a law, by which bounds are known, received {scenario.name}")
    law, tracks = scenario.law, scenario.simulate(runs, seed)
    truth = tracks.truth.flatten(0, -3)
    slope, transition = _slopes(law, scenario, tracks, truth), _transitions(law, scenario, tracks, truth)
    noise = None if law.process_noise is None else law.process_noise.to(truth)
    drawn = noise is not None and bool(noise.any())
    runs_axis = 0 if drawn else 1  # a mean over the runs of the information, or one bound for each
    found = cramer_rao(law.start.to(truth), transition.unsqueeze(runs_axis), noise, slope.unsqueeze(runs_axis))
    return Bound("posterior" if drawn else "parametric", law.known, found.nanmean(0))


def _slopes(law: Law, scenario: Scenario, tracks: Tracks, truth: Tensor) -> Tensor:
    """``(B, T, m, n)`` slopes of the measurements, whitened; 0 where missing."""
    u = None if tracks.u is None else tracks.u.expand(*truth.shape[:-1], -1)
    slope = slopes(law.sensor, truth, u)
    std = torch.as_tensor(law.std, dtype=truth.dtype).expand(truth.shape[1], slope.shape[-2])
    information = torch.as_tensor(law.information, dtype=truth.dtype).expand(truth.shape[1]) * scenario.detection
    slope = slope * (information.sqrt().unsqueeze(-1) / std).unsqueeze(-1)
    return slope if tracks.z.dim() == 4 else torch.where(tracks.z.isnan().unsqueeze(-1), 0.0, slope)


def _transitions(law: Law, scenario: Scenario, tracks: Tracks, truth: Tensor) -> Tensor:
    """``(B, T, n, n)`` slopes of the motion at the states before each step."""
    steps, dt = truth.shape[1], torch.tensor(scenario.dt, dtype=truth.dtype)
    if not isinstance(law.motion, Motion):
        return torch.stack([motion.transition(dt) for motion in law.motion]).to(truth).expand(len(truth), -1, -1, -1)
    motion = law.motion
    if motion.linear:  # of several targets each has its own
        matrix = motion.transition(dt).to(truth).expand(*tracks.truth.shape[:-2], -1, -1).flatten(0, -3)
        return matrix.unsqueeze(1).expand(-1, steps, -1, -1)
    if scenario.conversion is not None:
        raise ValueError("law: expected a linear motion where filters have other coordinates than the truth")
    start = tracks.prior.mean.to(truth).expand(len(truth), -1).unsqueeze(1)  # near enough: it is one slope of many
    u = None if tracks.u is None else tracks.u.expand(*truth.shape[:-1], -1)
    return slopes(lambda x, u: motion(x, dt.expand(x.shape[:-1]), u), torch.cat([start, truth[:, :-1]], 1), u)


def slopes(function: Measured, x: Tensor, u: Tensor | None) -> Tensor:
    """Slopes ``(..., m, n)`` of a function of states ``x (..., n)`` and ``u``, which takes each state by itself.

    (Forward mode, and ``torch.func``, would import torch's compiler for some operations, which takes seconds.)
    """
    with torch.inference_mode(False), torch.enable_grad():
        at = x.detach().clone().requires_grad_()
        values = function(at, u)
        sums = values.flatten(0, -2).sum(0)
        rows = [torch.autograd.grad(total, at, retain_graph=True, materialize_grads=True)[0] for total in sums]
    return torch.stack(rows, -2)
