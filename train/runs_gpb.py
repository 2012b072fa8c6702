"""The named runs that learn the values of ``gpb``, with the reasons for their settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from train.config import Config, Task

SINGLE = ("bearings-outliers", "ranges-outliers")
"""Scenarios in which ``gpb`` learns with one motion too; the others need a bank."""
HOLDS, CASES, OFF = 0.015, 0.035, 0.07
"""Regrets that are allowed: where the stated model holds, in scenarios, and where process noise is ten times off."""


def gpb() -> Config:
    """Values of ``gpb``: one set over starts, manoeuvres, outliers alone and in bursts, sensors, and stated models.

    Filters of a bank and of one motion learn the same values.  Half of the tasks are the papers' scenarios, recorded
    flights and ranges, where targets do not move as stated; the others are tracks drawn from the stated models, or with
    a stated noise that is several times off.  Each task allows a regret; what is above that counts, so that the worst
    regret falls.  What does not count (weight 0) is looked at in the end.
    """
    kinds = ("none", "covariance", "std", "bursts")
    bearings = [Task("bearings-outliers", {"initial": initial}, runs=320) for initial in ("paper", "truth")]
    bearings.append(Task("bearings-manoeuvre", runs=200))
    flights = [Task("recorded", {"sensor": sensor}, runs=32) for sensor in ("bearings", "position", "radar")]
    tasks = [_task(task, outliers=kind) for task in (*bearings, *flights) for kind in kinds]
    tasks += [Task("ranges-outliers", {"outliers": kind}, runs=24) for kind in ("short", "both")]
    tasks += [replace(task, models="motion") for task in tasks if task.scenario in SINGLE]
    unseen = [Task("ranges-outliers", {"outliers": "nlos", "anchors": "around"}, weight=0.0)]
    return Config(
        name="gpb",
        filter="gpb",
        loss="regret",
        tasks=(*(replace(task, allowed=CASES) for task in tasks), *stated(), *unseen),
        learn=("all",),
        start={
            "noise_levels": [0.00406, 1.0, 5.04, 104.0], "jump_factors": [8.23],
            "self_transition": [0.998, 0.99926, 0.864, 0.99111, 0.9681, 0.0614],
            "restart": [0.0397, 0.0726, 0.12, 0.0016, 0.7660982, 1.8e-06],
            "outlier_transition": [[0.99895, 0.00105], [0.898, 0.102]],
            "outlier_sizes": [9.04, 60.9, 1540.0, 19500.0],
            "outlier_shares": [0.651967, 0.347, 0.000327, 0.000706], "prior_outlier": 0.0128, "prior_inflation": 89.8,
        },
        # The process noise that is stated; and how long calm lasts: if longer, covariances miss the onset of turns.
        hold={"noise_levels": [1], "self_transition": [0]},
        rivals=("srckf", "rsrckf", "mr_ckf", "asrckf", "rmckf", "hghckf1", "iaukf", "fra", "imm_srckf", "imm_fra"),
        batch=64,
        iterations=24,
        lr=0.12,
        population=14,
        temperature=0.0,
        validate_every=2,
        validation_runs=64,
        patience=6,
        seed=13,
        validation_seed=14,
        test_seed=15,
        test_runs=200,
    )  # fmt: skip


def stated() -> list[Task]:
    """Tracks drawn from the stated models, or with a stated noise that is several times off."""

    def drawn(allowed: float, index: float = 0.1, outliers: str = "none", **options: Any) -> Task:
        return Task("as-stated", {"index": index, "outliers": outliers, **options}, allowed=allowed)

    indices = (0.001, 0.01, 0.1, 1.0)
    tasks = [drawn(HOLDS, index, motion=motion) for index in indices for motion in ("velocity", "bank")]
    tasks += [drawn(HOLDS, 1.0, sensor="ranges"), drawn(HOLDS, motion="acceleration")]
    for outliers in ("covariance", "std", "bursts"):
        tasks += [drawn(0.05, index, outliers) for index in indices]
        tasks += [drawn(0.05, outliers=outliers, motion=motion) for motion in ("acceleration", "bank")]
    tasks.append(drawn(0.05, outliers="bursts", sensor="ranges"))
    tasks += [drawn(OFF, index, q=q) for index in indices for q in (0.1, 10.0)]
    tasks += [drawn(OFF, q=q, motion="acceleration") for q in (0.1, 10.0)]
    tasks += [drawn(OFF, outliers="std", q=q) for q in (0.1, 10.0)]
    tasks += [drawn(1.0, index, q=0.01) for index in indices]
    return tasks + [drawn(0.4, index, std=std) for index in indices for std in (0.5, 2.0)]


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
