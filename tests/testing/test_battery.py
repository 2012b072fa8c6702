"""Every filter keeps what filters promise: the battery that users have for their own."""

import copy
import math
from dataclasses import dataclass
from functools import partial

import pytest
import torch
from gpb_cases import ANCHORS, FEWER, PRIOR, VALUES, measured
from joint import plane
from refusals import asked  # noqa: F401  a fixture
from short_tracks import SMALL_GPB

from torchfra import presets
from torchfra.association import ChiSquare, Clutter, Euclidean
from torchfra.catalogue import FILTERS
from torchfra.filters import SRCKF
from torchfra.gaussian import third_degree
from torchfra.motion import (
    Bank,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    CurrentStatistical,
    RandomWalk,
)
from torchfra.sensors import Correlated, Position, Ranges, Sensor, TimeDifferences
from torchfra.testing import CHECKS, check_filter
from torchfra.testing.battery import tried
from torchfra.testing.case import Case, make_case
from torchfra.types import Gaussian

ELSEWHERE = {
    "imm_ckf": "imm_srckf by another name", "imm_fra": "as imm_srckf and fra", "hghckf1": "as hghckf2, decided once",
    "jpda": "compiled too, below", "ukf_jpda": "as iaukf_jpda, whose noise is estimated besides",
}  # fmt: skip
"""Filters that are made of what others of the battery have, or go through it in another file."""
NAMES = [name for name in FILTERS if name not in ELSEWHERE]
COMPILED = ("iaukf", "fra", "imm_srckf", "alphabeta")
"""Their kernels go through the whole battery; those of high degree: test_huber.py, of all: test_random_settings.py."""
HOLDS = "where_its_models_hold_it_is_no_worse_than_a_kalman_filter"
"""Is asked of all filters, of more tracks, by test_as_stated.py."""


def preset(name, scenario, crossing, **options):
    """A filter of the catalogue with tracks for it."""
    entry = FILTERS[name]
    if entry.scans:
        options |= {"clutter": crossing.clutter, "detection": crossing.detection}
        tracks = crossing.simulate(3, 0)
        return entry.preset(crossing.motion, crossing.sensor, **options), {"z": tracks.z, "prior": tracks.prior}
    if entry.constant_gains:
        return entry.preset(ConstantVelocity(1.0), Position(2.0)), {}
    tracks, motion = scenario.simulate(3, 0), ConstantVelocity(1.0)
    prior = Gaussian(tracks.prior.mean[..., :4], tracks.prior.scale_tril[..., :4, :4])  # no acceleration: small kernels
    motions = Bank([motion, ConstantVelocity(10.0)], neighbours=[[1], [0]], first=[0, 1])
    f = entry.preset(motions if entry.bank else motion, copy.deepcopy(scenario.sensor), **options)
    return f, {"z": tracks.z, "prior": prior, "u": tracks.u}


@pytest.mark.slow
@pytest.mark.usefixtures("asked")
@pytest.mark.parametrize("name", NAMES)
def test_every_filter_keeps_what_filters_promise(name, scenario, crossing, request):
    small = SMALL_GPB if name == "gpb" else {}
    f, tracks = preset(name, scenario, crossing, **small)
    thorough = request.config.getoption("--thorough")
    report = check_filter(f, **tracks, compiled=name in COMPILED or thorough, thorough=thorough, skip=(HOLDS,))
    assert report.of("passed") == report.outcomes


@pytest.mark.slow
@pytest.mark.usefixtures("asked")
def test_kernels_of_gpb_keep_it_too(monkeypatch):
    """Of a target without a velocity, for the compiler's time."""
    names = [name for name, check in CHECKS.items() if "compiled" in check.ways]
    for name in names:
        monkeypatch.setitem(CHECKS, name, CHECKS[name]._replace(ways=("compiled",)))
    report = check_filter(presets.gpb(RandomWalk(1.0), Position(2.0), **SMALL_GPB), only=names)
    assert report.of("passed") == report.outcomes
    assert {outcome.way for outcome in report.outcomes} == {"compiled"}


@dataclass(frozen=True)
class Smoothed(Case):
    """The same, of smoothed estimates."""

    lag: int | None = None

    def __call__(self, **given):
        arguments = {"z": self.z, "prior": self.prior, "dt": self.dt, "u": self.u, "lag": self.lag}
        return self.filter.smooth(**arguments | given)


OF_SMOOTHED = [name for name in CHECKS if name not in (HOLDS, "steps_give_what_whole_tracks_give")]
LAGGED = ("srckf", "iaukf", "fra", "imm_srckf", "vsimm_srckf", "iaukf_jpda")
SMOOTHED = [(name, None) for name in NAMES if name != "alphabeta"] + [(name, 2) for name in LAGGED]
QUICK = ("srckf", "asrckf")


@pytest.mark.parametrize(
    ("name", "lag"), [pytest.param(*of, marks=() if of[0] in QUICK else pytest.mark.slow) for of in SMOOTHED]
)
def test_every_smoother_keeps_what_filters_promise(name, lag, scenario, crossing):
    f, tracks = preset(name, scenario, crossing, **(SMALL_GPB if name == "gpb" else {}))
    case = make_case(f, tracks["z"], tracks["prior"], 1.0, tracks.get("u"), seed=0, thorough=False)
    report = tried(Smoothed(**vars(case), lag=lag), OF_SMOOTHED, compiled=name in COMPILED)
    assert report.of("passed") == report.outcomes


MOTION, SENSOR = ConstantVelocity(1.0), Position(2.0)
BANK = [MOTION, ConstantVelocity(10.0)]
THREE = {"plain": 1.0, "preference": 0.4, "provisional": "likeliest", "final": "likeliest"}
SCANS = {"clutter": Clutter(1e6), "temperature": 0.1}
SETTINGS = {
    "three branches": lambda: presets.fra(MOTION, SENSOR, **THREE),
    "three soft branches": lambda: presets.fra(MOTION, SENSOR, **THREE, temperature=1.0),
    "rows of transitions": lambda: presets.imm(BANK, SENSOR, transition=[[0.95, 0.05], [0.1, 0.9]]),
    "durations": lambda: presets.imm(BANK, SENSOR, durations=(60.0, 9.0)),
    "soft gains": lambda: presets.alphabeta(
        ConstantAcceleration(1.0, 3), Position(20.0, dims=3), onset="fastest", detect="polar", temperature=0.2
    ),
    "errors that last": lambda: presets.rsrckf(MOTION, Correlated(SENSOR, 3.0, 20.0)),
    "a share of outliers": lambda: presets.hghckf2(MOTION, SENSOR, rule=third_degree, eps=0.2),
    "weights of the covariance": lambda: presets.hghckf2(MOTION, SENSOR, rule=third_degree, cov_mode="indicator"),
    "level of the acceleration": lambda: presets.srckf(CurrentStatistical(0.3, 2.0, negative_limit=3.0), SENSOR),
    "differences of times": lambda: presets.srckf(MOTION, TimeDifferences(ANCHORS, 0.3)),
    "ranges": lambda: presets.srckf(ConstantAcceleration(0.3), Ranges(ANCHORS, 0.15)),
    "two targets": plane,
    "models of targets": lambda: presets.jpda(BANK, SENSOR, inner=presets.imm, lost=1e-2, **SCANS),
    "regimes of targets": lambda: presets.jpda(MOTION, SENSOR, inner=partial(presets.gpb, **FEWER), **SCANS),
    "soft gates of targets": lambda: presets.iaukf_jpda(MOTION, SENSOR, lost=0.0, gate=Euclidean(60.0), **SCANS),
    "soft gates of a probability": lambda: presets.iaukf_jpda(MOTION, SENSOR, gate=ChiSquare(0.9), **SCANS),
}
OF_KERNELS = (
    "three soft branches", "rows of transitions", "durations", "soft gains", "errors that last", "two targets",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS)
def test_filters_keep_it_however_they_are_set(name):
    report = check_filter(SETTINGS[name](), compiled=name in OF_KERNELS, skip=(HOLDS,))
    assert report.of("passed") == report.outcomes


OF_TRACKS = (
    "a_single_track_needs_no_batch_and_no_company", "steps_give_what_whole_tracks_give",
    "time_steps_may_differ_per_step_and_per_track", "single_precision_stays_single",
    "a_track_that_fails_leaves_the_others_alone", "it_maps_over_tracks",
)  # fmt: skip


@pytest.mark.slow
def test_gpb_keeps_it_with_several_blocks_and_motions_too():
    motions = [ConstantAcceleration(0.05), CoordinatedTurn(math.pi / 20, 0.1, orders=3)]
    f = presets.gpb(motions, Ranges(ANCHORS[:2], 2.0), **VALUES)
    z = measured("ranges", 3)[:, 2:8, :2]
    assert [o.check for o in check_filter(f, z, PRIOR, compiled=False, only=OF_TRACKS).of("passed")] == [*OF_TRACKS]


def test_a_robust_filter_is_found_to_be_worse_where_the_models_hold(scenario, crossing):
    f, tracks = preset("srckf", scenario, crossing)
    assert check_filter(f, **tracks, compiled=False, only=[HOLDS]).of("skipped") == ()
    f, tracks = preset("rsrckf", scenario, crossing, threshold=0.3)  # which distrusts what is as it should be
    with pytest.raises(AssertionError, match="position error where its models hold: expected at most"):
        check_filter(f, **tracks, compiled=False, only=[HOLDS])


# ---------------------------------------------------------------- the battery finds what is broken


class Deaf(SRCKF):
    """Does not hear the noise that comes with measurements."""

    def forward(self, z, prior, *, std=None, noise=None, **options):
        return super().forward(z, prior, **options)


class Reckless(SRCKF):
    """Lets everything in."""

    def _batch(self, measurements, prior, name="prior"):
        return torch.Size(torch.broadcast_shapes(measurements.z.shape[:-2], prior.mean.shape[:-1]))


class Mixing(Sensor):
    """The tracks of a batch are not independent."""

    def __init__(self):
        super().__init__(2, [False, False], 2.0)

    def forward(self, x, u=None):
        return x[..., :2] - x[..., :2].mean()


class Stuck(Position):
    """Its gradient is lost on the way."""

    def forward(self, x, u=None):
        return super().forward(x).detach()


class Looking(Position):
    """Decides in Python by what it sees."""

    def forward(self, x, u=None):
        return super().forward(x) if x.sum() > 0 else super().forward(-x)


@pytest.mark.usefixtures("asked")
@pytest.mark.parametrize(
    ("f", "name"),
    [
        (lambda: Deaf(MOTION, Position(2.0)), "noise_may_come_with_the_measurements"),
        (lambda: Reckless(MOTION, Position(2.0)), "time_steps_must_be_seconds_above_zero"),
        (lambda: Reckless(MOTION, Position(2.0)), "noise_must_be_positive_and_finite"),
        (lambda: SRCKF(MOTION, Mixing()), "a_single_track_needs_no_batch_and_no_company"),
        (lambda: SRCKF(MOTION, Stuck(2.0)), "gradients_are_those_of_small_differences"),
        (lambda: SRCKF(MOTION, Looking(2.0)), "compiled_gives_what_eager_gives"),
        (lambda: SRCKF(MOTION, Looking(2.0)), "it_maps_over_tracks"),
    ],
)
def test_a_broken_filter_is_found_and_named(f, name):
    with pytest.raises(AssertionError, match=rf"{type(f()).__name__}: .*checks failed\n{name}, .*: expected"):
        check_filter(f(), only=[name])
    check_filter(SRCKF(MOTION, Position(2.0)), only=[name])


@pytest.mark.slow
def test_a_report_tells_what_passed_and_what_was_skipped_and_why(crossing, no_compiler):
    names = ["it_maps_over_tracks", "no_tracks_are_no_error"]
    f, tracks = preset("jpda", None, crossing)
    report = check_filter(f, **tracks, only=names)
    assert {(o.check, o.way) for o in report.of("passed")} == {(name, "eager") for name in names}
    assert all("not compiled" in outcome.reason for outcome in report.of("skipped"))
    assert str(report).startswith("JPDA\ncheck")
    assert len(check_filter(f, **tracks, only=names, compiled=False).outcomes) == 2


def test_checks_and_tracks_are_checked_themselves():
    f = SRCKF(MOTION, Position(2.0))
    with pytest.raises(ValueError, match=r"only, skip: expected names of testing\.CHECKS, received all"):
        check_filter(f, only=["all"])
    with pytest.raises(ValueError, match="z, prior: expected both or neither"):
        check_filter(f, torch.zeros(3, 6, 2))
    assert all(check.function.__doc__ for check in CHECKS.values())
