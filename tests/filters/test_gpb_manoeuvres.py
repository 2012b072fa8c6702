"""What a target may do is one word: gpb then counts on no manoeuvres, on some or on hard ones."""

import math

import pytest
import torch

from torchfra import presets
from torchfra.metrics import nees, rmse
from torchfra.motion import Augmented, ConstantVelocity, GaussMarkov, Odometry
from torchfra.scenarios import as_stated
from torchfra.sensors import Position
from torchfra.types import Gaussian

STD, STEPS, RUNS = 10.0, 80, 20
PRIOR = Gaussian(torch.tensor([0.0, 0, 40, 0]).double(), torch.diag(torch.tensor([STD, STD, 3, 3]).double()))


def turn(outliers=0.0):
    """40 m/s and a half turn at 10 deg/s, by fixes of 10 m, some of which may be 100 m off."""
    rng = torch.Generator().manual_seed(5)
    rate = torch.zeros(STEPS, dtype=torch.float64)
    rate[40:58] = math.radians(10.0)
    heading = rate.cumsum(0)
    truth = (40 * torch.stack([heading.cos(), heading.sin()], -1)).cumsum(0).expand(RUNS, -1, -1)
    noise = torch.randn(truth.shape, dtype=torch.float64, generator=rng)
    wrong = torch.rand(RUNS, STEPS, 1, dtype=torch.float64, generator=rng) < outliers
    return truth, truth + STD * torch.where(wrong, 10.0, 1.0) * noise


FEW_OUTLIERS = {"outlier_sizes": (100.0,), "outlier_shares": (1.0,), "adaptive_largest_size": False}
"""Of one size, for the compiler's time."""


def gpb(manoeuvres, motion=None, **options):
    return presets.gpb(
        motion or ConstantVelocity(0.1, continuous=True), Position(STD), manoeuvres=manoeuvres, **options
    )


@pytest.mark.slow
@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_a_hard_turn_of_one_motion_is_not_taken_for_outliers(outliers):
    truth, z = turn(outliers)
    error = {word: (gpb(word)(z, PRIOR).mean[..., :2] - truth).norm(dim=-1) for word in ("some", "hard")}
    for found in error.values():
        assert found.square().mean() < (2 * STD) ** 2
        assert found[:, 60:].median() < 2 * STD


@pytest.mark.slow
def test_smoothed_a_hard_turn_is_nearer_than_filtered():
    truth, z = turn()
    smoothed = gpb("hard").smooth(z, PRIOR)
    filtered, later = (rmse(e.mean, truth, slice(0, 2)).square().mean() for e in (smoothed.info.filtered, smoothed))
    assert later < 0.7 * filtered


@pytest.mark.parametrize("word", ["none", "hard"])
def test_where_the_model_holds_each_is_a_kalman_filter(word):
    scenario = as_stated("velocity", index=0.1, steps=60)
    tracks = scenario.simulate(100, 11)
    f = presets.gpb(scenario.motion, scenario.sensor, manoeuvres=word)
    found, plain = (g(tracks.z, tracks.prior) for g in (f, presets.srckf(scenario.motion, scenario.sensor)))
    errors = [rmse(e.mean, tracks.truth, scenario.position)[20:].mean() for e in (found, plain)]
    assert errors[0] < 1.02 * errors[1]
    assert 0.9 < nees(found, tracks.truth)[:, 20:].mean() / 4 < 1.1


def test_with_none_a_target_moves_as_it_is_stated_to_and_outliers_are_still_found():
    _, z = turn()
    z = z.clone()
    z[:, 20] += 300
    e = gpb("none")(z[:, :30], PRIOR)
    assert e.info.probabilities.shape[-1] == 1
    assert (e.info.outlier[:, 20] > 0.99).all()


def test_what_is_given_wins_over_the_word():
    f = gpb("none", noise_levels=(2.0,))
    assert f.regimes.noise_levels().tolist() == [2.0]


@pytest.mark.slow
def test_compiled_hard_manoeuvres_are_the_same_with_the_same_gradients():
    line = ConstantVelocity(0.1, dims=1, continuous=True)  # and no bank, for the compiler's time
    prior = Gaussian(torch.zeros(2).double(), torch.diag(torch.tensor([10, 40]).double()))
    z, found = turn(0.05)[1][:3, 36:46, 1:], []
    for compiled in (False, True):
        learn = ("manoeuvre_factors", "noise_levels")
        f = presets.gpb(line, Position(STD, dims=1), manoeuvres="hard", learn=learn, **FEW_OUTLIERS)
        f = f.compile() if compiled else f
        e = f(z - z[:, :1], prior)
        (e.mean.square().sum() + e.info.filtered.mean.square().sum()).backward()
        found.append([e.mean, e.covariance, e.info.outlier, *(p.grad for p in f.parameters())])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-9 * float(one.detach().abs().max()))


def test_an_unknown_word_is_an_error():
    with pytest.raises(ValueError, match="manoeuvres: expected one of none, jumps, some, hard, received 'wild'"):
        gpb("wild")


def test_a_motion_that_measures_itself_has_no_manoeuvres_unless_it_is_asked_for_some():
    own, plain = Odometry(0.01, 1e-4, 1e-6), ConstantVelocity(0.1)
    levels = {
        name: presets.gpb(motion, Position(STD), **options).regimes.level_count
        for name, motion, options in (
            ("odometry", own, {}), ("with a bias", Augmented(own, GaussMarkov(1.0, 60.0)), {}),
            ("asked for", own, {"manoeuvres": "some"}), ("any other", plain, {}),
        )
    }  # fmt: skip
    assert levels == {"odometry": 1, "with a bias": 1, "asked for": 5, "any other": 5}
