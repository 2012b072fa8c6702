"""A model set that changes is chosen as its rule says, track by track, and costs three filters for five."""

import copy
import itertools

import numpy as np
import oracles
import pytest
import torch
from test_imm import DT, PRIOR, SENSOR, SIGMA, bank, measured, of, same

from torchfra import presets
from torchfra.motion import aircraft
from torchfra.scenarios import adsb_models, adsb_turns
from torchfra.sensors import Position

CALLS = [[1, 3], [2, 4], [0, 4], [0, 1], [2, 0]]


def position():
    H = np.zeros((2, 6))
    H[0, 0] = H[1, 1] = 1
    return H, SIGMA**2 * np.eye(2)


def test_it_is_the_moment_form_with_the_same_sets():
    z = adsb_turns("arc").simulate(3, 0).z[:, 170:330]  # the slow turn, and the fast one
    drift = torch.linspace(0, 400, 150, dtype=torch.float64).unsqueeze(-1)
    z = torch.cat([z[:, :10], z[:, :150] + drift], 1)
    prior = PRIOR._replace(mean=torch.cat([z[:, 0], z.new_tensor([15.0, 0, 0, 0]).expand(3, 4)], -1))
    covariance = (prior.scale_tril @ prior.scale_tril.mT).numpy()
    models = [of(m) for m in adsb_models()]
    e = presets.vsimm_srckf(adsb_models(), SENSOR)(z, prior, dt=DT)
    for i in range(3):
        r = oracles.vsimm(z[i].numpy(), prior.mean[i].numpy(), covariance, models, *position(), CALLS, [0, 2, 3])
        assert (e.info.active[i] == torch.from_numpy(r["probabilities"] > 0)).all()
        assert (e.info.active[i, 1:] != e.info.active[i, :-1]).any(-1).sum() >= 2
        same(e.info.probabilities[i], torch.from_numpy(r["probabilities"]), 1e-8)
        same(e.mean[i], torch.from_numpy(r["mean"]))
        same(e.covariance[i], torch.from_numpy(r["P"]), 1e-8)
        same(e.log_likelihood[i], torch.from_numpy(r["log_likelihood"]))


def test_sets_are_those_of_the_rule_for_every_set_and_many_probabilities():
    f = presets.vsimm_srckf(adsb_models(), SENSOR)
    g = np.random.default_rng(0)
    for first in itertools.permutations(range(5), 3):
        mu = g.dirichlet([0.3] * 3, 20)
        active = torch.eye(5, dtype=torch.float64)[list(first)].expand(20, 3, 5)
        chosen, stays_active = f.subset.choose(active, torch.from_numpy(mu).log())
        for k in range(20):
            expected = oracles.likely_set(dict(zip(first, mu[k], strict=True)), 3, 0.05, 0.5, CALLS)
            found = chosen[k].argmax(-1).tolist()
            assert sorted(found) == expected
            for place, model in enumerate(first):
                assert (found[place] == model) == bool(stays_active[k, place])


def test_likely_models_stay_before_unlikely_ones_where_a_principal_one_leaves_a_place():
    bank = aircraft()
    f, g = presets.vsimm_srckf(bank, Position(10.0)), np.random.default_rng(0)
    for _ in range(60):
        first, mu = g.permutation(7)[:4], g.permutation([0.7, 0.2, 0.06, 0.04])
        active = torch.eye(7, dtype=torch.float64)[first]
        chosen, _ = f.subset.choose(active, torch.from_numpy(mu).log())
        expected = oracles.likely_set(dict(zip(first.tolist(), mu, strict=True)), 4, 0.05, 0.5, bank.neighbours)
        assert sorted(chosen.argmax(-1).tolist()) == expected


def test_transitions_are_the_papers_matrix_and_rows_sum_to_one():
    f = presets.vsimm_srckf(adsb_models(), SENSOR)
    constant = torch.tensor([[0.95, 0.025, 0.025], [0.025, 0.95, 0.025], [0.025, 0.025, 0.95]], dtype=torch.float64)
    same(between(f, (0, 2, 3), (0, 2, 3)), constant)
    for now in itertools.permutations(range(5), 3):
        if any(model in (0, 2, 3) and (0, 2, 3)[place] != model for place, model in enumerate(now)):
            continue  # a model that goes on keeps its place
        matrix = between(f, (0, 2, 3), now)
        same(matrix.sum(-1), torch.ones(3, dtype=torch.float64))
        for place, model in enumerate((0, 2, 3)):
            same(matrix[place], constant[place] if model in now else torch.full((3,), 1 / 3, dtype=torch.float64))


def test_a_matrix_of_ones_own_is_shared_out_among_those_that_run():
    rows = torch.from_numpy(np.random.default_rng(0).dirichlet([1.0] * 5, 5))
    f = presets.vsimm_srckf(adsb_models(), SENSOR, transition=rows)
    matrix = between(f, (0, 2, 3), (0, 1, 3))  # the third goes, the second comes in its place
    for was, place, stays in ((0, 0, True), (2, 1, False), (3, 2, True)):
        others = [model for model in (0, 1, 3) if model != was]
        left = 1 - rows[was, was] if stays else 1.0
        expected = [rows[was, m] * left / rows[was, others].sum() if m != was else rows[was, was] for m in (0, 1, 3)]
        same(matrix[place], torch.stack(expected))


def between(f, was, now):
    """The transition between two sets, given by models in their places."""
    eye = torch.eye(5, dtype=torch.float64)
    stays_active = torch.tensor([float(model in now) for model in was], dtype=torch.float64)
    return f.subset.matrix(f.matrix(eye), eye[list(was)], eye[list(now)], stays_active)


def test_the_whole_bank_as_set_is_an_imm():
    calls = [[1], [2], [0]]
    whole = presets.vsimm_srckf(bank()[:3], SENSOR, neighbours=calls, first=(0, 1, 2))(measured(3), PRIOR, dt=DT)
    plain = presets.imm(bank()[:3], SENSOR)(measured(3), PRIOR, dt=DT)
    same(whole.mean, plain.mean)
    same(whole.info.probabilities, plain.info.probabilities)


@pytest.mark.slow
def test_compiled_it_gives_the_same_and_gradients_reach_transition_and_noise():
    f = presets.vsimm_srckf(adsb_models(), SENSOR, learn=("transition", "q", "std"))
    z = adsb_turns().simulate(3, 1).z[:, 190:260]  # long enough for every model to follow every other
    prior = PRIOR._replace(mean=torch.cat([z[:, 0], torch.zeros(3, 4, dtype=torch.float64)], -1))
    found = []
    for g in (f, copy.deepcopy(f).compile()):
        e = g(z, prior, dt=DT)
        (e.log_likelihood.mean() + 1e-6 * e.mean.square().mean()).backward()
        found.append((e.mean.detach(), e.info.probabilities.detach(), *(p.grad for p in g.parameters())))
    for slow, fast in zip(*found, strict=True):
        same(fast, slow, 1e-7)
    assert (f.transition.raw.grad != 0).all()


@pytest.mark.slow
def test_three_filters_err_nearly_as_little_as_five():
    """Root mean square error in x and y from sample 21 on: 12.30 / 14.04 m, of other runs."""
    scenario = adsb_turns()
    tracks = scenario.simulate(100, 5)
    with torch.no_grad():
        e = presets.vsimm_srckf(adsb_models(), scenario.sensor).compile()(tracks.z, tracks.prior, dt=scenario.dt)
    found = (e.mean - tracks.truth)[:, 18:, :2].square().mean(0).sqrt().mean(0)
    assert found.tolist() == pytest.approx((12.30, 14.04), rel=0.1)
    changes = (e.info.active[:, 1:] != e.info.active[:, :-1]).any(-1).double().sum(1).mean()
    assert 3 < changes < 8


def test_what_does_not_fit_is_named():
    def make(**options):
        return presets.vsimm_srckf(adsb_models(), SENSOR, **options)

    with pytest.raises(ValueError, match="every model to be reached from every other"):
        make(neighbours=[[1], [0], [0], [0], [0]])
    with pytest.raises(ValueError, match="neighbours, first: expected both, or a Bank that has them"):
        presets.vsimm_srckf(bank(), SENSOR)
    with pytest.raises(ValueError, match="neighbours: expected one list for each of 5"):
        make(neighbours=[[1], [0]], first=(0, 1))
    with pytest.raises(ValueError, match="neighbours: expected indices from 0 to 4"):
        make(neighbours=[[1, 7], [2], [3], [4], [0]])
    with pytest.raises(ValueError, match="neighbours: expected at most 2 for each"):
        make(neighbours=[[1, 2, 3], [2], [3], [4], [0]])
    with pytest.raises(ValueError, match="first: expected 2 to 5 of the models in neighbours"):
        make(first=(0, 0, 1))
    with pytest.raises(ValueError, match="0 <= unlikely < principal < 1"):
        make(unlikely=0.6)
    with pytest.raises(ValueError, match="self_transition: expected a probability above 0 and below 1"):
        make(self_transition=1.5)
    with pytest.raises(ValueError, match=r"transition: expected \(5, 5\) above 0"):
        make(transition=torch.eye(5))


@pytest.mark.slow
def test_a_hundred_thousand_steps_lose_no_track():
    """The experiment's track end to end, again and again, in single precision."""
    scenario = adsb_turns()
    leg = scenario.simulate(1, 0).truth[0, :, :2]
    away = leg[-1] + torch.tensor([30.0, 0.0], dtype=torch.float64) - leg[0]
    laps = torch.arange(224, dtype=torch.float64)[:, None, None]
    truth = (leg + laps * away).reshape(-1, 2)[:100_000]
    z = truth + 30 * torch.randn(2, 100_000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    prior = scenario.simulate(2, 0).prior
    f = presets.vsimm_srckf(adsb_models(), scenario.sensor).compile()
    with torch.no_grad():
        e = f(z.float(), prior._replace(mean=prior.mean.float()), dt=scenario.dt)
    error = (e.mean[..., :2].double() - truth).norm(dim=-1)
    assert not e.failed.any()
    assert e.info.probabilities.isfinite().all()
    assert error[:, 5:].max() < 150
    assert error.square().mean().sqrt() < 25
