"""Mean durations make Markov chains in continuous time, whatever the steps: of models, of regimes and of outliers."""

from functools import partial

import gpb_loops
import numpy as np
import oracles
import pytest
import test_imm
import torch
from oracles import gpb as oracle

from torchfra import presets
from torchfra.filters.markov import generator, transition_over
from torchfra.motion import Bank, ConstantAcceleration, ConstantVelocity, CoordinatedTurn
from torchfra.sensors import Position
from torchfra.types import Gaussian


def tensor(*x):
    return torch.tensor(x, dtype=torch.float64)


LAST, FOLLOWS = tensor(3.0, 50.0, 0.01), torch.stack([tensor(0.0, 0.3, 0.7), tensor(1, 0, 0), tensor(0.5, 0.5, 0)])
G = generator(LAST, FOLLOWS)
BANK = [ConstantVelocity(0.1, orders=3, continuous=True), CoordinatedTurn(0.1, 1.0, orders=3),
        ConstantVelocity(4.0, orders=3, continuous=True)]  # fmt: skip
SENSOR = Position(3.0)
PRIOR = Gaussian(torch.zeros(6, dtype=torch.float64), torch.diag(tensor(10, 10, 10, 10, 1, 1)))
LEVELS = {"durations": (1000.0, 60.0, 5.0, 20.0, 3.0, 130.0, 0.7)}
WRONG = {"outlier_durations": (100.0, 4.0)}


def measured(batch=2, steps=16, seed=3):
    """Positions with outliers, and seconds between them."""
    g = torch.Generator().manual_seed(seed)
    z = 3 * torch.randn(batch, steps, 2, dtype=torch.float64, generator=g).cumsum(-2)
    z[:, 5] += 80
    z[:, 9:12] += 50
    return z, 0.1 + 3 * torch.rand(batch, steps, dtype=torch.float64, generator=g)


def in_parts(z, dt, parts):
    """The same measurements, with rows without any that cut the time before each."""
    more = torch.full((*z.shape[:-2], parts * z.shape[-2], z.shape[-1]), torch.nan, dtype=z.dtype)
    more[..., parts - 1 :: parts, :] = z
    return more, dt.repeat_interleave(parts, -1) / parts


# ---------------------------------------------------------------- the chain


@pytest.mark.parametrize(
    ("seconds", "rtol"), [(0.0, 1e-10), (1e-6, 1e-10), (0.1, 1e-10), (10.0, 1e-10), (3000.0, 1e-10), (21000.0, 3e-9)]
)
def test_probabilities_are_the_exponential_of_the_rates(seconds, rtol):
    found = transition_over(G, tensor(seconds)[0])
    torch.testing.assert_close(found, torch.linalg.matrix_exp(G * seconds), rtol=rtol, atol=1e-14)


def test_two_steps_are_one_of_their_sum_and_no_time_changes_nothing():
    a, b = tensor(0.7)[0], tensor(11.0)[0]
    torch.testing.assert_close(
        transition_over(G, a) @ transition_over(G, b), transition_over(G, a + b), rtol=1e-11, atol=1e-14
    )
    assert torch.equal(transition_over(G, torch.zeros_like(a)), torch.eye(3, dtype=torch.float64))


def test_single_precision_keeps_small_probabilities():
    found = transition_over(G.float(), torch.tensor(1e-5))
    torch.testing.assert_close(found.double(), torch.linalg.matrix_exp(G * 1e-5), rtol=1e-5, atol=0)


def test_gradients_are_those_of_finite_differences():
    inputs = LAST.clone().requires_grad_(), tensor(0.3, 2.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda last, dt: transition_over(generator(last, FOLLOWS), dt), inputs)


# ---------------------------------------------------------------- interacting models


def test_interacting_models_are_the_moment_form_with_that_chain():
    z, count, last = test_imm.measured(1)[0], 5, [20.0, 5.0, 8.0, 30.0, 3.0]
    e = presets.imm(test_imm.bank(), test_imm.SENSOR, durations=tensor(*last))(z, test_imm.PRIOR, dt=test_imm.DT)
    H = np.eye(2, 6)
    generator = (np.ones((count, count)) / (count - 1) - np.eye(count) * count / (count - 1)) / np.array(last)[:, None]
    chain = oracle.exponential(generator * test_imm.DT)
    models, prior = [test_imm.of(m) for m in test_imm.bank()], test_imm.PRIOR
    r = oracles.imm(z.numpy(), prior.mean.numpy(), prior.covariance.numpy(), models, H,
                    test_imm.SIGMA**2 * np.eye(2), chain, np.full(count, 1 / count))  # fmt: skip
    test_imm.same(e.mean, torch.from_numpy(r["mean"]))
    test_imm.same(e.info.probabilities, torch.from_numpy(r["probabilities"]))


def test_models_that_hardly_ever_end_do_end_in_single_precision():
    f = presets.imm(BANK, SENSOR, durations=1e5).float()
    torch.testing.assert_close(f.restart_probability(torch.tensor([1e-4])).double(), tensor(1.5e-9), rtol=1e-6, atol=0)


def test_one_duration_is_the_same_for_all():
    z, dt = measured()
    one, three = (presets.imm(BANK, SENSOR, durations=d) for d in (8.0, tensor(8.0, 8.0, 8.0)))
    torch.testing.assert_close(one(z, PRIOR, dt=dt).mean, three(z, PRIOR, dt=dt).mean)
    torch.testing.assert_close(one.smooth(z, PRIOR, dt=dt).mean, three.smooth(z, PRIOR, dt=dt).mean)


def test_each_track_may_have_its_own_models_after_one_that_ends():
    (z, dt), other = measured(), torch.stack([tensor(0.0, 1, 0), tensor(0, 0, 1), tensor(1, 0, 0)])
    f = presets.imm(BANK, SENSOR, durations=8.0, transition=torch.stack([FOLLOWS, other]))
    second = presets.imm(BANK, SENSOR, durations=8.0, transition=other)
    torch.testing.assert_close(f(z, PRIOR, dt=dt).mean[1], second(z[1], PRIOR, dt=dt[1]).mean)


@pytest.mark.parametrize("make", [
    partial(presets.imm, durations=20.0),
    partial(presets.imm, durations=LAST, transition=FOLLOWS),
    partial(presets.vsimm_srckf, durations=LAST, neighbours=[[1], [2], [0]], first=[0, 1, 2]),
], ids=["even", "matrix", "subset"])  # fmt: skip
def test_rows_without_a_measurement_do_not_change_what_a_chain_says(make):
    (z, dt), f = measured(), make([ConstantVelocity(1.0, continuous=True)] * 3, SENSOR)
    prior = Gaussian(PRIOR.mean[:4], PRIOR.scale_tril[:4, :4])
    if "initial" in f._modules and f.initial is not None:
        f.initial.set(tensor(0.7, 0.2, 0.1))
    one, four = (f(*x[:1], prior, dt=x[1]) for x in ((z, dt), in_parts(z, dt, 4)))
    near = partial(torch.testing.assert_close, rtol=1e-10, atol=1e-10)
    near(four.info.probabilities[..., 3::4, :], one.info.probabilities)
    near(four.mean[..., 3::4, :], one.mean)  # models alike, so that mixing loses nothing


@pytest.mark.parametrize("run", ["forward", "smooth"])
def test_gradients_of_a_subset_are_finite_where_no_time_passes(run):
    (z, dt), f = measured(1, 6), presets.vsimm_srckf(
        BANK, SENSOR, durations=LAST, neighbours=[[1], [2], [0]], first=[0, 1], learn=("durations",)
    )  # fmt: skip
    dt[:, 2] = 0
    (slope,) = torch.autograd.grad(getattr(f, run)(z, PRIOR, dt=dt).mean.sum(), [f.durations.raw])
    assert slope.isfinite().all()


# ---------------------------------------------------------------- regimes and outliers


@pytest.mark.parametrize("agile", [9.0, 1.0])
@pytest.mark.parametrize("motions", [1, 3])
def test_gpb_is_what_loops_over_hypotheses_say(motions, agile):
    case, last, restart = gpb_loops.position(), (40.0, agile, 6.0, 0.8), (0.5, 0.3, 0.15, 0.05)
    longest = agile / 2 if motions == 1 else np.inf
    bank = [ConstantAcceleration(0.05), ConstantVelocity(0.5, orders=3), CoordinatedTurn(-0.2, 0.1, orders=3)][:motions]
    dt = np.linspace(0.3, 2.0, gpb_loops.STEPS)
    of_steps, regimes = gpb_loops.regimes((0.5,) * 4, restart, (0.1, 30.0), motions=motions)
    options = {name: x for name, x in of_steps.items() if name not in ("self_transition", "outlier_transition")}
    f = presets.gpb(Bank(bank), case.sensor, durations=last, outlier_durations=(15.0, 2.5), **options)

    others = motions - 1
    by_regime, odds = np.array([*last[:2], *[last[2]] * others]), regimes.restart
    generator = (np.tile(odds, (len(odds), 1)) - np.eye(len(odds))) / by_regime[:, None]
    first = odds * by_regime / (odds * by_regime).sum()
    counted, since = [], 0.0
    for z, step in zip(case.z, dt, strict=True):  # no more between two measurements than half of what a level lasts
        counted.append(min(since + step, longest) - min(since, longest))
        since = since + step if np.isnan(z).all() else 0.0
    assert (min(counted) < dt.min()) == (longest < 2)
    regimes = regimes._replace(
        seconds=lambda k: (np.exp(-counted[k] / by_regime), oracle.exponential(generator * counted[k])),
        first=first,
        steps=dt.__getitem__,
        keeps=[np.exp(-1 / last[3])],  # measurements
    )
    modes = oracle.OutlierModes(case.blocks, None, options["outlier_sizes"], options["outlier_shares"],
                                 (15.0, 2.5), unreliable=options["unreliable"])  # fmt: skip
    prior, models = gpb_loops.PRIOR, [gpb_loops.carried(m, dt) for m in bank]
    r = oracle.gpb(case.z, prior.mean.numpy(), prior.covariance.numpy(), models, case.model, regimes, modes,
                   options["prior_outlier"], options["prior_inflation"])  # fmt: skip
    gpb_loops.same(f(torch.from_numpy(case.z), prior, dt=torch.from_numpy(dt)), r)


def test_rows_without_a_measurement_change_no_estimate_of_gpb_where_the_motion_holds():
    z, dt = measured()
    f = presets.gpb(ConstantVelocity(1.0, continuous=True), SENSOR, manoeuvres="none", durations=(50.0, 50.0), **WRONG)
    prior = Gaussian(PRIOR.mean[:4], PRIOR.scale_tril[:4, :4])
    one, four = (f(*x[:1], prior, dt=x[1]) for x in ((z, dt), in_parts(z, dt, 4)))
    for a, b in ((four.mean, one.mean), (four.info.outlier, one.info.outlier)):
        torch.testing.assert_close(a[..., 3::4, :], b, rtol=1e-10, atol=1e-10)
    assert one.info.outlier[:, [5, 9]].min() > 0.5


@pytest.mark.parametrize("sensor", [None, Position(2.0)], ids=["the first", "that of another sensor"])
def test_what_no_measurement_foretells_is_an_outlier_as_often_as_in_the_long_run(sensor):
    f = presets.gpb(ConstantVelocity(1.0), SENSOR, manoeuvres="none", outlier_durations=(60.0, 20.0), unreliable=0.0)
    state = f.init(Gaussian(torch.zeros(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)))
    if sensor is not None:
        state, _ = f.step(state, tensor(0.0, 0.0))
    measures = SENSOR if sensor is None else sensor
    alone = f.forget(state, measures)
    log_mode, block = f.outliers_of(measures).predict(
        alone.outlier, alone.unreliable, alone.relaxation, torch.tensor(True)
    )
    torch.testing.assert_close(log_mode.exp()[:, 0, 0], tensor(0.75, 0.25))
    assert (block.outlier == 1).all()
    off, _ = f.step(state, tensor(300.0, 300.0), dt=0.0, sensor=sensor)
    assert off.belief.mean.abs().max() < 20


def test_regimes_over_a_gap_are_as_likely_whatever_the_steps():
    f = presets.gpb(BANK, SENSOR, **LEVELS, **WRONG)
    z, dt = measured()
    gap = torch.full((2, 1, 2), torch.nan, dtype=torch.float64)
    one, three = (
        f(
            torch.cat([z, gap.expand(2, parts, 2)], -2),
            PRIOR,
            dt=torch.cat([dt, tensor(6.0).expand(2, parts) / parts], -1),
        )
        for parts in (1, 3)
    )
    torch.testing.assert_close(three.info.probabilities[:, -1], one.info.probabilities[:, -1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("off", [0.01, 0.1, 10.0, 100.0])
@pytest.mark.parametrize("seconds", [1.0, 60.0])
def test_process_noise_that_is_stated_too_small_or_too_large_is_noticed_however_long_steps_are(seconds, off):
    g, true, runs, steps = torch.Generator().manual_seed(0), 0.2**2 / seconds**3, 200, 60
    motion = ConstantVelocity(true, continuous=True)
    F, L = motion.transition(tensor(seconds)[0]), motion.process_noise(tensor(seconds)[0])
    prior = Gaussian(torch.zeros(4, dtype=torch.float64), torch.diag(tensor(1, 1, 1 / seconds, 1 / seconds)))
    x, path = torch.randn(runs, 4, dtype=torch.float64, generator=g) @ prior.scale_tril, []
    for _ in range(steps):
        x = x @ F.mT + torch.randn(runs, L.shape[-1], dtype=torch.float64, generator=g) @ L.mT
        path.append(x)
    truth = torch.stack(path, 1)[..., :2]
    z = truth + torch.randn(truth.shape, dtype=torch.float64, generator=g)
    stated = presets.gpb(ConstantVelocity(true / off, continuous=True), Position(1.0))
    found, best = (
        (f(z, prior, dt=seconds).mean[:, 20:, :2] - truth[:, 20:]).square().mean().sqrt()
        for f in (stated, presets.srckf(motion, Position(1.0)))
    )
    assert found < 1.15 * best


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(("make", "message"), [
    (lambda: presets.imm(BANK, SENSOR, durations=0.0), "durations: expected"),
    (lambda: presets.imm(BANK, SENSOR, durations=torch.inf), "durations: expected finite"),
    (lambda: presets.gpb(BANK, SENSOR, durations=(1.0,) * 6 + (torch.inf,)), "durations: expected finite"),
    (lambda: presets.gpb(BANK, SENSOR, outlier_durations=(10.0, torch.inf)), "outlier_durations: expected finite"),
    (lambda: presets.imm(BANK, SENSOR, durations=tensor(1.0, 2.0)), r"durations: expected a number or \(3,\)"),
    (lambda: presets.imm(BANK[:1], SENSOR, durations=1.0), "durations: expected None for a single model"),
    (lambda: presets.imm(BANK, SENSOR, durations=1.0, transition=torch.full((3, 3), 1 / 3)), "a diagonal of 0"),
    (lambda: presets.gpb(BANK, SENSOR, durations=(1.0, 2.0)), r"durations: expected \(..., 7\)"),
    (lambda: presets.gpb(BANK, SENSOR, self_transition=(0.5,) * 7, **LEVELS),
     "self_transition, durations: expected one of them"),
    (lambda: presets.gpb(BANK, SENSOR, outlier_durations=(10.0, 0.0)), "outlier_durations: expected"),
    (lambda: presets.gpb(BANK, SENSOR, outlier_durations=(1.0, 1.0), outlier_transition=((0.9, 0.1), (0.5, 0.5))),
     "outlier_transition, outlier_durations: expected one of them"),
])  # fmt: skip
def test_what_is_no_chain_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
