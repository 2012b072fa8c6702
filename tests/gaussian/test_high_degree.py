"""Rules of high degree are exact up to their degree, and repairs of their negative weights are reported."""

import math
from itertools import product

import numpy as np
import pytest
import torch

from torchfra import linalg, presets
from torchfra.adaptive import Fading
from torchfra.filters import SRCKF
from torchfra.gaussian import fifth_degree, gauss_hermite, spherical_fifth_degree, third_degree, unscented
from torchfra.gaussian.rules import FirstOrder, SigmaPoints
from torchfra.motion import ConstantAcceleration, Motion
from torchfra.sensors import Position, Sensor
from torchfra.types import Gaussian


def moment(powers):
    """Of a standard normal: products of double factorials."""
    return math.prod(0 if p % 2 else math.prod(range(1, p, 2)) for p in powers)


def integral(rule, n, powers):
    belief = Gaussian(torch.zeros(n).double(), torch.eye(n).double())
    p = torch.tensor([*powers, *[0] * (n - len(powers))], dtype=torch.float64)
    return rule(lambda x: (x**p).prod(-1, keepdim=True), belief, torch.sub)[0].item()


@pytest.mark.parametrize("n", range(1, 9))
@pytest.mark.parametrize("make", [fifth_degree, spherical_fifth_degree])
def test_monomials_up_to_degree_five_have_their_exact_mean(make, n):
    rule = make(n)
    for powers in product(range(6), repeat=min(n, 4)):
        if sum(powers) <= 5:
            assert integral(rule, n, powers) == pytest.approx(moment(powers), abs=1e-12)
    spread = rule(lambda x: x, Gaussian(torch.zeros(n).double(), torch.eye(n).double()), torch.sub).spread
    torch.testing.assert_close(spread[:, -n:], torch.eye(n).double(), rtol=0, atol=1e-12)


def test_the_unscented_transform_without_kappa_is_the_rule_of_degree_three():
    belief = Gaussian(torch.tensor([0.3, -0.2, 1.0]).double(), torch.eye(3).double())
    value, spread, _ = unscented(kappa=0.0)(3)(torch.exp, belief, torch.sub)
    expected, columns, _ = third_degree(3)(torch.exp, belief, torch.sub)
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(spread @ spread.mT, columns @ columns.mT)


@pytest.mark.parametrize("rule", [third_degree(3), FirstOrder()])
def test_a_root_of_all_counts_as_the_root_of_each(rule):
    mean = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(0)).double()
    root = torch.tensor([[2.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.0, 1.0, 3.0]]).double()
    found = rule(torch.sin, Gaussian(mean, root), torch.sub)
    expected = rule(torch.sin, Gaussian(mean, root.expand(2, 4, 3, 3)), torch.sub)
    torch.testing.assert_close(found[:2], expected[:2])


@pytest.mark.parametrize(("order", "n"), [(2, 3), (3, 1), (3, 2), (4, 3), (5, 2)])
def test_products_of_gauss_and_hermite_are_exact_in_each_component(order, n):
    rule = gauss_hermite(order)(n)
    assert len(rule.points) == order**n + (order % 2 == 0)  # the centre is always a point
    for powers in product(range(2 * order), repeat=n):
        assert integral(rule, n, powers) == pytest.approx(moment(powers), rel=1e-11, abs=1e-10)


@pytest.mark.parametrize("make", [third_degree, unscented(0.5), fifth_degree])
def test_single_precision_keeps_a_curvature_and_finds_none_in_a_line(make):
    rule, belief = make(2), Gaussian(torch.tensor([-3.0, 2.0]), torch.tensor([[0.5, 0.0], [0.2, 0.4]]))
    wide = Gaussian(*(x.double() for x in belief))
    single, double = (rule(lambda x: x.prod(-1, keepdim=True), x, torch.sub) for x in (belief, wide))
    for a, b in zip(single, double, strict=True):
        if b is not None:
            torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-5)
    at = Gaussian(torch.tensor([-1.2345678e6, -7e5]), belief.scale_tril)
    line = rule(lambda x: 0.3 * x[..., :1] + 0.7 * x[..., 1:], at, torch.sub)
    assert (line.spread[..., :-2] == 0).all()


def test_negative_weights_are_refused_where_a_rule_does_not_say_that_it_has_them():
    points, weights = torch.tensor([[1.0, -1.0, 2.0, -2.0]]), torch.tensor([0.75, 0.75, -0.0625, -0.0625])
    with pytest.raises(
        ValueError, match=r"^weights: expected all above 0 except the centre's, received \[0\.75, 0\.75, -"
    ):
        SigmaPoints(points, weights)
    SigmaPoints(points, weights, signed=True)


@pytest.mark.slow
def test_the_rule_of_degree_five_is_not_exact_in_degree_six():
    assert integral(fifth_degree(5), 5, (6,)) == pytest.approx(9)  # not 15


@pytest.mark.parametrize(
    ("n", "points", "size"),
    [(1, 3, 1), (2, 9, 1), (3, 19, 1), (4, 25, 1), (5, 51, 2.111), (6, 73, 3.667), (7, 99, 5.667)],
)
def test_points_and_weights_are_those_of_the_table(n, points, size):
    """Of n = 4 the eight points on the axes have no weight, and are left out."""
    rule = fifth_degree(n)
    weights = rule.combine[:, 0]
    assert len(rule.points) == points
    assert (weights.abs().sum() + (1 - weights.sum()).abs()).item() == pytest.approx(size, abs=1e-3)
    assert rule.signed == (n > 4)


@pytest.mark.parametrize("n", [1, 2])
def test_in_one_and_two_dimensions_it_is_gauss_and_hermite(n):
    ours, theirs = fifth_degree(n), gauss_hermite(3)(n)
    assert sorted(ours.points.mul(1e9).round().tolist()) == sorted(theirs.points.mul(1e9).round().tolist())
    belief = Gaussian(torch.tensor([0.3, -0.2][:n]).double(), 0.7 * torch.eye(n).double())
    values = [r(lambda x: x.exp() * x[..., :1].cos(), belief, torch.sub) for r in (ours, theirs)]
    torch.testing.assert_close(values[0].value, values[1].value)


@pytest.mark.parametrize(("n", "d"), [(6, 2), (5, 2), (7, 5)])
def test_the_marginal_rule_of_the_elements_that_a_sensor_reads_has_the_same_moments(n, d):
    root, g = torch.randn(n, n, generator=torch.Generator().manual_seed(0)).double().tril(), torch.Generator()
    mean = torch.randn(n, generator=g.manual_seed(1)).double()

    def covariance(rule, k):
        value, spread, lost = rule(
            lambda x: (x[..., :d] * 0.1).sin() * x[..., :1], Gaussian(mean[:k], root[:k, :k]), torch.sub
        )
        total = spread @ spread.mT
        return value, total if lost is None else total - lost @ lost.mT

    for a, b in zip(covariance(fifth_degree(n), n), covariance(fifth_degree(n).marginal(d), d), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_the_covariance_is_the_weighted_sum_also_where_weights_are_negative():
    n, g = 6, torch.Generator().manual_seed(3)
    root, mean = torch.randn(n, n, generator=g).double().tril(), torch.randn(n, generator=g).double()

    def f(x):
        return torch.stack([x.prod(-1), (x[..., 0] * x[..., 5]).cos(), x[..., 2] ** 3], -1)

    value, spread, lost = fifth_degree(n)(f, Gaussian(mean, root), torch.sub)
    signs = [s for s in product((-1, 0, 1), repeat=n) if sum(map(abs, s)) <= 2]
    weight = {0: 1 + n * (n - 7) / 18, 1: (4 - n) / 18, 2: 1 / 36}
    points = torch.tensor(signs, dtype=torch.float64) * 3**0.5
    weights = torch.tensor([weight[sum(map(abs, s))] for s in signs], dtype=torch.float64)
    values = f(mean + points @ root.mT)
    expected = weights @ values
    torch.testing.assert_close(value, expected)
    centred = values - expected
    torch.testing.assert_close(spread @ spread.mT - lost @ lost.mT, (weights[:, None] * centred).mT @ centred)


def test_as_many_columns_are_added_and_subtracted_as_there_are_directions_of_each_sign():
    rule = fifth_degree(6)
    points, weights, extra, _ = (x.numpy() if isinstance(x, torch.Tensor) else x for x in rule._rule)
    slope = weights[:, None] * points.T
    values = np.linalg.eigvalsh(np.diag(weights) + (extra - 1) * np.outer(weights, weights) - slope @ slope.T)
    assert rule.minus.shape[1] == (values < -1e-9).sum() > 0
    assert rule.combine.shape[1] == 1 + (values > 1e-9).sum() + 6
    assert min(rule.minus.norm(dim=0).min(), rule.combine.norm(dim=0).min()) > 1e-3


# ---------------------------------------------------------------- downdates


def test_a_downdate_is_the_root_of_the_difference():
    g = torch.Generator().manual_seed(0)
    root = torch.randn(7, 4, 4, generator=g).double().tril() + 3 * torch.eye(4).double()
    lost = 0.5 * torch.randn(7, 4, 3, generator=g).double()
    root_after, repaired = linalg.downdate(root, lost)
    assert not repaired.any()
    torch.testing.assert_close(root_after @ root_after.mT, root @ root.mT - lost @ lost.mT)
    assert (root_after.diagonal(dim1=-2, dim2=-1) > 0).all()
    assert torch.equal(root_after, root_after.tril())


def test_the_gradient_of_a_downdate_is_exact():
    g = torch.Generator().manual_seed(0)
    root = (torch.randn(2, 3, 3, generator=g).double().tril() + 3 * torch.eye(3).double()).requires_grad_()
    lost = (0.5 * torch.randn(2, 3, 2, generator=g).double()).requires_grad_()
    assert torch.autograd.gradcheck(lambda r, x: linalg.downdate(r.tril(), x)[0], (root, lost))
    alike = (0.3 * torch.eye(3).double()).requires_grad_()  # where eigenvalues coincide
    assert torch.autograd.gradcheck(lambda x: linalg.downdate(torch.eye(3).double(), x)[0], (alike,))


def test_a_downdate_that_is_not_positive_is_repaired_and_reported_for_each_track():
    root = torch.eye(3).double().expand(3, 3, 3)
    lost = torch.zeros(3, 3, 1).double()
    lost[0, 0], lost[1, 1] = 0.5, 2.0
    lost.requires_grad_()
    root_after, repaired = linalg.downdate(root, lost)
    assert repaired.tolist() == [False, True, False]
    assert root_after[1, 1, 1].item() == pytest.approx(1e-6)
    (slope,) = torch.autograd.grad(root_after.sum(), lost)
    assert slope.isfinite().all()
    torch.testing.assert_close(root_after[0, 0, 0], torch.tensor(0.75).double().sqrt())


def test_a_direction_without_uncertainty_stays_as_it_is():
    root = torch.diag(torch.tensor([1.0, 0.0])).double()
    root_after, repaired = linalg.downdate(root, torch.tensor([[0.6], [0.0]]).double())
    torch.testing.assert_close(root_after, torch.diag(torch.tensor([0.8, 0.0])).double())
    assert not repaired


# ---------------------------------------------------------------- in a filter


class Bent(Motion):
    """Six states, strongly nonlinear."""

    def __init__(self, bend, dims=2, orders=3):
        super().__init__(dims, orders, 0.01)
        self.bend = bend

    def forward(self, x, dt, u=None):
        return x + self.bend * (x * x.flip(-1)).tanh() * x.flip(-1).square()


class Spiked(Motion):
    """Six states, and a spike on the axes, where weights are negative."""

    def __init__(self, dims=2, orders=3):
        super().__init__(dims, orders, 0.01)

    def forward(self, x, dt, u=None):
        off = x.square().sum(-1, keepdim=True).square() - x.pow(4).sum(-1, keepdim=True)
        return x + torch.nn.functional.pad(20 * (-off).exp(), (0, self.size - 1))


class All(Sensor):
    """Measures products of all six states."""

    def __init__(self):
        super().__init__(6, [False, False], 0.5, None)

    def forward(self, x, u=None):
        return torch.stack([x[..., 0] + 0.1 * x[..., 3] * x[..., 4], x[..., 1] + 0.1 * x[..., 2] * x[..., 5]], -1)


def oracle(motion, sensor, z, mean, P):
    """GHCKF in covariance form, point by point."""
    n = len(mean)
    signs = [s for s in product((-1, 0, 1), repeat=n) if sum(map(abs, s)) <= 2]
    weight = {0: 1 + n * (n - 7) / 18, 1: (4 - n) / 18, 2: 1 / 36}
    w = np.array([weight[sum(map(abs, s))] for s in signs])
    at = 3**0.5 * np.array(signs, dtype=float)
    SQ = motion.process_noise(torch.ones((), dtype=torch.float64)).detach().numpy()
    means, covariances = [], []

    def through(f, mean, P):
        X = mean + at @ np.linalg.cholesky(P).T
        Y = f(torch.from_numpy(X)).numpy()
        centre = w @ Y
        return X, Y - centre, centre

    for step in z:
        _, Y, mean = through(lambda x: motion(x, torch.ones(1)), mean, P)
        P = (w[:, None] * Y).T @ Y + SQ @ SQ.T
        X, Z, zhat = through(sensor, mean, P)
        Pzz = (w[:, None] * Z).T @ Z + 0.25 * np.eye(2)
        Pxz = (w[:, None] * (X - mean)).T @ Z
        K = Pxz @ np.linalg.inv(Pzz)
        mean, P = mean + K @ (step - zhat), P - K @ Pzz @ K.T
        means.append(mean)
        covariances.append(P)
    return np.array(means), np.array(covariances)


def test_the_filter_agrees_with_its_covariance_form():
    motion, sensor, g = Bent(0.05), All(), torch.Generator().manual_seed(0)
    z = torch.randn(8, 2, generator=g).double()
    prior = Gaussian(torch.full((6,), 0.3).double(), 0.5 * torch.eye(6).double())
    e = presets.ghckf(motion, sensor)(z, prior)
    mean, P = oracle(motion, sensor, z.numpy(), prior.mean.numpy(), (prior.scale_tril @ prior.scale_tril.mT).numpy())
    assert (e.info.repaired == 0).all()
    np.testing.assert_allclose(e.mean, mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(e.covariance, P, rtol=1e-8, atol=1e-9)


def test_a_filter_repairs_covariances_that_negative_weights_make_indefinite_and_counts_them():
    prior = Gaussian(torch.zeros(2, 6).double(), torch.stack([0.1 * torch.eye(6), 4 * torch.eye(6)]).double())
    f = presets.ghckf(Spiked(), Position(0.5), learn=("std",))
    e = f(torch.zeros(2, 3, 2).double(), prior)
    assert e.info.repaired[0].sum() == 0
    assert e.info.repaired[1].sum() > 0
    assert not e.failed.any()
    e.mean.square().sum().backward()
    assert f.sensor.std.raw.grad.isfinite()


@pytest.mark.slow
def test_the_compiled_filter_gives_the_same():
    """Of five states, for the compiler's time: as few as have negative weights."""
    z = torch.randn(3, 4, 1, generator=torch.Generator().manual_seed(0)).double()
    prior = Gaussian(torch.zeros(5).double(), torch.eye(5).double())
    for motion in (Spiked(1, 5),):
        slow = presets.ghckf(motion, Position(0.5, dims=1))(z, prior)
        fast = presets.ghckf(motion, Position(0.5, dims=1)).compile()(z, prior)
        torch.testing.assert_close(fast.mean, slow.mean, rtol=1e-7, atol=1e-7)
        assert torch.equal(fast.info.repaired, slow.info.repaired)


def test_fading_and_negative_weights_do_not_go_together():
    with pytest.raises(ValueError, match="rule: expected one without negative weights"):
        SRCKF(Bent(0.1), Position(1.0), rule=fifth_degree, fading=Fading())
    SRCKF(ConstantAcceleration(0.1, 1), Position(1.0, dims=1), rule=fifth_degree, fading=Fading(states=slice(0, 1)))
    with pytest.raises(ValueError, match="order: expected 2 or more"):
        gauss_hermite(1)
    with pytest.raises(ValueError, match="at most 3000 points"):
        gauss_hermite(5)(8)
    assert not third_degree(8).signed
