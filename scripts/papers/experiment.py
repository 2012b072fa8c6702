"""What an experiment is: which filters it compares, how it sums up their errors, and what it draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from torchfra.catalogue import scenario_filters
from torchfra.evaluation import run
from torchfra.filters import Filter
from torchfra.scenarios import Scenario, Tracks
from torchfra.types import Estimate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Filters = dict[str, Filter]
Results = dict[str, dict[str, Any]]
Figures = dict[str, "Figure"]
SHOWN = 200
"""Most runs of which a figure shows medians and quartiles, where the paper's shows one run."""


@dataclass(frozen=True)
class Study:
    """One call of an experiment."""

    scenario: Scenario
    filters: Filters
    runs: int
    seed: int
    options: dict[str, Any]
    """What the scenario was made with; None stands for its default."""
    sizes: Sequence[float] = ()
    """How many times contaminated noise grows, for experiments that vary it."""
    compile: bool = False
    progress: bool = False

    @property
    def title(self) -> str:
        """Title of figures and printed tables."""
        return f"{self.scenario.name}, {self.runs} runs"


@dataclass(frozen=True)
class Experiment:
    """An experiment of a paper.

    Args:
        defaults: names of the filters that the paper compares.
        filters: makes filters of these names.
        summarise: from the results of ``evaluate``, what to add to the JSON file and the table to print.
        draw: figures by file name, from the results and from what was added.
        sizes: default of ``--sizes``; None if the experiment takes no such option.
    """

    defaults: Sequence[str]
    filters: Callable[[Scenario, Sequence[str]], Filters]
    summarise: Callable[[Study, Results], tuple[dict[str, Any], str]]
    draw: Callable[[Study, Results, dict[str, Any]], Figures]
    sizes: Sequence[float] | None = None


def catalogue_filters(scenario: Scenario, names: Sequence[str]) -> Filters:
    """The filters of these names in the catalogue."""
    return scenario_filters(list(names), scenario)


def filtered(f: Filter, scenario: Scenario, tracks: Tracks) -> Estimate:
    """Estimates in the coordinates of the truth, without gradients."""
    with torch.no_grad():
        return run(f, scenario, tracks)
