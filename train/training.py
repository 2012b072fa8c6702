"""The filter of a run, its losses, iterations and validation."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchfra import losses
from torchfra.catalogue import FILTERS, scenario_filter
from torchfra.filters import Filter
from torchfra.filters.soft import Soft
from torchfra.fitting.data import Batch
from torchfra.fitting.descent import falling, follow, means, summands
from torchfra.fitting.objective import LossFunction, Objective
from torchfra.fitting.vector import Vector
from torchfra.hyper import named, natural_values, one_of
from torchfra.running import distributed
from torchfra.scenarios import Scenario
from torchfra.types import Estimate
from train.batches import simulate, task_scenario
from train.config import Config


class Training:
    """A filter with its optimiser, and the tracks it learns from: a ``Learner`` of ``torchfra.fitting.descent``.

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
        weights = torch.tensor([task.weight for task in config.tasks], dtype=torch.float64)
        self.task_weights = weights / weights.sum()

    def make(self) -> nn.Module:
        """The module whose parameters learn."""
        config, first = self.config, self.scenarios[0]
        _check(config, self.scenarios)
        f = make_filter(config, first, config.start, learn=True)
        check_candidates(f, config)
        if config.loss == "teacher":
            self.teacher = make_filter(config, first, config.teacher, learn=False)
        self.objective = _objective(config, f, self.teacher, first)
        return f

    def step(self, iteration: int) -> dict[str, float]:
        """One iteration; a row of the log."""
        begun = time.perf_counter()
        losses, columns = self.iterate(iteration)
        row = {"loss": float(self.task_weights @ losses)}
        if len(losses) > 1:
            row |= {f"loss {i + 1}": value for i, value in enumerate(losses.tolist())}
        return row | columns | {"seconds": time.perf_counter() - begun}

    def iterate(self, iteration: int) -> tuple[Tensor, dict[str, float]]:
        """One iteration; the losses ``(tasks,)`` and further columns of the log."""
        # New tracks in each iteration.  Their numbers follow from the iteration, so a resumed run sees the same ones.
        c, progress = self.config, iteration / self.config.iterations
        batch = simulate(self.scenarios, first=iteration * c.batch, runs=c.batch, seed=c.seed, device=c.device)
        temperature = c.temperature and c.temperature * (c.cold / c.temperature) ** progress
        self.decide(temperature)
        losses, gradients, left_out = self.task_means(batch)
        gradient, rate = self.task_weights @ gradients, falling(c.lr, progress)
        follow(self.optimiser, gradient, rate)
        return losses, {
            "gradient": gradient.norm().item(), "left out": left_out, "lr": rate, "temperature": temperature
        }  # fmt: skip

    def task_means(self, batch: Batch) -> tuple[Tensor, Tensor, int]:
        """The mean loss ``(tasks,)`` and mean clipped gradient ``(tasks, P)`` of each task, over all processes.

        Tracks whose loss or gradient is NaN or infinite do not count; the third value is their number.
        """
        each, gradient = self.objective.gradients(self.objective.vector.raw()[None, None], batch)
        losses, gradients, used = means(self._by_task(summands(each[0], gradient[0], self.config.clip)))
        return losses, gradients, len(self.scenarios) * self.config.batch - used

    def validation(self) -> Tensor:
        """The weighted loss on validation tracks, with hard decisions; infinite if one is NaN."""
        c = self.config
        batch = simulate(self.held_out, first=0, runs=c.validation_runs, seed=c.validation_seed, device=c.device)
        # A teacher with soft decisions is compared with a filter with soft decisions.
        self.decide(c.temperature if c.loss == "teacher" else 0.0)
        losses = self.objective.of_filter(self.objective.filter, batch).nan_to_num(nan=math.inf)
        return self.task_weights @ distributed.summed(self._by_task(losses)) / c.validation_runs

    def _by_task(self, x: Tensor) -> Tensor:
        """Sums ``(tasks, ...)`` of ``x (N, ...)`` over the tracks of each task."""
        count = len(self.scenarios)
        task = torch.arange(count).repeat_interleave(len(x) // count)
        return x.new_zeros(count, *x.shape[1:]).index_add(0, task, x)

    def decide(self, temperature: float) -> None:
        """Makes the decisions of the filter and of its teacher soft, or hard at 0."""
        set_temperature(self.filter, temperature)
        if self.teacher is not None:
            set_temperature(self.teacher, temperature)

    def natural(self, start: int = 0) -> dict[str, float]:
        """The values that are learned or searched, in natural units."""
        paths = {name.removesuffix(".raw") for name in self.parameters} | set(named(self.filter, self.config.search))
        return {path: value for path, value in natural_values(self.filter).items() if path.partition("[")[0] in paths}


def _check(config: Config, scenarios: list[Scenario]) -> None:
    if len({(type(s.motion), type(s.sensor), s.motion.size, s.sensor.size) for s in scenarios}) > 1:
        raise ValueError("tasks: expected scenarios of one kind of motion and sensor")
    if min(config.batch, config.validation_runs) < distributed.size():
        raise ValueError(f"batch, validation_runs: expected at least {distributed.size()}, one for each process")


def _objective(config: Config, f: Filter, teacher: Filter | None, scenario: Scenario) -> Objective:
    """The loss of each track of a run, and its gradient."""

    def innovation(estimate: Estimate, batch: Batch) -> Tensor:
        loss = losses.innovation_nll(estimate)
        return loss.mean(-1) if f.scans else loss  # over the targets of a scene

    def from_teacher(estimate: Estimate, batch: Batch) -> Tensor:
        assert teacher is not None
        with torch.no_grad():
            target = teacher(batch.z, batch.belief(teacher), u=batch.u, dt=batch.dt).mean[..., config.skip :, :]
        return losses.robust_mse(estimate.mean, target, teacher.motion.position, config.scale)

    own: dict[str, LossFunction] = {"innovation": innovation, "teacher": from_teacher}
    convert = scenario.cartesian if teacher is None else None  # a teacher is in the coordinates of the motion
    return Objective(
        f, Vector(f), own.get(config.loss, config.loss), scale=config.scale, states=scenario.truth_position,
        skip=config.skip, convert=convert, truncate=config.truncate or None,
    )  # fmt: skip


def make_filter(config: Config, scenario: Scenario, values: Mapping[str, float], *, learn: bool) -> Filter:
    """The filter of a run around copies of a scenario's models.

    Args:
        config: names the filter, its options, its learned values, and the device.
        scenario: with the models, which are not changed.
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
        ValueError: an unknown hyperparameter, or a value out of its range.
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
    """Makes the decisions of a filter soft, or hard at 0; a filter without decisions is unchanged."""
    for part in f.modules():
        if isinstance(part, Soft):
            part.temperature = temperature
