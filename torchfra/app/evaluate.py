"""Many runs of a scenario through many filters: one dictionary of figures for each."""

from __future__ import annotations

import copy
import platform
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from torchfra.app import distributed
from torchfra.app.running_metrics import Tally
from torchfra.catalogue import reference_filter, scenario_filters
from torchfra.filters.base import Filter
from torchfra.scenarios import Scenario, Tracks
from torchfra.types import Estimate
from torchfra.version import __version__

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
        filters: names of ``catalogue.FILTERS``, or filters by any names.
        runs: how many.
        seed: of the random numbers; every filter sees the same runs.
        limit: a run diverges when its position error, root mean square over time, is above this, m.
        chunk: runs that are filtered at once; bounds the memory, which does not grow with ``runs`` but for one number
            per run and filter.
        compile: whether to run compiled (``Filter.compile``); needs a C++ compiler.
        progress: whether to show a bar.

    Returns:
        For each filter: ``rmse_position`` and so on for all ``Scenario.quantities`` over time ``[T]``, their
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
        filters = scenario_filters(filters, scenario)
    reference = reference_filter(scenario)
    timed = scenario_filters([reference], scenario) | dict(filters)
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


def run(f: Filter, scenario: Scenario, tracks: Tracks) -> Estimate:
    """The tracks of a scenario through one filter, in the truth's coordinates."""
    estimate: Estimate = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
    return scenario.cartesian(estimate)


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
