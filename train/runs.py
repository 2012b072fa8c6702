"""The named runs of ``train.tune``: each is a function that returns its settings, with the reasons for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from train.config import Config, Task, check, read_changes

SINGLE = ("bearings-outliers", "ranges-outliers")
"""Scenarios in which ``gpb`` learns with one motion too; the others need a bank."""
TRUE_MODEL, SCENARIOS, WRONG_NOISE = 0.015, 0.035, 0.07
"""Tolerated regrets: with the true model, in scenarios, and with process noise that is wrong by a factor of 10."""


def _bearings(name: str, weight: float = 1.0, **options: Any) -> Task:
    return Task(f"bearings-{name}", {"outliers": "std", **options}, weight)


def fra_bearings() -> Config:
    """Both bearings scenarios at once: one set of values for bad and good priors, outliers and a manoeuvre.

    Errors are near 60 m with good priors and near 250 m in the manoeuvre: by the weights relative errors count, most of
    all where the plain robust filters are good.  The scale is beyond the error of any track that does not diverge, so
    that the loss is nearly the mean squared error and the worst tracks dominate.
    """
    return Config(
        name="fra_bearings",
        tasks=(
            _bearings("outliers", 2.4, truth_noise=0.01),  # with the process noise of the filter
            _bearings("manoeuvre", 0.8, truth_noise=0.01),
            _bearings("outliers", 5.0, initial="truth"),
            _bearings("outliers", 13.0, initial="truth", outliers="covariance"),
            _bearings("manoeuvre", 1.0),
        ),
        learn=("threshold", "weakening", "forgetting", "fading_max", "gate", "preference", "q", "std"),
        scale=500.0,
        skip=9,  # the errors of the first steps are those of the bad prior, for any filter
        batch=48,
        iterations=90,
        lr=0.15,
        patience=9,  # the loss has a flat valley, along which validation scores fall by less than their scatter
        validation_runs=128,
    )


def fra_recorded() -> Config:
    """By the likelihood of the measurements, without a truth.  Every fifth recorded track is held out."""
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
    """Process and measurement noise of a plain filter, wrong by a factor of 3 at first, by measurements alone."""
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
    """Recovers known values from the estimates of a teacher that has them; at first they are wrong by a factor of 3."""
    known = {"threshold": 1.0, "weakening": 4.0, "q": 0.03}
    return Config(
        name="recover",
        tasks=(_bearings("outliers", truth_noise=known["q"]), _bearings("manoeuvre", truth_noise=known["q"])),
        learn=tuple(known),
        options={"patience": 0.0},  # with patience q is found 31 % too large in the iterations of the test
        teacher=known,
        start={"threshold": 3.0, "weakening": 4.0 / 3, "q": 0.01},
        loss="teacher",
        scale=10.0,
        batch=16,
        lr=0.1,
        validation_runs=16,
        patience=100,
        cold=1.0,  # both filters make soft decisions at one temperature; hard ones would gain nothing
        test_runs=0,
    )


def switching() -> Config:
    """Three of five models at a time on the ADS-B tracks: transition probabilities, noise levels, when the set changes.

    Both forms of the turns are learned, so that values do not fit a single path.  The scale is near the error of a
    track: each counts by its relative error.  Turn rates stay fixed: at the learning rate of the other values they
    jump.
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
        options={"eps": 0.0579148930},  # that of "minimax" at 1.345
        search={"eps": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]},  # the gradient is small compared with its scatter
        scale=10.0,
        batch=256,
        iterations=100,
        lr=0.05,
        clip=1.0,  # gradients through 500 chaotic steps can be of any size; only their direction is used
        temperature=0.0,
        validation_runs=1024,
        patience=8,
        test_runs=1000,
    )


def association() -> Config:
    """Detection, gate, and the adaptation to the measurement noise: by the likelihood of scans.

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


def gpb() -> Config:
    """Values of ``gpb``: one set over starts, manoeuvres, outliers alone and in bursts, sensors, and stated models.

    Filters of a bank and of one motion learn the same values.  Half of the tasks are the papers' scenarios, recorded
    flights and ranges, where targets do not follow the stated motion; the others are tracks of the stated models, or
    with a stated noise that is wrong by a factor.  Each task tolerates a regret; more than that counts, so that the
    worst regret falls.  Tasks of weight 0 do not count, but are in the report.
    """
    kinds = ("none", "covariance", "std", "bursts")
    bearings = [Task("bearings-outliers", {"initial": initial}, runs=320) for initial in ("paper", "truth")]
    bearings.append(Task("bearings-manoeuvre", runs=200))
    flights = [Task("recorded", {"sensor": sensor}, runs=32) for sensor in ("bearings", "position", "radar")]
    tasks = [
        replace(task, options={**task.options, "outliers": kind}) for task in (*bearings, *flights) for kind in kinds
    ]
    tasks += [Task("ranges-outliers", {"outliers": kind}, runs=24) for kind in ("short", "both")]
    tasks += [replace(task, models="motion") for task in tasks if task.scenario in SINGLE]
    tested = [Task("ranges-outliers", {"outliers": "nlos", "anchors": "around"}, weight=0.0)]
    return Config(
        name="gpb",
        filter="gpb",
        loss="regret",
        tasks=(*(replace(task, allowed=SCENARIOS) for task in tasks), *stated(), *tested),
        learn=("all",),
        start={
            "noise_levels": [0.00406, 1.0, 5.04, 104.0], "jump_factors": [8.23],
            "self_transition": [0.998, 0.99926, 0.864, 0.99111, 0.9681, 0.607],
            "restart": [0.0397, 0.0726, 0.12, 0.0016, 0.7660982, 1.8e-06],
            "outlier_transition": [[0.99895, 0.00105], [0.898, 0.102]],
            "outlier_sizes": [9.04, 60.9, 1540.0, 19500.0],
            "outlier_shares": [0.651967, 0.347, 0.000327, 0.000706], "prior_outlier": 0.0128, "prior_inflation": 89.8,
        },
        # The stated process noise; and the duration of calm flight, as longer ones miss the onset of turns.
        fixed={"noise_levels": [1], "self_transition": [0]},
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
    """Tracks of the stated models, or with a stated noise that is wrong by a factor."""

    def drawn(allowed: float, index: float = 0.1, outliers: str = "none", **options: Any) -> Task:
        return Task("as-stated", {"index": index, "outliers": outliers, **options}, allowed=allowed)

    indices = (0.001, 0.01, 0.1, 1.0)
    tasks = [drawn(TRUE_MODEL, index, motion=motion) for index in indices for motion in ("velocity", "bank")]
    tasks += [drawn(TRUE_MODEL, 1.0, sensor="ranges"), drawn(TRUE_MODEL, motion="acceleration")]
    for outliers in ("covariance", "std", "bursts"):
        tasks += [drawn(0.05, index, outliers) for index in indices]
        tasks += [drawn(0.05, outliers=outliers, motion=motion) for motion in ("acceleration", "bank")]
    tasks.append(drawn(0.05, outliers="bursts", sensor="ranges"))
    tasks += [drawn(WRONG_NOISE, index, q=q) for index in indices for q in (0.1, 10.0)]
    tasks += [drawn(WRONG_NOISE, q=q, motion="acceleration") for q in (0.1, 10.0)]
    tasks += [drawn(WRONG_NOISE, outliers="std", q=q) for q in (0.1, 10.0)]
    tasks += [drawn(1.0, index, q=0.01) for index in indices]
    return tasks + [drawn(0.4, index, std=std) for index in indices for std in (0.5, 2.0)]


def recover_gpb() -> Config:
    """As ``recover``, for ``gpb``, on tracks of its own model: levels, transitions and sizes.

    The likelihood of the measurements would identify sizes and transitions of outliers too, but not the levels and
    their self-transition probabilities: the filter merges the levels of a motion in each step, and a larger agile level
    compensates for that.
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
    return check(replace(RUNS[name](), **read_changes(changes)))
