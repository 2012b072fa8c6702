"""Cleaning finds what tracks are made of, rejects what is wrong, and no track stops another."""

import itertools
from dataclasses import replace

import numpy as np
import oracles
import pytest
import torch

import torchfra
from torchfra.cleaning import check_settings, clean_tracks
from torchfra.cleaning.kinds import KINDS, kind_of
from torchfra.cleaning.two_filters import _believed, _joined, _jumps
from torchfra.motion import ConstantVelocity, CoordinatedTurn
from torchfra.motion.bank import Bank
from torchfra.readers import Recording
from torchfra.readers.recording import Source

SIGMA = 10.0


def recorded(seed, *, steps=200, period=2.0, d=2, sigma=SIGMA, outliers=0.03, speed=150.0, irregular=False, **more):
    """A straight leg, a turn of 2 deg/s and a straight leg: the recording, the truth and which fixes are wrong."""
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(0.3, 1.7, steps) * period if irregular else np.full(steps, period)
    time = 1.7e9 + np.cumsum(gaps)
    turning = (np.arange(steps) > steps // 3) & (np.arange(steps) < steps // 2)
    heading = np.cumsum(np.radians(2.0) * gaps * turning)
    step = speed * gaps[:, None] * np.stack([np.cos(heading), np.sin(heading), 0.02 * np.ones(steps)], 1)
    truth = np.cumsum(step, 0)[:, :d]
    wrong = rng.random(steps) < outliers
    offset = rng.standard_normal((steps, d))
    offset *= np.exp(rng.uniform(np.log(100), np.log(1e4), (steps, 1))) / np.linalg.norm(offset, axis=1, keepdims=True)
    z = truth + sigma * rng.standard_normal(truth.shape) + wrong[:, None] * offset
    return (
        Recording(f"track {seed}", time, z, None, {}, **more),
        truth,
        wrong & (np.linalg.norm(offset, axis=1) > 6 * sigma),
    )


TRACKS = {}
"""By name what makes recordings and their truths, one or a list, of those that are cleaned with nothing told."""


def track(make):
    TRACKS[make.__name__] = make
    return make


@pytest.fixture(scope="module")
def results():
    """What comes of all of ``TRACKS``, as one batch, beside the truth of each, and of the two of ``cleaned``."""
    several = [recorded(seed, d=d) for seed, d in ((0, 2), (1, 3))]
    tracks = {name: make() for name, make in TRACKS.items()}
    pairs = [pair for made in tracks.values() for pair in (made if isinstance(made, list) else [made])]
    one, other, *done = clean_tracks([recording for recording, *_ in (*several, *pairs)])
    both = zip((truth for _, truth in pairs), done, strict=True)
    found = {
        name: [next(both) for _ in made] if isinstance(made, list) else next(both) for name, made in tracks.items()
    }
    return found | {"cleaned": (several, [one, other])}


@pytest.fixture
def cleaned(results):
    """A track in the plane and one in space: recordings, truths and which fixes are wrong; what comes of both."""
    return results["cleaned"]


@pytest.mark.slow
def test_the_noise_is_found_and_said(cleaned):
    for one in cleaned[1]:
        assert one.found.sigma == pytest.approx(SIGMA, rel=0.1)
        assert one.found.nis == pytest.approx(1.0, abs=0.3)
        assert one.found.estimated == {"sigma", "q"}
        assert one.found.bank == "any"
        assert len(one.found.notes) == one.raw.shape[1] - 2  # of the height, where there is one


@pytest.mark.slow
def test_a_result_prints_as_one_line(cleaned):
    of = cleaned[1][0]
    outliers = (of.flag == "outlier").sum()
    assert repr(of) == f"Cleaned('track 0': 200 fixes, {outliers} outliers, sigma {of.found.sigma:.3g})"


def test_outliers_are_found_and_nothing_else(cleaned):
    for (_, _, wrong), one in zip(*cleaned, strict=True):
        np.testing.assert_array_equal(one.flag == "outlier", wrong)


def test_smoothed_tracks_are_nearer_to_the_truth_than_their_fixes(cleaned):
    for (_, truth, _), one in zip(*cleaned, strict=True):
        error = np.sqrt(np.square(one.position - truth).mean())
        assert error < 0.6 * SIGMA


def test_the_truth_is_as_near_as_estimates_say(cleaned):
    off = np.concatenate([
        np.abs(one.position - truth)[:, :2] / one.std[:, :2] for (_, truth, _), one in zip(*cleaned, strict=True)
    ])  # fmt: skip
    assert 0.6 < (off < 1).mean() < 0.85
    assert (off < 2).mean() > 0.92


def test_a_turn_is_a_manoeuvre_with_a_segment(cleaned):
    for one in cleaned[1]:
        assert np.median(one.manoeuvre[75:90]) > 0.5 > np.median(one.manoeuvre[:50])
        (turn,) = [segment for segment in one.segments if "turn" in segment.kind]
        assert turn.kind == "left turn"
        assert turn.rate == pytest.approx(2.0, rel=0.1)


def test_what_is_told_is_taken():
    recording, _, _ = recorded(5, steps=40)
    (one,) = clean_tracks([recording], sigma=7.0, q=0.5, bank="vehicle")
    assert (one.found.sigma, one.found.bank, one.found.estimated) == (7.0, "vehicle", frozenset())


@track
def noise_of_their_own():
    rng = np.random.default_rng(1)
    recording, truth, _ = recorded(6, outliers=0.0)
    std = np.where(np.arange(200) % 2, 1.0, 6.0)
    z = truth + 5 * std[:, None] * rng.standard_normal(truth.shape)
    return Recording("own", recording.time, z, None, {}, sigma=std), truth


def test_fixes_that_state_their_own_noise_get_a_factor_on_it(results):
    _, one = results["noise_of_their_own"]
    assert one.found.sigma == pytest.approx(5.0, rel=0.15)
    assert (one.flag == "outlier").mean() < 0.01


def test_tracks_too_short_for_a_sigma_of_their_own_have_one_together():
    few = [recorded(seed, steps=25, outliers=0.0)[0] for seed in range(12)]
    done = clean_tracks(few)
    assert len({one.found.sigma for one in done}) == 1
    assert done[0].found.sigma == pytest.approx(SIGMA, rel=0.15)


def test_what_repeats_its_position_tells_nothing_of_the_noise_of_other_short_tracks():
    few = [recorded(seed, steps=25, outliers=0.0)[0] for seed in range(3)]
    beacons = [replace(few[0], name=f"beacon {i}", position=np.zeros_like(few[0].position)) for i in range(4)]
    alone, beside = clean_tracks(few), clean_tracks([*beacons, *few])
    assert [one.found.sigma for one in beside[4:]] == pytest.approx([one.found.sigma for one in alone])


@pytest.mark.slow
def test_the_filter_on_line_does_not_know_what_comes():
    recording, _, _ = recorded(7)
    cut = Recording("cut", recording.time[:120], recording.position[:120], None, {})
    whole, part = (clean_tracks([r], sigma=SIGMA, q=1.0, bank="aircraft", smooth=False)[0] for r in (recording, cut))
    np.testing.assert_allclose(whole.mean[:120], part.mean, rtol=1e-9)
    np.testing.assert_allclose(whole.outlier[:120], part.outlier, atol=1e-9)


@pytest.mark.slow
def test_a_long_track_in_rows_is_what_it_is_as_one(monkeypatch):
    recording, _, _ = recorded(8, steps=240)
    (one,) = clean_tracks([recording], sigma=SIGMA, q=1.0)
    monkeypatch.setattr("torchfra.cleaning.positions.ROW", 80)
    (rows,) = clean_tracks([recording], sigma=SIGMA, q=1.0)
    assert (np.abs(rows.position - one.position) < one.std).all()


@track
def walks_that_begin_or_end_with_a_burst():
    rng, turning = np.random.default_rng(0), np.arange(200) % 60 == 30
    course = np.pi / 2 * np.cumsum(turning)
    truth = 7.0 * np.cumsum(np.stack([np.cos(course), np.sin(course)], 1), 0)  # a walk of 5 s from fix to fix
    good = truth + 3.0 * rng.standard_normal(truth.shape)
    wrong = np.zeros((2, 200), bool)
    wrong[0, :4] = wrong[1, -4:] = True
    fixes = good + wrong[..., None] * np.array([700.0, -1400.0])
    return [
        (Recording("walk", 5.0 * np.arange(200), z, None, {}), (truth, bad))
        for z, bad in zip(fixes, wrong, strict=True)
    ]


def test_a_burst_of_one_offset_at_either_end_throws_no_good_fix_away(results):
    for (truth, bad), one in results["walks_that_begin_or_end_with_a_burst"]:
        np.testing.assert_array_equal(one.flag == "outlier", bad)
        assert np.abs(one.position - truth).max() < 5 * 3.0
        assert one.found.nis < 1.3


@track
def hard_turns_that_begin_or_end_with_a_burst():
    cases = [(5.0, slice(0, 6)), (5.0, slice(-6, None)), (10.0, slice(-6, None))]
    course = np.cumsum(np.radians(12.0) * ((np.arange(120) > 25) & (np.arange(120) < 35)))
    unit = np.cumsum(np.stack([np.cos(course), np.sin(course)], 1), 0)
    noise, made = SIGMA * np.random.default_rng(2).standard_normal(unit.shape), []
    for period, burst in cases:
        z = 10.0 * period * unit + noise
        z[burst] += (2000.0, 1000.0)
        made.append((Recording("burst", period * np.arange(120), z, None, {}), (10.0 * period * unit, burst)))
    return made


def test_a_burst_at_either_end_of_a_track_that_turns_hard_leaves_the_others_where_they_are(results):
    for (truth, burst), one in results["hard_turns_that_begin_or_end_with_a_burst"]:
        good = np.delete(np.arange(120), np.arange(120)[burst])
        assert (one.flag[burst] == "outlier").all()
        assert error(one, truth, good) < SIGMA


@track
def jumps_and_reversals():
    after, steps, truths = np.arange(120) >= 60, np.arange(120), []
    cases = [(5.0, 1000.0, 10.0), (5.0, 3000.0, 10.0), (5.0, 0.0, 220.0), (10.0, 0.0, 220.0)]
    for period, jump, speed in cases:
        along = np.cumsum(period * speed * np.where(after & (jump == 0), -1.0, 1.0))
        truths.append(np.stack([along, 3.0 * period * steps + jump * after], 1))
    noise = SIGMA * np.random.default_rng(0).standard_normal((120, 2))
    return [
        (Recording("sudden", period * steps, truth + noise, None, {}), truth)
        for (period, *_), truth in zip(cases, truths, strict=True)
    ]


@track
def whoever_turns_and_jumps_by_a_kilometre():
    found = []
    for period, speed, turn in ((5.0, 1.4, 0.7), (10.0, 1.4, 0.7), (10.0, 13.0, 0.3)):
        rng = np.random.default_rng(3)
        course = np.cumsum(turn * rng.standard_normal(120) * (rng.random(120) < 0.3))
        path = np.cumsum(period * speed * np.stack([np.cos(course), np.sin(course)], 1), 0)
        path[60:] += 800.0, -600.0
        found.append(
            (Recording("jump", period * np.arange(120), path + 5.0 * rng.standard_normal((120, 2)), None, {}), path)
        )
    return found


def test_whoever_turns_and_jumps_by_a_kilometre_is_on_either_side_where_it_was(results):
    for path, one in results["whoever_turns_and_jumps_by_a_kilometre"]:
        assert error(one, path, slice(None)) < np.sqrt(np.square(one.raw - path).sum(1).mean())


def test_each_filter_is_believed_on_its_side_of_a_jump_or_a_reversal(results):
    for truth, one in results["jumps_and_reversals"]:
        assert (one.flag != "outlier").all()
        assert error(one, truth, slice(None)) < SIGMA


@track
def a_balloon_that_bursts():
    rng, time = np.random.default_rng(2), 4.0 * np.arange(160)
    height = 26_000.0 + np.where(time < 320, 5.0 * time, 1600 - 37.0 * (time - 320) + 0.03 * (time - 320) ** 2)
    truth = np.stack([20.0 * time, 5.0 * time, height], 1)
    return Recording("sonde", time, truth + 6.0 * rng.standard_normal(truth.shape), None, {}), truth


def test_a_balloon_that_bursts_falls_from_where_it_was(results):
    truth, one = results["a_balloon_that_bursts"]
    assert (one.flag != "outlier").all()
    assert error(one, truth, slice(None)) < 6.0


@track
def a_crane_to_the_millimetre():
    sigma = 0.001
    rng, time = np.random.default_rng(0), np.arange(200) / 100
    truth = np.stack([0.4 * time, 0.02 * np.sin(2 * time)], 1)
    wrong = np.arange(200) % 60 == 59
    z = truth + sigma * rng.standard_normal(truth.shape) + 40 * sigma * wrong[:, None]
    return Recording("crane", time, z, None, {}), wrong


def test_noise_below_a_centimetre_is_found_of_metres_that_are_written_as_finely(results):
    wrong, one = results["a_crane_to_the_millimetre"]
    assert one.found.sigma == pytest.approx(0.001, rel=0.15)
    np.testing.assert_array_equal(one.flag == "outlier", wrong)


@track
def rounded_metres():
    time = np.arange(200) / 10
    walked = np.stack([1.3 * time, 0.0 * time], 1)
    return [(Recording("rounded", time, z, None, {}), z) for z in (walked.round(2), np.zeros_like(walked))]


def test_rounded_metres_have_no_less_noise_than_their_rounding(results):
    (_, fine), (_, stands) = results["rounded_metres"]
    assert fine.found.sigma >= 0.01 / np.sqrt(12)
    assert stands.found.sigma == pytest.approx(0.01)


def error(one, truth, at):
    """Root mean square of both axes together, which is 1.4 sigma of the fixes themselves."""
    return np.sqrt(np.square(one.position - truth)[at].sum(1).mean())


def test_a_jump_is_the_likeliest_step_from_which_on_the_other_filter_is_believed():
    rng, rare = np.random.default_rng(1), np.array([-1.0, -4.0] * 60)
    gain, lost, may = rng.standard_normal((40, 120)), rng.random((40, 120)) < 0.02, rng.random((40, 120)) < 0.8
    found = _jumps(*map(torch.from_numpy, (gain, lost, may, rare)))
    expected = [oracles.jumps(*of, float(one)) for *of, one in zip(gain.T, lost.T, may.T, rare, strict=True)]
    for one, other in zip(found, zip(*expected, strict=True), strict=True):
        np.testing.assert_array_equal(one.numpy(), np.stack(other, 1))
    assert all(of.any() for of in found)


def test_a_step_alone_is_no_jump_though_rounding_makes_one_filter_likelier():
    gain, no = torch.tensor([[-1e-15]], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.bool)
    assert not any(x.any() for x in _jumps(gain, no, no, torch.tensor([-8.0])))


def test_the_filters_believed_are_the_likeliest_choice_of_every_stretch():
    rng, rare = np.random.default_rng(0), np.array([-1.0, -3.0, -9.0, -4.0] * 20)
    gain, lost = 3.0 * rng.standard_normal((50, 80)), rng.random((50, 80)) < 0.3
    lost = np.transpose([oracles.joined(of, np.ones(50), 3) for of in lost.T])
    first = _believed(*map(torch.from_numpy, (gain, lost, rare))).numpy()
    expected = [oracles.believed(*of, 3) for of in zip(gain.T, lost.T, rare, strict=True)]
    np.testing.assert_array_equal(first & lost, np.transpose(expected))


def test_stretches_with_less_than_three_fixes_between_them_are_one():
    rng = np.random.default_rng(0)
    contrary, fixes = rng.random((60, 80)) < rng.uniform(0, 0.4, 80), rng.random((60, 80)) < 0.7
    whole = _joined(torch.from_numpy(contrary), torch.from_numpy(fixes).long()).numpy()
    expected = [oracles.joined(*of, 3) for of in zip(contrary.T, fixes.T, strict=True)]
    np.testing.assert_array_equal(whole, np.transpose(expected))


@pytest.mark.slow
def test_estimates_between_fixes_come_where_they_are_asked():
    recording, truth, _ = recorded(9, steps=80, period=4.0, outliers=0.0, irregular=True)
    (one,) = clean_tracks([recording], dt=1.0)
    between = one.row < 0
    np.testing.assert_array_equal(one.row[~between], np.arange(80))
    assert between.sum() == pytest.approx(one.time[-1], abs=2)
    assert np.isnan(one.raw[between]).all()
    assert not one.failed.any()
    assert (one.outlier[between] == 0).all()
    assert np.sqrt(np.square(one.position[~between] - truth).mean()) < SIGMA


@pytest.mark.slow
def test_a_gap_of_an_hour_is_bridged_and_unsure():
    recording, _, _ = recorded(10, outliers=0.0)
    time = recording.time + 3600.0 * (np.arange(200) >= 100)
    (one,) = clean_tracks([Recording("gap", time, recording.position, None, {})], dt=600.0)
    assert not one.failed.any()
    assert one.std[one.row < 0][5].min() > 100 * SIGMA


@track
def moored_with_repeated_positions():
    rng = np.random.default_rng(0)
    z = np.round(np.repeat(3 * rng.standard_normal((30, 2)), 5, 0), 1)
    return Recording("moored", 10.0 * np.arange(150), z, None, {}, source=Source(word="ship")), np.zeros((150, 2))


def test_repeated_positions_of_a_moored_ship_are_no_outliers(results):
    _, one = results["moored_with_repeated_positions"]
    assert one.found.bank == "ship"
    assert not one.failed.any()
    assert (one.flag == "outlier").mean() < 0.05


@pytest.mark.parametrize("count", [1, 2, 3])
def test_tracks_of_a_few_fixes_are_cleaned(count):
    recording, _, _ = recorded(11)
    few = Recording("few", recording.time[:count], recording.position[:count], None, {})
    (one,) = clean_tracks([few])
    assert not one.failed.any()
    assert one.mean.shape == (count, 4)


def test_a_target_that_fails_says_so_and_stops_no_other():
    good, _, _ = recorded(12, steps=40)
    bad = Recording("bad", good.time, np.full_like(good.position, np.inf), None, {})
    one, other = clean_tracks([bad, good], sigma=SIGMA)
    assert one.failed.all()
    assert one.found.failure == "position: expected finite metres or NaN, received infinity"
    assert not other.failed.any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fra", "vsimm_srckf", "alphabeta"])
def test_other_filters_run_with_what_was_found(name):
    several = [recorded(seed, steps=30, d=d)[0] for seed, d in ((13, 2), (14, 3))]
    for one in clean_tracks(several, filter=name):
        assert one.found.filter == name
        assert not one.failed.any()
        assert one.mean.shape == (30, 2 * one.raw.shape[1])
        assert one.found.smooth == (name != "alphabeta")
    assert ("not smoothed" in " ".join(one.found.notes)) == (name == "alphabeta")


def test_a_bank_of_your_own_is_used_as_it_is():
    recording, _, _ = recorded(15, steps=60, outliers=0.0)
    bank = Bank([ConstantVelocity(0.1, continuous=True), CoordinatedTurn(0.035, 0.1, continuous=True)])
    (one,) = clean_tracks([recording], bank=bank, sigma=SIGMA, smooth=False)
    assert one.found.bank == "own"
    assert np.isnan(one.manoeuvre).all()


@pytest.mark.parametrize(("given", "said"), [
    ({"sigma": 0.0}, "sigma: expected metres above 0"),
    ({"q": -1.0}, "q: expected m\\^2/s\\^3 of 0 or more"),
    ({"dt": 0.0}, "dt: expected seconds above 0"),
    ({"bank": "submarine"}, "bank: expected one of person, ship, vehicle, aircraft, marine, animal, bird"),
    ({"filter": "nothing"}, "filter: expected one of"),
])  # fmt: skip
def test_what_makes_no_sense_is_refused(given, said):
    with pytest.raises(ValueError, match=said):
        check_settings(**{"filter": "gpb"} | given)


@pytest.mark.parametrize("speed", [1.2, 15.0, 120.0])
def test_the_kind_of_a_target_is_what_the_file_says_and_never_follows_from_its_speed(speed):
    recording, _, _ = recorded(16, speed=speed, sigma=1.0, outliers=0.0)
    name, kind = kind_of(recording)
    assert name == "any"
    assert kind.fastest > 4 * speed
    assert kind_of(replace(recording, source=Source(word="ship"))) == ("ship", KINDS["ship"])


@pytest.mark.slow
def test_a_target_of_a_few_fixes_among_missing_ones_has_a_speed():
    position = np.full((90, 2), np.nan)
    position[[2, 40, 80]] = [[0.0, 0.0], [76.0, 0.0], [156.0, 0.0]]
    _, kind = kind_of(Recording("few", np.arange(90.0), position, None, {}))
    assert kind.fastest == pytest.approx(4.3 * 2.0)


@track
def heights_in_steps():
    rng, time = np.random.default_rng(3), np.arange(0.0, 200.0)
    truth = np.stack([200 * time, 0 * time, np.interp(time, [40, 160], [900, 1900])], 1)
    position = truth + 0.3 * rng.standard_normal((200, 3))
    position[:, 2] = 7.62 * np.round(truth[:, 2] / 7.62)
    return Recording("climb", time, position, None, {}), truth


def test_heights_in_steps_are_as_uncertain_as_their_rounding_and_make_no_outliers(results):
    truth, one = results["heights_in_steps"]
    assert not (one.flag == "outlier").any()
    assert np.abs(one.position - truth)[:, 2].mean() < 7.62 / 4
    assert one.std[:, 2].mean() > 0.5


@pytest.mark.parametrize("smooth", [True, False])
def test_steps_without_a_fix_change_neither_what_is_found_nor_the_estimates_at_the_fixes(smooth):
    recording, _, _ = recorded(4, steps=30, period=60.0, irregular=True)
    times = np.concatenate([recording.time, recording.time[3:25] + 7.0])
    order = np.argsort(times)
    position = np.concatenate([recording.position, np.full((22, 2), np.nan)])[order]
    gaps = Recording("gaps", times[order], position, None, {})
    (plain,), (dense,), (missing,) = (
        clean_tracks([recording], smooth=smooth),
        clean_tracks([recording], smooth=smooth, dt=0.5),  # so many that no row has two fixes of its own
        clean_tracks([gaps], smooth=smooth),
    )
    for one, fix in ((dense, dense.row >= 0), (missing, ~np.isnan(position).any(1))):
        assert (one.found.sigma, one.found.q) == pytest.approx((plain.found.sigma, plain.found.q), rel=1e-12)
        np.testing.assert_allclose(one.position[fix], plain.position, atol=1e-6)
        np.testing.assert_allclose(one.covariance[fix], plain.covariance, rtol=1e-6)
        np.testing.assert_allclose(one.outlier[fix], plain.outlier, atol=1e-9)


def test_a_few_fixes_on_either_side_of_a_long_gap_are_near_where_they_were_measured():
    time = np.array([0.0, 0.1, 0.2, 18000.3, 18000.4, 18000.5])
    position = 10.0 * time[:, None] * [0.8, -0.6] + 0.5 * np.random.default_rng(0).standard_normal((6, 2))
    (one,), (mirrored,) = (
        clean_tracks([Recording("gap", time, position * side, None, {})]) for side in ([1, 1], [1, -1])
    )
    assert np.abs(one.position - position).max() < 100.0  # they are 180 km apart, and three may be outliers
    np.testing.assert_allclose(mirrored.position * [1, -1], one.position, atol=1e-6)


@track
def a_sigma_for_each_fix():
    rng, time = np.random.default_rng(5), np.arange(0.0, 200.0)
    sigma, truth = np.where(time % 2, 2.0, 8.0), np.stack([10 * time, 0 * time], 1)
    position = truth + sigma[:, None] * rng.standard_normal((200, 2))
    return Recording("log", time, position, None, {}, None, np.broadcast_to(sigma, 200)), truth


def test_a_sigma_for_each_fix_is_taken_without_a_warning(results):
    assert 0.7 < results["a_sigma_for_each_fix"][1].found.sigma < 1.4


@track
def moored_and_heard_every_three_minutes():
    position = 5.5 * np.random.default_rng(6).standard_normal((140, 2))
    recording = Recording("moored", 180.0 * np.arange(140), position, None, {}, source=Source(word="ship"))
    return recording, np.zeros((140, 2))


def test_a_moored_ship_that_is_heard_every_three_minutes_is_known_better_than_its_fixes(results):
    _, one = results["moored_and_heard_every_three_minutes"]
    assert one.found.sigma == pytest.approx(5.5, rel=0.1)
    assert np.linalg.norm(one.position, axis=1).mean() < 0.7 * np.linalg.norm(one.raw, axis=1).mean()
    assert 0.5 < one.found.nis < 1.2
    assert not one.found.sigma_unsure
    assert not one.segments


def test_what_fixes_hardly_tell_of_sigma_is_said():
    def ship(count, dt):
        rng, time = np.random.default_rng(7), dt * np.arange(count)
        position = np.stack([8.0 * time, 0.0 * time], 1) + 5.0 * rng.standard_normal((count, 2))
        return Recording("ship", time, position, None, {}, source=Source(word="ship"))

    few, enough = [ship(3, 10.0)], [ship(60, dt) for dt in (900.0, 5.0)]
    assert clean_tracks(few)[0].found.sigma_unsure == "3 fixes are too few to estimate sigma"
    assert clean_tracks(few, sigma=5.0)[0].found.sigma_unsure == ""
    assert [one.found.sigma_unsure for one in clean_tracks(enough)] == ["", ""]


def laps():
    """A racing car 20 times a second that brakes by 30 m/s^2 and turns by 14 to 18: the recording, the truth."""
    rng, time = np.random.default_rng(3), 0.05 * np.arange(1200)
    speed = np.interp(time, [0, 15, 16, 25, 27, 60], [70, 70, 40, 40, 60, 60])
    turn = np.where((time > 15) & (time < 25), 0.35, np.where(time > 40, 0.3, 0.0))
    heading = np.cumsum(0.05 * turn)
    truth = np.cumsum(0.05 * speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1), 0)
    return Recording("car", time, truth + 0.3 * rng.standard_normal(truth.shape), None, {}), truth


def test_a_car_that_is_measured_often_brakes_and_turns_as_hard_as_one_that_is_not():
    recording, truth = laps()
    (cleaned,) = clean_tracks([recording])
    assert not (cleaned.flag == "outlier").any()
    before, after = (np.square(z - truth).mean() for z in (recording.position, cleaned.position))
    assert after < 0.4**2 * before


@track
def a_gull_every_five_minutes():
    rng, kept, velocity = np.random.default_rng(5), np.exp(-5 / 900), [np.zeros(2)]
    for _ in range(12_000):
        velocity.append(kept * velocity[-1] + 4.0 * np.sqrt(1 - kept**2) * rng.standard_normal(2))
    truth = np.cumsum(5.0 * np.stack(velocity), 0)[::60]
    position, time = truth + 15.0 * rng.standard_normal((201, 2)), 300.0 * np.arange(201)
    return Recording("gull", time, position, None, {}, source=Source(word="animal")), truth


def test_a_gull_every_five_minutes_hardly_tells_sigma(results):
    _, one = results["a_gull_every_five_minutes"]
    assert one.found.sigma_unsure == "Fixes 5 min apart hardly distinguish noise from motion: sigma is unsure"


@track
def a_gull_that_rests():
    rng, path = np.random.default_rng(9), [np.zeros(2)]
    for _ in range(4):  # rests of two hours, and flights of one that nobody foretells
        path += 24 * path[-1:] + list(path[-1] + np.cumsum(2000.0 * rng.standard_normal((12, 2)), 0))
    path = np.array(path)
    z = path + 15.0 * rng.standard_normal(path.shape)
    wrong = np.isin(np.arange(len(path)), [10, 50, 90])
    z[wrong] += (20_000.0, -15_000.0)
    return Recording("gull", 300.0 * np.arange(len(path)), z, None, {}, source=Source(word="bird")), (path, wrong)


def test_a_gull_that_rests_between_its_flights_tells_sigma_and_its_outliers(results):
    (path, wrong), cleaned = results["a_gull_that_rests"]
    np.testing.assert_array_equal(cleaned.flag == "outlier", wrong)
    assert cleaned.found.sigma == pytest.approx(15.0, rel=0.25)
    assert error(cleaned, path, ~wrong) < 15.0 * np.sqrt(2)


@track
def drones_that_turn_from_fix_to_fix():
    made = []
    for period, sigma in itertools.product((5.0, 20.0, 300.0), (0.3, 5.0)):
        rng = np.random.default_rng(4)
        course = np.cumsum(np.where(rng.random(100) < 0.5, rng.uniform(-2.0, 2.0, 100), 0.0))  # radians a fix
        path = 9.0 * period * np.cumsum(np.stack([np.cos(course), np.sin(course)], 1), 0)
        z = path + sigma * rng.standard_normal(path.shape)
        made.append((Recording("drone", period * np.arange(100), z, None, {}), path))
    return made


def test_where_targets_turn_from_fix_to_fix_the_path_goes_through_the_fixes(results):
    for path, cleaned in results["drones_that_turn_from_fix_to_fix"]:
        assert error(cleaned, path, slice(None)) < 1.05 * np.sqrt(np.square(cleaned.raw - path).sum(1).mean())


@track
def cars_that_go_to_and_fro():
    made = []
    for period in (900.0, 3600.0):
        rng = np.random.default_rng(6)
        moves = np.where(rng.random((120, 1)) < 0.7, 4.0 * period * rng.standard_normal((120, 2)), 0.0)
        path = np.cumsum(moves, 0)
        z = path + 5.0 * rng.standard_normal(moves.shape)
        made.append((Recording("car", period * np.arange(120), z, None, {}, source=Source(word="vehicle")), path))
    return made


def test_cars_that_go_to_and_fro_between_rare_fixes_are_where_they_were_measured(results):
    for path, cleaned in results["cars_that_go_to_and_fro"]:
        assert error(cleaned, path, slice(None)) < 1.1 * np.sqrt(np.square(cleaned.raw - path).sum(1).mean())


def seldom(path, period, word, wrong=()):
    """Fixes with 3 m of noise, but for those that are ``wrong``, which are 100 ways off; with path and those."""
    z = path + 3.0 * np.random.default_rng(8).standard_normal(path.shape)
    z[[*wrong]] += 100 * np.abs(np.diff(path, axis=0)).max()
    return Recording("rare", period * np.arange(len(z)), z, None, {}, source=Source(word=word)), (path, [*wrong])


def is_where_it_was_measured_and_its_outliers_are_found(truth, one):
    path, wrong = truth
    good = np.delete(np.arange(len(path)), wrong)
    assert error(one, path, good) < 1.05 * np.sqrt(np.square(one.raw - path)[good].sum(1).mean())
    np.testing.assert_array_equal(np.flatnonzero(one.flag[good] == "outlier"), [])
    assert (one.flag[wrong] == "outlier").all()


@track
def who_is_seen_once_a_day_about_its_home():
    path = 1000.0 * np.random.default_rng(1).standard_normal((90, 2))
    return [seldom(path, 86_400.0, word) for word in ("", "animal", "bird", "marine")]


def test_who_is_seen_once_a_day_about_its_home_is_where_it_was_measured(results):
    for (path, _), one in results["who_is_seen_once_a_day_about_its_home"]:
        assert error(one, path, slice(None)) < 1.05 * np.sqrt(np.square(one.raw - path).sum(1).mean())


@track
def who_rests_and_moves_now_and_then():
    made = []
    for period in (1800.0, 7200.0, 21_600.0):
        rng = np.random.default_rng(2)
        moves = np.where(rng.random((120, 1)) < 0.3, 1.2 * period * rng.standard_normal((120, 2)), 0.0)
        made.append(seldom(np.cumsum(moves, 0), period, "", [30, 70]))
    return made


def test_who_rests_and_moves_now_and_then_is_where_it_was_measured_and_its_outliers_are_found(results):
    for truth, one in results["who_rests_and_moves_now_and_then"]:
        is_where_it_was_measured_and_its_outliers_are_found(truth, one)


@track
def an_aircraft_that_takes_off_at_the_end():
    path = np.zeros((80, 2))
    path[:40] = 180_000.0 * np.arange(-40, 0)[:, None]
    path[-2:] = (120_000.0, 30_000.0), (235_000.0, 58_000.0)
    return seldom(path, 900.0, "aircraft")


def test_an_aircraft_that_takes_off_at_the_end_of_rare_fixes_is_no_outlier(results):
    is_where_it_was_measured_and_its_outliers_are_found(*results["an_aircraft_that_takes_off_at_the_end"])


def error_over_raw_in_bursts(path, gaps, word):
    """The error of a path whose fixes, with 5 m of noise, come after these gaps, over that of the fixes."""
    z = path + 5.0 * np.random.default_rng(3).standard_normal(path.shape)
    (cleaned,) = clean_tracks([Recording("bursts", np.cumsum(gaps), z, None, {}, source=Source(word=word))])
    return error(cleaned, path, slice(None)) / np.sqrt(np.square(z - path).sum(1).mean())


@pytest.mark.parametrize("gap", [1.0, 10.0])
def test_a_ship_that_is_elsewhere_after_each_pause_between_bursts_is_where_it_was_measured(gap):
    places = np.cumsum(40_000.0 * np.random.default_rng(5).standard_normal((16, 2)), 0)
    path = np.repeat(places, 10, 0)[:-9]  # the last fix is alone
    gaps = np.where(np.arange(len(path)) % 10, gap, 14_400.0)
    assert error_over_raw_in_bursts(path, gaps, "ship") < 1.05


def test_an_aircraft_that_turns_in_the_three_fixes_between_two_pauses_is_where_it_was_measured():
    gaps, number = np.tile((3600.0, 20.0, 20.0), 50), np.arange(150)
    course = np.cumsum(np.where(number // 3 % 12 == 0, np.tile((0.2, 0.3, 0.3), 50), 0.0))
    velocity = 190.0 * np.stack([np.cos(course), np.sin(course)], 1) * (number >= 75)[:, None]  # it rests before
    path = np.cumsum(velocity * gaps[:, None], 0)
    assert error_over_raw_in_bursts(path, gaps, "aircraft") < 1.05


@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_a_van_that_brakes_just_before_each_pause_and_starts_just_after_is_where_it_was_measured(speed):
    rng, gaps, number = np.random.default_rng(2), np.tile((3600.0, *[10.0] * 39), 4), np.arange(160) % 40
    way = gaps * np.where((number == 1) | (number == 39), speed, 15.0) * (number > 0)
    course = np.repeat(rng.uniform(-3.0, 3.0, 16), 10)
    places = np.repeat(rng.uniform(-20_000.0, 20_000.0, (4, 2)), 40, 0)
    path = places + np.cumsum(way[:, None] * np.stack([np.cos(course), np.sin(course)], 1), 0)
    assert error_over_raw_in_bursts(path, gaps, "target") < 1.05


@pytest.mark.slow
@pytest.mark.parametrize(("period", "sigma", "rare"), [(290.0, 5.0, ("ship", 900.0)), (20.0, 3.0, ("marine", 7200.0))])
def test_a_track_is_cleaned_as_alone_beside_one_whose_fixes_are_rare(period, sigma, rare):
    def wandering(seed, word, period):
        rng = np.random.default_rng(seed)
        course = np.cumsum(rng.normal(0.0, 0.3, 120))
        path = 10.0 * period * np.cumsum(np.stack([np.cos(course), np.sin(course)], 1), 0)
        z = path + sigma * rng.standard_normal(path.shape)
        return Recording(word, period * np.arange(120), z, None, {}, source=Source(word=word))

    recording = wandering(3, "aircraft", period)
    (alone,), (beside, _) = clean_tracks([recording]), clean_tracks([recording, wandering(9, *rare)])
    np.testing.assert_allclose(beside.position, alone.position, rtol=0, atol=1e-3)
    assert beside.found.sigma == pytest.approx(alone.found.sigma, rel=1e-6)


def drifting(seed, period, count=200):
    """A drifter's recording and where it was, by 0.3 m/s straight on."""
    rng, time = np.random.default_rng(seed), period * np.arange(count)
    truth = np.stack([0.3 * time, 0.1 * time], 1)
    return Recording("drifter", time, truth + 20.0 * rng.standard_normal(truth.shape), None, {}), truth


@pytest.mark.slow
def test_a_drifter_among_those_that_may_rest_is_cleaned_as_alone_beside_one_with_rarer_fixes():
    (one, _), (rarer, _) = drifting(1, 300.0), drifting(2, 600.0)
    (alone,), (beside, _) = clean_tracks([one]), clean_tracks([one, rarer])
    assert beside.found.sigma == pytest.approx(alone.found.sigma, rel=1e-6)
    np.testing.assert_allclose(beside.position, alone.position, rtol=0, atol=1e-3)


@track
def drifters_every_few_minutes():
    return [drifting(7, period) for period in (120.0, 180.0, 300.0)]


def test_a_drifter_that_goes_straight_on_is_known_better_than_its_fixes(results):
    for truth, cleaned in results["drifters_every_few_minutes"]:
        assert cleaned.found.sigma == pytest.approx(20.0, rel=0.15)
        assert error(cleaned, truth, slice(None)) < 0.5 * 20.0 * np.sqrt(2)


def circling(seed, speed, turn, period, wind=3.0, count=300):
    """Glides and thermals with ``turn`` seconds a circle, measured to 3 m: the recording and the truth."""
    rng, course, path = np.random.default_rng(seed), 0.0, [np.zeros(2)]
    while len(path) < 10 * period * count:
        rate = rng.choice([-1, 0, 1]) * 2 * np.pi / (turn * rng.uniform(0.8, 1.2))
        for _ in range(int(10 * rng.uniform(60, 300))):
            course += 0.1 * rate
            path.append(path[-1] + 0.1 * (speed * np.array([np.cos(course), np.sin(course)]) + wind))
    truth = np.array(path)[: int(10 * period * count) : int(10 * period)]
    z = truth + 3.0 * rng.standard_normal(truth.shape)
    return Recording("circling", period * np.arange(len(truth)), z, None, {}), truth


@track
def who_circles_with_a_few_fixes_a_turn():
    return [
        circling(seed, *how) for seed in (1, 2) for how in ((10.0, 15.0, 5.0), (12.0, 18.0, 8.0), (27.0, 24.0, 10.0))
    ]


def test_circles_of_a_few_fixes_are_no_noise(results):
    for truth, cleaned in results["who_circles_with_a_few_fixes_a_turn"]:
        assert cleaned.found.sigma < 1.5 * 3.0
        assert error(cleaned, truth, slice(None)) < 1.2 * 3.0 * np.sqrt(2)


@track
def quadcopters_that_stop_and_go():
    rng, speed, course, place, path = np.random.default_rng(3), 5.0, 0.0, np.zeros(2), []
    while len(path) < 12_000:  # tenths of a second
        wanted, rate = (rng.uniform(0, 15), 0.0) if rng.random() < 0.6 else (speed, rng.choice([-1, 1]) * 0.9)
        for _ in range(int(rng.uniform(20, 100) if rate == 0 else rng.uniform(6, 35))):
            speed, course = speed + np.clip(wanted - speed, -0.8, 0.8), course + 0.1 * rate
            place = place + 0.1 * speed * np.array([np.cos(course), np.sin(course)])
            path.append(place)
    truth = np.array(path)[:12_000:100]
    noise, time = rng.standard_normal(truth.shape), 10.0 * np.arange(len(truth))
    return [(Recording("quadcopter", time, truth + sigma * noise, None, {}), truth) for sigma in (0.3, 3.0)]


def test_where_targets_stop_and_go_between_fixes_the_path_goes_through_the_fixes(results):
    for truth, cleaned in results["quadcopters_that_stop_and_go"]:
        assert error(cleaned, truth, slice(None)) < 1.1 * np.sqrt(np.square(cleaned.raw - truth).sum(1).mean())


@track
def a_ship_that_goes_straight():
    rng, time = np.random.default_rng(7), 7200.0 * np.arange(60)
    truth = np.stack([8.0 * time, 0.0 * time], 1)
    position = truth + 5.0 * rng.standard_normal((60, 2))
    return Recording("ship", time, position, None, {}, source=Source(word="ship")), truth


def test_a_ship_that_goes_straight_is_known_better_than_its_fixes_hours_apart(results):
    truth, one = results["a_ship_that_goes_straight"]
    assert one.found.sigma == pytest.approx(5.0, rel=0.15)
    before, after = (np.square(z - truth).mean() for z in (one.raw, one.position))
    assert after < 0.7**2 * before


@pytest.mark.parametrize("where", [slice(0, 3), slice(117, 120)])
def test_arrays_keep_their_length_where_positions_are_missing(where):
    rng = np.random.default_rng(8)
    path = np.stack([30.0 * np.arange(120), 5.0 * np.arange(120)], 1)
    z = path + 5 * rng.standard_normal(path.shape)
    z[where] = np.nan
    of = torchfra.clean((np.arange(120.0), z))
    assert of.position.shape == path.shape
    assert np.linalg.norm(of.position - path, axis=1).max() < 25
    assert (of.outlier[where] == 0).all()


@track
def altitudes_are_missing_for_ten_fixes():
    rng = np.random.default_rng(9)
    path = np.stack([30.0 * np.arange(120), 5.0 * np.arange(120), 10.0 * np.arange(120)], 1)
    z = path + 3 * rng.standard_normal(path.shape)
    z[60:70, 2] = np.nan
    z[65, :2] += 500.0
    return Recording("climb", np.arange(120.0), z, None, {}), path


def test_a_missing_altitude_is_not_the_one_before(results):
    path, of = results["altitudes_are_missing_for_ten_fixes"]
    assert of.position.shape == path.shape
    assert np.abs(of.position - path)[60:70].max() < 15
    assert np.flatnonzero(of.flag == "outlier").tolist() == [65]  # wherever it is in height


def climb(missing):
    """A climbing aircraft as a file, without some of its altitudes; and its truth."""
    draw, time = np.random.default_rng(4), 2.0 * np.arange(200)
    truth = np.column_stack([50 * time, 1000 * np.sin(time / 30), 1000 + 8 * time])
    fixes = truth + draw.normal(0, 4, truth.shape)
    absent = draw.random(200) < missing
    absent[50:70] = missing > 0
    heights = ["" if gone else f"{z:.3f}" for z, gone in zip(fixes[:, 2], absent, strict=True)]
    rows = [f"{t},{x:.3f},{y:.3f},{z}" for t, (x, y, _), z in zip(time, fixes, heights, strict=True)]
    return "\n".join(["time,x,y,z", *rows]), truth


def test_altitudes_that_a_file_does_not_have_are_missing_and_not_those_of_the_fix_before(tmp_path):
    text, truth = climb(missing=0.3)
    (tmp_path / "climb.csv").write_text(text)
    (cleaned,) = torchfra.clean(tmp_path / "climb.csv")
    error = cleaned.mean[:, :3] - truth
    assert np.sqrt(np.square(error[:, 2]).mean()) < 1.5
    assert np.sqrt(np.square(error[:, :2]).mean()) < 4
    assert not (cleaned.flag == "outlier").any()
    assert np.isnan(cleaned.raw[:, 2]).sum() > 60


@track
def level_with_wild_altitudes():
    time = np.arange(120.0)
    fixes = np.column_stack([30 * time, 10 * time, np.full(120, 500.0)])
    fixes[[20, 60, 90], 2] = 900, 100, 3000
    return Recording("level", time, fixes, None, {}), fixes


def test_a_level_altitude_without_noise_stays_level_where_a_few_fixes_are_wild(results):
    _, cleaned = results["level_with_wild_altitudes"]
    assert np.abs(cleaned.mean[:, 2] - 500).max() < 0.1
    assert {20, 60, 90} <= {*np.flatnonzero(cleaned.flag == "outlier")}


@track
def two_levels_far_apart():
    draw, time = np.random.default_rng(1), 10.0 * np.arange(62)
    fixes = np.column_stack([200 * time + draw.normal(0, 8, 62), draw.normal(0, 8, 62), np.full(62, 8534.4)])
    wild = draw.choice(62, 5, replace=False)
    fixes[wild, 2] = 12192
    return Recording("levels", time, fixes, None, {}), wild


def test_two_levels_far_apart_are_no_steps_of_an_altimeter(results):
    wild, cleaned = results["two_levels_far_apart"]
    assert np.abs(cleaned.mean[:, 2] - 8534.4).max() < 1
    assert {*np.flatnonzero(cleaned.flag == "outlier")} == {*wild}


def bird(rng, fixes=200):
    """Fixes of a bird by Argos: times, the truth, measured positions, their stds, and which are outliers.

    It rests for some 18 h and flies at 12 m/s for some 6 h; one fix in twenty is 30 to 300 km off.
    """
    hours = np.cumsum(rng.exponential(2.0, fixes).clip(0.1))
    grid = np.arange(0.0, hours[-1] + 1.0, 0.1)
    flies = np.cumsum(rng.random(len(grid)) < 0.1 / 12) % 2 == 1
    course = np.cumsum(0.05 * rng.standard_normal(len(grid)))
    velocity = np.stack([np.sin(course), np.cos(course)], 1) * 12 * flies[:, None]
    truth = np.stack([np.interp(hours, grid, 360 * axis) for axis in np.cumsum(velocity, 0).T], 1)
    std = rng.choice([325.0, 669.0, 2769.0, 6810.0], fixes)
    z = truth + std[:, None] * rng.standard_normal((fixes, 2))
    wrong = rng.random(fixes) < 0.05
    angle, far = rng.uniform(0, 2 * np.pi, fixes), rng.uniform(3e4, 3e5, fixes)
    z[wrong] += (far * np.stack([np.sin(angle), np.cos(angle)]))[:, wrong].T
    return 3600 * hours, truth, z, std, wrong


@track
def birds_by_argos():
    rng = np.random.default_rng(0)
    return [
        (Recording("bird", t, z, None, {}, sigma=np.stack([std, std], 1), source=Source(word="bird")), (truth, wrong))
        for t, truth, z, std, wrong in (bird(rng) for _ in range(6))
    ]


def test_birds_by_argos_are_nearer_to_the_truth_than_their_good_fixes(results):
    ratio = []
    for (truth, wrong), of in results["birds_by_argos"]:
        ratio.append(np.linalg.norm((of.position - truth)[~wrong]) / np.linalg.norm((of.raw - truth)[~wrong]))
    assert np.median(ratio) < 1


@track
def two_with_wild_altitudes():
    tracks = [recorded(seed, d=3, outliers=0.0, period=20.0) for seed in range(2)]
    wild = np.random.default_rng(1).random((2, 200)) < 0.05
    for (recording, *_), high in zip(tracks, wild, strict=True):
        recording.position[high, 2] += 3000.0
    return [(recording, (truth, high)) for (recording, truth, _), high in zip(tracks, wild, strict=True)]


def test_a_wild_altitude_leaves_the_position_of_its_fix(results):
    tracks = results["two_with_wild_altitudes"]
    error = np.stack([of.position - truth for (truth, _), of in tracks])
    unsure, wild = np.stack([of.std[:, 0] for _, of in tracks]), np.stack([high for (_, high), _ in tracks])
    assert (np.stack([of.flag for _, of in tracks])[wild] == "outlier").all()
    assert np.abs(error[wild, 2]).max() < SIGMA
    assert np.median(unsure[wild]) < 1.1 * np.median(unsure[~wild])
