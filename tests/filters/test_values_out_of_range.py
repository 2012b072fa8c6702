"""A hyperparameter that is NaN fails every track and is named, and none can be loaded, set or made so."""

import copy
import re

import pytest
import torch
from short_tracks import SMALL_GPB

from torchfra import Cause, Gaussian, Hyper, learnable, presets
from torchfra.association import Clutter
from torchfra.filters import FixedLag
from torchfra.hyper import hypers
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.sensors import Position
from torchfra.stream import Tracker
from torchfra.targets import SPRT, Deletion, Targets, TwoPoint

MOTION, SENSOR, BANK = ConstantVelocity(1.0), Position(2.0), [ConstantVelocity(1.0), ConstantVelocity(100.0)]
DURATIONS = {"durations": (100.0,) * 8, "outlier_durations": (100.0, 3.0), "outlier_offsets": (1.0, 2.0, 3.0, 4.0)}
SINGLE = ["rsrckf", "hghckf1", "hghckf2", "mr_ckf", "asrckf", "iaukf", "fra", "alphabeta"]
"""Every part with hyperparameters of its own is in one of the filters."""
FILTERS = {name: (lambda name=name: getattr(presets, name)(MOTION, SENSOR)) for name in SINGLE} | {
    "three gains": lambda: presets.alphabeta(ConstantAcceleration(1.0), SENSOR),
    "gpb of a bank": lambda: presets.gpb(BANK, SENSOR, manoeuvres="hard", same_offset=0.5, lag=1),
    "gpb in continuous time": lambda: presets.gpb(MOTION, SENSOR, **DURATIONS),
    "imm": lambda: presets.imm(BANK, SENSOR),
    "imm of a matrix": lambda: presets.imm(BANK, SENSOR, transition=[[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5]),
    "imm in continuous time": lambda: presets.imm(BANK, SENSOR, durations=[10.0, 20.0]),
}


def tracks(f, count=2):
    n = f.motion.size
    z = torch.randn(count, 6, 2, generator=torch.Generator().manual_seed(0)).double()
    z[:, 4, 0] = 100.0
    return z, Gaussian(torch.zeros(count, n).double(), torch.eye(n).double())


def spoilt(f, path):
    """The filter with a value of NaN, written so that no version counter notices."""
    hypers(f)[path].raw.data.fill_(torch.nan)
    return f


@pytest.mark.parametrize("name", FILTERS)
def test_each_hyperparameter_that_is_nan_fails_every_track_and_is_named(name):
    made = FILTERS[name]()
    z, prior = tracks(made)
    assert made(z, prior).failure.values == ()
    for path in hypers(made):
        f = spoilt(copy.deepcopy(made), path)
        estimate = f(z, prior)
        assert estimate.failed.all()
        assert (estimate.failure.cause == Cause.VALUE).all()
        assert estimate.failure.values == (path,)
        assert estimate.failure.describe()[0] == f"track (0,): value {path}, step {estimate.failure.step[0]}"
        assert f.step(made.init(prior), z[:, 0])[0].belief.failed.all()


@pytest.mark.parametrize(("name", "path"), [
    ("rsrckf", "robust.threshold"), pytest.param("gpb", "outliers.outlier_sizes", marks=pytest.mark.slow),
])  # fmt: skip
def test_a_compiled_filter_fails_as_well_however_it_runs_and_goes_on_once_the_value_is_mended(name, path):
    f = getattr(presets, name)(MOTION, SENSOR, **(SMALL_GPB if name == "gpb" else {})).compile()
    z, prior = tracks(f)
    good, value = f(z, prior).mean, hypers(f)[path].raw.clone()
    state, _ = f.step(f.init(prior), z[:, 0])
    for _ in range(2):  # the second call of a form is another code path
        spoilt(f, path)
        assert f(z, prior).failure.values == f.smooth(z, prior).failure.values == (path,)
        assert f.smooth(z, prior).failed.all()
        assert f.step(state, z[:, 1])[0].belief.failed.all()
        hypers(f)[path].raw.data.copy_(value)
        torch.testing.assert_close(f(z, prior).mean, good, rtol=1e-12, atol=1e-12)
        assert not f.step(state, z[:, 1])[0].belief.failed.any()


@pytest.mark.parametrize("name", FILTERS)
def test_noise_that_is_infinite_fails_every_track_and_is_named(name):
    """Of interacting models too, where the others could go on without the one."""
    made = FILTERS[name]()
    z, prior = tracks(made)
    noise = [path for path in hypers(made) if path.rpartition(".")[2] in ("q", "std")]
    assert len(noise) >= 2
    for path in noise:
        f = copy.deepcopy(made)
        hypers(f)[path].raw.data.fill_(torch.inf)
        estimate = f(z, prior)
        assert (estimate.failure.cause == Cause.VALUE).all()
        assert estimate.failure.values == (path,)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_an_infinity_that_fails_a_track_is_named(name):
    made = FILTERS[name]()
    z, prior = tracks(made, 1)
    for path in hypers(made):
        for infinite in (torch.inf, -torch.inf):
            f = copy.deepcopy(made)
            hypers(f)[path].raw.data.fill_(infinite)
            estimate = f(z, prior)
            assert estimate.failure.values == ((path,) if estimate.failed.any() else ())


@pytest.mark.parametrize("make", [ConstantVelocity, Position])
def test_noise_that_is_infinite_is_refused(make):
    with pytest.raises(ValueError, match=r"(q|std): expected finite numbers, received inf"):
        make(torch.inf)
    f, values = make(1.0), make(1.0).state_dict()
    with pytest.raises(RuntimeError, match=r"(q|std): expected a value .*, finite, received inf"):
        f.load_state_dict({name: torch.full_like(x, torch.inf) for name, x in values.items()})


def test_trackers_lags_and_scans_fail_as_well():
    f = spoilt(presets.rsrckf(MOTION, SENSOR), "robust.threshold")
    z, prior = tracks(f)
    assert FixedLag(f, 2).step(FixedLag(f, 2).init(prior), z[:, 0])[0].belief.failed.all()
    assert Tracker(f, prior).update(1.0, z[:, 0]).failure.values == ("robust.threshold",)
    f = spoilt(presets.jpda(MOTION, SENSOR, clutter=Clutter(1e-4)), "detection")
    assert (f(z.unsqueeze(-2), Gaussian(prior.mean.unsqueeze(-2), prior.scale_tril)).failure.cause == Cause.VALUE).all()


def test_of_a_batch_of_values_only_the_tracks_of_the_bad_one_fail():
    f = presets.rsrckf(MOTION, SENSOR, threshold=torch.tensor([1.0, 2.0, 3.0]))
    f.robust.threshold.raw.data[1] = torch.nan
    z, prior = tracks(f, 3)
    for g in (f, copy.deepcopy(f).compile()):
        assert (g(z, prior).failure.step >= 0).tolist() == [False, True, False]


def test_one_bad_value_of_a_batch_is_refused():
    fair, nowhere = [1 / 8] * 8, [0.0] * 6 + [0.5, 0.5]
    presets.gpb(MOTION, SENSOR, restart=[fair, fair])
    with pytest.raises(ValueError, match="restart: expected a probability above 0 at one of indices"):
        presets.gpb(MOTION, SENSOR, restart=[fair, nowhere])


def test_the_loss_of_a_filter_that_is_nan_is_nan():
    f = spoilt(learnable(presets.rsrckf(MOTION, SENSOR), ["threshold"]), "robust.threshold")
    z, prior = tracks(f)
    assert f(z, prior).mean.square().mean().isnan()
    assert f(z, prior).log_likelihood.sum().isnan()


def test_an_infinity_out_of_the_range_of_a_value_is_a_failure_and_one_within_is_not():
    f = presets.rsrckf(MOTION, SENSOR)
    z, prior = tracks(f)
    f.robust.threshold.raw.fill_(-torch.inf)
    assert f(z, prior).failure.values == ("robust.threshold",)
    f.robust.threshold.raw.fill_(torch.inf)  # a threshold of infinity is none
    torch.testing.assert_close(f(z, prior).mean, presets.srckf(MOTION, SENSOR)(z, prior).mean)


@pytest.mark.parametrize("raw", [torch.nan, -torch.inf])
def test_state_dicts_with_such_values_are_refused_and_change_nothing(raw):
    f = presets.rsrckf(MOTION, SENSOR)
    values = f.state_dict() | {"robust.threshold.raw": torch.tensor(raw).double()}
    with pytest.raises(RuntimeError, match=r"robust.threshold: expected a value above 0, received"):
        f.load_state_dict(values)
    assert f.robust.threshold() == pytest.approx(1.345)
    with pytest.raises(ValueError, match=re.escape("value: expected a value above 0, received nan")):
        f.robust.threshold.set(torch.nan)


def test_infinite_values_that_mean_something_are_loaded():
    f = presets.rsrckf(MOTION, SENSOR, threshold=torch.inf)
    other = presets.rsrckf(MOTION, SENSOR)
    other.load_state_dict(f.state_dict())
    assert other.robust.threshold() == torch.inf
    assert Hyper(torch.inf)().item() == torch.inf


def test_targets_refuse_a_filter_with_such_a_value_by_its_name():
    f = presets.jpda(MOTION, SENSOR, clutter=Clutter(1e-4, rate=1.0))
    targets = Targets(f, birth=TwoPoint(speed=10.0), confirmation=SPRT(false=1e-4), deletion=Deletion(misses=3))
    state = targets.step(targets.init(), torch.zeros(1, 2).double())
    spoilt(targets.filter, "inner.sensor.std")
    for call in (
        lambda: targets.step(state, torch.zeros(1, 2).double()),
        lambda: targets(torch.zeros(3, 1, 2).double()),
    ):
        with pytest.raises(ValueError, match=r"filter: expected hyperparameters in their range.*inner\.sensor\.std"):
            call()
