"""Tracks of animals: files of Movebank are read with the errors of Argos, and fixes hours apart are cleaned."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cleaning.simulated import animal

from torchfra.cleaning import clean_tracks
from torchfra.cleaning.kinds import kind_of
from torchfra.cleaning.outputs.summary import sentences, settings_lines
from torchfra.readers import Recording, read
from torchfra.readers.recording import Source

HEADER = "event-id,visible,timestamp,location-long,location-lat,argos:lc,argos:semi-major,argos:semi-minor,"
HEADER += "argos:orientation,tag-local-identifier,individual-local-identifier"
ROWS = """
1,true,2020-01-01 00:00:00.000,10.00,54.0,3,400,200,90,77,seal
2,true,2020-01-01 02:00:00.000,10.01,54.0,A,,,,77,seal
3,false,2020-01-01 04:00:00.000,12.00,54.0,B,9000,200,90,77,seal
4,true,2020-01-01 06:00:00.000,10.02,54.0,2,1000,200,30,77,seal
"""


def written(folder, header, rows):
    (folder / "animals.csv").write_text(header + rows)
    (recording,) = read(folder / "animals.csv")
    return recording


def test_a_file_of_movebank_is_of_animals_and_of_individuals(tmp_path):
    recording = written(tmp_path, HEADER, ROWS)
    assert (recording.name, recording.source.word) == ("seal", "animal")
    assert recording.source.columns["id"] == "individual-local-identifier"
    assert kind_of(recording)[0] == "animal"


def test_rows_marked_as_outliers_are_dropped_and_counted(tmp_path):
    recording = written(tmp_path, HEADER, ROWS)
    assert recording.row.tolist() == [0, 1, 3]
    assert recording.repairs == {"rows marked as outliers dropped": 1}
    rows = ROWS.replace("true", "not").replace("false", "true").replace("not", "false")
    by_hand = written(tmp_path, HEADER.replace("visible", "manually-marked-outlier"), rows)
    assert by_hand.row.tolist() == [0, 1, 3]


def test_an_ellipse_of_argos_is_a_standard_deviation_east_and_north(tmp_path):
    sigma = written(tmp_path, HEADER, ROWS).sigma
    half = math.radians(30)
    root = np.array([[math.sin(half), math.cos(half)], [math.cos(half), -math.sin(half)]])
    covariance = root @ np.diag([1000.0**2 / 2, 200.0**2 / 2]) @ root.T
    np.testing.assert_allclose(sigma[0], [400 / math.sqrt(2), 200 / math.sqrt(2)])
    np.testing.assert_allclose(sigma[2], np.sqrt(np.diag(covariance)))


def test_a_class_of_argos_is_one_where_there_is_no_ellipse(tmp_path):
    radius = 6190.0  # of 68 % of the fixes of class A
    expected = radius / math.sqrt(-2 * math.log(1 - 0.68))
    np.testing.assert_allclose(written(tmp_path, HEADER, ROWS).sigma[1], expected)
    rows = "\nseal,2020-01-01 10:00:00,B,10.0,54.0\nseal,2020-01-01 12:00:00,A,10.01,54.0"
    np.testing.assert_allclose(written(tmp_path, "id,date,lc,lon,lat", rows).sigma[1], expected)


def test_a_mark_that_is_neither_true_nor_false_is_refused_with_its_row(tmp_path):
    with pytest.raises(ValueError, match="expected true or false in data row 4, column visible, received 'maybe'"):
        written(tmp_path, HEADER, ROWS.replace("4,true", "4,maybe"))


def walk(seed, noise=500.0, count=200, hours=2):
    """Fixes hours apart, one in 25 of them 20 km off: the recording, the truth and which are wrong."""
    rng = np.random.default_rng(seed)
    truth = animal(rng, 10 * hours * (count - 1), 360.0)[:: 10 * hours]
    wrong = rng.random(count) < 0.04
    angle = rng.uniform(-math.pi, math.pi, count)
    offset = 20e3 * wrong[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    fixes = truth + noise * rng.standard_normal((count, 2)) + offset
    return (
        Recording("seal", 3600.0 * hours * np.arange(count), fixes, None, {}, source=Source(word="animal")),
        truth,
        wrong,
    )


@pytest.mark.parametrize("kind", ["animal", "marine"])
def test_outliers_among_fixes_hours_apart_are_found_and_the_others_come_nearer(kind):
    several = [walk(seed) for seed in range(3)]
    for one, (recording, truth, wrong) in zip(
        clean_tracks([of for of, *_ in several], bank=kind), several, strict=True
    ):
        found = one.flag == "outlier"
        assert (found & wrong).sum() > 0.9 * wrong.sum()
        assert (found & wrong).sum() > 0.9 * found.sum()
        before, after = (np.square(z - truth)[~wrong].mean() for z in (recording.position, one.position))
        assert after < before


CASES = [(100.0, 2), (100.0, 4), (500.0, 4), (1000.0, 4)]
"""Noise in metres and hours between fixes where these hardly tell noise from motion."""


@pytest.fixture(scope="module")
def hardly_told():
    """Three walks of each case, and what comes of each: all as one batch."""
    several = [[walk(seed, noise, hours=hours) for seed in range(3)] for noise, hours in CASES]
    cleaned = clean_tracks([recording for walks in several for recording, *_ in walks])
    return {case: (several[i], cleaned[3 * i : 3 * i + 3]) for i, case in enumerate(CASES)}


@pytest.mark.parametrize("case", CASES)
def test_where_fixes_do_not_tell_noise_from_motion_the_path_is_no_farther_off_than_they_are(case, hardly_told):
    of_raw = []
    for (recording, truth, wrong), one in zip(*hardly_told[case], strict=True):
        before, after = (np.square(z - truth)[~wrong].mean() for z in (recording.position, one.position))
        of_raw.append(math.sqrt(after / before))
    assert np.median(of_raw) < 1.1


def test_it_is_said_where_a_far_lower_sigma_is_as_likely(hardly_told):
    one = hardly_told[100.0, 4][1][0]
    assert one.found.sigma_unsure == "Fixes 4 h apart hardly distinguish noise from motion: sigma is unsure"
    (one,) = clean_tracks([one.recording], sigma=100.0)
    assert not one.found.sigma_unsure


def test_a_standard_deviation_of_kilometres_that_is_stated_is_taken():
    recording, truth, wrong = walk(3, noise=0.0)
    rng = np.random.default_rng(4)
    sigma = rng.choice([300.0, 800.0, 4000.0], 200)
    fixes = recording.position + sigma[:, None] * rng.standard_normal((200, 2))
    (one,) = clean_tracks([Recording("seal", recording.time, fixes, None, {}, sigma=sigma)], bank="marine")
    assert one.found.sigma == pytest.approx(1.0, rel=0.25)
    assert np.square(one.position - truth).mean() < 0.3 * np.square(fixes - truth)[~wrong].mean()


def test_classes_of_argos_are_the_noise_as_they_are_or_times_a_given_factor_also_beside_other_tracks():
    recording, _, _ = walk(6, noise=100.0, count=40)
    fast = np.where(np.arange(40)[:, None] == 20, recording.position + 90e3, recording.position)
    classes, others = (Source(word="animal", argos=argos) for argos in (True, False))
    several = [
        Recording(name, recording.time, fast, None, {}, sigma=np.full(40, 4000.0), source=source)
        for name, source in (("ptt", classes), ("gps", others), ("ptt 2", classes))
    ]
    cleaned = clean_tracks(several)
    assert [one.recording.name for one in cleaned] == ["ptt", "gps", "ptt 2"]
    assert [("sigma" in one.found.estimated, one.found.sigma) for one in cleaned[::2]] == [(False, 1.0)] * 2
    assert sentences(cleaned[0])[1] == "Noise of a fix: 4.0 km per axis, as the file states"
    (given,) = clean_tracks(several[:1], sigma=0.5)
    assert sentences(given)[1] == "Noise of a fix: 2.0 km per axis, as given; the file states 4.0 km"


def test_it_is_said_where_a_path_of_argos_is_too_fast_for_what_swims():
    time = 60.0 * np.arange(40.0)
    ways = np.where(np.arange(39) < 10, 300.0, 30.0)  # 5 m/s for ten minutes, then 0.5
    path = np.stack([np.append(0.0, ways.cumsum()), np.zeros(40)], 1)
    one = Recording("ptt", time, path, None, {}, sigma=np.full(40, 1.0), source=Source(word="animal", argos=True))
    (cleaned,) = clean_tracks([one])
    assert "Faster than what swims (3 m/s): 10 of 39 ways of the path" in sentences(cleaned)
    (other,) = clean_tracks([replace(one, source=Source(word="animal"))])
    assert not any(line.startswith("Faster") for line in sentences(other))


def test_stated_deviations_stay_where_fixes_are_too_far_apart_to_show_them():
    recording, truth, _ = walk(5, noise=400.0, count=40)
    (one,) = clean_tracks([replace(recording, sigma=np.full(40, 400.0))])
    assert "sigma as stated" in settings_lines([one])[0]
    assert one.found.sigma == 1
    assert (one.std > 350.0).all()
    assert 0.5 < (((one.position - truth) / one.std) ** 2).mean() < 2
