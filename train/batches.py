"""Tracks of all tasks of a run as one batch."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from torchfra import readers, scenarios
from torchfra.catalogue import make_scenario
from torchfra.cli.loading import is_place, load_scenario
from torchfra.fitting.data import Batch, lengthened
from torchfra.running import distributed
from torchfra.scenarios import Scenario
from torchfra.types import Gaussian
from train.config import Config, Task
from train.gpb.regimes import regimes


def task_scenario(task: Task, config: Config, *, held_out: bool) -> Scenario:
    """The scenario of a task.

    Args:
        task: of the run.
        config: names the files of recorded tracks.
        held_out: whether recorded tracks are every fifth, which is not trained on, instead of the others.

    Raises:
        ValueError: a bank is asked for where there is none.
    """
    scenario = _recorded(task, config, held_out) if task.scenario == "recorded" else simulated(task)
    if task.models == "bank" and scenario.bank is None:
        raise ValueError(f"models: expected 'motion', as {task.scenario} has no bank of motions, received 'bank'")
    return dataclasses.replace(scenario, bank=None) if task.models == "motion" else scenario


def simulated(task: Task) -> Scenario:
    """The simulated scenario of a task: one of the catalogue, ``"regimes"``, or what a user's function makes."""
    if task.scenario == "regimes":
        return regimes(**task.options)
    make = load_scenario if is_place(task.scenario) else make_scenario
    return make(task.scenario, **task.options)


def _recorded(task: Task, config: Config, held_out: bool) -> Scenario:
    options = {"max_gap": 30.0, "repair": True, **task.options}
    corrected = _corrected(config.files, held_out, options["max_gap"] if options.pop("repair") else None)
    return scenarios.recorded(corrected, repair=False, **options)


@cache
def _corrected(files: tuple[str, ...], held_out: bool, max_gap: float | None) -> list[readers.Recording]:
    """Recorded tracks with corrected time stamps, which takes seconds; unchanged without a ``max_gap``."""
    paths = [Path(file) for file in files] or readers.samples("calibration", "gliders")
    recordings = [recording for path in paths for recording in readers.read(path)]
    kept = [recording for i, recording in enumerate(recordings) if (i % 5 == 4) == held_out]
    return kept if max_gap is None else [part for r in kept for part in readers.flyable(r, max_gap=max_gap)]


def simulate(tasks: Sequence[Scenario], *, first: int, runs: int, seed: int, device: str = "cpu") -> Batch:
    """This process's share of ``runs`` tracks of each task, those of a task one after the other.

    Args:
        tasks: the scenario of each.
        first: number of the first run; run i of a seed is always the same track.
        runs: tracks of each task, over all processes.
        seed: of the random numbers.
        device: of the tensors.
    """
    share = distributed.share(runs)
    count, steps = len(share), max(scenario.steps for scenario in tasks)
    parts = [scenario.simulate(count, seed, first=first + share.start) for scenario in tasks]
    us = [part.u.expand(count, *part.u.shape[-2:]) for part in parts if part.u is not None]  # the same for all, or not
    roots = [part.prior.scale_tril.expand(*part.prior.mean.shape, part.prior.mean.shape[-1]) for part in parts]
    return Batch(
        z=torch.cat([lengthened(part.z, steps, math.nan, 1) for part in parts]).to(device),
        truth=torch.cat([lengthened(part.truth, steps, math.nan, -2) for part in parts]).to(device),
        u=torch.cat([lengthened(u, steps, 0.0, -2) for u in us]).to(device) if us else None,
        prior=Gaussian(torch.cat([part.prior.mean for part in parts]).to(device), torch.cat(roots).to(device)),
        dt=torch.cat([seconds.expand(count, -1) for seconds in _seconds(tasks)]).to(device),
    )


def _seconds(tasks: Sequence[Scenario]) -> list[Tensor]:
    """Seconds of each step, ``(1,)`` for each task, or ``(T,)`` if one of them has steps that differ."""
    each = [torch.as_tensor(scenario.dt, dtype=torch.float64).reshape(-1) for scenario in tasks]
    if all(len(seconds) == 1 for seconds in each):
        return each
    longest = max(scenario.steps for scenario in tasks)
    each = [seconds.expand(scenario.steps) for seconds, scenario in zip(each, tasks, strict=True)]
    return [lengthened(seconds, longest, 1.0, 0) for seconds in each]
