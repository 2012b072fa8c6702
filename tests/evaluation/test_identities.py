"""Accuracy of identities is that of plain loops over all pairings, and as counted by hand."""

import itertools
import math

import pytest
import torch

from torchfra.metrics import hota, idf1

WHERE, CUTOFF, NAN = slice(0, 2), 30.0, math.nan


def lines(*heights):
    """Tracks ``(N, T, 2)`` that move along x at these heights, one for each step; None where there is none."""
    rows = [[(NAN, NAN) if y is None else (t, y) for t, y in enumerate(row)] for row in heights]
    return torch.tensor(rows, dtype=torch.float64)


def random_tracks(*batch, estimates=4, targets=3, seed=0):
    rng = torch.Generator().manual_seed(seed)
    found = []
    for count in (estimates, targets):
        x = 12 * torch.randn(*batch, count, 6, 2, generator=rng, dtype=torch.float64)
        x[torch.rand(*batch, count, 6, generator=rng) < 0.3] = NAN
        found.append(x)
    return found


def pairings(allowed):
    """All sets of pairs (i, j) that are allowed, no i and no j twice."""
    rows, columns = len(allowed), len(allowed[0])
    for choice in itertools.product([None, *range(columns)], repeat=rows):
        pairs = [(i, j) for i, j in enumerate(choice) if j is not None]
        if len({j for _, j in pairs}) == len(pairs) and all(allowed[i][j] for i, j in pairs):
            yield pairs


def plain_hota(mean, truth):
    """By going through all pairings of each scan; score, detection, association and localisation."""
    there = [[[not math.isnan(x[0]) for x in row] for row in tracks.tolist()] for tracks in (truth, mean)]
    targets, estimates = ([sum(row) for row in rows] for rows in there)
    scans, steps, found = range(truth.shape[1]), range(1, 20), []
    S = [
        [[max(0.0, 1 - math.dist(a, b) / CUTOFF) if a[0] == a[0] and b[0] == b[0] else 0.0
          for a, b in zip(one, other, strict=True)] for other in mean.tolist()]
        for one in truth.tolist()
    ]  # fmt: skip
    for least in (step / 20 for step in steps):
        near = [[[s >= least for s in pair] for pair in row] for row in S]
        could = [[sum(pair) / max(1, targets[i] + estimates[j] - sum(pair)) for j, pair in enumerate(row)]
                 for i, row in enumerate(near)]  # fmt: skip
        pairs = []
        for t in scans:
            ways = pairings([[pair[t] for pair in row] for row in near])
            best = max(ways, key=lambda w: (
                len(w), round(sum(could[i][j] for i, j in w), 9), sum(S[i][j][t] for i, j in w)))  # fmt: skip
            pairs += [(i, j, t) for i, j in best]
        each = []
        for i, j, _ in pairs:
            both = sum((i, j, t) in pairs for t in scans)
            each.append(both / (targets[i] + estimates[j] - both))
        missed, false = sum(targets) - len(pairs), sum(estimates) - len(pairs)
        detection, association = len(pairs) / (len(pairs) + missed + false), sum(each) / max(1, len(each))
        located = sum(S[i][j][t] for i, j, t in pairs) / max(1, len(pairs))
        found.append((math.sqrt(detection * association), detection, association, located))
    return [sum(part) / len(found) for part in zip(*found, strict=True)]


@pytest.mark.parametrize("seed", range(4))
def test_hota_is_that_of_plain_loops(seed):
    mean, truth = random_tracks(seed=seed)
    found = hota(mean, truth, WHERE, cutoff=CUTOFF)
    assert [part.item() for part in found] == pytest.approx(plain_hota(mean, truth), abs=1e-12)
    assert 0 < found.score < 1


@pytest.mark.parametrize("seed", range(4))
def test_idf1_is_the_best_over_all_assignments_of_tracks(seed):
    mean, truth = random_tracks(seed=seed)
    together = ((truth.unsqueeze(1) - mean).norm(dim=-1) < CUTOFF).sum(-1).tolist()
    most = max(sum(together[i][j] for i, j in way) for way in pairings([[True] * len(mean)] * len(truth)))
    targets, estimates = ((~x.isnan().any(-1)).sum().item() for x in (truth, mean))
    found = idf1(mean, truth, WHERE, cutoff=CUTOFF)
    assert found.score.item() == pytest.approx(2 * most / (targets + estimates))
    assert (found.precision.item(), found.recall.item()) == pytest.approx((most / estimates, most / targets))


def test_a_target_whose_track_is_broken_in_two():
    truth, mean = lines([0] * 10), lines([0] * 6 + [None] * 4, [None] * 6 + [0] * 4)
    found = hota(mean, truth, WHERE)
    association = 0.6 * 0.6 + 0.4 * 0.4
    assert [x.item() for x in found] == pytest.approx([math.sqrt(association), 1.0, association, 1.0])
    assert [x.item() for x in idf1(mean, truth, WHERE)] == pytest.approx([0.6, 0.6, 0.6])


def test_two_tracks_that_exchange_their_targets_are_detected_and_not_associated():
    truth = lines([0] * 8, [40] * 8)
    mean = lines([0] * 4 + [40] * 4, [40] * 4 + [0] * 4)
    found = hota(mean, truth, WHERE, cutoff=20.0)
    assert (found.detection.item(), found.association.item()) == pytest.approx((1.0, 4 / 12))
    assert idf1(mean, truth, WHERE, cutoff=20.0).score == 0.5
    kept = hota(truth, truth, WHERE, cutoff=20.0)
    assert [x.item() for x in kept] == pytest.approx([1.0] * 4)


def test_similarity_falls_with_the_distance_and_is_0_at_the_cutoff():
    truth, mean = lines([0] * 3), lines([5] * 3)
    found = hota(mean, truth, WHERE, cutoff=20.0)  # similar by 0.75: 15 of 19 thresholds
    assert (found.score.item(), found.localisation.item()) == pytest.approx((15 / 19, 0.75 * 15 / 19))
    assert hota(mean, truth, WHERE, cutoff=5.0).score == 0
    assert idf1(mean, truth, WHERE, cutoff=5.0).score == 0


def test_batches_are_each_their_own_and_nothing_is_nan():
    mean, truth = random_tracks(2, 2)
    for metric in (hota, idf1):
        whole = metric(mean, truth, WHERE, cutoff=CUTOFF)
        for i, j in itertools.product(range(2), range(2)):
            alone = metric(mean[i, j], truth[i, j], WHERE, cutoff=CUTOFF)
            assert [x.item() for x in alone] == [x[i, j].item() for x in whole]
        assert metric(mean[0, 0][:0], truth[0, 0], WHERE).score == 0
        assert metric(mean[0, 0][:0], truth[0, 0][:0], WHERE).score.isnan()
    assert idf1(mean[0, 0][:0], truth[0, 0], WHERE).precision.isnan()


def test_what_does_not_fit_is_named():
    truth = lines([0, 0])
    for metric in (hota, idf1):
        with pytest.raises(ValueError, match="cutoff: expected"):
            metric(truth, truth, WHERE, cutoff=0.0)
        with pytest.raises(ValueError, match="mean, truth: expected"):
            metric(truth[:, :1], truth, WHERE)
