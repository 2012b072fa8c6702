"""Cells that are drawn at random: the ratios of a filter's errors to those of the best other, the lost cells first."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from regrets.cells import Cell
from regrets.open_cells import OpenCell, draw_cell, open_cell
from regrets.ratios import Errors, batches, interval, label, ratios, regret
from regrets.smoothed import as_filtered
from torchfra import metrics, presets
from torchfra.catalogue import FILTERS, scenario_filters
from torchfra.evaluation import run
from torchfra.filters import Filter
from torchfra.motion import Bank
from torchfra.motion.base import Motion
from torchfra.scenarios import Scenario
from torchfra.tables import printable, text_table

OTHERS = ("srckf", "rsrckf", "mr_ckf", "hghckf", "iaukf", "fra", "imm_srckf")
"""Those that compete unless others are named."""
LEVEL = 100.0
"""Factor on the process noise of the second motion of ``imm_srckf``, where a cell has no bank."""
_STEPS = 20_000
"""Steps of all runs that are filtered at once; bounds the memory."""
SHARES = {"median": 0.5, "nine in ten": 0.9, "95 in 100": 0.95, "worst": 1.0}
"""Of the cells, those whose ratio is at most the one of this name."""
ABOVE = (1.05, 1.2)
"""Ratios above which cells are counted."""


def open_cells(count: int, seed: int) -> dict[str, Cell]:
    """The first cells of a seed by name."""
    return {f"{i}-{draw_cell(i, seed=seed).kind}": Cell(partial(open_cell, i, seed=seed)) for i in range(count)}


def open_filters(scenario: Scenario, names: Sequence[str], others: Sequence[str]) -> dict[str, Filter]:
    """The filters of a cell; interacting models of a single motion have two levels of its process noise.

    Raises:
        ValueError: one that is no filter of single targets.
    """
    every = list(dict.fromkeys([*others, *names]))
    with_bank = {name: FILTERS[name].bank for name in every}
    single = [name for name in every if not with_bank[name]]
    levels = scenario.bank or Bank([scenario.motion, _agile(scenario)])
    banked = {name: getattr(presets, name)(levels, scenario.sensor) for name in every if with_bank[name]}
    return scenario_filters(single, scenario) | banked


def _agile(scenario: Scenario) -> Motion:
    """The motion of a cell with more process noise."""
    fields: dict[str, Any] = {name: scenario.settings[name] for name in OpenCell.__dataclass_fields__}
    cell = OpenCell(**fields)
    return dataclasses.replace(cell, stated_q=LEVEL * cell.stated_q).scenario().motion


def results(
    scenario: Scenario, filters: Mapping[str, Filter], compared: Collection[str], *, runs: int, seed: int,
    progress: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """``ratios`` of the filtered estimates, and under ``"nees"`` that of positions per dimension of those compared."""
    found = {name: Errors(runs) for name in filters}
    nees: dict[str, list[torch.Tensor]] = {name: [] for name in compared}
    with torch.no_grad():
        for tracks, counts in batches(scenario, runs, seed, _STEPS, progress):
            for name, f in filters.items():
                estimate = as_filtered(run(f, scenario, tracks))
                found[name].add(metrics.error(estimate.mean, tracks.truth, scenario.truth_position), counts)
                if name in nees:
                    nees[name].append(metrics.nees(estimate, tracks.truth, scenario.truth_position))
    assert scenario.limit is not None
    of = ratios(found, compared, scenario.limit)
    dims = scenario.motion.dims
    return of | {"nees": {name: torch.cat(parts).nanmean().item() / dims for name, parts in nees.items()}}


def summary(cells: Mapping[str, Mapping[str, Any]], compared: Sequence[str]) -> dict[str, dict[str, float]]:
    """By filter the ratios at ``SHARES``, how many are above ``ABOVE``, and the median NEES."""
    found = {}
    for name in compared:
        of = sorted(_ratio(cell, name) for cell in cells.values())
        found[name] = {what: of[math.ceil(share * len(of)) - 1] for what, share in SHARES.items()}
        found[name] |= {f"above {least}": sum(ratio > least for ratio in of) for least in ABOVE}
        found[name]["NEES"] = float(np.median([cell["nees"][name] for cell in cells.values()]))
    return found


def summary_lines(of: Mapping[str, Mapping[str, float]], count: int) -> str:
    """The summary as text."""
    lines = []
    for name, values in of.items():
        shares = ", ".join(f"{what} {values[what]:.3g}" for what in SHARES)
        above = ", ".join(f"above {least} in {values[f'above {least}']}" for least in ABOVE)
        lines.append(f"{printable(label(name))}, {count} cells: {shares}; {above}; median NEES {values['NEES']:.2f}")
    return "\n".join(lines)


def table(cells: Mapping[str, Mapping[str, Any]], compared: Sequence[str]) -> str:
    """A line for each compared filter in each cell, the largest ratios first; errors in standard deviations."""
    rows = []
    for ratio, cell, name in sorted(((_ratio(of, n), c, n) for c, of in cells.items() for n in compared), reverse=True):
        result = cells[cell]
        best, one, std = result["filters"][result["best"]], result["filters"][name], result["settings"]["std"]
        rows.append([cell, _said(result["settings"]), result["best"], f"{best['rmse'] / std:.3g}", label(name),
                     f"{one['rmse'] / std:.3g}", regret(ratio), interval(one["interval"]), f"{one['lost']:.0%}",
                     f"{result['nees'][name]:.3g}"])  # fmt: skip
    header = ["cell", "of", "best other", "RMSE/std", "compared", "RMSE/std", "regret", "95 %", "lost", "NEES"]
    return text_table(header, rows, align="<<<><>")


def _ratio(cell: Mapping[str, Any], name: str) -> float:
    """Of a filter's error to that of the best; infinite where it is no number."""
    ratio: float = cell["filters"][name]["ratio"]
    return ratio if math.isfinite(ratio) else math.inf


def _said(settings: Mapping[str, Any]) -> str:
    """What a cell has, in short: of what is drawn what matters for its kind."""
    kind, said = settings["kind"], [settings["motion"], settings["sensor"], f"index {settings['index']:.2g}"]
    said.append(f"{settings['dt']:.2g} s" + ("" if settings["spacing"] == "even" else f" {settings['spacing']}"))
    if kind not in ("none", "heavy", "prior"):
        said.append(f"{settings['size']:.2g} std")
    if kind not in ("none", "heavy", "prior", "first", "half", "moved", "reset"):
        said.append(f"{settings['share']:.1%}")
    said += [f"t {settings['freedom']:g}"] if kind == "heavy" else []
    said += [f"of {settings['length']}"] if kind == "bursts" else []
    said += ["one-sided"] if kind == "half" and settings["one_sided"] else []
    said += ["turn"] if settings["turn"] and settings["motion"] not in ("odometry", "gyroscope") else []
    said += [f"q x{settings['stated_q']:g}"] if settings["stated_q"] != 1 else []
    return ", ".join(said + ([f"std x{settings['stated_std']:g}"] if settings["stated_std"] != 1 else []))
