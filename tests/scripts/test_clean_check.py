"""The judge of cleaned tracks counts right, and what it compares with is what it says."""

import json
import math

import clean_check
import numpy as np
import pytest
from cleaning import bounds, figures, measured, truths
from cleaning.constant_velocity import best, smoothed
from cleaning.figures import Counts, lasting, turn_rates
from cleaning.measured import Case, Measured

from torchfra.cleaning import Cleaned, Found, Segment
from torchfra.readers import samples

FOUND = Found("told", True, "told", 2.0, 1.0, 1.0)
FEW = ["--kinds", "ships", "--flights", "2", "--steps", "60", "--periods", "5", "--noises", "15", "--runs", "2"]


def circle(rate: float = 3.0, speed: float = 50.0, seconds: int = 120) -> truths.Truth:
    """A circle to the left, of which ``rate`` deg/s are flown."""
    angle = np.radians(rate) * np.arange(seconds + 1)
    radius = speed / np.radians(rate)
    return truths.Truth("ships", "circle", 1.0, radius * np.stack([np.sin(angle), -np.cos(angle)], 1))


def run_of(truth: truths.Truth, period: float = 1.0, noise: float = 2.0) -> Measured:
    window = truth.window(period, 1000)
    shape = len(window), truth.position.shape[1]
    return Measured(Case(truth, period, noise), window, np.ones(shape), np.zeros(shape))


def cleaned_of(run: Measured, error: np.ndarray, std: float = 1.0, segments=(), outliers=()) -> Cleaned:
    """What would have been cleaned: these errors of the position, and these fixes flagged."""
    steps, d = run.truth.shape
    mean = np.concatenate([run.truth + error, np.zeros_like(run.truth)], 1)
    covariance = np.broadcast_to(std**2 * np.eye(2 * d), (steps, 2 * d, 2 * d))
    flag = np.where(np.isin(np.arange(steps), outliers), "outlier", "")
    nothing = np.full(steps, np.nan)
    return Cleaned(run.recording(), run.time, np.arange(steps), run.recording().position, mean, covariance, nothing,
                   nothing, nothing, flag, FOUND, tuple(segments))  # fmt: skip


# ---------------------------------------------------------------- counts


def test_errors_and_bands_are_counted_by_hand():
    run = run_of(circle(seconds=99))
    error = np.zeros((100, 2))
    error[:40, 0] = 1.5  # of 200 coordinates 40 are 1.5 standard deviations off, and 10 are 3
    error[:10, 1] = 3.0
    counts = Counts()
    figures.add(counts, run, cleaned_of(run, error))
    assert counts.squared == pytest.approx(40 * 1.5**2 + 10 * 9)
    assert counts.raw == pytest.approx(200.0)
    shares = figures.shares(counts)
    assert (shares["band_68"], shares["band_95"]) == (150 / 200, 190 / 200)
    assert counts.sigma == [1.0]


def test_outliers_are_counted_beyond_six_sigma_where_found_and_all_where_flagged():
    run = run_of(circle(seconds=99))
    run.offset[[3, 4, 50]] = [20.0, 0.0]  # 10 sigma
    run.offset[70] = [8.0, 0.0]  # 4 sigma: need not be found, and is no false alarm
    counts = Counts()
    figures.add(counts, run, cleaned_of(run, np.zeros((100, 2)), outliers=[3, 4, 70, 90]))
    shares = figures.shares(counts)
    assert shares["outlier_recall"] == 2 / 3
    assert shares["outlier_precision"] == 3 / 4
    assert counts.fixes == 96


def test_an_estimate_that_is_not_finite_is_a_failed_run_and_far_off():
    run = run_of(circle(seconds=99))
    error = np.zeros((100, 2))
    error[7] = np.nan
    counts = Counts()
    figures.add(counts, run, cleaned_of(run, error))
    assert counts.failed == 1
    assert counts.squared == pytest.approx(2e12)


def test_turns_are_counted_in_seconds_to_their_side():
    run = run_of(circle(seconds=120))
    segments = [Segment(0.0, 59.0, "left turn", 3.0), Segment(80.0, 119.0, "right turn", -3.0),
                Segment(70.0, 75.0, "left turn", 3.0)]  # fmt: skip
    counts = Counts()
    figures.add(counts, run, cleaned_of(run, np.zeros((121, 2)), segments=segments))
    assert counts.turning == 121
    assert counts.met == 60 + 6  # a short one meets a turn, and is not asked whether it is one
    assert counts.listed == 60 + 40
    assert counts.true == 60


def test_only_what_turns_long_and_hard_enough_is_a_turn():
    on = np.array([1, 1, 0, 1, 1, 1, 0, 1], bool)
    assert lasting(on, 3).tolist() == [False, False, False, True, True, True, False, False]
    np.testing.assert_allclose(turn_rates(circle(4.0).position, 1.0, 1.0)[2:-2], 4.0, rtol=1e-3)
    assert not turn_rates(circle(4.0, speed=0.5).position, 1.0, 1.0).any()


# ---------------------------------------------------------------- what to beat


def test_the_smoother_of_constant_velocity_is_the_mean_given_all_measurements():
    rng, dt, sigma, q, steps = np.random.default_rng(0), 2.0, 3.0, 0.5, 12
    z, good = 10 * rng.standard_normal((steps, 2)), np.ones(steps, bool)
    good[[4, 5]] = False
    f = np.array([[1.0, dt], [0.0, 1.0]])
    noise = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    prior, powers = np.diag([1e4 * sigma**2, 1e6]), [np.linalg.matrix_power(f, k) for k in range(steps)]
    covariance = np.zeros((2 * steps, 2 * steps))
    for i in range(steps):
        for j in range(steps):
            both = powers[i] @ prior @ powers[j].T
            both = both + sum(powers[i - k] @ noise @ powers[j - k].T for k in range(1, min(i, j) + 1))
            covariance[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = both
    h = np.eye(2 * steps)[0::2][good]
    gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + sigma**2 * np.eye(len(h)))
    expected = (gain @ (z[good] - z[0]))[0::2] + z[0]
    np.testing.assert_allclose(smoothed(z, good, dt, sigma, np.array([q, 2 * q]))[0], expected, atol=1e-6)


def test_the_best_density_is_the_one_that_errs_least():
    rng = np.random.default_rng(1)
    truth = np.cumsum(np.cumsum(0.3 * rng.standard_normal((200, 2)), 0), 0)
    z = truth + 5 * rng.standard_normal((4, 200, 2))
    good = rng.random((4, 200)) < 0.9
    error, there, q = best(z, good, 1.0, 5.0, truth)
    for other in (q / 10, q, 10 * q):
        smooth = smoothed(z, good, 1.0, 5.0, np.array([other]))[0]
        assert math.sqrt(np.square(smooth - truth).sum(-1).mean()) >= error * (1 - 1e-12)
        if other == q:
            assert math.sqrt(np.square(smooth - truth).sum(-1)[good].mean()) == pytest.approx(there)
    assert error < 0.7 * math.sqrt(2) * 5


# ---------------------------------------------------------------- truths and what is measured of them


def test_three_in_a_hundred_fixes_are_outliers_of_every_size_and_some_come_in_bursts():
    truth = truths.Truth("ships", "still", 1.0, np.zeros((20_000, 2)))
    run = measured.measured(Case(truth, 1.0, 3.0), 20_000, 0)
    size = np.linalg.norm(run.offset, axis=1)[run.outlier]
    assert run.outlier.mean() == pytest.approx(0.03, abs=0.004)
    assert 100 <= size.min() < 150
    assert 7000 < size.max() <= 10_000
    both = (run.outlier[1:] & run.outlier[:-1]).sum() / run.outlier.sum()
    assert 0.25 < both < 0.5
    same = run.outlier[1:] & (run.offset[1:] == run.offset[:-1]).all(1)
    assert 0.1 < same.sum() / run.outlier.sum() < 0.25
    assert run.noise.std() == pytest.approx(3.0, rel=0.02)


def test_a_case_is_the_same_whichever_others_run_beside_it():
    case = Case(circle(), 1.0, 3.0)
    first, again, other = (measured.measured(case, 100, seed) for seed in (0, 0, 1))
    assert np.array_equal(first.recording().position, again.recording().position)
    assert not np.array_equal(first.recording().position, other.recording().position)


@pytest.mark.parametrize("kind", truths.HARDER)
def test_harder_kinds_have_the_errors_that_they_are_named_for(kind):
    truth = truths.truths([kind], 1)[-1]
    run = measured.measured(Case(truth, 1.0, 3.0), 600, 0)
    assert np.isfinite(run.recording().position).all()
    if kind == "late":
        ahead = np.gradient(run.truth, axis=0)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        along, across = (run.noise * ahead).sum(1), run.noise[:, 0] * ahead[:, 1] - run.noise[:, 1] * ahead[:, 0]
        assert across.std() == pytest.approx(3.0, rel=0.1)
        assert along.std() > 1.5 * across.std()
    if kind == "lasting":
        kept = (run.noise[1:] * run.noise[:-1]).mean() / np.square(run.noise).mean()
        assert kept == pytest.approx(math.exp(-1 / 20.0), abs=0.03)
    if kind == "slow":  # 40 s, as large as the white noise
        kept = (run.noise[1:] * run.noise[:-1]).mean() / np.square(run.noise).mean()
        assert kept == pytest.approx(math.exp(-1 / 40.0) / 2, abs=0.15)
    if kind == "heights":
        steps = (run.truth + run.noise)[:, 2] / (25 * 0.3048)
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
        assert 0.05 < run.recording().filled.mean() < 0.15
    if kind == "animals":
        assert run.recording().source.word == "animal"
        assert np.diff(run.time) == pytest.approx(1440.0)
        assert run.noise.std() == pytest.approx(100.0, rel=0.1)
        assert 0.2 < np.linalg.norm(np.diff(run.truth, axis=0), axis=1).mean() / 1440.0 < 0.8
    if kind == "rare":  # an animal: it rests, and forages at 0.6 m/s at most
        assert np.diff(run.time) == pytest.approx(360.0)
        speed = np.linalg.norm(np.diff(run.truth, axis=0), axis=1) / 360.0
        assert 0.1 < (speed == 0).mean() < 0.9
        assert 0.3 < speed.max() <= 0.6
    if kind == "bursts":
        np.testing.assert_allclose(np.diff(run.time)[:6], [4.0, 4.0, 3592.0] * 2)
    if kind == "gaps":
        assert len(run.time) == 200
        np.testing.assert_allclose(np.diff(run.time)[:40], [*[3.0] * 39, 3483.0])


def test_slow_errors_are_those_of_every_target_at_every_time_and_size():
    every = truths.truths(["slow"], 1)
    assert len(every) == 5 * len(truths.SLOW)
    assert sum(truth.plain for truth in every) == 5


def test_a_recorded_flight_is_moved_little_to_make_it_smooth():
    samples("calibration")
    (truth,) = truths.truths(["calibration"], 1)
    assert truth.position.shape == (6001, 3)
    assert 0 < truth.moved < 10
    acceleration = np.diff(truth.position[:, :2], n=2, axis=0)
    assert np.linalg.norm(acceleration, axis=1).max() < 12
    assert np.linalg.norm(np.diff(acceleration, axis=0), axis=1).max() < 6


# ---------------------------------------------------------------- the command


@pytest.mark.slow
@pytest.mark.usefixtures("rough_figures")
def test_a_small_run_prints_both_tables_and_writes_json_and_a_picture(tmp_path, capsys):
    files = ["--json", str(tmp_path / "c.json"), "--plot", str(tmp_path / "c.png")]
    assert clean_check.main([*FEW, "--cases", *files]) == 0
    out = capsys.readouterr().out
    assert "ships/ships-0 5 s 15 m" in out
    assert "error over the best constant velocity's" in out
    assert (tmp_path / "c.png").stat().st_size > 10_000
    result = json.loads((tmp_path / "c.json").read_text())
    assert [case["case"] for case in result["cases"]] == [f"ships/ships-{i} 5 s 15 m" for i in range(2)]
    for case in result["cases"]:
        assert case["failed"] == 0
        assert case["runs"] == 2
        assert case["steps"] == 60
    assert {bound["bound"] for bound in result["bounds"]} >= {"sigma found over true", "68 % band"}


def test_a_bound_holds_in_as_many_cases_as_are_within_it():
    case = {bound.figure: 1.0 for bound in bounds.bounds(5.0)} | {"period": 5.0, "failed": 0}
    counts = dict.fromkeys([name for pair in figures.SHARES.values() for name in pair], 100)
    ratios = ((0.5, 100), (0.7, 100), (0.9, 80))
    cases = [case | {"case": f"{i}", "of_raw": ratio, "of_best": 1.05, "turn_recall": met / 100,
                     "counts": counts | {"met": met}} for i, (ratio, met) in enumerate(ratios)]  # fmt: skip
    found = {of["bound"]: of for of in bounds.verdicts(cases)}
    raw, turns = found["error over that of the raw fixes"], found["recall of turns"]
    assert (raw["high"], raw["held"], raw["cases"], raw["passed"]) == (0.8, 2, 3, False)
    assert (raw["median"], raw["worst"], raw["worst_case"]) == (0.7, 0.9, "2")
    assert found["error over the best constant velocity's"]["passed"]
    assert not found["the same, median"]["passed"]
    assert (turns["held"], turns["all"], turns["passed"]) == (2, pytest.approx(280 / 300), True)
