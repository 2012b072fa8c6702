"""Metrics that are accumulated batch by batch are those of all tracks at once."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra import Gaussian, presets
from torchfra.evaluation import evaluate
from torchfra.evaluation.running_metrics import RunningMedian, RunningMetrics
from torchfra.metrics import nees
from torchfra.motion import ConstantAcceleration
from torchfra.scenarios import bearings_outliers
from torchfra.sensors import Position
from torchfra.types import Estimate


@given(st.lists(st.floats(0, 1e12), min_size=1, max_size=60), st.integers(0, 60))
@settings(deadline=None, max_examples=50)
def test_a_running_median_is_the_median_to_a_thousandth(values, cut):
    median = RunningMedian()
    tensor = torch.tensor(values, dtype=torch.float64)
    median.add(tensor[:cut])
    median.add(tensor[cut:])
    low, high = np.quantile(values, 0.5, method="lower"), np.quantile(values, 0.5, method="higher")
    assert low * (1 - 1e-3) - 1e-300 <= median() <= high * (1 + 1e-3) + 1e-300


def test_nan_does_not_count_and_infinity_does():
    median = RunningMedian()
    assert np.isnan(median())
    median.add(torch.tensor([1.0, torch.nan, torch.nan, torch.nan]))
    assert median() == pytest.approx(1.0, rel=1e-3)
    median.add(torch.tensor([torch.inf, torch.inf]))
    assert median() == torch.inf


def random_tracks(runs, seed):
    g = torch.Generator().manual_seed(seed)
    truth = 100 * torch.randn(runs, 9, 4, dtype=torch.float64, generator=g)
    mean = truth + torch.randn(runs, 9, 4, dtype=torch.float64, generator=g)
    truth[0, 5:] = torch.nan
    mean[1, 3:] = torch.nan
    root = torch.eye(4, dtype=torch.float64).expand(runs, 9, 4, 4)
    return Estimate(mean, root, mean[..., 0], mean[..., 0], None), truth


def test_metrics_are_what_numpy_computes_of_all_tracks():
    parts = [random_tracks(runs, seed) for seed, runs in enumerate((3, 50, 7))]
    one, two = (RunningMetrics({"position": slice(0, 2), "velocity": slice(2, 4)}) for _ in range(2))
    for metrics, (estimate, truth) in zip((one, two, one), parts, strict=True):
        metrics.add(estimate, truth, 1.0)
    one.merge(two)
    summary = one.summary(limit=2.0)
    mean, truth = (np.concatenate(x) for x in ([p[0].mean.numpy() for p in parts], [p[1].numpy() for p in parts]))
    order = np.r_[0:3, 53:60, 3:53]  # merged last
    error = np.sqrt(((mean - truth)[order, :, :2] ** 2).sum(-1))
    error[np.isnan(error) & ~np.isnan(truth[order, :, 0])] = np.inf
    np.testing.assert_allclose(summary["rmse_position"], np.sqrt(np.nanmean(error**2, 0)))
    gap = np.where(np.isnan(mean) & ~np.isnan(truth), np.inf, mean - truth)
    for i, axis in enumerate("xy"):
        np.testing.assert_allclose(summary[f"mean_error_{axis}"], np.nanmean(gap[..., i], 0), atol=1e-12)
        np.testing.assert_allclose(summary[f"rmse_{axis}"], np.sqrt(np.nanmean(gap[..., i] ** 2, 0)))
        share = np.abs(gap[..., i]) / np.maximum(np.abs(truth[..., i]), 100)
        np.testing.assert_allclose(summary[f"mape_{axis}"], 100 * np.nanmean(share, 0))
    track_rmse = np.sqrt(np.nanmean(error**2, 1))
    assert summary["divergence_rate"] == (track_rmse > 2).mean()
    assert summary["worst_track"] == np.inf
    assert summary["median_error_position"] == pytest.approx(np.nanmedian(error), rel=5e-2)
    assert summary["median_track_rmse"] == pytest.approx(np.quantile(track_rmse, 0.5, method="lower"))
    assert one.seconds == 3.0


def test_memory_is_one_number_for_each_metric_and_track_however_many_steps():
    metrics = RunningMetrics({"position": slice(0, 2), "velocity": slice(2, 4)})
    for seed in range(3):
        estimate, truth = random_tracks(20, seed)
        metrics.add(estimate, truth, 0.0, truth[..., :2])
    assert sum(x.numel() for x in metrics.sums.values()) == (8 + 3 * 2) * 9  # of them three by coordinate
    assert {name: len(metrics.runs(name)) for name in metrics.of_runs} == dict.fromkeys(
        ("rmse_position", "rmse_velocity", "nees", "nis", "log_likelihood"), 60
    )


@pytest.mark.slow
def test_chunks_leave_the_figures():
    scenario = bearings_outliers("std", initial="truth")
    at_once = evaluate(scenario, ["srckf"], runs=30)["srckf"]
    for options in ({"chunk": 7}, {"compile": True}):
        part = evaluate(scenario, ["srckf"], runs=30, **options)["srckf"]
        for key in at_once.keys() - {"microseconds", "relative_time"}:
            assert part[key] == pytest.approx(at_once[key], rel=1e-9), key


def test_errors_of_a_singular_covariance_are_those_of_its_span_or_ruled_out():
    """The limit of covariances that are not singular; the acceleration of a target is certain to three fixed gains."""
    root = torch.tensor([[2.0, 0, 0], [1.0, 0, 0], [0, 0, 0.5]]).double()
    errors = torch.tensor([[2.0, 1.0, 0.5], [2.0, 1.5, 0.5], [torch.nan, 1.0, 0.5]]).double()
    estimate = Estimate(errors, root.expand(3, 3, 3), errors[:, 0], errors[:, 0], None)
    found = nees(estimate, torch.zeros(3, 3).double())
    assert found[:2].tolist() == [2.0, torch.inf]
    assert found[2].isnan()
    least = root @ root.mT + 1e-9 * torch.eye(3).double()
    limit = errors[0] @ torch.linalg.solve(least, errors[0])
    torch.testing.assert_close(found[0], limit, rtol=1e-6, atol=0.0)
    three = presets.alphabeta(ConstantAcceleration(1.0), Position(2.0))
    z, prior = torch.zeros(8, 2).double(), Gaussian(torch.zeros(6).double(), 10 * torch.eye(6).double())
    estimate = three(z, prior)
    still, moving = torch.zeros(8, 6).double(), torch.ones(8, 6).double()
    assert nees(estimate, still).tolist() == [0.0] * 8
    certain = estimate.scale_tril[:, 4, 4] == 0
    assert certain.any()
    assert torch.equal(nees(estimate, moving).isinf(), certain)
