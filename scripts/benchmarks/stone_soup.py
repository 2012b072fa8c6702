"""Trackers of Stone Soup on scans that are handed in: a process that tracks, and times itself.

    python scripts/benchmarks/stone_soup.py jpda job.npz tracks.npz
    python scripts/benchmarks/stone_soup.py sensors job.npz tracks.npz        JPDA of scans by several sensors in turn

Prints a JSON line with the processor's seconds of each run, or with what is missing.  Needs
``pip install 'torchfra[bench]'`` but neither torch nor torchfra.  Births are those of ``MultiMeasurementInitiator``: a
tentative track has the nearest measurements that are no other track's until it is confirmed; a track ends after five
scans without one.
"""

from __future__ import annotations

import datetime
import json
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

WINDOW = 3
"""Scans of the multi-frame assignment."""
MISSES = 5
"""Scans without a measurement after which a track ends."""
START = datetime.datetime(2000, 1, 1)


class Job(NamedTuple):
    """Targets in a plane, nearly constant velocity; positions with noise, missed and false ones."""

    z: np.ndarray
    """``(R, T, J, 2)`` scans, m; NaN is none."""
    time: np.ndarray
    """``(T,)`` s."""
    sensor: np.ndarray
    """``(T,)`` number of the sensor of each scan."""
    q: np.ndarray
    """``()`` density of the acceleration noise, m^2/s^3."""
    std: np.ndarray
    """``(S,)`` standard deviation of a position, m, of each sensor."""
    speed: np.ndarray
    """``()`` standard deviation of a target's velocity in each direction, m/s."""
    detection: np.ndarray
    """``(S,)`` probability that a target is measured."""
    gate: np.ndarray
    """``()`` probability of the gate."""
    density: np.ndarray
    """``(S,)`` false measurements per m^2."""
    points: np.ndarray
    """``()`` measurements that confirm a track."""


class Parts(NamedTuple):
    """The common parts of both trackers."""

    predictor: Any
    updater: Any
    hypothesiser: Any
    initiator: Any
    deleter: Any


def parts(job: Job, sensor: int = 0) -> Parts:
    """The Kalman filter, gates and births of a sensor."""
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.deleter.time import UpdateTimeStepsDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import MultiMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(float(job.q))] * 2))
    measurement = LinearGaussian(4, (0, 2), float(job.std[sensor]) ** 2 * np.eye(2))
    updater = KalmanUpdater(measurement)
    near = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=3)
    wide = GaussianState(np.zeros(4), np.diag([0.0, float(job.speed) ** 2] * 2), timestamp=START)
    deleter = UpdateTimeStepsDeleter(MISSES)
    initiator = MultiMeasurementInitiator(
        wide, UpdateTimeStepsDeleter(2), GNNWith2DAssignment(near), updater, measurement, min_points=int(job.points)
    )
    hypothesiser = PDAHypothesiser(
        predictor,
        updater,
        float(job.density[sensor]),
        prob_detect=float(job.detection[sensor]),
        prob_gate=float(job.gate),
    )
    return Parts(predictor, updater, hypothesiser, initiator, deleter)


def detections(job: Job, scans: np.ndarray) -> Iterator[tuple[datetime.datetime, set[Any]]]:
    """Times and sets of the measurements ``(T, J, 2)``."""
    from stonesoup.types.detection import Detection

    for seconds, scan in zip(job.time, scans, strict=True):
        at = START + datetime.timedelta(seconds=float(seconds))
        yield at, {Detection(z.reshape(2, 1), timestamp=at) for z in scan if not np.isnan(z).any()}


def jpda(job: Job, scans: np.ndarray) -> Iterator[set[Any]]:
    """Joint probabilistic data association, by efficient hypothesis management: the tracks after each scan."""
    from stonesoup.dataassociator.probability import JPDAwithEHM2
    from stonesoup.tracker.simple import MultiTargetMixtureTracker

    p = parts(job)
    tracker = MultiTargetMixtureTracker(
        p.initiator, p.deleter, detections(job, scans), JPDAwithEHM2(p.hypothesiser), p.updater
    )
    for _, tracks in tracker:
        yield tracks


def sensors(job: Job, scans: np.ndarray) -> Iterator[set[Any]]:
    """``jpda`` of scans by several sensors, each with gates and births of its own: the tracks after each scan."""
    from stonesoup.dataassociator.probability import JPDAwithEHM2
    from stonesoup.functions import gm_reduce_single
    from stonesoup.types.array import StateVectors
    from stonesoup.types.update import GaussianStateUpdate

    each = [parts(job, i) for i in range(len(job.std))]
    associators, tracks = [JPDAwithEHM2(p.hypothesiser) for p in each], set()
    for i, (at, scan) in zip(job.sensor, detections(job, scans), strict=True):
        p, taken = each[i], set()
        for track, hypotheses in associators[i].associate(tracks, scan, at).items():
            states = [p.updater.update(h) if h else h.prediction for h in hypotheses]
            means = StateVectors([x.state_vector for x in states])
            covariances = np.stack([x.covar for x in states], axis=2)
            weights = np.array([float(h.probability) for h in hypotheses])
            mean, covariance = gm_reduce_single(means, covariances, weights)
            found = {h.measurement for h in hypotheses if h}
            none = next(h.prediction for h in hypotheses if not h)
            track.append(GaussianStateUpdate(mean, covariance, hypotheses, at) if found else none)
            taken |= found
        tracks -= p.deleter.delete_tracks(tracks)
        tracks |= p.initiator.initiate(scan - taken, at)
        yield tracks


def mfa(job: Job, scans: np.ndarray) -> Iterator[set[Any]]:
    """Multiple hypotheses over a window of scans, chosen by multi-frame assignment."""
    from stonesoup.dataassociator.mfa import MFADataAssociator
    from stonesoup.hypothesiser.mfa import MFAHypothesiser
    from stonesoup.types.mixture import GaussianMixture
    from stonesoup.types.numeric import Probability
    from stonesoup.types.state import TaggedWeightedGaussianState
    from stonesoup.types.track import Track
    from stonesoup.types.update import GaussianMixtureUpdate

    p, tracks = parts(job), set()
    associator = MFADataAssociator(MFAHypothesiser(p.hypothesiser), slide_window=WINDOW)
    for at, scan in detections(job, scans):
        taken = set()
        for track, hypotheses in associator.associate(tracks, scan, at).items():
            components = [p.updater.update(h) if h else h.prediction for h in hypotheses]
            track.append(GaussianMixtureUpdate(hypothesis=hypotheses, components=components))
            best = max(hypotheses, key=lambda h: h.prediction.weight)
            track.metadata["misses"] = 0 if best else track.metadata["misses"] + 1
            taken |= {h.measurement for h in hypotheses if h}
        tracks = {track for track in tracks if track.metadata["misses"] < MISSES}
        for begun in p.initiator.initiate(scan - taken, at):
            one = TaggedWeightedGaussianState(
                begun.state_vector, begun.covar, timestamp=at, weight=Probability(1), tag=[0] * WINDOW
            )
            tracks.add(Track([GaussianMixture([one])], init_metadata={"misses": 0}))
        yield tracks


TRACKERS: dict[str, Callable[[Job, np.ndarray], Iterator[set[Any]]]] = {"jpda": jpda, "mfa": mfa, "sensors": sensors}


def positions(job: Job, run: int, name: str) -> tuple[np.ndarray, float]:
    """Positions ``(K, T, 2)`` of the tracks of a run, NaN where they do not exist, and the processor's seconds."""
    found: dict[str, np.ndarray] = {}
    scans = job.z[run]
    start = time.process_time()
    for k, tracks in enumerate(TRACKERS[name](job, scans)):
        for track in tracks:
            place = found.setdefault(track.id, np.full((len(scans), 2), np.nan))
            place[k] = np.asarray(best(track.state).state_vector, dtype=float)[[0, 2], 0]
    seconds = time.process_time() - start
    return np.array(list(found.values())).reshape(-1, len(scans), 2), seconds


def best(state: Any) -> Any:
    """A Gaussian, or the likeliest of a mixture of them."""
    return max(state.components, key=lambda c: c.weight) if hasattr(state, "components") else state


def main(name: str, job_file: str, tracks_file: str) -> int:
    """Tracks all runs of a job."""
    with np.load(job_file) as arrays:
        job = Job(**arrays)
    try:
        results = [positions(job, run, name) for run in range(len(job.z))]
    except ImportError as missing:
        print(json.dumps({"missing": str(missing)}))
        return 0
    np.savez(tracks_file, *(found for found, _ in results))
    print(json.dumps({"seconds": [seconds for _, seconds in results]}))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
