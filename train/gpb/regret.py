"""Several filters that share values, learned from their errors as ratios to the best rival's: the loss ``"regret"``."""

from __future__ import annotations

import copy
import dataclasses
import math
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from torchfra.catalogue import filters_for, scenario_filter
from torchfra.evaluation import evaluate
from torchfra.filters import Filter
from torchfra.fitting.data import Batch
from torchfra.hyper import Hyper, named
from torchfra.motion.bank import Bank
from torchfra.running import distributed
from torchfra.running.progress import progress_bar
from torchfra.scenarios import Scenario
from train.batches import simulate, task_scenario
from train.config import Config
from train.gpb.evolution import Evolution
from train.training import Training

POWER = 60
"""Exponent of the ratios in the loss, whose sum over the tasks is about that of the worst task."""
LEAST_RATIO, LARGEST_RATIO = 0.7, 12.0
"""Bounds on the ratios in the loss: a task with a far smaller error than its rivals needs no further gain."""


class Cases(NamedTuple):
    """Tracks of the tasks that count, and the errors of the best rivals on them."""

    groups: list[tuple[list[int], Batch]]
    """Tasks with the same models, and the tracks of all of them."""
    rivals: Tensor
    """``(tasks,)`` errors of the best rivals; 1 of tasks that do not count."""


class Regrets(Training):
    """Filters of one preset around different models, with the same values, and the errors of their best rivals.

    ``filter`` has the values by the names of the preset's arguments.  The loss of a task is the mean of two ratios to
    the power ``POWER``: of the filtered and of the lagged error to that of the best rival times 1 and the regret that
    is ``allowed`` in the task.  An error is the mean over time of the root mean square position error over the runs:
    one number for all runs together.  Rivals have the same runs, and so have all iterations, so that ratios do not
    depend on the choice of runs.  An evolution strategy searches the values without gradients.

    Args:
        config: of the run.
        quiet: whether to show no progress bar.

    Raises:
        ValueError: settings that do not fit each other, several processes, or no task that counts.
    """

    def __init__(self, config: Config, *, quiet: bool = True) -> None:
        self.quiet = quiet
        super().__init__(config)
        values = parameters_to_vector(self.filter.parameters()).detach().clone()
        self.optimiser = Evolution(values, step=config.lr, population=config.population, seed=config.seed)
        self.initial, self.fixed = values, self._fixed()

    def make(self) -> nn.Module:
        """The values, which the ``filters`` of the tasks share."""
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
            kind = _kind(scenario)
            if kind not in made:
                made[kind] = self._sharing(values, scenario)
            self.filters.append(made[kind])
        for name, places in config.fixed.items():
            entries = values[name]().numel() if name in values else 0
            if not all(0 <= place < entries for place in places):
                raise ValueError(f"fixed, {name}: expected indices below {entries}, received {places}")
        if config.compile:
            for i in self.counted:
                self.filters[i].compile()
        self.start = copy.deepcopy(values.state_dict())
        self.cases = self._cases(config.batch, config.seed, held_out=False)
        self.validation_cases = self._cases(config.validation_runs, config.validation_seed, held_out=True)
        return values

    def _sharing(self, values: nn.ModuleDict, scenario: Scenario) -> Filter:
        """A filter around the models of a scenario, with the shared values, which are those of the first filter."""
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

    def _fixed(self) -> Tensor:
        """Bool, the numbers of all parameters that do not change."""
        fixed = []
        for path, value in self.filter.named_parameters():
            which = torch.tensor(self.config.fixed.get(path.removesuffix(".raw"), []), dtype=torch.long)
            fixed.append(torch.zeros(value.numel(), dtype=torch.bool).index_fill(0, which, True))
        return torch.cat(fixed).to(self.config.device)

    def _take(self, candidate: Tensor) -> None:
        """Sets the parameters to these values, except the fixed ones."""
        vector_to_parameters(torch.where(self.fixed, self.initial, candidate), self.filter.parameters())

    def _cases(self, runs: int, seed: int, *, held_out: bool) -> Cases:
        """Tracks, and the best rivals on them; tasks with the same models are one batch."""
        config, scenarios = self.config, self.held_out if held_out else self.scenarios
        best, known = torch.ones(len(scenarios), dtype=torch.float64), dict[str, float]()
        together: dict[tuple[str, int], list[int]] = {}
        for i in progress_bar(self.counted, "best rivals, validation" if held_out else "best rivals", not self.quiet):
            task = config.tasks[i]
            scenario = repr((task.scenario, task.options, task.runs))
            if scenario not in known:
                known[scenario] = self.best_rival(i, held_out=held_out, runs=task.runs or runs, seed=seed)[1]
            best[i] = known[scenario]
            together.setdefault((_values(scenarios[i]), task.runs or runs), []).append(i)
        groups = [
            (tasks, simulate([scenarios[i] for i in tasks], first=0, runs=count, seed=seed, device=config.device))
            for (_, count), tasks in together.items()
        ]
        return Cases(groups, best)

    def best_rival(self, i: int, *, held_out: bool, runs: int, seed: int) -> tuple[str, float]:
        """Name and error of the best rival in a task."""
        config, task = self.config, dataclasses.replace(self.config.tasks[i], models="any")
        scenario = task_scenario(task, config, held_out=held_out)
        names = [name for name in config.rivals if name in filters_for(scenario)]
        results = evaluate(scenario, names, runs=runs, seed=seed, compile=config.compile)
        errors = {name: float(torch.tensor(results[name]["rmse_position"][config.skip :]).nanmean()) for name in names}
        best = min(errors, key=errors.__getitem__)
        return best, errors[best]

    @torch.no_grad()
    def iterate(self, iteration: int) -> tuple[Tensor, dict[str, float]]:
        """A generation of the search: the best losses ``(tasks,)`` of a candidate, and further columns of the log."""
        search, losses = cast(Evolution, self.optimiser), []
        for candidate in search.ask():
            self._take(candidate)
            losses.append(self.losses_of(self.cases))
        totals = torch.stack(losses) @ self.task_weights
        search.tell(totals)
        self._take(search.mean)
        best = losses[int(totals.nan_to_num(nan=math.inf).argmin())]
        return best, {"median": float(totals.median()), "step": search.step, "left out": 0}

    @torch.no_grad()
    def validation(self) -> Tensor:
        """The weighted loss on validation tracks."""
        return self.task_weights @ self.losses_of(self.validation_cases)

    def losses_of(self, cases: Cases) -> Tensor:
        """``(tasks,)`` losses; 0 of tasks that do not count."""
        losses = torch.zeros(len(self.filters), dtype=torch.float64)
        allowed = 1 + torch.tensor([task.allowed for task in self.config.tasks], dtype=torch.float64)
        for tasks, batch in cases.groups:
            ratios = (
                (self.errors(tasks, batch) / cases.rivals[tasks])
                .nan_to_num(nan=math.inf)
                .clamp(LEAST_RATIO, LARGEST_RATIO)
            )
            losses[tasks] = (ratios / allowed[tasks]).pow(POWER).mean(0)
        return losses

    def errors(self, tasks: list[int], batch: Batch) -> Tensor:
        """Errors ``(2, tasks)``, filtered and lagged, of tasks with the same models, from their tracks."""
        scenario, f, skip = self.scenarios[tasks[0]], self.filters[tasks[0]], self.config.skip
        for own, stated in zip(_models(f), _models(scenario), strict=True):
            own.load_state_dict(stated.state_dict())
        assert batch.truth is not None
        estimate = f(batch.z, batch.belief(f), u=batch.u, dt=scenario.dt)
        means = torch.stack([estimate.info.filtered.mean, estimate.info.lagged.mean])
        square = (means - batch.truth)[..., skip:, scenario.truth_position].square().sum(-1)
        rmse: Tensor = square.unflatten(1, (len(tasks), -1)).nanmean(2).sqrt().nanmean(-1)
        return torch.where(means.flatten(-2).isnan().any(-1).unflatten(1, (len(tasks), -1)).any(2), torch.nan, rmse)

    def preset(self) -> dict[str, object]:
        """The values as arguments of the preset."""
        return {name: cast(Hyper, hyper)().tolist() for name, hyper in self.filter.named_children()}


def _models(of: Filter | Scenario) -> list[nn.Module]:
    """The motions and the sensor of a filter or a scenario."""
    motion = getattr(of, "bank", None) or of.motion
    return [*(motion.models if isinstance(motion, Bank) else [motion]), of.sensor]


def _kind(scenario: Scenario) -> str:
    """Key of the models and their geometry, without the values of their hyperparameters."""
    models = nn.ModuleList(_models(scenario))
    saved = models.state_dict()
    made = [(type(m).__name__, m.extra_repr()) for m in models.modules() if not isinstance(m, Hyper)]
    places = [(name, x.tolist()) for name, x in models.named_buffers() if name not in saved]
    return repr((made, places, [(name, tuple(x.shape)) for name, x in saved.items()]))


def _values(scenario: Scenario) -> str:
    """Key of the models with all their values, and the time step: tracks with equal keys are one batch."""
    values = [(name, x.tolist()) for name, x in nn.ModuleList(_models(scenario)).state_dict().items()]
    return repr((_kind(scenario), values, scenario.dt))
