"""Joint association around a filter follows the paper, keeps every promise of a filter, and does what it is for."""

import copy
import math
from functools import partial

import numpy as np
import oracles
import pytest
import torch

from torchfra import losses, metrics, presets, scenarios
from torchfra.association import Candidates, ChiSquare, Clutter, Euclidean
from torchfra.filters import JPDA, SRCKF
from torchfra.kernel.build import CompileError
from torchfra.motion import Bank, ConstantVelocity
from torchfra.sensors import Bearings, Position, RangeBearing
from torchfra.types import Gaussian

PAPER = {"gate": Euclidean(150.0), "lost": 0.0}
STEPS = 25


@pytest.fixture(scope="module")
def scenario():
    return scenarios.clutter_crossing(noise_scale=4.0, change=8)


@pytest.fixture(scope="module")
def tracks(scenario):
    t = scenario.simulate(3, 3)
    return t._replace(truth=t.truth[:, :, :STEPS], z=t.z[:, :STEPS])


def make(name, scenario, **options):
    return getattr(presets, name)(
        scenario.motion, scenario.sensor, **{"clutter": scenario.clutter, "detection": scenario.detection} | options
    )


def plane(clutter=None, detection=0.9, gate=None, **options):
    """Two dimensions, positions, linear: closed forms hold."""
    return presets.jpda(
        ConstantVelocity(0.5, 2), Position(2.0), clutter=clutter or Clutter(1e4, rate=2.0), detection=detection,
        gate=gate or ChiSquare(0.9999), **options,
    )  # fmt: skip


def flat_prior(*positions):
    mean = torch.tensor([[*p, 1.0, 0.0] for p in positions], dtype=torch.float64)
    return Gaussian(mean, torch.diag(torch.tensor([3.0, 3.0, 1.0, 1.0], dtype=torch.float64)).expand(len(mean), 4, 4))


# ------------------------------------------------------------------------------------------ against plain loops


@pytest.mark.parametrize(("name", "how"), [("ukf_jpda", None), ("iaukf_jpda", oracles.Tuned())])
@pytest.mark.parametrize("rate", [None, 6.0])
def test_the_whole_filter_is_that_of_plain_loops(scenario, tracks, name, how, rate):
    clutter = Clutter(2 * 400.0**3, rate=rate)
    estimate = make(name, scenario, clutter=clutter, **PAPER)(tracks.z, tracks.prior)
    dt = torch.tensor(1.0, dtype=torch.float64)
    F, root = scenario.motion.cartesian.transition(dt).numpy(), scenario.motion.cartesian.process_noise(dt)
    root = root.expand(2, 6, 3)[0]
    for b in range(len(tracks.z)):
        P = (tracks.prior.scale_tril[b] @ tracks.prior.scale_tril[b].mT).numpy()
        truth = oracles.jpda(
            tracks.z[b].numpy(), tracks.prior.mean[b].numpy(), P, F, (root @ root.mT).numpy(),
            scenario.sensor.std().numpy() ** 2, PD=0.95, gate=150.0, volume=2 * 400.0**3, how=how, rate=rate,
        )  # fmt: skip
        np.testing.assert_allclose(estimate.info.association[b].movedim(0, 1), truth["association"], atol=1e-6)
        np.testing.assert_allclose(estimate.mean[b].movedim(0, 1), truth["mean"], rtol=1e-6, atol=1e-9)
        scale = np.sqrt(truth["P"].diagonal(axis1=2, axis2=3))
        scale = scale[..., :, None] * scale[..., None, :]
        np.testing.assert_allclose(estimate.covariance[b].movedim(0, 1).numpy() / scale, truth["P"] / scale, atol=1e-5)
        if how is not None:
            R = estimate.info.noise[b].movedim(0, 1).numpy() * scenario.sensor.std().numpy() ** 2
            np.testing.assert_allclose(R, truth["R"], rtol=1e-5)


def test_the_update_is_the_papers_equations_and_so_moment_matching():
    """x + K nu and P - (1 - b0) K S K^T + K (sum b nu nu^T - nu nu^T) K^T, eqs. (28)-(30)."""
    f, prior = plane(), flat_prior((0.0, 0.0), (6.0, 3.0))
    z = torch.tensor([[1.0, 0.5], [4.0, 2.0], [8.0, 5.0], [math.nan, math.nan]], dtype=torch.float64)
    state, _ = f.step(f.init(prior), z)
    beta = f(z.unsqueeze(0), prior).info.association[:, 0]
    F, Q = f.motion.transition(torch.tensor(1.0).double()), f.motion.process_noise(torch.tensor(1.0).double())
    H, R = torch.eye(2, 4).double(), 4.0 * torch.eye(2).double()
    for t in range(2):
        ahead, P = F @ prior.mean[t], F @ prior.covariance[t] @ F.mT + Q @ Q.mT
        S = H @ P @ H.mT + R
        K = P @ H.mT @ S.inverse()
        nu = z[:3] - H @ ahead
        b = beta[t, 1:4]
        bar = b @ nu
        scatter = (b[:, None, None] * nu[:, :, None] * nu[:, None, :]).sum(0) - bar[:, None] * bar
        torch.testing.assert_close(state.belief.mean[t], ahead + K @ bar, rtol=1e-12, atol=1e-12)
        expected = P - b.sum() * K @ S @ K.mT + K @ scatter @ K.mT
        torch.testing.assert_close(state.belief.covariance[t], expected, rtol=1e-11, atol=1e-12)
        assert beta[t, 4] == 0
        assert 0.001 < b.max() < 0.999


# -------------------------------------------------------------------------------------------------- limits


@pytest.mark.parametrize(
    "inner", [presets.srckf, presets.ekf, presets.ghckf, presets.rsrckf, presets.hghckf2, presets.iaukf]
)
def test_without_false_measurements_and_always_detected_it_is_the_filter_itself(inner):
    s = scenarios.noise_change()
    t = s.simulate(3, 0)
    plain = inner(s.motion, s.sensor)(t.z, t.prior)
    around = presets.jpda(s.motion, s.sensor, clutter=Clutter(1e9), inner=inner, detection=1.0, gate=Euclidean(1e7))
    prior = Gaussian(t.prior.mean.unsqueeze(1), t.prior.scale_tril.unsqueeze(1))
    joint = around(t.z.unsqueeze(-2), prior)
    torch.testing.assert_close(joint.mean[:, 0], plain.mean, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(joint.scale_tril[:, 0], plain.scale_tril, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(joint.nis[:, 0], plain.nis, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("inner", [presets.asrckf, presets.rmckf, presets.mr_ckf])
def test_fading_factors_are_those_of_the_filter_itself_too(inner):
    """A target that turns away from its model, with missing elements."""
    t = torch.arange(1, 31, dtype=torch.float64)
    z = torch.stack([t, 0.2 * (t - 12).clamp_min(0) ** 2], -1)
    z = z + 2 * torch.randn(30, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    z[7, 0], z[9], prior = math.nan, math.nan, flat_prior((0.0, 0.0))
    plain = inner(ConstantVelocity(0.01, 2), Position(2.0))(z, Gaussian(prior.mean[0], prior.scale_tril[0]))
    around = presets.jpda(ConstantVelocity(0.01, 2), Position(2.0), inner=inner, detection=1.0, clutter=Clutter(1e9),
                          gate=Euclidean(1e4))  # fmt: skip
    joint = around(z.unsqueeze(1), prior)
    torch.testing.assert_close(joint.mean[0], plain.mean, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(joint.scale_tril[0], plain.scale_tril, rtol=1e-8, atol=1e-10)
    if inner is not presets.mr_ckf:
        assert plain.info.fading.max() > 2
        torch.testing.assert_close(joint.info.fading[0], plain.info.fading, rtol=1e-8, atol=1e-8)
        both = around(z.unsqueeze(1), flat_prior((0.0, 0.0), (1e5, 1e5)))
        torch.testing.assert_close(both.mean[0], joint.mean[0])


def test_a_missed_target_does_not_fade_whatever_else_was_measured():
    rng = torch.Generator().manual_seed(0)
    own = 60 * torch.randn(16, 1, 2, dtype=torch.float64, generator=rng)
    own[10:12] = math.nan
    far = torch.full((16, 1, 2), 5e4).double()
    f = presets.jpda(ConstantVelocity(0.1, 2), Position(10.0), inner=partial(presets.asrckf, weakening=1.0),
                     clutter=Clutter(1e8), gate=Euclidean(1000.0))  # fmt: skip
    one, other = (f(torch.cat(scan, 1), flat_prior((0.0, 0.0))) for scan in ((own, far), (far, own)))
    assert one.info.fading.max() > 2
    assert (one.info.fading[0, 10:12] == 1).all()
    torch.testing.assert_close(one.mean, other.mean)


def test_a_measurement_that_cannot_be_lets_all_others_count(scenario, tracks):
    """An elevation beyond the vertical, a range below 0 and one of 0."""
    f, z = make("iaukf_jpda", scenario, learn=("detection", "volume")), tracks.z.clone()
    plain = f(torch.cat([z, torch.full((3, STEPS, 1, 3), math.nan).double()], 2), tracks.prior).mean
    for wild in ([1.0, 1.7, 2000.0], [1.0, 0.5, -3.0], [1.0, 0.5, 0.0]):
        more = torch.tensor(wild).double().expand(3, STEPS, 1, 3)
        estimate = f(torch.cat([z, more], 2), tracks.prior)
        torch.testing.assert_close(estimate.mean, plain)
        gradients = torch.autograd.grad(estimate.log_likelihood.sum(), list(f.parameters()))
        assert all(gradient.isfinite() for gradient in gradients)


@pytest.mark.parametrize("far", [30.0, 300.0, 3000.0])
def test_a_target_that_is_always_measured_follows_however_far_its_measurement_is(far):
    f = plane(detection=1.0, gate=Euclidean(1e9), clutter=Clutter(1e9))
    z = torch.tensor([[[far, 0.0]]], dtype=torch.float64)
    plain = presets.srckf(ConstantVelocity(0.5, 2), Position(2.0))(z[0], flat_prior((0.0, 0.0))._replace(
        mean=flat_prior((0.0, 0.0)).mean[0], scale_tril=flat_prior((0.0, 0.0)).scale_tril[0]))  # fmt: skip
    estimate = f(z, flat_prior((0.0, 0.0)))
    torch.testing.assert_close(estimate.mean[0], plain.mean)
    assert estimate.info.association[0, 0].tolist() == [0.0, 1.0]


def test_targets_far_apart_are_filtered_alone():
    near, far = (0.0, 0.0), (1e4, 0.0)
    z = torch.randn(10, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 4
    z[:, 2] += torch.tensor(far)
    f = plane()
    both = f(z, flat_prior(near, far))
    one, two = f(z, flat_prior(near)), f(z, flat_prior(far))
    torch.testing.assert_close(both.mean, torch.cat([one.mean, two.mean]))
    torch.testing.assert_close(both.log_likelihood, torch.cat([one.log_likelihood, two.log_likelihood]))


def test_an_empty_scan_is_a_pure_prediction():
    f, prior = plane(), flat_prior((0.0, 0.0), (5.0, 0.0))
    state, _ = f.step(f.init(prior), torch.full((3, 2), math.nan).double())
    F = f.motion.transition(torch.tensor(1.0).double())
    torch.testing.assert_close(state.belief.mean, (F @ prior.mean.unsqueeze(-1)).squeeze(-1))


def test_a_row_of_nan_and_the_order_of_measurements_do_not_matter(scenario, tracks):
    f = make("iaukf_jpda", scenario)
    plain = f(tracks.z, tracks.prior)
    order = [3, 1, 7, 0, 2, 6, 5, 4]
    padded = torch.cat([tracks.z[:, :, order], torch.full((3, STEPS, 2, 3), math.nan).double()], 2)
    other = f(padded, tracks.prior)
    torch.testing.assert_close(other.mean, plain.mean, rtol=1e-9, atol=1e-11)
    moved = other.info.association[..., 1:9]
    torch.testing.assert_close(moved, plain.info.association[..., 1:][..., order], rtol=1e-6, atol=1e-9)
    assert (other.info.association[..., 9:] == 0).all()


def test_targets_may_come_in_any_order(scenario, tracks):
    s = scenarios.clutter_straight()
    f = make("iaukf_jpda", s)
    straight = f(tracks.z, tracks.prior)
    turned = f(tracks.z, Gaussian(tracks.prior.mean.flip(1), tracks.prior.scale_tril.flip(1)))
    torch.testing.assert_close(turned.mean.flip(1), straight.mean, rtol=1e-9, atol=1e-11)


# -------------------------------------------------------------------------------------- the promises of a filter


def test_streaming_is_the_whole_and_a_batch_is_its_scenes(scenario, tracks):
    f = make("iaukf_jpda", scenario)
    whole = f(tracks.z, tracks.prior)
    assert whole.mean.shape == (3, 2, STEPS, 6)
    assert whole.info.association.shape == (3, 2, STEPS, 9)
    state = f.init(tracks.prior)
    for k in range(STEPS):
        state, innovation = f.step(state, tracks.z[:, k])
        torch.testing.assert_close(state.belief.mean, whole.mean[:, :, k], rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(innovation.log_likelihood, whole.log_likelihood[:, :, k])
        torch.testing.assert_close(innovation.nis, whole.nis[:, :, k])
        assert innovation.residual.shape == (3, 2, 3)
        assert innovation.scale_tril.shape == (3, 2, 3, 3)
    alone = f(tracks.z[1], Gaussian(tracks.prior.mean[1], tracks.prior.scale_tril[1]))
    torch.testing.assert_close(alone.mean, whole.mean[1], rtol=1e-10, atol=1e-13)


def test_steps_and_noise_may_differ_between_scenes(scenario, tracks):
    f = make("iaukf_jpda", scenario)
    dt = torch.tensor([[0.5], [1.0], [2.0]], dtype=torch.float64).expand(3, STEPS)
    std = scenario.sensor.std() * torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)[:, None, None, None].expand(
        3, STEPS, 8, 1
    )
    together = f(tracks.z, tracks.prior, dt=dt, std=std)
    roots = torch.diag_embed(std)
    as_roots = f(tracks.z, tracks.prior, dt=dt, noise=roots)
    torch.testing.assert_close(as_roots.mean, together.mean, rtol=1e-8, atol=1e-10)
    for b in range(3):
        prior = Gaussian(tracks.prior.mean[b], tracks.prior.scale_tril[b])
        alone = f(tracks.z[b], prior, dt=dt[b], std=std[b])
        torch.testing.assert_close(alone.mean, together.mean[b], rtol=1e-9, atol=1e-12)
    state = f.init(tracks.prior)
    state, _ = f.step(state, tracks.z[:, 0], dt=dt[:, 0], std=std[:, 0])
    torch.testing.assert_close(state.belief.mean, together.mean[:, :, 0], rtol=1e-10, atol=1e-13)


def test_hyperparameters_may_differ_between_targets_and_scenes(scenario, tracks):
    values = torch.tensor([[0.8, 0.9], [0.7, 0.95], [0.6, 0.99]], dtype=torch.float64)
    together = make("iaukf_jpda", scenario, detection=values, forgetting=values)(tracks.z, tracks.prior)
    prior = Gaussian(tracks.prior.mean[1], tracks.prior.scale_tril[1])
    alone = make("iaukf_jpda", scenario, detection=values[1], forgetting=values[1])(tracks.z[1], prior)
    torch.testing.assert_close(alone.mean, together.mean[1], rtol=1e-9, atol=1e-12)
    same = make(
        "iaukf_jpda", scenario, detection=values[:, :1], gate=Euclidean(torch.tensor([[90.0], [150.0], [200.0]]))
    )
    prior = Gaussian(tracks.prior.mean[2], tracks.prior.scale_tril[2])
    alone = make("iaukf_jpda", scenario, detection=0.6, gate=Euclidean(200.0))(tracks.z[2], prior)
    torch.testing.assert_close(alone.mean, same(tracks.z, tracks.prior).mean[2], rtol=1e-9, atol=1e-12)


def test_one_that_fails_lets_the_others_go_on(scenario, tracks):
    f, mean = make("iaukf_jpda", scenario), tracks.prior.mean.clone()
    mean[0, 0, 5] = math.nan
    estimate = f(tracks.z, Gaussian(mean, tracks.prior.scale_tril))
    assert estimate.failed[0, 0]
    assert not estimate.failed[1:].any()
    torch.testing.assert_close(estimate.mean[1:], f(tracks.z, tracks.prior).mean[1:])


def test_state_dicts_and_copies_hold_all(scenario, tracks):
    f, g = make("iaukf_jpda", scenario, detection=0.8, forgetting=0.9), make("iaukf_jpda", scenario)
    g.load_state_dict(f.state_dict())
    torch.testing.assert_close(g(tracks.z, tracks.prior).mean, f(tracks.z, tracks.prior).mean)
    torch.testing.assert_close(copy.deepcopy(f)(tracks.z, tracks.prior).mean, f(tracks.z, tracks.prior).mean)


def test_what_was_handed_in_stays_as_it_was(scenario):
    inner = SRCKF(scenario.motion, scenario.sensor)
    f = JPDA(inner, gate=Euclidean(), clutter=Clutter(1.0))
    assert f.inner is not inner
    make("iaukf_jpda", scenario, learn="all")
    for part in (inner, scenario.clutter, scenario.motion, scenario.sensor):
        assert all(h.shared_dims == 0 and not h.raw.requires_grad for h in part.modules() if hasattr(h, "shared_dims"))


def test_it_runs_in_single_precision(scenario, tracks):
    f = make("iaukf_jpda", scenario)
    prior = Gaussian(*(x.float() for x in tracks.prior))
    low, high = f(tracks.z.float(), prior), f(tracks.z, tracks.prior)
    assert low.mean.dtype == torch.float32
    gap = scenario.cartesian(low).mean[..., :3].double() - scenario.cartesian(high).mean[..., :3]
    assert gap.norm(dim=-1).median() < 0.1


def test_vmap_and_checkpoints_give_the_same(scenario, tracks):
    f = make("iaukf_jpda", scenario)
    z = tracks.z[:, :6]
    whole = f(z, tracks.prior)
    mapped = torch.func.vmap(lambda z, mean, root: f(z, Gaussian(mean, root)).mean)(z, *tracks.prior)
    torch.testing.assert_close(mapped, whole.mean, rtol=1e-9, atol=1e-12)
    learning = make("iaukf_jpda", scenario, learn=("detection",))
    gradients = []
    for checkpoint in (None, 2):
        (gradient,) = torch.autograd.grad(
            learning(z, tracks.prior, checkpoint=checkpoint).log_likelihood.sum(), list(learning.parameters())
        )
        gradients.append(gradient)
    torch.testing.assert_close(*gradients)


# ----------------------------------------------------------------------------------------------------- learning


def test_gradients_through_the_association_are_those_of_finite_differences(scenario, tracks):
    """Detection, gate (soft), forgetting, confidences: innovation likelihood and estimates."""
    f = make("iaukf_jpda", scenario, gate=Euclidean(60.0), temperature=0.2, lost=0.0,
             learn=("detection", "gate.size", "forgetting", "confidence", "volume"))  # fmt: skip
    names = [name for name, _ in f.named_parameters()]
    prior = Gaussian(tracks.prior.mean[:1], tracks.prior.scale_tril[:1])

    def run(*values):
        estimate = torch.func.functional_call(f, dict(zip(names, values, strict=True)), (tracks.z[:1, :14], prior))
        return losses.innovation_nll(estimate), estimate.mean[..., 3:].sum()

    values = [p.detach().clone().requires_grad_() for p in f.parameters()]
    assert len(values) == 5
    assert torch.autograd.gradcheck(run, values, atol=1e-6)
    grads = torch.autograd.grad(run(*values)[0].sum(), values)
    assert all(g.abs().max() > 0 for g in grads)


def test_gradients_reach_a_soft_gate_of_probability(scenario, tracks):
    f = make("iaukf_jpda", scenario, gate=ChiSquare(0.9), temperature=0.1, learn=("probability",))
    (p,) = f.parameters()
    prior = Gaussian(tracks.prior.mean[:1], tracks.prior.scale_tril[:1])

    def run(value):
        name = next(iter(dict(f.named_parameters())))
        return torch.func.functional_call(f, {name: value}, (tracks.z[:1, :10], prior)).log_likelihood.sum()

    assert torch.autograd.gradcheck(run, (p.detach().clone().requires_grad_(),), atol=1e-6)


def test_a_cold_gate_is_a_hard_one(scenario, tracks):
    hard = make("iaukf_jpda", scenario, **PAPER)(tracks.z, tracks.prior)
    cold = make("iaukf_jpda", scenario, **PAPER, temperature=1e-6)(tracks.z, tracks.prior)
    torch.testing.assert_close(cold.mean, hard.mean, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_the_likelihood_of_the_scans_finds_how_often_targets_are_measured():
    """From 0.7 back to 0.9, from scans alone; false measurements are Poisson, as the model says."""
    f = plane(detection=0.7, clutter=Clutter(1e4, rate=3.0), learn=("detection",))
    rng = torch.Generator().manual_seed(0)
    z, prior = scenes(rng, 200, 20, 0.9, 3)
    optimiser = torch.optim.Adam(f.parameters(), lr=0.2)
    for _ in range(25):
        optimiser.zero_grad()
        losses.innovation_nll(f(z, prior)).mean().backward()
        optimiser.step()
    assert f.detection().item() == pytest.approx(0.9, abs=0.02)


def scenes(rng, runs, steps, detection, false):
    """Two targets that move as assumed, and about so many false measurements in a square of 100 m."""
    motion = ConstantVelocity(0.5, 2)
    one = torch.tensor(1.0).double()
    F, root = motion.transition(one), motion.process_noise(one)
    prior = flat_prior((-20.0, 0.0), (-20.0, 15.0))
    state = prior.mean + (prior.scale_tril @ torch.randn(runs, 2, 4, 1, generator=rng).double()).squeeze(-1)
    scans = []
    for _ in range(steps):
        state = (F @ state.unsqueeze(-1)).squeeze(-1)
        state = state + (root @ torch.randn(runs, 2, 2, 1, generator=rng).double()).squeeze(-1)
        z = state[..., :2] + 2.0 * torch.randn(runs, 2, 2, generator=rng).double()
        z = torch.where((torch.rand(runs, 2, 1, generator=rng) < detection), z, math.nan)
        clutter = 100 * torch.rand(runs, 9, 2, generator=rng).double() - 50
        clutter = torch.where(torch.rand(runs, 9, 1, generator=rng) < false / 9, clutter, math.nan)
        scans.append(torch.cat([z, clutter], 1))
    return torch.stack(scans, 1), prior


# -------------------------------------------------------------------------------------------- gates and clutter


def test_gates_hold_what_they_say():
    sensor = RangeBearing(torch.tensor([1.0, 0.01]))
    z = torch.tensor([[[1000.0, 0.0], [1000.0, 0.06], [1070.0, 0.0]]], dtype=torch.float64)
    predicted = torch.tensor([[[1000.0, 0.0]]], dtype=torch.float64).expand(1, 3, 2)
    nis = torch.tensor([[1.0, 13.8, 13.9]], dtype=torch.float64)
    candidates = Candidates(z, predicted, torch.ones(1, 3, 2).double(), nis)
    inside = Euclidean(65.0)(candidates, sensor, 0.0)
    assert inside.exp().tolist() == [[1.0, 1.0, 0.0]]
    assert ChiSquare(0.999)(candidates, sensor, 0.0).exp().tolist() == [[1.0, 1.0, 0.0]]  # 13.816 for two elements
    assert Euclidean(30.0, least=0.999)(candidates, sensor, 0.0).exp().tolist() == [[1.0, 1.0, 0.0]]
    one = candidates._replace(seen=torch.tensor([1.0, 0.0]).double().expand(1, 3, 2))
    assert ChiSquare(0.999)(one, sensor, 0.0).exp().tolist() == [[1.0, 0.0, 0.0]]  # 10.83 for one


def test_the_density_of_false_measurements_is_that_of_points_that_fall_evenly():
    """Counted in a small cell of the measurement's space."""
    sensor, rng = RangeBearing(1.0, dims=3), np.random.default_rng(0)
    x = np.array([300.0, 400.0, 200.0]) + rng.uniform(-50, 50, (2_000_000, 3))
    z = sensor(torch.from_numpy(x))
    middle = sensor(torch.tensor([300.0, 400.0, 200.0]).double())
    cell = torch.tensor([10.0, 0.02, 0.02], dtype=torch.float64)
    share = ((z - middle).abs() < cell / 2).all(-1).double().mean() / cell.prod()
    row = middle.expand(1, 1, 3)
    candidates = Candidates(row, row, torch.ones(1, 1, 3).double(), torch.zeros(1, 1).double())
    assert Clutter(100.0**3)(candidates, sensor).exp().item() == pytest.approx(share.item(), rel=0.03)
    assert Clutter(100.0**3, rate=5.0)(candidates, sensor).exp().item() == pytest.approx(5 * share.item(), rel=0.03)
    box = Clutter(extent=[100.0, 1.0, 2.0])
    assert box(candidates, sensor).exp().item() == pytest.approx(1 / 200)
    some = candidates._replace(seen=torch.tensor([[[1.0, 0.0, 1.0]]]).double())
    assert box(some, sensor).exp().item() == pytest.approx(1 / 200)


def test_a_measurement_of_the_infrared_sensor_alone_is_associated_too(scenario, tracks):
    """Ranges fail from step 5 on; directions still tell the targets."""
    f, z = make("iaukf_jpda", scenario), tracks.z.clone()
    z[:, 5:, :, 2] = math.nan
    estimate = f(z, tracks.prior)
    assert not estimate.failed.any()
    assert (estimate.info.association[:, :, 5:15, 0] < 0.5).double().mean() > 0.7
    assert (
        estimate.scale_tril[..., 5, :].norm(dim=-1)[:, :, 15]
        > f(tracks.z, tracks.prior).scale_tril[..., 5, :].norm(dim=-1)[:, :, 15]
    ).all()


def test_a_track_that_searches_does_not_widen_further_while_nothing_is_measured_at_all():
    f = plane(lost=1e-2, gate=ChiSquare(0.99))
    z = torch.full((30, 1, 2), math.nan).double()
    z[:5] = 1e4
    searching, patient = (g(z, flat_prior((0.0, 0.0))) for g in (f, plane(gate=ChiSquare(0.99))))
    ratio = (searching.scale_tril[0, :, 0, 0] / patient.scale_tril[0, :, 0, 0]).log2()
    assert ratio[4] > 1
    assert ratio.max() < 5.5


def test_values_of_scenes_work_with_scans_of_one():
    z = torch.randn(6, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    prior, values = flat_prior((0.0, 0.0), (3.0, 1.0)), torch.tensor([[0.9], [0.8], [0.7]], dtype=torch.float64)
    for options, alone in (
        ({"detection": values}, {"detection": 0.8}),
        ({"clutter": Clutter(1e4, rate=10 * values)}, {"clutter": Clutter(1e4, rate=8.0)}),
        ({"clutter": Clutter(1e4 * values)}, {"clutter": Clutter(8e3)}),
        ({"gate": ChiSquare(values)}, {"gate": ChiSquare(0.8)}),
    ):
        together, one = plane(**options)(z, prior), plane(**alone)(z, prior)
        torch.testing.assert_close(together.mean[1], one.mean)
        state, _ = plane(**options).step(plane(**options).init(prior), z[0])
        torch.testing.assert_close(state.belief.mean[1], one.mean[:, 0])


def test_an_empty_batch_is_a_batch(scenario):
    f = make("iaukf_jpda", scenario)
    prior = Gaussian(torch.zeros(0, 2, 6).double(), torch.zeros(0, 2, 6, 6).double())
    assert f(torch.zeros(0, 5, 8, 3).double(), prior).mean.shape == (0, 2, 5, 6)
    single = scenarios.noise_change()
    plain = presets.iaukf(single.motion, single.sensor)
    prior = Gaussian(torch.zeros(0, 6).double(), torch.zeros(0, 6, 6).double())
    assert plain(torch.zeros(0, 5, 3).double(), prior).mean.shape == (0, 5, 6)


def test_what_had_to_be_mended_and_how_far_robust_filters_trust_is_told(scenario, tracks):
    robust = presets.jpda(scenario.motion, scenario.sensor, clutter=scenario.clutter, inner=presets.rsrckf)
    info = robust(tracks.z, tracks.prior).info
    assert info.weights.shape == (3, 2, STEPS, 8, 3)
    assert info.repaired is None
    high = presets.jpda(scenario.motion, scenario.sensor, clutter=scenario.clutter, inner=presets.ghckf)
    assert high(tracks.z, tracks.prior).info.repaired.shape == (3, 2, STEPS)


@pytest.mark.slow
def test_torch_compile_sees_a_step_as_it_is(scenario, tracks):
    f = make("iaukf_jpda", scenario)
    state = f.init(tracks.prior)
    fast = torch.compile(f.step, backend="eager", fullgraph=True)
    torch.testing.assert_close(fast(state, tracks.z[:, 0])[0].belief.mean, f.step(state, tracks.z[:, 0])[0].belief.mean)


def test_shared_noise_is_one_for_all_targets(scenario, tracks):
    apart = make("iaukf_jpda", scenario)(tracks.z, tracks.prior).info.noise
    shared = make("iaukf_jpda", scenario, share_noise=True)(tracks.z, tracks.prior).info.noise
    assert (apart[:, 0] != apart[:, 1]).any()
    assert torch.equal(shared[:, 0], shared[:, 1])


def test_residuals_may_tell_the_noise(scenario, tracks):
    estimate = make("iaukf_jpda", scenario, adapt="residual")(tracks.z, tracks.prior)
    assert estimate.info.noise[:, :, -1].mean() > 2
    assert not estimate.failed.any()


def test_a_lost_track_searches_and_finds_and_a_dead_one_stays_finite():
    """A start 60 m off, of a track that believes in 3 m: within 15 scans it is back with its target."""
    f = {lost: plane(lost=lost, gate=ChiSquare(0.99), clutter=Clutter(1e5, rate=0.5)) for lost in (0.0, 1e-3)}
    for g in f.values():
        g.motion.q.set(1e-3)
    t = torch.arange(1, 41, dtype=torch.float64)
    truth = torch.stack([60 + t, 0 * t], -1)
    z = truth.unsqueeze(1) + torch.randn(40, 1, 2, generator=torch.Generator().manual_seed(0)).double()
    far = {lost: (g(z, flat_prior((0.0, 0.0))).mean[0, :, :2] - truth).norm(dim=-1) for lost, g in f.items()}
    assert far[0.0][:15].min() > 20
    assert far[1e-3][15:].max() < 5
    z[10:] = 1e4  # another place altogether
    assert f[1e-3](z, flat_prior((60.0, 0.0))).scale_tril.isfinite().all()


# ----------------------------------------------------------------------------------------------------- the paper


@pytest.mark.slow
@pytest.mark.parametrize("which", ["straight", "crossing"])
def test_the_noise_estimate_wins_by_far_where_the_noise_grows_and_costs_nothing_where_it_does_not(which):
    """100 runs, gates of 100 and 150 m: the claims on errors, lost tracks and swaps."""
    for scale, most in ((4.0, 0.35), (1.0, 1.05)):
        s = getattr(scenarios, f"clutter_{which}")(noise_scale=scale)
        t = s.simulate(100, 0)
        for size in (100.0, 150.0):
            runs = {}
            for name, gate in (("ukf_jpda", Euclidean(size)), ("iaukf_jpda", Euclidean(size, least=0.9999))):
                mean = s.cartesian(make(name, s, gate=gate)(t.z, t.prior)).mean
                runs[name] = metrics.error(mean, t.truth, s.truth_position)[..., 10:].square().mean((1, 2)).sqrt()
            worst = {name: run.square().mean().sqrt() for name, run in runs.items()}
            assert worst["iaukf_jpda"] < most * worst["ukf_jpda"]
            assert (runs["iaukf_jpda"] > 100).sum() == 0
            assert runs["iaukf_jpda"].median() < (17 if scale > 1 else 5)
            assert runs["ukf_jpda"].median().item() == pytest.approx(4.7 if scale == 1 else 39.0, rel=0.2)


def test_what_does_not_fit_is_named(scenario):
    motion, sensor, clutter = scenario.motion, scenario.sensor, scenario.clutter
    flat = ConstantVelocity(1.0, 2)
    for build, said in (
        (
            lambda: JPDA(presets.fra(flat, Position(1.0)), gate=ChiSquare(), clutter=Clutter(1.0)),
            "inner: expected an SRCKF",
        ),
        (lambda: JPDA(SRCKF(Bank([flat, flat]), Position(1.0)), gate=ChiSquare(), clutter=Clutter(1.0)), "inner"),
        (lambda: presets.jpda(flat, Bearings(0.1), clutter=Clutter(1.0)), "sensor: expected one that measures each"),
        (
            lambda: presets.jpda(flat, Bearings(0.1), clutter=Clutter(extent=[1.0, 1.0]), gate=Euclidean()),
            "where the target",
        ),
        (lambda: presets.jpda(flat, Position(1.0), clutter=Clutter(extent=[1.0] * 3)), "extent: expected"),
        (lambda: Clutter(), "volume, extent"),
        (lambda: Clutter(-1.0), "volume"),
        (lambda: ChiSquare(1.0), "probability"),
        (lambda: Euclidean(1.0, least=1.0), "least"),
        (lambda: presets.ukf_jpda(motion, sensor, clutter=clutter, detection=0.0), "detection: expected a prob"),
        (lambda: presets.ukf_jpda(motion, sensor, clutter=clutter, lost=1.0), "lost"),
        (lambda: presets.ukf_jpda(motion, sensor, clutter=clutter, share_noise=True), "share_noise"),
        (lambda: presets.ukf_jpda(motion, sensor, clutter=clutter, exact=(8, 12)), "exact"),
        (lambda: presets.ukf_jpda(motion, sensor, clutter=clutter, temperature=-1.0), "temperature"),
        (lambda: scenarios.clutter_straight(detection=0.0), "detection"),
        (lambda: scenarios.clutter_crossing(dt=0.0), "dt"),
        (lambda: scenarios.clutter_straight(std=(1.0, 2.0)), "std"),
    ):
        with pytest.raises(ValueError, match=said):
            build()
    f = presets.iaukf_jpda(motion, sensor, clutter=clutter)
    good = scenario.prior
    for z, prior, options, said in (
        (torch.zeros(5, 3).double(), good, {}, r"z: expected \(..., T, J, 3\)"),
        (torch.zeros(5, 0, 3).double(), good, {}, r"z: expected"),
        (
            torch.zeros(5, 2, 3).double(),
            Gaussian(good.mean[0], good.scale_tril[0]),
            {},
            r"prior.mean: expected \(..., N, 6\)",
        ),
        (torch.zeros(5, 2, 3).double(), good, {"std": torch.ones(5, 3).double()}, "std: expected"),
        (torch.zeros(5, 2, 3).double(), good, {"dt": 0.0}, "dt: expected"),
        (torch.zeros(4, 5, 2, 3).double(), Gaussian(good.mean.expand(3, 2, 6), good.scale_tril), {}, "batch: expected"),
        (torch.zeros(5, 2, 3).double(), good, {"truncate": 0}, "truncate"),
        (
            torch.zeros(5, 2, 3).double(),
            Gaussian(good.mean, good.scale_tril[:1]),
            {},
            "prior.scale_tril: expected one for",
        ),
        (
            torch.zeros(5, 2, 3).double(),
            Gaussian(good.mean[:1], good.scale_tril[:1]),
            {},
            "rate: expected a value for each",
        ),
    ):
        with pytest.raises(ValueError, match=said):
            f(z, prior, **options)
    with pytest.raises(CompileError, match="JPDA"):
        f.compile()
