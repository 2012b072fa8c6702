"""Targets that exist with a probability: joint integrated probabilistic data association."""

import math

import numpy as np
import pytest
import torch
from joint import plane
from oracles.events import joint_existence

from torchfra import presets
from torchfra.association import ChiSquare, Clutter, associate
from torchfra.filters.scans.scan import associate_uncertain
from torchfra.targets import SPRT, Deletion, Existence, FieldOfView, OnePoint, Targets, TwoPoint

FALSE, WIDTH, COUNT = 12, 200.0, 3


def dense(scenes, steps, seed):
    """Scans ``(R, T, J, 2)``: three targets, which are rows 0 to 2 and measured in the first scan, in dense clutter."""
    rng = torch.Generator().manual_seed(seed)

    def anywhere(*shape):
        return WIDTH * torch.rand(*shape, 2, generator=rng).double()

    place, velocity = anywhere(scenes, COUNT), 3.0 * torch.randn(scenes, COUNT, 2, generator=rng).double()
    scans = []
    for k in range(steps):
        z = place + k * velocity + 2.0 * torch.randn(scenes, COUNT, 2, generator=rng).double()
        missed = torch.rand(scenes, COUNT, generator=rng) < 0.05
        z[missed & (k > 0)] = math.nan
        scans.append(torch.cat([z, anywhere(scenes, FALSE)], 1))
    return torch.stack(scans, 1)


def manager(confirmation, *, compile=False, **options):
    f = plane(Clutter(WIDTH**2, rate=float(FALSE)), detection=0.95, gate=ChiSquare(0.999))
    f = f.compile() if compile else f
    return Targets(f, **{"birth": OnePoint(3.0), "confirmation": confirmation} | options)


def run(targets, scans, **options):
    state, states = targets.init(len(scans)), []
    for z in scans.unbind(1):
        state = targets.step(state, z, **options)
        states.append(state)
    return states


def given_up(confirmation):
    """Share of targets whose first track, begun by their first measurement, is never confirmed."""
    confirmed = set()
    for state in run(manager(confirmation), dense(8, 8, 0)):
        of = state.track
        mine = of.confirmed & (of.identity < COUNT)
        confirmed |= set(zip(of.scene[mine].tolist(), of.identity[mine].tolist(), strict=True))
    return 1 - len(confirmed) / (8 * COUNT)


def test_existence_keeps_targets_that_a_ratio_test_gives_up_in_dense_clutter():
    """Tentative targets swallow each other's measurements, so that it gives up far more than it states."""
    assert given_up(SPRT(1e-3, missed=0.01)) > 0.2
    assert given_up(Existence()) < 0.15


def test_association_is_the_sum_over_who_exists_and_who_is_measured():
    rng = np.random.default_rng(0)
    for _ in range(20):
        L = rng.random((4, 3)) * (rng.random((4, 3)) < 0.6)
        exists, density = rng.uniform(0.001, 0.999, 3), np.full(4, 0.3)
        beta, missed, absent = joint_existence(L, 0.8, density, 0.9, exists)
        with np.errstate(divide="ignore"):
            ratio = torch.from_numpy(np.log(0.8 * L.T / density))
        miss = torch.tensor(math.log(1 - 0.8 * 0.9), dtype=torch.float64)
        found = associate_uncertain(torch.from_numpy(exists), ratio, miss)
        np.testing.assert_allclose(found.probabilities.mT, beta / (1 - absent), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.log_weights[:, 0].exp(), missed / (1 - absent), rtol=1e-9)
        odds = torch.from_numpy(exists).logit() + miss - found.log_weights[:, 0]
        np.testing.assert_allclose(odds, np.log((1 - absent) / absent), rtol=1e-9, atol=1e-9)


def test_targets_that_surely_exist_are_associated_as_ever():
    rng = torch.Generator().manual_seed(0)
    ratio, miss = torch.randn(5, 3, 4, generator=rng).double(), torch.tensor(-1.5).double()
    sure, plain = associate_uncertain(torch.ones(5, 3).double(), ratio, miss), associate(ratio, miss)
    for one, other in zip(sure, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_without_a_scan_lives_end_at_the_rate_of_the_lifetime():
    rule, exists = Existence(lifetime=50.0), torch.tensor([0.001, 0.3, 0.9, 0.999999]).double()
    later = rule.predicted(exists.logit(), torch.tensor([0.0, 1.0, 20.0, 500.0]).double()).sigmoid()
    expected = exists * torch.exp(-torch.tensor([0.0, 1.0, 20.0, 500.0]).double() / 50.0)
    torch.testing.assert_close(later, expected, rtol=1e-9, atol=0)


def test_a_measurement_that_a_target_may_explain_begins_a_less_probable_one():
    targets, z = manager(Existence(birth=0.1)), torch.tensor([[[50.0, 50.0], [200.0, 200.0]]]).double()
    state = targets.step(targets.init(), z)
    torch.testing.assert_close(state.track.score.sigmoid(), torch.full((2,), 0.1).double())
    state = targets.step(state, z[:, :1] + 6.0)
    old, _, new = state.track.score.sigmoid().tolist()
    assert 0.1 < old < 0.5
    assert new < 0.1 * (1 - 0.8 * old)


def test_a_target_that_has_ended_is_deleted_and_one_out_of_sight_is_not():
    z = torch.stack([50.0 + 3.0 * torch.arange(8.0)] * 2, -1).double().reshape(1, 8, 1, 2)
    nothing, ferry = torch.full((1, 6, 1, 2), math.nan).double(), torch.tensor([60.0, 60.0]).double()
    for away, there in ((0.0, 0), (500.0, 1)):
        targets = manager(Existence(), views={None: FieldOfView(100.0)})
        state = run(targets, z, u=ferry)[-1]
        assert len(state.identity) == 1
        for scan in nothing.unbind(1):
            state = targets.step(state, scan, u=ferry + away)
        assert len(state.identity) == there


def check_gradients(targets, scans):
    """Gradients of likelihoods and estimates with respect to all values are finite differences."""

    def likelihood():
        estimate = targets(scans)
        return estimate.log_likelihood.sum() + estimate.mean[estimate.confirmed].sum()

    likelihood().backward()
    for p in targets.parameters():
        with torch.no_grad():
            p += 1e-6
            above = likelihood()
            p -= 2e-6
            below = likelihood()
            p += 1e-6
        assert p.grad.abs() > 1e-3
        torch.testing.assert_close(p.grad, (above - below) / 2e-6, rtol=1e-5, atol=1e-6)


def test_gradients_are_those_of_finite_differences():
    scans = dense(1, 5, 3)
    targets = Targets(
        plane(learn=("detection", "q", "std")), birth=OnePoint(3.0), confirmation=Existence(confirmed=0.6)
    )
    check_gradients(targets, scans)


def test_a_filter_of_regimes_has_targets_that_may_not_exist_too():
    f = plane(Clutter(WIDTH**2, rate=4.0), detection=0.95, inner=presets.gpb)
    estimate = Targets(f, birth=TwoPoint(10.0), confirmation=Existence())(dense(1, 7, 6)[:, :, : COUNT + 4])
    assert estimate.confirmed[..., -1].sum() == COUNT


def test_existence_alone_needs_no_other_rule_of_deletion():
    assert manager(Existence()).deletion is None
    assert isinstance(manager(SPRT()).deletion, Deletion)
    assert manager(Existence(), deletion=Deletion(3)).deletion.misses == 3


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Existence(0.0), "lifetime: expected finite seconds above 0, received 0.0"),
    (lambda: Existence(math.inf), "lifetime: expected finite seconds above 0, received inf"),
    (lambda: Existence("x"), "lifetime: expected finite seconds above 0, received 'x'"),
    (lambda: Existence(birth=1e-3), "expected probabilities above 0 and below 1 in that order, received 0.001, 0.001"),
    (lambda: Existence(confirmed=1.0), "in that order, received 0.001, 0.1, 1.0"),
    (lambda: Targets(plane(clutter=Clutter(1e4)), confirmation=Existence()), "expected clutter of a Poisson rate"),
])  # fmt: skip
def test_arguments_that_do_not_fit_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
