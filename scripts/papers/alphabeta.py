"""Xu et al.: a bank of alpha-beta filters on a target that flies level and then weaves, with two outliers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from papers.experiment import SHOWN, Experiment, Figures, Filters, Results, Study, catalogue_filters, filtered
from papers.figures import along, by_coordinate, errors_along, probabilities
from torchfra import presets
from torchfra.filters.alphabeta import AlphaBeta, AlphaBetaBank, gains
from torchfra.scenarios import Scenario
from torchfra.tables import text_table
from torchfra.types import Estimate

TRACKING_INDEX = {"f1": 1.5, "f2": 0.5, "f3": 0.1}
"""Of the paper's single filters, which set the gains."""
DETECT = {"paper": "cartesian", "paper_polar": "polar"}
"""Coordinates in which the paper's bank votes; the paper votes in slant range and azimuth."""
LEVELS = ("level 1, fastest", "level 2", "level 3, slowest")
PARTS = {"level": slice(19, 73), "manoeuvre": slice(73, 120)}
"""Steps of the averages: 20 to 73 s and 74 to 120 s."""
AROUND_OUTLIERS = range(97, 105)
"""Seconds whose decisions are reported; the outliers are at 100 and 101 s."""


def filters(scenario: Scenario, names: Sequence[str]) -> Filters:
    """Filters of these names; ``f1``, ``f2`` and ``f3`` are the paper's single ones, those of ``DETECT`` its bank."""
    motion, sensor = scenario.motion, scenario.sensor
    made: Filters = {}
    for name in names:
        if name in TRACKING_INDEX:
            made[name] = AlphaBeta(motion, sensor, gains.kalata(TRACKING_INDEX[name]))
        elif name in DETECT:
            made[name] = presets.alphabeta(
                motion, sensor, gains=gains.levels(), manoeuvre=3.5, outlier=10.0, level_shares=[6 / 7], margin=3.6,
                detect=DETECT[name],
            )  # fmt: skip
        else:
            made |= catalogue_filters(scenario, [name])
    return made


def summarise(study: Study, results: Results) -> tuple[dict[str, Any], str]:
    """``decisions``: errors by axis of each part of the tracks, and what the banks decided around the outliers."""
    tracks = study.scenario.simulate(study.runs, study.seed)
    decisions: dict[str, dict[str, Any]] = {}
    for name, f in study.filters.items():
        estimate = filtered(f, study.scenario, tracks)
        decisions[name] = _errors(estimate, tracks.truth) | _decisions(estimate)
    rows = []
    for name, of in decisions.items():
        errors = [f"{of['level_x']:.1f}", f"{of['manoeuvre_x']:.1f}"]
        rejected = " ".join(f"{100 * share:.0f}" for share in of.get("rejected", {}).values())
        rows.append([name, *errors, f"{of['restarts_per_run']:.3f}" if rejected else "", rejected])
    header = ["filter", "level x, m", "manoeuvre x", "restarts", "rejected at 97 ... 104 s, %"]
    return {"decisions": decisions}, text_table(header, rows)


def _errors(estimate: Estimate, truth: torch.Tensor) -> dict[str, float]:
    square = (estimate.mean[..., :3] - truth[..., :3]).square()
    errors: dict[str, float] = {}
    for part, steps in PARTS.items():
        of_runs = square[:, steps].mean(1).sqrt()
        errors |= {f"{part}_{axis}": of_runs[:, i].mean().item() for i, axis in enumerate("xyz")}
    return errors


def _decisions(estimate: Estimate) -> dict[str, Any]:
    """Along x: shares of the runs that vote for a manoeuvre and reject the measurement; nothing for a single filter."""
    if not hasattr(estimate.info, "rejected"):
        return {}
    of: dict[str, Any] = {}
    for key in ("manoeuvre", "rejected"):
        share = getattr(estimate.info, key)[..., 0].double().mean(0)
        of[key] = {str(k): share[k - 1].item() for k in AROUND_OUTLIERS}
    return of | {"restarts_per_run": estimate.info.restarted[..., 0].double().sum(1).mean().item()}


def draw(study: Study, results: Results, summary: dict[str, Any]) -> Figures:
    """Coordinates of the first run, errors along x, errors by coordinate over time, and levels in use along x."""
    scenario, dt = study.scenario, study.scenario.dt
    tracks = scenario.simulate(min(study.runs, SHOWN), study.seed)
    estimates = {name: filtered(f, scenario, tracks) for name, f in study.filters.items()}
    banks = [name for name, f in study.filters.items() if isinstance(f, AlphaBetaBank)]
    figures, first = {}, f"{scenario.name}, first run"
    for i, axis in enumerate("xyz"):
        paths = {name: estimates[name].mean[0, :, i] for name in banks or estimates}
        name, label = f"xu-{4 + i}-{axis}", f"{axis}, m"
        figures[name] = along(tracks.truth[0, :, i], tracks.z[0, :, i], paths, dt, label, first)
    errors = {name: estimate.mean[..., 0] - tracks.truth[..., 0] for name, estimate in estimates.items()}
    title = f"{scenario.name}, quartiles of {len(tracks.z)} runs"
    figures["xu-7-errors"] = errors_along(errors, dt, "error along x, m", title)
    figures["xu-rmse"] = by_coordinate(results, "rmse", 1.0, dt, study.title)
    shares = {}
    for name in banks:
        level = estimates[name].info.level[..., 0].round().long()
        shares[name] = torch.nn.functional.one_hot(level, len(LEVELS)).double().mean(0)
    if shares:
        figures["xu-levels"] = probabilities(shares, LEVELS, 1.0, dt, title)
    return figures


EXPERIMENTS = {
    "alpha-beta": Experiment(("f1", "f2", "f3", "paper", "paper_polar", "alphabeta"), filters, summarise, draw)
}
