"""A recording whose time stamps are off becomes a track of possible speeds, while its path and its turns stay."""

import gzip
import json

import numpy as np
import pytest

from torchfra import readers, scenarios
from torchfra.readers import Recording, flyable, read, resample
from torchfra.readers.smoothing import differences, smoothed, solve

RADIUS, PERIOD = 90.0, 22.0
SPEED = 2 * np.pi * RADIUS / PERIOD


def flown(t):
    """A glider: 120 s straight on, ten circles, straight on."""
    t = np.asarray(t)
    circling = np.clip(t - 120, 0, 10 * PERIOD)
    angle = 2 * np.pi * circling / PERIOD
    along = SPEED * (np.minimum(t - 120, 0) + np.maximum(t - 120 - 10 * PERIOD, 0))
    return np.stack([along + RADIUS * np.sin(angle), RADIUS * (1 - np.cos(angle))], 1)


def recording(time, position):
    return Recording("a", np.asarray(time, float), np.asarray(position, float), None, {})


def jittered(most=2.0, step=3.0, seed=0):
    """A fix every ``step`` seconds, each taken up to ``most`` seconds before or after its stamp."""
    time = np.arange(0.0, 460.0, step)
    return recording(time, flown(time + np.random.default_rng(seed).uniform(-most, most, len(time))))


def acceleration(time, position):
    before, after = np.diff(time)[:-1, None], np.diff(time)[1:, None]
    moved = np.diff(position[:, :2], axis=0)
    return np.linalg.norm((moved[1:] / after - moved[:-1] / before) * 2 / (before + after), axis=1)


def on_grid(recordings, dt=5.0):
    """Accelerations at regular steps, as a scenario has them."""
    pieces = [piece for r in recordings for piece in resample(r, dt, max_gap=30)]
    return np.concatenate([acceleration(*piece) for piece in pieces])


def rmse(recording):
    ((time, position),) = resample(recording, 1.0, max_gap=30)
    return np.sqrt(((position - flown(time)) ** 2).sum(1).mean())


# ---------------------------------------------------------------- tracks whose truth is known


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("most", [1.0, 2.0, 3.0])
def test_the_mended_track_is_nearer_to_the_truth(most, seed):
    raw = jittered(most, seed=seed)
    (mended,) = flyable(raw)
    assert rmse(mended) < 0.8 * rmse(raw)
    assert acceleration(raw.time, raw.position).max() > 9.4
    assert acceleration(mended.time, mended.position).max() < 9.1


def test_circles_keep_their_radius():
    (mended,) = flyable(jittered())
    circling = (mended.time > 130) & (mended.time < 110 + 10 * PERIOD)
    radius = np.linalg.norm(mended.position[circling] - [0, RADIUS], axis=1)
    assert radius.mean() == pytest.approx(RADIUS, rel=0.02)


@pytest.mark.parametrize("step", [1.0, 3.0, 5.0])
def test_a_track_that_can_be_flown_stays_as_it_is(step):
    clean = jittered(0.0, step)
    (same,) = flyable(clean)
    assert np.isin(clean.time, same.time).all()
    moved = same.position[np.isin(same.time, clean.time)] - clean.position
    assert np.abs(moved).max() < 0.05


@pytest.mark.parametrize("seed", range(20))
def test_times_increase_and_positions_move_by_no_more_than_the_seconds_allowed(seed):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.choice([1.0, 2.0, 5.0, 9.0, 20.0], 60))
    raw = recording(time, np.outer(np.maximum.accumulate(60 * (time - rng.uniform(0, 4, 60))), [0.6, 0.8, 0.1]))
    raw = recording(time[1:][np.diff(raw.position[:, 0]) > 0], raw.position[1:][np.diff(raw.position[:, 0]) > 0])
    pieces = flyable(raw, seconds=2.0, limit=1e3)
    assert pieces
    for piece in pieces:
        assert (np.diff(piece.time) > 0).all()
        assert raw.time[0] <= piece.time[0] < piece.time[-1] <= raw.time[-1]
        far, near = (np.interp(piece.time + s, raw.time, raw.position[:, 0]) for s in (2.0, -2.0))
        inside = (piece.time > raw.time[0] + 2) & (piece.time < raw.time[-1] - 2)
        assert (piece.position[inside, 0] < far[inside] + 0.1).all()
        assert (piece.position[inside, 0] > near[inside] - 0.1).all()
        # Heights follow the path, and the path is straight.
        np.testing.assert_allclose(piece.position, np.outer(piece.position[:, 0] / 0.6, [0.6, 0.8, 0.1]), atol=1e-3)


def test_a_corner_is_rounded_until_it_can_be_flown():
    time = 5.0 * np.arange(61)
    track = np.stack([100 * np.minimum(time, 150), 100 * np.maximum(time - 150, 0)], 1)
    (mended,) = flyable(recording(time, track), limit=6.0)
    sizes = acceleration(mended.time, mended.position)
    assert 5.5 < sizes.max() < 6.1
    assert acceleration(time, track).max() > 20
    np.testing.assert_allclose(mended.position[:15], track[:15], atol=1.0)


# ---------------------------------------------------------------- what no time stamp explains


def test_a_jump_splits_the_track_as_a_gap_does():
    time = np.append(5.0 * np.arange(40), 5.0 * np.arange(60, 100))
    track = np.outer(40 * time, [1.0, 0.0])
    track[20:, 1] += 3000
    pieces = flyable(recording(time, track))
    assert [len(piece.time) for piece in pieces] == [20, 20, 40]
    np.testing.assert_allclose(np.concatenate([piece.position for piece in pieces]), track, atol=0.05)


def test_a_fix_that_another_has_overtaken_is_dropped_and_counted():
    time = 5.0 * np.arange(40)
    track = np.outer(80 * time, [1.0, 0.0])
    track[20] = track[17] + [100.0, 0.0]
    (mended,) = flyable(recording(time, track))
    assert mended.repairs == {"fixes out of order dropped": 1}
    assert np.abs(mended.position[:, 0] - 80 * mended.time).max() < 100


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_fixes_are_no_trouble(count):
    time = 5.0 * np.arange(count)
    pieces = flyable(recording(time, np.outer(time, [30.0, 40.0])))
    assert [len(piece.time) for piece in pieces] == ([] if count == 1 else [count])


@pytest.mark.parametrize("name", ["max_gap", "seconds", "along", "limit"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_what_is_not_above_zero_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}: expected a value above 0, received {value}"):
        flyable(jittered(), **{name: value})


# ---------------------------------------------------------------- recorded flights


@pytest.mark.slow
@pytest.mark.parametrize(("group", "name", "most"), [("calibration", "bornholm", 0.5), ("gliders", "danube", 0.95)])
def test_recorded_flights_can_be_flown_and_their_speed_is_nearer_to_what_the_aircraft_said(group, name, most):
    file = next(file for file in readers.samples(group) if file.name.startswith(name))
    (raw,) = read(file)
    told = {row["timestamp"] / 1e3: row["groundspeed"] for row in json.loads(gzip.decompress(file.read_bytes()))}
    mended = flyable(raw)
    assert on_grid([raw]).max() > 20
    assert on_grid(mended).max() < 12
    assert np.quantile(on_grid(mended), 0.999) < 9.4

    def speed_error(pieces):
        errors = []
        for time, position in pieces:
            speed = np.linalg.norm(np.gradient(position[:, :2], time, axis=0), axis=1)
            errors.append(speed - [(told.get(t) or np.nan) * 1852 / 3600 for t in time])
        return np.nanmean(np.abs(np.concatenate(errors)))

    breaks = np.flatnonzero(np.diff(raw.time) > 30) + 1
    parts = zip(np.split(raw.time, breaks), np.split(raw.position, breaks), strict=True)
    before = speed_error([part for part in parts if len(part[0]) > 2])
    after = speed_error([(piece.time, piece.position) for piece in mended if len(piece.time) > 2])
    assert after < most * before


def test_the_scenario_mends_time_stamps_unless_told_not_to():
    straight = 5.0 * np.arange(100)
    late = straight - np.random.default_rng(1).uniform(0, 3, 100)
    raw = recording(straight, np.outer(100 * late, [1.0, 0.0]))
    mended, same = (scenarios.recorded([raw], "position", steps=50, repair=repair) for repair in (True, False))
    assert (mended.settings["repair"], same.settings["repair"]) == (True, False)
    steps = [np.diff(s.simulate(1, 0).truth[0, :, 0].numpy(), 2) / 25 for s in (mended, same)]
    assert np.abs(steps[0]).max() < 2 < 8 < np.abs(steps[1]).max()
    np.testing.assert_allclose(same.simulate(1, 0).truth[0, :, :2], raw.position[1:51], atol=1e-9)


# ---------------------------------------------------------------- the smoother


def test_banded_systems_are_solved_as_dense_ones():
    rng = np.random.default_rng(0)
    for size in (1, 2, 31, 32, 33, 200):
        bands = rng.normal(size=(4, size))
        bands[0] += 20
        bands *= np.arange(size) + np.arange(4)[:, None] < size
        dense = np.zeros((size, size))
        for j in range(4):
            for i in range(size - j):
                dense[i, i + j] = dense[i + j, i] = bands[j, i]
        right = rng.normal(size=(size, 2))
        np.testing.assert_allclose(solve(bands, right), np.linalg.solve(dense, right), rtol=1e-10, atol=1e-12)


def test_differences_are_the_derivatives_of_polynomials():
    time = np.cumsum(np.random.default_rng(1).uniform(0.5, 3.0, 12))
    for order, derivative in ((2, 2 * 5.0), (3, 6 * 7.0)):
        values = (5.0 if order == 2 else 7.0) * time**order + 3 * time - 1
        rows = differences(time, order)
        applied = [rows[i] @ values[i : i + order + 1] for i in range(len(rows))]
        np.testing.assert_allclose(applied, derivative, rtol=1e-9)


def test_the_limit_is_met_by_moving_as_little_as_possible():
    """At the least-moved curve the moves are combinations of the active limits only, with multipliers above 0."""
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(1.0, 4.0, 30))
    x = np.cumsum(rng.normal(0, 6, (30, 2)), 0)
    result = smoothed(time, x, np.ones(30), limit=1.0)
    dense = np.zeros((28, 30))
    for i, row in enumerate(differences(time, 2)):
        dense[i, i : i + 3] = row
    bend = dense @ result
    sizes = np.linalg.norm(bend, axis=1)
    assert sizes.max() < 1.02
    # x - result = dense.T @ (multipliers * bend): solve for the product, which must point along the bend.
    product = np.linalg.lstsq(dense.T, x - result, rcond=None)[0]
    multipliers = (product * bend).sum(1) / sizes**2
    assert (multipliers > -1e-4 * multipliers.max()).all()
    np.testing.assert_allclose(product, multipliers[:, None] * bend, atol=1e-4 * np.abs(product).max())
    assert (multipliers[sizes < 0.9] < 1e-2 * multipliers.max()).all()
