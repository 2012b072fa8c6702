"""The named runs of ``train.tune``: each is a function that returns a config, numbers with their reasons."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, get_type_hints


@dataclass(frozen=True)
class Task:
    """Tracks to learn from, and how much they count."""

    scenario: str
    """A name of ``torchfra.cli.SCENARIOS``, ``"bearings-outliers"`` say, or ``"recorded"``."""
    options: dict[str, Any] = field(default_factory=dict)
    """What the scenario takes, such as ``outliers`` and ``truth_noise``."""
    weight: float = 1.0
    """Of the mean loss of this task's tracks."""


@dataclass(frozen=True)
class Config:
    """What a run does.  Any field may be set on the command line, ``lr=0.1``."""

    name: str
    tasks: tuple[Task, ...]
    """Each iteration takes tracks of all of them."""
    learn: tuple[str, ...]
    """Hyperparameters by name, or ``("all",)``."""
    filter: str = "fra"
    """A preset."""
    options: dict[str, Any] = field(default_factory=dict)
    """What the preset takes."""
    start: dict[str, float] = field(default_factory=dict)
    """Values to start from instead of the preset's and the scenario's, in natural units."""
    search: dict[str, list[float]] = field(default_factory=dict)
    """Values to try, by hyperparameter, for what no gradient reaches: after the last iteration, on the validation
    tracks, one hyperparameter after the other."""
    loss: str = "robust"
    """``"mse"``, ``"robust"``, ``"nll"`` (of the position), ``"innovation"`` or ``"teacher"``."""
    scale: float = 100.0
    """Position error, m, from which on the robust loss flattens."""
    teacher: dict[str, float] = field(default_factory=dict)
    """Loss ``"teacher"``: values of the filter whose estimates are to be found again."""
    skip: int = 0
    """First steps of a track that do not count."""
    files: tuple[str, ...] = ()
    """Recorded tracks for the task ``"recorded"``; the sample tracks if none."""
    batch: int = 64
    """Tracks of each task and iteration, over all processes."""
    iterations: int = 100
    lr: float = 0.05
    """Of Adam, on the unconstrained values; falls to a tenth along a half cosine."""
    clip: float = 100.0
    """Largest norm of one track's gradient.  Large: it is the tracks in danger that have large gradients."""
    truncate: int = 0
    """Steps after which gradients flow no further back; 0 for all of a track."""
    temperature: float = 1.0
    """Of FRA's decision at the start; falls geometrically to ``cold`` at the end.  0 trains the hard decision."""
    cold: float = 0.1
    validate_every: int = 10
    """Iterations between validations, with the hard decision, on tracks never trained on."""
    validation_runs: int = 128
    patience: int = 5
    """Validations without a better one after which training stops."""
    checkpoint_every: int = 10
    test_runs: int = 500
    """Unseen tracks of each task for the figures before and after; 0 for none."""
    seed: int = 0
    validation_seed: int = 1
    test_seed: int = 2
    device: str = "cpu"
    compile: bool = True
    """Run compiled kernels on the CPU: many times faster, and needs a C++ compiler."""
    tensorboard: bool = False
    """Also write a TensorBoard log."""


def _bearings(name: str, weight: float = 1.0, **options: Any) -> Task:
    return Task(f"bearings-{name}", {"outliers": "std", **options}, weight)


def fra_bearings() -> Config:
    """Both bearings scenarios at once: one set of values for a poor start, a good one, outliers and a manoeuvre.

    Good starts end near 60 m and the manoeuvre near 250 m: the weights let relative errors count, and most where the
    plain robust filters are hard to keep up with.  The scale is beyond any track that is not lost, so that the loss is
    nearly the mean squared error and the worst tracks lead.
    """
    return Config(
        name="fra_bearings",
        tasks=(
            _bearings("outliers", 2.4, truth_noise=0.01),  # disturbed as the filter assumes
            _bearings("manoeuvre", 0.8, truth_noise=0.01),
            _bearings("outliers", 5.0, initial="truth"),
            _bearings("outliers", 13.0, initial="truth", outliers="covariance"),
            _bearings("manoeuvre", 1.0),
        ),
        learn=("threshold", "weakening", "forgetting", "fading_max", "gate", "preference", "q", "std"),
        scale=500.0,
        skip=9,  # the first steps carry the poor start, whatever the filter does
        batch=48,
        iterations=90,
        lr=0.15,
        patience=9,  # it moves along a flat valley; validation is noisier than its slope
        validation_runs=128,
    )


def fra_recorded() -> Config:
    """The likelihood of the measurements alone: needs no truth.  Every fifth recorded track is kept for the test."""
    return Config(
        name="fra_recorded",
        tasks=(Task("recorded"),),
        learn=("threshold", "weakening", "forgetting", "gate", "preference", "q", "std"),
        loss="innovation",
        batch=48,
        iterations=60,
        test_runs=200,
    )


def noise() -> Config:
    """Process and measurement noise of a plain filter, a factor 3 off, from measurements alone."""
    return Config(
        name="noise",
        tasks=(Task("bearings-outliers", {"outliers": "none", "truth_noise": 0.04, "initial": "truth"}),),
        learn=("q", "std"),
        filter="srckf",
        start={"q": 0.04 / 3, "std": 0.0175 * 3},
        loss="innovation",
        temperature=0.0,
        test_runs=0,
    )


def recover() -> Config:
    """A filter with known values is the teacher; another that starts a factor 3 off finds them from its estimates."""
    known = {"threshold": 1.0, "weakening": 4.0, "q": 0.03}
    return Config(
        name="recover",
        tasks=(_bearings("outliers", truth_noise=known["q"]), _bearings("manoeuvre", truth_noise=known["q"])),
        learn=tuple(known),
        teacher=known,
        start={"threshold": 3.0, "weakening": 4.0 / 3, "q": 0.01},
        loss="teacher",
        scale=10.0,
        batch=16,
        lr=0.1,
        validation_runs=16,
        patience=100,
        cold=1.0,  # teacher and pupil decide alike, and softly: nothing is gained by hardening
        test_runs=0,
    )


def switching() -> Config:
    """Three of five models at a time on the ADS-B tracks: which follows which, how noisy each is, and when sets change.

    Both forms of the turns, so that it is not one path that is learned.  The scale is near the error of a track: each
    counts by its relative error.  Rates of turns stay: at one learning rate with the others they jump.
    """
    return Config(
        name="switching",
        tasks=(Task("adsb-turns"), Task("adsb-turns", {"turns": "arc"})),
        learn=("transition", "q", "alpha", "limit", "std"),
        filter="vsimm_srckf",
        search={"unlikely": [0.0, 0.01, 0.02, 0.05, 0.1, 0.15], "principal": [0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]},
        scale=20.0,
        skip=18,  # figures count from sample 21 on, and filters start with the third
        batch=48,
        iterations=150,
        lr=0.1,
        temperature=0.0,
        validation_runs=256,
    )


def contaminated() -> Config:
    """Threshold of the Huber score, and the contamination it assumes, on the growth model with wild noise.

    Three in ten measurements have 15 times the standard deviation.  Errors are near 9: the scale is that of a track.
    """
    return Config(
        name="contaminated",
        tasks=(Task("growth", {"outliers": "std", "size": 15.0}),),
        learn=("threshold", "eps"),
        filter="hghckf2",
        options={"eps": 0.0579148930},  # what "minimax" gives at 1.345
        search={"eps": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]},  # its slope is small against the noise of the gradient
        scale=10.0,
        batch=256,
        iterations=100,
        lr=0.05,
        clip=1.0,  # gradients through 500 chaotic steps are wild: it is their direction that counts
        temperature=0.0,
        validation_runs=1024,
        patience=8,
        test_runs=1000,
    )


def association() -> Config:
    """How often targets are measured, the gate, and how fast to follow the noise: from the likelihood of scans alone.

    Two targets among Poisson false measurements (the likelihood of a non-parametric number of them would reward small
    gates, as it counts them in the gates alone); the noise becomes four times what the filter assumes.  Detection
    starts at 0.7 (truth: 0.95), the gate at 60 m, the memory at five innovations.  The gate is soft while it learns.
    """
    return Config(
        name="association",
        tasks=(
            Task("clutter-straight", {"noise_scale": 4.0, "counts": "poisson"}),
            Task("clutter-straight", {"noise_scale": 1.0, "counts": "poisson"}),
        ),
        learn=("detection", "gate.size", "forgetting", "confidence"),
        filter="iaukf_jpda",
        start={"detection": 0.7, "gate.size": 60.0, "forgetting": 0.8},
        loss="innovation",
        skip=5,
        batch=16,
        iterations=60,
        lr=0.1,
        clip=10.0,
        temperature=0.3,
        cold=0.05,
        validation_runs=64,
        test_runs=200,
        compile=False,  # there are no kernels for scans
    )


RUNS: dict[str, Callable[[], Config]] = {
    f.__name__: f for f in (fra_bearings, fra_recorded, switching, contaminated, association, noise, recover)
}


def configured(name: str, changes: Sequence[str] = ()) -> Config:
    """A named run with ``key=value`` changes.

    Raises:
        ValueError: an unknown run or key, or a value of the wrong kind.
    """
    if name not in RUNS:
        raise ValueError(f"run: expected one of {', '.join(RUNS)}, received {name!r}")
    hints = get_type_hints(Config)
    given: dict[str, Any] = {}
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals or key not in hints:
            raise ValueError(f"config: expected KEY=VALUE with a key out of {', '.join(hints)}, received {change!r}")
        given[key] = _read(key, text, hints[key])
    return _checked(dataclasses.replace(RUNS[name](), **given))


def _read(key: str, text: str, kind: Any) -> Any:
    try:
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
    except (ValueError, KeyError, TypeError):
        said = getattr(kind, "__name__", None) or str(kind)
        raise ValueError(
            f"{key}: expected {'JSON' if 'dict' in said or 'Task' in str(kind) else said}, received {text!r}"
        ) from None


def _checked(config: Config) -> Config:
    for key, low in (("batch", 1), ("iterations", 1), ("validate_every", 1), ("validation_runs", 1), ("patience", 1),
                     ("checkpoint_every", 1), ("skip", 0), ("truncate", 0), ("test_runs", 0), ("seed", 0),
                     ("validation_seed", 0), ("test_seed", 0)):  # fmt: skip
        if getattr(config, key) < low:
            raise ValueError(f"{key}: expected at least {low}, received {getattr(config, key)}")
    for key in ("lr", "clip", "scale"):
        if not getattr(config, key) > 0:
            raise ValueError(f"{key}: expected a value above 0, received {getattr(config, key)}")
    if config.temperature and not config.temperature >= config.cold > 0:
        raise ValueError(f"cold: expected above 0 and at most {config.temperature}, received {config.cold}")
    if len({config.seed, config.validation_seed, config.test_seed}) < 3:
        raise ValueError("seed, validation_seed, test_seed: expected three different ones")
    if not config.tasks or not config.learn:
        raise ValueError("tasks, learn: expected at least one of each")
    return config
