"""A sensor that is faulty is said, since when and by how much: of gpb, in a tracker, and in a table."""

import copy
import math
from dataclasses import replace

import gpb_loops as cases
import numpy as np
import pytest
import torch
from cleaned_tracks import straight
from oracles import gpb as oracle

from torchfra import Gaussian, presets
from torchfra.cleaning.outputs.table import columns
from torchfra.motion import ConstantVelocity, Odometry
from torchfra.sensors import Position, RangeBearing
from torchfra.stream import Tracker

F64 = {"dtype": torch.float64}
PRIOR = Gaussian(torch.tensor([0.0, 100, 9, 0], **F64), torch.tensor([20.0, 20, 8, 8], **F64).diag())
DT = np.array([1.0, 1, 2, 1, 1, 0.5, 1, 1, 1, 3, 1, 1, 1, 1])
CHAINS = {"outlier_transition": ((0.9, 0.1), (0.3, 0.7))}, {"outlier_durations": (30.0, 6.0)}


def close(a, b, tolerance=1e-9):
    torch.testing.assert_close(a, torch.as_tensor(b, **F64), rtol=tolerance, atol=tolerance)


def with_a_fault(make):
    """A case of the oracle whose first block is wrong from step 4 to 11; in steps 9 and 10 nothing is measured."""
    case, rng = make(), np.random.default_rng(1)
    std = np.linalg.norm(case.model.SR, axis=1)
    case.z = np.array([case.model.h(x, k) for k, x in enumerate(cases.path())])
    case.z += 0.3 * std * rng.standard_normal(case.z.shape)
    case.z[4:12, case.blocks[0]] += 40 * std[case.blocks[0]]
    case.z[9:11], case.z[2, 1] = np.nan, np.nan
    return case


@pytest.mark.parametrize("chain", CHAINS, ids=["steps", "seconds"])
@pytest.mark.parametrize("make", cases.SENSORS)
def test_alarms_are_those_of_loops_over_steps_and_blocks(make, chain):
    case, motion = with_a_fault(make), ConstantVelocity(0.5)
    options, of_oracle = cases.regimes((0.9, 0.5), (0.8, 0.2), (1.0,), ())
    options = {name: x for name, x in options.items() if not name.startswith("outlier_transition")} | chain
    f = presets.gpb(motion, case.sensor, **options)
    estimate = f(torch.as_tensor(case.z), PRIOR, dt=torch.as_tensor(DT))
    modes = oracle.OutlierModes(
        case.blocks, np.array(chain.get("outlier_transition", np.eye(2))), cases.VALUES["outlier_sizes"],
        cases.VALUES["outlier_shares"], chain.get("outlier_durations"), unreliable=cases.VALUES["unreliable"],
    )  # fmt: skip
    r = oracle.gpb(
        case.z, PRIOR.mean.numpy(), PRIOR.covariance.numpy(), [cases.carried(motion, DT)], case.model,
        of_oracle._replace(steps=DT.__getitem__), modes, 0.3, 50.0,
    )  # fmt: skip
    expected = oracle.alarms(r, case.z, case.model, case.blocks, DT, modes)
    for name, values in expected.items():
        close(getattr(estimate.info.alarm, name), values)
    assert expected["duration"][11, 0] == DT[5:12].sum()  # the fault was seen, from its first step on


def drive(steps=300, first=40, nothing=211, wrong=24):
    """A robot that measures its own way, without positions for a while, which then are 720 to 840 m off."""
    rng = torch.Generator().manual_seed(4)
    truth = torch.stack([1.5 * torch.arange(1, steps + 1, **F64), torch.zeros(steps, **F64)], -1)
    z = truth + 3 * torch.randn(steps, 2, generator=rng, **F64)
    u = torch.tensor([1.5, 0.0], **F64) + 0.02 * torch.randn(steps, 2, generator=rng, **F64)
    z[first : first + nothing] = math.nan
    without = z.clone()
    fault = slice(first + nothing, first + nothing + wrong)
    z[fault, 1] += torch.linspace(720, 840, wrong, **F64)
    without[fault] = math.nan
    return truth, z, without, u, fault


@pytest.mark.slow
def test_positions_that_are_hundreds_of_metres_off_after_a_long_gap_raise_the_alarm_at_once_and_do_no_harm():
    truth, z, without, u, fault = drive()
    f = presets.gpb(Odometry(1e-2, 1e-6, 1e-7), Position(3.0), burst=60)
    prior = Gaussian(torch.zeros(4, **F64), torch.tensor([1.0, 1.0, 0.05, 0.02], **F64).diag())
    both = f(torch.stack([z, without]), prior, u=u)
    off, usual = (both.mean[..., :2] - truth).norm(dim=-1)
    alarm = both.info.alarm
    assert (off - usual).max() < 20
    assert (alarm.probability[0, fault] > 0.5).all()
    assert (alarm.probability[:, : fault.start] > 0.5).sum() == 0
    close(alarm.duration[0, fault.stop - 1], [23.0])
    close(alarm.offset[0, fault, 1], torch.linspace(720, 840, 24, **F64), tolerance=0.05)


@pytest.mark.slow
def test_a_step_has_the_alarm_that_a_whole_track_has_and_compiled_too():
    case = with_a_fault(cases.position)
    f = presets.gpb(ConstantVelocity(0.5), case.sensor, **CHAINS[0])
    expected, z = f(torch.as_tensor(case.z), PRIOR, dt=torch.as_tensor(DT)).info.alarm, torch.as_tensor(case.z)
    for g in (f, copy.deepcopy(f).compile()):
        for a, b in zip(g(z, PRIOR, dt=torch.as_tensor(DT)).info.alarm, expected, strict=True):
            close(a, b)
        state = g.init(PRIOR)
        for k, dt in enumerate(DT):
            state, innovation = g.step(state, z[k], dt=float(dt))
            for a, b in zip(innovation.alarm, expected, strict=True):
                close(a, b[k])


def test_a_filter_without_outliers_has_no_alarm():
    f = presets.srckf(ConstantVelocity(0.5), Position(1.0))
    _, innovation = f.step(f.init(PRIOR), torch.tensor([1.0, 2.0], **F64))
    assert innovation.alarm is None


GPS, RADAR = Position(2.0), RangeBearing(torch.tensor([3.0, 0.02], **F64))


def tracker(**options):
    f = presets.gpb(ConstantVelocity(0.01), GPS, manoeuvres="none", **CHAINS[0])
    return Tracker(f, PRIOR, sensors={"gps": GPS, "radar": RADAR}, lag=5.0, **options)


def events(count=12):
    """Positions that are right, and in between ranges and bearings that are wrong from 6.5 s on."""
    for k in range(1, count):
        x, y = 9.0 * k, 100.0
        yield k, [x, y], "gps"
        wrong = 300.0 if k > 5 else 0.0
        yield k + 0.5, [math.hypot(x + 4.5, y) + wrong, math.atan2(x + 4.5, y)], "radar"


def fed(t, every):
    for event in every:
        report = t.update(*event)
    return report


def test_a_tracker_says_which_of_its_sensors_is_faulty_since_when_and_by_how_much():
    t = tracker()
    report = fed(t, events())
    assert all(map(torch.equal, report.alarm, t.alarms["radar"]))
    assert t.alarms["radar"].probability > 0.99
    close(t.alarms["radar"].duration, [5.0])
    close(t.alarms["radar"].offset, [300.0, 0.0], tolerance=0.02)
    assert t.alarms["gps"].probability < 0.1
    close(t.alarms["gps"].duration, [0.0])


def test_a_tracker_keeps_an_alarm_while_its_sensor_measures_nothing_and_others_do():
    t = tracker()
    fed(t, events())
    t.update(12.0, [108.0, 100.0], "gps")
    t.update(12.5, [math.nan, math.nan], "radar")
    close(t.alarms["radar"].duration, [6.0])
    close(t.alarms["radar"].offset, [300.0, 0.0], tolerance=0.02)


def test_late_measurements_raise_the_alarms_that_they_would_have_raised():
    every, one, other = list(events()), tracker(), tracker()
    fed(one, every)
    fed(other, [*every[:-3], *every[:-4:-1]])
    for a, b in zip(one.alarms["radar"], other.alarms["radar"], strict=True):
        close(a, b)


def test_a_tracker_that_was_saved_has_its_alarms():
    t, again = tracker(), tracker()
    fed(t, events())
    again.load_state_dict(t.state_dict())
    for name, alarm in t.alarms.items():
        assert all(map(torch.equal, alarm, again.alarms[name]))


def test_a_filter_without_outliers_has_no_alarms():
    t = Tracker(presets.srckf(ConstantVelocity(0.01), GPS), PRIOR)
    assert t.update(1.0, [9.0, 100.0]).alarm is None
    assert t.alarms == {}


def test_a_table_says_how_far_off_fixes_are():
    of = straight(12, rejected=(3, 4, 6, 9))
    raw, row = of.raw.copy(), of.row.copy()
    raw[5], row[5] = np.nan, -1  # a step between fixes
    table = columns(replace(of, raw=raw, row=row))
    np.testing.assert_allclose(table["residual"], np.linalg.norm(raw - of.position, axis=1))
