"""Cells of the regret table: each is a scenario, an error it makes, and how many runs it has."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from torchfra import readers, scenarios
from torchfra.catalogue import make_scenario
from torchfra.readers.recording import Recording
from torchfra.scenarios import Scenario

OUTLIERS = ("none", "covariance", "std", "bursts")
INDICES = (0.001, 0.01, 0.1, 1.0)
"""Manoeuvring indices of cells whose truth is drawn from the stated models."""
SAMPLES = ("calibration", "gliders")
"""Recorded flights, of those that come with the package ``traffic``, unless others are given."""


class Cell(NamedTuple):
    """One line of the table."""

    make: Callable[[], Scenario]
    """Reads its files only when it is called."""
    runs: int | None = None
    """Number of runs; None if it is not limited."""


def all_cells(flights: Sequence[Path] | None = None, ranges: Iterable[Path] = ()) -> dict[str, Cell]:
    """The cells by name.

    Args:
        flights: files of recorded flights; None for ``SAMPLES``.
        ranges: folders with recorded ranges; each recording in or below them is a cell of one run.

    Raises:
        ValueError: a folder without recorded ranges.
    """
    cells: dict[str, Cell] = {}
    for name, scenario, initial in (
        ("1-paper", "bearings-outliers", "paper"), ("1-good", "bearings-outliers", "truth"),
        ("2", "bearings-manoeuvre", "truth"),
    ):  # fmt: skip
        for kind in OUTLIERS:
            cells[f"{name}-{kind}"] = Cell(partial(make_scenario, scenario, outliers=kind, initial=initial))
    files = None if flights is None else tuple(flights)
    for sensor in ("bearings", "position", "radar"):
        cells |= {f"flights-{sensor}-{kind}": Cell(partial(_flights, files, sensor, kind)) for kind in OUTLIERS}
    cells["ranges"] = Cell(partial(make_scenario, "ranges-outliers"))
    cells |= {name: Cell(partial(make_scenario, "as-stated", **options)) for name, options in as_stated().items()}
    for folder in ranges:
        cells |= {str(place): Cell(partial(_ranges, place), 1) for place in readers.range_folders(folder)}
    return cells


def chosen_cells(cells: dict[str, Cell], patterns: Sequence[str]) -> dict[str, Cell]:
    """The cells whose names match one of the patterns, such as ``1-*-std``.

    Raises:
        ValueError: a pattern that no name matches.
    """
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in cells):
            raise ValueError(f"cells: expected names or patterns among {', '.join(cells)}, received {pattern!r}")
    return {name: cell for name, cell in cells.items() if any(fnmatchcase(name, pattern) for pattern in patterns)}


def as_stated() -> dict[str, dict[str, Any]]:
    """Options of cells whose truth is drawn from models, by name: models, manoeuvring index, outliers, what is off.

    First where the models hold; then with outliers; then where another ``q`` or ``std`` is stated; then where seven of
    ten steps have no measurement, so that those that come do so at irregular times.  Steps take 0.1, 1 and 10 s in
    turns, which changes nothing for filters whose chains count steps.
    """
    motions, sensors = ("velocity", "acceleration", "turn", "bank"), ("bearings", "radar", "ranges")
    chosen: list[dict[str, Any]] = [{"motion": motion, "index": index} for motion in motions for index in INDICES]
    chosen += [{"sensor": sensor, "index": index} for sensor in sensors for index in (0.001, 0.1, 1.0)]
    for kind in OUTLIERS[1:]:
        chosen += [{"index": index, "outliers": kind} for index in INDICES]
        chosen += [{"motion": motion, "index": 0.1, "outliers": kind} for motion in motions[1:]]
        chosen += [{"sensor": sensor, "index": 0.1, "outliers": kind} for sensor in sensors]
    chosen += [{"index": index, "q": q} for index in INDICES for q in (0.01, 0.1, 10.0, 100.0)]
    chosen += [{"index": index, "std": std} for index in INDICES for std in (0.5, 2.0)]
    chosen += [
        {"index": 0.1, "q": q} | more for q in (0.1, 10.0) for more in ({"motion": "acceleration"}, {"outliers": "std"})
    ]
    chosen += [{"index": index, "outliers": kind, "missing": 0.7} for index in (0.01, 1.0) for kind in ("none", "std")]
    return {_name(options): options | {"dt": (0.1, 1.0, 10.0)[i % 3]} for i, options in enumerate(chosen)}


def _name(options: dict[str, Any]) -> str:
    """Such as ``stated-velocity-0.1-none`` and ``stated-velocity-0.1-none-q10``."""
    models = options["sensor"] if "sensor" in options else options.get("motion", "velocity")
    off = [f"{key}{options[key]:g}" for key in ("q", "std", "missing") if key in options]
    return "-".join(["stated", models, f"{options['index']:g}", options.get("outliers", "none"), *off])


def _flights(files: tuple[Path, ...] | None, sensor: str, outliers: str) -> Scenario:
    return scenarios.recorded(_recordings(files), sensor, outliers=outliers)


@cache
def _recordings(files: tuple[Path, ...] | None) -> list[Recording]:
    paths = readers.samples(*SAMPLES) if files is None else files
    return [recording for path in paths for recording in readers.read(path)]


def _ranges(folder: Path) -> Scenario:
    return scenarios.recorded_ranges([readers.read_ranges(folder)])
