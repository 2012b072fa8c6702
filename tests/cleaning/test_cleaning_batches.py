"""Cleaning works in one thread, or several processes, by batches of recordings of similar lengths."""

import numpy as np
import pytest
import torch

from torchfra.cleaning import batches, clean_tracks, core
from torchfra.cleaning.batches import groups, steps_of
from torchfra.cleaning.kinds import KINDS
from torchfra.readers import Recording
from torchfra.running import jobs


def recorded(count):
    rng = np.random.default_rng(count)
    path = np.arange(count)[:, None] * np.array([70.0, 50.0, 2.0])
    return Recording(f"of {count} fixes", np.arange(count), path + 10.0 * rng.standard_normal(path.shape), None, {})


def test_torch_has_as_many_threads_after_cleaning_as_before():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        clean_tracks([recorded(12)])
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_recordings_that_are_divided_into_rows_are_one_batch_whatever_their_lengths():
    several = [recorded(count) for count in (300, 2000, 10)]
    assert groups(several, alike=256) == [[2], [0, 1]]
    assert groups(several) == [[2], [0], [1]]


def test_recordings_that_are_alike_are_an_even_number_of_batches_of_as_many_fixes(monkeypatch):
    monkeypatch.setattr(batches, "_ALONE", 200)
    monkeypatch.setattr(batches, "_PAIR", 400)
    assert groups([recorded(90)] * 2) == [[0, 1]]
    assert groups([recorded(90)] * 5) == [[0, 1], [2, 3, 4]]
    assert groups([recorded(90)] * 8) == [[0, 1], [2, 3], [4, 5], [6, 7]]
    assert groups([recorded(90)] * 2 + [recorded(260)]) == [[0, 1], [2]]


def test_a_long_recording_is_one_batch(monkeypatch):
    monkeypatch.setattr(batches, "_ALONE", 200)
    assert groups([recorded(1000)]) == [[0]]


# ---------------------------------------------------------------- between fixes


def test_steps_between_fixes_are_at_whole_hours_whenever_a_target_begins():
    hour = 3600.0 * 444_444  # since 1970
    for start, gap in ((100.3, 2500.1), (3599.9, 7000.0), (1.0, 30.0)):
        recording = Recording("", hour + start + gap * np.arange(200), np.zeros((200, 2)), None, {})
        steps = steps_of(recording, KINDS["ship"], dt=3600.0)
        hours = (recording.time[0] + steps.time[steps.row < 0]) / 3600.0
        expected = np.arange(444_445, np.floor(recording.time[-1] / 3600.0) + 1)
        np.testing.assert_allclose(hours, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("dt", [0.1, 1.0, 3600.0])
def test_a_fix_at_a_regular_time_is_no_second_step(dt):
    recording = Recording("", 1.6e9 + dt * np.arange(50), np.zeros((50, 2)), None, {})
    assert len(steps_of(recording, KINDS["ship"], dt=dt).time) == (50 if dt < 3600.0 else 99)


# ---------------------------------------------------------------- processes


def test_few_fixes_start_no_process(monkeypatch):
    def started(*_, **__):
        raise AssertionError("a process was started")

    monkeypatch.setattr(jobs, "prepare", started)
    monkeypatch.setattr(jobs, "ProcessPoolExecutor", started)
    several = [recorded(12), recorded(300)]
    assert len(groups(several)) == 2
    assert len(clean_tracks(several, jobs=8)) == 2


def test_no_process_at_all_is_refused():
    with pytest.raises(ValueError, match="jobs: expected 1 or more, received 0"):
        clean_tracks([recorded(12)], jobs=0)


@pytest.mark.slow
def test_results_are_the_same_to_the_last_bit_whatever_the_number_of_processes(monkeypatch):
    monkeypatch.setattr(batches, "_ALONE", 100)
    monkeypatch.setattr(batches, "_PAIR", 300)
    monkeypatch.setattr(core, "_WORTHWHILE", 1)
    several = [recorded(count) for count in (150, 30, 20, 45, 170, 35, 40, 12, 25, 50, 15)]  # short ones share sigma
    alone, shared = (clean_tracks(several, jobs=number) for number in (1, 3))
    for one, other in zip(alone, shared, strict=True):
        assert one.recording is other.recording
        for name in ("mean", "covariance", "nis", "outlier", "manoeuvre", "flag"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.found, one.segments) == (other.found, other.segments)
        values = [
            torch.cat([x.flatten() for f in of.filters() for x in f.state_dict().values()]) for of in (one, other)
        ]
        torch.testing.assert_close(*values, rtol=0, atol=0)
