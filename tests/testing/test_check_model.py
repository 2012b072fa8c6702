"""A motion or a sensor of one's own that is wrong is told in words, with the line that is to blame."""

import math
import re

import pytest
import torch

import torchfra
from torchfra import Hyper, check_model
from torchfra.motion import Augmented, Bank, Bicycle, Clock, ConstantVelocity, Motion, RandomWalk, Spherical
from torchfra.sensors import Bearings, Biased, Camera, InfraredLaser, Pseudoranges, Ranges, Sensor, Stacked

ANCHORS = torch.tensor([[0.0, 0.0], [300.0, 0.0], [0.0, 300.0]], dtype=torch.float64)
RANGES = Ranges(ANCHORS, 0.3)
STRAIGHT = ConstantVelocity(1.0)


class Drag(Motion):
    """Right."""

    def __init__(self):
        super().__init__(2, 2, 0.1)
        self.drag = Hyper(0.1, name="drag")

    def forward(self, x, dt, u=None):
        velocity = x[..., 2:] * torch.exp(-self.drag(x) * dt).unsqueeze(-1)
        return torch.cat([x[..., :2] + dt.unsqueeze(-1) * velocity, velocity], -1)


class Wild(Motion):
    """Right, and a change of the last digit of a state grows a thousandfold in some steps."""

    def __init__(self):
        super().__init__(1, 1, 0.01)

    def forward(self, x, dt, u=None):
        return 4 * torch.sin(4 * x) + 0 * u


class Short(Sensor):
    """Says that it reads three components, and reads four."""

    def __init__(self):
        super().__init__(3, [False], 1.0)

    def forward(self, x, u=None):
        return (x[..., :2] * x[..., 2:]).sum(-1, keepdim=True)


class Itself(Sensor):
    def __init__(self):
        super().__init__(1, [False], 300.0, None)

    def forward(self, x, u=None):
        return x[..., :1]


class Deciding(Drag):
    def forward(self, x, dt, u=None):
        if dt > 1.2:
            return x
        return super().forward(x, dt, u)


class Broadcast(Drag):
    def forward(self, x, dt, u=None):
        return torch.cat([x[..., :2] + dt * x[..., 2:], x[..., 2:]], -1)


class Shorter(Drag):
    def forward(self, x, dt, u=None):
        return super().forward(x, dt, u)[..., :3]


class InPlace(Drag):
    def forward(self, x, dt, u=None):
        x[..., :2] += dt.unsqueeze(-1) * x[..., 2:]
        return x.clone()


class Together(Drag):
    def forward(self, x, dt, u=None):
        return super().forward(x, dt, u) + x.mean()


class Double(Drag):
    def forward(self, x, dt, u=None):
        return super().forward(x, dt, u) + torch.zeros(4, dtype=torch.float64)


class Rounded(Drag):
    def forward(self, x, dt, u=None):
        return super().forward(x.detach(), dt, u) + 0 * x


class Noisy(Drag):
    def process_noise(self, dt):
        return torch.eye(3, dtype=dt.dtype)


class Timeless(Drag):
    def process_noise(self, dt):
        return torch.eye(4, dtype=dt.dtype) * dt


class Dividing(Drag):
    def forward(self, x, dt, u=None):
        return super().forward(x, dt, u) * (dt / dt).unsqueeze(-1)


class Hurried(Drag):
    def forward(self, x, dt, u=None):
        return super().forward(x, torch.ones_like(dt), u)


class Pair(Drag):
    def forward(self, x, dt, u=None):
        return super().forward(x, dt, u), dt


class Heading(Motion):
    def __init__(self, angles=()):
        super().__init__(2, 2, 1.0, velocity=slice(0, 0), angles=angles)

    def forward(self, x, dt, u=None):
        px, py, speed, heading = x.unbind(-1)
        moved = [px + dt * speed * heading.cos(), py + dt * speed * heading.sin()]
        return torch.stack([*moved, speed, torch.atan2(heading.sin(), heading.cos())], -1)


class Beyond(Sensor):
    def __init__(self):
        super().__init__(2, [False, False], 1.0)

    def forward(self, x, u=None):
        return x[..., 2:4]


class Bearing(Sensor):
    def __init__(self, angle=False, degrees=False, place=(0.0, 0.0)):
        super().__init__(2, [angle], 0.01)
        self.degrees, self.place = degrees, place

    def forward(self, x, u=None):
        angle = torch.atan2(x[..., :1] - self.place[0], x[..., 1:2] - self.place[1])
        return torch.rad2deg(angle) if self.degrees else angle


class Curved(Sensor):
    linear = True

    def __init__(self):
        super().__init__(2, [False, False], 1.0)

    def forward(self, x, u=None):
        return x[..., :2] ** 2


class Root(Sensor):
    def __init__(self):
        super().__init__(2, [False], 1.0)

    def forward(self, x, u=None):
        return (x[..., :1] - x[..., :1]).abs().sqrt() + x[..., 1:2]


class Needy(Sensor):
    def __init__(self):
        super().__init__(2, [False, False], 1.0)

    def forward(self, x, u=None):
        return x[..., :2] - u[..., :2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "sensor", "options"),
    [
        (Drag(), RANGES, {}),
        (Augmented(Bicycle(2.7, 1.0, 0.1), RandomWalk(0.1, 1, kind="bias")), Biased(RANGES, 5), {"dt": 0.1}),
        (Bank([STRAIGHT, Drag()]), Stacked(Bearing(angle=True), RANGES), {}),
        (STRAIGHT, Needy(), {"u": torch.ones(2)}),
        (Augmented(ConstantVelocity(1.0, 3), Clock(1.0, 0.1)), Pseudoranges(2, 1.0, 0.1), {
            "u": [2e7, 0, 0, 0, 2e7, 0, 1e3, 0, 0, 0, 1e3, 0]}),
        (Heading(angles=(3,)), Bearing(True, place=(2e4, -3e4)), {}),
        (Spherical(ConstantVelocity(1.0, 3)), InfraredLaser([1e-3, 1e-3, 1.0]), {}),
        (ConstantVelocity(1.0, 3), Camera(800.0, 1.0, position=[0, 0, 0], rotation=torch.eye(3)), {
            "state": torch.tensor([5.0, 2.0, 100.0, 0.0, 1.0, -1.0])}),
    ],
)  # fmt: skip
def test_models_that_are_right_have_no_problems(motion, sensor, options):
    report = check_model(motion, sensor, **options)
    assert report.ok, report
    assert not report.problems
    assert f"{type(motion).__name__} and {type(sensor).__name__}: no problems" in str(report)
    assert re.search("right: in a filter: .*it maps over tracks, ", str(report))


@pytest.mark.parametrize(
    ("motion", "sensor", "said", "line"),
    [
        (Deciding(), RANGES, "shapes: .*for states .3, 4. and dt .3,.: Boolean value", "if dt > 1.2:"),
        (Broadcast(), RANGES, "shapes: .*for states .3, 4. and dt .3,.: The size of tensor a", "return torch.cat("),
        (Shorter(), RANGES, r"shapes: .*expected what has the shape \(4,\), received \(3,\)", "def forward("),
        (InPlace(), RANGES, "shapes: the states that it was given: expected as they were", "def forward("),
        (Together(), RANGES, "batches: state 0 of a batch.*: expected what it gives alone", "def forward("),
        (Dividing(), RANGES, "no time: for states .3, 4. and a dt of 0: expected finite numbers", "def forward("),
        (Double(), RANGES, "precision: dtype for states in float32 .*received torch.float64", "def forward("),
        (Rounded(), RANGES, r"gradients: gradient with respect to component 0: expected \[1, 1, 1\]", "def forward("),
        (Noisy(), RANGES, r"process noise: for dt \(\): expected a root .*received \(3, 3\)", "def process_noise("),
        (Timeless(), RANGES, r"process noise: .* for dt \(5,\)", "return torch.eye(4, dtype=dt.dtype) * dt"),
        (STRAIGHT, Bearing(), "angles: element 0 .* expected an angle in rad, declared in angles=, .* in rad", "def f"),
        (
            Hurried(),
            RANGES,
            r"no time: the position for states .3, 4. and a dt of 0 .*: expected as it was",
            "def forward(",
        ),
        (
            Pair(),
            RANGES,
            r"shapes: .* expected a tensor \(4,\), received tuple",
            "def forward(",
        ),
        (Heading(), RANGES, r"angles of states: component 3, .* expected an angle in rad, declared in", "def forward("),
        (STRAIGHT, Beyond(), r"what it reads: for states .2,. .* shape \(2,\), received \(0,\)", "def forward("),
        (STRAIGHT, Bearing(place=(2e4, -3e4)), "angles: element 0 .* received a jump by a turn in rad", "def forward("),
        (STRAIGHT, Bearing(True, True), "angles: element 0 .* received a jump by a turn in degrees", "def forward("),
        (STRAIGHT, Curved(), "linearity: twice a state, as linear is True", "def forward("),
        (STRAIGHT, Root(), "gradients: gradient: expected finite numbers", "def forward("),
        (STRAIGHT, Needy(), "TypeError: .*'NoneType' .* hand one in: u=.$", "return x[..., :2] - u[..., :2]"),
    ],
)
def test_what_is_wrong_is_told_with_the_line_of_the_user(motion, sensor, said, line):
    report = check_model(motion, sensor)
    assert not report.ok
    (problem,) = report.problems
    words, where = problem.split("\n     ")
    wrong = sensor if motion is STRAIGHT else motion
    assert words.startswith(f"{type(wrong).__name__}.{'process_noise' if 'noise' in said else 'forward'}: ")
    assert re.search(said, words), words
    assert where.startswith(f"{__file__}, line "), where
    assert line in where, where
    assert f"1 problem\n  1. {problem}" in str(report)
    assert "skipped: in a filter: all: until they are right by themselves" in str(report)


def test_a_sensor_that_asks_for_its_u_itself_is_told_how_to_hand_it_in():
    (problem,) = check_model(STRAIGHT, Bearings(0.01)).problems
    assert re.search("u: expected the positions of 2 stations, .* hand one in: u=.$", problem), problem


def test_every_motion_and_sensor_that_is_wrong_is_told():
    report = check_model(Bank([Shorter(), STRAIGHT, Double()]), Bearing())
    assert [problem.split(":")[0] for problem in report.problems] == [
        "Shorter.forward",
        "Double.forward",
        "Bearing.forward",
    ]


@pytest.mark.slow
def test_a_filter_is_compiled_where_there_is_a_compiler_and_skipped_with_a_word_where_not(request):
    assert "right: in a compiled filter: " in str(check_model(STRAIGHT, RANGES, compiled=True))
    request.getfixturevalue("no_compiler")
    report = check_model(Drag(), RANGES, compiled=True)
    assert report.ok, report
    assert "skipped: in a compiled filter: all: compile: expected the package llvmlite" in str(report)


def test_arguments_that_do_not_fit_are_refused_before_any_work():
    with pytest.raises(ValueError, match="motion: expected an instance of torchfra's Motion, received Position"):
        check_model(type("Position", (), {})(), RANGES)
    with pytest.raises(ValueError, match=r"state: expected finite numbers \(4,\) of \[x, y, vx, vy\], received \(3,\)"):
        check_model(STRAIGHT, RANGES, state=torch.ones(3))
    with pytest.raises(ValueError, match=r"u: expected finite numbers \(k,\), received \(2, 2\)"):
        check_model(STRAIGHT, RANGES, u=torch.ones(2, 2))
    with pytest.raises(ValueError, match=r"state: expected finite numbers .*, received \[1.0, 2.0, 3.0, nan\]"):
        check_model(STRAIGHT, RANGES, state=[1, 2, 3, math.nan])
    for dt in (-1.0, 0.0, math.inf, "1"):
        with pytest.raises(ValueError, match="dt: expected a finite number of seconds above 0, received"):
            check_model(STRAIGHT, RANGES, dt=dt)


def test_a_state_and_a_u_may_be_lists_and_what_mixes_tracks_is_told_by_how_much():
    assert check_model(STRAIGHT, Needy(), state=[100, 50, 1, 2], u=[3, 4]).ok
    (problem,) = check_model(Together(), RANGES).problems
    assert re.search(r"state 0 of a batch.* received .*, a difference of \[", problem)


def test_a_sensor_that_reads_more_than_it_says_is_told_of_although_shapes_fit():
    (problem,) = check_model(STRAIGHT, Short()).problems
    assert "measurement of the 3 components that it reads alone (reads): expected that of the whole state" in problem


# ---------------------------------------------------------------- series, networks


class Autoregressive(Motion):
    """Of the second order: states ``[value, value before]``, a step for each measurement, whatever ``dt``."""

    linear = True

    def __init__(self, **options):
        super().__init__(1, 2, None, **options)

    def transition(self, dt):
        return torch.tensor([[1.5, -0.7], [1.0, 0.0]], dtype=dt.dtype).expand(*dt.shape, 2, 2)

    def process_noise(self, dt):
        return torch.tensor([[1.0], [0.0]], dtype=dt.dtype).expand(*dt.shape, 2, 1)


class Learned(Motion):
    def __init__(self, both=False):
        super().__init__(2, 2, 0.1)
        self.network, self.both = torch.nn.Sequential(torch.nn.Linear(4, 4), torch.nn.Tanh()), both

    def forward(self, x, dt, u=None):
        known = x.to(self.network[0].weight) if self.both else x
        return x + dt.unsqueeze(-1) * self.network(known).to(x)


def test_a_series_says_of_what_kind_it_is_and_gets_all_checks():
    (problem,) = check_model(Autoregressive(), Itself()).problems
    (advice,) = re.findall(r"hand (kinds=\('other', 'other'\)) to Motion", problem)
    report = check_model(eval(f"Autoregressive({advice})"), Itself())
    assert report.ok, report
    assert "right: in a filter: " in str(report)


def test_all_other_checks_of_a_motion_that_moves_in_no_time_are_told():
    assert "right: Hurried.forward: shapes, batches, precision, linearity, gradients, vmap" in str(
        check_model(Hurried(), RANGES)
    )


def test_a_network_of_one_precision_is_told_how_to_take_both():
    (problem,) = check_model(Learned(), RANGES).problems
    assert "for states in float32: " in problem
    assert "take both: self.network(x.to(weights)).to(x)" in problem
    assert check_model(Learned(both=True), RANGES).ok


# ---------------------------------------------------------------- models in which rounding grows


def test_a_model_that_amplifies_rounding_is_not_blamed_for_what_float32_makes_of_it():
    report = check_model(Wild(), Itself(), u=torch.ones(1), state=torch.ones(1))
    assert report.ok, report


def test_a_growth_model_whose_gradient_bends_strongly_is_right():
    growth = torchfra.scenarios.growth()
    report = check_model(growth.motion, growth.sensor, u=torch.tensor([3.0]), state=torch.tensor([5.0]), seed=34)
    assert report.ok, report


def test_a_gradient_that_is_wrong_is_told_of_once_and_the_checks_after_it_see_the_same_values():
    growth = torchfra.scenarios.growth()

    class Detached(type(growth.sensor)):
        def __init__(self):
            super().__init__()
            self.gain = Hyper(1.0, name="gain")

        def forward(self, x, u=None):
            return super().forward(x) * (0.9 * self.gain(x) + 0.1 * self.gain(x).detach()).unsqueeze(-1)

    report = check_model(growth.motion, Detached(), u=torch.tensor([3.0]), state=torch.tensor([5.0]))
    (problem,) = report.problems
    assert "gradient of sensor.gain.raw" in problem
