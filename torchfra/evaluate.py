"""Many runs of a scenario through many filters: one dictionary of figures for each."""

from __future__ import annotations

import copy
import json
import platform
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchfra import distributed, presets
from torchfra.bank import Bank
from torchfra.filters.base import Filter
from torchfra.motion import Motion
from torchfra.scenarios import Scenario, Tracks
from torchfra.sensors import Position, Sensor
from torchfra.tally import Tally
from torchfra.types import Estimate
from torchfra.version import __version__

FILTERS: dict[str, Callable[..., Filter]] = {
    f.__name__: f
    for f in (presets.ukf, presets.ekf, presets.srckf, presets.rsrckf, presets.mr_ckf, presets.asrckf, presets.rmckf,
              presets.ghckf, presets.hghckf1, presets.hghckf2, presets.iaukf,
              presets.fra_srckf, presets.fra, presets.imm_srckf, presets.vsimm_srckf, presets.imm_fra,
              presets.alphabeta)
}  # fmt: skip
"""The filters that commands know by name."""
BANKED = ("imm_srckf", "vsimm_srckf", "imm_fra")
"""Those of them around a bank of motions."""
SCANS: dict[str, Callable[..., Filter]] = {f.__name__: f for f in (presets.ukf_jpda, presets.iaukf_jpda)}
"""The filters for scans of several targets."""

Result = dict[str, Any]


def evaluate(
    scenario: Scenario,
    filters: Sequence[str] | Mapping[str, Filter],
    *,
    runs: int,
    seed: int = 0,
    limit: float = 2000.0,
    chunk: int = 1000,
    compile: bool = False,
    progress: bool = False,
) -> dict[str, Result]:
    """Runs of a scenario through filters.

    Args:
        scenario: what is tracked.
        filters: names of ``FILTERS`` (of ``SCANS`` for scans), or filters by names of their own.
        runs: how many.
        seed: of the random numbers; every filter sees the same runs.
        limit: a run diverges when its position error, root mean square over time, is above this, m.
        chunk: runs that are filtered at once; bounds the memory, which does not grow with ``runs`` but for one number
            per run and filter.
        compile: whether to run compiled (``Filter.compile``); needs a C++ compiler.
        progress: whether to show a bar.

    Returns:
        For each filter: ``rmse_position``, ``rmse_velocity`` and those of ``Scenario.others`` over time ``[T]``, their
        means ``mean_rmse_*``, ``median_error_position`` over all steps and runs (to 0.05 %), ``median_track_rmse`` and
        ``worst_track`` of the runs' own root mean square errors, ``divergence_rate``, ``nees_position`` (median, to
        0.05 %; 1.39 if honest, in the plane), by coordinate and over time the signed ``mean_error_x``, ``rmse_x`` and
        ``mape_x`` (mean relative error, %, of coordinates of 100 m or more), the models' mean ``probabilities``
        ``[T][K]`` if there are some, ``microseconds`` per run and step and ``relative_time`` to the UKF (``ukf_jpda``
        on scans) on the same runs.  Each target of a run of several counts as a track.

    Under ``torchrun`` the processes share the runs, and each returns the results of all of them.

    Raises:
        ValueError: an unknown filter, or fewer runs than processes.
    """
    if not isinstance(filters, Mapping):
        filters = chosen(filters, scenario)
    reference = "ukf" if scenario.clutter is None else "ukf_jpda"
    timed = chosen([reference], scenario) | dict(filters)
    if runs < distributed.size() or chunk < 1:
        raise ValueError(f"runs, chunk: expected at least {distributed.size()} and 1, received {runs}, {chunk}")
    if compile:
        timed = {name: copy.copy(f).compile() for name, f in timed.items()}
    own = distributed.share(runs)
    tallies = {name: Tally(scenario.quantities) for name in timed}
    with torch.no_grad():
        # The first passes pay for memory and for kernels.
        few = scenario.simulate(min(len(own), chunk), seed)
        for f in timed.values():
            run(f, scenario, few)
        for first in progress_bar(own[::chunk], f"{chunk} runs", progress):
            tracks = scenario.simulate(min(chunk, own.stop - first), seed, first=first)
            for name, f in timed.items():
                start = time.perf_counter()
                estimate = run(f, scenario, tracks)
                tallies[name].add(estimate, tracks.truth, time.perf_counter() - start)
                del estimate  # before the next one is made
    everyone = distributed.gathered(tallies)
    for others in everyone[1:]:
        for name, tally in others.items():
            everyone[0][name].merge(tally)
    tallies = everyone[0]
    steps = runs * scenario.steps
    return {
        name: tallies[name].summary(limit)
        | {
            "microseconds": tallies[name].seconds / steps * 1e6,
            "relative_time": tallies[name].seconds / tallies[reference].seconds,
        }
        for name in filters
    }


def chosen(names: Sequence[str], scenario: Scenario) -> dict[str, Filter]:
    """The filters of these names, around the models of a scenario.

    Raises:
        ValueError: a name that is not in ``FILTERS`` (``SCANS`` for scans), or none at all.
    """
    check_names(names, scenario)
    return {name: _around(name, scenario) for name in names}


def check_names(names: Sequence[str], scenario: Scenario) -> None:
    """Whether there are filters of these names for a scenario.

    Raises:
        ValueError: a name that is not in ``FILTERS`` (``SCANS`` for scans), or none at all.
    """
    known = FILTERS if scenario.clutter is None else SCANS
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise ValueError(f"filters: expected names out of {', '.join(known)}, received {', '.join(unknown) or 'none'}")


def _around(name: str, scenario: Scenario, **options: Any) -> Filter:
    """The filter of this name around the models of a scenario."""
    if scenario.clutter is None:
        return make(name, scenario.motion, scenario.sensor, scenario.bank, **options)
    given = {"clutter": scenario.clutter, "detection": scenario.detection}
    return SCANS[name](scenario.motion, scenario.sensor, **given | options)


def fitting(scenario: Scenario) -> list[str]:
    """The filters for a scenario: those of banks if it has one, and of positions if that is what is measured."""
    if scenario.clutter is not None:
        return list(SCANS)
    skipped = set(BANKED) if scenario.bank is None else set()
    if not isinstance(scenario.sensor, Position) or scenario.sensor.std is None:
        skipped.add("alphabeta")
    return [name for name in FILTERS if name not in skipped]


def make(name: str, motion: Motion, sensor: Sensor, bank: Bank | None = None, **options: Any) -> Filter:
    """The filter of this name around a motion, or around a bank of motions if it is one of interacting models.

    Raises:
        ValueError: an unknown name, or interacting models where there is no bank.
    """
    if name not in FILTERS:
        raise ValueError(f"filter: expected one of {', '.join(FILTERS)}, received {name!r}")
    if name not in BANKED:
        return FILTERS[name](motion, sensor, **options)
    if bank is None:
        raise ValueError(f"filter: expected one of a single motion, received {name!r}, for which there is no bank")
    return FILTERS[name](bank, sensor, **options)


def learned(path: str | Path, scenario: Scenario, name: str = "fra") -> Filter:
    """The filter ``name`` of ``FILTERS`` with values that were learned.

    Args:
        path: a state dictionary, as ``torch.save(f.state_dict(), path)`` writes it; a ``config.json`` beside it, of a
            training run with this filter, says what the filter was made with.
        scenario: whose models the filter gets, with learned values of their own.
        name: of the filter that learned, one of ``SCANS`` for scans.

    Raises:
        ValueError: an unknown filter, or a file that is no state dictionary of it.
    """
    config = Path(path).with_name("config.json")  # what train.tune writes beside it
    said = json.loads(config.read_text()) if config.exists() else {}
    options = said.get("options", {}) if said.get("filter") == name else {}
    check_names([name], scenario)
    f = _around(name, copy.deepcopy(scenario), **options)
    try:
        f.load_state_dict(torch.load(path, weights_only=True))
    except OSError:
        raise
    except Exception as error:  # torch raises whatever its reader came upon
        said = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"learned: expected {path} to hold a state dictionary of {name}: {said}") from None
    return f


def run(f: Filter, scenario: Scenario, tracks: Tracks) -> Estimate:
    """The tracks of a scenario through one filter, in the truth's coordinates."""
    estimate: Estimate = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
    return scenario.shown(estimate)


def report(scenario: Scenario, results: dict[str, Result], *, runs: int, seed: int) -> dict[str, Any]:
    """What a results file holds: what was done, with what, and what came out."""
    settings = {"dt": scenario.dt, "steps": scenario.steps, "threads": torch.get_num_threads(), **scenario.settings}
    return {"experiment": scenario.name, "runs": runs, "seed": seed, "settings": settings, "versions": versions(),
            "filters": results}  # fmt: skip


def versions() -> dict[str, str]:
    """Of what computed the results."""
    return {
        "torchfra": __version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def table(results: dict[str, Result]) -> str:
    """The results as text, one line per filter."""
    columns = (
        ("RMSE m", "mean_rmse_position", ".1f"),
        ("RMSE m/s", "mean_rmse_velocity", ".2f"),
        ("median m", "median_error_position", ".1f"),
        ("worst run m", "worst_track", ".0f"),
        ("diverged %", "divergence_rate", ".2f"),
        ("NEES", "nees_position", ".2f"),
        ("time / UKF", "relative_time", ".2f"),
    )
    lines = [f"{'filter':<10}" + "".join(f"{title:>12}" for title, _, _ in columns)]
    for name, result in results.items():
        cells = [result[key] * (100 if key == "divergence_rate" else 1) for _, key, _ in columns]
        said = [f"{c:{f}}" if c < 1e6 else f"{c:.0e}" for c, (_, _, f) in zip(cells, columns, strict=True)]
        lines.append(f"{name:<10}" + "".join(f"{cell:>12}" for cell in said))
    return "\n".join(lines)


def progress_bar(items: Iterable[Any], unit: str, show: bool) -> Iterable[Any]:
    """The items, behind a bar if that is wanted, a terminal is there and tqdm is installed."""
    if show and sys.stderr.isatty():
        try:
            from tqdm import tqdm
        except ImportError:
            return items
        bar: Iterable[Any] = tqdm(items, unit=unit, leave=False)
        return bar
    return items
