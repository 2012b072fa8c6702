"""The filter of a run, its losses, and the state of training."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchfra import losses
from torchfra.catalogue import FILTERS, scenario_filter
from torchfra.filters import Filter
from torchfra.filters.soft import Soft
from torchfra.hyper import named, natural_values, one_of
from torchfra.running import distributed
from torchfra.scenarios import Scenario
from torchfra.types import Estimate
from train.batches import Batch, task_scenario
from train.config import Config


class Training:
    """A filter with its optimiser, the tracks it learns from, and the progress so far.

    Raises:
        ValueError: settings that do not fit each other, or fewer tracks than processes.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.scenarios = [task_scenario(task, config, held_out=False) for task in config.tasks]
        self.held_out = [task_scenario(task, config, held_out=True) for task in config.tasks]
        self.teacher: Filter | None = None
        self.filter = self.make()
        self.parameters = dict(self.filter.named_parameters())
        self.optimiser: Any = torch.optim.Adam(self.parameters.values(), lr=config.lr)
        weights = torch.tensor([task.weight for task in config.tasks], dtype=torch.float64, device=config.device)
        self.task_weights = weights / weights.sum()
        self.iteration, self.stopped = 0, False
        self.rows: list[dict[str, float]] = []
        """Rows of the log, one for each iteration."""
        self.best: dict[str, Any] = {}
        """Score, iteration and state_dict of the best validation."""
        self.keep(math.inf)

    def make(self) -> nn.Module:
        """The module whose parameters learn."""
        config, first = self.config, self.scenarios[0]
        _check(config, self.scenarios)
        f = make_filter(config, first, config.start, learn=True)
        check_candidates(f, config)
        if config.loss == "teacher":
            self.teacher = make_filter(config, first, config.teacher, learn=False)
        return f

    def losses(self, values: Mapping[str, Tensor], batch: Batch, temperature: float) -> Tensor:
        """``(B,)`` loss of each track; of several targets in scans their mean.

        Args:
            values: parameters to use instead of the filter's, by name, each with or without a batch of tracks.
            batch: of tracks.
            temperature: of the filter's decisions, 0 for hard ones.
        """
        options: dict[str, Any] = {"u": batch.u, "dt": batch.dt, "truncate": self.config.truncate or None}
        set_temperature(self.filter, temperature)
        estimate = torch.func.functional_call(self.filter, dict(values), (batch.z, batch.prior), options)
        skip = self.config.skip
        mean, root, nis, log_likelihood, *_ = estimate
        mean, root = mean[..., skip:, :], root[..., skip:, :, :]
        counted = Estimate(mean, root, nis[..., skip:], log_likelihood[..., skip:], None)
        if self.teacher is None:
            target, states = batch.truth, self.scenarios[0].truth_position
            counted = self.scenarios[0].cartesian(counted)
        else:  # both estimates are in the coordinates of the motion
            set_temperature(self.teacher, temperature)
            states = self.teacher.motion.position
            with torch.no_grad():
                target = self.teacher(batch.z, batch.prior, **options).mean
        loss = _loss(self.config, counted, target[..., skip:, :], states)
        return loss.flatten(1).mean(-1) if loss.dim() > 1 else loss

    def learned_values(self) -> dict[str, float]:
        """The values that learn or are searched, in natural units."""
        paths = {name.removesuffix(".raw") for name in self.parameters} | set(named(self.filter, self.config.search))
        return {path: value for path, value in natural_values(self.filter).items() if path.partition("[")[0] in paths}

    def keep(self, score: float) -> None:
        """Makes the present values the best so far."""
        state = copy.deepcopy(self.filter.state_dict())
        self.best = {"score": score, "iteration": self.iteration, "filter": state}


def _check(config: Config, scenarios: list[Scenario]) -> None:
    if len({(type(s.motion), type(s.sensor), s.motion.size, s.sensor.size) for s in scenarios}) > 1:
        raise ValueError("tasks: expected scenarios of one kind of motion and sensor")
    if min(config.batch, config.validation_runs) < distributed.size():
        raise ValueError(f"batch, validation_runs: expected at least {distributed.size()}, one for each process")


def _loss(config: Config, estimate: Estimate, target: Tensor, states: slice) -> Tensor:
    """The loss of a run, ``(...)`` over tracks."""
    if config.loss == "innovation":
        return losses.innovation_nll(estimate)
    if config.loss == "nll":
        return losses.nll(estimate, target, states)
    if config.loss == "mse":
        return losses.mse(estimate.mean, target, states)
    return losses.robust_mse(estimate.mean, target, states, config.scale)  # "robust", "teacher"


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
