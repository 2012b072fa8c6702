"""The filter of a run, and its hyperparameters in natural units."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch
from torch import nn

from torchfra.catalogue import FILTERS, scenario_filter
from torchfra.filters import Filter
from torchfra.filters.soft import Soft
from torchfra.hyper import named, one_of
from torchfra.scenarios import Scenario
from train.config import Config


def make_filter(config: Config, scenario: Scenario, values: Mapping[str, float], *, learn: bool) -> Filter:
    """The filter of a run around copies of a scenario's models.

    Args:
        config: names the filter, its options, what it learns, and where it runs.
        scenario: with the models; they stay as they are.
        values: of hyperparameters by name, in natural units; the others keep the preset's and the scenario's.
        learn: whether the hyperparameters of ``config.learn`` become parameters.

    Raises:
        ValueError: the filter does not go with the scenario, or has no such hyperparameter.
    """
    scans = scenario.clutter is not None
    one_of(filter=(config.filter, [name for name, entry in FILTERS.items() if entry.scans == scans]))
    names = ("all" if config.learn == ("all",) else config.learn) if learn else ()
    f = scenario_filter(config.filter, copy.deepcopy(scenario), learn=names, **config.options)
    for name, value in values.items():
        for hyper in named(f, (name,)).values():
            hyper.set(value, name)
    f = f.to(config.device)
    if config.compile and torch.device(config.device).type == "cpu":
        from torchfra.compiler.llvm import binding  # only where it is needed

        binding()
    return f.compile() if config.compile else f


def check_candidates(f: Filter, config: Config) -> None:
    """Checks that the filter takes all values of ``config.search``.

    Raises:
        ValueError: it has no such hyperparameter, or the value is outside its range.
    """
    for name, values in config.search.items():
        try:
            for hyper in copy.deepcopy(list(named(f, (name,)).values())):
                for value in values:
                    hyper.set(float(value), name)
        except (ValueError, TypeError) as error:
            expected = f"values that {config.filter} takes, received {name}: {values}"
            raise ValueError(f"search: expected {expected} ({error})") from None


def set_temperature(f: nn.Module, temperature: float) -> None:
    """Makes the filter's decisions soft, or hard at 0; nothing happens to a filter without decisions."""
    for part in f.modules():
        if isinstance(part, Soft):
            part.temperature = temperature
