"""Joint association compiled gives what it gives eagerly: results, gradients, missing data, failures, errors."""

import copy
import math
from functools import partial

import numpy as np
import oracles
import pytest
import torch
from alike import both, close
from gpb_cases import FEWER
from joint import flat_prior, make, plane
from test_association import log_ratio, random_scan

from torchfra import learnable, presets
from torchfra.association import Clutter, Euclidean, associate
from torchfra.linalg.tracing import elementary
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.steps import engine
from torchfra.types import Gaussian

PRIOR = flat_prior((0.0, 0.0), (6.0, 3.0))


def scans(runs=3, steps=5, count=3):
    """Two targets that cross among false measurements, of which some are missing."""
    truth = PRIOR.mean[:, :2] + torch.arange(1.0, steps + 1).double()[:, None, None] * PRIOR.mean[:, 2:]
    z = torch.cat([truth, 6 * torch.randn(steps, count - 2, 2).double()], 1) + torch.randn(runs, steps, count, 2)
    z[torch.rand(z.shape[:-1]) < 0.2] = math.nan
    return z, Gaussian(*(x.expand(runs, *x.shape) for x in PRIOR))


@pytest.mark.parametrize("diffuse", [False, True])
def test_sums_over_sets_of_targets_are_those_of_an_oracle_that_enumerates_every_event(diffuse):
    rng = np.random.default_rng(0)
    for targets, count in ((1, 3), (2, 1), (2, 8), (3, 5), (4, 4)):
        for share, scale in ((0.3, 2.0), (1.0, 2.0), (0.6, 20.0)):
            L, c = random_scan(rng, targets, count, share, scale)
            beta, missed = oracles.joint_events(L, 0.8, c, diffuse)
            with elementary():
                found = associate(log_ratio(L, 0.8, c), math.log(0.2), diffuse=diffuse).log_weights.exp()
            np.testing.assert_allclose(found[:, 1:], beta.T, atol=1e-12)
            np.testing.assert_allclose(found[:, 0], missed, atol=1e-12)


@pytest.mark.parametrize("diffuse", [False, True])
def test_sums_over_sets_of_targets_and_their_gradients_are_those_of_events(diffuse):
    """Also of targets that are always measured, whose clusters have events with the fewest misses alone."""
    ratio = 20 * torch.randn(300, 3, 5).double()
    ratio = torch.where(torch.rand(ratio.shape) < 0.6, -torch.inf, ratio).requires_grad_()
    for always in (0.0, 0.4):
        miss = torch.rand(300, 3).double() - 3
        miss = torch.where(torch.rand(miss.shape) < always, -torch.inf, miss).requires_grad_()
        weight = torch.randn(300, 3, 6).double()
        results = []
        for context in (torch.enable_grad, elementary):
            with context():
                found = associate(ratio, miss, diffuse=diffuse)
            value = (weight * found.log_weights.exp()).sum() + (weight[..., 0] * found.evidence).sum()
            results.append((found.log_weights.exp(), found.evidence, *torch.autograd.grad(value, (ratio, miss))))
        close(*results)


@pytest.mark.slow
@pytest.mark.parametrize("lag", [None, 2])
def test_smoothed_results_and_gradients_are_those_of_the_eager_filter(lag, monkeypatch):
    """Also of scenes each with its own time steps and targets with values of their own; no loop of Python runs."""
    z, prior = scans()
    dt = torch.linspace(0.8, 1.2, 15).double().reshape(3, 5)
    motion = ConstantVelocity(torch.tensor([0.5, 2.0]).double())
    f = learnable(presets.jpda(motion, Position(2.0), clutter=Clutter(1e4, rate=2.0), lost=0.2), ("q",))
    fast = copy.deepcopy(f).compile()
    said = [f.smooth(z, prior, dt=dt, lag=lag)]
    monkeypatch.setattr(engine, "backward", None)
    said.append(fast.smooth(z, prior, dt=dt, lag=lag))
    close(*(x[:4] for x in said))
    close(
        *(
            torch.autograd.grad(x.mean.sum() + x.scale_tril.sum(), list(g.parameters()))
            for x, g in zip(said, (f, fast), strict=True)
        )
    )


@pytest.mark.slow
def test_elements_may_be_missing_and_a_target_that_fails_leaves_the_others_alone(crossing):
    """All safeguards at once: gates in metres, estimated noise, tracks that seem lost."""
    tracks = crossing.simulate(3, 3)
    z, mean = tracks.z[:, :6, :3].clone(), tracks.prior.mean.clone()
    z[0, 2, 1, 0] = z[1, 3, 0, 2] = z[2, :3] = math.nan
    mean[1, 0, 0] = math.nan
    f = make("iaukf_jpda", crossing, lost=0.2, gate=Euclidean(300.0, probability=0.99))
    slow, fast = both(f, z, Gaussian(mean, tracks.prior.scale_tril))
    assert slow.failed.tolist() == fast.failed.tolist() == [[False] * 2, [True, False], [False] * 2]
    close(slow.failure, fast.failure)
    good = ~slow.failed
    for a, b in ((slow, fast), (slow.info, fast.info)):
        close([x[good] for x in a[:4] if x is not None], [x[good] for x in b[:4] if x is not None], 1e-9)


@pytest.mark.slow
def test_single_scans_whole_or_not_are_those_of_the_eager_filter():
    z, prior = scans(runs=2)
    f = plane()
    fast = copy.deepcopy(f).compile()
    slow_state, state = f.init(prior), fast.init(prior)
    z[:, 3, 0, 1] = math.nan  # after scans without such an element, and before one
    for scan in z.unbind(1):
        slow_state, expected = f.step(slow_state, scan)
        state, found = fast.step(state, scan)
        close((slow_state, expected), (state, found))


def test_more_targets_than_all_of_whose_events_are_summed_are_refused():
    z, prior = scans(count=4)
    with pytest.raises(NotImplementedError, match=r"JPDA: exact: .*expected exact=\(2, 4\) or more"):
        plane(exact=(2, 3)).compile()(z, prior)
    close(*both(plane(exact=(2, 4)), z[:1, :2], Gaussian(prior.mean[:1], prior.scale_tril[:1])))


def test_what_counts_the_best_permutation_alone_is_refused():
    z, prior = scans()
    with pytest.raises(NotImplementedError, match="JPDA: permutations: kernels count all joint events"):
        plane(permutations=False).compile()(z, prior)


@pytest.mark.slow
def test_gradients_are_finite_where_the_tail_beyond_a_soft_gate_is_no_normal_number_any_more():
    """The tail of chi squared of two is below the normal numbers from 1417 on, and 0 from 1490 on."""
    far = torch.linspace(1400.0, 1500.0, 41).double()
    f = learnable(plane(temperature=0.3), ("probability", "std"))
    prior = Gaussian(PRIOR.mean[:1].expand(41, 1, 4), PRIOR.scale_tril[:1].expand(41, 1, 4, 4))
    variance = 3.0**2 + 1.0 + 0.5 / 4 + 2.0**2  # position, velocity, process noise, measurement
    z = torch.stack([1 + (variance * far).sqrt(), torch.zeros_like(far)], -1)[:, None, None]
    gradients = [
        torch.autograd.grad(g(z, prior).log_likelihood.sum(), list(g.parameters()))
        for g in (f, copy.deepcopy(f).compile())
    ]
    assert all(x.isfinite().all() for x in gradients[1])
    close(*gradients)


INNER = {
    "robust and fading": {"inner": presets.rmckf},
    "residual": {"inner": partial(presets.iaukf, adapt="residual")},
    "fifth degree": {"inner": presets.ghckf},
    "models": {"inner": presets.imm_srckf, "motion": [ConstantVelocity(0.5), ConstantVelocity(5.0)]},
    "regimes": {"inner": partial(presets.gpb, **FEWER)},
    "soft, by target": {"temperature": 0.3, "detection": torch.tensor([0.9, 0.8]).double()},
    "diffuse, by scene": {
        "clutter": Clutter(400.0), "detection": torch.linspace(0.5, 0.9, 3).double().unsqueeze(-1),
    },
    "always measured": {"detection": 1.0, "gate": Euclidean(15.0)},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("how", INNER)
def test_every_kind_of_filter_inside_and_every_option_compiles(how):
    options = {"clutter": Clutter(400.0, rate=2.0), "motion": ConstantVelocity(0.5)} | INNER[how]
    z, prior = scans(count=2)  # for the compiler's time
    close(*both(presets.jpda(sensor=Position(2.0), **options), z, prior))
    if how in ("robust and fading", "residual"):
        close(*both(presets.jpda(sensor=Position(2.0), **options), z, prior, std=torch.ones_like(z)))
