"""Tracks of a lidar and of a Doppler radar, the OKF in plain torch, fits beside it, and the command."""

import itertools
import json
import math

import numpy as np
import okf
import pytest
import torch
from learned import lidar, radar
from learned.okf import LEAST, OKF, AnyNoise, Tracks, mse, optimised, prior, sampled

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
    """Means of one track of either sensor, by loops over the covariance form."""
    n = len(process)
    f, covariance, means = np.eye(n) + np.eye(n, k=n // 2), (1e3 if n == 4 else 1e6) * np.eye(n), []
    mean = np.array([*z[0], 0, 0]) if n == 4 else np.concatenate([z[0, :3], z[0, 3] * along(z[0])])
    for step, measured in enumerate(z):
        if step:
            mean, covariance = f @ mean, f @ covariance @ f.T + process
        h = np.eye(len(measured), n)
        if n == 6:
            h[3] = np.concatenate([np.zeros(3), along(measured)])
        gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + measurement)
        mean, covariance = mean + gain @ (measured - h @ mean), covariance - gain @ h @ covariance
        means.append(mean)
    return np.stack(means)


def along(z):
    """The direction of a position."""
    return z[:3] / np.sqrt((z[:3] ** 2).sum())


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


def test_a_turn_keeps_speed_and_height_rate_and_follows_an_arc():
    velocity = torch.tensor([[60.0, 80.0, -5.0]]).double()
    on, off = torch.tensor([True]), torch.tensor([False])
    place, after = radar.moved(torch.zeros(1, 3).double(), velocity, 25.0 * torch.ones(1), -torch.ones(1), on, off)
    rate = -25.0 / 100.0
    course = np.arctan2(80.0, 60.0) + rate * np.linspace(0, 1, 20001)
    np.testing.assert_allclose(after[0], [100 * np.cos(course[-1]), 100 * np.sin(course[-1]), -5.0])
    middle = (course[1:] + course[:-1]) / 2
    np.testing.assert_allclose(place[0], [100 * np.cos(middle).mean(), 100 * np.sin(middle).mean(), -5.0], rtol=1e-6)


def test_the_radar_has_the_noise_of_its_data_sheet():
    kind = radar.KINDS["const_v"]
    tracks, sensor = radar.simulate(kind, 400, 4), radar.sensor(kind)
    missed = sensor.difference(radar.after_first(kind, tracks), sensor(tracks.truth))
    far = tracks.truth[..., :2].norm(dim=-1) > 1000.0
    stds = missed[far & ~missed.isnan().any(-1)].std(0)
    np.testing.assert_allclose(stds, [*radar.NOISE, radar.DOPPLER], rtol=0.03)


def test_noise_is_turned_to_where_a_target_is():
    place, std = torch.tensor([[300.0, -800, 400]]).double(), torch.tensor(radar.NOISE, dtype=torch.float64)
    change = torch.autograd.functional.jacobian(radar.located, radar.polar(place)[0])
    torch.testing.assert_close(radar.turned(place, std)[0], change * std)


def test_a_believed_start_is_the_first_measurement_with_its_noise_and_the_velocities_of_samples():
    kind = radar.KINDS["const_v"]
    tracks = radar.simulate(kind, 600, 5)
    mean, root = radar.believed(kind, tracks, tracks)
    torch.testing.assert_close(mean[:, :3], tracks.z[:, 0, :3])
    noise = radar.turned(tracks.z[:, 0, :3], torch.tensor(radar.NOISE, dtype=torch.float64))
    torch.testing.assert_close((root @ root.mT)[:, :3, :3], noise @ noise.mT)
    off = (mean - tracks.truth[:, 0])[:, 3:]
    torch.testing.assert_close((root @ root.mT)[0, 3:, 3:], off.mT @ off / len(off))


def test_a_converted_measurement_has_noise_along_and_across_the_line_of_sight():
    z = torch.tensor([0.0, 2000.0, 0.0, 30.0]).double()
    root = radar.Converted().measurement_noise(z).root
    stds = [2000 * radar.NOISE[1], radar.NOISE[0], 2000 * radar.NOISE[2], radar.DOPPLER]
    torch.testing.assert_close(root @ root.mT, torch.tensor(stds).double().square().diag())


def test_sample_covariances_are_those_of_what_models_are_off(tracks):
    off, missed = [], []
    for truth, z in zip(tracks.truth, tracks.z, strict=True):
        states = lasting(truth)
        off += [b - [a[0] + a[2], a[1] + a[3], a[2], a[3]] for a, b in itertools.pairwise(states)]
        missed += list(z[: len(states)].numpy() - states[:, :2])
    process, measurement = sampled(tracks, lidar.MODEL)
    np.testing.assert_allclose(process, np.cov(np.array(off).T) + LEAST * np.eye(4), atol=1e-9)
    np.testing.assert_allclose(measurement, np.cov(np.array(missed).T) + LEAST * np.eye(2), atol=1e-9)


@pytest.mark.parametrize("kind", ["okf", "srckf"])
@pytest.mark.parametrize("problem", ["lidar", "radar"])
def test_the_filter_in_plain_torch_and_ours_are_the_kalman_filter(problem, kind, tracks):
    if problem == "radar":
        tracks = radar.simulate(radar.KINDS["free"], 12, 3)
    model = lidar.MODEL if problem == "lidar" else radar.MODEL
    process, measurement = sampled(tracks, model)
    with torch.no_grad():
        if kind == "okf":
            means = OKF(tracks, model)(tracks.z)
        else:
            sensor = lidar.AnyPosition(measurement) if problem == "lidar" else radar.AnyDoppler(measurement)
            f = presets.srckf(AnyNoise(process), sensor)
            u = None if problem == "lidar" else lambda x: radar.direction(x.z)
            task = okf.Task(lambda x: x.z, lambda x: prior(x, model), u or (lambda x: None))
            means = f(**task.of(f, tracks)).mean
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
    found = [optimised(OKF(tracks, lidar.MODEL), short, 0, together=together) for together in (True, False)]
    for a, b in zip(*(f.parameters() for f in found), strict=True):
        torch.testing.assert_close(a, b)


def test_what_adam_has_learned_has_smaller_errors(tracks):
    short = Tracks(tracks.truth[:, :12], tracks.z[:, :12])
    with torch.no_grad():
        before = float(mse(OKF(short, lidar.MODEL)(short.z), short))
    learned = optimised(OKF(short, lidar.MODEL), short, 0, epochs=4)
    assert float(mse(learned(short.z), short).detach()) < before


@pytest.mark.slow
def test_a_fit_of_the_same_filter_has_smaller_errors_than_sample_covariances():
    options = okf.argparse.Namespace(iterations=6, no_compile=False, seed=0)
    tracks, test, ways = lidar.simulate(24, 0), lidar.simulate(24, 1), okf.PROBLEMS["lidar"].ways
    with torch.no_grad():
        found, plain = (mse(ways[way](tracks, options)(test), test) for way in ("fit", "KF"))
    assert found < plain


def test_the_table_and_the_json_have_a_line_for_each_filter(tmp_path, capsys):
    out = tmp_path / "r.json"
    assert okf.main([*SMALL, "--filters", "OKF together,fit lidar", "--json", str(out)]) == 0
    found = json.loads(out.read_text())["found"]["lidar"]
    assert found.keys() == {"KF", "OKF together", "fit lidar"}
    assert all(draws[0].keys() == {"mse", "seconds"} for draws in found.values())
    printed = capsys.readouterr().out
    assert "| fit lidar" in printed
    assert "| OKF, published, KF 808 | 674 | 0.834 |" in printed
