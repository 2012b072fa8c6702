"""How targets are followed over their lives: counts by hand, and pairs by going through all choices."""

import itertools
import math

import pytest
import torch

from torchfra.metrics import lives

WHERE = slice(0, 2)
NAN = math.nan


def lines(*heights):
    """Tracks ``(N, T, 2)`` that move along x at these heights, one for each step; None where there is none."""
    rows = [[(NAN, NAN) if y is None else (t, y) for t, y in enumerate(row)] for row in heights]
    return torch.tensor(rows, dtype=torch.float64)


def test_a_target_that_is_followed_by_two_tracks_in_turn():
    truth = lines([None, 0, 0, 0, 0, 0, 0, 0])
    mean = lines([None, None, 1, 1, None, None, None, None], [None] * 5 + [2, 2, 2])
    found = lives(mean, truth, WHERE, cutoff=5.0)
    assert found.length.tolist() == [7]
    assert found.followed.tolist() == [5]
    assert found.longest.tolist() == [3]
    assert found.begun.tolist() == [1]
    assert found.switches.tolist() == [1]
    assert found.breaks.tolist() == [1]
    assert found.track_length.tolist() == [2, 3]
    assert found.false.tolist() == [0, 0]
    assert (found.false_tracks, found.missed_targets) == (0, 0)


def test_a_track_that_is_found_again_has_a_break_and_no_switch():
    found = lives(lines([0, 0, None, 0, 0, 0]), lines([0] * 6), WHERE, cutoff=5.0)
    assert (found.breaks.item(), found.switches.item(), found.longest.item()) == (1, 0, 3)


def test_a_track_keeps_its_target_though_another_comes_closer():
    truth, mean = lines([0, 0, 0, 0], [3, 3, 3, 3]), lines([0, 1, 2, 0], [3, 2, 1, 3])
    assert lives(mean, truth, WHERE, cutoff=5.0).switches.tolist() == [0, 0]
    swapped = lives(lines([0, 0, 30, 30], [30, 30, 0, 0]), lines([0] * 4, [30] * 4), WHERE, cutoff=5.0)
    assert swapped.switches.tolist() == [1, 1]
    assert swapped.breaks.tolist() == [0, 0]


def test_false_tracks_and_missed_targets_are_counted():
    found = lives(lines([0, 0], [90, 90], [None, None]), lines([0, 0], [50, 50], [None, None]), WHERE, cutoff=5.0)
    assert (found.false_tracks.item(), found.missed_targets.item()) == (1, 1)
    assert found.false.tolist() == [0, 2, 0]
    assert math.isnan(found.begun[1])
    none = lives(lines([0, 0])[:0], lines([0, 0]), WHERE)
    assert none.followed.tolist() == [0]
    assert none.false_tracks == 0


def test_batches_are_each_their_own():
    rng = torch.Generator().manual_seed(0)
    mean, truth = (20 * torch.randn(3, 2, n, 6, 2, generator=rng, dtype=torch.float64) for n in (4, 3))
    mean[torch.rand(3, 2, 4, 6, generator=rng) < 0.2] = NAN
    whole = lives(mean, truth, WHERE, cutoff=25.0)
    for i, j in itertools.product(range(3), range(2)):
        for one, other in zip(lives(mean[i, j], truth[i, j], WHERE, cutoff=25.0), whole, strict=True):
            torch.testing.assert_close(one, other[i, j], equal_nan=True)


@pytest.mark.parametrize("seed", range(5))
def test_as_many_pairs_as_possible_follow_each_other(seed):
    rng = torch.Generator().manual_seed(seed)
    mean, truth = (20 * torch.randn(n, 1, 2, generator=rng, dtype=torch.float64) for n in (4, 3))
    gap = (truth - mean.transpose(0, 1)).norm(dim=-1)
    most = 0
    for choice in itertools.product([None, *range(4)], repeat=3):
        pairs = [(i, j) for i, j in enumerate(choice) if j is not None]
        if len({j for _, j in pairs}) == len(pairs) and all(gap[p] < 30.0 for p in pairs):
            most = max(most, len(pairs))
    found = lives(mean, truth, WHERE, cutoff=30.0)
    assert found.followed.sum() == most > 0


def test_a_batch_of_nothing_has_no_lives():
    truth = lines([0, 0]).expand(0, -1, -1, -1)
    assert lives(truth, truth, WHERE).followed.shape == (0, truth.shape[-3])


def test_what_does_not_fit_is_named():
    truth = lines([0, 0])
    with pytest.raises(ValueError, match="cutoff: expected"):
        lives(truth, truth, WHERE, cutoff=0.0)
    with pytest.raises(ValueError, match="mean, truth: expected"):
        lives(truth[:, :1], truth, WHERE)
    with pytest.raises(ValueError, match="mean, truth: expected"):
        lives(truth.unsqueeze(0), truth, WHERE)
