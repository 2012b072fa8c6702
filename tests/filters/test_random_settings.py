"""However a filter is set and whatever it is given, compiled, step by step and in any order it says what it says eager.

Every motion and every sensor of the package is in one of the pairs at least.  Of each pair there is one draw, the same
on every machine, each with other options; with ``--draws N`` there are N in all, and others each time.
"""

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
import torch
from gpb_cases import FEWER
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch.nn import Module

import torchfra
from torchfra import Gaussian, catalogue, motion, presets, sensors, tree
from torchfra.motion import Augmented, Bank, Clock, ConstantAcceleration, ConstantVelocity, CoordinatedTurn, RandomWalk
from torchfra.sensors import Bearings, Biased, Position, RangeBearing, Ranges, Stacked

NAN = math.nan
TOLERANCE = {torch.float64: 1e-8, torch.float32: 2e-2}
AMPLIFIED = 1e3
"""By how many times as much as the same filter moves by a change of its data in the last digit."""
LOST = 1e-2
"""What a change in the last digit moves by more than that, in units of its standard deviation, is left to chance."""

ANCHORS = torch.tensor([[0.0, 0.0, 3.0], [200.0, 0.0, 2.0], [200.0, 150.0, 4.0], [0.0, 150.0, 1.0]]).double()
FLAT = ANCHORS[:, :2].contiguous()
PLANE = Gaussian(torch.tensor([100.0, 60.0, 7.0, 8.0]).double(), torch.tensor([20.0, 20.0, 5.0, 5.0]).double())
PLACE = Gaussian(PLANE.mean[:2], PLANE.scale_tril[:2])
SPACE = Gaussian(
    torch.tensor([100.0, 60.0, 20.0, 7.0, 8.0, 1.0]).double(), torch.tensor([20.0] * 3 + [5.0] * 3).double()
)


def with_more(belief, mean, std):
    """Mean and standard deviations of more components."""
    return Gaussian(*(torch.cat([x, torch.tensor(more).double()]) for x, more in zip(belief, (mean, std), strict=True)))


ACCELERATED = with_more(PLANE, [0.0, 0.0], [1.0, 1.0])
DRIVEN = Gaussian(torch.tensor([100.0, 60.0, 10.0, 0.5, 0.0]).double(), torch.tensor([5.0, 5, 2, 0.3, 0.1]).double())
AWAY = torchfra.coordinates.from_cartesian(SPACE.mean * 100)


HERE = torch.tensor([0.0, 0.0, 5.0]).double()
HALF = torch.eye(2, 4, dtype=torch.float64)


class Pair(NamedTuple):
    """A filter around a motion and a sensor, and where its tracks begin."""

    preset: object
    motion: object
    sensor: object
    start: Gaussian
    """Mean and standard deviations."""
    u: tuple = ()
    """What the models need to know."""
    noise: str = ""
    """Whether ``"std"`` or ``"noise"`` comes with the measurements."""


def satellites(rates):
    places = 2e4 * torch.tensor([[1.0, 0, 1], [-1, 0.5, 1], [0, -1, 1], [0.2, 0.3, 1]]).double()
    return tuple((torch.cat([places.flatten(), 0.1 * places.flatten()]) if rates else places.flatten()).tolist())


VELOCITY = ConstantVelocity(1.0)
FEW = partial(presets.gpb, **FEWER)
"""One of all its hypotheses is enough, for the compiler's time."""
PAIRS = {
    "gpb": Pair(presets.gpb, VELOCITY, Position(2.0), PLANE, noise="std"),
    "gpb of a radar": Pair(FEW, [VELOCITY, CoordinatedTurn(0.1, 1.0)], RangeBearing((2.0, 0.02)), PLANE),
    "gpb of ranges": Pair(FEW, VELOCITY, Ranges(FLAT[:2], 1.0), PLANE, noise="std"),
    "ekf": Pair(presets.ekf, motion.UnknownTurn(1.0, 0.01), RangeBearing((2.0, 0.02)), with_more(PLANE, [0.1], [0.1])),
    "ukf": Pair(presets.ukf, motion.Bicycle(2.5, 1.0, 0.1), Position(2.0), DRIVEN),
    "srckf": Pair(presets.srckf, motion.CurrentStatistical(0.3, 5.0), Position(2.0), ACCELERATED, noise="noise"),
    "srckf of time differences": Pair(
        presets.srckf, ConstantVelocity(1.0, continuous=True), sensors.TimeDifferences(FLAT, 3.0), PLANE, noise="noise"
    ),
    "srckf of a camera": Pair(
        presets.srckf, ConstantVelocity(1.0, 3),
        sensors.Camera(800.0, 2.0, position=HERE, rotation=sensors.facing(HERE, SPACE.mean[:3])), SPACE,
    ),
    "srckf of satellites": Pair(
        presets.srckf, Augmented(ConstantVelocity(1.0, 3), Clock(0.1, 0.1)), sensors.Pseudoranges(4, 2.0, 0.1),
        with_more(SPACE, [10.0, 1.0], [10.0, 1.0]), u=satellites(True),
    ),
    "rsrckf": Pair(presets.rsrckf, ConstantAcceleration(1.0), Bearings(0.01, stations=FLAT[:3]), ACCELERATED),
    "mr_ckf": Pair(presets.mr_ckf, motion.WhiteJerk(1.0), RangeBearing((2.0, 0.02)), ACCELERATED, noise="std"),
    "asrckf": Pair(presets.asrckf, VELOCITY, Stacked(Position(2.0), sensors.RangeRates(FLAT[:2], 0.5)), PLANE),
    "mr_ckf of odometry": Pair(
        presets.mr_ckf, Augmented(motion.Odometry(0.1, 1e-3, 1e-3, 1e-6), motion.GaussMarkov(1.0, 20.0, 2)),
        Biased(Position(2.0), [5, 6]), with_more(PLACE, [0.1, 0.0, 0.0, 0.0, 0.0], [0.2, 0.1, 0.01, 1.0, 1.0]),
        u=(3.0, 0.1),
    ),
    "rmckf": Pair(
        presets.rmckf, motion.Level(motion.IntegratedOrnsteinUhlenbeck(1.0, 0.2), 0.1), Position(2.0, dims=3),
        Gaussian(*(torch.cat([x[:2], x.new_ones(1), x[2:]]) for x in PLANE)),
    ),
    "ghckf": Pair(presets.ghckf, VELOCITY, RangeBearing((2.0, 0.02)), PLANE),  # of few states, for the compiler
    "hghckf1": Pair(presets.hghckf1, VELOCITY, Position(2.0), PLANE),
    "srckf of a constant speed": Pair(
        presets.srckf, motion.ConstantSpeed(1.0, 0.01), RangeBearing((2.0, 0.02, 0.02), dims=3), SPACE
    ),
    "hghckf2": Pair(presets.hghckf2, VELOCITY, Ranges(ANCHORS, 1.0, height=1.0), PLANE),
    "hghckf": Pair(
        presets.hghckf, CoordinatedTurn(0.1, 1.0, continuous=True), Bearings(0.01, stations=FLAT[1:3]), PLANE
    ),
    "iaukf": Pair(presets.iaukf, motion.Bicycle(2.5, 1.0, 0.1), RangeBearing((2.0, 0.02)), DRIVEN),
    "iaukf in spherical coordinates": Pair(
        presets.iaukf, motion.Spherical(ConstantVelocity(1.0, 3)), sensors.InfraredLaser((0.002, 0.002, 5.0)),
        Gaussian(AWAY, torch.tensor([1e-3, 1e-3, 1e-3, 0.01, 0.01, 1e-6]).double()),
    ),
    "fra": Pair(presets.fra, Augmented(VELOCITY, RandomWalk(0.1, 2, kind="bias")), Biased(Position(2.0), [4, 5]),
                with_more(PLANE, [1.0, 1.0], [2.0, 2.0])),
    "fra_srckf": Pair(presets.fra_srckf, VELOCITY, Bearings(0.01), PLANE, u=(0.0, 0.0, 200.0, 0.0)),
    "imm": Pair(
        presets.imm_srckf, Bank([ConstantAcceleration(1.0), motion.Singer(4.0, 0.2)]), Position(2.0), ACCELERATED
    ),
    "imm_fra": Pair(presets.imm_fra, [VELOCITY, CoordinatedTurn(0.2, 1.0)], RangeBearing((2.0, 0.02)), PLANE),
    "vsimm": Pair(
        presets.vsimm_srckf,
        Bank([ConstantVelocity(q) for q in (0.1, 1.0, 30.0)], neighbours=[[1], [2], [0]], first=[0, 1]),
        Position(2.0), PLANE,
    ),
    "imm of an embedded motion": Pair(
        presets.imm_srckf, [VELOCITY, motion.Embedded(RandomWalk(1.0), HALF, HALF.mT, 2)], Ranges(FLAT, 1.0), PLANE
    ),
    "alphabeta": Pair(presets.alphabeta, VELOCITY, Position(2.0), PLANE),
}  # fmt: skip


TIMES = {
    "each": lambda dt: dt,
    "a number": lambda dt: float(dt[0, 0]),
    "of numpy": lambda dt: np.float64(dt[0, 0]),
    "per step": lambda dt: dt[0],
    "whole": lambda dt: math.ceil(dt[0, 0]),
    "per track": lambda dt: dt[:, :1],
    "of numpy, whole": lambda dt: np.int64(math.ceil(dt[0, 0])),
    "of numpy, rough": lambda dt: np.float32(dt[0, 0]),
    "0-d": lambda dt: dt[0, 0],
}
"""All that time steps may be given as, from ``(B, T)``."""


class Tracks(NamedTuple):
    """What a filter is given."""

    z: torch.Tensor
    prior: Gaussian
    dt: object
    more: dict

    def seconds(self, k):
        """The time step of step ``k``, as ``step`` takes it."""
        dt = self.dt
        return dt[..., min(k, dt.shape[-1] - 1)] if isinstance(dt, torch.Tensor) and dt.dim() else dt


def drawn(pair, f, number, *, batch, steps, missing, still, round_numbers, outliers, time="each"):
    """Tracks of a filter's own motion, or of the first of its bank, drawn from a number."""
    generator = torch.Generator().manual_seed(number)

    def normal(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    def chance(*shape):
        return torch.rand(*shape, dtype=torch.float64, generator=generator)

    mean, std = pair.start
    of_truth = f.motion[0] if f.motion.stacked else f.motion
    times = 10 ** (2 * chance(batch, 1) - 1)
    x = mean + std * normal(batch, len(mean))
    prior = Gaussian(mean + times * std * normal(batch, len(mean)), torch.diag_embed((times * std).expand(batch, -1)))
    if round_numbers:  # as people write them: points lie on axes and behind stations
        prior = Gaussian(mean.expand(batch, -1).clone(), torch.diag_embed(std.expand(batch, -1)))
    dt = chance(batch, steps) + 0.1
    if still and f.limits.zero_dt:
        dt = torch.where(chance(batch, steps) < 0.3, 0.0, dt)
    dt = TIMES[time](dt)
    each = torch.as_tensor(dt, dtype=torch.float64).expand(batch, steps)
    u = torch.tensor(pair.u).double() if pair.u else None
    seen = []
    for k in range(steps):
        x = of_truth(x, each[:, k], None if u is None else u.expand(batch, -1))
        seen.append(f.sensor(x, None if u is None else u.expand(batch, -1)))
    z = torch.stack(seen, 1)
    deviations = f.sensor.measurement_noise(z).std.expand_as(z)
    z = z + deviations * normal(*z.shape) * torch.where(chance(*z.shape) < 0.1 * outliers, 30.0, 1.0)
    z = torch.where((chance(*z.shape) < 0.3 * missing) | (chance(batch, steps, 1) < 0.3 * missing), NAN, z)
    more = {} if u is None else {"u": u.expand(steps, -1)}
    own = deviations * (0.5 + chance(*z.shape))
    more |= {"std": {"std": own}, "noise": {"noise": torch.diag_embed(own) + 0.1 * own.unsqueeze(-2).tril()}}.get(
        pair.noise, {}
    )
    return Tracks(z.detach(), prior, dt, {name: x.detach() for name, x in more.items()})


def run(f, tracks):
    """What a filter says of tracks."""
    with torch.no_grad():
        return f(tracks.z, tracks.prior, dt=tracks.dt, **tracks.more)


def moved(tracks, sign):
    """The same tracks, changed in their last digits."""
    times = 1 + 4 * sign * torch.finfo(tracks.z.dtype).eps
    return tracks._replace(
        z=times * tracks.z, prior=Gaussian(times * tracks.prior.mean, tracks.prior.scale_tril / times)
    )


def gaps(found, expected):
    """How far two estimates are apart up to each step, ``(B, T)``, in units of what is expected."""
    std = expected.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    std = torch.maximum(
        std, torch.finfo(std.dtype).eps ** 0.5 * std.amax((0, 1))
    )  # what is certain is so up to rounding
    pairs = [
        ((found.mean - expected.mean) / std, 1.0),
        ((found.covariance - expected.covariance) / (std.unsqueeze(-1) * std.unsqueeze(-2)), 1.0),
    ]
    of_info = zip(tree.flatten(found.info), tree.flatten(expected.info), strict=True)
    for a, b in [(found.nis, expected.nis), (found.log_likelihood, expected.log_likelihood), *of_info]:
        if b.is_floating_point() and b.shape[:2] == std.shape[:2]:
            pairs.append((a - b, 1 + b.abs()))
    each = [(a / b).abs().nan_to_num(nan=math.inf).reshape(*std.shape[:2], -1).amax(-1) for a, b in pairs]
    return torch.stack(each).amax(0).cummax(1).values


def expect_same(found, expected, amplified, what):
    """Expects estimates that differ by rounding, where the last digit does not decide what a filter says."""
    limit, gap = TOLERANCE[expected.mean.dtype] + AMPLIFIED * amplified, gaps(found, expected)
    wrong = (gap > limit) & (amplified < LOST)
    said = f"{float(gap[wrong].max()):.3g}, moved by {float(amplified[wrong].max()):.3g}" if wrong.any() else ""
    assert not wrong.any(), f"{what}: a difference of {said} by the last digit"


FILTERS = {}


def filters_of(name):
    """The filter of a pair, eager and compiled."""
    if name not in FILTERS:
        pair = PAIRS[name]
        FILTERS[name] = pair.preset(pair.motion, pair.sensor), pair.preset(pair.motion, pair.sensor).compile()
    return FILTERS[name]


def stepped(f, tracks):
    """The beliefs after each step, ``(B, T, n)``."""
    state, said = f.init(tracks.prior), []
    for k in range(tracks.z.shape[1]):
        given = {key: x[k] if key == "u" else x[:, k] for key, x in tracks.more.items()}
        state, _ = f.step(state, tracks.z[:, k], dt=tracks.seconds(k), **given)
        said.append(state.belief)
    return Gaussian(*(torch.stack(x, 1) for x in zip(*said, strict=True)))


def single(tracks):
    """The same tracks in float32."""
    return tree.map_tensors(torch.Tensor.float, tracks._replace(more=None))._replace(
        more={name: x.float() for name, x in tracks.more.items()}
    )


def check(name, number, options):
    """One draw."""
    eager, compiled = filters_of(name)
    few = PAIRS[name].preset is FEW  # kernels of one track and of single precision: of all hypotheses
    tracks = drawn(PAIRS[name], eager, number, **options | {"batch": max(options["batch"], 1 + few)})
    expected = run(eager, tracks)
    amplified = torch.stack([gaps(run(eager, moved(tracks, sign)), expected) for sign in (1, -1)]).amax(0)
    found = run(compiled, tracks)
    expect_same(found, expected, amplified, "compiled and eager")
    order = torch.randperm(len(tracks.z), generator=torch.Generator().manual_seed(number))
    dt = tracks.dt[order] if getattr(tracks.dt, "ndim", 0) == 2 else tracks.dt
    shuffled = Tracks(tracks.z[order], Gaussian(*(x[order] for x in tracks.prior)), dt,
                      {key: x if key == "u" else x[order] for key, x in tracks.more.items()})  # fmt: skip
    back = tree.map_tensors(lambda x: x[order.argsort()], run(compiled, shuffled))
    expect_same(back, expected, amplified, "in another order")
    now = getattr(expected.info, "provisional", getattr(expected.info, "filtered", expected))
    with torch.no_grad():
        each = stepped(compiled, tracks)
    same = {"nis": expected.nis, "log_likelihood": expected.log_likelihood, "info": ()}
    of_steps, at_once = (torchfra.types.Estimate(x.mean, x.scale_tril, **same) for x in (each, now))
    expect_same(of_steps, at_once, amplified, "step by step")
    if number % 4 == 0 and not few:
        short = single(tracks)
        rough = run(eager, short)
        amplified = torch.stack([gaps(run(eager, moved(short, sign)), rough) for sign in (1, -1)]).amax(0)
        expect_same(run(compiled, short), rough, amplified, "compiled and eager in float32")


OPTIONS = st.fixed_dictionaries({
    "batch": st.integers(1, 5), "steps": st.integers(1, 8), "missing": st.booleans(), "still": st.booleans(),
    "round_numbers": st.booleans(), "outliers": st.booleans(), "time": st.sampled_from([*TIMES]),
})  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_a_compiled_filter_says_what_the_filter_says(name, request):
    draws, place = request.config.getoption("--draws"), [*PAIRS].index(name)
    if not draws:
        few, more = {"batch": 1 + place % 3, "steps": 6}, {"still": place % 2 > 0, "round_numbers": place % 5 == 0}
        few["time"] = [*TIMES][place % len(TIMES)]
        return check(name, place, few | more | {"missing": True, "outliers": place % 2 == 0})
    count, number = -(-draws // len(PAIRS)), st.integers(0, 2**31)
    of = settings(max_examples=count, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    of(given(number, OPTIONS)(lambda number, options: check(name, number, options)))()


def test_every_filter_of_the_catalogue_is_drawn():
    """But for those of scans, whose tracks are others, and second names."""
    wanted = {entry.preset for entry in catalogue.FILTERS.values() if entry.listed and not entry.scans}
    assert wanted <= {pair.preset for pair in PAIRS.values()}


def test_every_motion_and_every_sensor_of_the_package_is_drawn():
    seen = {type(part).__name__ for pair in PAIRS.values() for f in [pair.preset(pair.motion, pair.sensor)]
            for part in f.modules()}  # fmt: skip
    every = {getattr(of, name) for of in (motion, sensors) for name in of.__all__}
    models = {x for x in every if isinstance(x, type) and issubclass(x, Module)}
    bare = {"Motion", "Sensor", "Correlated"}  # those of which the others are made, and what a preset makes a state of
    bare |= {"Linear", "BodyOdometry", "Mounted"}  # whose matrices, readings and poses come in u: files of their own
    assert {x.__name__ for x in models} - seen == bare
