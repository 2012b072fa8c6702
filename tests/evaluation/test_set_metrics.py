"""Distances between sets of targets and estimates are the best over all assignments; swaps are counted."""

import itertools
import math
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra.metrics import gospa, ospa, swaps

WHERE = slice(0, 2)


def sets(n, m, seed, spread=100.0):
    rng = torch.Generator().manual_seed(seed)
    x, y = (spread * torch.randn(k, 1, 2, generator=rng, dtype=torch.float64) for k in (n, m))
    return x, y


def best(x, y, cutoff, order):
    """Least sum over all ways to pair the smaller set with the larger, each pair at most at the cutoff."""
    few, many = (x, y) if len(x) <= len(y) else (y, x)
    cost = np.minimum(np.linalg.norm(few - many.swapaxes(0, 1), axis=-1), cutoff) ** order
    ways = itertools.permutations(range(len(many)), len(few))
    return min(sum(cost[i, j] for i, j in enumerate(way)) for way in ways)


@given(n=st.integers(1, 4), m=st.integers(1, 4), order=st.sampled_from([1.0, 2.0]), seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=60)
def test_ospa_is_the_best_over_all_pairings(n, m, order, seed):
    (x, y), c = sets(n, m, seed), 80.0
    found = ospa(x, y, WHERE, cutoff=c, order=order)
    localisation = best(x.numpy(), y.numpy(), c, order) / max(n, m)
    cardinality = c**order * abs(n - m) / max(n, m)
    assert found.distance.item() == pytest.approx((localisation + cardinality) ** (1 / order))
    assert found.localisation.item() == pytest.approx(localisation ** (1 / order))
    assert found.cardinality.item() == pytest.approx(cardinality ** (1 / order))
    assert 0 <= found.distance.item() <= c + 1e-9


@given(n=st.integers(1, 4), m=st.integers(1, 4), order=st.sampled_from([1.0, 2.0]), seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=60)
def test_gospa_is_the_best_over_all_partial_pairings(n, m, order, seed):
    (x, y), c = sets(n, m, seed), 80.0
    found = gospa(x, y, WHERE, cutoff=c, order=order)
    distance = np.linalg.norm(x.numpy() - y.numpy().swapaxes(0, 1), axis=-1)
    least = math.inf
    for count in range(min(n, m) + 1):
        for rows in itertools.combinations(range(n), count):
            for columns in itertools.permutations(range(m), count):
                sum_of = sum(distance[i, j] ** order for i, j in zip(rows, columns, strict=True))
                least = min(least, sum_of + c**order / 2 * (n + m - 2 * count))
    assert found.distance.item() == pytest.approx(least ** (1 / order))
    parts = [part.item() ** order for part in found[1:]]
    assert sum(parts) == pytest.approx(least)
    assert parts[1] / (c**order / 2) - parts[2] / (c**order / 2) == pytest.approx(m - n)


def test_known_distances():
    x = torch.tensor([[[0.0, 0.0]], [[50.0, 0.0]]], dtype=torch.float64)
    y = torch.tensor([[[3.0, 4.0]], [[50.0, 5.0]]], dtype=torch.float64)
    assert ospa(x, y, WHERE, cutoff=100.0).distance.item() == pytest.approx(5.0)
    assert gospa(x, y, WHERE, cutoff=100.0).distance.item() == pytest.approx(math.sqrt(50))
    alone = gospa(x, y[:1], WHERE, cutoff=10.0)
    assert [part.item() for part in alone] == pytest.approx([math.sqrt(75), 5.0, 0.0, math.sqrt(50)])


def test_nan_is_a_target_or_an_estimate_that_is_not_there():
    x, y = sets(3, 2, 0)
    fewer = x.clone()
    fewer[1] = math.nan
    for metric in (ospa, gospa):
        for ours, theirs in zip(metric(fewer, y, WHERE), metric(x[[0, 2]], y, WHERE), strict=True):
            torch.testing.assert_close(ours, theirs)
        nothing = metric(torch.full_like(x, math.nan), torch.full_like(y, math.nan), WHERE)
        assert nothing.distance.item() == 0
    assert gospa(x[:0], y, WHERE, cutoff=70.0).distance.item() == pytest.approx(70.0)
    assert ospa(torch.full_like(x, math.nan), y, WHERE, cutoff=70.0).distance.item() == pytest.approx(70.0)


def test_batches_and_steps_are_each_their_own():
    rng = torch.Generator().manual_seed(0)
    x, y = (50 * torch.randn(2, 3, 5, 4, generator=rng, dtype=torch.float64) for _ in range(2))
    whole = gospa(x, y, WHERE).distance
    assert whole.shape == (2, 5)
    torch.testing.assert_close(whole[1, 3:4], gospa(x[1, :, 3:4], y[1, :, 3:4], WHERE).distance)


def test_swaps_are_changes_of_the_target_that_is_followed():
    t = torch.arange(10, dtype=torch.float64)
    truth = torch.stack([torch.stack([t * 0, t], -1), torch.stack([t * 0 + 500, t], -1)])
    assert swaps(truth, truth, WHERE).tolist() == [0, 0]
    crossed = torch.cat([truth[:, :5], truth.flip(0)[:, 5:]], 1)
    assert swaps(crossed, truth, WHERE).tolist() == [1, 1]
    there_and_back = torch.cat([truth[:, :4], truth.flip(0)[:, 4:6], truth[:, 6:]], 1)
    assert swaps(there_and_back, truth, WHERE).tolist() == [2, 2]
    lost = truth.clone()
    lost[0, 5:] += 250.0
    assert swaps(lost, truth, WHERE).tolist() == [0, 0]  # nobody's is no swap
    near = truth.clone()
    near[1, :, 0] = 80.0
    assert swaps(near, near.flip(0), WHERE).tolist() == [0, 0]  # too near to tell


def test_without_scipy_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    with pytest.raises(ImportError, match=r'assignment needs the package scipy: pip install "torchfra\[assignment\]"'):
        ospa(*sets(1, 1, 0), WHERE)


def test_what_does_not_fit_is_named():
    x, y = sets(2, 3, 0)
    with pytest.raises(ValueError, match="truth: expected"):
        swaps(x, y, WHERE)
    with pytest.raises(ValueError, match="mean, truth: expected"):
        ospa(x[0], y[0], WHERE)
    for options in ({"cutoff": 0.0}, {"order": 0.5}, {"order": math.inf}, {"cutoff": math.inf}):
        with pytest.raises(ValueError, match="cutoff, order: expected"):
            gospa(*sets(1, 1, 0), WHERE, **options)
