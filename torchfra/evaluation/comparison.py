"""Filters compared as a paper would: intervals, paired tests, consistency, and the Cramer-Rao bound."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.catalogue import scenario_filters
from torchfra.evaluation.results import Result, infinite, report
from torchfra.evaluation.running_metrics import RunningMetrics
from torchfra.evaluation.runs import check_limit, measure, results_of
from torchfra.filters.base import Filter
from torchfra.metrics.statistics import LEVEL, holm, signed_rank
from torchfra.numbers import is_integer
from torchfra.pictures import picture_format
from torchfra.running.atomic_write import write, write_json
from torchfra.scenarios import Bound, Scenario, Tracks, of_tracks
from torchfra.scenarios import bound as bound_on
from torchfra.tables import formed_table, significant, with_error

ERROR, LIKELIHOOD = "rmse_position", "log_likelihood"
FORMS = {".txt": "text", ".csv": "csv", ".tex": "latex", ".md": "markdown"}
"""Forms of tables by the endings of files."""
Cell = tuple[str, str]
"""A value, and half the width of its confidence interval; "" without one."""
MOST_FOR_BOUND = 500
"""Largest number of runs for the expectations of a bound."""


def compare(
    filters: Mapping[str, Filter] | Sequence[str],
    data: Scenario | Tracks,
    *,
    runs: int | None = None,
    seed: int = 0,
    dt: float = 1.0,
    limit: float | None = None,
    compile: bool = False,
    bound: bool = True,
    chunk: int = 1000,
    progress: bool = False,
) -> Comparison:
    """Filters on the same runs: errors with intervals, paired tests, consistency, the bound, a table and a figure.

    Args:
        filters: by any names, or names of the catalogue.
        data: a scenario, or tracks of the caller; without a truth, filters are compared by the log likelihood of the
            measurements.
        runs: number of runs; None for 100 of a scenario, and each track once.
        seed: of the random numbers; every filter has the same runs.
        dt: seconds per step of ``Tracks``; a scenario has its own.
        limit: a run diverges when its position error, root mean square over time, is above this, m; None for that of
            the scenario, or one that follows its scale (``torchfra.evaluation.divergence_limit``).
        compile: whether to run compiled; a filter that cannot be runs interpreted.
        bound: whether to compute the Cramer-Rao bound, where it is known.
        chunk: runs that are filtered at once; bounds the memory.
        progress: whether to show a bar.

    Raises:
        ValueError: no filter, an unknown name, data that is neither a scenario nor tracks, tracks that do not fit, or a
            number out of its range.

    Example::

        comparison = torchfra.compare(["gpb", "srckf"], torchfra.scenarios.bearings_outliers(), runs=200)
        print(comparison)
        comparison.plot("errors.pdf")
    """
    filters = [filters] if isinstance(filters, str) else filters
    _check(filters, runs, seed, limit, chunk)
    scenario = _scenario(filters, data, dt)
    chosen = dict(filters) if isinstance(filters, Mapping) else scenario_filters(filters, scenario)
    if runs is None:
        runs = len(scenario.recordings) or 100
    metrics = measure(
        scenario, chosen, runs=runs, seed=seed, chunk=chunk, compile=compile, progress=progress, reference=False,
        fallback=lambda name, reason: None,
    )  # fmt: skip
    results = results_of(metrics, chosen, scenario, runs, limit)
    return Comparison(scenario, runs, seed, results, metrics, bound_of(scenario, runs, seed) if bound else None)


def _check(
    filters: Mapping[str, Filter] | Sequence[str], runs: int | None, seed: int, limit: float | None, chunk: int
) -> None:
    if not isinstance(filters, Mapping | list | tuple) or not all(isinstance(name, str) for name in filters):
        raise ValueError(f"filters: expected names, or filters by name, received {filters!r:.80}")
    if isinstance(filters, Mapping):
        if not filters:
            raise ValueError("filters: expected one or more, received none")
        for name, f in filters.items():
            if not isinstance(f, Filter):
                raise ValueError(f"filters: expected a Filter as {name}, received {type(f).__name__}")
    for name, value, least in (("runs", 1 if runs is None else runs, 1), ("seed", seed, 0), ("chunk", chunk, 1)):
        if not is_integer(value, least):
            raise ValueError(f"{name}: expected a whole number of {least} or more, received {value!r}")
    check_limit(limit)


def bound_of(scenario: Scenario, runs: int, seed: int) -> Bound | None:
    """The Cramer-Rao bound of a scenario, from ``runs`` runs; None where it is unknown."""
    with torch.no_grad():
        return None if scenario.law is None else bound_on(scenario, runs=min(runs, MOST_FOR_BOUND), seed=seed)


def _scenario(filters: Mapping[str, Filter] | Sequence[str], data: Scenario | Tracks, dt: float) -> Scenario:
    """The data as a scenario; that of tracks has the models of the first filter."""
    if isinstance(data, Scenario):
        return data
    if not isinstance(data, Tracks):
        raise ValueError(f"data: expected a Scenario or Tracks (truth, z, u, prior), received {type(data).__name__}")
    if not isinstance(filters, Mapping):
        raise ValueError("filters: expected filters by name with Tracks, which have no models for the catalogue's")
    first = next(iter(filters.values()))
    return of_tracks(data, first.motion, first.sensor, dt=dt)


class Test(NamedTuple):
    """A paired test of two filters on the same runs."""

    one: str
    other: str
    p: float
    """Two-sided p value of Wilcoxon's signed-rank test."""
    corrected: float
    """The p value with Holm's correction for all pairs."""


@dataclass(frozen=True)
class Comparison:
    """The result of ``torchfra.compare``; as text, a table.

    Where the truth of no step is known, filters are compared by the log likelihood of the measurements.
    """

    scenario: Scenario
    runs: int
    seed: int
    results: dict[str, Result]
    """The figures of each filter, ``Result``."""
    metrics: Mapping[str, RunningMetrics]
    """The metrics behind ``results``, with a number for each run."""
    bound: Bound | None
    """Lower bound of the errors; None where it is not known."""

    @property
    def by(self) -> str:
        """The criterion of the comparison: ``"rmse_position"`` of a run, or its ``"log_likelihood"``."""
        known = any(bool((~self.metrics[name].errors().isnan()).any()) for name in self.results)
        return ERROR if known else LIKELIHOOD

    def of_runs(self, name: str) -> Tensor:
        """The criterion ``(runs,)`` for each run of a filter; its mean over several targets."""
        values = self.metrics[name].runs(self.by)
        return values.view(self.runs, -1).mean(-1)

    @cached_property
    def best(self) -> str:
        """The filter with the smallest mean error, or the largest mean log likelihood."""
        sign = 1 if self.by == ERROR else -1
        means = {name: sign * float(self.of_runs(name).nanmean()) for name in self.results}
        return min(means, key=lambda name: infinite(means[name]))

    def tests(self) -> list[Test]:
        """A paired test of each two filters."""
        return list(self._tests)

    @cached_property
    def _tests(self) -> list[Test]:
        values = {name: self.of_runs(name).numpy() for name in self.results}
        pairs = list(combinations(values, 2))
        p = [signed_rank(values[one], values[other]) for one, other in pairs]
        return [Test(*pair, raw, corrected) for pair, raw, corrected in zip(pairs, p, holm(p), strict=True)]

    def p(self, one: str, other: str) -> float:
        """The corrected p of two filters; 1 of a filter with itself.

        Raises:
            ValueError: a name that was not compared.
        """
        for name in (one, other):
            self._known(name)
        return next((test.corrected for test in self._tests if {test.one, test.other} == {one, other}), 1.0)

    def _known(self, name: str) -> None:
        if name not in self.results:
            raise ValueError(f"filter: expected one of {', '.join(self.results)}, received {name!r}")

    def efficiency(self, name: str) -> float:
        """The bound divided by the error, both RMS over the runs and means over time; NaN without one.

        Raises:
            ValueError: a name that was not compared.
        """
        self._known(name)
        if self.bound is None or self.by != ERROR:
            return math.nan
        return float(self._least(self.bound) / self.results[name]["mean_rmse_position"])

    def _least(self, bound: Bound) -> float:
        """The bound on the error of the position, m: root mean square over the runs, mean over time."""
        return bound.rmse(self.scenario.truth_position).nanmean().item()

    def table(self, form: str = "text") -> str:
        """A line for each filter: means with 95 % intervals and so on; the best, and filters as good, are bold.

        Args:
            form: ``"text"``, ``"csv"``, in which half widths of intervals are columns of their own, ``"latex"``, for
                ``booktabs``, or ``"markdown"``.

        Raises:
            ValueError: another form.
        """
        rows, good = {}, set()
        for name in self.results:
            p = self.p(name, self.best)
            rows[name] = self._row(name, p)
            if name == self.best or p >= 1 - LEVEL:
                good.add(name)
        return _formed(form, rows, good, self.caption())

    def _row(self, name: str, p: float) -> dict[str, Cell]:
        """The cells of a filter by the titles of their columns."""
        of, row = self.results[name], dict[str, Cell]()
        if self.by == ERROR:
            for quantity in self.scenario.quantities:
                unit = {"position": "m", "velocity": "m/s"}.get(quantity, quantity)
                row[f"run RMSE {unit}"] = _cell(of[f"mean_track_rmse_{quantity}"])
                if quantity == "position":
                    row["median run m"] = (significant(of["median_track_rmse_position"][0]), "")
            diverged = 100 * of["divergence_rate"]
            row["diverged %"] = (significant(diverged, 2) if diverged else "0", "")
            row["ANEES"] = _cell(of["anees"])
        else:
            row["log likelihood"] = _cell(of["mean_log_likelihood"])
        if "anis" in of:
            row["ANIS"] = _cell(of["anis"])
        share = self.efficiency(name)
        row["bound %"] = (significant(100 * share, 3 if share >= 0.1 else 2), "")
        few = f"{p:.3f}" if p >= 0.001 else f"{p:.0e}" if p >= 1e-99 else "0"
        row["p"] = ("best" if name == self.best else few, "")
        return row | {"us/step": (significant(of["microseconds"], 2), "")}

    def save(self, path: str | Path) -> Path:
        """Writes the table by the ending of the file, ``.txt``, ``.csv``, ``.tex`` or ``.md``; all of it as ``.json``.

        Raises:
            ValueError: a name that ends in none of these.
            OSError: it cannot be written.
        """
        path = Path(path)
        if path.suffix == ".json":
            write_json(path, report(self.scenario, self.results, runs=self.runs, seed=self.seed))
            return path
        text = self.table(table_form(path)).rstrip("\n") + "\n"
        return write(path, lambda file: file.write(text.encode()))

    def plot(self, path: str | Path | None = None, *, width: float = 3.5) -> Any:
        """Errors over time with the bound, and the means with their intervals, for print: a matplotlib figure.

        Args:
            path: where to write it: PDF, SVG or PNG by the ending; None for nowhere.
            width: of the figure, inches: 3.5 is a column.

        Raises:
            ValueError: a name that ends otherwise, or no truth to compare with.
            OSError: it cannot be written.
        """
        if path is not None:
            picture_format(path)
        from torchfra import plotting  # matplotlib takes long to import

        if self.by != ERROR:
            raise ValueError("plot: expected tracks with truth, as errors are drawn, received none")
        bound = None if self.bound is None else self.bound.rmse(self.scenario.truth_position).tolist()
        figure = plotting.printed(self.results, self.scenario.mean_dt, bound, width=width)
        if path is not None:
            plotting.save(figure, path)
        return figure

    def caption(self) -> str:
        """The contents of the table, in sentences."""
        what = "RMSE of the position in a run" if self.by == ERROR else "log likelihood of a measurement"
        sentences = [
            f"{self.scenario.name}: {self.runs} runs, seed {self.seed}",
            f"{what}: mean +- 95 % (Student)",
            f"p: against the best, Wilcoxon signed rank on the runs, Holm for {len(self._tests)} of them",
            *self._consistency(),
        ]
        if self.by == ERROR:
            sentences.append(f"diverged: above {significant(self.results[self.best]['limit'])} m")
        if self.bound is not None and self.by == ERROR:
            least = significant(self._least(self.bound))
            sentences.append(f"{self.bound}: {least} m, mean over time; in the table its share of the error")
        return ". ".join(sentences) + "."

    def _consistency(self) -> list[str]:
        """The intervals of ANEES and ANIS of a consistent filter, in sentences."""
        of, sentences = self.results[self.best], []
        for key, what in (("anees", "ANEES per component"), ("anis", "ANIS per element")):
            if key in of and not math.isnan(of[key][0]):
                low, high = of[f"{key}_bounds"]
                sentences.append(f"{what}: 1 of a consistent filter, of 95 % of its steps {low:.3f} to {high:.3f}")
        return sentences

    def __str__(self) -> str:
        return f"{self.table()}\n" + "\n".join(self.caption().split(". "))


def table_form(path: Path) -> str:
    """The form of a table by the ending of its file.

    Raises:
        ValueError: a name that ends in none of ``FORMS``.
    """
    if path.suffix not in FORMS:
        raise ValueError(f"table: expected a file that ends in {', '.join(FORMS)}, received {path}")
    return FORMS[path.suffix]


def _formed(form: str, rows: Mapping[str, dict[str, Cell]], good: Collection[str], caption: str) -> str:
    """The table of all rows, without columns that are empty; the first number of ``good`` filters is bold."""
    titles = [title for title in next(iter(rows.values())) if any(row[title] != ("-", "") for row in rows.values())]
    if form == "csv":
        halved = [title for title in titles if any(row[title][1] for row in rows.values())]
        columns = [c for title in titles for c in ([title, f"{title} +-"] if title in halved else [title])]
        table = [
            [name, *(cell for title in titles for cell in row[title][: 1 + (title in halved)])]
            for name, row in rows.items()
        ]
        return formed_table(form, ["filter", *columns], table)
    table = []
    for name, row in rows.items():
        first, *others = (" +- ".join(filter(None, row[title])) for title in titles)
        table.append([name, f"**{first}**" if name in good else first, *others])
    return formed_table(form, ["filter", *titles], table, caption)


def _cell(interval: list[float]) -> Cell:
    value, low, high = interval
    return with_error(value, (high - low) / 2)
