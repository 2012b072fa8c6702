"""The settings of a run of ``train.tune``, their changes on the command line, and their ranges."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, get_type_hints

from torchfra.hyper import one_of

LOSSES = ("mse", "robust", "nll", "innovation", "teacher", "regret")
MODELS = ("motion", "bank", "any")
LARGEST = 10**9
"""Largest seed and largest count."""


@dataclass(frozen=True)
class Task:
    """Tracks to learn from, and their weight in the loss."""

    scenario: str
    """A name of ``torchfra.catalogue.SCENARIOS``, ``"bearings-outliers"`` for example, a function of the user that
    makes a ``Scenario``, as ``module:function`` or ``file.py:function``, or ``"recorded"``."""
    options: dict[str, Any] = field(default_factory=dict)
    """Arguments of the scenario, such as ``outliers`` and ``truth_noise``."""
    weight: float = 1.0
    """Weight of this task's mean loss in the loss of the run.  Loss ``"regret"``: 0 for tracks to test on only."""
    allowed: float = 0.0
    """Loss ``"regret"``: the regret that is tolerated; a larger one counts for much more."""
    runs: int = 0
    """Loss ``"regret"``: number of tracks of this task, for learning and reports; 0 for that of the run."""
    models: str = "any"
    """Models of the scenario for filters that take either: its ``"motion"``, its ``"bank"``, or ``"any"``: the bank
    if it has one."""


@dataclass(frozen=True)
class Config:
    """The settings of a run.  Any of them may be changed on the command line: ``lr=0.1``."""

    name: str
    tasks: tuple[Task, ...]
    """Each iteration simulates tracks of all of them."""
    learn: tuple[str, ...]
    """Hyperparameters by name, or ``("all",)``."""
    filter: str = "fra"
    """A name of ``torchfra.catalogue.FILTERS``."""
    options: dict[str, Any] = field(default_factory=dict)
    """Arguments of the filter's preset."""
    start: dict[str, Any] = field(default_factory=dict)
    """Initial values, in natural units, instead of the preset's and the scenario's.  Loss ``"regret"``: arguments of
    the preset."""
    fixed: dict[str, list[int]] = field(default_factory=dict)
    """Loss ``"regret"``: indices of entries of learned values that keep their initial value, such as a level of 1."""
    rivals: tuple[str, ...] = ("srckf", "rsrckf", "mr_ckf", "fra", "imm_srckf", "imm_fra")
    """Loss ``"regret"``: filters at their defaults; an error is compared with that of the best of them in a task."""
    search: dict[str, list[float]] = field(default_factory=dict)
    """Candidate values of hyperparameters without a gradient.  They are tried after the last iteration, on the
    validation tracks, one hyperparameter after the other."""
    loss: str = "robust"
    """``"mse"``, ``"robust"``, ``"nll"`` (of the position), ``"innovation"``, ``"teacher"`` or ``"regret"``: errors as
    ratios to the best rival's, of several filters that share values, which are searched without gradients
    (``train/gpb/regret.py``)."""
    scale: float = 100.0
    """Position error, m, above which the robust loss flattens."""
    teacher: dict[str, Any] = field(default_factory=dict)
    """Loss ``"teacher"``: values of the filter whose estimates are the targets."""
    skip: int = 0
    """Steps at the start of each track that do not count."""
    files: tuple[str, ...] = ()
    """Recorded tracks for the task ``"recorded"``; the sample tracks if empty."""
    batch: int = 64
    """Tracks of each task in an iteration, over all processes."""
    iterations: int = 100
    lr: float = 0.05
    """Learning rate of Adam, on the unconstrained values; falls to a tenth along a half cosine.  Loss ``"regret"``: the
    first standard deviation of the search on these."""
    population: int = 10
    """Loss ``"regret"``: sets of values that are tried in an iteration."""
    clip: float = 100.0
    """Largest norm of one track's gradient.  Large, because tracks about to diverge have large gradients."""

    truncate: int = 0
    """Steps after which backpropagation through time is truncated; 0 for never."""
    temperature: float = 1.0
    """Initial temperature of FRA's decision; falls geometrically to ``cold``.  0 trains the hard decision."""
    cold: float = 0.1
    """Final temperature."""
    validate_every: int = 10
    """Iterations between validations, with the hard decision, on validation tracks."""
    validation_runs: int = 128
    patience: int = 5
    """Validations without improvement after which training stops."""
    test_runs: int = 500
    """Test tracks of each task for the errors before and after; 0 for none."""
    seed: int = 0
    validation_seed: int = 1
    test_seed: int = 2
    device: str = "cpu"
    compile: bool = True
    """Run compiled kernels: many times faster, and needs a C++ compiler, or NVRTC on a GPU."""
    tensorboard: bool = False
    """Also write a TensorBoard log."""


def read_changes(changes: Sequence[str]) -> dict[str, Any]:
    """Fields of ``Config`` from ``KEY=VALUE``; ``scenario=A,B`` is short for tasks without options.

    Raises:
        ValueError: an unknown key, or a value of another type.
    """
    types = get_type_hints(Config)
    fields: dict[str, Any] = {}
    for change in changes:
        key, equals, text = change.partition("=")
        if equals and key == "scenario":
            fields["tasks"] = tuple(Task(name) for name in _read(text, tuple[str, ...]))
            continue
        if not equals or key not in types:
            known = ", ".join(("scenario", *types))
            raise ValueError(f"config: expected KEY=VALUE with a key of {known}, received {change!r}")
        try:
            fields[key] = _read(text, types[key])
        except (ValueError, KeyError, TypeError):
            raise ValueError(f"{key}: expected {_type_name(types[key])}, received {text!r}") from None
    return fields


def _read(text: str, kind: Any) -> Any:
    if kind is bool:
        return {"true": True, "false": False, "1": True, "0": False}[text.lower()]
    if kind in (int, float, str):
        return kind(text)
    if kind == tuple[str, ...]:
        return tuple(part for part in text.split(",") if part)
    value = json.loads(text)
    if kind == tuple[Task, ...]:
        return tuple(Task(**task) for task in value)
    if not isinstance(value, dict):
        raise TypeError
    return value


def _type_name(kind: Any) -> str:
    if kind in (bool, int, float, str):
        return str(kind.__name__)
    return "names with commas between them" if kind == tuple[str, ...] else "JSON"


def check(config: Config) -> Config:
    """The settings, after a check of their ranges.

    Raises:
        ValueError: a value out of its range.
    """
    one_of(loss=(config.loss, LOSSES))
    for task in config.tasks:
        one_of(models=(task.models, MODELS))
    for low, keys in ((4, ("population",)),
                      (1, ("batch", "iterations", "validate_every", "validation_runs", "patience")),
                      (0, ("skip", "truncate", "test_runs", "seed", "validation_seed", "test_seed"))):  # fmt: skip
        for key in keys:
            if getattr(config, key) < low:
                raise ValueError(f"{key}: expected at least {low}, received {getattr(config, key)}")
            if getattr(config, key) > LARGEST:
                raise ValueError(f"{key}: expected at most {LARGEST:,}, received {getattr(config, key):,}")
    for key in ("lr", "clip", "scale"):
        if not getattr(config, key) > 0:
            raise ValueError(f"{key}: expected a value above 0, received {getattr(config, key)}")
    if config.temperature and not config.temperature >= config.cold > 0:
        raise ValueError(f"cold: expected above 0 and at most {config.temperature}, received {config.cold}")
    if len({config.seed, config.validation_seed, config.test_seed}) < 3:
        raise ValueError("seed, validation_seed, test_seed: expected three different ones")
    if not config.tasks or not config.learn:
        raise ValueError("tasks, learn: expected at least one of each")
    if config.files and not any(task.scenario == "recorded" for task in config.tasks):
        names = ", ".join(task.scenario for task in config.tasks)
        raise ValueError(f"files: expected a task 'recorded' beside them, received tasks {names}")
    return config
