"""The clutter experiments of ``reproduce.py``: errors by target, raw and filtered ranges, association, lost tracks."""

from __future__ import annotations

from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchfra import metrics, presets
from torchfra.angles import wrap
from torchfra.app import plotting
from torchfra.app.progress import progress_bar
from torchfra.association import Euclidean
from torchfra.catalogue import check_names
from torchfra.coordinates import from_cartesian
from torchfra.filters import Filter
from torchfra.scenarios import Scenario, Tracks

GATES = (100.0, 150.0)
SETTLED, LOST = 10, 100.0
"""Steps that do not count in averages, and the RMSE of a run, m, from which on a track of it is lost."""
SHOWN = 3
"""Scans of the first run whose association probabilities are told: those that leave the last filter most in doubt."""
_CHUNK = 500
_SAFEGUARDS = {"paper": (0.0, 0.0), "safe": (0.9999, 1e-3)}
"""Least probability of the gate, and when a track counts as lost."""


def scan_filters(scenario: Scenario, names: list[str]) -> dict[str, Filter]:
    """Filters of these names at both gates: ``ukf_jpda_paper`` without our safeguards, ``ukf_jpda_safe`` with them."""
    found: dict[str, Filter] = {}
    for name in names:
        base, _, kind = name.rpartition("_")
        if kind not in _SAFEGUARDS:
            raise ValueError(f"filters: expected names that end in _paper or _safe, received {name!r}")
        check_names([base], scenario)
        least, lost = _SAFEGUARDS[kind]
        for gate in GATES:
            found[f"{name} {gate:g} m"] = getattr(presets, base)(
                scenario.motion, scenario.sensor, clutter=scenario.clutter, detection=scenario.detection,
                gate=Euclidean(gate, least), lost=lost,
            )  # fmt: skip
    return found


def scan_figures(
    scenario: Scenario, filters: dict[str, Filter], runs: int, seed: int, progress: bool
) -> dict[str, dict[str, Any]]:
    """Of every filter.

    Returns:
        ``rmse_range``, ``rmse_azimuth``, ``rmse_elevation`` and ``rmse_position`` over time of each target ``[N][T]``;
        ``rmse`` of the position, ``median_run``, ``lost`` runs and ``swaps`` from step 11 on; ``ospa`` over time;
        ``raw`` and ``filtered`` range error, root mean square over both targets and time.
    """
    sums: dict[str, dict[str, Any]] = {name: {} for name in filters}
    for first in progress_bar(range(0, runs, _CHUNK), f"{_CHUNK} runs", progress):
        tracks = scenario.simulate(min(_CHUNK, runs - first), seed, first=first)
        raw = _raw(scenario, tracks)
        for name, f in filters.items():
            with torch.no_grad():
                estimate = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
            for key, value in _errors(scenario, *_several(scenario, estimate, tracks), raw).items():
                sums[name].setdefault(key, []).append(value)
    return {name: _averages({key: torch.cat(parts) for key, parts in of.items()}) for name, of in sums.items()}


def _several(scenario: Scenario, estimate: Any, tracks: Tracks) -> tuple[Tensor, Tensor, Tensor]:
    """Estimates ``(B, N, T, 6)`` in both coordinates, and the truth; of a single target too."""
    all_of = (estimate.mean, scenario.cartesian(estimate).mean, tracks.truth)
    mean, shown, truth = (x if x.dim() == 4 else x.unsqueeze(1) for x in all_of)
    return mean, shown, truth


def _errors(scenario: Scenario, mean: Tensor, shown: Tensor, cartesian: Tensor, raw: Tensor) -> dict[str, Tensor]:
    """Per run."""
    truth = from_cartesian(cartesian)
    gone = 1 / mean[..., 5] - 1 / truth[..., 5]
    position = metrics.error(shown, cartesian, scenario.truth_position)
    return {
        "range": gone,
        "azimuth": wrap(mean[..., 3] - truth[..., 3]),
        "elevation": mean[..., 4] - truth[..., 4],
        "position": position,
        "raw": raw,
        "swaps": metrics.swaps(shown, cartesian, scenario.truth_position, LOST),
        "ospa": metrics.ospa(shown, cartesian, scenario.truth_position, cutoff=LOST).distance,
    }


def _raw(scenario: Scenario, tracks: Tracks) -> Tensor:
    """Range errors ``(B, N, T)`` of the measurements nearest to each target; NaN where it was missed."""
    truth, z = (tracks.truth, tracks.z) if tracks.z.dim() == 4 else (tracks.truth.unsqueeze(1), tracks.z.unsqueeze(-2))
    there = scenario.sensor(from_cartesian(truth)).movedim(1, 2).unsqueeze(-2)  # (B, T, N, 1, m)
    gap = scenario.sensor.difference(z.unsqueeze(-3), there)
    scale = scenario.sensor.std() * float(str(scenario.settings["noise_scale"]))
    far = (gap / scale).square().sum(-1).nan_to_num(torch.inf)
    least, nearest = far.min(-1)
    error = gap[..., 2].gather(-1, nearest.unsqueeze(-1)).squeeze(-1)
    return torch.where(least < 25.0, error, torch.nan).movedim(1, 2)


def _averages(of: dict[str, Tensor]) -> dict[str, Any]:
    over_time = {f"rmse_{key}": of[key].square().mean(0).sqrt().tolist()
                 for key in ("range", "azimuth", "elevation", "position")}  # fmt: skip
    settled = slice(SETTLED, None)
    run = of["position"][..., settled].square().mean((-2, -1)).sqrt()
    lost = run > LOST
    return {
        "rmse": run.square().mean().sqrt().item(),
        "rmse_kept": run[~lost].square().mean().sqrt().item(),
        "median_run": run.median().item(),
        "lost": int(lost.sum()),
        "swaps": int(of["swaps"].sum()),
        "raw_range": of["raw"][..., settled].square().nanmean().sqrt().item(),
        "filtered_range": of["range"][..., settled].square().mean().sqrt().item(),
        "filtered_range_median_run": of["range"][..., settled].square().mean((-2, -1)).sqrt().median().item(),
        "ospa": of["ospa"].mean(0).tolist(),
        **over_time,
    }


def associations(scenario: Scenario, filters: dict[str, Filter], seed: int) -> dict[str, dict[str, Any]]:
    """Of the first run, at some scans, for each target: probabilities that it was missed, and of each measurement."""
    tracks = scenario.simulate(1, seed)
    with torch.no_grad():
        of = {name: f(tracks.z, tracks.prior, dt=scenario.dt).info.association[0] for name, f in filters.items()}
    doubt = torch.special.entr(list(of.values())[-1]).sum((0, -1))
    shown = sorted(doubt.argsort(descending=True)[:SHOWN].tolist())
    return {name: {str(k + 1): each[:, k].tolist() for k in shown} for name, each in of.items()}


def scan_table(of: dict[str, dict[str, Any]]) -> str:
    """As text."""
    titles = ("RMSE m", "kept m", "median run", "lost", "swaps", "range m", "raw m", "azimuth mrad", "elevation mrad")
    lines = [f"{'filter':<24}" + "".join(f"{title:>15}" for title in titles)]
    for name, values in of.items():
        angles = [1e3 * torch.tensor(values[f"rmse_{key}"])[:, SETTLED:].square().mean().sqrt().item()
                  for key in ("azimuth", "elevation")]  # fmt: skip
        cells = [f"{values[key]:.2f}" for key in ("rmse", "rmse_kept", "median_run")]
        cells += [str(values[key]) for key in ("lost", "swaps")]
        cells += [f"{x:.2f}" for x in (values["filtered_range"], values["raw_range"], *angles)]
        lines.append(f"{name:<24}" + "".join(f"{cell:>15}" for cell in cells))
    return "\n".join(lines)


def association_table(of: dict[str, dict[str, Any]]) -> str:
    """As text, of the last filter."""
    name = list(of)[-1]
    lines = [f"association probabilities of the first run, {name}"]
    for scan, targets in of[name].items():
        for number, row in enumerate(targets):
            said = "  ".join(f"{p:.3f}" for p in row[1:])
            lines.append(f"  scan {scan:>3}, target {number + 1}: missed {row[0]:.3f}, measurements {said}")
    return "\n".join(lines)


def draw_scans(
    scenario: Scenario, filters: dict[str, Filter], of: dict[str, dict[str, Any]], runs: int, seed: int
) -> dict[str, Figure]:
    """Errors of each target over time; raw and filtered range errors and a picture in space of the first run."""
    title = f"{scenario.name}, {runs} runs"
    errors = {f"{scenario.name}-errors": plotting.by_target(of, scenario.dt, title)}
    if scenario.clutter is None:
        return errors
    last = list(filters)[-1]
    tracks = scenario.simulate(1, seed)
    with torch.no_grad():
        estimate = filters[last](tracks.z, tracks.prior, dt=scenario.dt)
    ranges = {
        f"target {i + 1}": (_raw(scenario, tracks)[0, i].abs(), (1 / estimate.mean[0, i, :, 5] - gone).abs())
        for i, gone in enumerate(1 / from_cartesian(tracks.truth[0])[..., 5])
    }
    scans = scenario.sensor.locate(tracks.z[0]).flatten(0, 1)
    paths = scenario.cartesian(estimate).mean[0]
    return errors | {
        f"{scenario.name}-ranges": plotting.raw_and_filtered(
            ranges, scenario.dt, f"{scenario.name}, first run, {last}"
        ),
        f"{scenario.name}-space": plotting.in_space(
            tracks.truth[0], paths, scans, f"{scenario.name}, first run, {last}"
        ),
    }
