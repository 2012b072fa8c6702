"""Joint association around interacting models and around GPB is that of plain loops, and keeps every promise."""

import math
from functools import partial

import numpy as np
import oracles
import pytest
import torch
from gpb_loops import of_oracle
from oracles import gpb as regimes
from oracles import joint_models

from torchfra import presets
from torchfra.angles import wrap
from torchfra.association import ChiSquare, Clutter, Euclidean
from torchfra.filters import IMM, JPDA, SRCKF
from torchfra.filters.fixed_lag import FixedLag
from torchfra.motion import Bank, ConstantVelocity, CoordinatedTurn, Spherical, aircraft
from torchfra.sensors import Position, Ranges
from torchfra.types import Gaussian

STD, STEPS, VOLUME = 2.0, 9, 400.0
TURN = CoordinatedTurn(0.3, 0.5)
PAIR = Bank([ConstantVelocity(0.05), TURN])
GPB = {
    "noise_levels": (0.1, 30.0),
    "jump_factors": (200.0,),
    "self_transition": (0.9, 0.8, 0.7, 0.1),
    "restart": (0.5, 0.3, 0.15, 0.05),
    "outlier_transition": ((0.9, 0.1), (0.6, 0.4)),
    "outlier_sizes": (9.0, 400.0),
    "outlier_shares": (0.6, 0.4),
    "prior_outlier": 0.3,
    "prior_inflation": 50.0,
}
INNER = {
    "imm": (presets.imm_srckf, PAIR),
    "vsimm": (presets.vsimm_srckf, aircraft(4.0)),
    "robust": (partial(presets.imm, inner=presets.rsrckf), PAIR),
    "fading": (partial(presets.imm, inner=presets.asrckf), PAIR),
    "gpb": (presets.gpb, ConstantVelocity(0.5)),
    "bank": (partial(presets.gpb, lag=1), PAIR),
}
each = pytest.mark.parametrize("name", INNER)
two = pytest.mark.parametrize("name", ["vsimm", "bank"])  # a subset of models, and hypotheses of several motions


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


def crowd(steps=STEPS, seed=0, batch=()):
    """Scans of two targets that meet, one of them turning, with false measurements and missed ones."""
    rng = torch.Generator().manual_seed(seed)
    t = torch.arange(1, steps + 1).double()
    one = torch.stack([6 * t, 0.0 * t], -1)
    other = torch.stack([6 * t, 20 - 4 * t + 0.3 * t**2], -1)
    own = torch.stack([one, other], -2).expand(*batch, steps, 2, 2)
    own = own + STD * torch.randn(own.shape, generator=rng).double()
    own = torch.where(torch.rand(own.shape[:-1], generator=rng).unsqueeze(-1) < 0.1, math.nan, own)
    false = one.unsqueeze(-2) + 25 * torch.randn(*batch, steps, 3, 2, generator=rng).double()
    return torch.cat([false[..., :2, :], own, false[..., 2:, :]], -2)


def priors(size, *places):
    """Beliefs at places, moving right, of states of any size."""
    mean = torch.zeros(len(places), size).double()
    mean[:, :2], mean[:, 2] = tensor(places), 6.0
    root = tensor([3.0, 3.0, 2.0, 2.0, 0.5, 0.5][:size]).diag()
    return Gaussian(mean, root.expand(len(places), size, size))


def around(name, **options):
    inner, motion = INNER[name]
    values = {"clutter": Clutter(VOLUME, rate=1.0), "detection": 0.9, "gate": ChiSquare(0.9999)} | options
    return presets.jpda(motion, Position(STD), inner=inner, **values)


def start(name, *places):
    return priors(INNER[name][1].size, *(places or ((0.0, 0.0), (0.0, 20.0))))


def carried(motion):
    """A motion's matrices for an oracle."""
    dt = tensor(1.0)
    return motion.transition(dt).numpy(), motion.process_noise(dt).numpy()


def same(estimate, probabilities, truth):
    for name, mine in (
        ("association", estimate.info.association), ("mean", estimate.mean), ("P", estimate.covariance),
        ("probabilities", probabilities),
    ):  # fmt: skip
        scale = np.abs(truth[name]).max()
        np.testing.assert_allclose(mine.movedim(0, 1), truth[name], rtol=1e-9, atol=1e-9 * scale, err_msg=name)
    doubtful = truth["association"].max(-1) < 0.9
    assert doubtful.sum() > 4  # it was not always plain whose a measurement is


@pytest.mark.parametrize("rate", [None, 2.0])
def test_interacting_models_of_two_targets_are_those_of_plain_loops(rate):
    z, prior = crowd(), priors(4, (0.0, 0.0), (0.0, 20.0))
    transition, initial = tensor([[0.8, 0.2], [0.3, 0.7]]), tensor([0.6, 0.4])
    f = JPDA(
        IMM(SRCKF(PAIR, Position(STD)), transition=transition, initial=initial),
        gate=Euclidean(15.0), clutter=Clutter(VOLUME, rate=rate), detection=0.9,
    )  # fmt: skip
    motions = [(lambda x, F=F, Q=Q: (F, 0.0, Q @ Q.T)) for F, Q in map(carried, PAIR)]
    targets = [
        joint_models.models(mean, P, motions, np.eye(2, 4), STD**2 * np.eye(2), transition.numpy(), initial.numpy())
        for mean, P in zip(prior.mean.numpy(), prior.covariance.numpy(), strict=True)
    ]
    truth = joint_models.follow(
        z.numpy(), targets, PD=0.9, density=(rate or 1.0) / VOLUME, gate=15.0, diffuse=rate is None
    )
    estimate = f(z, prior)
    same(estimate, estimate.info.inner.probabilities, truth)
    assert truth["probabilities"].max() > 0.7  # models were told apart
    assert truth["probabilities"].min() < 0.3


@pytest.mark.slow
def test_gpb_of_two_targets_is_that_of_plain_loops():
    z, prior, motion = crowd(), priors(4, (0.0, 0.0), (0.0, 20.0)), ConstantVelocity(0.05)
    f = presets.jpda(
        motion, Position(STD), inner=partial(presets.gpb, **GPB, separate_levels=0, noise="stated"),
        gate=Euclidean(15.0), detection=0.9, clutter=Clutter(VOLUME, rate=2.0),
    )  # fmt: skip
    F, SQ = carried(motion)
    # One motion: its two levels, and the jump.
    stay, restart = (np.delete(GPB[name], 2) for name in ("self_transition", "restart"))
    r = of_oracle([0, 0], list(GPB["noise_levels"]), GPB["jump_factors"], list(stay), list(restart), 1)
    r = r._replace(burst=4.0)
    q = regimes.OutlierModes(
        [[0, 1]], np.array(GPB["outlier_transition"]), list(GPB["outlier_sizes"]), list(GPB["outlier_shares"])
    )
    model = oracles.Model(F, SQ, STD * np.eye(2), lambda x, k: x[:2], np.zeros(2))
    targets = [
        joint_models.regimes(
            mean, P, [regimes.linear_motion(F, SQ)], model, r, q, GPB["prior_outlier"], GPB["prior_inflation"]
        )
        for mean, P in zip(prior.mean.numpy(), prior.covariance.numpy(), strict=True)
    ]
    truth = joint_models.follow(z.numpy(), targets, PD=0.9, density=2.0 / VOLUME, gate=15.0, diffuse=False)
    estimate = f(z, prior)
    same(estimate, estimate.info.inner.probabilities, truth)


@each
def test_without_false_measurements_and_always_detected_it_is_the_filter_itself(name):
    inner, motion = INNER[name]
    z = crowd(20)[:, 2]  # with missed scans
    assert z.isnan().any()
    prior = start(name, (0.0, 0.0))
    plain = inner(motion, Position(STD))(z, Gaussian(prior.mean[0], prior.scale_tril[0]))
    joint = around(name, clutter=Clutter(1e9), detection=1.0, gate=Euclidean(1e6))(z.unsqueeze(1), prior)
    torch.testing.assert_close(joint.mean[0], plain.mean, rtol=1e-12, atol=1e-11)
    torch.testing.assert_close(joint.scale_tril[0], plain.scale_tril, rtol=1e-12, atol=1e-11)
    for mine, theirs in zip(joint.info.inner, plain.info, strict=True):
        if isinstance(mine, torch.Tensor):
            torch.testing.assert_close(mine[0], theirs, rtol=1e-10, atol=1e-12)


@two
def test_scans_without_a_measurement_in_a_gate_are_pure_predictions(name):
    f, prior = around(name), start(name)
    none = torch.full((3, 2, 2), math.nan).double()
    empty, far = f(none, prior), f(torch.full((3, 2, 2), 1e5).double(), prior)
    torch.testing.assert_close(far.mean, empty.mean)
    torch.testing.assert_close(far.scale_tril, empty.scale_tril)
    plain = INNER[name][0](INNER[name][1], Position(STD))(none[:, 0], prior._replace(mean=prior.mean))
    torch.testing.assert_close(empty.mean, plain.mean)


@two
def test_a_target_that_fails_lets_the_others_go_on(name):
    f, z, prior = around(name), crowd(), start(name)
    mean = prior.mean.clone()
    mean[0, 2] = math.nan
    estimate = f(z, Gaussian(mean, prior.scale_tril))
    assert estimate.failed.tolist() == [True, False]
    alone = f(z, Gaussian(prior.mean[1:], prior.scale_tril[1:]))
    torch.testing.assert_close(estimate.mean[1], alone.mean[0], rtol=1e-10, atol=1e-10)


def test_a_filter_runs_on_the_measurements_in_gates_alone(monkeypatch):
    ran = []
    advance = SRCKF.advance
    monkeypatch.setattr(
        SRCKF, "advance", lambda f, s, frame, mix=None: (ran.append(frame.z.shape), advance(f, s, frame, mix))[1]
    )
    z = torch.cat([torch.tensor([[7.0, 0.0], [5.0, 1.0], [6.0, 21.0]]).double(), 1e4 + torch.zeros(50, 2).double()])
    f, state = around("imm"), around("imm").init(start("imm"))
    f.step(state, z)
    assert [shape[:-1].numel() for shape in ran] == [1, 4]  # missed; two targets of two measurements at most


def test_values_may_differ_between_targets():
    z, prior = crowd(), start("imm", (0.0, 0.0), (0.0, 5e4))
    for name, options, values in (
        ("imm", {"initial": tensor([[0.9, 0.1], [0.2, 0.8]])}, "initial"),
        ("gpb", {"prior_outlier": tensor([0.1, 0.6])}, "prior_outlier"),
    ):
        inner, motion = INNER[name]
        build = partial(presets.jpda, motion, Position(STD), clutter=Clutter(VOLUME, rate=1.0), detection=0.9)
        both = build(inner=partial(inner, **options))(z, prior)
        alone = build(inner=partial(inner, **{values: options[values][0]}))(
            z, Gaussian(prior.mean[:1], prior.scale_tril[:1])
        )
        torch.testing.assert_close(both.mean[0], alone.mean[0], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("inner", [presets.imm_srckf, presets.gpb])
def test_targets_across_the_cut_of_the_azimuth_are_those_of_any_other_direction(crossing, scans, inner):
    """The whole scene turned, so that one target flies to and fro where the azimuth jumps by a turn."""
    bank = Bank([crossing.motion, Spherical(ConstantVelocity(4.0, 3))])
    f = presets.jpda(
        bank, crossing.sensor, inner=inner, clutter=crossing.clutter, gate=Euclidean(150.0, probability=0.9999)
    )
    z, (mean, root) = scans.z[:, :12], scans.prior
    azimuth, (of_state,) = 0, bank.angles
    plain = f(z, scans.prior)
    by = -plain.mean[0, 0, 6, of_state]

    def turned(x, element):
        x = x.clone()
        x[..., element] = wrap(x[..., element] + by)
        return x

    other = f(turned(z, azimuth), Gaussian(turned(mean, of_state), root))
    assert other.mean[0, 0, :, of_state].min() < 0.1
    assert other.mean[0, 0, :, of_state].max() > 6.2
    gap = other.mean - turned(plain.mean, of_state)
    gap[..., of_state] = wrap(gap[..., of_state])
    assert gap.abs().max() < 1e-9
    torch.testing.assert_close(other.scale_tril, plain.scale_tril, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_models_that_mix_alike_search_as_those_mixed_by_rows(lost):
    """A target that is seldom seen: the beliefs of its models are widened, and what they know together follows."""
    matrix = presets.imm_srckf(PAIR, Position(STD)).matrix()
    z, prior = crowd(), priors(4, (0.0, 0.0), (0.0, 200.0))
    found = []
    for options in ({}, {"transition": matrix}):
        f = presets.jpda(
            PAIR, Position(STD), inner=partial(presets.imm_srckf, **options), lost=lost, gate=ChiSquare(0.99),
            clutter=Clutter(VOLUME, rate=1.0), detection=0.9,
        )  # fmt: skip
        found.append(f(z, prior))
    torch.testing.assert_close(found[0].mean, found[1].mean, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found[0].scale_tril, found[1].scale_tril, rtol=1e-9, atol=1e-9)


def test_what_cannot_be_followed_is_named_with_its_reason():
    build = partial(presets.jpda, sensor=Position(STD), clutter=Clutter(VOLUME))
    for inner, motion, said in (
        (presets.fra, ConstantVelocity(1.0), "received FRA of .*decides about a measurement by the next"),
        (presets.imm_fra, PAIR, "received IMM of FRA .*decides"),
        (partial(presets.imm, inner=presets.iaukf), PAIR, "expected models without an estimate of the measurement"),
        (
            presets.alphabeta,
            ConstantVelocity(1.0),
            "expected an SRCKF of one motion, IMM of several",
        ),
        (SRCKF, PAIR, "expected an SRCKF of one motion"),
    ):
        with pytest.raises(ValueError, match=f"inner: .*{said}"):
            build(motion, inner=inner)
    f = around("gpb")
    for refused in (lambda: f.smooth(crowd(), start("gpb")), lambda: FixedLag(f, 2)):
        with pytest.raises(NotImplementedError, match="JPDA around GPB"):
            refused()
    ranges = presets.jpda(
        ConstantVelocity(1.0), Ranges(tensor([[0.0, 0.0], [9.0, 0.0]]), 1.0), inner=presets.gpb,
        clutter=Clutter(extent=[1.0, 1.0]),
    )  # fmt: skip
    correlated = torch.tensor([[1.0, 0.0], [0.5, 1.0]]).double().expand(STEPS, 5, 2, 2)
    with pytest.raises(ValueError, match="noise: expected noise that is independent between blocks"):
        ranges(crowd(), start("gpb"), noise=correlated)
