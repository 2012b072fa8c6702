"""Results of named sets of values: what a file of them has, and what is put there."""

from __future__ import annotations

import json
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from train.config import Task

Figures = dict[str, Any]


def read(file: Path) -> Figures:
    """What a file of sets holds; none if it does not exist."""
    contents: Figures = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"sets": []}
    return contents


def name_of(record: Figures) -> str:
    """What a set is called: its preset and its own name."""
    return f"{record['preset']}-{record['values']}"


def take_results(sets: dict[str, Figures], settings: Figures, file: Path, *, everything: bool) -> None:
    """Gives each set the results that a file already has of it, with equal settings and values; else none.

    Args:
        sets: changed in place.
        settings: of what is to be measured.
        file: where it is to be written.
        everything: whether all is measured, so that nothing is lost that the file holds.

    Raises:
        ValueError: the file has other settings, and only a part is measured.
    """
    before = read(file)
    if before["sets"] and before["settings"] != settings and not everything:
        expected = f"expected all, as {file} has results of other settings, {before['settings']}"
        raise ValueError(f"cells: {expected}, received a part of them")
    known = {name_of(record): record for record in before["sets"] if before["settings"] == settings}
    for name, record in sets.items():
        same = name in known and all(known[name][part] == record[part] for part in ("arguments", "factors"))
        record["results"] = known[name]["results"] if same else []


def measured(record: Figures, task: Task, runs: int) -> bool:
    """Whether a set has a result of a scenario, of so many runs."""
    return any(_is_of(result, task) and result["runs"] == runs for result in record["results"])


def add_result(record: Figures, figures: Figures, tasks: list[Task]) -> None:
    """Puts a result in place of the one of the same scenario, in the order of the tasks."""
    results = [figures, *record["results"]]
    found = (next((result for result in results if _is_of(result, task)), None) for task in tasks)
    record["results"] = [result for result in found if result is not None]


def _is_of(result: Figures, task: Task) -> bool:
    return (result["scenario"], result["options"], result["models"]) == (task.scenario, task.options, task.models)


def matches(name: str, patterns: str) -> bool:
    """Whether a name is one of a comma-separated list of names and patterns."""
    return any(fnmatchcase(name, pattern) for pattern in patterns.split(","))
