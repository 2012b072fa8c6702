"""Beside other libraries: the cells that are lost come first, and a filter of one's own joins."""

import json

import field
import numpy as np
import peers_field
import pytest
import torch
from learned import lorenz

from torchfra import Gaussian, presets
from torchfra.motion import WhiteJerk
from torchfra.sensors import Position, RangeBearing

OWN = '''
import numpy as np


def peer(job):
    """A Kalman filter of one motion, track by track, that leaves out what is missing."""

    def track(x, z):
        p, kept = job.p, []
        for z_k, f, q in zip(z, job.matrices[0], job.noises[0]):
            x, p = f @ x, f @ p @ f.T + q
            if not np.isnan(z_k).any():
                gain = p @ job.sensor.T @ np.linalg.inv(job.sensor @ p @ job.sensor.T + job.r)
                x, p = x + gain @ (z_k - job.sensor @ x), p - gain @ job.sensor @ p
            kept.append(x)
        return np.array(kept)

    return lambda: np.array([track(x, z) for x, z in zip(job.means, job.z)])
'''


@pytest.fixture
def alone(monkeypatch):
    """No other library is installed."""

    def missing(name, *arguments):
        if name.endswith(".py"):
            return started(name, *arguments)
        print(f"{name}: not installed")
        return None

    started = field.started
    monkeypatch.setattr(field, "started", missing)


@pytest.mark.slow
def test_a_filter_of_ones_own_joins_and_has_the_same_errors_where_models_hold(alone, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(field, "ROBUST", ["rsrckf"])
    own, results = tmp_path / "mine.py", tmp_path / "field.json"
    own.write_text(OWN)
    options = ["--quick", "--passes", "1", "--jobs", "gaps,spikes", "--own", str(own), "--json", str(results)]
    assert field.main(options) == 0
    said = capsys.readouterr().out
    assert "pykalman: not installed" in said
    cells = {(one["job"], one["measure"]): one for one in json.loads(results.read_text())["cells"]}
    assert cells["irregular times, 30 % missing", "error"]["ratio"] == pytest.approx(1.0, abs=1e-9)
    assert cells["spikes of 300 std", "error"]["ratio"] < 0.1  # it follows spikes
    assert [*cells["irregular times, 30 % missing", "time"]["theirs"]] == [str(own)]


def test_without_any_other_library_it_says_what_to_install(alone, capsys):
    assert field.main(["--quick", "--passes", "1", "--jobs", "gaps"]) == 2
    assert "expected another library that is installed" in capsys.readouterr().err


def test_cells_that_are_lost_come_first_and_are_red(tmp_path):
    cells = [
        field.cell("fast", "time", {"torchfra, srckf": 1.0, "other": 4.0, "slow": 9.0}),
        field.cell("lost", "error", {"torchfra, fra": 3.0, "torchfra, gpb": 2.5, "other": 1.0}),
    ]
    lines = field.table(cells).splitlines()
    assert lines[1].split() == ["lost", "error", "2.50", "gpb", "2.50", "m", "other", "1.00", "m"]
    assert lines[2].split()[:3] == ["fast", "time", "0.25"]
    field.draw(cells, tmp_path / "ratios.png")
    assert (tmp_path / "ratios.png").stat().st_size > 5000


@pytest.mark.slow
def test_a_published_filter_has_its_published_error_on_the_public_benchmark():
    truth, z, noise = field.manoeuvring_tracks(200, 0)
    start = Gaussian.from_std([2000.0, 10_000.0, 0.0, -15.0, 0.0, 0.0], [10.0, 10.0, 1.0, 1.0, 0.05, 0.05])
    estimate = presets.srckf(WhiteJerk(1e-4), Position(100.0))(z, start, dt=10.0, noise=noise)
    assert field.error_from_the_start(estimate, truth) == pytest.approx(
        field.PUBLISHED["forward"]["published: constant acceleration"], rel=0.01
    )


@pytest.mark.slow
def test_the_public_benchmark_has_filtered_and_smoothed_cells(capsys, monkeypatch):
    truth, z, noise = field.manoeuvring_tracks(2, 0)
    monkeypatch.setattr(field, "manoeuvring_tracks", lambda *_: (truth[:4], z[:, :4], noise[:, :4]))
    assert field.main(["--quick", "--jobs", "manoeuvring"]) == 0
    said = capsys.readouterr().out
    assert "public benchmark of manoeuvring targets, filtered" in said
    assert "public benchmark of manoeuvring targets, smoothed" in said


def test_what_is_not_linear_is_told_to_other_libraries_as_it_is():
    x = torch.tensor([3.0, -4.0, 5.0, 0.5], dtype=torch.float64)
    seen = RangeBearing((1.0, 0.1))(x)
    np.testing.assert_allclose(peers_field.MODELS["radar"].measure(x.numpy()), seen, rtol=1e-12)
    after = lorenz.Lorenz()(x[:3], torch.tensor(lorenz.DT, dtype=torch.float64))
    np.testing.assert_allclose(
        peers_field.MODELS["lorenz"].move(x[:3].numpy(), lorenz.DT * np.eye(3)), after, rtol=1e-12
    )
    west = np.array([[1.0, 3.1], [1.0, -3.1]])
    assert abs(peers_field.mean_direction(west, np.array([0.5, 0.5]))[1]) == pytest.approx(np.pi)
    assert peers_field.turned(west[0], west[1])[1] == pytest.approx(6.2 - 2 * np.pi)


def test_slopes_of_other_libraries_are_those_of_the_functions():
    slope = peers_field.jacobian(lambda x: np.array([x[0] ** 2, x[0] * x[1]]), np.array([3.0, -2.0]))
    np.testing.assert_allclose(slope, [[6.0, 0.0], [-2.0, 3.0]], atol=1e-8)
