"""Chen, Zou & Wu: aircraft among false measurements, and one aircraft alone whose measurement noise grows.

Filters estimate in modified spherical coordinates; the truth is Cartesian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from papers.experiment import SHOWN, Experiment, Figures, Filters, Results, Study, catalogue_filters
from papers.figures import by_target, in_space, raw_and_filtered
from torchfra import metrics, presets
from torchfra.angles import wrap
from torchfra.association import Euclidean
from torchfra.catalogue import scenario_filter
from torchfra.coordinates import AZIMUTH, ELEVATION, from_cartesian
from torchfra.filters import Filter
from torchfra.running.progress import progress_bar
from torchfra.scenarios import Scenario, Tracks
from torchfra.tables import text_table
from torchfra.types import Estimate

GATES = (100.0, 150.0)
"""Sizes of the gate, m."""
SCANS_SHOWN = 3
"""Scans of the first run whose association probabilities are reported: those in which the last filter is least sure."""
NUMBERS: dict[str, dict[str, Any]] = {
    "clutter-straight": {"ranges": "chen-2-ranges", "errors": "chen-3-errors",
                         "space": {"100": "chen-straight-space", "150": "chen-straight-space-wide"}},
    "clutter-crossing": {"ranges": "chen-crossing-ranges", "errors": "chen-6-errors",
                         "space": {"100": "chen-5-space", "150": "chen-4-space-wide"}},
    "noise-change": {"errors": "chen-noise-change"},
}  # fmt: skip
"""Names of figures, with the numbers of the paper's."""
CONVERGED, LOST = 10, 100.0
"""Steps that do not count in averages, and the RMSE of a run, m, from which on a track of it is lost."""
INVERSE_RANGE = 5
"""Component of the modified spherical state."""
RANGE = 2
"""Element of a measurement."""
_FARTHEST = 25.0
"""Squared distance, in standard deviations, up to which the nearest measurement of a scan may come from a target."""

_CHUNK = 500
_SAFEGUARDS = {"paper": (0.0, 0.0), "safe": (0.9999, 1e-3)}
"""Least probability of the gate, and the probability below which a series of misses means that a track is lost."""
SAME_POINTS = "_same_points"
"""End of the names of filters whose points go from the prediction through the sensor, as in the paper."""
_INNER: dict[str, Callable[..., Filter]] = {
    "ukf": partial(presets.ukf, alpha=1.0, beta=2.0, kappa=0.0),
    "iaukf": presets.iaukf,
}
_KEYS = {"RMSE m": "rmse", "kept m": "rmse_kept", "median run": "median_run", "lost": "lost", "swaps": "swaps",
         "range m": "filtered_range", "raw m": "raw_range"}  # fmt: skip


def filters(scenario: Scenario, names: Sequence[str]) -> Filters:
    """Filters of these names; those of scans at both gates.

    ``ukf_jpda_paper`` and ``iaukf_jpda_paper`` are as in the paper, those on ``_safe`` have the safeguards of
    ``presets.iaukf_jpda``.  Those on ``SAME_POINTS`` draw no new points after the prediction, as in the paper.
    """
    made: Filters = {}
    for name in names:
        base = name.removesuffix(SAME_POINTS)
        if base != name:
            made |= _with_same_points(scenario, name, base)
            continue
        if scenario.clutter is None:
            made |= catalogue_filters(scenario, [name])
            continue
        base, _, kind = name.rpartition("_")
        if kind not in _SAFEGUARDS:
            raise ValueError(f"filters: expected names that end in _paper or _safe, received {name!r}")
        least, lost = _SAFEGUARDS[kind]
        for size in GATES:
            made[f"{name} {size:g} m"] = scenario_filter(base, scenario, gate=Euclidean(size, least), lost=lost)
    return made


def _with_same_points(scenario: Scenario, name: str, base: str) -> Filters:
    """A filter, or those at both gates, whose points go from the prediction through the sensor."""
    kind = base.removesuffix("_jpda_paper")
    if kind not in _INNER or (kind == base) != (scenario.clutter is None):
        raise ValueError(f"filters: expected {' or '.join(_INNER)} before {SAME_POINTS}, received {name!r}")
    motion, sensor, inner = scenario.motion, scenario.sensor, partial(_INNER[kind], redraw=False)
    if scenario.clutter is None:
        return {name: inner(motion, sensor)}
    return {f"{name} {size:g} m": presets.jpda(motion, sensor, clutter=scenario.clutter, inner=inner,
                                               gate=Euclidean(size)) for size in GATES}  # fmt: skip


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
    """Of every filter, see ``averages``."""
    scenario = study.scenario
    parts: dict[str, list[dict[str, Tensor]]] = {name: [] for name in study.filters}
    for first in progress_bar(range(0, study.runs, _CHUNK), f"{_CHUNK} runs", study.progress):
        tracks = scenario.simulate(min(_CHUNK, study.runs - first), study.seed, first=first)
        for name, f in study.filters.items():
            with torch.no_grad():
                estimate = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
            parts[name].append(of_estimate(scenario, estimate, tracks))
    return {name: averages({key: torch.cat([part[key] for part in of]) for key in of[0]}) for name, of in parts.items()}


def associations(study: Study) -> dict[str, dict[str, Any]]:
    """Of the first run, at some scans, for each target: probabilities that it was missed, and of each measurement."""
    tracks = study.scenario.simulate(1, study.seed)
    with torch.no_grad():
        of = {name: f(tracks.z, tracks.prior, dt=study.scenario.dt).info.association[0]
              for name, f in study.filters.items()}  # fmt: skip
    entropy = torch.special.entr(list(of.values())[-1]).sum((0, -1))
    shown = sorted(entropy.argsort(descending=True)[:SCANS_SHOWN].tolist())
    return {name: {str(k + 1): each[:, k].tolist() for k in shown} for name, each in of.items()}


def _cells(values: dict[str, Any]) -> list[str]:
    cells = [str(values[key]) if isinstance(values[key], int) else f"{values[key]:.2f}" for key in _KEYS.values()]
    for angle in ("azimuth", "elevation"):
        converged = torch.tensor(values[f"rmse_{angle}"])[:, CONVERGED:]
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
    """Errors of each target over time; in clutter also range errors, and pictures in space of the first run."""
    scenario, numbers = study.scenario, NUMBERS[study.scenario.name]
    figures = {numbers["errors"]: by_target(summary["scans"], scenario.dt, study.title)}
    if scenario.clutter is None:
        return figures
    last = list(study.filters)[-1]
    tracks = scenario.simulate(min(study.runs, SHOWN), study.seed)
    with torch.no_grad():
        estimate = study.filters[last](tracks.z, tracks.prior, dt=scenario.dt)
    raw, error = measured_ranges(scenario, tracks).abs(), range_errors(estimate, tracks.truth).abs()
    ranges = {f"target {i + 1}": (raw[:, i], error[:, i]) for i in range(raw.shape[1])}
    title = f"{scenario.name}, quartiles of {len(tracks.z)} runs, {last}"
    figures[numbers["ranges"]] = raw_and_filtered(ranges, scenario.dt, title)
    one, measured = scenario.simulate(1, study.seed), scenario.sensor.locate(tracks.z[0]).flatten(0, 1)
    for name, f in list(study.filters.items())[-len(GATES) :]:
        with torch.no_grad():
            paths = scenario.cartesian(f(one.z, one.prior, dt=scenario.dt)).mean[0]
        size = name.rsplit(" ", 2)[-2]
        key = numbers["space"][size]
        figures[key] = in_space(one.truth[0], paths, measured, f"{scenario.name}, first run, {name}")
    return figures


# ---------------------------------------------------------------- errors


def of_estimate(scenario: Scenario, estimate: Estimate, tracks: Tracks) -> dict[str, Tensor]:
    """Per run, target and step ``(B, N, T)``: errors in spherical coordinates and in space, ``swaps`` and ``ospa``.

    Args:
        scenario: with estimates in modified spherical coordinates.
        estimate: as the filter gives it, of several targets ``(B, N, T)`` or of one ``(B, T)``.
        tracks: what was filtered.
    """
    parts = (estimate.mean, scenario.cartesian(estimate).mean, tracks.truth)
    mean, cartesian, truth = (x if x.dim() == 4 else x.unsqueeze(1) for x in parts)
    angles, position = from_cartesian(truth), scenario.truth_position
    return {
        "range": range_errors(estimate._replace(mean=mean), truth),
        "azimuth": wrap(mean[..., AZIMUTH] - angles[..., AZIMUTH]),
        "elevation": mean[..., ELEVATION] - angles[..., ELEVATION],
        "position": metrics.error(cartesian, truth, position),
        "raw": measured_ranges(scenario, tracks),
        "swaps": metrics.swaps(cartesian, truth, position, LOST),
        "ospa": metrics.ospa(cartesian, truth, position, cutoff=LOST).distance,
    }


def range_errors(estimate: Estimate, truth: Tensor) -> Tensor:
    """Errors ``(..., T)`` in range of estimates in modified spherical coordinates, m."""
    return 1 / estimate.mean[..., INVERSE_RANGE] - 1 / from_cartesian(truth)[..., INVERSE_RANGE]


def measured_ranges(scenario: Scenario, tracks: Tracks) -> Tensor:
    """Range errors ``(B, N, T)`` of the measurements nearest to each target, m; NaN where it was missed."""
    truth, z = (tracks.truth, tracks.z) if tracks.z.dim() == 4 else (tracks.truth.unsqueeze(1), tracks.z.unsqueeze(-2))
    exact = scenario.sensor(from_cartesian(truth)).movedim(1, 2).unsqueeze(-2)  # (B, T, N, 1, m)
    gap = scenario.sensor.difference(z.unsqueeze(-3), exact)
    std = scenario.sensor.std() * float(str(scenario.settings["noise_scale"]))
    distance, nearest = (gap / std).square().sum(-1).nan_to_num(torch.inf).min(-1)
    error = gap[..., RANGE].gather(-1, nearest.unsqueeze(-1)).squeeze(-1)
    return torch.where(distance < _FARTHEST, error, torch.nan).movedim(1, 2)


def averages(of: dict[str, Tensor]) -> dict[str, Any]:
    """Of the errors of all runs.

    Returns:
        ``rmse_range``, ``rmse_azimuth``, ``rmse_elevation`` and ``rmse_position`` over time of each target ``[N][T]``;
        from step 11 on ``rmse`` of the position, ``rmse_kept`` without the runs that are ``lost``, ``median_run``, and
        root mean square range errors ``raw_range`` and ``filtered_range``; ``swaps``, and ``ospa`` over time.
    """
    over_time = {f"rmse_{key}": of[key].square().mean(0).sqrt().tolist()
                 for key in ("range", "azimuth", "elevation", "position")}  # fmt: skip
    converged = slice(CONVERGED, None)
    of_run = of["position"][..., converged].square().mean((-2, -1)).sqrt()
    lost = of_run > LOST
    ranges = of["range"][..., converged].square()
    return {
        "rmse": of_run.square().mean().sqrt().item(),
        "rmse_kept": of_run[~lost].square().mean().sqrt().item(),
        "median_run": of_run.median().item(),
        "lost": int(lost.sum()),
        "swaps": int(of["swaps"].sum()),
        "raw_range": of["raw"][..., converged].square().nanmean().sqrt().item(),
        "filtered_range": ranges.mean().sqrt().item(),
        "filtered_range_median_run": ranges.mean((-2, -1)).sqrt().median().item(),
        "ospa": of["ospa"].mean(0).tolist(),
        **over_time,
    }


_IN_CLUTTER = Experiment(
    ("ukf_jpda_paper", "iaukf_jpda_paper", "ukf_jpda_safe", "iaukf_jpda_safe"), filters, summarise, draw
)
EXPERIMENTS = {
    "clutter-straight": _IN_CLUTTER,
    "clutter-crossing": _IN_CLUTTER,
    "noise-change": Experiment(("ukf", "iaukf"), filters, summarise, draw),
}
