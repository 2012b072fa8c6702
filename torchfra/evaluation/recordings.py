"""Results on recorded measurements, of which each run is a recording with a name."""

from __future__ import annotations

from typing import Any

from torchfra.evaluation.results import Result
from torchfra.readers.repairs import in_words
from torchfra.scenarios import Scenario
from torchfra.tables import printable, text_table


def recordings_table(results: dict[str, Result], scenario: Scenario) -> str:
    """The root mean square position error of each filter on each recording, m, as text.

    Args:
        results: from ``evaluate``, with ``rmse_of_runs``.
        scenario: with ``recordings``.
    """
    runs = len(next(iter(results.values()))["rmse_of_runs"])
    named = enumerate(scenario.recordings[:runs], 1)
    lines = [f"{number}: {printable(name)}{_repairs(scenario, number)}" for number, name in named]
    rows = [
        [name, *(_metres(error) for error in of["rmse_of_runs"]),
         _metres(sum(of["rmse_of_runs"]) / runs), _metres(of["median_error_position"]),
         f"{of['diverged']}", f"{of['nees_position']:.2f}", f"{of['microseconds']:.2f}"]
        for name, of in results.items()
    ]  # fmt: skip
    header = ["RMSE m", *map(str, range(1, runs + 1)), "mean", "median m", "lost", "NEES", "us/step"]
    return "\n".join([*lines, text_table(header, rows)])


def _metres(error: float) -> str:
    return f"{error:.2f}" if error < 1e6 else f"{error:.0e}"


def _repairs(scenario: Scenario, number: int) -> str:
    """A sentence on the repairs of a recording."""
    repairs: Any = scenario.settings["repairs"]
    counts = in_words(repairs[number - 1])
    return f"; repairs: {counts}" if counts else ""
