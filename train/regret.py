"""Several filters that share values, learned from their errors as ratios to the best rival's: the loss ``"regret"``."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from torchfra.catalogue import filters_for, scenario_filter
from torchfra.evaluation import evaluate
from torchfra.filters import Filter
from torchfra.hyper import Hyper, named
from torchfra.running import distributed
from torchfra.running.progress import progress_bar
from torchfra.scenarios import Scenario
from train.batches import Batch, simulate, task_scenario
from train.config import Config
from train.evolution import Evolution
from train.training import Training

POWER = 6
"""Of the ratios in the loss: a task far behind its best rival counts for more than what others are ahead."""
AHEAD, BEHIND = 0.7, 12.0
"""Ratios beyond which nothing is gained or lost: in a task that is far ahead there is no need to get further."""


class Regrets(Training):
    """Filters of one preset around different models, with the same values, and the errors of their best rivals.

    ``filter`` has the values by the names of the preset's arguments.  The loss of a task is the mean of two ratios to
    the power ``POWER``: of the filtered and of the settled error to that of the best rival.  An error is the mean over
    time of the root mean square position error over the runs: one number for all runs together.  It needs no gradient,
    for which the kernels of a bank would take the compiler long: an evolution strategy searches the values.

    Args:
        config: of the run.
        quiet: whether to show no progress bar.

    Raises:
        ValueError: settings that do not fit each other, several processes, or no task that counts.
    """

    def __init__(self, config: Config, *, quiet: bool = True) -> None:
        self.quiet = quiet
        super().__init__(config)
        values = parameters_to_vector(self.filter.parameters())
        self.optimiser = Evolution(values, step=config.lr, population=config.population, seed=config.seed)

    def make(self) -> nn.Module:
        """The values; ``filters`` of the tasks take them."""
        config = self.config
        if distributed.size() > 1:
            raise ValueError(f"loss: expected another than 'regret' in {distributed.size()} processes")
        self.counted = [i for i, task in enumerate(config.tasks) if task.weight > 0]
        if not self.counted:
            raise ValueError("tasks: expected one of a weight above 0")
        values = nn.ModuleDict()
        made: dict[str, Filter] = {}
        self.filters: list[Filter] = []
        for scenario in self.scenarios:
            models = _models(scenario)
            if models not in made:
                made[models] = self._sharing(values, scenario)
            self.filters.append(made[models])
        if config.compile:
            for i in self.counted:
                self.filters[i].compile()
        self.start = copy.deepcopy(values.state_dict())
        self.rivals = self._rivals()
        return values

    def _sharing(self, values: nn.ModuleDict, scenario: Scenario) -> Filter:
        """A filter around the models of a scenario, and the values; the first filter brings them."""
        config = self.config
        f = scenario_filter(config.filter, copy.deepcopy(scenario), **config.options | config.start)
        for name in config.start:
            ((path, hyper),) = named(f, (name,)).items()
            if name not in values:
                values[name] = hyper
                if config.learn == ("all",) or name in config.learn:
                    hyper.learn(name)
            owner, _, key = path.rpartition(".")
            setattr(f.get_submodule(owner), key, values[name])
        return f.to(config.device)

    def _rivals(self) -> Tensor:
        """``(tasks,)`` errors of the best rivals; 1 of tasks that do not count."""
        config, best = self.config, torch.ones(len(self.filters), dtype=torch.float64)
        known: dict[str, float] = {}
        for i in progress_bar(self.counted, "best rivals", not self.quiet):
            scenario = repr((config.tasks[i].scenario, config.tasks[i].options))
            if scenario not in known:
                known[scenario] = self.best_rival(i, held_out=False, runs=config.validation_runs, seed=config.seed)[1]
            best[i] = known[scenario]
        return best

    def best_rival(self, i: int, *, held_out: bool, runs: int, seed: int) -> tuple[str, float]:
        """Name and error of the best rival in a task."""
        config, task = self.config, dataclasses.replace(self.config.tasks[i], models="any")
        scenario = task_scenario(task, config, held_out=held_out)
        names = [name for name in config.rivals if name in filters_for(scenario)]
        few = scenario.bank is None or len(scenario.bank) < 4  # the compiler takes minutes for more motions
        results = evaluate(scenario, names, runs=runs, seed=seed, compile=config.compile and few)
        errors = {name: float(torch.tensor(results[name]["rmse_position"][config.skip :]).nanmean()) for name in names}
        best = min(errors, key=errors.__getitem__)
        return best, errors[best]

    @torch.no_grad()
    def generation(self) -> tuple[Tensor, dict[str, float]]:
        """An iteration: the best losses ``(tasks,)`` of a candidate, and what the log says of it."""
        config, search = self.config, cast(Evolution, self.optimiser)
        tracks = self._tracks(self.scenarios, first=self.iteration * config.batch, runs=config.batch, seed=config.seed)
        losses = []
        for candidate in search.ask():
            vector_to_parameters(candidate, self.filter.parameters())
            losses.append(self.losses_of(tracks))
        totals = torch.stack(losses) @ self.task_weights
        search.tell(totals)
        vector_to_parameters(search.mean.clone(), self.filter.parameters())
        best = losses[int(totals.nan_to_num(nan=math.inf).argmin())]
        return best, {"median": float(totals.median()), "step": search.step, "left out": 0}

    @torch.no_grad()
    def validation(self) -> float:
        """The weighted loss on tracks that are never trained on."""
        config = self.config
        tracks = self._tracks(self.held_out, first=0, runs=config.validation_runs, seed=config.validation_seed)
        return float(self.task_weights @ self.losses_of(tracks))

    def losses_of(self, tracks: list[tuple[list[int], Batch]]) -> Tensor:
        """``(tasks,)`` losses; 0 of tasks that do not count."""
        losses = torch.zeros(len(self.filters), dtype=torch.float64)
        for tasks, batch in tracks:
            ratios = (self.errors(tasks, batch) / self.rivals[tasks]).nan_to_num(nan=math.inf).clamp(AHEAD, BEHIND)
            losses[tasks] = ratios.pow(POWER).mean(0)
        return losses

    def errors(self, tasks: list[int], batch: Batch) -> Tensor:
        """Errors ``(2, tasks)``, filtered and settled, of tasks with the same filter, from their tracks."""
        scenario, skip = self.scenarios[tasks[0]], self.config.skip
        estimate = self.filters[tasks[0]](batch.z, batch.prior, u=batch.u, dt=scenario.dt)
        means = torch.stack([estimate.info.filtered.mean, estimate.info.lagged.mean])
        square = (means - batch.truth)[..., skip:, scenario.truth_position].square().sum(-1)
        rmse: Tensor = square.unflatten(1, (len(tasks), -1)).nanmean(2).sqrt().nanmean(-1)
        return torch.where(means.flatten(-2).isnan().any(-1).unflatten(1, (len(tasks), -1)).any(2), torch.nan, rmse)

    def _tracks(
        self, scenarios: Sequence[Scenario], *, first: int, runs: int, seed: int
    ) -> list[tuple[list[int], Batch]]:
        """Tracks of the tasks that count; those with the same filter are one batch."""
        together: dict[Filter, list[int]] = {}
        for i in self.counted:
            together.setdefault(self.filters[i], []).append(i)
        return [
            (
                tasks,
                simulate([scenarios[i] for i in tasks], first=first, runs=runs, seed=seed, device=self.config.device),
            )
            for tasks in together.values()
        ]

    def preset(self) -> dict[str, object]:
        """The values as arguments of the preset."""
        return {name: cast(Hyper, hyper)().tolist() for name, hyper in self.filter.named_children()}


def _models(scenario: Scenario) -> str:
    """Motion, sensor and time step of a scenario with all their values: what a filter around them is known by."""
    models = nn.ModuleList([scenario.bank or scenario.motion, scenario.sensor])
    values = [(name, x.tolist()) for of in (models.named_parameters, models.named_buffers) for name, x in of()]
    return repr((models, values, scenario.dt))
