"""Chen, Zou & Wu: aircraft among false measurements, and one aircraft alone whose measurement noise grows.

Filters estimate in modified spherical coordinates; the truth is Cartesian.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from papers import scans
from papers.experiment import Experiment, Figures, Filters, Results, Study, catalogue_filters
from torchfra import plotting
from torchfra.association import Euclidean
from torchfra.catalogue import scenario_filter
from torchfra.running.progress import progress_bar
from torchfra.scenarios import Scenario
from torchfra.tables import text_table

GATES = (100.0, 150.0)
"""Sizes of the gate, m."""
SCANS_SHOWN = 3
"""Scans of the first run whose association probabilities are reported: those in which the last filter is least sure."""
_CHUNK = 500
_SAFEGUARDS = {"paper": (0.0, 0.0), "safe": (0.9999, 1e-3)}
"""Least probability of the gate, and the probability below which a series of misses means that a track is lost."""
_KEYS = {"RMSE m": "rmse", "kept m": "rmse_kept", "median run": "median_run", "lost": "lost", "swaps": "swaps",
         "range m": "filtered_range", "raw m": "raw_range"}  # fmt: skip


def filters(scenario: Scenario, names: Sequence[str]) -> Filters:
    """Filters of these names; those of scans at both gates.

    ``ukf_jpda_paper`` and ``iaukf_jpda_paper`` are as in the paper, those on ``_safe`` have the safeguards of
    ``presets.iaukf_jpda``.
    """
    if scenario.clutter is None:
        return catalogue_filters(scenario, names)
    made: Filters = {}
    for name in names:
        base, _, kind = name.rpartition("_")
        if kind not in _SAFEGUARDS:
            raise ValueError(f"filters: expected names that end in _paper or _safe, received {name!r}")
        least, lost = _SAFEGUARDS[kind]
        for size in GATES:
            made[f"{name} {size:g} m"] = scenario_filter(base, scenario, gate=Euclidean(size, least), lost=lost)
    return made


def summarise(study: Study, results: Results) -> tuple[dict[str, Any], str]:
    """``scans``: errors by target, lost runs, swaps; in clutter also ``associations`` of the first run."""
    of = errors(study)
    summary: dict[str, Any] = {"scans": of}
    rows = [[name, *_cells(values)] for name, values in of.items()]
    text = text_table(["filter", *_KEYS, "azimuth mrad", "elevation mrad"], rows)
    if study.scenario.clutter is not None:
        summary["associations"] = associations(study)
        text += "\n" + _association_text(summary["associations"])
    return summary, text


def errors(study: Study) -> dict[str, dict[str, Any]]:
    """Of every filter, see ``scans.averages``."""
    scenario = study.scenario
    parts: dict[str, list[dict[str, torch.Tensor]]] = {name: [] for name in study.filters}
    for first in progress_bar(range(0, study.runs, _CHUNK), f"{_CHUNK} runs", study.progress):
        tracks = scenario.simulate(min(_CHUNK, study.runs - first), study.seed, first=first)
        for name, f in study.filters.items():
            with torch.no_grad():
                estimate = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
            parts[name].append(scans.errors(scenario, estimate, tracks))
    return {
        name: scans.averages({key: torch.cat([part[key] for part in of]) for key in of[0]})
        for name, of in parts.items()
    }


def associations(study: Study) -> dict[str, dict[str, Any]]:
    """Of the first run, at some scans, for each target: probabilities that it was missed, and of each measurement."""
    tracks = study.scenario.simulate(1, study.seed)
    with torch.no_grad():
        of = {name: f(tracks.z, tracks.prior, dt=study.scenario.dt).info.association[0]
              for name, f in study.filters.items()}  # fmt: skip
    doubt = torch.special.entr(list(of.values())[-1]).sum((0, -1))
    shown = sorted(doubt.argsort(descending=True)[:SCANS_SHOWN].tolist())
    return {name: {str(k + 1): each[:, k].tolist() for k in shown} for name, each in of.items()}


def _cells(values: dict[str, Any]) -> list[str]:
    cells = [str(values[key]) if isinstance(values[key], int) else f"{values[key]:.2f}" for key in _KEYS.values()]
    for angle in ("azimuth", "elevation"):
        converged = torch.tensor(values[f"rmse_{angle}"])[:, scans.CONVERGED :]
        cells.append(f"{1e3 * converged.square().mean().sqrt().item():.2f}")
    return cells


def _association_text(of: dict[str, dict[str, Any]]) -> str:
    """The association probabilities of the last filter."""
    name = list(of)[-1]
    lines = [f"association probabilities of the first run, {name}"]
    for scan, targets in of[name].items():
        for number, (missed, *measured) in enumerate(targets, 1):
            shares = "  ".join(f"{p:.3f}" for p in measured)
            lines.append(f"  scan {scan:>3}, target {number}: missed {missed:.3f}, measurements {shares}")
    return "\n".join(lines)


def draw(study: Study, results: Results, summary: dict[str, Any]) -> Figures:
    """Errors of each target over time; in clutter also range errors and a picture in space of the first run."""
    scenario = study.scenario
    figures = {f"{scenario.name}-errors": plotting.by_target(summary["scans"], scenario.dt, study.title)}
    if scenario.clutter is None:
        return figures
    last = list(study.filters)[-1]
    title = f"{scenario.name}, first run, {last}"
    tracks = scenario.simulate(1, study.seed)
    with torch.no_grad():
        estimate = study.filters[last](tracks.z, tracks.prior, dt=scenario.dt)
    ranges = {
        f"target {i + 1}": (raw.abs(), error.abs())
        for i, (raw, error) in enumerate(
            zip(scans.measured_ranges(scenario, tracks)[0], scans.range_errors(estimate, tracks.truth)[0], strict=True)
        )
    }
    measured = scenario.sensor.locate(tracks.z[0]).flatten(0, 1)
    paths = scenario.cartesian(estimate).mean[0]
    return figures | {
        f"{scenario.name}-ranges": plotting.raw_and_filtered(ranges, scenario.dt, title),
        f"{scenario.name}-space": plotting.in_space(tracks.truth[0], paths, measured, title),
    }


_IN_CLUTTER = Experiment(
    ("ukf_jpda_paper", "iaukf_jpda_paper", "ukf_jpda_safe", "iaukf_jpda_safe"), filters, summarise, draw
)
EXPERIMENTS = {
    "clutter-straight": _IN_CLUTTER,
    "clutter-crossing": _IN_CLUTTER,
    "noise-change": Experiment(("ukf", "iaukf"), filters, summarise, draw),
}
