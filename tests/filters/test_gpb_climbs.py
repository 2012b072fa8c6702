"""GPB in space: a target that flies on calmly may yet climb."""

import copy

import numpy as np
import oracles
import pytest
import torch
from gpb_loops import PRIOR, VALUES, carried, expected, position, same, tensor
from test_gpb_promises import agree

from torchfra import presets
from torchfra.filters import Regimes
from torchfra.motion import (
    ConstantAcceleration,
    ConstantVelocity,
    IntegratedOrnsteinUhlenbeck,
    Level,
    Spherical,
    UnknownTurn,
    aircraft,
)
from torchfra.sensors import Position, RangeBearing, RangeRates, Stacked
from torchfra.types import Gaussian

SPACE = ConstantVelocity(0.5, dims=3)
SENSOR = Position(5.0, dims=3)


# ---------------------------------------------------------------- what a climb is


@pytest.mark.parametrize(("motion", "vertical"), [
    (ConstantVelocity(1.0, dims=3), (2, 5)),
    (ConstantAcceleration(1.0, 3), (2, 5, 8)),
    (UnknownTurn(1.0, 0.1, 3), (2, 5)),
    (aircraft(dims=3), (2, 5, 8)),
    (ConstantVelocity(1.0), ()),
    (Level(IntegratedOrnsteinUhlenbeck(1.0, 0.2), 0.1), ()),
    (Spherical(ConstantVelocity(1.0, 3)), ()),
])  # fmt: skip
def test_vertical_components_are_those_along_the_third_axis_of_a_motion_that_can_climb(motion, vertical):
    assert motion.vertical == vertical


def test_a_climb_is_what_the_oracle_says():
    """Of a motion in the plane, of which the second axis is called vertical."""
    case, motion, vertical = position(), ConstantAcceleration(0.05), (1, 3, 5)
    levels, jumps = (0.1, 1.0, 60.0), [30.0]
    stay, restart = [0.9, 0.5, 0.6, 0.9, 0.2], [0.4, 0.2, 0.1, 0.1, 0.2]
    f = presets.gpb(motion, case.sensor, **VALUES)
    f.regimes = Regimes(
        1, noise_levels=levels, jump_factors=jumps, self_transition=stay, restart=restart, separate_levels=1,
        vertical=vertical, burst=VALUES["burst"],
    )  # fmt: skip
    root = np.full(6, np.sqrt(levels[0]))
    root[list(vertical)] = 1.0
    odds = np.array([0.2, 0.2, 0.1, 0.2, 0.2])  # of levels, the climb, the jump: calm is shared, others are impossible
    chain = oracles.gpb.restart_transition([0.9, 0.5, 0.6, 0.9, 0.2], list(odds / odds.sum()))
    r = oracles.gpb.Regimes(
        [1, 0, 0, 2],
        [*levels, np.outer(root, root)],
        jumps,
        chain,
        np.eye(5),
        oracles.gpb.stationary(chain),
        2,
        burst=VALUES["burst"],
    )
    same(f(tensor(case.z), PRIOR), expected(case, [carried(motion, 1.0)] * 3, r))


class Climbing(ConstantVelocity):
    """Calm, but for the vertical process noise."""

    def __init__(self, q, factor):
        super().__init__(q, dims=3)
        self.factor = factor

    def process_noise(self, dt):
        rows = torch.tensor([self.factor, self.factor, 1.0] * 2, dtype=torch.float64).sqrt()
        return rows.unsqueeze(-1) * super().process_noise(dt)


@pytest.mark.slow
def test_a_climb_is_a_motion_of_its_own_beside_the_calm_one_smoothed_and_compiled_too():
    factor, (calm, stated, jump), (a, b, c) = 0.01, (60.0, 30.0, 0.5), (0.5, 0.4, 0.1)
    few = {"jump_factors": (9.0,), "outlier_sizes": (100.0,), "outlier_shares": (1.0,)}  # for the compiler's time
    one = presets.gpb(
        SPACE, SENSOR, noise_levels=(factor, 1.0), durations=(calm, stated, 1.0, jump), restart=(a, b, 0.0, c),
        separate_levels=1, climbs=True, **few,
    )  # fmt: skip
    bank = [SPACE, ConstantVelocity(factor * 0.5, dims=3), Climbing(0.5, factor)]
    three = presets.gpb(
        bank, SENSOR, noise_levels=(1.0,), durations=(stated, calm, jump), restart=(b, a, c), separate_levels=0,
        climbs=False, **few,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(3)
    dt = 0.5 + torch.rand(13, generator=generator, dtype=torch.float64)
    z = dt.cumsum(0)[:, None] * torch.tensor([8.0, 2.0, 0.0]).double()
    z = z + 5 * torch.randn(13, 3, generator=generator, dtype=torch.float64)
    z[8:, 2] += 6 * dt.cumsum(0)[8:] - 6 * dt.cumsum(0)[8]
    z[5] += 200.0
    z[10:12] = torch.nan
    prior = Gaussian(torch.zeros(6).double(), torch.diag(torch.tensor([20.0, 20, 20, 9, 9, 9]).double()))
    for f in (one, copy.deepcopy(one).compile()):
        agree(f, three, z, prior, dt)


def test_regimes_have_names_in_the_order_of_their_probabilities():
    bank = [SPACE, IntegratedOrnsteinUhlenbeck(0.5, 0.1, dims=3)]
    f = presets.gpb(bank, SENSOR, manoeuvres="hard")
    names = f.regime_names
    info = f(torch.zeros(3, 3).double(), Gaussian.from_std([0.0] * f.motion.size, 5.0)).info
    assert len(names) == info.probabilities.shape[-1]
    assert names[0].startswith("constant velocity, noise x ")
    assert names[f.regimes.level_count :] == (f.bank.names[1], "climb", "manoeuvre", *["jump"] * f.regimes.jump_count)


# ---------------------------------------------------------------- when there are climbs


def test_climbs_are_for_motions_in_space_unless_values_are_given():
    plane = presets.gpb(ConstantVelocity(1.0), Position(5.0))
    none = presets.gpb(SPACE, SENSOR, manoeuvres="none")
    own = presets.gpb(SPACE, SENSOR, noise_levels=(0.1, 1.0, 2.0, 50.0, 500.0))
    asked = presets.gpb(SPACE, SENSOR, noise_levels=(0.1, 1.0, 50.0, 500.0), climbs=True)
    counts = [f.regimes.climb_count for f in (plane, none, own, presets.gpb(SPACE, SENSOR), asked)]
    assert counts == [0, 0, 0, 1, 1]
    assert presets.gpb(SPACE, SENSOR, manoeuvres="hard").regimes.manoeuvre_count == 1


def test_a_target_in_the_plane_does_not_climb():
    with pytest.raises(ValueError, match="climbs: expected a motion with a height and its rate, received"):
        presets.gpb(ConstantVelocity(1.0), Position(5.0), climbs=True)


@pytest.mark.slow
def test_a_climb_that_only_a_coarse_elevation_shows_is_followed():
    std = tensor([10.0, 0.01, 0.05, 1.0])  # ranges and rates speak against noise in all directions
    radar = Stacked(RangeBearing(std[:3], dims=3), RangeRates([[0.0, 0.0, 0.0]], 1.0))
    velocity = torch.tensor([[60.0, 10.0, 0.0]] * 15 + [[60.0, 10.0, 12.0]] * 65, dtype=torch.float64)
    truth = torch.cat([tensor([1000.0, 3000.0, 300.0]) + velocity.cumsum(0), velocity], -1).expand(20, -1, -1)
    noise = torch.randn(20, 80, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(8))
    z = radar(truth) + std * noise
    prior = Gaussian(truth[0, 0], torch.diag(tensor([50.0, 50, 50, 10, 10, 10])))
    error = {
        climbs: (presets.gpb(ConstantVelocity(16.0, dims=3), radar, climbs=climbs)(z, prior).mean - truth)[:, 20:, 2]
        for climbs in (True, False)
    }
    assert error[True].square().mean() < 0.85 * error[False].square().mean()
