"""Cleaning divides its work: by the axes among threads, and by length among batches."""

import numpy as np
import pytest
import torch

from torchfra.cleaning import clean_tracks
from torchfra.cleaning.batches import groups
from torchfra.cleaning.parts import of_each
from torchfra.readers import Recording


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def recorded(count):
    rng = np.random.default_rng(count)
    path = np.arange(count)[:, None] * np.array([70.0, 50.0, 2.0])
    return Recording(f"of {count} fixes", np.arange(count), path + 10.0 * rng.standard_normal(path.shape), None, {})


def test_threads_change_no_result(two_threads):
    (two,) = clean_tracks([recorded(40)])
    torch.set_num_threads(1)
    (one,) = clean_tracks([recorded(40)])
    np.testing.assert_allclose(two.mean, one.mean, rtol=1e-9)
    np.testing.assert_allclose(two.covariance, one.covariance, rtol=1e-9)


def test_threads_of_the_caller_are_as_many_as_before(two_threads):
    before = torch.get_num_threads()
    assert of_each(lambda part: 2 * part, [0, 1]) == [0, 2]
    assert torch.get_num_threads() == before


def test_what_fails_in_a_thread_fails_here(two_threads):
    with pytest.raises(ValueError, match="of a part"):
        of_each(_fails, [0, 1])


def _fails(part):
    raise ValueError("of a part")


def test_recordings_that_are_divided_into_rows_are_one_batch_whatever_their_lengths():
    several = [recorded(count) for count in (300, 2000, 10)]
    assert groups(several, alike=256) == [[2], [0, 1]]
    assert groups(several) == [[2], [0], [1]]
