"""Every hyperparameter learns by name, alone and in groups, and its gradient is the right one over whole tracks."""

import copy

import pytest
import torch
from conftest import PRESETS, without_acceleration

import torchfra
from torchfra import hyper, presets, scenarios
from torchfra.hyper import Hyper, hypers, learnable, named
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.robust import Huber
from torchfra.sensors import Bearings, Position, RangeBearing
from torchfra.types import Gaussian


def estimate(f, tracks):
    return f(tracks.z, tracks.prior, u=tracks.u)


# ---------------------------------------------------------------- names


@pytest.mark.parametrize("name", PRESETS)
def test_all_learns_every_value_that_lies_inside_its_range(name, make):
    f = make(name, learn="all")
    assert {path for path, hyper in hypers(f).items() if hyper.raw.requires_grad} == set(hypers(f))
    assert {n.removesuffix(".raw") for n, _ in f.named_parameters()} == set(hypers(f))


def test_values_on_the_edge_stay_as_they_are_under_all_and_are_refused_by_name(make):
    f = make("fra", fading_max=torch.inf, learn="all")
    assert not f.fading.fading_max.raw.requires_grad
    assert f.fading.weakening.raw.requires_grad
    with pytest.raises(ValueError, match="expected a value inside its range, to learn it"):
        make("fra", fading_max=torch.inf, learn=("fading_max",))


def test_a_name_is_the_last_part_of_a_path_or_the_whole_of_it(make):
    f = make("fra")
    assert set(named(f, ("q", "robust.threshold"))) == {"motion.q", "robust.threshold"}
    assert set(named(f, "gate")) == {"gate"}
    with pytest.raises(ValueError, match="expected 'all' or some of"):
        named(f, ("robust.q",))


def test_models_that_learn_are_copies_and_models_that_do_not_are_shared(scenario):
    f = presets.fra(scenario.motion, scenario.sensor, learn=("q", "threshold"))
    assert f.motion is not scenario.motion
    assert f.sensor is scenario.sensor
    assert not list(scenario.motion.parameters())


def test_a_model_that_was_made_learnable_before_is_shared_between_filters(scenario):
    motion = learnable(copy.deepcopy(scenario.motion), ("q",))
    one, other = (presets.srckf(motion, scenario.sensor, learn=("q",)) for _ in range(2))
    assert one.motion is other.motion is motion


def test_a_value_may_be_set_in_natural_units():
    hyper = Hyper(2.0, learn=True)
    hyper.set(5.0)
    assert hyper().item() == pytest.approx(5.0)
    with pytest.raises(ValueError, match=r"gate: expected a value above 0, received -1\.0"):
        hyper.set(-1.0, "gate")
    assert hyper().item() == pytest.approx(5.0)


def test_the_summary_is_a_table_of_names_values_ranges_and_what_learns(make, capsys):
    torchfra.summary(make("fra", learn=("threshold", "q"), per_element=True))
    lines = [line.split("  ") for line in capsys.readouterr().out.splitlines()]
    cells = {line[0].strip(): [c.strip() for c in line[1:] if c.strip()] for line in lines}
    assert cells["name"] == ["value", "range", "learning"]
    assert cells["robust.threshold"] == ["1.345, 1.345", "a value above 0", "learnable"]
    assert cells["motion.q"] == ["0.1", "a value of 0 or more", "learnable"]
    assert cells["fading.forgetting"] == ["0.95", "a value in [0, 1]", "fixed"]
    assert cells["preference"] == ["0", "a number", "fixed"]


# ---------------------------------------------------------------- per element, per group


@pytest.mark.parametrize("name", ["rsrckf", "rmckf", "fra"])
def test_a_threshold_for_each_element_is_one_for_all_when_they_are_equal(name, make, tracks):
    one, each = make(name, threshold=0.8), make(name, threshold=0.8, per_element=True)
    assert each.robust.threshold().shape == (2,)
    torch.testing.assert_close(estimate(each, tracks).mean, estimate(one, tracks).mean, rtol=0, atol=0)


def test_an_element_with_a_threshold_of_its_own_is_weighted_by_it():
    residual = torch.tensor([[3.0, 3.0], [-1.0, 8.0]], dtype=torch.float64)
    weights = Huber(torch.tensor([1.5, 4.0], dtype=torch.float64), elements=2)(residual, residual[:, 0])
    torch.testing.assert_close(weights, torch.tensor([[0.5, 1.0], [1.0, 0.5]], dtype=torch.float64))
    with pytest.raises(ValueError, match=r"threshold: expected \(\.\.\., 2\), received \(3,\)"):
        Huber(torch.ones(3), elements=2)


def test_thresholds_for_each_element_may_be_a_batch_of_them(make, tracks):
    values = torch.tensor([[[0.5, 2.0]], [[1.5, 1.0]]], dtype=torch.float64)  # (2, 1, m) against 4 tracks
    batch = estimate(make("fra", threshold=values, per_element=True), tracks)
    assert batch.mean.shape[:2] == (2, 4)
    for i in range(2):
        alone = estimate(make("fra", threshold=values[i, 0], per_element=True), tracks)
        torch.testing.assert_close(batch.mean[i], alone.mean, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("name", ["asrckf", "rmckf", "fra"])
def test_groups_of_states_take_their_share_of_the_fading(name, make, tracks):
    position, velocity = slice(0, 2), slice(2, 4)
    plain = estimate(make(name), tracks)
    nothing = estimate(make(name, states=(position, velocity), share=(1.0, 0.0)), tracks)
    torch.testing.assert_close(nothing.mean, plain.mean, rtol=1e-9, atol=1e-6)
    together = estimate(make(name, states=slice(0, 4)), tracks)
    all_of_it = estimate(make(name, states=(position, velocity)), tracks)
    torch.testing.assert_close(all_of_it.mean, together.mean, rtol=1e-9, atol=1e-6)
    some = make(
        name,
        states=(position, velocity),
        share=(1.0, 0.5),
        learn=("share",),
        **({"temperature": 1.0} if name == "fra" else {}),
    )
    estimate(some, tracks).mean.square().sum().backward()
    assert (some.fading.share.raw.grad != 0).all()
    with pytest.raises(ValueError, match=r"share: expected \(\.\.\., 2\), received \(1,\)"):
        make(name, states=(position, velocity), share=(1.0,))


def test_noise_for_each_element_learns_each(scenario):
    sensor = RangeBearing(torch.tensor([50.0, 0.01], dtype=torch.float64))
    f = presets.srckf(scenario.motion, sensor, learn=("std",))
    assert f.sensor.std().shape == (2,)
    z = sensor(scenario.simulate(3, 0).truth) + torch.randn(3, 100, 2).double() * sensor.std()
    prior = Gaussian(scenario.prior.mean, 100 * torch.eye(4).double())
    torchfra.losses.innovation_nll(f(z, prior)).mean().backward()
    assert (f.sensor.std.raw.grad != 0).all()


# ---------------------------------------------------------------- soft decisions


@pytest.mark.parametrize("name", ["fra_srckf", "fra"])
def test_a_soft_decision_becomes_the_hard_one_as_its_temperature_falls(name, make):
    scenario = without_acceleration(scenarios.bearings_outliers("std"))
    tracks = scenario.simulate(8, 3)
    tracks = tracks._replace(z=tracks.z[:, :40], u=tracks.u[:40])
    hard, soft = make(name), make(name, temperature=1e-7)
    a, b = estimate(hard, tracks), estimate(soft, tracks)
    assert a.info.adaptive.any()
    assert (a.info.abnormal & ~a.info.adaptive).any()
    torch.testing.assert_close(b.mean, a.mean, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(b.covariance, a.covariance, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(b.info.provisional.mean, a.info.provisional.mean, rtol=1e-9, atol=1e-6)
    assert (b.info.abnormal == a.info.abnormal).all()
    assert (b.info.adaptive == a.info.adaptive).all()
    soft.temperature = 0.0
    torch.testing.assert_close(estimate(soft, tracks).mean, a.mean, rtol=0, atol=0)


def test_only_a_soft_decision_has_a_gradient_in_its_gate_and_preference(make, tracks):
    for temperature in (0.0, 1.0):
        f = make("fra", learn=("gate", "preference"), temperature=temperature)
        loss = estimate(f, tracks).mean.square().mean()
        if not temperature:
            assert not loss.requires_grad
            continue
        loss.backward()
        assert f.gate.raw.grad != 0
        assert f.preference.raw.grad != 0


@pytest.mark.slow
def test_a_preference_moves_the_decision_to_its_side(make):
    tracks = without_acceleration(scenarios.bearings_outliers("std")).simulate(24, 3)
    tracks = tracks._replace(z=tracks.z[:, :30], u=tracks.u[:30])
    kept = [estimate(make("fra", preference=p), tracks).info.adaptive.sum().item() for p in (-1e6, -2.0, 0.0, 2.0, 1e6)]
    assert kept == sorted(kept, reverse=True)
    assert kept[0] > kept[2] > kept[4] == 0


def test_a_branch_that_lost_its_numbers_is_not_mixed_in(make, tracks):
    f = make("fra", temperature=1.0)
    state = f.init(tracks.prior)
    for k in range(4):
        state, _ = f.step(state, tracks.z[:, k], u=tracks.u[k])
    lost = Gaussian(*(torch.full_like(x, torch.nan) for x in state.adaptive))
    after, _ = f.step(state._replace(adaptive=lost), tracks.z[:, 4], u=tracks.u[4])
    assert after.lagged.mean.isfinite().all()
    none_left, _ = f.step(state._replace(adaptive=lost, robust=lost), tracks.z[:, 4], u=tracks.u[4])
    assert none_left.lagged.mean.isnan().all()


def test_a_temperature_below_zero_is_refused(scenario):
    with pytest.raises(ValueError, match="temperature: expected 0 or more, received -1"):
        presets.fra(scenario.motion, scenario.sensor, temperature=-1.0)


# ---------------------------------------------------------------- gradients over whole tracks


def benign(steps=30):
    """No outliers, a start near the truth: no step sits on an edge."""
    scenario = without_acceleration(scenarios.bearings_outliers("none", initial="truth"))
    tracks = scenario.simulate(3, 4)
    return tracks._replace(z=tracks.z[:, :steps], u=tracks.u[:steps], truth=tracks.truth[:, :steps])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [  # over fewer steps: the battery, of every filter
    ("iaukf", {}),
    ("fra", {"temperature": 1.0, "per_element": True, "states": (slice(0, 2), slice(2, 4)), "share": (1.0, 0.5)}),
], ids=str)  # fmt: skip
def test_gradients_through_thirty_steps_are_those_of_finite_differences(name, options, make):
    tracks = benign()
    f = make(name, learn="all", **options)
    values = {path: p.detach() for path, p in f.named_parameters()}
    direction = torch.cos(torch.arange(tracks.truth.numel(), dtype=torch.float64)).reshape(tracks.truth.shape)

    def loss(values):
        e = torch.func.functional_call(f, values, (tracks.z, tracks.prior), {"u": tracks.u})
        return (direction * (e.mean - tracks.truth)).mean() + e.log_likelihood.mean()

    learned = {path: p.clone().requires_grad_() for path, p in values.items()}
    value = loss(learned)
    gradients = torch.autograd.grad(value, list(learned.values()), allow_unused=True)
    step, rounding, like = 1e-4, 1e-9 * abs(value.item()), {"dtype": torch.float64}
    sizes = [p.numel() for p in values.values()]
    moves = step * torch.tensor([1.0, -1, 2, -2], **like)[:, None, None] * torch.eye(sum(sizes), **like)
    moved = {  # every element of every value by itself, all in one call
        path: p + move.reshape(-1, *p.shape)
        for (path, p), move in zip(values.items(), moves.flatten(0, 1).split(sizes, -1), strict=True)
    }
    with torch.no_grad():
        losses = torch.func.vmap(loss)(moved).reshape(4, -1)
    expected = (8 * (losses[0] - losses[1]) - (losses[2] - losses[3])) / (12 * step)  # fourth order
    for path, gradient, differences in zip(values, gradients, expected.split(sizes), strict=True):
        exact = torch.zeros_like(differences) if gradient is None else gradient.flatten()
        assert exact.tolist() == pytest.approx(differences.tolist(), rel=1e-5, abs=rounding), path


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [
    ("mr_ckf", {}), ("fra", {}), ("fra", {"temperature": 1.0}),
])  # fmt: skip
def test_hundreds_of_tracks_of_outliers_have_gradients_without_a_nan(name, options, make):
    scenario = without_acceleration(scenarios.bearings_outliers("std", truth_noise=0.01))
    tracks = scenario.simulate(300, 77)
    tracks = tracks._replace(z=tracks.z[:, :50], u=tracks.u[:50], truth=tracks.truth[:, :50])
    f = make(name, learn="all", **options)
    names, shared = zip(*f.named_parameters(), strict=True)
    own = [p.detach().expand(300).clone().requires_grad_() for p in shared]  # each track its own gradient
    call = (tracks.z, tracks.prior)
    e = torch.func.functional_call(f, dict(zip(names, own, strict=True)), call, {"u": tracks.u})
    loss = torchfra.losses.robust_mse(e.mean, tracks.truth, scenario.position, 100.0)
    gradients = torch.autograd.grad(loss.sum(), own, allow_unused=True)
    assert not e.failed.any()
    for path, gradient in zip(names, gradients, strict=True):
        assert gradient is None or gradient.isfinite().all(), path


def test_truncated_back_propagation_stops_gradients_and_changes_no_estimate(make, tracks):
    f = make("fra", learn=("q",), temperature=1.0)
    z = tracks.z.nan_to_num().requires_grad_()
    whole = f(z, tracks.prior, u=tracks.u)
    cut = f(z, tracks.prior, u=tracks.u, truncate=4)
    torch.testing.assert_close(cut.mean, whole.mean, rtol=0, atol=0)
    (far,) = torch.autograd.grad(cut.mean[:, 4:].sum(), z)
    assert (far[:, :4] == 0).all()
    assert (far[:, 4:] != 0).any()
    (far,) = torch.autograd.grad(whole.mean[:, 4:].sum(), z)
    assert (far[:, :4] != 0).any()
    with pytest.raises(ValueError, match="truncate: expected at least 1 step, received 0"):
        f(z, tracks.prior, u=tracks.u, truncate=0)


# ---------------------------------------------------------------- ensembles


@pytest.mark.slow
def test_an_ensemble_of_hyperparameters_is_one_call_of_vmap(make, tracks):
    f = make("fra", learn=("threshold", "q"), temperature=1.0)
    values = {name: p.detach() + torch.tensor([-0.5, 0.0, 0.7]).double() for name, p in f.named_parameters()}

    def loss(values):
        e = torch.func.functional_call(f, values, (tracks.z, tracks.prior), {"u": tracks.u})
        return torchfra.losses.mse(e.mean, tracks.truth, slice(0, 2)).mean()

    mapped, gradient = torch.func.vmap(torch.func.grad_and_value(loss))(values)[::-1]
    for i in range(3):
        alone = {name: value[i].clone().requires_grad_() for name, value in values.items()}
        expected = loss(alone)
        torch.testing.assert_close(mapped[i], expected.detach(), rtol=1e-8, atol=1e-8)
        for name, g in zip(alone, torch.autograd.grad(expected, list(alone.values())), strict=True):
            torch.testing.assert_close(gradient[name][i], g, rtol=1e-6, atol=1e-6)


def test_a_sensor_of_one_std_for_all_may_have_a_batch_of_them(scenario, tracks):
    f = presets.srckf(ConstantVelocity(0.1), Bearings(0.02), learn=("std",))
    raw = torch.tensor([0.01, 0.02, 0.03, 0.04]).double().log()
    batch = torch.func.functional_call(f, {"sensor.std.raw": raw}, (tracks.z, tracks.prior), {"u": tracks.u})
    for i in range(4):
        alone = presets.srckf(ConstantVelocity(0.1), Bearings(0.01 * (i + 1)))
        prior = Gaussian(tracks.prior.mean[i], tracks.prior.scale_tril)
        torch.testing.assert_close(batch.mean[i], alone(tracks.z[i], prior, u=tracks.u).mean, rtol=1e-7, atol=1e-6)


def test_shares_without_states_are_of_position_velocity_and_acceleration():
    models = ConstantAcceleration(0.01), Position(1.0)
    every, one = (presets.fra(*models, **share).fading.states for share in ({"share": (1, 0.1, 0.1)}, {}))
    assert every == (slice(0, 2), slice(2, 4), slice(4, 6))
    assert one == (slice(0, 2),)


# ---------------------------------------------------------------- values within a call


def test_a_value_is_computed_once_for_all_steps_of_a_call(make, tracks, monkeypatch):
    computed = []
    transform_to = hyper.transform_to
    monkeypatch.setattr(hyper, "transform_to", lambda constraint: computed.append(1) or transform_to(constraint))
    counts = []
    for steps in (2, 5):
        computed.clear()
        make("gpb").smooth(tracks.z[:, :steps], tracks.prior, u=tracks.u[:steps])
        counts.append(len(computed))
    assert counts[0] == counts[1]


def test_a_value_that_changes_between_calls_counts_in_the_next_one(make, tracks):
    f = make("gpb")
    before = estimate(f, tracks).mean
    f.regimes.noise_levels.set(2 * f.regimes.noise_levels())
    f.sensor.std.set(3 * f.sensor.std())
    other = make("gpb")
    other.load_state_dict(f.state_dict())
    after = estimate(f, tracks).mean
    assert torch.equal(after, estimate(other, tracks).mean)
    assert not torch.equal(after, before)


@pytest.mark.parametrize("name", ["fra", "gpb"])
def test_gradients_of_values_computed_once_are_those_of_values_computed_in_every_step(name, make, tracks):
    f = make(name, learn="all")
    parameters = list(f.parameters())
    logs = [
        f(tracks.z, tracks.prior, u=tracks.u, checkpoint=checkpoint).log_likelihood.sum() for checkpoint in (None, 1)
    ]
    once, every = (torch.autograd.grad(log, parameters, allow_unused=True, materialize_grads=True) for log in logs)
    for one, each in zip(once, every, strict=True):
        torch.testing.assert_close(one, each, rtol=1e-9, atol=1e-12)
