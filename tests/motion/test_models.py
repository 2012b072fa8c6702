"""Rules integrate what they claim to; models follow their closed forms; hyperparameters keep to their range."""

import math
from itertools import product

import mpmath
import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra import metrics, presets
from torchfra.angles import near, wrap
from torchfra.gaussian import first_order, third_degree, unscented
from torchfra.hyper import Hyper, learnable
from torchfra.motion import Bank, ConstantAcceleration, ConstantVelocity, CoordinatedTurn, Motion
from torchfra.motion.blocks import arc
from torchfra.presets import fra
from torchfra.sensors import Bearings, Position, RangeBearing, Sensor
from torchfra.types import Estimate, Gaussian


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


RULES = [third_degree, unscented(), unscented(0.5, 2.0, 0.0), unscented(1.0, 0.0, 2.0)]


# ---------------------------------------------------------------- rules


@pytest.mark.parametrize("n", [1, 2, 3, 8])
@pytest.mark.parametrize("rule", RULES)
def test_polynomials_of_third_degree_have_their_exact_mean(rule, n):
    belief = Gaussian(torch.zeros(n).double(), torch.eye(n).double())
    for powers in product(range(4), repeat=min(n, 3)):
        if not 0 < sum(powers) <= 3:
            continue
        p = tensor(*powers, *[0] * (n - len(powers)))
        value, _, _ = rule(n)(lambda x, p=p: (x**p).prod(-1, keepdim=True), belief, torch.sub)
        exact = 1.0 if sorted(powers)[-1] == 2 and sum(powers) == 2 else 0.0
        assert value.item() == pytest.approx(exact, abs=1e-12)


@pytest.mark.parametrize(
    "scaling", [(1.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.5, 2.0, 0.0), (1e-2, 2.0, 0.0), (1.0, 2.0, -1.0)]
)
def test_mean_and_covariance_are_the_textbook_sums(scaling):
    n, (alpha, beta, kappa) = 4, scaling
    torch.manual_seed(0)
    root, mean = torch.randn(n, n).double().tril(), torch.randn(n).double()

    def f(x):
        return torch.stack([x[..., 0] ** 2 + x[..., 1], (x[..., 0] * x[..., 1]).sin(), x[..., 1].exp()], -1)

    scale = alpha**2 * (n + kappa)
    wm = np.full(2 * n + 1, 0.5 / scale)
    wm[0] = 1 - n / scale
    wc = wm.copy()
    wc[0] += 1 - alpha**2 + beta
    offsets = scale**0.5 * root.mT
    values = f(torch.cat([mean[None], mean + offsets, mean - offsets])).numpy()
    expected = wm @ values
    covariance = ((values - expected) * wc[:, None]).T @ (values - expected)
    rule = unscented(*scaling)(n)
    for r, d in ((rule, n), (rule.marginal(2), 2)):
        value, spread, _ = r(f, Gaussian(mean[:d], root[:d, :d]), torch.sub)
        np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(spread @ spread.mT, covariance, rtol=1e-8, atol=1e-8)


def test_the_first_order_rule_is_the_jacobian_times_the_root():
    root, mean = torch.randn(3, 3).double().tril(), tensor(0.3, -0.2, 1.0)
    value, spread, _ = first_order(3)(lambda x: x.sin() * x[..., :1], Gaussian(mean, root), torch.sub)
    torch.testing.assert_close(value, mean.sin() * mean[0])
    torch.testing.assert_close(spread, torch.func.jacrev(lambda x: x.sin() * x[:1])(mean) @ root)


def test_angles_average_across_the_cut():
    belief = Gaussian(tensor(0.0, -100.0), 20 * torch.eye(2).double())
    sensor = Bearings(0.01, stations=torch.zeros(1, 2).double())
    value, spread, _ = third_degree(2)(lambda x: sensor(x), belief, sensor.difference)
    assert abs(wrap(value - math.pi).item()) < 1e-12
    assert 0.15 < spread.norm() < 0.25


def test_rules_refuse_what_has_no_real_root():
    with pytest.raises(ValueError, match="alpha"):
        unscented(0.0)
    with pytest.raises(ValueError, match="kappa: expected a value above -6"):
        unscented(1.0, 0.0, -6.0)(6)
    with pytest.raises(ValueError, match="weights: expected a centre whose weight leaves the covariance a real root"):
        unscented(1e-3, 0.0, 0.0)(6)


# ---------------------------------------------------------------- motion


@given(dt=st.floats(0.01, 20), q=st.floats(0, 10), rate=st.floats(-1, 1, allow_subnormal=False))
@settings(deadline=None, max_examples=40)
def test_motions_are_those_of_the_oracles(dt, q, rate):
    for motion, (F, SQ) in (
        (ConstantVelocity(q), oracles.cv(dt, q)),
        (ConstantAcceleration(q), oracles.ca(dt, q)),
        (CoordinatedTurn(rate, q), oracles.turn(dt, rate, q) if rate else oracles.cv(dt, q)),
    ):
        step = torch.tensor(dt, dtype=torch.float64)
        np.testing.assert_allclose(motion.transition(step), F, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(motion.process_noise(step), SQ, rtol=1e-9, atol=1e-9)


def test_a_turn_is_the_exponential_of_its_dynamics():
    w, dt = 0.3, tensor(0.5, 2.0)
    dynamics = torch.zeros(4, 4).double()
    dynamics[0, 2] = dynamics[1, 3] = 1
    dynamics[2, 3], dynamics[3, 2] = -w, w
    exact = torch.linalg.matrix_exp(dynamics * dt[:, None, None])
    torch.testing.assert_close(CoordinatedTurn(w, 1.0).transition(dt), exact)
    space = CoordinatedTurn(w, 1.0, 3).transition(dt)
    torch.testing.assert_close(space[:, [0, 1, 3, 4]][..., [0, 1, 3, 4]], exact)
    torch.testing.assert_close(space[:, 2], torch.stack([tensor(0, 0, 1, 0, 0, 0.5), tensor(0, 0, 1, 0, 0, 2.0)]))


def test_a_turn_of_rate_zero_is_straight_and_has_a_gradient():
    motion = learnable(CoordinatedTurn(0.0, 1.0), ("rate",))
    matrix = motion.transition(torch.tensor(2.0, dtype=torch.float64))
    torch.testing.assert_close(
        matrix.detach(), ConstantVelocity(1.0).transition(torch.tensor(2.0, dtype=torch.float64))
    )
    matrix[0, 3].backward()
    assert motion.rate.raw.grad.item() == pytest.approx(-2.0)  # of -(1 - cos(w t)) / w at w = 0


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 0.5, -2.0])
def test_the_second_derivatives_of_an_arc_are_right_at_a_rate_of_zero_and_near_it(angle):
    along, across = (torch.func.grad(torch.func.grad(lambda a, i=i: arc(a)[i]))(tensor(angle)[0]) for i in (0, 1))
    with mpmath.workdps(40):
        expected = [float(mpmath.diff(f, angle, 2)) for f in (mpmath.sinc, lambda a: a / 2 * mpmath.sinc(a / 2) ** 2)]
    torch.testing.assert_close(torch.stack([along, across]), tensor(*expected), rtol=1e-12, atol=1e-12)


def test_motions_of_several_values_and_steps_broadcast():
    motion = ConstantAcceleration(torch.tensor([[0.1], [0.2], [0.3]], dtype=torch.float64), dims=3)
    assert motion.process_noise(torch.ones(5).double()).shape == (3, 5, 9, 3)
    assert motion.transition(torch.ones(5).double()).shape == (5, 9, 9)


def test_motions_refuse_what_makes_no_sense():
    with pytest.raises(ValueError, match="dims"):
        ConstantVelocity(1.0, 0)
    with pytest.raises(ValueError, match="dims"):
        CoordinatedTurn(0.1, 1.0, 1)
    with pytest.raises(ValueError, match="q: expected a value of 0 or more"):
        ConstantVelocity(-1.0)


class Orbit(Motion):
    """A user's motion, of five components, that insists on the shapes of its documentation."""

    def __init__(self):
        super().__init__(2, 2, 0.1, size=5)

    def forward(self, x, dt, u=None):
        assert x.shape[-1] == 5
        assert u.shape[-1] == 2
        assert x.shape[:-1] == dt.shape == u.shape[:-1]
        place = torch.stack([x[..., 0] + dt * x[..., 2], x[..., 1] + dt * x[..., 3] * x[..., 4].cos()], -1)
        return torch.cat([place + u, x[..., 2:]], -1)

    def process_noise(self, dt):
        return 0.1 * torch.eye(5, dtype=dt.dtype).expand(*dt.shape, 5, 5)


class Sight(Sensor):
    """A user's sensor that insists on the shapes of its documentation."""

    def __init__(self):
        super().__init__(3, [True, False], 0.1)

    def forward(self, x, u=None):
        assert x.shape[:-1] == u.shape[:-1]
        both = torch.cat([x[..., :2], u], -1)
        return torch.stack([torch.atan2(both[..., 0] - both[..., 2], both[..., 1] - both[..., 3]), x[..., 2]], -1)


@pytest.mark.parametrize("batch", [(), (2, 3)])
@pytest.mark.parametrize("dt", [0.5, "of steps", "of tracks"])
@pytest.mark.parametrize("preset", [presets.ekf, presets.fra])
def test_motions_and_sensors_of_a_user_get_the_shapes_of_their_documentation(batch, dt, preset):
    steps, generator = 4, torch.Generator().manual_seed(0)
    z = torch.randn(*batch, steps, 2, generator=generator, dtype=torch.float64)
    u = torch.randn(steps, 2, generator=generator, dtype=torch.float64)
    if dt == "of steps":
        dt = torch.linspace(0.5, 1.0, steps, dtype=torch.float64)
    elif dt == "of tracks":
        dt = torch.linspace(0.5, 1.0, math.prod(batch), dtype=torch.float64).reshape(*batch, 1)
    prior = Gaussian(torch.ones(5).double(), torch.eye(5).double())
    f = preset(Orbit(), Sight())
    together = f(z, prior, u=u, dt=dt).mean
    assert together.shape == (*batch, steps, 5)
    for index in product(*map(range, batch)):
        alone = f(z[index], prior, u=u, dt=dt[index] if isinstance(dt, torch.Tensor) and dt.dim() > 1 else dt)
        torch.testing.assert_close(together[index], alone.mean)


def test_a_motion_that_contradicts_itself_is_refused_where_it_is_defined():
    with pytest.raises(TypeError, match="Claims: linear is True: expected a transition"):

        class Claims(Motion):
            linear = True

    with pytest.raises(TypeError, match="Hides: linear is False: expected linear = True"):

        class Hides(Motion):
            def transition(self, dt):
                return torch.eye(4)

    with pytest.raises(TypeError, match=r"Adapts: linear is True: expected no process_noise_at, .* linear = False"):

        class Adapts(ConstantVelocity):
            def process_noise_at(self, process_noise, mean, dt):
                return mean[..., 2:, None] * process_noise

    with pytest.raises(TypeError, match="Lost: locates is True: expected a locate"):

        class Lost(Sensor):
            locates = True

    with pytest.raises(TypeError, match="expected a forward, or linear = True"):
        Motion(2, 2, 1.0)(torch.ones(4), torch.ones(()))


def test_a_motion_declares_which_components_are_what():
    own = Motion(2, 2, 1.0, size=6, position=slice(1, 3), velocity=slice(4, 6))
    assert (own.size, own.position, own.velocity) == (6, slice(1, 3), slice(4, 6))
    assert (ConstantVelocity(1.0, 3).position, ConstantVelocity(1.0, 3).velocity) == (slice(0, 3), slice(3, 6))
    with pytest.raises(ValueError, match="size: expected 1 or more"):
        Motion(2, 2, 1.0, size=0)


# ---------------------------------------------------------------- sensors


def test_bearings_count_from_north_in_all_quadrants():
    x = tensor([1, 1], [1, -1], [-1, -1], [-1, 1]) * 10
    expected = tensor([0.25], [0.75], [-0.75], [-0.25]) * math.pi
    torch.testing.assert_close(Bearings(0.1, stations=torch.zeros(1, 2).double())(x), expected)
    torch.testing.assert_close(Bearings(0.1, count=1)(x, torch.zeros(4, 2).double()), expected)


def test_range_bearing_and_elevation():
    x = tensor(30.0, 40.0, 120.0)
    torch.testing.assert_close(RangeBearing(1.0)(x), tensor(50.0, math.atan2(30, 40)))
    seen = RangeBearing(1.0, dims=3)(x + 7, torch.full((3,), 7.0).double())
    torch.testing.assert_close(seen, tensor(130.0, math.atan2(30, 40), math.atan2(120, 50)))


@given(st.floats(-1e3, 1e3))
def test_a_wrapped_angle_is_the_same_angle_within_half_a_turn(angle):
    wrapped = wrap(torch.tensor(angle, dtype=torch.float64)).item()
    assert abs(wrapped) <= math.pi + 1e-9
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_rounding_does_not_decide_which_way_round_half_a_turn_is(dtype):
    half = torch.tensor([-1, 1, -3, 3], dtype=dtype) * math.pi
    digit = torch.tensor([-1, 0, 1], dtype=dtype).unsqueeze(-1) * 8 * torch.finfo(dtype).eps
    assert (wrap(half * (1 + digit)) > 3).all()
    assert (near(half * (1 + digit) + 0.5, torch.full_like(half, 0.5)) > 3).all()


def test_only_angles_wrap():
    gap = RangeBearing(1.0).difference(tensor(100.0, 3.0), tensor(0.0, -3.0))
    torch.testing.assert_close(gap, tensor(100.0, 6 - 2 * math.pi))


def test_sensors_refuse_what_does_not_fit():
    for options, said in (
        ({}, "expected one of the two, received none"),
        ({"std": 1.0, "noise": torch.eye(2)}, "expected one of the two, received both"),
        ({"std": torch.ones(3)}, r"std: expected a number or \(\.\.\., 2\)"),
        ({"std": 0.0}, "std: expected a value above 0"),
        ({"noise": torch.eye(3)}, "noise: expected"),
        ({"noise": torch.ones(2, 2)}, "inverse"),
    ):
        with pytest.raises(ValueError, match=said):
            Position(**options)


# ---------------------------------------------------------------- hyperparameters


def test_a_hyperparameter_is_read_in_natural_units_and_learns_in_its_range():
    fixed, learned = Hyper(1.345), Hyper(1.345, learn=True)
    assert fixed().item() == pytest.approx(1.345, rel=1e-15)
    assert not list(fixed.parameters())
    optimiser = torch.optim.SGD(learned.parameters(), lr=100.0)
    learned().backward()
    optimiser.step()
    assert 0 <= learned().item() < 1.345
    fixed.load_state_dict(learned.state_dict())
    assert fixed().item() == learned().item()
    assert "1.345" in repr(Hyper(1.345))
    assert math.isinf(Hyper(math.inf)().item())


def test_a_hyperparameter_out_of_range_is_refused_with_its_name():
    for value in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="threshold: expected a value above 0"):
            Hyper(value, name="threshold")
    with pytest.raises(ValueError, match="expected a value inside its range, to learn it"):
        Hyper(math.inf, learn=True)
    with pytest.raises(ValueError, match=r"forgetting: expected a value in \[0, 1\], received 1.5"):
        fra(ConstantVelocity(1.0), Position(1.0), forgetting=1.5)


def test_a_hyperparameter_is_not_set_to_values_of_another_shape():
    hyper = Hyper(torch.ones(3))
    hyper.set(2.0)
    assert hyper().tolist() == pytest.approx([2.0] * 3)
    with pytest.raises(ValueError, match=r"q: expected a number or \(3,\), received \(2,\)"):
        hyper.set(torch.ones(2), "q")


# ---------------------------------------------------------------- metrics


def test_metrics_are_what_numpy_says_and_unknown_truth_does_not_count():
    torch.manual_seed(0)
    mean, truth = torch.randn(7, 5, 4).double(), torch.randn(7, 5, 4).double()
    truth[2, 3:] = torch.nan
    squared = ((mean - truth)[..., :2] ** 2).sum(-1).numpy()
    np.testing.assert_allclose(metrics.rmse(mean, truth, slice(0, 2)), np.sqrt(np.nanmean(squared, 0)))
    np.testing.assert_allclose(metrics.track_rmse(mean, truth, slice(0, 2)), np.sqrt(np.nanmean(squared, 1)))
    root = torch.randn(7, 5, 4, 4).double().tril() + 3 * torch.eye(4).double()
    estimate = Estimate(mean, root, squared, squared, None)
    for states in (slice(0, 2), slice(1, 3), slice(0, 4, 2), slice(None)):
        gap = (mean - truth)[..., states].numpy()
        inverse = np.linalg.inv(estimate.covariance[..., states, states].numpy())
        expected = np.einsum("bti,btij,btj->bt", gap, inverse, gap)
        np.testing.assert_allclose(metrics.nees(estimate, truth, states), expected)


def test_an_estimate_that_is_nan_has_diverged():
    truth = torch.zeros(3, 5, 2).double()
    mean = truth.clone()
    mean[1, 4] = torch.nan
    mean[2] = 1e4
    assert metrics.diverged(mean, truth, slice(0, 2)).tolist() == [False, True, True]
    assert metrics.rmse(mean, truth, slice(0, 2))[4].isinf()


def test_a_bank_refuses_states_without_a_dimension_of_models():
    bank = Bank([ConstantVelocity(1.0), ConstantVelocity(2.0)])
    assert bank(torch.ones(3, 2, 4), torch.tensor(1.0)).shape == (3, 2, 4)
    with pytest.raises(ValueError, match=r"x: expected states \(\.\.\., 2, 4\), received \(3, 5, 4\)"):
        bank(torch.ones(3, 5, 4), torch.tensor(1.0))
