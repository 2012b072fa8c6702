"""A single step that fails says so, a stream says when and why, and begins again."""

import pytest
import torch
from short_tracks import SMALL_GPB

from torchfra import Cause, Gaussian, presets
from torchfra.motion import ConstantVelocity, Odometry
from torchfra.sensors import Position
from torchfra.stream import Tracker
from torchfra.types import Estimate

PRIOR = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
NAN = Gaussian(torch.full((4,), torch.nan).double(), PRIOR.scale_tril)
Z = torch.randn(8, 2, generator=torch.Generator().manual_seed(0)).double()


class Carried(Position):
    """Measures relative to a ship at ``u``."""

    def forward(self, x, u=None):
        return super().forward(x) - u


def made(name="srckf", sensor=None, compiled=False):
    few = SMALL_GPB if name == "gpb" else {}  # for the compiler's time
    f = getattr(presets, name)(ConstantVelocity(1.0), Position(2.0) if sensor is None else sensor, **few)
    return f.compile() if compiled else f


@pytest.mark.parametrize("compiled", [False, True])
def test_the_state_of_a_step_says_which_tracks_have_failed(compiled):
    f, u = made(sensor=Carried(2.0), compiled=compiled), torch.zeros(3, 2).double()
    u[1] = torch.nan
    state, _ = f.step(f.init(Gaussian(PRIOR.mean.expand(3, 4), PRIOR.scale_tril)), Z[:3], u=u)
    assert state.belief.failed.tolist() == [False, True, False]


def test_a_step_without_a_measurement_whose_motion_needs_what_is_nan_has_failed():
    f = presets.srckf(Odometry(1e-2, 1e-6, 1e-7), Position(2.0))
    n = f.motion.size
    prior = Gaussian(torch.zeros(n).double(), torch.eye(n).double())
    missing, u = torch.full((2,), torch.nan).double(), torch.full((2,), torch.nan).double()
    assert f.step(f.init(prior), missing, u=u)[0].belief.failed


@pytest.mark.parametrize("name", ["srckf", "fra", "gpb", "alphabeta"])
@pytest.mark.parametrize("compiled", [False, True])
def test_a_tracker_says_when_it_has_failed_and_why_and_begins_again(name, compiled):
    f = made(name, compiled=compiled)
    tracker, sound = Tracker(f, NAN), Tracker(f, PRIOR, time=3.0)
    assert tracker.failure is None
    for k in range(3):
        report = tracker.update(k + 1.0, Z[k])
    assert report.failure.describe() == tracker.failure.describe() == ["track (): prior, step 0"]
    tracker.restart(PRIOR)
    assert tracker.failure is None
    for k in range(3, 6):
        report, expected = tracker.update(k + 1.0, Z[k]), sound.update(k + 1.0, Z[k])
        assert report.failure is None
        assert torch.equal(report.belief.mean, expected.belief.mean)


def test_only_streams_that_have_failed_begin_again_and_a_saved_track_remembers_its_failure():
    f = made()
    tracker = Tracker(f, Gaussian(torch.stack([PRIOR.mean, NAN.mean]), PRIOR.scale_tril))
    tracker.update(1.0, Z[:2])
    other = Tracker(f, Gaussian(PRIOR.mean.expand(2, 4), PRIOR.scale_tril))
    other.load_state_dict(tracker.state_dict())
    assert other.failure.cause.tolist() == [Cause.NONE, Cause.PRIOR]
    kept = tracker.belief.mean[0]
    tracker.restart(Gaussian(PRIOR.mean.expand(2, 4) + 1, PRIOR.scale_tril), which=tracker.failure.step >= 0)
    assert tracker.failure is None
    assert torch.equal(tracker.belief.mean, torch.stack([kept, PRIOR.mean + 1]))
    assert not tracker.update(2.0, Z[2:4]).belief.failed.any()
    with pytest.raises(ValueError, match=r"prior: expected one of streams \(2,\), received \(\)"):
        tracker.restart(PRIOR)


def test_a_stream_that_fails_later_keeps_its_first_cause():
    f = made(sensor=Carried(2.0))
    tracker = Tracker(f, PRIOR)
    tracker.update(1.0, Z[0], u=[0.0, 0.0])
    f.motion.q.raw.data.fill_(torch.nan)
    for k in (2, 3):
        report = tracker.update(float(k), Z[k], u=[0.0, 0.0])
    assert report.failure.describe() == ["track (): value motion.q, step 1"]


@pytest.mark.parametrize(("name", "compiled", "lag"), [
    *(("srckf", compiled, lag) for compiled in (False, True) for lag in (None, 2)),
    *((name, compiled, lag) for name in ("fra", "gpb") for compiled, lag in ((True, None), (False, 2))),
])  # fmt: skip
def test_the_failure_of_a_smoothed_estimate_is_that_of_the_filtered_one(name, compiled, lag):
    f = made(name, compiled=compiled)
    z = Z.repeat(3, 1, 1)
    z[1, 4, 0] = torch.inf
    prior = Gaussian(torch.stack([PRIOR.mean, PRIOR.mean, NAN.mean]), PRIOR.scale_tril)
    filtered, smoothed = f(z, prior), f.smooth(z, prior, lag=lag)
    again = f.smooth(z, prior, estimate=f(z, prior, past=True), lag=lag)
    assert filtered.failure.cause.tolist() == [Cause.NONE, Cause.MEASUREMENT, Cause.PRIOR]
    for one in (smoothed, again, f.smooth(z, prior, estimate=Estimate(*filtered[:5]), lag=lag)):
        assert torch.equal(one.failure.step, filtered.failure.step)
        assert torch.equal(one.failure.cause, filtered.failure.cause)
