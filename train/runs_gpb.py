"""The named runs that learn the values of ``gpb``, with the reasons for their settings."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

from torchfra import presets
from torchfra.presets.regimes import MANOEUVRES
from train.config import Config, Task

SINGLE = ("bearings-outliers", "ranges-outliers")
"""Scenarios in which ``gpb`` learns with one motion too; the others need a bank."""


def gpb() -> Config:
    """Values of ``gpb``: one set over starts, manoeuvres, outliers alone and in bursts, and sensors.

    Filters of a bank count twice as much as those of one motion, and learn the same values.  Targets of the bearings
    scenarios move without process noise, which would draw the levels to 0; so the truth of some is disturbed as filters
    assume, and other tracks are drawn from what filters are told, or are told a process noise that is ten times off.
    What does not count (weight 0) is looked at in the end.
    """
    kinds = ("none", "covariance", "std", "bursts")
    starts = [Task("bearings-outliers", {"initial": initial}) for initial in ("paper", "truth")]
    flights = [Task("recorded", {"sensor": sensor}) for sensor in ("bearings", "position", "radar")]
    tasks = [_task(task, outliers=kind) for task in (*starts, Task("bearings-manoeuvre"), *flights) for kind in kinds]
    tasks += [_task(task, outliers="std", truth_noise=0.01) for task in starts]
    tasks += [Task("ranges-outliers", {"outliers": kind}) for kind in ("short", "both")]
    for index in (0.01, 1.0):
        told = Task("as-stated", {"index": index, "outliers": "none"})
        tasks += [
            told,
            _task(told, outliers="std"),
            _task(told, outliers="bursts"),
            _task(told, q=0.1),
            _task(told, q=10.0),
        ]
    single = [replace(task, models="motion", weight=0.5) for task in tasks if task.scenario in SINGLE]
    unseen = [Task("ranges-outliers", {"outliers": "nlos", "anchors": "around"}, weight=0.0)]
    return Config(
        name="gpb",
        filter="gpb",
        loss="regret",
        tasks=(*tasks, *single, *unseen),
        learn=("all",),
        start={
            "noise_levels": [0.1, 1.0, 10.0, 100.0], "jump_factors": [3.7],
            "self_transition": [0.97, 0.97, 0.9, 0.8, 0.99, 0.1], "restart": [0.3, 0.2, 0.15, 0.1, 0.249999, 1e-6],
            "outlier_transition": [[0.98, 0.02], [0.7, 0.3]], "outlier_sizes": [10.0, 100.0, 1600.0, 3e4],
            "outlier_shares": [0.5, 0.35, 0.149, 0.001], "prior_outlier": 0.25, "prior_inflation": 340.0,
        },
        batch=32,
        iterations=60,
        lr=0.3,
        temperature=0.0,
        validate_every=4,
        validation_runs=64,
        patience=6,
        test_runs=200,
    )  # fmt: skip


def gpb_bearings() -> Config:
    """Values of ``gpb`` for two bearings, from the defaults on: half of the targets are disturbed as the motion says.

    The defaults expect calmer targets than that.  With one motion and with the bank, as in ``gpb``.
    """
    kinds = [Task("bearings-outliers", {"initial": initial}) for initial in ("paper", "truth")]
    kinds.append(Task("bearings-manoeuvre"))
    tasks = [_task(kind, outliers="std", truth_noise=noise) for kind in kinds for noise in (0.0, 0.01)]
    tasks += [_task(kind, outliers=outliers) for kind in kinds[1:] for outliers in ("covariance", "bursts")]
    defaults = {name: of.default for name, of in inspect.signature(presets.gpb).parameters.items()} | MANOEUVRES["some"]
    return replace(
        gpb(),
        name="gpb_bearings",
        tasks=(*tasks, *(replace(task, models="motion", weight=0.5) for task in tasks)),
        start={name: defaults[name] for name in gpb().start},
        iterations=40,
        lr=0.2,
    )


def recover_gpb() -> Config:
    """As ``recover``, for ``gpb``, on tracks that do what it believes: levels, chains and sizes.

    The likelihood of the measurements would tell sizes and the chain of outliers too, but not the levels and how long
    they stay: the filter merges the levels of a motion in each step, and a larger agile level makes up for that.
    """
    known = {
        "noise_levels": [1.0, 100.0],
        "regimes.self_transition": [0.94, 0.8, 0.5],
        "outliers.outlier_transition": [[0.97, 0.03], [0.4, 0.6]],
        "outlier_sizes": [100.0],
    }
    return Config(
        name="recover_gpb",
        tasks=(Task("regimes"),),
        learn=tuple(known),
        filter="gpb",
        options={
            "noise_levels": [1.0, 100.0],
            "jump_factors": [],
            "adaptive_largest_size": False,
            "outlier_sizes": [100.0],
            "outlier_shares": [1.0],
            "restart": [0.5, 0.4, 0.1],
            "self_transition": [0.94, 0.8, 0.5],
        },
        teacher=known,
        start={
            "noise_levels": [3.0, 33.3],
            "regimes.self_transition": [0.82, 0.4, 0.5],
            "outliers.outlier_transition": [[0.91, 0.09], [0.8, 0.2]],
            "outlier_sizes": [33.3],
        },
        loss="teacher",
        scale=1.0,
        temperature=0.0,
        batch=32,
        iterations=500,
        lr=0.3,
        validation_runs=32,
        patience=100,
        test_runs=0,
    )


def _task(task: Task, **options: Any) -> Task:
    """The same with more options."""
    return replace(task, options=task.options | options)
