"""Unknowns after a block of a measurement, for all sizes of its noise, are what dense covariances say."""

import numpy as np
import pytest
import torch

from torchfra.filters.gpb.updates import update

SIZES = np.array([1.0, 3.0, 12.0, 40.0])


def dense(rows, z, measured, size):
    """Mean, covariance and log density by the covariance form, of the elements that are measured."""
    h, z = rows[measured], z[measured]
    s = h @ h.T + size**2 * np.eye(len(z))
    gain = h.T @ np.linalg.inv(s)
    log_density = -0.5 * (z @ np.linalg.solve(s, z) + np.linalg.slogdet(s)[1])
    return gain @ z, np.eye(h.shape[1]) - gain @ h, log_density


@pytest.mark.parametrize("offsets", [None, (0.0, 2.0, -5.0, 30.0)])
@pytest.mark.parametrize("missing", [None, 0, -1])
@pytest.mark.parametrize("m", [1, 2, 3])
def test_each_size_and_all_but_the_first_merged(m, missing, offsets):
    rng = np.random.default_rng(m)
    rows, z, measured = rng.normal(size=(m, m)), 5 * rng.normal(size=m), np.full(m, True)
    if missing is not None:
        measured[missing] = False
        rows[missing], z[missing] = 0.0, 0.0
    tensors = (torch.tensor(x) for x in (rows, z, SIZES, 1.0 - measured))
    updated, found = update(*tensors, None if offsets is None else torch.tensor(offsets, dtype=torch.float64))
    each = [dense(rows, z - o * measured, measured, s) for o, s in zip(offsets or [0.0] * 4, SIZES, strict=True)]
    for k, (mean, covariance, density) in enumerate(each):
        assert_same(updated.of(k), mean, covariance)
        np.testing.assert_allclose(found.log(k), density, rtol=1e-12)
    shares = np.array([0.5, 0.3, 0.2])
    mean = sum(p * x for p, (x, _, _) in zip(shares, each[1:], strict=True))
    covariance = sum(p * (c + np.outer(x - mean, x - mean)) for p, (x, c, _) in zip(shares, each[1:], strict=True))
    assert_same(updated.merged(torch.tensor(shares).sqrt()), mean, covariance)
    half = updated.before_prior(2, 1)  # the second size, and the unknowns as they were
    mean, covariance = 0.5 * each[1][0], 0.5 * (each[1][1] + np.eye(m)) + 0.25 * np.outer(each[1][0], each[1][0])
    assert_same(half.merged(torch.full((2,), 0.5, dtype=torch.float64).sqrt()), mean, covariance)


def assert_same(belief, mean, covariance):
    np.testing.assert_allclose(belief.mean, mean, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(belief.covariance, covariance, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize(("dtype", "wide"), [(torch.float64, 1e60), (torch.float32, 1e14)])
def test_what_is_known_well_keeps_its_digits_beside_what_is_hardly_known(dtype, wide, m):
    rows = torch.tensor([wide, 0.5, 2.0], dtype=dtype)[:m]
    noise = torch.tensor([1.0, 10.0, 10 * wide], dtype=dtype)
    updated, _ = update(rows.diag(), rows, noise, torch.zeros(m, dtype=dtype))
    for k, size in enumerate(noise):
        variance, mean = 1 / (1 + (rows / size).square()), (rows / size).square() / (1 + (rows / size).square())
        eps = torch.finfo(dtype).eps
        torch.testing.assert_close(updated.of(k).scale_tril.square().sum(-1), variance, rtol=20 * eps, atol=0.0)
        torch.testing.assert_close(updated.of(k).mean, mean, rtol=20 * eps, atol=eps**2)


@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("far", [1e100, 1e200])
def test_a_residual_whose_square_overflows_is_an_outlier_of_that_size_with_a_finite_gradient(far, m):
    residual = torch.full((m,), far, dtype=torch.float64, requires_grad=True)
    noise = torch.cat([torch.tensor([1.0, 30.0], dtype=torch.float64), residual[:1]])
    updated, density = update(torch.eye(m, dtype=torch.float64), residual, noise, torch.zeros(m))
    log_density = torch.stack([density.log(i) for i in range(3)])
    weight = log_density.detach().softmax(0)
    assert weight[2] == 1
    np.testing.assert_allclose(log_density[2].item(), -m * (0.5 + np.log(far)), rtol=1e-12)
    belief = updated.merged(weight.sqrt())
    np.testing.assert_allclose(belief.covariance.detach(), np.eye(m), rtol=1e-12)
    (log_density[2] + belief.mean.sum() + belief.scale_tril.sum()).backward()
    assert residual.grad.isfinite().all()


@pytest.mark.parametrize("m", [1, 2, 3])
def test_infinite_noise_tells_nothing(m):
    rows, noise = torch.eye(m, dtype=torch.float64), torch.tensor([1.0, torch.inf], dtype=torch.float64)
    updated, density = update(rows, rows[0], noise, torch.zeros(m, dtype=torch.float64))
    assert_same(updated.of(1), np.zeros(m), np.eye(m))
    assert (density.log(1) - density.log(0)).exp() < 1e-300
