"""GPB is made of parts, and names what does not fit, before any work."""

import pytest
import torch
from gpb_cases import ANCHORS, MOTION, PRIOR, SENSORS, STEPS, VALUES, measured, same, tensor

from torchfra import presets
from torchfra.filters import GPB, Outliers, Regimes
from torchfra.gaussian import fifth_degree
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position, Ranges


def test_the_parts_make_the_filter_that_the_preset_makes():
    regimes = Regimes(
        1,
        noise_levels=(0.1, 30.0),
        separate_levels=1,
        jump_factors=(200.0,),
        self_transition=VALUES["self_transition"],
        restart=VALUES["restart"],
    )
    outliers = Outliers(
        [[0, 1]],
        outlier_transition=VALUES["outlier_transition"],
        outlier_sizes=VALUES["outlier_sizes"],
        outlier_shares=VALUES["outlier_shares"],
    )
    f = GPB(MOTION, SENSORS["position"], regimes=regimes, outliers=outliers, prior_outlier=0.3, prior_inflation=50.0)
    same(f(measured(), PRIOR), presets.gpb(MOTION, SENSORS["position"], **VALUES)(measured(), PRIOR))


def numbered(argument):
    """Only what is said is a name; others, such as functions, are not the same text in every process."""
    return argument if isinstance(argument, str) else ""


@pytest.mark.parametrize(("options", "said"), [
    ({"outlier_transition": ((0.9, 0.2), (0.5, 0.5))}, "outlier_transition: expected"),
    ({"outlier_transition": (0.9, 0.1)}, r"outlier_transition: expected \(2, 2\), received \(2,\)"),
    ({"outlier_shares": (0.6, 0.3, 0.2)}, "outlier_shares: expected"),
    ({"outlier_shares": (0.6, 0.4)}, "outlier_shares: expected one for each of outlier_sizes"),
    ({"outlier_sizes": (0.9, 4.0, 100.0)}, "outlier_sizes: expected a value above 1"),
    ({"outlier_offsets": (0.0, 4.0, float("inf"))}, "outlier_offsets: expected finite numbers"),
    ({"same_offset": 1.5}, r"same_offset: expected a value in \[0, 1\]"),
    ({"noise_levels": (-1.0, 10.0)}, "noise_levels: expected"),
    ({"separate_levels": 2}, "separate_levels: expected a number from 0 to 1, or .* indices of 2 levels, received 2"),
    ({"separate_levels": (1, 1)}, "separate_levels: expected a number from 0 to 1, or .*, received .1, 1."),
    ({"separate_levels": (2,)}, "separate_levels: expected a number from 0 to 1, or .*, received .2,."),
    ({"noise_levels": 3.0}, "noise_levels: expected a sequence of numbers, received 3"),
    ({"noise_levels": ()}, "self_transition: expected"),
    ({"jump_factors": 300.0}, "jump_factors: expected a sequence of numbers, received 300"),
    ({"jump_factors": (-1.0,)}, "jump_factors: expected a value above 0"),
    ({"self_transition": (0.5, 0.5, 0.5, 1.5)}, r"self_transition: expected a value in \[0, 1\]"),
    ({"self_transition": (0.5, 0.5, 0.5)}, r"self_transition: expected \(..., 4\), received \(3,\)"),
    ({"self_transition": 0.9}, r"self_transition: expected \(..., 4\), received \(\)"),
    ({"restart": (0.5, 0.3, 0.2)}, r"restart: expected \(..., 4\), received \(3,\)"),
    ({"restart": (0.5, 0.3, 0.2, 0.1)}, "restart: expected"),
    ({"restart": (0.5, 0.3, 0.3, -0.1)}, "restart: expected"),
    ({"prior_outlier": 2.0}, r"prior_outlier: expected a value in \[0, 1\]"),
    ({"prior_inflation": 0.5}, "prior_inflation: expected a value of 1 or more"),
    ({"lag": 2}, "lag: expected 0 or 1 steps, received 2"),
    ({"rule": fifth_degree}, "rule: expected one without negative weights"),
    ({"rule": "ckf"}, "rule: expected torchfra.gaussian.third_degree or the like"),
    ({"learn": ("gamma",)}, r"learn: expected 'all' or some of .*received 'gamma'"),
], ids=numbered)  # fmt: skip
def test_values_that_do_not_fit_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        presets.gpb(MOTION, SENSORS["position"], **VALUES | options)


def with_blocks(*blocks):
    sensor = Ranges(ANCHORS, 2.0)
    sensor.blocks = blocks
    return sensor


ROOT = torch.eye(4).double() + 0.2


@pytest.mark.parametrize(("motion", "sensor", "said"), [
    ([MOTION, ConstantVelocity(1.0)], Position(5.0), "models: expected motions of one state"),
    ([], Position(5.0), "models: expected motions of one state"),
    (Position(5.0), Position(5.0), "motion: expected one, several or a Bank, received Position"),
    (MOTION, MOTION, "sensor: expected an instance of torchfra's Sensor"),
    (MOTION, Position(5.0, dims=3), "sensor: expected one of at most 2 dimensions"),
    (MOTION, with_blocks((0, 1), (1, 2, 3)), "blocks: expected each of 4 elements once"),
    (MOTION, with_blocks((0, 1), (2,)), "blocks: expected each of 4 elements once"),
    (MOTION, with_blocks((0, 1), (2, 3), ()), "blocks: expected each of 4 elements once"),
    (MOTION, Ranges(ANCHORS, noise=ROOT), "sensor: expected noise that is independent between blocks"),
], ids=numbered)  # fmt: skip
def test_models_that_do_not_fit_are_named(motion, sensor, said):
    with pytest.raises(ValueError, match=said):
        presets.gpb(motion, sensor)


def test_regimes_of_other_motions_are_refused():
    regimes = Regimes(
        2,
        noise_levels=(0.1, 30.0),
        jump_factors=(200.0,),
        self_transition=VALUES["self_transition"],
        restart=VALUES["restart"],
    )
    outliers = Outliers(
        [[0, 1]], outlier_transition=VALUES["outlier_transition"], outlier_sizes=(9.0,), outlier_shares=(1.0,)
    )
    with pytest.raises(ValueError, match=r"regimes: expected those of 1 motions, received of 2"):
        GPB(MOTION, SENSORS["position"], regimes=regimes, outliers=outliers)


def test_noise_that_is_correlated_between_blocks_is_refused_before_any_work():
    f, z = presets.gpb(MOTION, SENSORS["ranges"], **VALUES), measured("ranges")
    own = torch.diag_embed(tensor([2.0, 2, 2, 2])).expand(STEPS, 4, 4)
    same(f(z, PRIOR, noise=own), f(z, PRIOR))
    same(presets.gpb(MOTION, Ranges(ANCHORS, noise=own[0]), **VALUES)(z, PRIOR), f(z, PRIOR))
    with pytest.raises(ValueError, match="noise: expected noise that is independent between blocks"):
        f(z, PRIOR, noise=ROOT.expand(STEPS, 4, 4))
    with pytest.raises(ValueError, match="noise: expected noise that is independent between blocks"):
        f.step(f.init(PRIOR), z[0, 0], noise=ROOT)
    inside = presets.gpb(MOTION, with_blocks((0, 2), (1, 3)), **VALUES)
    pairs = torch.eye(4).double()
    pairs[2, 0] = pairs[3, 1] = 0.5
    assert inside(z, PRIOR, noise=pairs.expand(STEPS, 4, 4)).mean.isfinite().all()
