"""Several filters that share values, learned from their errors as ratios to the best rival's: the loss ``"regret"``."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from torchfra.app import distributed
from torchfra.app.evaluate import evaluate
from torchfra.app.progress import progress_bar
from torchfra.catalogue import filters_for, scenario_filter
from torchfra.filters import Filter
from torchfra.hyper import Hyper, named
from torchfra.scenarios import Scenario
from torchfra.types import Estimate
from train.batches import simulate, task_scenario
from train.config import Config
from train.training import Training

POWER = 4
"""Of the ratios in the loss: a task far behind its best rival counts for more than what others are ahead."""
PATHS = {"qualities": "qualities.chain", "regimes": "regimes.chain"}
"""Where a filter has the value of an argument of its preset, if it is not called the same."""


class Regrets(Training):
    """Filters of one preset around different models, with the same values, and the errors of their best rivals.

    ``filter`` has the values by the names of the preset's arguments.  The loss of a task is the mean of two ratios to
    the fourth power: of the filtered and of the settled error to that of the best rival.  An error is the mean over
    time of the root mean square position error over the runs: one number for all runs together, whose gradient is not a
    sum over tracks, so that one process has them all.

    Args:
        config: of the run.
        quiet: whether to show no progress bar.

    Raises:
        ValueError: settings that do not fit each other, several processes, or no task that counts.
    """

    def __init__(self, config: Config, *, quiet: bool = True) -> None:
        self.quiet = quiet
        super().__init__(config)

    def make(self) -> nn.Module:
        """The values; ``filters`` of the tasks take them."""
        config = self.config
        if distributed.size() > 1:
            raise ValueError(f"loss: expected another than 'regret' in {distributed.size()} processes")
        self.counted = [i for i, task in enumerate(config.tasks) if task.weight > 0]
        if not self.counted:
            raise ValueError("tasks: expected one of a weight above 0")
        values, made = nn.ModuleDict(), {}
        self.filters: list[Filter] = []
        for scenario in self.scenarios:
            models = repr((scenario.bank or scenario.motion, scenario.sensor))
            if models not in made:
                made[models] = self._sharing(values, scenario)
            self.filters.append(made[models])
        if config.compile:
            for i in self.counted:
                self.filters[i].compile()
        self.start = copy.deepcopy(values.state_dict())
        self.rivals = self._rivals()
        return values

    def arguments(self, kind: str) -> list[str]:
        """The names of the arguments that filters of one ``"motion"`` or of a ``"bank"`` take."""
        return [name for name in self.config.start if self.config.only.get(name, kind) == kind]

    def _sharing(self, values: nn.ModuleDict, scenario: Scenario) -> Filter:
        """A filter around the models of a scenario, and the values; it brings those that are new."""
        config, names = self.config, self.arguments("motion" if scenario.bank is None else "bank")
        f = scenario_filter(config.filter, copy.deepcopy(scenario), **{name: config.start[name] for name in names})
        for name in names:
            ((path, hyper),) = named(f, (PATHS.get(name, name),)).items()
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
        for i in progress_bar(self.counted, "best rivals", not self.quiet):
            best[i] = self.best_rival(i, held_out=False, runs=config.validation_runs, seed=config.seed)[1]
        return best

    def best_rival(self, i: int, *, held_out: bool, runs: int, seed: int) -> tuple[str, float]:
        """Name and error of the best rival in a task."""
        config, task = self.config, dataclasses.replace(self.config.tasks[i], models="any")
        scenario = task_scenario(task, config, held_out=held_out)
        names = [name for name in config.rivals if name in filters_for(scenario)]
        few = scenario.bank is None or len(scenario.bank) < 4  # the compiler takes minutes for more motions
        results = evaluate(scenario, names, runs=runs, seed=seed, compile=config.compile and few)
        errors = {name: _mean(torch.tensor(results[name]["rmse_position"][config.skip :])) for name in names}
        best = min(errors, key=errors.__getitem__)
        return best, errors[best]

    def errors(
        self, tasks: Sequence[int], scenarios: Sequence[Scenario], *, first: int, runs: int, seed: int
    ) -> Tensor:
        """Errors ``(2, tasks)``, filtered and settled, of tasks with the same filter."""
        batch = simulate([scenarios[i] for i in tasks], first=first, runs=runs, seed=seed, device=self.config.device)
        estimate: Estimate = self.filters[tasks[0]](batch.z, batch.prior, u=batch.u, dt=batch.dt)
        means = torch.stack([estimate.info.filtered.mean, estimate.info.settled.mean])
        skip, position = self.config.skip, scenarios[tasks[0]].truth_position
        truth = batch.truth[..., skip:, position]
        known = truth.isfinite().all(-1)
        off = torch.where(known.unsqueeze(-1), means[..., skip:, position] - truth, 0.0)  # squared it would spread NaN
        square = off.square().sum(-1).unflatten(1, (len(tasks), runs)).sum(2)
        count = known.unflatten(0, (len(tasks), runs)).sum(1)
        rmse = torch.where(count > 0, square / count.clamp_min(1), 1.0).sqrt()
        of_tasks: Tensor = torch.where(count > 0, rmse, 0.0).sum(-1) / (count > 0).sum(-1)
        return of_tasks

    def gradient(self, first: int) -> tuple[Tensor, Tensor, int]:
        """As ``tune.whole_gradient``; if any track spoils the gradient, all are left out."""
        config, parameters = self.config, list(self.parameters.values())
        losses, gradient = torch.zeros(len(self.filters), dtype=torch.float64), torch.zeros(())
        for tasks in self._together():
            errors = self.errors(tasks, self.scenarios, first=first, runs=config.batch, seed=config.seed)
            loss = (errors / self.rivals[tasks]).pow(POWER).mean(0)
            total = self.task_weights[tasks] @ loss
            parts = torch.autograd.grad(total, parameters, allow_unused=True, materialize_grads=True)
            gradient = gradient + torch.cat([part.flatten() for part in parts])
            losses[tasks] = loss.detach()
        norm = gradient.norm()
        if not norm.isfinite():
            return losses, torch.zeros_like(gradient), len(self.counted) * config.batch
        return losses, gradient * (config.clip / norm).clamp_max(1.0), 0

    @torch.no_grad()
    def validation(self) -> float:
        """The weighted loss on tracks that are never trained on; infinite if it is NaN."""
        config, total = self.config, 0.0
        for tasks in self._together():
            errors = self.errors(
                tasks, self.held_out, first=0, runs=config.validation_runs, seed=config.validation_seed
            )
            loss = (errors / self.rivals[tasks]).pow(POWER).mean(0)
            total += float(self.task_weights[tasks] @ loss)
        return math.inf if math.isnan(total) else total

    def _together(self) -> list[list[int]]:
        """Numbers of the tasks that count, those with the same filter together."""
        tasks: dict[Filter, list[int]] = {}
        for i in self.counted:
            tasks.setdefault(self.filters[i], []).append(i)
        return list(tasks.values())

    def presets(self) -> dict[str, dict[str, object]]:
        """The values as arguments of the preset, for one ``"motion"`` and for a ``"bank"``."""
        values = cast(dict[str, Hyper], dict(self.filter.named_children()))
        return {
            kind: {name: values[name]().tolist() for name in self.arguments(kind) if name in values}
            for kind in ("motion", "bank")
        }


def _mean(x: Tensor) -> float:
    return float(x.nanmean())
