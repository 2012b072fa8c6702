"""The jobs that other libraries are timed on are those of the filters here, and they find the same."""

import numpy as np
import pytest
from benchmarks import elsewhere
from benchmarks.linear import long_tracks
from peers import Job, bearings, covariances

from torchfra import presets, scenarios
from torchfra.evaluation import run

LINEAR = {"plane": scenarios.as_stated(steps=30), **long_tracks(steps=30)}
BEARINGS = scenarios.bearings_outliers(initial="truth")
APART = {"dynamax": 1e-2, "pykalman": 1.0, "stonesoup": 1.0}
"""m: 1e-9 on each innovation covariance; other points; means of angles on the circle."""


def ends(scenario, tracks):
    """Last means of ``srckf``, ``(B, n)``."""
    return run(presets.srckf(scenario.motion, scenario.sensor), scenario, tracks).mean[:, -1].detach().numpy()


def cubature(job, expected):
    """Last means ``(B, n)`` by a cubature Kalman filter in covariance form: ``expected(x, k)`` of a state at a step."""
    q, r, start = covariances(job)
    n, last = len(job.matrix), []
    for x, track in zip(job.means, job.z, strict=True):
        p = start
        for k, z in enumerate(track):
            x, p = job.matrix @ x, job.matrix @ p @ job.matrix.T + q
            away = np.sqrt(n) * np.linalg.cholesky(p)
            away = np.hstack([away, -away])
            seen = np.stack([expected(x + a, k) for a in away.T], 1)
            centre = seen.mean(1)
            spread = seen - centre[:, None]
            s, cross = spread @ spread.T / (2 * n) + r, away @ spread.T / (2 * n)
            gain = cross @ np.linalg.inv(s)
            x, p = x + gain @ (z - centre), p - gain @ s @ gain.T
        last.append(x)
    return np.array(last)


@pytest.mark.parametrize("name", LINEAR)
def test_the_linear_jobs_are_those_of_the_filter(name):
    scenario = LINEAR[name]
    tracks = scenario.simulate(2, 0)
    job = Job(**elsewhere.job_arrays(scenario, tracks))
    np.testing.assert_allclose(cubature(job, lambda x, k: job.sensor @ x), ends(scenario, tracks), rtol=1e-7, atol=1e-7)


def test_the_job_of_bearings_is_that_of_the_filter():
    tracks = BEARINGS.simulate(2, 0)
    job = Job(**elsewhere.job_arrays(BEARINGS, tracks))
    last = cubature(job, lambda x, k: bearings(x, job.u[k]))
    np.testing.assert_allclose(last, ends(BEARINGS, tracks), rtol=1e-7, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "name"),
    [(LINEAR["plane"], name) for name in elsewhere.LINEAR] + [(BEARINGS, n) for n in elsewhere.PEERS],
)
def test_others_end_where_the_filter_does(scenario, name, monkeypatch, capsys):
    """In so far as they are installed."""
    for listed in ("LINEAR", "PEERS"):
        labels = getattr(elsewhere, listed)
        monkeypatch.setattr(elsewhere, listed, {name: labels[name]} if name in labels else {})
    for skipped in ("IN_TURN", "AT_ONCE"):
        monkeypatch.setattr(elsewhere, skipped, ())
    tracks = scenario.simulate(3, 0)
    with elsewhere.start_peers(scenario, tracks) as peers:
        if not peers:
            pytest.skip(capsys.readouterr().out)
        (peer,) = peers.values()
        last = peer.means()
    np.testing.assert_allclose(
        last[:, :2], ends(scenario, tracks)[:, :2], rtol=0, atol=APART.get(name, 1e-7) if scenario is BEARINGS else 1e-7
    )
