"""Wang et al. (2021): bearings from two moving stations, with outliers (scenario 1) and a manoeuvre (scenario 2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from papers.experiment import SHOWN, Experiment, Figures, Filters, Results, Study, catalogue_filters, filtered
from papers.figures import innovations, rmse_curves
from torchfra import plotting, presets
from torchfra.evaluation import table
from torchfra.filters import Filter
from torchfra.filters.fra import FRA
from torchfra.scenarios import Scenario
from torchfra.tables import text_table

GATE = 5.991
"""Normalised innovations squared above it are drawn as abnormal: the 95 % point of chi-square with two elements."""
NUMBERS = {"bearings-outliers": (2, 3, 4, 5), "bearings-manoeuvre": (6, 7, 8, 9)}
"""Numbers of the paper's figures, in whose names they stand."""
LITERAL = "fra_srckf_literal"
WINDOWS = {"1-20 s": (1, 20), "30-80 s": (30, 80), "69 s": (69, 69), "70 s": (70, 70), "75 s": (75, 75),
           "80-100 s": (80, 100)}  # fmt: skip
"""Seconds over which errors are averaged too: the start, the turn of scenario 2, around the last outlier, the end."""
OUTLIERS = {"bearings-outliers": (40, 50, 60, 70), "bearings-manoeuvre": (50, 60, 70)}
"""Seconds of the outliers."""
OWN: dict[str, Callable[[Scenario], Filter]] = {
    LITERAL: lambda s: presets.fra_srckf(s.motion, s.sensor, rcond=0.0, fading_max=math.inf),
    "gpb_one_motion": lambda s: presets.gpb(s.motion, s.sensor),
    "imm_rsrckf": lambda s: presets.imm(s.bank or s.motion, s.sensor, inner=presets.rsrckf, self_transition=0.99),
}
"""Filters that the catalogue has not: the paper's formulas without the safeguards that it does not give, ``gpb`` with
as little information as filters of one motion have, and robust filters inside interacting motions."""


def filters(scenario: Scenario, names: Sequence[str]) -> Filters:
    """Filters of these names, those of ``OWN`` among them, in their order."""
    made = catalogue_filters(scenario, known) if (known := [name for name in names if name not in OWN]) else {}
    return {name: OWN[name](scenario) if name in OWN else made[name] for name in names}


def summarise(study: Study, results: Results) -> tuple[dict[str, Any], str]:
    """Errors over ``WINDOWS``, and shares of up to 200 runs.

    These are of innovations above the gate, and of the runs in which a filter forked at the first step, or at an
    outlier, those in which it kept the adaptive branch.
    """
    errors, text = {}, [table(results)]
    for quantity, unit, digits in (("position", "m", 0), ("velocity", "m/s", 1)):
        errors[quantity] = {name: _in_windows(of[f"rmse_{quantity}"]) for name, of in results.items()}
        heads = [f"RMSE of {quantity}, {unit}", *next(iter(errors[quantity].values()))]
        rows = [[name, *(f"{x:.{digits}f}" if x < 1e5 else f"{x:.0e}" for x in of.values())]
                for name, of in errors[quantity].items()]  # fmt: skip
        text.append(text_table(heads, rows))
    tracks = study.scenario.simulate(min(study.runs, SHOWN), study.seed)
    planned = OUTLIERS[study.scenario.name] if study.scenario.settings["outliers"] not in ("bursts", "none") else ()
    seconds = [1, *(second for second in planned if second <= tracks.z.shape[-2])]
    shares: dict[str, dict[str, float]] = {}
    for name, f in study.filters.items():
        estimate = filtered(f, study.scenario, tracks)
        above = (estimate.nis > GATE).double().mean(0)
        shares[name] = {"above the gate": float(above.mean())}
        if len(turn := above[29:80]):
            shares[name]["at 30-80 s"] = float(turn.mean())
        if isinstance(f, FRA):
            forked, adaptive = estimate.info.abnormal, estimate.info.adaptive & estimate.info.abnormal
            kept = adaptive.sum(0) / forked.sum(0)
            shares[name] |= {f"adaptive at {second} s": float(kept[second - 1]) for second in seconds}
    heads = list(dict.fromkeys(key for of in shares.values() for key in of))
    rows = [[n, *(f"{100 * of[key]:.0f}" if key in of else "" for key in heads)] for n, of in shares.items()]
    text.append(text_table([f"%, {len(tracks.z)} runs", *heads], rows))
    return {"windows": errors, "shares": shares}, "\n\n".join(text)


def _in_windows(curve: Sequence[float]) -> dict[str, float]:
    """Means of an error over time over those of ``WINDOWS`` that the tracks have; NaN where it is not finite."""
    return {
        name: mean if math.isfinite(mean := sum(part) / len(part)) else math.nan
        for name, (first, last) in WINDOWS.items()
        if len(part := curve[first - 1 : last]) == last - first + 1
    }


def draw(study: Study, results: Results, summary: dict[str, Any]) -> Figures:
    """Paths of the first run; of all runs the innovations, as quartiles, and both errors over time."""
    scenario = study.scenario
    first = scenario.simulate(1, study.seed)
    paths = {name: filtered(f, scenario, first).mean[0] for name, f in study.filters.items()}
    compared = [name for name in ("srckf", "fra_srckf", LITERAL, "fra") if name in paths] or list(paths)
    reading = f"outliers {scenario.settings['outliers']}"
    tracks = scenario.simulate(min(study.runs, SHOWN), study.seed)
    nis = {name: filtered(study.filters[name], scenario, tracks).nis for name in compared}
    shown = f"{scenario.name}, {reading}, quartiles of {len(tracks.z)} runs"
    stations = first.u if scenario.name == "bearings-outliers" else None  # the paper's figure 6 leaves them out
    figures = {
        "tracks": plotting.tracks(first.truth[0], paths, f"{scenario.name}, {reading}, first run", stations),
        "innovations": innovations(nis, GATE, scenario.dt, shown),
        "position": rmse_curves(results, "position", scenario.dt, f"{study.title}, {reading}"),
        "velocity": rmse_curves(results, "velocity", scenario.dt, f"{study.title}, {reading}"),
    }
    return {f"wang-{n}-{kind}": f for n, (kind, f) in zip(NUMBERS[scenario.name], figures.items(), strict=True)}


_FILTERS = ("ukf", "srckf", "mr_ckf", "rsrckf", "rmckf", "fra_srckf", "fra")
EXPERIMENTS = {name: Experiment(_FILTERS, filters, summarise, draw) for name in NUMBERS}
