"""Cleaning works in one thread, by batches of recordings of similar lengths."""

import numpy as np
import torch

from torchfra.cleaning import clean_tracks
from torchfra.cleaning.batches import groups
from torchfra.readers import Recording


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
