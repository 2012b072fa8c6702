"""Presets say what they take, refuse what they do not know, and share nothing that learns with what they are handed."""

import inspect
import re
from functools import partial

import numpy as np
import pytest
import torch

from torchfra import Gaussian, presets, scenarios
from torchfra.adaptive import Fading
from torchfra.association import Clutter
from torchfra.hyper import hypers
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.presets import constant_gains
from torchfra.presets import options as groups
from torchfra.robust import Huber, HuberScore, ThreeSegment
from torchfra.sensors import Bearings, Position

ALL = [getattr(presets, name) for name in presets.__all__]


def keywords(preset):
    """Names and annotations of all that a preset takes, in the order of its documentation, those of its groups too."""
    own = dict(inspect.signature(preset).parameters)
    group = own.pop("options", None)
    own = {name: str(p.annotation) for name, p in own.items()}
    if group is None:
        return own
    name = group.annotation.removeprefix("Unpack[").removesuffix("]")
    typed = getattr(groups, name, None) or getattr(constant_gains, name)
    return own | {name: str(kind) for name, kind in typed.__annotations__.items()}


def faded(f):
    """The components that the fading factors of a filter act on."""
    return next(part.states for part in f.modules() if isinstance(part, Fading))


def same(one, other):
    torch.testing.assert_close(one.mean, other.mean, rtol=0, atol=0)


@pytest.mark.parametrize("preset", ALL)
def test_every_keyword_has_its_line_of_documentation(preset):
    documented = re.findall(r"^    (\w+): ", inspect.getdoc(preset).split("Args:\n")[1].split("\n\n")[0], re.MULTILINE)
    assert documented == list(keywords(preset))


@pytest.mark.parametrize("preset", ALL)
def test_a_misspelt_keyword_is_an_error_that_names_the_preset(preset):
    with pytest.raises(TypeError, match=rf"{preset.__name__}\(\) got an unexpected keyword argument 'wekening'"):
        preset(ConstantVelocity(1.0), Position(1.0), wekening=2.0)


def test_what_is_not_given_is_as_documented():
    """Presets that share keywords differ in those that their docstrings name."""
    motion, sensor = ConstantVelocity(1.0), Position(1.0)
    bank = [motion, ConstantVelocity(9.0)]
    clutter = Clutter(rate=1.0, volume=1e4)
    published, own, several = (
        presets.fra_srckf(motion, sensor),
        presets.fra(motion, sensor),
        presets.imm_fra(bank, sensor),
    )
    for f, patience, decision, memory, rcond in (
        (published, 0.0, "normalised", "plain", 0.1),
        (own, 4.0, "likelihood", "weighted", 0.2),
        (several.inner, 4.0, "likelihood", "weighted", 0.2),
    ):
        assert (f.patience, f.decision, f.memory, f.fading.rcond) == (patience, decision, memory, rcond)
        assert f.gate().item() == pytest.approx(5.991)
    assert [f.preference().item() for f in (published, own, several.inner)] == pytest.approx([0.0, 0.0, 5.0])
    assert several.self_transition().item() == pytest.approx(0.99)
    assert presets.imm(bank, sensor).self_transition().item() == pytest.approx(0.95)
    for name, lost, gate in (
        ("jpda", 0.0, "ChiSquare"),
        ("ukf_jpda", 0.0, "Euclidean"),
        ("iaukf_jpda", 1e-3, "Euclidean"),
    ):
        f = getattr(presets, name)(motion, sensor, clutter=clutter)
        assert (f.lost, type(f.gate).__name__) == (lost, gate)


@pytest.mark.parametrize("name", ["rsrckf", "rmckf", "fra_srckf", "fra"])
def test_a_robust_update_takes_the_place_of_huber_weights(scenario, tracks, name):
    preset = partial(getattr(presets, name), scenario.motion, scenario.sensor)

    def estimate(f):
        return f(tracks.z, tracks.prior, u=tracks.u)

    same(estimate(preset(robust=Huber(0.7))), estimate(preset(threshold=0.7)))
    other = estimate(preset(robust=ThreeSegment()))
    assert (other.mean - estimate(preset()).mean).abs().max() > 1e-3
    for options in ({"threshold": 1.345}, {"per_element": True}):
        with pytest.raises(
            ValueError,
            match="robust, threshold, per_element: expected robust or options of Huber weights, received both",
        ):
            preset(robust=Huber(), **options)


def test_a_robust_update_that_learns_is_a_copy(scenario):
    side = HuberScore(2.0)
    f = presets.rsrckf(scenario.motion, scenario.sensor, robust=side, learn=("threshold",))
    assert f.robust.threshold.raw.requires_grad
    assert not side.threshold.raw.requires_grad
    assert presets.rsrckf(scenario.motion, scenario.sensor, robust=side).robust is side


def test_options_of_an_inner_filter_are_bound_with_partial():
    f = presets.imm_fra([ConstantAcceleration(0.1), ConstantAcceleration(1.0)], Bearings(0.1), gate=9.0, threshold=2.0)
    assert f.inner.gate().item() == pytest.approx(9.0)
    assert f.inner.robust.threshold().item() == pytest.approx(2.0)
    bank = scenarios.adsb_models()
    f = presets.vsimm_srckf(bank, Position(1.0), inner=partial(presets.rsrckf, threshold=2.0))
    assert f.inner.robust.threshold().item() == pytest.approx(2.0)
    f = presets.jpda(ConstantVelocity(1.0), Position(1.0), clutter=Clutter(1.0), inner=partial(presets.ukf, kappa=2.0))
    assert hypers(f).keys() >= {"gate.probability", "detection", "clutter.volume"}


def test_a_share_fades_position_velocity_and_acceleration_apart():
    f = presets.asrckf(ConstantAcceleration(1.0), Position(1.0), share=(1, 0.1, 0.1))
    assert faded(f) == (slice(0, 2), slice(2, 4), slice(4, 6))
    assert faded(presets.asrckf(ConstantAcceleration(1.0), Position(1.0))) == (slice(0, 2),)
    assert faded(presets.asrckf(ConstantVelocity(1.0), Position(1.0), states=slice(0, 4))) == (slice(0, 4),)


def test_fading_follows_where_a_motion_has_its_position_and_velocity():
    motion = ConstantVelocity(1.0)
    motion.position, motion.velocity = slice(2, 4), slice(0, 2)
    assert faded(presets.asrckf(motion, Position(1.0))) == (slice(2, 4),)
    assert faded(presets.rmckf(motion, Position(1.0), share=(1, 0.5))) == (slice(2, 4), slice(0, 2))


def test_alphabeta_is_tuned_for_constant_acceleration_and_keeps_what_is_chosen():
    motion, sensor = ConstantAcceleration(4.0, 3), Position(20.0, dims=3)
    f = presets.alphabeta(motion, sensor)
    assert (f.manoeuvre().item(), f.outlier().item(), f.margin().item()) == pytest.approx((3.5, 18.0, 6.0))
    assert (f.hysteresis().item(), f.dwell().item(), f.onset) == (pytest.approx(0.7), pytest.approx(20.0), "fastest")
    f = presets.alphabeta(motion, sensor, margin=2.0, onset="shared")
    assert (f.outlier().item(), f.margin().item(), f.onset) == (pytest.approx(18.0), pytest.approx(2.0), "shared")
    f = presets.alphabeta(ConstantVelocity(4.0, 3), sensor)
    assert (f.margin().item(), f.dwell().item(), f.onset) == (pytest.approx(3.0), pytest.approx(3.0), "shared")


def with_companions(preset, name):
    """Models for a preset, and what else it needs before it looks at an argument."""
    motion, sensor, others = ConstantVelocity(1.0), Position(1.0), {}
    if "clutter" in inspect.signature(preset).parameters:
        others["clutter"] = Clutter(rate=1.0, volume=1e4)
    if preset is presets.vsimm_srckf:
        others |= {"neighbours": [[1], [0]], "first": [0, 1]}
    if name == "initial":
        others["transition"] = torch.eye(2) * 0.8 + 0.1
    return ([motion, ConstantVelocity(9.0)] if preset in BANKS else motion), sensor, others


BANKS = {p for p in ALL if "models" in inspect.signature(p).parameters}
NUMBERS = [
    (preset, name)
    for preset in ALL
    for name, kind in list(keywords(preset).items())[2:]
    if re.search(r"Value|float|\bint\b(?!\])", kind)
]


@pytest.mark.parametrize("bad", ["abc", ["a"], {}])
def test_words_where_numbers_belong_are_an_error_that_names_the_argument(bad):
    assert len(NUMBERS) > 100
    for preset, name in NUMBERS:
        models, sensor, others = with_companions(preset, name)
        with pytest.raises(ValueError, match=rf"^[\w, ]*\b{name}\b[\w, ]*: expected"):
            preset(models, sensor, **{**others, name: bad})


@pytest.mark.slow
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_numbers_of_numpy_are_numbers(kind):
    for preset, name in NUMBERS:
        if "int" in keywords(preset)[name]:
            continue
        models, sensor, others = with_companions(preset, name)
        for value in (0.5, 3.0, 0.0):  # a probability, a threshold, what has to be 0
            try:
                preset(models, sensor, **{**others, name: value})
            except ValueError:
                continue
            preset(models, sensor, **{**others, name: kind(value)})


def test_an_outlier_is_a_probability_whatever_the_filter_decides():
    """Of blocks of elements, axes or whole measurements; 0 or 1 where a filter decides."""
    motion, sensor = ConstantVelocity(0.1), Position(1.0)
    prior = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
    z = torch.zeros(12, 2).double()
    z[7] = 300.0
    for name in ("gpb", "fra", "fra_srckf", "alphabeta"):
        outlier = getattr(presets, name)(motion, sensor)(z, prior).info.outlier
        assert outlier.is_floating_point()
        assert outlier.shape == (12, 1) or name == "alphabeta"
        assert outlier[7].min() > 0.99
        assert outlier[:6].max() < 0.01
        assert getattr(presets, name)(motion, sensor)(z.expand(3, -1, -1), prior).info.outlier[2].allclose(outlier)


@pytest.mark.parametrize(
    ("name", "path"),
    [("srckf", "motion.q"), ("rsrckf", "robust.threshold"), ("fra", "robust.threshold"), ("gpb", "prior_outlier")],
)
def test_values_under_vmap_are_a_loop_over_them(make, tracks, name, path):
    f = make(name)
    raws = dict(f.named_buffers())[f"{path}.raw"] + torch.linspace(-0.5, 0.5, 2).double()

    def mean(raw):
        return torch.func.functional_call(f, {f"{path}.raw": raw}, (tracks.z, tracks.prior), {"u": tracks.u}).mean

    torch.testing.assert_close(torch.func.vmap(mean)(raws), torch.stack([*map(mean, raws)]), rtol=1e-9, atol=1e-6)
