"""Doors for xarray, polars and scikit-learn: keypoints of animals are cleaned in the form in which they come."""

import sys
from importlib import import_module

import numpy as np
import pytest
import torch
from numbered_examples import load

import torchfra
from torchfra.adapters.points import noise_and_motion

FPS = 30


@pytest.fixture(scope="module")
def example():
    pytest.importorskip("xarray")
    return load("18_keypoints")


@pytest.fixture(scope="module")
def mice(example):
    return example.simulate(600, seed=1)


@pytest.fixture(scope="module")
def found(example, mice):
    pytest.importorskip("llvmlite")
    return example.poses.clean(mice[0], compile=True)


@pytest.mark.slow
def test_it_says_how_far_off_a_keypoint_may_be_and_which_were_wrong(mice, found):
    data, truth = mice
    assert found.position.dims == data.position.dims
    off = (found.position - truth) / found.position_std
    assert 0.7 < float((off**2).mean()) < 1.4
    wrong = (np.abs(data.position - truth) > 15).any("space")
    there = data.confidence >= 0.6
    assert float(found.outlier.where(wrong & there).mean()) > 0.9
    assert float(found.outlier.where(~wrong & there).mean()) < 0.05
    assert float((found.velocity - truth.differentiate("time")).std()) < 30


def test_points_are_measurements_of_filters_with_confidence_as_their_noise(example, mice):
    data, _ = mice
    points = example.poses.measurements(data)
    assert points.z.shape == (6, 600, 2)
    np.testing.assert_allclose(points.dt, 1 / FPS)
    sure = data.confidence.transpose("keypoints", "individuals", "time").to_numpy().reshape(6, 600)
    assert points.z[..., 0].isnan().numpy().tolist() == (sure < 0.6).tolist()
    kept = np.where(sure >= 0.6, sure, np.nan)
    expected = np.nan_to_num(np.nanquantile(kept, 0.5, 1, keepdims=True, method="lower") / kept, nan=1.0)
    np.testing.assert_allclose(points.factor[..., 0], expected)


def test_an_animal_that_is_not_there_stays_missing_and_moments_are_times(example, mice):
    import pandas as pd

    data, _ = mice
    data = data.copy(deep=True).isel(time=slice(0, 40))
    expected = example.poses.clean(data.isel(individuals=[0]), smooth=False)
    data.position[{"individuals": 1}] = np.nan
    data = data.assign_coords(time=pd.Timestamp("2026-01-01") + pd.to_timedelta(data.time.to_numpy(), unit="s"))
    found = example.poses.clean(data, smooth=False)
    assert found.position.isel(individuals=1).isnull().all()
    np.testing.assert_allclose(found.position.isel(individuals=[0]), expected.position, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.position, r"dataset: expected an xarray\.Dataset .* received DataArray"),
        (lambda d: d.rename(space="axis"), r"dataset: expected .* received position over time, axis, keypoints"),
        (lambda d: d.isel(time=slice(None, None, -1)), r"time: expected two frames or more in order of time"),
        (lambda d: d.isel(time=[0]), r"time: expected two frames or more in order of time, received 1"),
    ],
)
def test_what_are_no_poses_is_named(example, mice, change, message):
    with pytest.raises(ValueError, match=message):
        example.poses.measurements(change(mice[0]))


def test_cleaning_tracks_says_where_poses_are_cleaned(mice):
    with pytest.raises(ValueError, match=r"received Dataset: take torchfra\.adapters\.poses\.clean"):
        torchfra.clean(mice[0])


# ---------------------------------------------------------------- values


@pytest.mark.parametrize("std", [0.5, 2.0])
@pytest.mark.parametrize("q", [200.0, 5000.0])
def test_noise_and_motion_are_found_beside_outliers(std, q):
    rng = np.random.default_rng(0)
    v = np.cumsum(np.sqrt(q / FPS) * rng.normal(size=(3, 900, 2)), 1)
    z = np.cumsum(v / FPS, 1) + std * rng.normal(size=v.shape)
    z[rng.uniform(size=v.shape[:2]) < 0.05] += 100
    found_std, found_q = noise_and_motion(torch.from_numpy(z), 1 / FPS)
    assert (found_std / std).log().abs().max() < np.log(1.3)
    assert (found_q / q).log().abs().max() < np.log(2.0)


def test_a_point_that_rests_or_is_short_tells_no_noise():
    std, q = noise_and_motion(torch.stack([torch.ones(100, 2), torch.arange(200.0).reshape(100, 2)]).double(), 1.0)
    assert std.isnan().all()
    assert q.isnan().all()
    assert noise_and_motion(torch.randn(1, 8, 2).double(), 1.0)[0].isnan().all()


# ---------------------------------------------------------------- scikit-learn


@pytest.fixture
def scikit():
    pytest.importorskip("sklearn")
    from torchfra.adapters import scikit

    return scikit


def points(rows=60):
    rng = np.random.default_rng(0)
    truth = 40 * np.sin(np.arange(rows)[:, None] / FPS + np.arange(4))
    X = truth + rng.normal(size=(rows, 4))
    X[rng.uniform(size=rows) < 0.1, :2] += 50
    X[20:25, 2:] = np.nan
    return truth, X


@pytest.mark.slow
def test_an_estimator_of_scikit_learn_finds_values_and_smooths(scikit):
    from sklearn.base import clone

    truth, X = points()
    smoother = scikit.Smoother(period=1 / FPS)
    assert smoother.get_params() == {"dims": 2, "period": 1 / FPS, "std": None, "q": None, "smooth": True,
                                     "compile": False}  # fmt: skip
    found = clone(smoother).set_params(q=300.0).fit(X)
    assert np.abs(found.std_.numpy() - 1).max() < 0.3
    assert np.abs(found.transform(X) - truth).std() < 0.6
    assert found.score(X) > clone(smoother).set_params(std=5.0, q=300.0).fit(X).score(X)


@pytest.mark.slow
def test_it_is_a_part_of_a_pipeline(scikit):
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    _, X = points(60)
    pipeline = make_pipeline(StandardScaler(), scikit.Smoother(period=1 / FPS, smooth=False))
    assert np.isfinite(pipeline.fit_transform(X)).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s, X: s.fit(X[:, :3]), r"X: expected rows of 2 columns for each point, received \(60, 3\)"),
        (lambda s, X: s.fit(X).transform(X[:, :2]), r"X: expected 4 columns as in fit, received 2"),
        (lambda s, X: s.fit(X[:8]), r"X: expected points that move, .* to tell std, or std="),
        (lambda s, X: s.set_params(period=0).fit(X), r"period: expected a finite number above 0, received 0"),
    ],
)
def test_rows_that_do_not_fit_are_named(scikit, call, message):
    with pytest.raises(ValueError, match=message):
        call(scikit.Smoother(), points(60)[1])


# ---------------------------------------------------------------- polars


def test_a_table_of_polars_comes_back_cleaned_as_one_of_pandas():
    polars, pandas = pytest.importorskip("polars"), pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    rng, t = np.random.default_rng(0), np.arange(40.0)
    columns = {"time": t, "x": 5 * t + rng.normal(size=40), "y": rng.normal(size=40)}
    found = torchfra.clean(polars.DataFrame(columns))
    expected = torchfra.clean(pandas.DataFrame(columns))
    assert isinstance(found, polars.DataFrame)
    pandas.testing.assert_frame_equal(found.to_pandas(), expected, check_dtype=False)
    from torchfra.adapters import frames

    z, dt = frames.measurements(polars.DataFrame(columns), ["x", "y"], time="time")
    assert z.shape == (40, 2)
    assert dt.eq(1).all()


def test_who_has_not_installed_a_library_is_told_how(monkeypatch):
    for name in ("xarray", "sklearn"):
        monkeypatch.setitem(sys.modules, name, None)
        monkeypatch.setitem(sys.modules, f"{name}.base", None)
    for module, package in (("poses", "xarray"), ("scikit", "sklearn")):
        monkeypatch.delitem(sys.modules, f"torchfra.adapters.{module}", raising=False)
        with pytest.raises(ImportError, match=rf'needs the package {package}: pip install "torchfra\[frames\]"'):
            import_module(f"torchfra.adapters.{module}")
