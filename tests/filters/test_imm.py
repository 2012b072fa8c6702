"""Interacting models are what moment-form arithmetic says, keep every model alive, and take any filter inside."""

import math
from functools import partial

import numpy as np
import oracles
import pytest
import torch

from torchfra import presets, scenarios
from torchfra.filters import IMM
from torchfra.hyper import hypers
from torchfra.metrics import rmse
from torchfra.motion import (
    Bank,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    CurrentStatistical,
    Embedded,
    Motion,
)
from torchfra.robust import Huber
from torchfra.sensors import Position
from torchfra.types import Gaussian

DT, SIGMA, STEPS = 2.0, 30.0, 10
SENSOR = Position(SIGMA)
PRIOR = Gaussian(
    torch.tensor([0, 2000, 15, 0, 0, 0], dtype=torch.float64),
    torch.diag(torch.tensor([30, 30, 15, 15, 0.3, 0.3], dtype=torch.float64)),
)


def bank():
    return [
        ConstantVelocity(1e-4, orders=3),
        ConstantAcceleration(4e-4),
        CurrentStatistical(1 / 20, 1.0),
        CoordinatedTurn(math.pi / 400, 4e-4, orders=3),
        CoordinatedTurn(-math.pi / 100, 4e-4, orders=3),
    ]


def measured(batch, seed=0):
    """Straight, then turning."""
    g = torch.Generator().manual_seed(seed)
    t = DT * torch.arange(1, STEPS + 1, dtype=torch.float64)
    x = torch.stack([15 * t, 2000 + 0.15 * (t - 10).clamp_min(0) ** 2], -1)
    return x + SIGMA * torch.randn(batch, STEPS, 2, dtype=torch.float64, generator=g)


def of(motion):
    """A motion for the oracle."""
    dt = torch.tensor(DT, dtype=torch.float64)

    def model(mean):
        F, noise = motion.transition(dt), motion.process_noise(dt)
        follows, shift = motion.adaptation(dt), torch.zeros(6, dtype=torch.float64)
        if follows is not None:
            shift, noise = follows(torch.from_numpy(mean), None, noise)
        return F.numpy(), shift.numpy(), (noise @ noise.mT).numpy()

    return model


def same(a, b, tolerance=1e-10):
    torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance * b.abs().max().item())


# ---------------------------------------------------------------- what it computes


def test_it_is_the_moment_form():
    z, count = measured(1)[0], 5
    f = presets.imm(bank(), SENSOR, initial=torch.tensor([0.5, 0.2, 0.1, 0.1, 0.1], dtype=torch.float64))
    e = f(z, PRIOR, dt=DT)
    H = np.zeros((2, 6))
    H[0, 0] = H[1, 1] = 1
    covariance = (PRIOR.scale_tril @ PRIOR.scale_tril.mT).numpy()
    rows = 0.95 * np.eye(count) + 0.0125 * (1 - np.eye(count))
    initial = np.array([0.5, 0.2, 0.1, 0.1, 0.1])
    models = [of(m) for m in bank()]
    r = oracles.imm(z.numpy(), PRIOR.mean.numpy(), covariance, models, H, SIGMA**2 * np.eye(2), rows, initial)
    same(e.mean, torch.from_numpy(r["mean"]))
    same(e.covariance, torch.from_numpy(r["P"]))
    same(e.info.probabilities, torch.from_numpy(r["probabilities"]))
    same(e.log_likelihood, torch.from_numpy(r["log_likelihood"]))


@pytest.mark.parametrize("inner", ["srckf", "ukf", "ekf", "rsrckf", "rmckf"])
def test_one_model_is_the_filter_itself(inner):
    z = measured(3)
    alone = getattr(presets, inner)(ConstantAcceleration(0.01), SENSOR)(z, PRIOR, dt=DT)
    one = presets.imm([ConstantAcceleration(0.01)], SENSOR, inner=getattr(presets, inner))(z, PRIOR, dt=DT)
    for a, b in zip(one[:4], alone[:4], strict=True):
        same(a, b)
    assert (one.info.probabilities == 1).all()


def test_ckf_and_srckf_inside_are_the_same_filter():
    ckf, srckf = (f(bank(), SENSOR)(measured(2), PRIOR, dt=DT) for f in (presets.imm_ckf, presets.imm_srckf))
    assert torch.equal(ckf.mean, srckf.mean)


def test_models_that_are_the_same_stay_as_likely_as_they_were():
    e = presets.imm([ConstantAcceleration(0.01)] * 3, SENSOR)(measured(2), PRIOR, dt=DT)
    same(e.info.probabilities, torch.full_like(e.info.probabilities, 1 / 3))
    same(e.mean, presets.srckf(ConstantAcceleration(0.01), SENSOR)(measured(2), PRIOR, dt=DT).mean)


def test_a_probability_too_small_for_a_number_comes_back():
    models = [ConstantVelocity(1e-8, orders=3), ConstantVelocity(1e-3, orders=3)]
    f = presets.imm(models, Position(0.01), self_transition=0.999)
    t = torch.arange(-19, 41, dtype=torch.float64).unsqueeze(-1)
    z = 5 * (t.clamp(0, 10) ** 2 + 20 * (t - 10).clamp_min(0)).expand(-1, 2)  # at rest, speeding up, at constant speed
    prior = Gaussian(torch.zeros(6, dtype=torch.float64), 0.01 * torch.eye(6, dtype=torch.float64))
    state, lowest = f.init(prior), 0.0
    for k in range(60):
        state, _ = f.step(state, z[k])
        lowest = min(lowest, state.log_weights[0].item())
        if k == 19:
            assert state.log_weights[0] > math.log(0.9)
    assert lowest < math.log(1e-300)
    assert state.log_weights[0] > math.log(0.5)
    assert state.belief.mean.isfinite().all()


def test_an_outlier_says_much_less_of_the_model_of_a_robust_filter():
    z = measured(1)[0]
    z[4] += 40 * SIGMA
    models = [
        ConstantVelocity(1e-4, orders=3),
        CoordinatedTurn(-math.pi / 100, 4e-4, orders=3),
        ConstantAcceleration(25.0),
    ]
    plain, robust = (presets.imm(models, SENSOR, inner=i)(z, PRIOR, dt=DT).info.probabilities[4, 2]
                     for i in (presets.srckf, presets.rsrckf))  # fmt: skip
    assert 1 - plain < 1e-9
    assert 1 - robust > 1e-2


# ---------------------------------------------------------------- how it behaves


@pytest.mark.slow
def test_transition_rows_learn_on_the_simplex():
    rows = torch.full((3, 3), 0.025) + 0.925 * torch.eye(3)
    f = presets.imm(bank()[:3], SENSOR, transition=rows, learn=("transition", "initial"))
    z = measured(2)[:, :6]
    optimiser = torch.optim.Adam(f.parameters(), lr=0.5)
    before = f(z, PRIOR, dt=DT).log_likelihood.mean()
    for _ in range(5):
        optimiser.zero_grad()
        loss = -f(z, PRIOR, dt=DT).log_likelihood.mean()
        loss.backward()
        optimiser.step()
    assert -loss > before
    same(f.transition().sum(-1), torch.ones(3, dtype=torch.float64))


def test_models_that_learn_are_copies():
    models = bank()
    f = presets.imm(models, SENSOR, learn="all")
    assert not any(h.raw.requires_grad for m in models for h in hypers(m).values())
    assert f.motion.models[1].q.raw.requires_grad
    fixed = presets.imm(bank(), SENSOR)
    fixed.load_state_dict(f.state_dict())


def test_the_filter_that_is_handed_in_stays_as_it_was_and_a_copy_of_it_runs():
    bank = scenarios.bearings_outliers().bank
    inner = presets.rsrckf(bank, Position(1.0), threshold=torch.tensor([1.0, 2.0]).double())
    f = IMM(inner, transition=torch.full((3, 3), 1 / 3))
    assert inner.robust.threshold().shape == (2,)
    assert f.inner.robust.threshold().shape == (2, 1)  # one for all models of each track
    f.motion[0].q.set(7.0)
    assert bank[0].q() != 7.0


@pytest.mark.parametrize("compiled", [False, True])
def test_a_part_that_is_replaced_later_has_values_of_each_track_too(compiled):
    thresholds = torch.tensor([0.3, 3.0]).double()  # of as many tracks as models
    bank, z = [ConstantVelocity(q) for q in (0.1, 10.0)], torch.tensor([3.0, -2.0]).double().expand(2, 5, 2)
    prior = Gaussian(torch.zeros(4).double(), 5 * torch.eye(4).double())
    given = presets.imm(bank, Position(1.0), inner=lambda *models: presets.rsrckf(*models, threshold=thresholds))
    later = presets.imm(bank, Position(1.0), inner=presets.rsrckf)
    later.inner.robust = Huber(thresholds)
    if compiled:
        later.compile()
    same(later(z, prior).mean, given(z, prior).mean)
    state, _ = later.step(later.init(Gaussian(prior.mean.expand(2, 4), prior.scale_tril)), z[:, 0])
    same(state.belief.mean, given(z, prior).mean[:, 0])


def test_a_smaller_state_is_put_into_the_larger_one_by_maps():
    into = torch.eye(6, 4, dtype=torch.float64)
    inside = Embedded(ConstantVelocity(0.5), into.mT, into, orders=3)
    outside = ConstantVelocity(0.5, orders=3)
    dt = torch.tensor([1.0, 3.0], dtype=torch.float64)
    same(inside.transition(dt), outside.transition(dt))
    same(inside.process_noise(dt), outside.process_noise(dt))
    assert inside.shift(dt, None) is None


class Curved(Motion):
    """Not linear."""

    def __init__(self, bend):
        super().__init__(2, 3, 0.1)
        self.bend = bend

    def forward(self, x, dt, u=None):
        p, v, a = x[..., :2], x[..., 2:4], x[..., 4:]
        dt = dt.unsqueeze(-1) if dt.dim() else dt
        return torch.cat([p + dt * v, v + dt * a, a - self.bend * v.tanh()], -1)


def test_motions_that_are_not_linear_interact_as_well():
    z = measured(2)
    one = presets.imm([Curved(0.1), Curved(0.1)], SENSOR)(z, PRIOR, dt=DT)
    same(one.mean, presets.srckf(Curved(0.1), SENSOR)(z, PRIOR, dt=DT).mean)
    two = presets.imm([Curved(0.1), Curved(0.01)], SENSOR)(z, PRIOR, dt=DT)
    assert (two.info.probabilities - 0.5).abs().max() > 1e-3


class Pushed(ConstantAcceleration):
    """With a known push, its own in each track where ``u`` says so."""

    def shift(self, dt, u):
        push = torch.tensor([1.0, -2, 0, 0, 0, 0], dtype=torch.float64)
        return push if u is None else push * u


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("given", ["nothing", "dt of tracks", "dt of steps", "u of tracks", "u of steps"])
def test_a_known_push_pushes_every_model(batch, given):
    z = measured(batch)
    z = z[0] if batch == 1 else z
    if given.startswith("u"):
        call = {"u": torch.linspace(0.5, 2, STEPS, dtype=torch.float64)[:, None], "dt": DT}
        if given == "u of tracks" and batch > 1:
            call["u"] = call["u"] * torch.linspace(1, 2, batch, dtype=torch.float64)[:, None, None]
    else:
        steps = {
            "nothing": torch.tensor(DT),
            "dt of tracks": torch.full((batch, 1), DT),
            "dt of steps": torch.full((STEPS,), DT),
        }
        call = {"dt": (steps[given][0] if given == "dt of tracks" and batch == 1 else steps[given]).double()}
    one = presets.srckf(Pushed(0.01), SENSOR)(z, PRIOR, **call)
    same(presets.imm([Pushed(0.01)] * 2, SENSOR)(z, PRIOR, **call).mean, one.mean)


@pytest.mark.parametrize("inner", ["rsrckf", "fra"])
@pytest.mark.parametrize("batch", [2, 3])
def test_a_value_for_each_track_is_that_of_all_its_models(inner, batch):
    z, values = measured(batch), torch.linspace(0.3, 2.0, batch, dtype=torch.float64)
    make = getattr(presets, inner)
    whole = presets.imm(bank()[:3], SENSOR, inner=partial(make, threshold=values))(z, PRIOR, dt=DT)
    assert whole.mean.shape == (batch, STEPS, 6)
    for i in range(batch):
        f = presets.imm(bank()[:3], SENSOR, inner=partial(make, threshold=values[i].item()))
        same(whole.mean[i], f(z[i], PRIOR, dt=DT).mean)


def test_motions_that_are_not_linear_take_what_they_need_to_know():
    z, u = measured(1)[0], torch.zeros(STEPS, 2, dtype=torch.float64)
    one = presets.srckf(Curved(0.1), SENSOR)(z, PRIOR, dt=DT, u=u)
    same(presets.imm([Curved(0.1)] * 2, SENSOR)(z, PRIOR, dt=DT, u=u).mean, one.mean)


@pytest.mark.slow
def test_a_bank_that_knows_the_turn_follows_it_with_a_robust_filter_inside():
    scenario = scenarios.bearings_manoeuvre("std")
    tracks = scenario.simulate(100, 7)
    models = [ConstantAcceleration(0.01), *(CoordinatedTurn(s * math.pi / 10, 0.01, orders=3) for s in (1, -1))]

    def error(f):
        return rmse(f(tracks.z, tracks.prior, u=tracks.u).mean, tracks.truth, scenario.position).mean()

    alone = error(presets.fra(scenario.motion, scenario.sensor))
    assert error(presets.imm(models, scenario.sensor, inner=presets.rsrckf, self_transition=0.99)) < 0.5 * alone
    assert error(presets.imm_fra(models, scenario.sensor, self_transition=0.99)) < 0.5 * alone


# ---------------------------------------------------------------- errors


def test_what_does_not_fit_is_named():
    with pytest.raises(
        ValueError, match=r"models: expected motions of one state.*ConstantVelocity of \[x, y, vx, vy\]; "
    ):
        Bank([ConstantVelocity(1.0), ConstantAcceleration(1.0)])
    with pytest.raises(ValueError, match="models: expected several motions or a Bank"):
        presets.imm(ConstantAcceleration(1.0), SENSOR)
    with pytest.raises(ValueError, match=r"models: .*none"):
        presets.imm([], SENSOR)
    with pytest.raises(ValueError, match="self_transition: expected a probability above 0 and below 1"):
        presets.imm(bank(), SENSOR, self_transition=1.0)
    with pytest.raises(ValueError, match=r"transition: expected \(5, 5\) that reaches every model"):
        presets.imm(bank(), SENSOR, transition=torch.eye(3))
    with pytest.raises(ValueError, match="transition"):
        presets.imm(bank()[:2], SENSOR, transition=torch.tensor([[0.5, 0.6], [0.5, 0.5]]))
    with pytest.raises(ValueError, match=r"initial: expected \(5,\)"):
        presets.imm(bank(), SENSOR, initial=torch.ones(3) / 3)
    for preset, models in ((presets.srckf, bank()[0]), (presets.gpb, bank()), (presets.imm, bank())):
        with pytest.raises(
            ValueError, match="inner: expected SRCKF or FRA around a Bank, or a filter whose advance takes a mix"
        ):
            IMM(preset(models, SENSOR), self_transition=0.9)
    with pytest.raises(ValueError, match="out, into"):
        Embedded(ConstantVelocity(1.0), torch.eye(4), torch.eye(4), orders=3)
    with pytest.raises(ValueError, match="motion: expected a linear one"):
        Embedded(Curved(0.1), torch.eye(6).double(), torch.eye(6).double(), orders=3)
    with pytest.raises(ValueError, match="motion: expected one that does not adapt to an estimated acceleration"):
        Embedded(CurrentStatistical(0.3, 5.0), torch.eye(6), torch.eye(6), orders=3)
