"""What a fit says of its own certainty is so: exact Hessians, intervals that cover, values that tracks do not tell."""

import json

import certainty
import pytest
import torch
from test_fit import PRIOR, QUICK, STD, Q, start, walks

import torchfra
from torchfra import Gaussian, presets
from torchfra.filters.hessian import hessian
from torchfra.fitting.data import batch_of
from torchfra.fitting.descent import bounded
from torchfra.fitting.newton import Sums, median_of_nonzero, minimised
from torchfra.fitting.objective import Objective
from torchfra.fitting.vector import NORMAL_95, Vector, copied
from torchfra.motion import ConstantVelocity, CoordinatedTurn
from torchfra.sensors import Position


def sums_of(f, z, **options):
    vector = Vector(f)
    objective = Objective(f, vector, "likelihood", scale=1.0, states=slice(0, 2))
    return vector, Sums(objective, batch_of(f, {"z": z, "prior": PRIOR}, runs=0, seed=0), vector.directions, **options)


def exact(f, vector, z, raw):
    """The Hessian of the negative log likelihood that autograd gives."""

    def total(values):
        options = (z, Gaussian(*(x.expand(len(z), *x.shape) for x in PRIOR)))
        return -torch.func.functional_call(f, vector.parameters(values), options).log_likelihood.sum()

    return torch.autograd.functional.hessian(total, raw)


def test_the_hessian_is_that_of_autograd():
    f, z = start(learn=("q", "std")), walks(0, 4, 6)[1]
    vector, sums = sums_of(f, z)
    raw = vector.raw()
    curvature = sums.curvature(raw[None])
    expected = exact(f, vector, z, raw)
    assert torch.allclose(curvature.hessian[0], expected, rtol=1e-6, atol=1e-6)


def test_the_hessian_is_that_of_a_loop_of_ones_own():
    f, z = start(learn=("q", "std")), walks(0, 4, 6)[1]
    vector, sums = sums_of(f, z)
    alone = hessian(lambda: -f(z, PRIOR).log_likelihood.sum(), list(f.parameters()))
    found = sums.curvature(vector.raw()[None]).hessian[0]
    assert torch.allclose(found, alone.matrix, rtol=1e-6, atol=1e-6)


def test_the_scores_are_the_gradients_of_single_tracks():
    f, z = start(learn=("q", "std")), walks(0, 5, 6)[1]
    vector, sums = sums_of(f, z)
    expected = torch.zeros(2, 2, dtype=torch.float64)
    for track in z:
        loss = -f(track, PRIOR).log_likelihood.sum()
        gradient = torch.stack(torch.autograd.grad(loss, list(f.parameters())))
        expected += gradient.outer(gradient)
    assert torch.allclose(sums.curvature(vector.raw()[None]).scores[0], expected)


def test_a_track_whose_loss_is_chaotic_is_distinguished_from_the_others(monkeypatch):
    f, z = start(learn=("q", "std")), walks(0, 6, 6)[1]
    vector, sums = sums_of(f, z)
    raw = vector.raw()[None]
    assert sums.not_chaotic(raw).all()
    loss, gradient, bends = sums.of_tracks(raw)
    bends[:, 2] *= 1000
    bends[:, 4] = torch.nan
    monkeypatch.setattr(sums, "of_tracks", lambda raw: (loss, gradient, bends))
    assert sums.not_chaotic(raw).tolist() == [True, True, False, True, False, True]


def test_tracks_that_a_value_does_not_reach_are_regular_and_do_not_make_the_others_chaotic(monkeypatch):
    f, z = start(learn=("q", "std")), walks(0, 6, 6)[1]
    vector, sums = sums_of(f, z)
    raw = vector.raw()[None]
    loss, gradient, bends = sums.of_tracks(raw)
    bends[:, :4] = 0
    monkeypatch.setattr(sums, "of_tracks", lambda raw: (loss, gradient, bends))
    assert sums.not_chaotic(raw).all()


def test_a_gradient_of_zero_stays_zero_where_those_of_most_tracks_are():
    gradients = torch.tensor([[0.0], [0.0], [2.0]])
    clipped, finite = bounded(torch.zeros(3), gradients, 10 * median_of_nonzero(gradients.norm(dim=-1), 0))
    assert torch.equal(clipped, gradients)
    assert finite.all()


def test_weights_count_tracks_as_often_as_they_say():
    f, z = start(learn=("q", "std")), walks(0, 4, 6)[1]
    vector, weighted = sums_of(f, z, weights=torch.tensor([[2.0, 0, 1, 0]]).double())
    _, twice = sums_of(f, z[[0, 0, 2]])
    raw = vector.raw()[None]
    assert torch.allclose(weighted.curvature(raw).hessian, twice.curvature(raw).hessian)
    assert torch.allclose(weighted.losses(raw), twice.losses(raw))


@pytest.mark.slow
def test_rows_of_probabilities_have_a_standard_error_and_intervals_inside_zero_and_one():
    bank = [ConstantVelocity(0.5), CoordinatedTurn(0.3, 0.5)]
    f = presets.imm_srckf(bank, Position(STD), transition=[[0.95, 0.05], [0.05, 0.95]], learn=("transition",))
    found = torchfra.fit(f, {"z": walks(0, 12, 4)[1], "prior": PRIOR}, compile=False, iterations=2, quiet=True)
    assert len(found.learned) == 4
    for row in (0, 1):
        ends = [found.learned[f"transition[{row},{j}]"] for j in (0, 1)]
        assert sum(ends) == pytest.approx(1)
        errors = [found.errors[f"transition[{row},{j}]"] for j in (0, 1)]
        assert errors[0] == pytest.approx(errors[1])
        low, high = found.intervals[f"transition[{row},0]"]
        assert 0 <= low <= ends[0] <= high <= 1


def test_the_copy_that_is_fitted_has_probabilities_that_sum_to_one_too():
    bank, rows = [ConstantVelocity(0.5), ConstantVelocity(9.0)], [[0.95, 0.05], [0.05, 0.95]]
    f = copied(presets.imm_srckf(bank, Position(STD), transition=rows), ("transition",))
    assert Vector(f).directions.shape == (4, 2)


def test_a_value_that_tracks_do_not_tell_is_named():
    z = walks(1, 40, 12, q=1e-7)[1]  # hardly any process noise: below some level, it is all the same
    f = presets.srckf(ConstantVelocity(1e-7), Position(STD))
    found = torchfra.fit(f, {"z": z, "prior": PRIOR}, learn=("q", "std"), polish=False, **QUICK)
    told = dict(zip(found.learned, found.certainty.identified, strict=True))
    assert told == {"motion.q": False, "sensor.std": True}
    assert found.certainty.weakest.startswith("motion.q up")


def test_values_that_are_mixed_up_have_a_large_condition():
    class Both(Position):
        """A position whose noise is the product of two values: only the product can be known."""

        def __init__(self):
            super().__init__(STD)
            self.more = torchfra.Hyper(1.0, name="more")

        def measurement_noise(self, z, std=None, root=None):
            return super().measurement_noise(z, (self.std(z) * self.more(z)).unsqueeze(-1), root)

    f = presets.srckf(ConstantVelocity(Q), Both(), learn=("std", "more"))
    found = torchfra.fit(f, {"z": walks(0, 20, 8)[1], "prior": PRIOR}, **QUICK)
    assert found.certainty.condition > 1e6
    assert set(found.certainty.weakest.split(":")[0].split(", ")) == {"sensor.std up", "sensor.more down"}


@pytest.fixture(scope="module")
def found():
    return torchfra.fit(start(), {"z": walks(7, 60, 10)[1], "prior": PRIOR}, learn=("q", "std"), **QUICK)


@pytest.mark.slow
def test_a_profile_rises_as_the_hessian_says_near_the_best(found):
    profile = found.profile("sensor.std", points=5, reach=1.0)
    middle, error = found.learned["sensor.std"], found.errors["sensor.std"]
    assert profile.growth[2] == pytest.approx(0, abs=1e-6)
    assert profile.values[2] == pytest.approx(middle)
    assert profile.values[4] - middle == pytest.approx(error, rel=0.1)
    assert [profile.growth[i] for i in (0, 4)] == pytest.approx([0.5, 0.5], rel=0.1)  # one standard error away
    assert len(profile.inside) == 5


def test_a_profile_of_what_is_not_there_is_refused(found):
    with pytest.raises(ValueError, match="name: expected one of"):
        found.profile("gate")
    for wrong in ({"points": 1}, {"reach": 0.0}):
        with pytest.raises(ValueError, match="points, reach: expected 2 or more"):
            found.profile("sensor.std", **wrong)


@pytest.mark.slow
def test_the_bootstrap_agrees_with_the_hessian_where_the_model_holds(found):
    drawn = found.bootstrap(30)
    for name, error in found.errors.items():
        assert 0.6 * error < drawn.errors[name] < 1.6 * error  # 30 resamples: a standard deviation of 13 %
        low, high = drawn.intervals[name]
        assert low < found.learned[name] < high
    with pytest.raises(ValueError, match="resamples: expected 10 or more"):
        found.bootstrap(5)


@pytest.mark.slow
def test_the_sandwich_is_wider_where_the_model_does_not_hold():
    truth, z = walks(8, 100, 15)
    z = truth[..., :2] + (z - truth[..., :2]) * torch.tensor([0.4, 1.5]).double()[torch.arange(100) % 2, None, None]
    by_hessian, by_sandwich = (
        torchfra.fit(start(), {"z": z, "prior": PRIOR}, learn=("std", "q"), errors=kind, **QUICK).errors["sensor.std"]
        for kind in ("hessian", "sandwich")
    )
    assert by_sandwich > 2 * by_hessian


def coverage(sets, runs, steps, seed):
    """The share of 95 % intervals that hold the true q and std, over data sets that are fitted one after the other."""
    f, inside = presets.srckf(ConstantVelocity(3 * Q), Position(3 * STD), learn=("q", "std")).compile(), []
    for z in walks(seed, sets * runs, steps)[1].split(runs):
        vector, sums = sums_of(f, z)
        raw, curvature = minimised(sums, vector.raw()[None])
        assert (curvature.gradient_size < 0.1).all()
        error = torch.linalg.inv(curvature.hessian).diagonal(dim1=-2, dim2=-1).sqrt()
        known = torch.stack([vector.unconstrained("motion.q", [Q])[0], vector.unconstrained("sensor.std", [STD])[0]])
        inside.append((raw - known).abs() <= NORMAL_95 * error)
    return torch.cat(inside).double().mean(0).tolist()


@pytest.mark.slow
def test_intervals_cover_the_true_values_in_95_of_100_fits():
    for share in coverage(sets=100, runs=25, steps=20, seed=12):
        assert 0.90 <= share <= 0.98


@pytest.mark.slow
def test_errors_of_whole_fits_are_as_large_as_they_say(tmp_path, capsys):
    small = ["--fits", "12", "--tracks", "24", "--steps", "10", "--iterations", "4"]
    assert certainty.main([*small, "--json", str(tmp_path / "c.json")]) == 0
    found = json.loads((tmp_path / "c.json").read_text())["values"]
    for of in found.values():
        assert of["inside"] >= 9 / 12  # of intervals that hold in 95 of 100, fewer do once in 5000
        assert 0.45 < of["rms"] < 1.7  # 99.9 % of the roots of mean squares of 12 normal numbers
    assert "12 fits" in capsys.readouterr().out
