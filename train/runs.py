"""The named runs of ``train.tune``: each is a function that returns its settings, with the reasons for them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from train.config import Config, Task, check, read_changes
from train.runs_gpb import gpb, recover_gpb


def _bearings(name: str, weight: float = 1.0, **options: Any) -> Task:
    return Task(f"bearings-{name}", {"outliers": "std", **options}, weight)


def fra_bearings() -> Config:
    """Both bearings scenarios at once: one set of values for a poor start, a good one, outliers and a manoeuvre.

    Good starts end near 60 m and the manoeuvre near 250 m: the weights make relative errors count, most of all where
    the plain robust filters are hard to beat.  The scale is beyond the error of any track that does not diverge, so
    that the loss is nearly the mean squared error and the worst tracks dominate.
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
        skip=9,  # the errors of the first steps are those of the poor start, whatever the filter does
        batch=48,
        iterations=90,
        lr=0.15,
        patience=9,  # the loss has a flat valley: validation scores scatter more than they fall along it
        validation_runs=128,
    )


def fra_recorded() -> Config:
    """The likelihood of the measurements alone: needs no truth.  Every fifth recorded track is held out."""
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
    """A filter with known values is the teacher; another, a factor 3 off at first, recovers them from its estimates."""
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
        cold=1.0,  # both filters make soft decisions at one temperature: nothing is gained by hard ones
        test_runs=0,
    )


def switching() -> Config:
    """Three of five models at a time on the ADS-B tracks: transition probabilities, noise levels, when the set changes.

    Both forms of the turns, so that what is learned is not one path.  The scale is near the error of a track: each
    counts by its relative error.  Turn rates stay fixed: at the learning rate of the other values they jump.
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
    """Threshold of the Huber score, and the contamination it assumes, on the growth model with outliers.

    Three in ten measurements have 15 times the standard deviation.  The scale is near the error of a track, 9.
    """
    return Config(
        name="contaminated",
        tasks=(Task("growth", {"outliers": "std", "size": 15.0}),),
        learn=("threshold", "eps"),
        filter="hghckf2",
        options={"eps": 0.0579148930},  # what "minimax" gives at 1.345
        search={"eps": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]},  # the gradient is small compared with its scatter
        scale=10.0,
        batch=256,
        iterations=100,
        lr=0.05,
        clip=1.0,  # gradients through 500 chaotic steps can be of any size: their direction is what counts
        temperature=0.0,
        validation_runs=1024,
        patience=8,
        test_runs=1000,
    )


def association() -> Config:
    """Detection, gate, and how fast to follow the measurement noise: from the likelihood of scans alone.

    Two targets among Poisson false measurements (the likelihood of a non-parametric number of them would reward small
    gates, as it counts only those inside); the measurement noise becomes four times what the filter assumes.  Detection
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
    )


LEARNED = (fra_bearings, fra_recorded, gpb, switching, contaminated, association)
KNOWN = (noise, recover, recover_gpb)
RUNS: dict[str, Callable[[], Config]] = {f.__name__: f for f in (*LEARNED, *KNOWN)}


def configured(name: str, changes: Sequence[str] = ()) -> Config:
    """A named run with ``KEY=VALUE`` changes.

    Raises:
        ValueError: an unknown run or key, or a value of the wrong type or out of its range.
    """
    if name not in RUNS:
        raise ValueError(f"run: expected one of {', '.join(RUNS)}, received {name!r}")
    return check(dataclasses.replace(RUNS[name](), **read_changes(changes)))
