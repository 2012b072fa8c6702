"""Models that switch to the others with equal probability mix two beliefs: the moments are those of a full mixture."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_imm import DT, PRIOR, SENSOR, STEPS, Curved, bank, measured, same
from test_mixed_angles import Compass, Heading

from torchfra import presets
from torchfra.angles import wrap
from torchfra.filters import IMM
from torchfra.hyper import summary
from torchfra.motion import Bank, ConstantVelocity
from torchfra.types import Gaussian


def both(models, sensor=SENSOR, inner=presets.srckf, self_transition=0.95, **options):
    """By ``self_transition``, and by rows."""
    even = IMM(inner(Bank(models), sensor), self_transition=self_transition, **options)
    return even, IMM(inner(Bank(models), sensor), transition=even.matrix(), **options)


def equal(a, b, tolerance=1e-12):
    for x, y in zip((*a[:4], a.info.probabilities), (*b[:4], b.info.probabilities), strict=True):
        same(x, y, tolerance)


def times():
    """Steps of two seconds, with a second measurement at one instant."""
    dt = torch.full((STEPS,), DT, dtype=torch.float64)
    dt[5] = 0
    return dt


# ---------------------------------------------------------------- the same as by rows


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(st.integers(2, 5), st.floats(0, 0.9999), st.integers(0, 9999), st.sampled_from(["srckf", "rsrckf", "fra"]))
def test_it_is_what_whole_rows_give(count, position, seed, inner):
    generator = torch.Generator().manual_seed(seed)
    stay = 1 / count + (1 - 1 / count) * position
    initial = torch.rand(count, dtype=torch.float64, generator=generator) + 1e-3
    models = {"self_transition": stay, "initial": initial / initial.sum(), "inner": getattr(presets, inner)}
    z = measured(2, seed)
    z[0, 3], z[1, 7] = torch.nan, z[1, 7] + 300
    even, rows = both(bank()[:count], **models)
    equal(even(z, PRIOR, dt=times()), rows(z, PRIOR, dt=times()))


def test_beliefs_of_any_weights_mix_alike():
    """From states whose models differ as much as they like, one of them without any weight."""
    generator = torch.Generator().manual_seed(1)
    even, rows = both(bank(), self_transition=0.8)
    state = even.init(PRIOR)
    mean = PRIOR.mean + 100 * torch.randn(20, 5, 6, dtype=torch.float64, generator=generator)
    root = torch.randn(20, 5, 6, 6, dtype=torch.float64, generator=generator).tril()
    weights = torch.log_softmax(20 * torch.randn(20, 5, dtype=torch.float64, generator=generator), -1)
    weights[3] = torch.tensor([0, 0.25, 0.25, 0.5, 0]).double().log()
    mean[3, 0] = torch.nan  # a model that failed
    share = weights.exp().unsqueeze(-1)
    middle = (share * mean.nan_to_num()).sum(-2)
    apart = (mean.nan_to_num() - middle.unsqueeze(-2)).unsqueeze(-1)
    covariance = (share.unsqueeze(-1) * (root @ root.mT + apart @ apart.mT)).sum(-3)
    together = Gaussian(middle, torch.linalg.cholesky(covariance))
    inner = state.inner._replace(belief=Gaussian(mean, root))
    state = state._replace(belief=together, inner=inner, log_weights=weights)
    (a, seen), (b, expected) = (f.step(state, measured(20)[:, 0], dt=DT) for f in (even, rows))
    same(a.belief.mean, b.belief.mean, 1e-12)
    same(a.belief.covariance, b.belief.covariance, 1e-12)
    same(a.log_weights, b.log_weights, 1e-12)
    same(a.inner.belief.mean, b.inner.belief.mean, 1e-12)
    same(seen.log_likelihood, expected.log_likelihood, 1e-12)


def test_over_no_time_no_model_gives_way_and_gradients_are_numbers():
    f = IMM(
        presets.srckf(Bank(bank()), SENSOR), self_transition=0.9, initial=torch.tensor([0.4, 0.3, 0.2, 0.1, 0]).double()
    )
    prior = Gaussian(*(x.clone().requires_grad_() for x in PRIOR))
    _, rows = both(bank(), self_transition=0.9, initial=f.initial())
    dt = times()
    dt[6] = 0
    e = f(measured(2), prior, dt=dt)
    equal(e, rows(measured(2), PRIOR, dt=dt))
    f.self_transition.learn()
    e = f(measured(2), prior, dt=dt)
    (e.log_likelihood.sum() + e.mean.sum()).backward()
    assert all(x.grad.isfinite().all() and (x.grad != 0).any() for x in (*prior, f.self_transition.raw))


@pytest.mark.parametrize("turn", [0.0, 3.1, 6.2])
def test_angles_mix_alike_wherever_the_circle_is_cut(turn):
    even, rows = both([Heading(1e-4), Heading(1e-3), Heading(0.01)], Compass(), self_transition=0.6)
    generator = torch.Generator().manual_seed(0)
    z = wrap(turn + 0.1 * torch.randn(4, STEPS, 1, dtype=torch.float64, generator=generator).cumsum(-2))
    prior = Gaussian(torch.tensor([turn, 0.1]).double(), 0.3 * torch.eye(2, dtype=torch.float64))
    a, b = even(z, prior, dt=DT), rows(z, prior, dt=DT)
    same(a.covariance, b.covariance, 1e-12)
    same(a.info.probabilities, b.info.probabilities, 1e-12)
    away = a.mean - b.mean
    assert torch.cat([wrap(away[..., :1]), away[..., 1:]], -1).abs().max() < 1e-12


def test_motions_that_are_not_linear_and_the_backward_pass():
    even, rows = both([Curved(0.1), Curved(0.01), Curved(0.3)], self_transition=0.7)
    equal(even(measured(2), PRIOR, dt=times()), rows(measured(2), PRIOR, dt=times()))
    even, rows = both(bank(), self_transition=0.7)
    a, b = (f.smooth(measured(2), PRIOR, dt=times()) for f in (even, rows))
    same(a.mean, b.mean, 1e-10)
    same(a.covariance, b.covariance, 1e-10)


def test_a_stay_for_each_track():
    stays, z = torch.tensor([0.5, 0.9, 0.99]).double(), measured(3)
    whole = IMM(presets.srckf(Bank(bank()), SENSOR), self_transition=stays)(z, PRIOR, dt=times())
    for i, stay in enumerate(stays.tolist()):
        same(whole.mean[i], presets.imm(bank(), SENSOR, self_transition=stay)(z[i], PRIOR, dt=times()).mean, 1e-12)


# ---------------------------------------------------------------- gradients and kernels


# ---------------------------------------------------------------- which one a filter has


def test_a_preset_stays_alike_unless_rows_are_given(capsys):
    def learned(**options):
        return {name for name, _ in presets.imm(bank(), SENSOR, **options).named_parameters()}

    assert learned(learn=("self_transition",)) == {"self_transition.raw"}
    with pytest.raises(
        ValueError, match=r"learn: expected 'all' or some of .*'self_transition'.*, received 'transition'"
    ):
        learned(learn=("transition",))
    assert {"self_transition.raw", "initial.raw"} < learned(learn="all")
    matrix = presets.imm(bank(), SENSOR, self_transition=0.8).matrix()
    same(matrix.sum(-1), torch.ones(5, dtype=torch.float64))
    assert learned(transition=matrix, learn="transition") == {"transition.raw"}
    assert (
        presets.imm(bank(), SENSOR, self_transition=0.1).self_transition is None
    )  # below 1 / K: gives way more often than to any other
    summary(presets.imm(bank(), SENSOR))
    assert "[0.2, 1)" in capsys.readouterr().out


def test_what_does_not_fit_is_named():
    inner = presets.srckf(Bank(bank()), SENSOR)
    with pytest.raises(ValueError, match="transition, self_transition: expected one of the two, received neither"):
        IMM(inner)
    with pytest.raises(ValueError, match="transition, self_transition: expected one of the two, received both"):
        IMM(inner, self_transition=0.9, transition=torch.full((5, 5), 0.2))
    for stay in (0.19, 1.0):
        with pytest.raises(ValueError, match=r"self_transition: expected a value in \[0.2, 1\), received"):
            IMM(inner, self_transition=stay)
    with pytest.raises(ValueError, match="self_transition: expected None for a single model"):
        IMM(presets.srckf(Bank([ConstantVelocity(1.0)]), SENSOR), self_transition=0.9)
