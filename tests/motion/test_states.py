"""A motion says what its state holds, and states are put together from those of others."""

import pytest
import torch

from torchfra import Gaussian, presets
from torchfra import motion as motions
from torchfra.motion import (
    KINDS,
    Augmented,
    Bank,
    Bicycle,
    Clock,
    ConstantAcceleration,
    ConstantSpeed,
    ConstantVelocity,
    CurrentStatistical,
    Embedded,
    GaussMarkov,
    IntegratedOrnsteinUhlenbeck,
    Motion,
    Odometry,
    RandomWalk,
    Spherical,
    UnknownTurn,
    aircraft,
)
from torchfra.sensors import Position, Ranges

BIASES = RandomWalk(0.01, 2, kind="bias")
EVERY = [
    (ConstantVelocity(1.0, 3), "x y z vx vy vz", "position*3 velocity*3"),
    (ConstantAcceleration(1.0), "x y vx vy ax ay", "position*2 velocity*2 acceleration*2"),
    (motions.CoordinatedTurn(0.1, 1.0, orders=3), "x y vx vy ax ay", "position*2 velocity*2 acceleration*2"),
    (motions.Singer(1.0, 0.1, 1), "x vx ax", "position velocity acceleration"),
    (IntegratedOrnsteinUhlenbeck(1.0, 0.1), "x y vx vy", "position*2 velocity*2"),
    (ConstantSpeed(1.0, 0.1), "x y z vx vy vz", "position*3 velocity*3"),
    (UnknownTurn(1.0, 0.1), "x y vx vy rate", "position*2 velocity*2 rate"),
    (Bicycle(2.7, 1.0, 0.1), "x y speed heading steering", "position*2 velocity angle*2"),
    (RandomWalk(1.0), "x y", "position*2"),
    (Clock(1.0, 1.0), "clock drift", "clock*2"),
    (GaussMarkov(3.0, 60.0), "bias", "bias"),
    (Odometry(0.1, 0.01, 1e-4), "x|y|heading error|log scale", "position*2 angle parameter"),
    (Odometry(0.1, 0.01, 1e-4, 1e-8), "x|y|heading|log scale|rate bias", "position*2 angle parameter bias"),
    (Augmented(ConstantVelocity(1.0, 1), BIASES, Clock(1.0, 1.0)), "x|vx|bias 0|bias 1|clock|drift",
     "position velocity bias*2 clock*2"),
    (Augmented(RandomWalk(1.0, 1), BIASES, BIASES), "x|bias 0|bias 1|bias 0 (2)|bias 1 (2)", "position bias*4"),
    (Spherical(ConstantVelocity(1.0, 3)), "omega|elevation rate|range rate / range|azimuth|elevation|inverse range",
     "rate*2 other angle*2 other"),
    (aircraft(), "x y vx vy ax ay", "position*2 velocity*2 acceleration*2"),
    (Embedded(ConstantVelocity(1.0), torch.eye(4, 6), torch.eye(6, 4), 3), "x y vx vy ax ay",
     "position*2 velocity*2 acceleration*2"),
    (ConstantVelocity(1.0, 4), "x0 x1 x2 x3 vx0 vx1 vx2 vx3", "position*4 velocity*4"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("motion", "names", "kinds"), EVERY, ids=lambda x: x.describe() if isinstance(x, Motion) else ""
)
def test_every_motion_names_the_components_of_its_state(motion, names, kinds):
    assert motion.components == tuple(names.split("|" if "|" in names else " "))
    repeated = [[*word.split("*"), "1"] for word in kinds.split()]
    assert motion.kinds == tuple(kind for kind, count, *_ in repeated for _ in range(int(count)))
    assert len(motion.components) == len(motion.kinds) == motion.size
    assert all(motion.kinds[i] == "angle" for i in motion.angles)
    if not isinstance(motion, Spherical):  # whose place is in angles
        at = range(motion.size)
        assert [i for i in at if motion.kinds[i] == "position"] == [*at[motion.position]]
        assert {motion.kinds[i] for i in at[motion.velocity]} <= {"velocity"}
    assert f"state=[{', '.join(motion.components)}]" in repr(motion)


def test_what_is_no_motion_in_space_has_neither_a_place_nor_a_velocity():
    for motion in (Clock(1.0, 1.0), GaussMarkov(3.0, 60.0, 2), RandomWalk(0.1, 2, kind="bias")):
        assert not [*range(motion.size)[motion.position], *range(motion.size)[motion.velocity]]


def test_a_motion_of_a_user_gets_the_names_that_its_layout_tells():
    own = Motion(2, 2, 1.0, size=6, angles=(5,))
    assert own.components == ("x", "y", "vx", "vy", "state 4", "angle 5")
    assert own.kinds == ("position", "position", "velocity", "velocity", "other", "angle")
    apart = Motion(2, 3, 1.0, size=6, position=slice(1, 3), velocity=slice(4, 6))
    assert apart.components == ("state 0", "x", "y", "state 3", "vx", "vy")
    named = Motion(1, 1, 1.0, components=("depth",), kinds=("position",))
    assert (named.components, named.kinds, named.size) == (("depth",), ("position",), 1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"components": ("x",)}, r"components: expected one for each of 4 components, received \['x'\]"),
        ({"components": ("x", "x", "y", "z")}, "components: expected different names"),
        ({"kinds": ("place",) * 4}, f"kinds: expected some of {', '.join(KINDS)}, received 'place'"),
        ({"kinds": ("bias",)}, "kinds: expected one for each of 4"),
        (
            {"kinds": ("position", "position", "velocity", "angle")},
            "angles: expected the indices of the components of kind 'angle'",
        ),
        ({"angles": (4,)}, r"angles: expected indices of components, 0 to 3, received \(4,\)"),
    ],
)
def test_names_and_kinds_that_do_not_fit_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        Motion(2, 2, 1.0, **options)


def test_motions_that_do_not_go_together_are_named_with_their_states():
    with pytest.raises(ValueError, match=r"others: expected motions beside the first.*received ConstantVelocity$"):
        Augmented(ConstantVelocity(1.0))
    with pytest.raises(ValueError, match=r"others: expected motions .* received Bank, RandomWalk"):
        Augmented(aircraft(), BIASES)
    with pytest.raises(ValueError, match="others: expected none that adapts to an estimated acceleration"):
        Augmented(ConstantVelocity(1.0), CurrentStatistical(0.1, 1.0))
    turn, bicycle = UnknownTurn(1.0, 0.1), Bicycle(2.7, 1.0, 0.1)
    with pytest.raises(ValueError, match=r"UnknownTurn of \[x, y, vx, vy, rate\]; Bicycle of \[x, y, speed, heading,"):
        Bank([turn, bicycle])
    with pytest.raises(ValueError, match=r"UnknownTurn of .*; Augmented of \[x, y, vx, vy, bias\]"):
        Bank([turn, Augmented(ConstantVelocity(1.0), RandomWalk(0.1, 1, kind="bias"))])
    with pytest.raises(ValueError, match=r"sensor: .* at most 1 states \[x\], received one that reads 2"):
        presets.srckf(RandomWalk(1.0, 1), Position(1.0))
    for options, said in (
        ({"q": -1.0}, "q: expected a value of 0 or more"),
        ({"dims": 0}, "dims: expected 1 or more"),
        ({"kind": "place"}, "kinds: expected some of"),
    ):
        with pytest.raises(ValueError, match=said):
            RandomWalk(**{"q": 1.0} | options)
    with pytest.raises(ValueError, match="rear: expected finite metres, 0 or more, received -1"):
        Bicycle(2.7, 1.0, 1.0, rear=-1.0)
    with pytest.raises(ValueError, match="dims: expected 2 or more dimensions for a turn, received 1"):
        UnknownTurn(1.0, 1.0, 1)
    with pytest.raises(ValueError, match="q: expected a value above 0"):
        ConstantSpeed(0.0, 1.0)


# ---------------------------------------------------------------- states side by side


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


DT = tensor(0.5, 2.0)


def covariance(motion, mean=None, dt=DT):
    root = motion.process_noise(dt)
    root = root if mean is None else motion.process_noise_at(root, mean, dt)
    return root @ root.mT


@pytest.mark.parametrize(
    "first", [ConstantVelocity(0.3), UnknownTurn(0.3, 0.1, continuous=True), Bicycle(2.7, 0.3, 0.1)]
)
def test_each_motion_moves_its_own_part_for_itself(first):
    motion = Augmented(first, BIASES, Clock(0.1, 0.2))
    x = tensor(1, 2, 3, 4, 0.1)[: first.size]
    x = torch.cat([x, tensor(5, 6, 7, 8)]).expand(2, -1)
    n = first.size
    moved = motion(x, DT)
    torch.testing.assert_close(moved[:, :n], first(x[:, :n], DT))
    torch.testing.assert_close(moved[:, n:], torch.cat([x[:, n : n + 2], Clock(0, 0)(x[:, n + 2 :], DT)], -1))
    torch.testing.assert_close(motion.at_points(x.unsqueeze(0), DT)[0], moved)
    assert motion.linear == first.linear
    whole = covariance(motion, moved)
    for part, rows, mean in ((first, slice(0, n), moved[:, :n]), (BIASES, slice(n, n + 2), None),
                             (Clock(0.1, 0.2), slice(n + 2, n + 4), None)):  # fmt: skip
        torch.testing.assert_close(whole[:, rows, rows], covariance(part, mean))
        whole[:, rows, rows] = 0
    assert (whole == 0).all()
    if motion.linear:
        torch.testing.assert_close((motion.transition(DT) @ x.unsqueeze(-1)).squeeze(-1), moved)


def test_known_changes_of_parts_stand_side_by_side():
    class Pushed(ConstantVelocity):
        def shift(self, dt, u):
            return dt.unsqueeze(-1) * torch.tensor([0.0, 0.0, 1.0, 2.0]).double()

    dt = torch.tensor([0.5, 2.0]).double()
    expected = torch.tensor([[0.0, 0.0, 0.5, 1.0, 0.0, 0.0], [0.0, 0.0, 2.0, 4.0, 0.0, 0.0]]).double()
    torch.testing.assert_close(Augmented(Pushed(1.0), BIASES).shift(dt, None), expected)
    assert Augmented(ConstantVelocity(1.0), BIASES).shift(dt, None) is None


def test_a_bias_beside_a_target_leaves_its_motion_as_it_is_also_where_that_follows_the_acceleration():
    rng = torch.Generator().manual_seed(0)
    z = torch.randn(3, 12, 2, generator=rng, dtype=torch.float64).cumsum(1)
    bank = aircraft()
    beside = Bank([Augmented(model, BIASES) for model in bank])
    prior = Gaussian(torch.zeros(6).double(), torch.eye(6).double())
    wide = Gaussian(torch.zeros(8).double(), torch.eye(8).double())
    with torch.no_grad():
        alone, both = (
            presets.imm_srckf(models, Position(0.5), self_transition=0.9)(z, given)
            for models, given in ((bank, prior), (beside, wide))
        )
    torch.testing.assert_close(both.mean[..., :6], alone.mean)
    torch.testing.assert_close(both.info.probabilities, alone.info.probabilities)
    torch.testing.assert_close(both.mean[..., 6:], torch.zeros(3, 12, 2).double())


@pytest.mark.parametrize(
    "motion",
    [UnknownTurn(0.1, 0.01, continuous=True), Augmented(Bicycle(2.7, 0.1, 0.01), RandomWalk(0.1, 1, kind="bias"))],
    ids=["turn", "bicycle with a bias"],
)
def test_motions_learn(motion):
    rng = torch.Generator().manual_seed(0)
    truth = [tensor(0, 0, 3, 1, 0.1, 0.0)[: motion.size].expand(4, -1)]
    for _ in range(12):
        truth.append(motion(truth[-1], torch.tensor(0.5).double()))
    anchors = tensor([0, 0], [30, 0], [0, 30])
    sensor = Ranges(anchors, 0.3)
    z = sensor(torch.stack(truth[1:], 1))
    z = z + 0.3 * torch.randn(z.shape, generator=rng, dtype=torch.float64)
    prior = Gaussian(truth[0][0], 0.5 * torch.eye(motion.size).double())
    f = presets.srckf(motion, sensor, learn="all")
    f(z, prior, dt=0.5).mean.square().sum().backward()
    assert all(p.grad.isfinite().all() for p in f.parameters())
    assert all(p.grad.abs().sum() > 0 for p in f.parameters())
