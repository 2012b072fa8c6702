"""Probabilities of association are sums over all joint events, and messages come close to them."""

import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra.association import associate, clusters, events


def random_scan(rng, targets, count, share=0.6, scale=2.0):
    """Likelihoods (J, N), 0 where not gated, and densities of false measurements (J,)."""
    L = np.exp(scale * rng.standard_normal((count, targets))) * (rng.random((count, targets)) < share)
    return L, np.exp(0.5 * rng.standard_normal(count))


def log_ratio(L, PD, c):
    with np.errstate(divide="ignore"):
        return torch.from_numpy(np.log(PD * L / c[:, None]).T.copy())


def test_the_design_vector_is_met_to_eight_digits():
    L = np.array([[0.02, 0.001], [0.004, 0.03], [0, 0.002]])
    found = associate(log_ratio(L, 0.9, np.full(3, 1 / 500)), math.log(0.1), diffuse=True).log_weights.exp()
    expected = [[0.02208133, 0.95758636, 0.02033231, 0.0], [0.01617840, 0.00655881, 0.90511587, 0.07214692]]
    np.testing.assert_allclose(found, expected, atol=5.1e-9)


def test_one_target_is_the_non_parametric_filter_of_bar_shalom():
    L = np.array([[0.02], [0.004]])
    found = associate(log_ratio(L, 0.9, np.full(2, 1 / 500)), math.log(0.1), diffuse=True).log_weights.exp()[0]
    b = 2 * 0.1 / (0.9 * 500)
    expected = np.array([b, 0.02, 0.004]) / (b + 0.024)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_allclose(found, [0.01818182, 0.81818182, 0.16363636], atol=5.1e-9)


@given(
    targets=st.integers(1, 4),
    count=st.integers(1, 6),
    diffuse=st.booleans(),
    share=st.sampled_from([0.3, 0.6, 1.0]),
    seed=st.integers(0, 10_000),
)
@settings(deadline=None, max_examples=150)
def test_probabilities_are_those_of_going_through_every_event_of_every_cluster(targets, count, diffuse, share, seed):
    rng = np.random.default_rng(seed)
    L, c = random_scan(rng, targets, count, share)
    PD, PG = rng.uniform(0.3, 0.99), rng.uniform(0.9, 1.0)
    beta, missed = oracles.joint_events(L, PD, c, diffuse, PG)
    found = associate(log_ratio(L, PD, c), math.log1p(-PD * PG), diffuse=diffuse)
    np.testing.assert_allclose(found.log_weights[:, 1:].exp(), beta.T, atol=1e-12)
    np.testing.assert_allclose(found.log_weights[:, 0].exp(), missed, atol=1e-12)


@given(targets=st.integers(5, 8), seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=20)
def test_many_targets_in_small_clusters_are_exact_too(targets, seed):
    """Each measurement is gated by two neighbours at most."""
    rng = np.random.default_rng(seed)
    L, c = random_scan(rng, targets, 8)
    for j in range(8):
        keep = rng.integers(targets - 1)
        L[j, [t for t in range(targets) if t not in (keep, keep + 1) or (keep % 3 == 2)]] = 0
    beta, missed = oracles.joint_events(L, 0.8, c, True)
    found = associate(log_ratio(L, 0.8, c), math.log(0.2), diffuse=True)
    np.testing.assert_allclose(found.log_weights[:, 1:].exp(), beta.T, atol=1e-12)
    np.testing.assert_allclose(found.log_weights[:, 0].exp(), missed, atol=1e-12)


def test_a_batch_is_its_scans():
    rng = np.random.default_rng(1)
    each = [random_scan(rng, 3, 5) for _ in range(20)]
    ratios = torch.stack([log_ratio(L, 0.9, c) for L, c in each])
    whole = associate(ratios.reshape(4, 5, 3, 5), math.log(0.1), diffuse=True)
    for i in range(20):
        alone = associate(ratios[i], math.log(0.1), diffuse=True)
        torch.testing.assert_close(whole.log_weights.reshape(20, 3, 6)[i].exp(), alone.log_weights.exp())
        torch.testing.assert_close(whole.evidence.reshape(20, 3)[i], alone.evidence)


def test_clusters_are_what_shares_measurements_directly_or_not():
    gated = torch.tensor([[1, 0, 0, 0], [1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]], dtype=torch.bool)
    expected = torch.eye(5, dtype=torch.bool)
    expected[:3, :3] = True
    assert torch.equal(clusters(gated), expected)


def test_the_order_of_targets_and_measurements_does_not_matter():
    L, c = random_scan(np.random.default_rng(3), 4, 6)
    straight = associate(log_ratio(L, 0.9, c), math.log(0.1)).log_weights
    rows, columns = [2, 0, 3, 1], [4, 1, 0, 5, 3, 2]
    turned = associate(log_ratio(L, 0.9, c)[rows][:, columns], math.log(0.1)).log_weights
    torch.testing.assert_close(turned[:, 1:].exp(), straight[rows][:, 1:][:, columns].exp())


def test_evidence_is_the_log_of_the_sum_over_all_events():
    """Shared out evenly in a cluster; of Poisson false measurements, for which events of all targets may be summed."""
    L, c = random_scan(np.random.default_rng(5), 3, 4, share=1.0)
    total = sum(weight for weight, _ in oracles.every_event([0, 1, 2], [0, 1, 2, 3], L, 0.8, c, 1.0))
    found = associate(log_ratio(L, 0.8, c), math.log(0.2)).evidence
    np.testing.assert_allclose(found, np.full(3, math.log(total) / 3), rtol=1e-12)
    L[:, 2] = 0  # a cluster of two, and one alone with nothing
    total = sum(weight for weight, _ in oracles.every_event([0, 1], [0, 1, 2, 3], L, 0.8, c, 1.0))
    found = associate(log_ratio(L, 0.8, c), math.log(0.2)).evidence
    np.testing.assert_allclose(found, [math.log(total) / 2] * 2 + [math.log(0.2)], rtol=1e-12)


def test_targets_that_are_always_measured_are_missed_as_rarely_as_can_be():
    """Detection of 1: as the limit of a detection that goes there."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        L, c = random_scan(rng, 3, 3, share=0.4)
        sure = associate(log_ratio(L, 1.0, c), -math.inf).log_weights.exp()
        nearly = associate(log_ratio(L, 1.0, c), math.log(1e-14)).log_weights.exp()
        np.testing.assert_allclose(sure, nearly, atol=1e-9)


@pytest.mark.parametrize("diffuse", [False, True])
def test_messages_are_close_to_the_sum_over_events(diffuse):
    """Loopy belief propagation, 4 targets with 10 measurements in all gates: the error that the docstring says."""
    rng = np.random.default_rng(0)
    scans = [random_scan(rng, 4, 10, 0.8) for _ in range(200)]
    ratios = torch.stack([log_ratio(L, 0.9, c) for L, c in scans])
    exact = associate(ratios, math.log(0.1), diffuse=diffuse)
    close = associate(ratios, math.log(0.1), diffuse=diffuse, exact=(1, 1))
    error = (exact.log_weights.exp() - close.log_weights.exp()).abs()
    assert error.mean() < 0.01
    assert error.max() < 0.15
    assert error.max() > 1e-6  # it is another way, after all
    torch.testing.assert_close(close.log_weights.exp().sum(-1), torch.ones(200, 4).double())
    assert (exact.evidence - close.evidence).abs().max() < 0.3


def test_messages_of_targets_that_are_always_measured_are_probabilities_too():
    """More targets than measurements, whose odds are far from even: each measurement still belongs to one target."""
    rng = np.random.default_rng(0)
    both = torch.tensor([[0.0, -40.0], [0.0, -40.0]], dtype=torch.float64)  # two for two: none is missed
    assert associate(both, -math.inf, exact=(1, 1)).log_weights[:, 0].exp().max() < 1e-3
    for targets, count, scale in ((5, 3, 1.0), (3, 2, 1.0), (2, 1, 10.0), (3, 2, 100.0)):
        ratio = torch.from_numpy(scale * rng.standard_normal((targets, count)))
        close = associate(ratio, -math.inf, exact=(1, 1))
        assert close.log_weights[:, 1:].exp().sum(0).max() < 1.01
        if targets <= 3:
            sure = associate(ratio, -math.inf)
            assert (close.log_weights.exp() - sure.log_weights.exp()).abs().max() < 0.3
            assert (close.evidence - sure.evidence).abs().max() < 1


def test_messages_are_exact_where_nothing_is_shared():
    L, c = random_scan(np.random.default_rng(7), 5, 15, share=1.0)
    L *= np.kron(np.eye(5), np.ones((3, 1)))
    for diffuse in (False, True):
        beta, missed = oracles.joint_events(L, 0.9, c, diffuse)
        found = associate(log_ratio(L, 0.9, c), math.log(0.1), diffuse=diffuse, exact=(0, 0)).log_weights.exp()
        np.testing.assert_allclose(found[:, 1:], beta.T, atol=1e-12)
        np.testing.assert_allclose(found[:, 0], missed, atol=1e-12)


def test_a_crowd_runs_by_messages():
    L, c = random_scan(np.random.default_rng(9), 12, 40, share=0.5)
    found = associate(log_ratio(L, 0.9, c), math.log(0.1)).log_weights.exp()
    assert found.isfinite().all()
    torch.testing.assert_close(found.sum(-1), torch.ones(12).double())
    assert (found[:, 1:].sum(0) < 1 + 1e-6).all()  # no measurement belongs to more than one target


@pytest.mark.parametrize("exact", [(4, 10), (1, 1)])
@pytest.mark.parametrize("diffuse", [False, True])
def test_gradients_are_those_of_finite_differences(diffuse, exact):
    L, c = random_scan(np.random.default_rng(4), 3, 4, share=0.7)
    ratio = log_ratio(L, 0.9, c)
    inside = ratio > -torch.inf
    miss = torch.tensor(0.1, dtype=torch.float64).log().requires_grad_()

    def probabilities(values, miss):
        full = torch.full_like(ratio, -torch.inf).index_put(torch.where(inside), values)
        found = associate(full, miss, diffuse=diffuse, exact=exact)
        return found.log_weights.exp(), found.evidence

    assert torch.autograd.gradcheck(probabilities, (ratio[inside].requires_grad_(), miss))


def test_it_runs_under_vmap_and_compile():
    rng = np.random.default_rng(6)
    ratios = torch.stack([log_ratio(random_scan(rng, 3, 4)[0], 0.9, np.ones(4)) for _ in range(6)])
    eager = associate(ratios, math.log(0.1), diffuse=True)
    mapped = torch.func.vmap(lambda r: associate(r, math.log(0.1), diffuse=True))(ratios)
    torch.testing.assert_close(mapped.log_weights.exp(), eager.log_weights.exp())
    torch.testing.assert_close(mapped.evidence, eager.evidence)


def test_a_scan_of_nothing_is_refused():
    with pytest.raises(ValueError, match="log_ratio: expected"):
        associate(torch.zeros(2, 0), math.log(0.1))


def test_events_are_all_of_them_once():
    for targets, count in ((1, 3), (2, 3), (4, 2), (3, 5)):
        number = sum(math.comb(targets, k) * math.perm(count, k) for k in range(min(targets, count) + 1))
        every = events(targets, count)
        assert len(every) == len({tuple(e) for e in every.tolist()}) == number
    with pytest.raises(ValueError, match="exact: expected targets"):
        events(8, 12)
