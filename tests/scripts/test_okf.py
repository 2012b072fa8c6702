"""Tracks of a lidar, the OKF in plain torch, fits beside it, and the command."""

import itertools
import json
import math

import numpy as np
import okf
import pytest
import torch
from learned import lidar
from learned.okf import LEAST, OKF, AnyNoise, Tracks, mse, optimised, sampled

from torchfra import presets

SMALL = ["--draws", "1", "--tracks", "24", "--iterations", "1"]


@pytest.fixture(scope="module")
def tracks():
    return lidar.simulate(40, 3)


def lasting(truth):
    """The states of a track, as long as it lasts."""
    return truth[~truth.isnan().any(-1)].numpy()


def parts_of(states):
    """Steps of each part of a track, with the accelerations along the path and to the left."""
    found = []
    for before, after in itertools.pairwise(states):
        ahead = before[2:] / np.hypot(*before[2:])
        change = after[2:] - before[2:]
        np.testing.assert_allclose(after[:2] - before[:2], before[2:] + change / 2, atol=1e-9)
        found.append((round(change @ ahead, 6), round(change @ [-ahead[1], ahead[0]], 6)))
    return [(len(list(steps)), *acceleration) for acceleration, steps in itertools.groupby(found)]


def kalman(z, process, measurement):
    """Means of one track, by loops over the covariance form."""
    f, h, covariance, means = np.eye(4) + np.eye(4, k=2), np.eye(2, 4), 1e3 * np.eye(4), []
    mean = np.array([*z[0], 0, 0])
    for step, measured in enumerate(z):
        if step:
            mean, covariance = f @ mean, f @ covariance @ f.T + process
        gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + measurement)
        mean, covariance = mean + gain @ (measured - h @ mean), covariance - gain @ h @ covariance
        means.append(mean)
    return np.stack(means)


def test_targets_go_in_parts_of_constant_acceleration():
    along, across, counts = [], [], []
    for truth in lidar.simulate(200, 0).truth:
        parts = parts_of(lasting(truth))
        counts.append(len(parts))
        assert all(5 <= steps <= 8 for steps, *_ in parts)
        along += [a for _, a, _ in parts]
        across += [c for *_, c in parts]
    assert set(counts) == {4, 5, 6}
    assert np.std(along) == pytest.approx(lidar.ALONG, rel=0.1)
    assert 0.98 * lidar.ACROSS < np.abs(across).max() < lidar.ACROSS
    assert np.std(across) == pytest.approx(2 * lidar.ACROSS / math.sqrt(12), rel=0.1)


def test_ranges_and_bearings_have_the_noise_that_is_stated():
    tracks = lidar.simulate(400, 2)
    place, polar = tracks.truth[..., :2], lidar.polar(tracks.z)
    far = place.norm(dim=-1) > 50
    missed = torch.stack(
        [polar[..., 0] - place.norm(dim=-1), polar[..., 1] - torch.atan2(place[..., 0], place[..., 1])]
    )
    missed[1] = torch.remainder(missed[1] + math.pi, 2 * math.pi) - math.pi
    assert missed[0][far].std() == pytest.approx(lidar.RANGE, rel=0.03)
    assert missed[1][far].std() == pytest.approx(lidar.BEARING, rel=0.03)


def test_sample_covariances_are_those_of_what_models_are_off(tracks):
    off, missed = [], []
    for truth, z in zip(tracks.truth, tracks.z, strict=True):
        states = lasting(truth)
        off += [b - [a[0] + a[2], a[1] + a[3], a[2], a[3]] for a, b in itertools.pairwise(states)]
        missed += list(z[: len(states)].numpy() - states[:, :2])
    process, measurement = sampled(tracks)
    np.testing.assert_allclose(process, np.cov(np.array(off).T) + LEAST * np.eye(4), atol=1e-9)
    np.testing.assert_allclose(measurement, np.cov(np.array(missed).T) + LEAST * np.eye(2), atol=1e-9)


@pytest.mark.parametrize("kind", ["okf", "srckf"])
def test_the_filter_in_plain_torch_and_ours_are_the_kalman_filter(kind, tracks):
    process, measurement = sampled(tracks)
    with torch.no_grad():
        if kind == "okf":
            means = OKF(tracks)(tracks.z)
        else:
            f = presets.srckf(AnyNoise(process), lidar.AnyPosition(measurement))
            means = f(**okf.given(f, tracks.z, tracks)).mean
    for found, z in zip(means, tracks.z, strict=True):
        known = z[~z.isnan().any(-1)].numpy()
        wanted = kalman(known, process.numpy(), measurement.numpy())
        np.testing.assert_allclose(found[: len(known)], wanted, rtol=1e-9, atol=1e-5)


def test_the_error_is_the_mean_over_steps_of_all_tracks(tracks):
    squares = [
        ((state[:2] - measured) ** 2).sum()
        for truth, z in zip(tracks.truth, tracks.z, strict=True)
        for state, measured in zip(lasting(truth), z.numpy(), strict=False)
    ]
    assert float(mse(tracks.z, tracks)) == pytest.approx(np.mean(squares))


def test_tracks_of_a_batch_teach_the_same_together_and_one_at_a_time(tracks):
    short = Tracks(tracks.truth[:24, :6], tracks.z[:24, :6])
    found = [optimised(OKF(tracks), short, 0, together=together) for together in (True, False)]
    for a, b in zip(*(f.parameters() for f in found), strict=True):
        torch.testing.assert_close(a, b)


def test_what_adam_has_learned_has_smaller_errors(tracks):
    short = Tracks(tracks.truth[:, :12], tracks.z[:, :12])
    with torch.no_grad():
        before = float(mse(OKF(short)(short.z), short))
    learned = optimised(OKF(short), short, 0, epochs=4)
    assert float(mse(learned(short.z), short).detach()) < before


@pytest.mark.slow
def test_a_fit_of_the_same_filter_has_smaller_errors_than_sample_covariances():
    options = okf.argparse.Namespace(iterations=6, no_compile=False, seed=0)
    tracks, test, ways = lidar.simulate(24, 0), lidar.simulate(24, 1), okf.WAYS
    with torch.no_grad():
        found, plain = (mse(ways[way](tracks, options)(test), test) for way in ("fit", "KF"))
    assert found < plain


def test_the_table_and_the_json_have_a_line_for_each_filter(tmp_path, capsys):
    out = tmp_path / "r.json"
    assert okf.main([*SMALL, "--filters", "OKF together,fit lidar", "--json", str(out)]) == 0
    found = json.loads(out.read_text())["found"]
    assert found.keys() == {"KF", "OKF together", "fit lidar"}
    assert all(draws[0].keys() == {"mse", "seconds"} for draws in found.values())
    printed = capsys.readouterr().out
    assert "| fit lidar" in printed
    assert "| OKF, published, KF 808 | 674 | 0.834 |" in printed
