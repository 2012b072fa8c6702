"""Errors of all filters of a cell on the same runs, their ratios to the best with intervals, and these as text."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra import metrics
from torchfra.evaluation import run
from torchfra.filters import Filter
from torchfra.running.progress import progress_bar
from torchfra.scenarios import Scenario, Tracks
from torchfra.tables import printable, text_table
from torchfra.types import Estimate

RESAMPLES = 1000
"""Bootstrap resamples of the runs, for an interval."""
KINDS = ("filtered", "lagged")
"""Estimates of a step from the measurements up to it, and with the next one where a filter decides late."""
_STEPS = 100_000
"""Steps of all runs that are filtered at once; bounds the memory."""
_LOST = 1e200
"""Squared error that stands for an infinite one, so that 0 times it is 0."""
Cells = Mapping[str, dict[str, Any]]


def estimates_of(estimate: Estimate) -> dict[str, Tensor]:
    """Means ``(..., T, n)`` by kind; ``"lagged"`` only of a filter that has both.

    What ``info`` does not hold of ``filtered`` (or ``provisional``) and ``lagged`` is the estimate itself.
    """
    held = {name: getattr(estimate.info, name, None) for name in ("provisional", "filtered", "lagged")}
    filtered = held["filtered"] if held["provisional"] is None else held["provisional"]
    means = {"filtered": estimate.mean if filtered is None else filtered.mean}
    if filtered is not None or held["lagged"] is not None:
        means["lagged"] = estimate.mean if held["lagged"] is None else held["lagged"].mean
    return means


def draws(runs: int, seed: int, resamples: int = RESAMPLES) -> Tensor:
    """How often each run counts ``(1 + resamples, runs)``: once, and in each resample as often as it is drawn.

    Raises:
        ValueError: no run, or a seed below 0.
    """
    if runs < 1 or seed < 0:
        raise ValueError(f"runs, seed: expected at least 1 and 0, received {runs}, {seed}")
    rng = np.random.default_rng(seed)
    drawn = [np.bincount(rng.integers(runs, size=runs), minlength=runs) for _ in range(resamples)]
    return torch.from_numpy(np.stack([np.ones(runs, dtype=np.int64), *drawn]).astype(np.int32))


class Errors:
    """Position errors of one estimate, from blocks of runs: memory does not grow with their number.

    ``rmse`` is the mean over time of the root mean square error over the runs, as in ``torchfra compare``; of a single
    run the root mean square error over time.
    """

    def __init__(self, runs: int) -> None:
        self.runs = runs
        self.squares: Tensor | float = 0.0
        """Sums over the runs, ``(1 + resamples, T)``."""
        self.counts: Tensor | float = 0.0
        self.tracks: list[Tensor] = []
        """Root mean square error over time of each run."""

    def add(self, error: Tensor, counts: Tensor) -> None:
        """Adds runs.

        Args:
            error: ``(B, T)`` m; NaN where the truth is unknown, infinite where there is no estimate.
            counts: ``(1 + resamples, B)`` how often each of them counts.
        """
        square, weights = error.square().clamp(max=_LOST), counts.to(error)
        known = ~square.isnan()
        squares = weights @ square.nan_to_num()
        every = weights.sum(-1, keepdim=True).expand_as(squares)
        self.squares = self.squares + squares
        self.counts = self.counts + (every if known.all() else weights @ known.to(error))
        self.tracks.append(square.nanmean(-1).sqrt())

    def rmse(self) -> NDArray[np.float64]:
        """``(1 + resamples,)`` m: of all runs, and of each resample."""
        assert isinstance(self.squares, Tensor)
        assert isinstance(self.counts, Tensor)
        if self.runs == 1:
            values = (self.squares.sum(-1) / self.counts.sum(-1)).sqrt()
        else:
            values = (self.squares / self.counts).sqrt().nanmean(-1)
        return torch.where(values > _LOST**0.25, torch.inf, values).numpy()

    def lost(self, limit: float) -> float:
        """The share of runs whose root mean square error over time is above this, m."""
        return (torch.cat(self.tracks) > limit).double().mean().item()


def errors(
    scenario: Scenario, filters: Mapping[str, Filter], *, runs: int, seed: int, progress: bool = False
) -> dict[str, dict[str, Errors]]:
    """Errors by kind and filter; every filter sees the same runs."""
    found: dict[str, dict[str, Errors]] = {kind: {} for kind in KINDS}
    with torch.no_grad():
        for tracks, counts in batches(scenario, runs, seed, _STEPS, progress):
            for name, f in filters.items():
                for kind, mean in estimates_of(run(f, scenario, tracks)).items():
                    error = metrics.error(mean, tracks.truth, scenario.truth_position)
                    found[kind].setdefault(name, Errors(runs)).add(error, counts)
    return found


def batches(scenario: Scenario, runs: int, seed: int, steps: int, progress: bool) -> Iterator[tuple[Tracks, Tensor]]:
    """All runs, as many at once as have so many ``steps`` together, and how often each counts: see ``draws``."""
    counts, chunk = draws(runs, seed, RESAMPLES if runs > 1 else 0), max(1, steps // scenario.steps)
    for first in progress_bar(range(0, runs, chunk), f"{chunk} runs", progress):
        yield scenario.simulate(min(chunk, runs - first), seed, first=first), counts[:, first : first + chunk]


def ratio(rmse: NDArray[np.float64], other: NDArray[np.float64]) -> dict[str, Any]:
    """``ratio`` of one error to another, with its 95 % ``interval``, None of a single run."""
    with np.errstate(invalid="ignore"):
        of = rmse / other
    interval = np.quantile(of[1:], [0.025, 0.975], method="inverted_cdf").tolist() if len(of) > 1 else None
    return {"ratio": of[0].item(), "interval": interval}


def ratios(found: Mapping[str, Errors], compared: Collection[str], limit: float) -> dict[str, Any]:
    """The best filter that is not compared, and of every filter the ratio of its error to that one's.

    Args:
        found: of all filters, by name.
        compared: names of those that are no candidates for the best.
        limit: position error above which a run is lost, m.

    Returns:
        ``best``, and by filter ``rmse``, ``lost``, ``ratio`` and its 95 % ``interval`` (None of a single run), in which
        both filters have the same runs and the best stays the best.
    """
    rmse = {name: of.rmse() for name, of in found.items()}
    best = min((name for name in rmse if name not in compared), key=lambda name: rmse[name][0])
    filters = {}
    for name, values in rmse.items():
        filters[name] = {"rmse": values[0].item(), "lost": found[name].lost(limit), **ratio(values, rmse[best])}
    return {"best": best, "filters": filters}


def both_kinds(found: Mapping[str, Mapping[str, Errors]], compared: Collection[str], limit: float) -> dict[str, Any]:
    """``ratios`` by kind; among the lagged estimates are the filtered ones of filters that have no other."""
    filtered, lagged = found["filtered"], found["lagged"]
    of = {"filtered": filtered, "lagged": {**filtered, **lagged}}
    return {kind: ratios(of[kind], compared, limit) for kind in KINDS} | {"with_lag": list(lagged)}


# ---------------------------------------------------------------- as text, and what a picture shows


def label(name: str) -> str:
    """What a filter is called in tables: learned values by their folder."""
    return Path(name).parent.name or name


def table(cells: Cells, compared: Sequence[str], kind: str) -> str:
    """A line for each compared filter in each cell."""
    rows = []
    for cell, result in cells.items():
        of = result[kind]
        best = of["filters"][of["best"]]
        for name in (name for name in compared if name in of["filters"]):
            one = of["filters"][name]
            rows.append([cell, of["best"], metres(best["rmse"]), label(name), metres(one["rmse"]),
                         regret(one["ratio"]), interval(one["interval"]), f"{one['lost']:.2%}"])  # fmt: skip
    header = [f"{kind}: cell", "best other", "RMSE m", "compared", "RMSE m", "regret", "95 %", "lost"]
    return text_table(header, rows, align="<<><>")


def summary(cells: Cells, compared: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Median and largest regret of each compared filter, the cell of the latter, and its largest share of lost runs."""
    found: dict[str, dict[str, Any]] = {}
    for kind in KINDS:
        found[kind] = {}
        for name in compared:
            of = {cell: result[kind]["filters"].get(name) for cell, result in cells.items()}
            ratio = {cell: one["ratio"] for cell, one in of.items() if one is not None}
            worst = max(ratio, key=ratio.__getitem__)
            found[kind][name] = {"median": median(ratio.values()) - 1, "worst": ratio[worst] - 1, "worst_cell": worst,
                                 "most_lost": max(one["lost"] for one in of.values() if one is not None)}  # fmt: skip
    return found


def summary_lines(of: Mapping[str, dict[str, Any]], kind: str) -> str:
    """The summary as text."""
    return "\n".join(
        f"{printable(label(name))}, {kind}: median regret {one['median']:+.1%}, worst {regret(1 + one['worst'])} "
        f"({printable(one['worst_cell'])}), lost at most {one['most_lost']:.2%}"
        for name, one in of[kind].items()
    )


def not_finite(cells: Cells) -> list[str]:
    """A message for each filter with an error in a cell that is not finite."""
    return [
        f"{cell}, {label(name)}, {kind}: an error that is not finite"
        for cell, result in cells.items()
        for kind in KINDS
        for name, of in result[kind]["filters"].items()
        if not math.isfinite(of["rmse"])
    ]


def panels(cells: Cells, compared: Sequence[str]) -> dict[str, tuple[list[str], list[list[float]]]]:
    """Columns and ratios of the picture: all filters filtered, and those that have a lagged estimate, lagged."""
    found = {}
    for kind in KINDS:
        names = dict.fromkeys([*compared, *(name for result in cells.values() for name in result[kind]["filters"])])
        if kind == "lagged":
            with_lag = {name for result in cells.values() for name in result["with_lag"]}
            names = dict.fromkeys(name for name in names if name in with_lag)
        nothing = {"ratio": float("nan")}
        values = [[r[kind]["filters"].get(name, nothing)["ratio"] for name in names] for r in cells.values()]
        if names:
            found[kind] = ([label(name) for name in names], values)
    return found


def metres(value: float) -> str:
    """To a millimetre up to 10 m, and to 0.1 m above."""
    return f"{value:.3f}" if value < 10 else f"{value:.1f}" if value < 1e6 else f"{value:.0e}"


def regret(ratio: float) -> str:
    """What a ratio to the best is above 1."""
    return f"{ratio - 1:+.1%}" if ratio < 100 else f"{100 * ratio:+.0e}%"


def interval(bounds: Sequence[float] | None) -> str:
    """Both bounds as regrets; nothing of a single run."""
    return "" if bounds is None else " to ".join(map(regret, bounds))
