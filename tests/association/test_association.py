"""Association probabilities are sums over all joint events, and belief propagation comes close to them."""

import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra.association import associate, check_exact, joint_events, same_cluster


def random_scan(rng, targets, count, share=0.6, scale=2.0):
    """Likelihoods (J, N), 0 where not gated, and densities of false measurements (J,)."""
    L = np.exp(scale * rng.standard_normal((count, targets))) * (rng.random((count, targets)) < share)
    return L, np.exp(0.5 * rng.standard_normal(count))


def log_ratio(L, PD, c):
    with np.errstate(divide="ignore"):
        return torch.from_numpy(np.log(PD * L / c[:, None]).T.copy())


def test_two_targets_and_three_measurements_have_their_known_probabilities():
    L = np.array([[0.02, 0.001], [0.004, 0.03], [0, 0.002]])
    result = associate(log_ratio(L, 0.9, np.full(3, 1 / 500)), math.log(0.1), diffuse=True).log_weights.exp()
    expected = [[0.02208133, 0.95758636, 0.02033231, 0.0], [0.01617840, 0.00655881, 0.90511587, 0.07214692]]
    np.testing.assert_allclose(result, expected, atol=5.1e-9)


def test_one_target_is_the_non_parametric_filter_of_bar_shalom():
    L = np.array([[0.02], [0.004]])
    result = associate(log_ratio(L, 0.9, np.full(2, 1 / 500)), math.log(0.1), diffuse=True).log_weights.exp()[0]
    b = 2 * 0.1 / (0.9 * 500)
    expected = np.array([b, 0.02, 0.004]) / (b + 0.024)
    np.testing.assert_allclose(result, expected, rtol=1e-12)
    np.testing.assert_allclose(result, [0.01818182, 0.81818182, 0.16363636], atol=5.1e-9)


@given(
    targets=st.integers(1, 4),
    count=st.integers(1, 6),
    diffuse=st.booleans(),
    share=st.sampled_from([0.3, 0.6, 1.0]),
    seed=st.integers(0, 10_000),
)
@settings(deadline=None, max_examples=60)
def test_probabilities_are_those_of_an_oracle_that_enumerates_every_event(targets, count, diffuse, share, seed):
    rng = np.random.default_rng(seed)
    L, c = random_scan(rng, targets, count, share)
    PD, PG = rng.uniform(0.3, 0.99), rng.uniform(0.9, 1.0)
    beta, missed = oracles.joint_events(L, PD, c, diffuse, PG)
    result = associate(log_ratio(L, PD, c), math.log1p(-PD * PG), diffuse=diffuse)
    np.testing.assert_allclose(result.log_weights[:, 1:].exp(), beta.T, atol=1e-12)
    np.testing.assert_allclose(result.log_weights[:, 0].exp(), missed, atol=1e-12)


@given(
    targets=st.integers(2, 4), count=st.integers(1, 5), share=st.sampled_from([0.6, 1.0]), seed=st.integers(0, 10_000)
)
@settings(deadline=None, max_examples=60)
def test_without_permutations_the_best_event_of_each_set_of_targets_and_measurements_counts(
    targets, count, share, seed
):
    """Plain loops over all events; the evidence stays that of all of them."""
    rng = np.random.default_rng(seed)
    L, c = random_scan(rng, targets, count, share)
    ratio, miss = log_ratio(L, 0.8, c), math.log(0.2)
    clusters = same_cluster(ratio > -torch.inf)
    result, all_counted = associate(ratio, miss, permutations=False), associate(ratio, miss)
    torch.testing.assert_close(result.evidence, all_counted.evidence)
    for t in range(targets):
        members = clusters[t].nonzero()[:, 0].tolist()
        best = {}
        for weight, event in oracles.every_event(members, list(range(count)), L, 0.8, c, 1.0):
            kind = tuple(event[i] is None for i in members), frozenset(event.values())
            if kind not in best or weight > best[kind][0]:
                best[kind] = weight, event
        expected = np.zeros(count + 1)
        for weight, event in best.values():
            expected[0 if event[t] is None else event[t] + 1] += weight
        np.testing.assert_allclose(result.log_weights[t].exp(), expected / expected.sum(), atol=1e-12)


def test_targets_in_one_place_keep_both_permutations_as_they_are_as_probable():
    ratio = torch.tensor([[1.0, 2.0], [1.0, 2.0]], dtype=torch.float64)
    same = [associate(ratio, math.log(0.1), permutations=x).log_weights for x in (False, True)]
    torch.testing.assert_close(same[0][0], same[0][1])
    torch.testing.assert_close(*same)


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
    result = associate(log_ratio(L, 0.8, c), math.log(0.2), diffuse=True)
    np.testing.assert_allclose(result.log_weights[:, 1:].exp(), beta.T, atol=1e-12)
    np.testing.assert_allclose(result.log_weights[:, 0].exp(), missed, atol=1e-12)


def test_each_scan_of_a_batch_has_the_result_that_it_has_alone():
    rng = np.random.default_rng(1)
    each = [random_scan(rng, 3, 5) for _ in range(20)]
    ratios = torch.stack([log_ratio(L, 0.9, c) for L, c in each])
    together = associate(ratios.reshape(4, 5, 3, 5), math.log(0.1), diffuse=True)
    for i in range(20):
        alone = associate(ratios[i], math.log(0.1), diffuse=True)
        torch.testing.assert_close(together.log_weights.reshape(20, 3, 6)[i].exp(), alone.log_weights.exp())
        torch.testing.assert_close(together.evidence.reshape(20, 3)[i], alone.evidence)


def test_targets_that_share_measurements_directly_or_through_others_are_a_cluster():
    gated = torch.tensor([[1, 0, 0, 0], [1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]], dtype=torch.bool)
    expected = torch.eye(5, dtype=torch.bool)
    expected[:3, :3] = True
    assert torch.equal(same_cluster(gated), expected)


@pytest.mark.parametrize("targets", [1, 2, 3, 5, 6, 9, 17, 18])
def test_a_chain_of_targets_is_one_cluster_however_long(targets):
    gated = torch.ones(targets, targets, dtype=torch.bool).tril().triu(-1)  # its own measurement and the one before
    assert same_cluster(gated).all()
    gated[targets // 2 :, : targets // 2] = False
    assert same_cluster(gated).sum() == (targets // 2) ** 2 + (targets - targets // 2) ** 2


def test_the_order_of_targets_and_measurements_does_not_matter():
    L, c = random_scan(np.random.default_rng(3), 4, 6)
    straight = associate(log_ratio(L, 0.9, c), math.log(0.1)).log_weights
    rows, columns = [2, 0, 3, 1], [4, 1, 0, 5, 3, 2]
    turned = associate(log_ratio(L, 0.9, c)[rows][:, columns], math.log(0.1)).log_weights
    torch.testing.assert_close(turned[:, 1:].exp(), straight[rows][:, 1:][:, columns].exp())


def test_evidence_is_the_log_of_the_sum_over_all_events():
    """Divided equally in a cluster; with Poisson false measurements the sum may run over the events of all targets."""
    L, c = random_scan(np.random.default_rng(5), 3, 4, share=1.0)
    total = sum(weight for weight, _ in oracles.every_event([0, 1, 2], [0, 1, 2, 3], L, 0.8, c, 1.0))
    result = associate(log_ratio(L, 0.8, c), math.log(0.2)).evidence
    np.testing.assert_allclose(result, np.full(3, math.log(total) / 3), rtol=1e-12)
    L[:, 2] = 0  # a cluster of two, and a single target without measurements
    total = sum(weight for weight, _ in oracles.every_event([0, 1], [0, 1, 2, 3], L, 0.8, c, 1.0))
    result = associate(log_ratio(L, 0.8, c), math.log(0.2)).evidence
    np.testing.assert_allclose(result, [math.log(total) / 2] * 2 + [math.log(0.2)], rtol=1e-12)


def test_a_detection_probability_of_one_is_the_limit_of_smaller_ones():
    rng = np.random.default_rng(2)
    for _ in range(20):
        L, c = random_scan(rng, 3, 3, share=0.4)
        sure = associate(log_ratio(L, 1.0, c), -math.inf).log_weights.exp()
        nearly = associate(log_ratio(L, 1.0, c), math.log(1e-14)).log_weights.exp()
        np.testing.assert_allclose(sure, nearly, atol=1e-9)


@pytest.mark.parametrize("diffuse", [False, True])
def test_belief_propagation_is_close_to_the_sum_over_events(diffuse):
    """Four targets with 10 measurements in shared gates: the error is the one that the docstring states."""
    rng = np.random.default_rng(0)
    scans = [random_scan(rng, 4, 10, 0.8) for _ in range(200)]
    ratios = torch.stack([log_ratio(L, 0.9, c) for L, c in scans])
    exact = associate(ratios, math.log(0.1), diffuse=diffuse)
    close = associate(ratios, math.log(0.1), diffuse=diffuse, exact=(1, 1))
    error = (exact.log_weights.exp() - close.log_weights.exp()).abs()
    assert error.mean() < 0.01
    assert error.max() < 0.15
    assert error.max() > 1e-6  # or it would be the same computation
    torch.testing.assert_close(close.log_weights.exp().sum(-1), torch.ones(200, 4).double())
    assert (exact.evidence - close.evidence).abs().max() < 0.3


def test_belief_propagation_gives_each_measurement_to_one_target_if_all_are_always_measured():
    """Also with more targets than measurements, and with odds far from even."""
    rng = np.random.default_rng(0)
    both = torch.tensor([[0.0, -40.0], [0.0, -40.0]], dtype=torch.float64)  # two measurements: none is missed
    assert associate(both, -math.inf, exact=(1, 1)).log_weights[:, 0].exp().max() < 1e-3
    for targets, count, scale in ((5, 3, 1.0), (3, 2, 1.0), (2, 1, 10.0), (3, 2, 100.0)):
        ratio = torch.from_numpy(scale * rng.standard_normal((targets, count)))
        close = associate(ratio, -math.inf, exact=(1, 1))
        assert close.log_weights[:, 1:].exp().sum(0).max() < 1.01
        if targets <= 3:
            sure = associate(ratio, -math.inf)
            assert (close.log_weights.exp() - sure.log_weights.exp()).abs().max() < 0.3
            assert (close.evidence - sure.evidence).abs().max() < 1


@pytest.mark.parametrize("diffuse", [True, False])
def test_large_clusters_have_the_result_that_each_has_alone(diffuse):
    """Of 5 and 7 targets, with different numbers of measurements, between targets that share none."""
    rng = np.random.default_rng(2)
    blocks = [random_scan(rng, targets, count) for targets, count in ((1, 2), (5, 6), (1, 0), (7, 12), (2, 3))]
    ratios = [log_ratio(L, 0.9, c) for L, c in blocks]
    together = associate(torch.block_diag(*(r.exp() for r in ratios)).log(), math.log(0.1), diffuse=diffuse)
    row = column = 0
    for r in ratios:
        targets, count = r.shape
        mine = together.log_weights[row : row + targets].exp()
        if count:
            alone = associate(r, math.log(0.1), diffuse=diffuse)
            torch.testing.assert_close(mine[:, 1 + column : 1 + column + count], alone.log_weights[:, 1:].exp())
            torch.testing.assert_close(together.evidence[row : row + targets].sum(), alone.evidence.sum())
        torch.testing.assert_close(mine.sum(-1), torch.ones(targets).double())
        row, column = row + targets, column + count


def test_belief_propagation_is_exact_if_no_measurement_is_shared():
    L, c = random_scan(np.random.default_rng(7), 5, 15, share=1.0)
    L *= np.kron(np.eye(5), np.ones((3, 1)))
    for diffuse in (False, True):
        beta, missed = oracles.joint_events(L, 0.9, c, diffuse)
        result = associate(log_ratio(L, 0.9, c), math.log(0.1), diffuse=diffuse, exact=(0, 0)).log_weights.exp()
        np.testing.assert_allclose(result[:, 1:], beta.T, atol=1e-12)
        np.testing.assert_allclose(result[:, 0], missed, atol=1e-12)


def test_twelve_targets_with_forty_measurements_have_valid_probabilities():
    L, c = random_scan(np.random.default_rng(9), 12, 40, share=0.5)
    result = associate(log_ratio(L, 0.9, c), math.log(0.1)).log_weights.exp()
    assert result.isfinite().all()
    torch.testing.assert_close(result.sum(-1), torch.ones(12).double())
    assert (result[:, 1:].sum(0) < 1 + 1e-6).all()  # no measurement belongs to more than one target


@pytest.mark.parametrize("exact", [(4, 10), (1, 1)])
@pytest.mark.parametrize("diffuse", [False, True])
def test_gradients_are_those_of_finite_differences(diffuse, exact):
    L, c = random_scan(np.random.default_rng(4), 3, 4, share=0.7)
    ratio = log_ratio(L, 0.9, c)
    inside = ratio > -torch.inf
    miss = torch.tensor(0.1, dtype=torch.float64).log().requires_grad_()

    def probabilities(values, miss):
        full = torch.full_like(ratio, -torch.inf).index_put(torch.where(inside), values)
        result = associate(full, miss, diffuse=diffuse, exact=exact)
        return result.log_weights.exp(), result.evidence

    assert torch.autograd.gradcheck(probabilities, (ratio[inside].requires_grad_(), miss))


@pytest.mark.slow
def test_vmap_and_torch_compile_give_the_same():
    rng = np.random.default_rng(6)
    ratios = torch.stack([log_ratio(random_scan(rng, 3, 4)[0], 0.9, np.ones(4)) for _ in range(6)])
    eager = associate(ratios, math.log(0.1), diffuse=True)
    mapped = torch.func.vmap(lambda r: associate(r, math.log(0.1), diffuse=True))(ratios)
    torch.testing.assert_close(mapped.log_weights.exp(), eager.log_weights.exp())
    torch.testing.assert_close(mapped.evidence, eager.evidence)
    compiled = torch.compile(lambda r: associate(r, math.log(0.1), diffuse=True), backend="eager")(ratios)
    torch.testing.assert_close(compiled.log_weights.exp(), eager.log_weights.exp())


def test_a_scan_without_measurements_is_an_error():
    with pytest.raises(ValueError, match="log_ratio: expected"):
        associate(torch.zeros(2, 0), math.log(0.1))


def test_every_joint_event_is_enumerated_once():
    for targets, count in ((1, 3), (2, 3), (4, 2), (3, 5)):
        number = sum(math.comb(targets, k) * math.perm(count, k) for k in range(min(targets, count) + 1))
        every = joint_events(targets, count)
        assert len(every) == len({tuple(e) for e in every.tolist()}) == number
    with pytest.raises(ValueError, match="exact: expected targets"):
        joint_events(8, 12)


def test_the_pair_may_be_a_list_as_in_the_options_of_a_run():
    check_exact([4, 10])
    for bad in ([4], [4, 10.5], "ab", 4):
        with pytest.raises(ValueError, match=r"exact: expected .*, such as \(4, 10\), received"):
            check_exact(bad)
