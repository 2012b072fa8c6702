"""Filters and their smoothers on the same runs: errors, ratios with intervals, and how consistent covariances are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from regrets.ratios import Errors, batches, interval, metres, ratio, regret
from torchfra import metrics
from torchfra.filters import Filter
from torchfra.scenarios import Scenario
from torchfra.tables import text_table
from torchfra.types import Estimate

FILTERS = ("srckf", "rsrckf", "imm_srckf", "fra", "gpb")
"""Those that are smoothed unless others are named."""
KINDS = {"filtered": 0, "lag 1": 1, "lag 5": 5, "smoothed": None}
"""Estimates by the steps that they look ahead; None for all there are."""
_STEPS = 20_000
"""Steps of all runs that are smoothed at once; bounds the memory."""


def estimates(f: Filter, scenario: Scenario, tracks: Any) -> dict[str, Estimate]:
    """By kind, in the coordinates of the truth; the filter runs once for all of them."""
    given: dict[str, Any] = {"z": tracks.z, "prior": tracks.prior, "u": tracks.u, "dt": scenario.dt}
    filtered = f(**given, past=True)
    every = {kind: f.smooth(**given, lag=lag, estimate=filtered) for kind, lag in KINDS.items() if lag != 0}
    every["filtered"] = as_filtered(filtered)
    return {kind: scenario.cartesian(every[kind]) for kind in KINDS}


def as_filtered(estimate: Estimate) -> Estimate:
    """What was known at each step itself, of a filter whose estimate may be smoothed by the next step."""
    early = getattr(estimate.info, "provisional", getattr(estimate.info, "filtered", None))
    return estimate if early is None else estimate._replace(mean=early.mean, scale_tril=early.scale_tril)


def one_run(f: Filter, scenario: Scenario, seed: int) -> dict[str, tuple[Tensor, Tensor]]:
    """By kind the errors ``(T,)`` of the first coordinate of one run, and the standard deviations ``(T,)`` of it."""
    tracks, at = scenario.simulate(1, seed), scenario.truth_position.start
    with torch.no_grad():
        every = estimates(f, scenario, tracks)
    return {
        kind: ((e.mean - tracks.truth)[0, :, at], e.scale_tril[0, :, at].norm(dim=-1))
        for kind, e in every.items()
        if kind != "lag 5"
    }


def errors(
    scenario: Scenario, filters: Mapping[str, Filter], *, runs: int, seed: int, progress: bool = False
) -> dict[str, dict[str, Any]]:
    """By filter and kind the ``Errors``, and under ``"nees"`` by kind the mean of that of positions per dimension."""
    found: dict[str, dict[str, Any]] = {name: {kind: Errors(runs) for kind in KINDS} for name in filters}
    nees: dict[str, dict[str, list[Tensor]]] = {name: {kind: [] for kind in KINDS} for name in filters}
    with torch.no_grad():
        for tracks, counts in batches(scenario, runs, seed, _STEPS, progress):
            for name, f in filters.items():
                for kind, estimate in estimates(f, scenario, tracks).items():
                    error = metrics.error(estimate.mean, tracks.truth, scenario.truth_position)
                    found[name][kind].add(error, counts)
                    nees[name][kind].append(metrics.nees(estimate, tracks.truth, scenario.truth_position))
    dims = scenario.motion.dims
    for name, of in nees.items():
        found[name]["nees"] = {kind: torch.cat(parts).nanmean().item() / dims for kind, parts in of.items()}
    return found


def results(found: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """By filter and kind ``rmse``, the ``ratio`` to the filtered one's with its 95 % ``interval``, and ``nees``."""
    of: dict[str, Any] = {}
    for name, kinds in found.items():
        filtered, of[name] = kinds["filtered"].rmse(), {}
        for kind in KINDS:
            values = kinds[kind].rmse()
            of[name][kind] = {"rmse": values[0].item(), **ratio(values, filtered), "nees": kinds["nees"][kind]}
    return of


def table(cells: Mapping[str, Mapping[str, Any]]) -> str:
    """A line for each filter in each cell."""
    rows = []
    for cell, result in cells.items():
        for name, kinds in result["smoothing"].items():
            of, before = kinds["smoothed"], kinds["filtered"]
            rows.append([cell, name, *(metres(kinds[kind]["rmse"]) for kind in KINDS), regret(of["ratio"]),
                         interval(of["interval"]), f"{before['nees']:.2f}", f"{of['nees']:.2f}"])  # fmt: skip
    header = ["cell", "filter", *(f"{kind}, m" for kind in KINDS), "change", "95 %", "NEES", "smoothed"]
    return text_table(header, rows, align="<<>")
