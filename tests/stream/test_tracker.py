"""A track in a loop: measurements in any order, twice, not at all, and by clocks that jump."""

import io
import math
import random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra import Gaussian, presets, sensors
from torchfra.motion import Augmented, ConstantVelocity, CoordinatedTurn, RandomWalk, Spherical, aircraft
from torchfra.sensors import Biased, Position, RangeBearing, Ranges, Stacked
from torchfra.sensors.base import Sensor
from torchfra.stream import Tracker
from torchfra.stream.tracker import OUTCOMES

F64 = {"dtype": torch.float64}
GPS, RADAR = Position(2.0), RangeBearing(torch.tensor([3.0, 0.02], **F64))
SENSORS = {"gps": GPS, "radar": RADAR}


def made(name="srckf", **options):
    motion = aircraft(continuous=True) if "imm" in name else ConstantVelocity(1.0)
    return getattr(presets, name)(motion, GPS, **options)


def prior_of(f, *batch):
    n = f.motion.size
    mean = torch.tensor([100.0, 80.0] + [0.0] * (n - 2), **F64)
    return Gaussian(mean.expand(*batch, n), 8 * torch.eye(n, **F64))


def tracker(f, *batch, **options):
    return Tracker(f, prior_of(f, *batch), **{"sensors": SENSORS, "lag": 3.0} | options)


def events(seed=0, count=12):
    """Times, measurements and sensors, in order (at one instant too); some with a missing element."""
    rng, time, every = random.Random(seed), 0.0, []
    for k in range(count):
        time += rng.choice([0.0, 0.3, 0.9]) * rng.random()
        if rng.random() < 0.5:
            every.append((time, [100 + 3 * time + rng.gauss(0, 2), 80 + rng.gauss(0, 2)], "gps"))
        else:
            away, bearing = math.hypot(100 + 3 * time, 80.0), math.atan2(100 + 3 * time, 80.0)
            z = [away + rng.gauss(0, 3), bearing + rng.gauss(0, 0.02)]
            every.append((time, [z[0], math.nan] if k % 5 == 4 else z, "radar"))
    return sorted(every, key=lambda event: (event[0], event[2], event[1][0]))


def fed(t, every):
    for event in every:
        report = t.update(*event)
    return report


def close(a, b, tolerance=1e-12):
    torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)


FILTERS = {name: made(name) for name in ("srckf", "rsrckf", "asrckf", "fra", "gpb", "imm_srckf")}


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
@settings(deadline=None, max_examples=2)
@given(seed=st.integers(0, 1000), delay=st.floats(0.5, 2.9))
def test_late_data_is_sorted_data(name, seed, delay):
    f, every, rng = FILTERS[name], events(seed), random.Random(seed)
    late = sorted(every, key=lambda event: event[0] + delay * rng.random())
    one, other = tracker(f), tracker(f)
    first, second = fed(one, every), fed(other, late)
    close(one.belief, other.belief)
    close(first.belief, second.belief)
    close(one.predict(one.time + 1.0, "radar"), other.predict(other.time + 1.0, "radar"))
    assert one.time == other.time == every[-1][0]
    if one.lagged is not None:
        close(one.lagged.belief, other.lagged.belief)


def test_in_turn_it_is_the_filter():
    f, every = made("gpb"), events()
    t, state, time = tracker(f), f.init(prior_of(f)), 0.0
    for when, z, name in every:
        report = t.update(when, z, name)
        state, innovation = f.step(state, torch.tensor(z, **F64), dt=when - time, sensor=SENSORS[name])
        close(report.belief, state.belief)
        close(report.innovation, innovation)
        close(t.lagged.belief, state.lagged)
        assert report.outcome == "used"
        time = when
    assert tracker(made()).lagged is None


def test_a_late_measurement_says_what_it_would_have_said():
    every, t = events(3), tracker(made())
    reports = [t.update(*event) for event in every]
    again = tracker(made())
    fed(again, every[:6] + every[7:])
    report = again.update(*every[6])
    assert report.outcome == "late"
    assert report.time == every[-1][0]
    close(report.innovation, reports[6].innovation)


def test_what_is_older_than_the_lag_is_refused_or_counted():
    every = events(1, 30)
    t = tracker(made(), lag=1.0)
    fed(t, every)
    before, counts = t.belief, t.counts
    with pytest.raises(ValueError, match=r"time: expected seconds since .*, received 0\.1"):
        t.update(0.1, [0.0, 0.0], "gps")
    assert t.counts == counts
    lenient = tracker(made(), lag=1.0, old="count")
    fed(lenient, every)
    report = lenient.update(0.1, [0.0, 0.0], "gps")
    assert (report.outcome, report.innovation, lenient.counts["old"]) == ("old", None, 1)
    close(report.belief, before)
    assert tracker(made(), old="count").update(-1.0, [0.0, 0.0], "gps").outcome == "old"  # before the prior


def test_a_bound_on_steps_is_a_lag_in_measurements():
    every = [(0.5 * k, [100.0 + k, 80.0], "gps") for k in range(12)]
    t = tracker(made(), lag=math.inf, steps=4, old="count")
    fed(t, every)
    assert t.update(3.4, [104.0, 80.0], "gps").outcome == "old"
    assert t.update(3.9, [104.0, 80.0], "gps").outcome == "late"
    assert t.counts == {"used": 12, "late": 1, "duplicate": 0, "old": 1, "jumped": 0}


def test_a_duplicate_is_left_out_and_counted():
    every, t, once = events(2), tracker(made()), tracker(made())
    fed(once, every)
    for event in every:
        t.update(*event)
        report = t.update(*event)
        assert (report.outcome, report.innovation) == ("duplicate", None)
    close(t.belief, once.belief)
    assert t.counts["duplicate"] == len(every)
    last = every[-1]
    assert t.update(last[0], [last[1][0] + 1.0, last[1][1]], last[2]).outcome == "used"
    assert t.update(*last, std=[1.0, 1.0]).outcome == "used"  # the noise is another


def test_a_clock_that_is_set_back_goes_on():
    f = made("fra")
    t, steady = tracker(f, jump=60.0), tracker(f)
    for k in range(8):
        t.update(1000.0 + 0.5 * k, [100.0 + k, 80.0], "gps")
        steady.update(1000.0 + 0.5 * k, [100.0 + k, 80.0], "gps")
    assert t.update(7.0, [108.0, 80.0], "gps").outcome == "jumped"
    steady.update(1004.0, [108.0, 80.0], "gps")
    for k in (2, 1, 3):  # one comes late, by the new clock
        t.update(7.0 + 0.5 * k, [108.0 + k, 80.0], "gps")
        steady.update(1004.0 + 0.5 * k, [108.0 + k, 80.0], "gps")
    close(t.belief, steady.belief)
    assert t.time == 8.5
    assert (t.counts["jumped"], t.counts["late"]) == (1, 1)
    close(t.predict(9.0, "gps").belief, steady.predict(1006.0, "gps").belief)


def test_what_comes_late_by_the_clock_before_it_was_set_back_belongs_before_that():
    f, every = made(), [(1000.0, 100.0), (1001.0, 101.0), (1002.0, 102.0), (5.0, 103.0), (6.0, 104.0), (1001.5, 101.5)]
    t, steady = tracker(f, jump=60.0), tracker(f)
    for time, x in every:
        report = t.update(time, [x, 80.0], "gps")
        steady.update(time if time > 100 else time + 998.0, [x, 80.0], "gps")
    assert (report.outcome, t.time) == ("late", 6.0)
    close(t.belief, steady.belief)
    again = tracker(f, jump=60.0)
    again.load_state_dict(t.state_dict())
    assert again.update(1001.7, [101.7, 80.0], "gps").outcome == "late"
    with pytest.raises(ValueError, match=r"time: expected seconds since 3\.0, received 990\.0"):
        t.update(990.0, [0.0, 0.0], "gps")
    assert t.update(70.0, [168.0, 80.0], "gps").outcome == "used"


def test_steps_keep_all_of_the_newest_instant():
    t = tracker(made(), steps=1, sensors={"gps": GPS, "radar": RADAR, "other": Position(5.0)})
    for name, z in (("radar", [128.0, 0.9]), ("other", [101.0, 80.0]), ("gps", [102.0, 80.0])):
        assert t.update(1.0, z, name).outcome == "used"
    t.update(2.0, [101.0, 80.0], "gps")
    with pytest.raises(ValueError, match=r"time: expected seconds after 1\.0, received 1\.0"):
        t.update(1.0, [103.0, 80.0], "gps")


def test_what_is_missing_is_only_predicted():
    t = tracker(made())
    t.update(1.0, [101.0, 80.0], "gps")
    expected = t.predict(2.0, "gps").belief
    close(t.update(2.0, [math.nan, math.nan], "gps").belief, expected)


@pytest.mark.parametrize("name", ["srckf", "fra", "gpb", "imm_srckf"])
def test_saved_and_loaded_it_goes_on_to_the_same_bits(name, tmp_path):
    f, every = made(name), events(5, 20)
    t = tracker(f, jump=1e3, time=-0.5)
    fed(t, every[:9] + every[10:12])
    torch.save(t.state_dict(), tmp_path / "track.pt")
    again = tracker(f, jump=1e3, time=-0.5)
    again.load_state_dict(torch.load(tmp_path / "track.pt", weights_only=True))
    for event in [every[9], *every[12:]]:
        one, other = t.update(*event), again.update(*event)
        assert one.outcome == other.outcome
        assert all(torch.equal(a, b) for a, b in zip(one.belief, other.belief, strict=True))
        torch.testing.assert_close(one.innovation, other.innovation, rtol=0, atol=0)
    assert t.counts == again.counts
    assert t.time == again.time


def test_a_track_of_another_filter_is_not_loaded():
    t = tracker(made("gpb"))
    for other, message in (
        (tracker(made("fra")), "values: expected filter 'FRA', received 'GPB'"),
        (Tracker(made("gpb"), prior_of(made("gpb"))), r"values: expected sensors \['sensor'\]"),
        (tracker(made("gpb"), origin=[1.0, 2.0]), "values: expected origin"),
        (tracker(made("gpb"), 3), "values: expected states of"),
    ):
        with pytest.raises(ValueError, match=message):
            other.load_state_dict(t.state_dict())
    with pytest.raises(ValueError, match="values: expected format 1, received None"):
        t.load_state_dict({})


def test_a_track_of_other_models_or_sensors_is_not_loaded():
    t = tracker(made())
    for other, message in (
        (tracker(made("rsrckf")), r"values: expected filter.robust 'Huber\(\)', received None"),
        (tracker(presets.srckf(ConstantVelocity(9.0), GPS)), r"values: expected filter.motion.q 'Hyper\(9,"),
        (
            tracker(presets.srckf(ConstantVelocity(1.0, continuous=True), GPS)),
            r"values: expected filter.motion .*=True",
        ),
        (tracker(presets.srckf(CoordinatedTurn(0.1, 1.0), GPS)), r"values: expected filter.motion 'CoordinatedTurn"),
        (tracker(made(), sensors={"gps": RADAR, "radar": GPS}), r"values: expected sensor gps 'RangeBearing"),
    ):
        with pytest.raises(ValueError, match=message):
            other.load_state_dict(t.state_dict())


@pytest.mark.parametrize("missing", ["entries", "clock", "counts", "time"])
def test_what_is_not_all_there_leaves_the_track_as_it_was(missing):
    t, other = tracker(made()), tracker(made())
    fed(t, events())
    values = {name: x for name, x in t.state_dict().items() if name != missing}
    with pytest.raises(ValueError, match=f"values: expected all entries of state_dict, received none of '{missing}'"):
        other.load_state_dict(values)
    assert (other.time, other.counts["used"]) == (0.0, 0)
    close(other.belief, tracker(made()).belief)


@pytest.mark.parametrize(("changed", "said"), [
    ({"time": math.nan}, "time: expected finite seconds"),
    ({"state": [1.0]}, "expected what state_dict gives"),
    ({"clock": {"behind": "1", "before": 0.0, "back": 0.0, "gap": 0.0}}, "expected what state_dict gives"),
    ({"counts": dict.fromkeys(OUTCOMES, 0.5)}, "expected what state_dict gives"),
    ({"failure": (1,)}, "expected what state_dict gives"),
    ({"failure": (torch.zeros(3), torch.zeros(3))}, "expected a failure of streams"),
    ({"sensor": 2}, "sensor: expected the number of one of"),
    ({"z": torch.zeros(3).double()}, r"z: expected \(\.\.\., 2\)"),
    ({"std": torch.zeros(4, 2).double()}, "std: expected 1 dimension"),
    ({"noise": object}, "expected what state_dict gives"),
])  # fmt: skip
def test_what_is_of_another_form_is_refused_and_leaves_the_track_as_it_was(changed, said):
    t, other = tracker(made()), tracker(made())
    fed(t, events())
    values = t.state_dict()
    if {*changed} <= {*values}:
        values |= changed
    else:
        values["entries"][-1] |= changed
    with pytest.raises(ValueError, match=f"values: {said}"):
        other.load_state_dict(values)
    assert (other.time, other.counts["used"], other.failure) == (0.0, 0, None)


def test_several_streams_go_side_by_side():
    f, every = made("rsrckf"), [event for event in events(7) if event[2] == "gps"]
    side_by_side, apart = tracker(f, 3), [tracker(f) for _ in range(3)]
    for time, z, name in every:
        each = [[z[0] + 2 * k, z[1]] for k in range(3)]
        belief = side_by_side.update(time, each, name).belief
        for k, t in enumerate(apart):
            close(t.update(time, each[k], name).belief, Gaussian(*(x[k] for x in belief)), 1e-10)


@pytest.mark.parametrize("name", ["srckf", "fra", "imm_srckf"])
def test_what_is_kept_is_smoothed_by_all_of_it(name):
    f, every = made(name), events(4, 10)
    t = tracker(f, lag=math.inf)
    assert t.smoothed() == []
    fed(t, every[:4] + every[5:] + every[4:5])
    told = t.smoothed()
    z = torch.tensor([event[1] for event in every], **F64)
    times = torch.tensor([0.0] + [event[0] for event in every], **F64)
    which = [list(SENSORS).index(event[2]) for event in every]
    whole = f.smooth(z, prior_of(f), dt=times.diff(), sensors=list(SENSORS.values()), which=which, lag=len(every))
    assert [at.time for at in told] == [event[0] for event in every]
    close(torch.stack([at.belief.mean for at in told]), whole.mean, 1e-9)


def test_compiled_it_is_the_same():
    every, f = events(6), made().compile()
    one, other = tracker(made()), tracker(f)
    fed(one, every)
    fed(other, every[:7] + every[8:] + every[7:8])
    close(one.belief, other.belief, 1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "away"), [("srckf", 1e3), ("srckf", 1e5), ("gpb", 1e5)])
def test_with_an_origin_single_precision_keeps_a_metre_at_six_million(name, away):
    origin, rng = torch.tensor([6.0e6, -2.2e6, 1.1e6], **F64), torch.Generator().manual_seed(1)
    f = getattr(presets, name)(ConstantVelocity(0.5, dims=3), Position(1.0, dims=3))
    start, speed = origin + away, torch.tensor([12.0, -7.0, 3.0], **F64)
    root = torch.tensor([10.0, 10.0, 10.0, 20.0, 20.0, 20.0], **F64).diag()
    prior = Gaussian(torch.cat([start, 0 * start]), root)
    double, single = Tracker(f, prior), Tracker(f, prior, origin=origin, dtype=torch.float32)
    plain = Tracker(f, prior, dtype=torch.float32)
    apart = lost = 0.0
    for k in range(1, 31):
        z = start + 0.7 * k * speed + torch.randn(3, generator=rng, **F64)
        exact, local, far = (t.update(0.7 * k, z).belief.mean[:3].double() for t in (double, single, plain))
        apart, lost = max(apart, float((local - exact).norm())), max(lost, float((far - exact).norm()))
    assert single.state.belief.mean.dtype == torch.float32
    assert single.belief.mean.dtype == torch.float64
    limits = {("srckf", 1e3): 0.002, ("srckf", 1e5): 0.02, ("gpb", 1e5): 0.1}
    assert apart < limits[name, away]
    assert lost > 5 * limits[name, away]
    forecast, expected = single.predict(45.0), double.predict(45.0)
    close(forecast.belief.mean[:3], expected.belief.mean[:3], 0.5 * limits[name, away])
    close(forecast.measurement.mean, expected.measurement.mean, 0.5 * limits[name, away])


def test_what_cannot_be_smoothed_says_so_before_another_sensor_has_measured():
    t = tracker(made("gpb"))
    t.update(1.0, [101.0, 80.0], "gps")
    with pytest.raises(NotImplementedError, match="of one sensor in the backward pass"):
        t.smoothed()


def test_a_state_is_predicted_without_a_sensor():
    t = tracker(made(), sensors={"radar": RADAR, "other": Position(5.0)})
    close(t.predict(2.0).belief, t.predict(2.0, "radar").belief)
    close(t.predict(2.0).measurement, tracker(made()).predict(2.0, "gps").measurement)


@pytest.mark.parametrize("lag", [np.float32(2.0), torch.tensor(2.0), 2])
def test_numbers_of_any_kind_are_numbers(lag):
    t = tracker(made(), lag=lag, steps=np.int64(3), jump=np.float64(60.0))
    for time in (1.0, 2.0, np.float32(3.0), torch.tensor(2.5)):
        t.update(time, [100.0, 80.0], "gps")
    assert (t.time, t.lag, t.counts["late"]) == (3.0, 2.0, 1)


BAD = [
    ({"filter": "gpb"}, "filter: expected one of single tracks, such as presets.gpb, received str"),
    ({"prior": None}, "prior: expected a Gaussian"),
    ({"time": math.nan}, "time: expected finite seconds, received nan"),
    ({"sensors": {}}, "sensors: expected one or more by name"),
    ({"sensors": [GPS]}, "sensors: expected one or more by name"),
    ({"sensors": {"far": Position(1.0, dims=3)}}, "sensor: expected one of at most 2 dimensions"),
    ({"lag": -1.0}, "lag: expected seconds of 0 or more"),
    ({"lag": "long"}, "lag: expected seconds of 0 or more, received 'long'"),
    ({"steps": 0}, "steps: expected 1 or more measurements"),
    ({"steps": 2.5}, "steps: expected 1 or more measurements"),
    ({"dtype": "float32"}, r"dtype: expected one of \(torch.float32, torch.float64\)"),
    ({"old": "drop"}, r"old: expected one of \('refuse', 'count'\)"),
    ({"jump": 2.0}, r"jump: expected seconds above the lag of 3\.0"),
    ({"origin": [1.0, 2.0, 3.0]}, r"origin: expected a finite position \(2,\)"),
    ({"origin": "here"}, "origin: expected numbers, received 'here'"),
    ({"origin": [1.0, math.inf]}, r"origin: expected a finite position \(2,\)"),
]


@pytest.mark.parametrize(("wrong", "message"), BAD)
def test_what_a_tracker_cannot_be_made_of_is_named(wrong, message):
    f = made()
    right = {"filter": f, "prior": prior_of(f), "sensors": SENSORS, "lag": 3.0}
    with pytest.raises(ValueError, match=message):
        Tracker(**right | wrong)


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ((math.inf, [1.0, 2.0], "gps"), "time: expected finite seconds, received inf"),
        (("noon", [1.0, 2.0], "gps"), "time: expected finite seconds, received 'noon'"),
        ((1.0, [1.0, 2.0]), r"sensor: expected one of \['gps', 'radar'\], received None"),
        ((1.0, [1.0, 2.0], "sonar"), r"sensor: expected one of \['gps', 'radar'\], received 'sonar'"),
        ((1.0, [1.0, 2.0, 3.0], "gps"), r"z: expected \(..., 2\), received \(3,\)"),
        ((1.0, "here", "gps"), "z: expected numbers, received 'here'"),
        ((1.0, [[1.0, 2.0]] * 3, "gps"), r"z: expected 1 dimension behind the prior's batch \(\), received \(3, 2\)"),
        ((1.0, [math.inf, 2.0], "gps"), "z: expected finite numbers, or NaN for what is missing"),
        ((1.0, np.array([1.0, 2.0j]), "gps"), "z: expected real numbers, received complex128"),
        ((1.0, [1.0, 2.0], "gps", {"u": [math.nan]}), "u: expected finite numbers"),
        ((1.0, [1.0, 2.0], "gps", {"u": 3.0}), "u: expected 1 dimension"),
        ((1.0, [1.0, 2.0], "gps", {"noise": [1.0, 1.0]}), "noise: expected 2 dimensions"),
    ],
)
def test_a_measurement_that_does_not_fit_leaves_the_track_as_it_was(event, message):
    t = tracker(made())
    t.update(0.5, [100.0, 80.0], "gps")
    before = io.BytesIO(), io.BytesIO()
    torch.save(t.state_dict(), before[0])
    with pytest.raises(ValueError, match=message):
        t.update(*event[:3], **dict(*event[3:]))
    torch.save(t.state_dict(), before[1])
    assert before[0].getvalue() == before[1].getvalue()
    with pytest.raises(ValueError, match="time: expected seconds since"):
        t.predict(-1.0, "gps")


class Undeclared(Sensor):
    """A position that does not say that it is linear, and a speed."""

    def __init__(self):
        super().__init__(4, [False] * 3, 1.0)

    def forward(self, x, u=None):
        """Both."""
        return torch.cat([x[..., :2], torch.linalg.vector_norm(x[..., 2:4], dim=-1, keepdim=True)], -1)


@pytest.mark.parametrize(
    ("sensor", "z"),
    [
        (Undeclared(), [6e6 + 3.0, 2e6 + 4.0, 5.0]),
        (Stacked(GPS, RADAR, Ranges([[-1e5, 0.0]], 1.0)), [6e6 + 3.0, 2e6 + 4.0, 5.0, 0.6435, 1e5 + 3.0]),
        (Biased(GPS, 4), [6e6 + 8.0, 2e6 + 9.0]),
    ],
)
def test_an_origin_is_taken_off_what_moves_along_with_the_target(sensor, z):
    motion = Augmented(ConstantVelocity(1.0), RandomWalk(1.0, 1, kind="bias"))
    f, origin = presets.srckf(motion, sensor), torch.tensor([6e6, 2e6], **F64)
    there = torch.cat([origin, torch.zeros(3, **F64)]) + torch.tensor([3.0, 4.0, 3.0, 4.0, 5.0], **F64)
    t = Tracker(f, Gaussian(there, torch.eye(5, **F64)), origin=origin, dtype=torch.float32)
    report = t.update(0.0, z)
    close(report.belief.mean, there, 1.0)
    assert report.innovation.residual.abs().max() < 0.5
    close(t.predict(0.0).measurement.mean, torch.tensor(z, **F64), 1.0)


def test_a_motion_that_depends_on_where_it_is_has_no_origin():
    f = presets.srckf(Spherical(ConstantVelocity(1.0, 3)), sensors.InfraredLaser(1.0))
    prior = Gaussian(torch.ones(f.motion.size, **F64), torch.eye(f.motion.size, **F64))
    with pytest.raises(ValueError, match="origin: expected a motion that is the same everywhere"):
        Tracker(f, prior, origin=[1.0] * 3)


@pytest.mark.parametrize("origin", [None, [10.0, 20.0]])
def test_a_buffer_that_is_written_anew_does_not_change_the_track(origin):
    f = made()
    once, prior = tracker(f, origin=origin), prior_of(f)
    t = Tracker(f, prior, sensors=SENSORS, lag=3.0, origin=origin)
    _ = [x.zero_() for x in (prior.mean, prior.scale_tril)]
    z, std = np.empty(2), torch.empty(2, **F64)
    for k in (1, 3, 2):  # one comes late
        z[:], std[:] = [100.0 + k, 80.0], torch.full((2,), float(k))
        report = t.update(k, z, "gps", std=std)
        _ = [x.zero_() for x in report.belief]
        once.update(k, [100.0 + k, 80.0], "gps", std=[float(k)] * 2)
    close(t.belief, once.belief, 0)


def test_what_a_compiled_filter_reports_is_the_callers_own():
    f, every = made().compile(), [event for event in events(8) if event[2] == "gps"]
    t, once = tracker(f), tracker(f)
    for event in every[:3] + every[4:] + every[3:4]:  # one comes late
        _ = [x.zero_() for x in t.update(*event).belief]
        once.update(*event)
    close(t.belief, once.belief, 0)


KINDS = [(101.0, 80.0), [101, 80.0], [np.float64(101.0), 80.0], np.array([101, 80]), torch.tensor([101.0, 80.0])]


@pytest.mark.parametrize("z", KINDS, ids=["floats", "whole", "of NumPy", "array", "tensor"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_measurement_is_the_same_in_numbers_of_any_kind(z, dtype):
    one, other = tracker(made(), dtype=dtype), tracker(made(), dtype=dtype)
    one.update(1.0, [101.0, 80.0], "gps")
    other.update(1.0, z, "gps")
    torch.testing.assert_close(other.belief, one.belief, rtol=0, atol=0)


@pytest.mark.parametrize("batch", [(), (2,)])
def test_a_number_beyond_single_precision_is_refused_there(batch):
    t, z = tracker(made(), *batch, dtype=torch.float32), [1e300, 80.0]
    with pytest.raises(ValueError, match=r"z: expected finite numbers, or NaN for what is missing, in torch.float32"):
        t.update(1.0, [z, z] if batch else z, "gps")


def test_a_standard_deviation_that_is_a_number_is_that_of_each_element():
    one, other = tracker(made()), tracker(made())
    one.update(1.0, [101.0, 80.0], "gps", std=3.0)
    other.update(1.0, [101.0, 80.0], "gps", std=[3.0, 3.0])
    close(one.belief, other.belief)


def test_at_one_instant_the_order_is_not_that_in_which_measurements_come():
    f, tied = made(), [
        (1.0, [101.0, 80.0], "gps", [1.0, 2.0]),
        (1.0, [101.0, 80.0], "gps", [4.0, 1.0]),
        (1.0, [103.0, 81.0], "gps", None),
        (1.0, [130.0, 0.9], "radar", None),
    ]  # fmt: skip
    beliefs = []
    for order in (tied, tied[::-1]):
        t = tracker(f)
        for time, z, name, std in order:
            t.update(time, z, name, std=std)
        beliefs.append(t.belief)
    torch.testing.assert_close(*beliefs, rtol=0, atol=0)
