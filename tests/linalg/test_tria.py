"""``tria`` gives the one lower root with a non-negative diagonal and its exact gradient, also where rank is lost."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchfra.compiler.operations  # noqa: F401  # fills the rules of entries
from torchfra.compiler.entries import Entries, as_entries
from torchfra.compiler.expressions import Expressions
from torchfra.compiler.program import Program, batch_first
from torchfra.compiler.source import Port, Scan
from torchfra.linalg import (
    downdate,
    gram_information,
    gram_pinv,
    hstack,
    safe_divide,
    safe_log,
    safe_sqrt,
    safe_square,
    tria,
    tria_beside,
    whiten,
)
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.tracing import elementary
from torchfra.linalg.triangular import block_diagonal, dependent, eliminated, marginal_root, split, tria_of_update

torch.manual_seed(0)


def random(*shape, dtype=torch.float64, seed=0):
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def slope(a, direction, h=1e-6):
    """Directional derivative of a weighted sum of L: by differences, and by the gradient."""
    weights = random(a.shape[0], a.shape[0], seed=9)
    numeric = ((tria(a + h * direction) - tria(a - h * direction)) / (2 * h) * weights).sum()
    a = a.clone().requires_grad_()
    (gradient,) = torch.autograd.grad((tria(a) * weights).sum(), a)
    assert gradient.isfinite().all()
    return numeric.item(), (gradient * direction).sum().item()


@settings(deadline=None, max_examples=60)
@given(
    n=st.integers(1, 7),
    p=st.integers(1, 12),
    batch=st.lists(st.integers(1, 3), max_size=2),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 1000),
)
def test_it_is_a_lower_root_with_a_non_negative_diagonal(n, p, batch, dtype, seed):
    a = random(*batch, n, p, dtype=dtype, seed=seed)
    root = tria(a)
    assert root.dtype == dtype
    assert root.shape == (*batch, n, n)
    tolerance = 100 * torch.finfo(dtype).eps
    torch.testing.assert_close(root @ root.mT, a @ a.mT, rtol=tolerance, atol=tolerance * 10)
    assert (root.triu(1) == 0).all()
    assert (root.diagonal(dim1=-2, dim2=-1) >= 0).all()


def test_at_full_rank_it_is_the_cholesky_factor():
    a = random(5, 4, 9)
    torch.testing.assert_close(tria(a), torch.linalg.cholesky(a @ a.mT))


@pytest.mark.parametrize("diagonal", [(1.0, 1, 1, 1), (1.0, 1, 0, 2)])
def test_beside_a_diagonal_matrix_it_is_the_same_without_the_zeros(diagonal):
    diagonal, a, weights = torch.tensor(diagonal).double(), random(3, 4, 6), random(3, 4, 4, seed=1)
    a[1, 0], a[2, 3] = 0, 0
    a.requires_grad_()
    expected = tria(hstack(torch.diag(diagonal), a))
    torch.testing.assert_close(tria_beside(diagonal, a), expected)
    torch.testing.assert_close(tria_beside(diagonal, a.detach()), expected.detach())
    torch.testing.assert_close(torch.func.vmap(lambda a: tria_beside(diagonal, a))(a.detach()), expected.detach())
    gradients = [torch.autograd.grad((x * weights).sum(), a)[0] for x in (tria_beside(diagonal, a), expected)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("shape", [(3, 5), (4, 4), (2, 3, 7)])
def test_gradients_of_both_orders_are_exact(shape):
    a = random(*shape).requires_grad_()
    assert torch.autograd.gradcheck(tria, a)
    assert torch.autograd.gradgradcheck(tria, a)


@pytest.mark.parametrize(("row", "times"), [(0, 1.0), (0, 0.0), (2, 0.0), (1, -2.0), (2, 3.0)])
@pytest.mark.parametrize("shape", [(4, 7), (4, 4), (2, 4, 3)])
def test_derivatives_forwards_are_those_backwards(shape, row, times):
    a, direction, weights = random(*shape), random(*shape, seed=1), random(4, 4, seed=2)
    a[..., row, :], direction[..., row, :] = times * a[..., 0, :], times * direction[..., 0, :]
    lower, rate = torch.func.jvp(tria, (a,), (direction,))
    torch.testing.assert_close(lower, tria(a))
    assert (rate.triu(1) == 0).all()
    (gradient,) = torch.autograd.grad((tria(a.requires_grad_()) * weights).sum(), a)
    torch.testing.assert_close((rate * weights).sum(), (gradient * direction).sum())


@pytest.mark.parametrize("row", range(5))
def test_the_gradient_is_exact_beside_a_zero_row_and_a_zero_column(row):
    a, direction = random(5, 8), random(5, 8, seed=1)
    a[row], a[:, 3], direction[row] = 0, 0, 0
    numeric, exact = slope(a, direction)
    assert exact == pytest.approx(numeric, rel=1e-6)


def test_the_gradient_is_exact_without_initial_uncertainty_and_with_process_noise_of_low_rank():
    gamma = torch.tensor([0.5, 1.0, 1.0], dtype=torch.float64)
    a = torch.cat([torch.zeros(6, 6), torch.kron(gamma.unsqueeze(-1), torch.eye(2))], 1).double()
    assert (tria(a).diagonal() > 0).sum() == 2
    for seed in range(5):
        change = torch.zeros(6, 8, dtype=torch.float64)
        change[0::2, 6], change[1::2, 7] = random(3, seed=seed), random(3, seed=seed + 50)
        numeric, exact = slope(a, change)
        assert exact == pytest.approx(numeric, rel=1e-6)


def test_a_matrix_of_zeros_has_finite_gradients():
    a = torch.zeros(2, 3, 4, dtype=torch.float64, requires_grad=True)
    tria(a).sum().backward()
    assert a.grad.isfinite().all()


def test_a_matrix_that_contains_nan_does_not_affect_the_others_of_its_batch():
    a = random(3, 4, 6)
    with_nan = a.clone()
    with_nan[1, 0, 0] = torch.nan
    torch.testing.assert_close(tria(with_nan)[[0, 2]], tria(a)[[0, 2]], rtol=0, atol=0)


# ---------------------------------------------------------------- scale


def with_gradient(a, weights, root=tria):
    """The root, and the gradient of its weighted sum."""
    a = a.clone().requires_grad_()
    lower = root(a)
    (gradient,) = torch.autograd.grad((lower * weights).sum(), a)
    return lower.detach(), gradient


def in_a_kernel(a, weights):
    """The same, computed by a kernel."""
    book = Expressions()
    x, w = (Entries.inputs(book, y.shape, a.dtype) for y in (a, weights))
    x.requires_grad_()
    with elementary():
        lower = tria(x)
        (gradient,) = torch.autograd.grad(lower, x, w)
    reads = [Port(y.ids.flatten().tolist(), y.shape) for y in (x, w)]
    writes = [Port(y.ids.flatten().tolist(), y.shape, timed=True) for y in (lower, gradient)]
    program = Program(Scan(book, [], [], reads, writes, dtype=a.dtype))
    return [batch_first(y, 1)[0, 0] for y in program(torch.Size([1]), 1, [a, weights])]


WAYS = {
    "eager": with_gradient,
    "vmap": lambda a, w: with_gradient(a, w, lambda x: torch.func.vmap(tria)(x.unsqueeze(0)).squeeze(0)),
    "torch.compile": lambda a, w: with_gradient(a, w, torch.compile(tria, backend="eager", fullgraph=True)),
    "kernel": in_a_kernel,
}


def by_torch(a):
    """The root as ``torch.linalg.qr`` alone gives it; of full rank, so that signs are all there is to agree on."""
    lower = torch.linalg.qr(a.mT, mode="reduced").R.mT
    return lower * lower.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_eager_code_and_kernels_have_the_root_of_torch_linalg_qr_and_its_gradient(way, dtype):
    a, weights = random(4, 7, dtype=dtype), random(4, 4, dtype=dtype, seed=1).tril()
    expected = with_gradient(a, weights, by_torch)
    tolerance = 200 * torch.finfo(dtype).eps
    for found, right in zip(WAYS[way](a, weights), expected, strict=True):
        torch.testing.assert_close(found, right, rtol=tolerance, atol=tolerance)


def test_a_call_that_needs_no_gradient_has_the_root_of_mode_r_to_the_bit():
    a = random(6, 4, 7)
    padded = torch.cat([torch.zeros(6, 4, 4, dtype=a.dtype), a], -1)
    torch.testing.assert_close(tria(a), -torch.linalg.qr(padded.mT, mode="r").R.mT, rtol=0, atol=0)
    torch.testing.assert_close(tria(a.clone().requires_grad_()).detach(), tria(a), rtol=0, atol=0)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("dtype", "powers"), [(torch.float64, [-1000, -530, 530, 1000]),
                                               (torch.float32, [-120, -83, 63, 120])])  # fmt: skip
def test_rows_of_any_scale_have_the_root_and_the_gradient_of_that_scale(way, dtype, powers):
    """With a diagonal D, the root of D A is D L, and its gradient D^-1 times that of L; powers of 2 change no bit."""
    a, weights = random(4, 7, dtype=dtype), random(4, 4, dtype=dtype, seed=1).tril()
    expected, gradient = with_gradient(a, weights)
    tolerance = 100 * torch.finfo(dtype).eps
    for power in powers:
        for rows in ([power] * 4, [0, power, 0, power // 2]):
            d = torch.tensor([2.0**p for p in rows], dtype=dtype).unsqueeze(-1)
            found, slope_found = WAYS[way](a * d, weights / d)
            torch.testing.assert_close(found / d, expected, rtol=tolerance, atol=tolerance)
            torch.testing.assert_close(slope_found * d, gradient, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("zeros", [[0], [0, 1], [0, 1, 2], [1, 3]])
def test_a_tall_matrix_with_rows_of_zeros_keeps_its_other_rows(way, zeros):
    """As of missing elements above those of a state: a row of zeros takes none of the few directions there are."""
    a, weights = random(5, 3), random(5, 5, seed=1).tril()
    a[zeros] = 0
    lower, _ = WAYS[way](a, weights)
    torch.testing.assert_close(lower @ lower.mT, a @ a.mT)


@pytest.mark.parametrize("way", WAYS)
def test_beside_rows_of_zeros_the_gradient_is_the_same_in_every_way(way):
    a, weights = random(4, 7), random(4, 4, seed=1).tril()
    a[[0, 2]] = 0
    torch.testing.assert_close(WAYS[way](a, weights)[1], with_gradient(a, weights)[1])


@pytest.mark.parametrize("power", [-600, 600])
def test_a_lost_rank_is_seen_at_any_scale(power):
    a, weights = random(4, 7), random(4, 4, seed=1).tril()
    a[3] = a[1]
    _, expected = with_gradient(a, weights)
    _, found = with_gradient(a * 2.0**power, weights * 2.0**-power)
    torch.testing.assert_close(found * 2.0**power, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("rcond", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("shape", [(2, 2), (3, 2), (2, 3), (4, 2, 2)])
def test_gram_pinv_is_that_of_the_truncated_pseudo_inverse(shape, rcond):
    h = random(*shape, seed=1).requires_grad_()
    pinv = np.linalg.pinv(h.detach().numpy(), rcond=rcond or 1e-15)
    torch.testing.assert_close(gram_pinv(h, rcond).detach(), torch.from_numpy(np.swapaxes(pinv, -1, -2) @ pinv))
    assert torch.autograd.gradcheck(lambda x: gram_pinv(x, rcond), h)


def test_gram_pinv_has_a_gradient_where_singular_values_coincide():
    assert torch.autograd.gradcheck(lambda x: gram_pinv(x, 0.1), torch.eye(3, dtype=torch.float64, requires_grad=True))


@pytest.mark.parametrize(("dtype", "least"), [(torch.float32, 1e-5), (torch.float64, 1e-11)])
def test_little_information_is_kept(dtype, least):
    """An eigenvalue of 1 - p tells p: without it the mean would be off by a share of the root of p of its deviation."""
    h = torch.tensor([0.5, 1 - least, 1.0, 1.5], dtype=torch.float64).sqrt().diag().to(dtype)
    root, weight = gram_information(h)
    expected = torch.tensor([1.0, least**0.5, 0.0, 0.0], dtype=dtype).diag()
    torch.testing.assert_close(root, expected, rtol=1e-2, atol=0)
    torch.testing.assert_close((root @ weight).diagonal()[:2], 1 / h.diagonal()[:2].square(), rtol=1e-4, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_much_information_is_kept_with_its_gradient_as_long_as_numbers_hold_it(dtype):
    h = torch.tensor([[torch.finfo(dtype).max ** -0.31]], dtype=dtype, requires_grad=True)
    root, _ = gram_information(h)
    torch.testing.assert_close(root, 1 / h)
    (slope,) = torch.autograd.grad(root, h)
    torch.testing.assert_close(slope, -1 / h.detach().square())
    assert gram_information(h.detach() / torch.finfo(dtype).max ** 0.03)[0] == 0


def test_small_helpers():
    assert hstack(torch.ones(3, 2, 1), torch.zeros(2, 4)).shape == (3, 2, 5)
    root, v = tria(random(4, 3, 5)), random(4, 3)
    torch.testing.assert_close((root @ whiten(root, v).unsqueeze(-1)).squeeze(-1), v)


# ---------------------------------------------------------------- as kernels do it


def as_in_kernels(work):
    """What a function gives where decompositions are loops of elementary arithmetic."""
    with elementary(lambda function, ranks, tensors: function(*tensors)):
        return work()


LOOPS = {
    "gram_pinv of two rows": lambda: gram_pinv(random(5, 2, 4), 0.3),
    "gram_pinv of a wide matrix": lambda: gram_pinv(random(5, 3, 4), 0.3),
    "gram_pinv of a tall matrix": lambda: gram_pinv(random(5, 4, 2), 0.0),
    "gram_information": lambda: torch.stack(gram_information(0.4 * random(5, 4, 4))),
    "downdate": lambda: downdate(random(5, 3, 3).tril() + 3 * torch.eye(3), 0.5 * random(5, 3, 2, seed=1))[0],
    "tria of many columns": lambda: tria(random(5, 2, 23), graded=False),
    "split": lambda: [x @ x.mT for x in split(random(5, 4, 6), 2)[:3]],
}


@pytest.mark.parametrize("name", LOOPS)
def test_loops_of_elementary_arithmetic_give_what_lapack_gives(name):
    torch.testing.assert_close(as_in_kernels(LOOPS[name]), LOOPS[name]())


@pytest.mark.parametrize("way", [lambda work: work(), as_in_kernels])
@pytest.mark.parametrize("unit", [True, False])
def test_the_root_of_an_update_is_that_of_the_whole_matrix_with_its_gradient(unit, way):
    """Of two measurements that read two of three states."""
    noise, read, root = random(4, 2, 3), random(4, 2, 2, seed=1), tria(random(4, 3, 3, seed=2))
    top, bottom = hstack(noise, read, torch.zeros(4, 2, 1)), hstack(torch.zeros(4, 3, 3), root)
    a, weights = torch.cat([top, bottom], -2).double(), random(5, 5, seed=3).tril()
    identity = torch.eye(5, 2).double()
    whole = with_gradient(a, weights, lambda x: tria(hstack(identity, x) if unit else x))
    found = way(lambda: with_gradient(a, weights, lambda x: tria_of_update(x, 2, 2, unit=unit)))
    torch.testing.assert_close(found, whole)
    torch.testing.assert_close(way(lambda: tria_of_update(a, 2, 2, unit=unit)), whole[0])


@pytest.mark.parametrize("states", [slice(2), slice(0, 3), slice(1, 4), slice(0, 4, 2)])
def test_some_components_have_the_root_of_their_covariance(states):
    root = tria(random(5, 4, 6))
    marginal, covariance = marginal_root(root, states), (root @ root.mT)[..., states, states]
    torch.testing.assert_close(marginal @ marginal.mT, covariance)
    assert (marginal.triu(1) == 0).all()


def test_matrices_along_a_diagonal_have_zeros_beside_them():
    blocks = random(3, 1, 2, 3), random(2, 1, 1, seed=1), random(3, 2, 2, 0, seed=2)
    expected = torch.zeros(3, 2, 5, 4).double()
    expected[..., :2, :3], expected[..., 2:3, 3:] = blocks[0], blocks[1]
    assert torch.equal(block_diagonal(blocks), expected)


# ---------------------------------------------------------------- squares, roots, logarithms and quotients

SAFE = {
    "square": (safe_square, [3.0, 1e110, 1e200, -math.inf], [9.0, 1e220, math.inf, math.inf], [6.0, 0.0, 0.0, 0.0]),
    "sqrt": (safe_sqrt, [4.0, 0.0, -1.0], [2.0, 0.0, 0.0], [0.25, 0.0, 0.0]),
    "log": (safe_log, [2.0, 0.0, -1.0], [math.log(2), -math.inf, -math.inf], [0.5, 0.0, 0.0]),
    "log of a subnormal": (safe_log, [1.0, 1e-310], [0.0, -math.inf], [1.0, 0.0]),
    "log, filled": (lambda x: safe_log(x, fill=0.0), [2.0, 0.0], [math.log(2), 0.0], [0.5, 0.0]),
    "divide": (lambda x: safe_divide(3.0, x), [2.0, 0.0, -1.0], [1.5, 0.0, -3.0], [-0.75, 0.0, -3.0]),
    "divide, filled": (lambda x: safe_divide(3.0, x, fill=7.0), [2.0, 0.0], [1.5, 7.0], [-0.75, 0.0]),
}


@pytest.mark.parametrize("name", SAFE)
def test_safe_functions_have_finite_derivatives_of_both_orders_at_the_edge(name):
    function, arguments, values, slopes = SAFE[name]
    x = torch.tensor(arguments, dtype=torch.float64, requires_grad=True)
    y = function(x)
    np.testing.assert_allclose(y.detach(), values)
    (first,) = torch.autograd.grad(torch.where(y.isfinite(), y, 0.0).sum(), x, create_graph=True)
    np.testing.assert_allclose(first.detach(), slopes)
    (second,) = torch.autograd.grad(first.sum(), x)
    assert second.isfinite().all()
    assert second[0] != 0
    assert (second[x == 0] == 0).all()


def test_the_gradient_of_a_safe_quotient_reaches_the_numerator_only_where_it_counts():
    a = torch.ones(2, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(safe_divide(a, torch.tensor([4.0, 0.0]).double()).sum(), a)
    assert gradient.tolist() == [0.25, 0.0]


def test_nan_is_filled_by_root_and_logarithm_and_stays_in_a_quotient():
    nan = torch.tensor([math.nan])
    assert safe_sqrt(nan).item() == 0
    assert safe_log(nan).item() == -math.inf
    assert safe_divide(1.0, nan).isnan().all()


@pytest.mark.parametrize("name", SAFE)
def test_safe_functions_run_under_torch_compile_and_in_kernels(name):
    function, arguments, values, _ = SAFE[name]
    x = torch.tensor(arguments, dtype=torch.float64)
    np.testing.assert_allclose(torch.compile(function, backend="eager", fullgraph=True)(x), values)
    traced = function(as_entries(book := Expressions(), x))
    assert isinstance(traced, Entries)
    np.testing.assert_allclose([book.values[i] for i in traced.ids.tolist()], values)


@pytest.mark.parametrize("graded", [False, True])
def test_rows_are_taken_out_of_others_at_any_rank(graded):
    rng = torch.Generator().manual_seed(3)
    a = torch.randn(4, 5, 7, generator=rng).double()
    a[0, 1] = 2 * a[0, 0]  # it depends on the row above
    a[1, 0] = 0.0
    root, cross, rest, dependent = eliminated(a, 3, 1e-13, graded=graded)
    assert dependent.tolist() == [[False, True, False], [True, False, False], [False] * 3, [False] * 3]
    rebuilt = torch.where(dependent.unsqueeze(-2), 0.0, root)  # without the ones that stand for nothing
    whole = torch.cat([torch.cat([rebuilt, torch.zeros(4, 3, 7)], -1), torch.cat([cross, rest], -1)], -2).double()
    own = a[:, :3] @ a[:, :3].mT
    independent = (~dependent).unsqueeze(-1) & (~dependent).unsqueeze(-2)
    product = whole @ whole.mT
    torch.testing.assert_close(torch.where(independent, product[:, :3, :3], 0.0), torch.where(independent, own, 0.0))
    torch.testing.assert_close(product[:, 3:, 3:], a[:, 3:] @ a[:, 3:].mT)
    torch.testing.assert_close(cross[2:], tria(a)[2:, 3:, :3])  # of full rank


def test_a_row_that_depends_on_those_above_is_found_in_columns_of_any_scale():
    a = random(3, 6, dtype=torch.float32) * torch.tensor([1e6, 1.0, 1e-6, 1.0, 1e3, 1e-3])
    a[1] = -2 * a[0]
    a[2, 0] = 1e9
    *_, dependent = eliminated(a, 3, 48 * torch.finfo(torch.float32).eps, graded=True)
    assert dependent.tolist() == [False, True, False]


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_a_row_depends_on_those_above_it_in_every_unit(unit):
    root = torch.tensor([[1.0, 0, 0], [1.0, 1e-18, 0], [0.5, 0.0, 1e-6]], dtype=torch.float64)
    assert dependent(unit * root, 3).tolist() == [False, True, False]


def test_what_is_left_of_rows_has_nothing_along_those_taken_out_however_alike_they_are():
    """Where columns are of any scale, to the last digit of what is left and not of what was there."""
    rng = torch.Generator().manual_seed(5)
    a = torch.randn(1, 4, 6, generator=rng).double()
    a[:, 1:] = 1e6 * a[:, :1] + a[:, 1:]
    a = a * torch.tensor([1e5, 1.0, 1.0, 1e-3, 1.0, 1.0])
    root, cross, rest, _ = eliminated(a, 2, 1e-13, graded=True)
    units = torch.linalg.solve_triangular(root, a[:, :2], upper=False)
    torch.testing.assert_close(cross @ units + rest, a[:, 2:], rtol=1e-9, atol=0)
    along = (rest.unsqueeze(-2) * units.unsqueeze(-3)).sum(-1)
    assert (along.abs() < 1e-9 * rest.norm(dim=-1, keepdim=True)).all()


def test_shapes_broadcast_as_those_of_torch_or_are_refused_as_there():
    shapes = [(), (1,), (2,), (3,), (1, 2), (2, 1), (2, 3), (4, 1, 1), (0,)]
    for some in itertools.product(shapes, repeat=3):
        try:
            expected = torch.broadcast_shapes(*some)
        except RuntimeError:
            with pytest.raises(RuntimeError, match="do not broadcast"):
                broadcast_shapes(*some)
        else:
            assert broadcast_shapes(*some) == expected
