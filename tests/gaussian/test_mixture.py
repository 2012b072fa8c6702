"""A mixture's Gaussian has the mixture's moments, and a gradient everywhere."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra.filters.forecast import moments
from torchfra.gaussian import moment_match
from torchfra.gaussian.mixture import nearest, share_roots
from torchfra.linalg import elementary
from torchfra.types import Gaussian


def beliefs(k, n, *batch, seed=0):
    rng = torch.Generator().manual_seed(seed)
    root = torch.randn(k, *batch, n, n, dtype=torch.float64, generator=rng).tril()
    return Gaussian(torch.randn(k, *batch, n, dtype=torch.float64, generator=rng), root)


@given(k=st.integers(1, 9), n=st.integers(1, 6), kernel=st.booleans(), seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=30)
def test_mean_and_covariance_are_those_of_the_mixture(k, n, kernel, seed):
    """As kernels do it too, which merge many beliefs some after others."""
    each = beliefs(k, n, 3, seed=seed)
    log_weights = torch.log_softmax(3 * torch.randn(k, 3, generator=torch.Generator().manual_seed(seed)).double(), 0)
    with elementary(lambda function, ranks, tensors: function(*tensors)) if kernel else nullcontext():
        mixed = moment_match(each, log_weights)
    w, means, covariances = log_weights.exp().numpy(), each.mean.numpy(), each.covariance.numpy()
    mean = np.einsum("kb,kbn->bn", w, means)
    gap = means - mean
    covariance = np.einsum("kb,kbij->bij", w, covariances + gap[..., :, None] * gap[..., None, :])
    np.testing.assert_allclose(mixed.mean, mean, atol=1e-12)
    np.testing.assert_allclose(mixed.covariance, covariance, atol=1e-11)
    assert (mixed.scale_tril.diagonal(dim1=-2, dim2=-1) >= 0).all()
    assert (mixed.scale_tril.triu(1) == 0).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_forecast_of_hypotheses_has_the_moments_of_all(count):
    each, log_weights = beliefs(count, 2, seed=count), torch.log_softmax(torch.arange(1.0 * count).double(), 0)
    found, expected = moments(each, log_weights), moment_match(each, log_weights)
    torch.testing.assert_close(found.mean, expected.mean)
    torch.testing.assert_close(found.covariance, expected.covariance)


def test_samples_of_the_mixture_have_its_moments():
    each, weights = beliefs(3, 2), torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    rng = np.random.default_rng(0)
    which = rng.choice(3, 200_000, p=weights.numpy())
    x = each.mean.numpy()[which] + np.einsum(
        "sij,sj->si", each.scale_tril.numpy()[which], rng.standard_normal((200_000, 2))
    )
    mixed = moment_match(each, weights.log())
    np.testing.assert_allclose(mixed.mean, x.mean(0), atol=0.02)
    np.testing.assert_allclose(mixed.covariance, np.cov(x.T), atol=0.05)


def test_one_belief_with_all_the_weight_is_the_result_even_if_the_others_are_nan():
    each = beliefs(3, 4)
    each.mean[1], each.scale_tril[2] = torch.nan, torch.inf
    weights = torch.tensor([0.0, -torch.inf, -torch.inf], dtype=torch.float64)
    mixed = moment_match(each, weights)
    torch.testing.assert_close(mixed.mean, each.mean[0])
    torch.testing.assert_close(mixed.covariance, each.covariance[0])


def test_a_weight_that_is_nan_makes_the_result_nan():
    assert moment_match(beliefs(2, 3), torch.full((2,), torch.nan).double()).mean.isnan().all()


@pytest.mark.parametrize("logits", [[0.3, -1.0, 0.5], [0.0, -800.0, 0.0]])
def test_its_gradient_is_that_of_finite_differences_down_to_weights_of_zero(logits):
    each = beliefs(3, 3)
    logits = torch.tensor(logits, dtype=torch.float64, requires_grad=True)
    parts = [x.clone().requires_grad_() for x in each]
    assert torch.autograd.gradcheck(
        lambda mean, root, x: tuple(moment_match(Gaussian(mean, root.tril()), torch.log_softmax(x, 0))),
        (*parts, logits),
    )


@given(k=st.integers(1, 5), scale=st.sampled_from([1.0, 300.0, 1e5]), seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=30)
def test_weights_of_any_sum_are_shared_as_by_softmax_and_their_sum_is_that_of_logsumexp(k, scale, seed):
    log_weights = scale * torch.randn(k, 3, generator=torch.Generator().manual_seed(seed)).double()
    log_weights[1:, 0] = -torch.inf
    roots, log_sum = share_roots(log_weights)
    torch.testing.assert_close(roots.square(), log_weights.softmax(0))
    torch.testing.assert_close(log_sum, log_weights.logsumexp(0))


def test_shares_and_their_sum_have_exact_gradients():
    log_weights = torch.tensor([[0.3, -40.0], [-1.0, 2.0], [0.5, 2.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(share_roots, (log_weights,))
    assert torch.autograd.gradgradcheck(share_roots, (log_weights,))


def test_where_squares_overflow_under_every_model_the_nearest_counts_alone():
    """Also beside one that failed, which is infinitely far off; where one says a number, or all failed, nothing is."""
    inf, nan = torch.inf, torch.nan
    log_density = [[-inf, -inf], [-inf, -3.0], [-1.0, -2.0], [-inf, -inf], [-inf, -inf], [-inf, -inf]]
    far = [[-3e200, 2e200], [3e200, 1.0], [1.0, 2.0], [3e200, nan], [nan, nan], [2e200, 2e200]]
    expected = [[-inf, 0.0], [-inf, -3.0], [-1.0, -2.0], [0.0, -inf], [-inf, -inf], [0.0, 0.0]]
    found = nearest(torch.tensor(log_density).double(), torch.tensor(far, dtype=torch.float64).unsqueeze(-1))
    assert found.tolist() == expected
