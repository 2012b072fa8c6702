"""Work is shared among processes: all of it is done, each part once, and an error ends it."""

import math

import pytest

from torchfra.running.jobs import check_jobs, finished


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_every_part_is_done_and_comes_with_its_number(jobs):
    assert dict(finished(math.sqrt, [(4.0,), (9.0,), (16.0,)], jobs)) == {0: 2.0, 1: 3.0, 2: 4.0}


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_in_a_part_ends_the_work(jobs):
    with pytest.raises(ValueError, match="math domain error"):
        list(finished(math.sqrt, [(4.0,), (-1.0,), (4.0,)], jobs))


def test_fewer_processes_than_one_are_refused():
    with pytest.raises(ValueError, match="jobs: expected 1 or more, received 0"):
        check_jobs(0)
