"""Odometry as robots have it: in their own axes, at its own times, with sensors that turn with them."""

import math

import numpy as np
import pytest
import torch

from torchfra import Gaussian, check_model, learnable, presets
from torchfra.motion import Augmented, BodyOdometry, RandomWalk, body_velocities
from torchfra.sensors import Mounted, Position, RangeBearing, Ranges
from torchfra.stream import merge

ROBOT = BodyOdometry(along=4e-3, across=1e-3, heading=1e-4, turn=1e-3, longest=2.0)
U = torch.tensor([[1.0, 0.2, 0.3], [0.5, -0.3, -1.2], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]]).double()


def driven(x, dt, u, steps=20000):
    """Where small straight steps lead, midpoint by midpoint."""
    px, py, heading = x
    for _ in range(steps):
        middle = heading + u[2] * dt / steps / 2
        px += (u[0] * math.cos(middle) - u[1] * math.sin(middle)) * dt / steps
        py += (u[0] * math.sin(middle) + u[1] * math.cos(middle)) * dt / steps
        heading += u[2] * dt / steps
    return [px, py, heading]


# ---------------------------------------------------------------- the motion


@pytest.mark.parametrize("u", U.tolist())
def test_velocities_in_the_robots_axes_make_the_arc_of_small_straight_steps(u):
    start = [1.0, 2.0, 0.7]
    got = ROBOT(torch.tensor(start).double(), torch.tensor(1.5).double(), torch.tensor(u).double())
    np.testing.assert_allclose(got, driven(start, 1.5, u), rtol=0, atol=1e-7)


def test_a_step_is_what_odometry_reports_from_pose_to_pose():
    steps = BodyOdometry(1e-3, 1e-3, 1e-4, steps=True)
    first, way, second = 0.4, 2.0, -1.1
    u = torch.tensor([way * math.cos(first), way * math.sin(first), first + second]).double()
    x, y, heading = steps(torch.tensor([1.0, 2.0, 0.7]).double(), torch.tensor(5.0).double(), u)
    np.testing.assert_allclose(
        [x, y, heading], [1 + way * math.cos(0.7 + first), 2 + way * math.sin(0.7 + first), 0.7 + first + second]
    )
    assert steps(torch.zeros(3).double(), torch.tensor(0.0).double(), u).eq(0).all()


def test_velocities_from_poses_lead_from_each_to_the_next():
    rng = np.random.default_rng(0)
    time, pose = np.cumsum(rng.uniform(0.1, 2, 9)), rng.normal(size=(5, 9, 3)) * [5, 5, 3]
    u, dt = body_velocities(time, pose), torch.from_numpy(np.diff(time)).expand(5, 8)
    after = ROBOT(torch.from_numpy(pose[:, :-1]), dt, u) - torch.from_numpy(pose[:, 1:])
    after[..., 2] = torch.remainder(after[..., 2] + math.pi, 2 * math.pi) - math.pi
    assert float(after.abs().max()) < 1e-12


@pytest.mark.parametrize("u", [[2.0, 0.5, 0.0], [1.5, 0.0, 0.2]])
def test_noise_along_the_robots_axes_is_that_of_many_short_steps(u):
    """The spread of 20,000 robots that err on every centimetre is the covariance of a step, to 4 standard errors."""
    rng, robots, parts, dt = np.random.default_rng(1), 20_000, 200, 2.0
    x, y, heading, h = np.zeros(robots), np.zeros(robots), np.full(robots, 0.9), dt / parts
    way, turn = math.hypot(u[0], u[1]) * h, abs(u[2]) * h
    for _ in range(parts):
        ahead = u[0] * h + rng.normal(size=robots) * math.sqrt(4e-3 * way)
        left = u[1] * h + rng.normal(size=robots) * math.sqrt(1e-3 * way)
        new = heading + u[2] * h + rng.normal(size=robots) * math.sqrt(1e-4 * way + 1e-3 * turn)
        middle = (heading + new) / 2
        x, y = x + ahead * np.cos(middle) - left * np.sin(middle), y + ahead * np.sin(middle) + left * np.cos(middle)
        heading = new
    step, inputs = torch.tensor(dt).double(), torch.tensor(u).double()
    mean = ROBOT(torch.tensor([0.0, 0.0, 0.9]).double(), step, inputs)
    root = ROBOT.process_noise_at(ROBOT.process_noise(step, inputs), mean, step)
    covariance, found = (root @ root.mT).numpy(), np.cov([x, y, heading])
    size = np.sqrt(np.outer(covariance.diagonal(), covariance.diagonal()))
    assert np.abs((found - covariance) / size).max() < 4 * math.sqrt(2 / robots) + 0.05 * abs(u[2]) * dt


def test_a_robot_that_stands_has_no_noise():
    root = ROBOT.process_noise(torch.ones(4).double(), U)
    assert (root[3] == 0).all()
    assert (root[:3].abs().sum((-2, -1)) > 0).all()
    f = presets.srckf(ROBOT, Position(1.0))
    prior = Gaussian.from_std([0, 0, 0], [1, 1, 0.1])
    still = f(torch.full((50, 2), torch.nan), prior, u=torch.zeros(50, 3))
    torch.testing.assert_close(still.covariance[-1].double(), prior.covariance, rtol=1e-5, atol=1e-6)


def test_noise_of_a_robot_that_stands_now_and_then_learns():
    motion = BodyOdometry(along=4e-3, across=1e-3, heading=1e-4, turn=1e-3, longest=1.0)
    f = learnable(presets.srckf(motion, Position(1.0)), ("along", "across", "heading", "turn"))
    z = torch.arange(8.0).double().reshape(4, 2)

    def likelihood():
        return f(z, Gaussian.from_std([0, 0, 0], [1, 1, 0.1]), u=U).log_likelihood.sum()

    likelihood().backward()
    for raw in f.parameters():
        values = []
        for step in (1e-5, -1e-5):
            with torch.no_grad():
                raw += step
                values.append(float(likelihood()))
                raw -= step
        assert float(raw.grad) == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-4, abs=1e-8)


def test_each_step_may_bring_its_noise():
    u = torch.cat([U[:1], torch.tensor([[0.1, 0.2, 0.03]]).double()], -1)
    root = BodyOdometry(longest=1.0).process_noise(torch.ones(1).double(), u)
    covariance = root[0] @ root[0].mT
    assert float(covariance[2, 2].sqrt()) == pytest.approx(0.03)
    ahead, left, _ = driven([0, 0, 0], 1.0, U[0].tolist())
    lead = 0.03**2 / 3 * (ahead**2 + left**2)
    assert float(covariance[0, 0] + covariance[1, 1]) == pytest.approx(0.1**2 + 0.2**2 + lead)
    assert ROBOT.process_noise(torch.ones(1).double(), U[:1]).shape == root.shape


@pytest.mark.parametrize("dt", [2.1, torch.tensor([0.5, 0.5, 2.1, 0.5])])
def test_velocities_over_a_gap_are_an_error_and_not_one_arc(dt):
    f, prior, z = presets.gpb(ROBOT, Position(1.0)), Gaussian.from_std([0, 0, 0], 1.0), torch.zeros(4, 2).double()
    assert not f(z, prior, dt=2.0, u=U).failed
    message = r"dt: expected 2 s or less \(longest\), .* received 2\.1 s"
    for call in (
        lambda: f(z, prior, dt=dt, u=U),
        lambda: f.smooth(z, prior, dt=dt, u=U),
        lambda: f.step(f.init(prior), z[0], dt=2.1, u=U[0]),
        lambda: f.predict(f.init(prior), dt=2.1, u=U[0]),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_a_gap_is_none_for_time_steps_that_rounding_made_longer():
    f = presets.srckf(BodyOdometry(1e-3, 1e-3, 1e-4, longest=0.1), Position(1.0))
    dt = torch.arange(1.0, 2.0, 0.1).double().diff()
    for kind in (torch.float32, torch.float64):
        z, u = torch.zeros(9, 2, dtype=kind), torch.ones(9, 3, dtype=kind)
        assert not f(z, Gaussian.from_std([0, 0, 0], 1.0), dt=dt.to(kind), u=u).failed


@pytest.mark.parametrize(
    ("motion", "u"),
    [(ROBOT, U[0]), (BodyOdometry(1e-3, 1e-3, 1e-4, steps=True), U[0]), (BodyOdometry(longest=2.0), U[:2].flatten())],
)
def test_they_pass_the_check_of_models(motion, u):
    report = check_model(motion, RangeBearing([0.1, 0.02], position=[9.0, 5.0], frame="body"), u=u)
    assert report.ok, report


# ---------------------------------------------------------------- sensors on a robot


def test_a_landmark_is_seen_from_the_robot_ahead_and_to_its_left():
    seen = RangeBearing([0.1, 0.02], position=[3.0, 4.0], frame="body")
    x = torch.tensor([[3.0, 1.0, math.pi / 2], [3.0, 1.0, 0.0], [0.0, 0.0, math.atan2(4, 3) - 0.1]]).double()
    torch.testing.assert_close(seen(x), torch.tensor([[3.0, 0.0], [3.0, math.pi / 2], [5.0, 0.1]]).double())
    by_inputs = RangeBearing([0.1, 0.02], frame="body")
    u = torch.cat([U[:3], torch.tensor([[3.0, 4.0]]).double().expand(3, 2)], -1)
    torch.testing.assert_close(by_inputs(x, u), seen(x))
    assert not seen.locates
    assert not seen.measures_each_direction


def test_an_antenna_on_a_lever_arm_goes_round_when_the_robot_turns():
    heading = torch.linspace(-3, 3, 7).double()
    x = torch.stack([torch.full_like(heading, 10.0), torch.full_like(heading, 20.0), heading], -1)
    seen = Mounted(Position(0.1), at=[2.0, 1.0])(x)
    place = 10 + 20j + (2 + 1j) * np.exp(1j * heading.numpy())
    np.testing.assert_allclose(seen, np.stack([place.real, place.imag], -1))
    distance = Mounted(Ranges([[0.0, 0.0]], 0.1), at=[2.0, 1.0])(x)
    np.testing.assert_allclose(distance[:, 0], abs(place))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: BodyOdometry(1e-3, 1e-3), r"along, across, heading: .* received no heading"),
        (lambda: BodyOdometry(-1.0, 0.0, 0.0), r"along: expected a value of 0 or more"),
        (lambda: presets.srckf(ROBOT, Position(1.0))(torch.zeros(3, 2), Gaussian.from_std([0, 0, 0], 1)),
         r"u: expected \(\.\.\., 3\), velocities ahead and to the left and turn, received None"),
        (lambda: BodyOdometry(1e-3, 1e-3, 1e-4), r"longest: expected seconds that velocities may hold above 0, .*None"),
        (lambda: BodyOdometry(1e-3, 1e-3, 1e-4, longest=1.0, steps=True), r"longest: expected None beside steps"),
        (lambda: BodyOdometry(longest=1.0)(torch.zeros(3), torch.tensor(1.0), torch.zeros(3)),
         r"u: expected \(.*6\), .*std"),
        (lambda: RangeBearing(0.1, frame="car"), r"frame: expected one of \('world', 'body'\), received 'car'"),
        (lambda: RangeBearing(0.1, frame="body", dims=3), r"dims: expected 2, received 3"),
        (lambda: RangeBearing(0.1, frame="body", heading=1), r"heading: expected the index of a component behind"),
        (lambda: RangeBearing(0.1, frame="body")(torch.zeros(3)), r"u: expected where the landmark stands"),
        (lambda: Mounted(Position(0.1), at=[1.0]), r"at: expected finite numbers \(2,\)"),
        (lambda: Mounted(ROBOT, at=[1.0, 0.0]), r"sensor: expected a sensor, received BodyOdometry"),
        (lambda: Mounted(Position(0.1), at=[1.0, 0.0], heading=0), r"heading: expected the index of a component"),
        (lambda: body_velocities([0.0, 0.0], np.zeros((2, 3))), r"time: expected seconds that increase"),
        (lambda: body_velocities([0.0], np.zeros((2, 3))), r"time, pose: expected \(T,\) and \(\.\.\., T, 3\)"),
    ],
)  # fmt: skip
def test_what_a_robot_cannot_have_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# ---------------------------------------------------------------- one axis of time


def one_by_one(readings, measurements, start):
    """The merged steps by an explicit loop: time, dt, reading and the measurement's value."""
    events = sorted([(t, 0, None) for t, _ in readings] + [(t, -1, z) for t, z in measurements], key=lambda e: e[:2])
    rows, before, taken = [], start, {t for t, _ in measurements}
    for t, kind, z in events:
        if t < start or (kind == 0 and (t <= start or t in taken)):
            continue
        rows.append((t, t - before, max(r for r in readings if r[0] <= before)[1], z))
        before = t
    return rows


def test_readings_and_measurements_are_merged_as_one_by_one():
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.integers(1, 4, 12)) / 4.0
    readings = [(float(t), float(i)) for i, t in enumerate(times)]
    seen = np.sort(rng.choice(np.arange(4 * times[0], 4 * times[-1]) / 4, 9))  # at times of readings, and twice at one
    merged = merge((times, np.arange(12.0)[:, None]), {"gps": (seen, seen[:, None])}, longest=1.0)
    expected = one_by_one(readings, [(float(t), float(t)) for t in seen], float(times[0]))
    assert merged.time.tolist() == [row[0] for row in expected]
    assert merged.dt.tolist() == [row[1] for row in expected]
    moved = [(row[2], got) for row, got in zip(expected, merged.u[:, 0].tolist(), strict=True) if row[1] > 0]
    assert all(a == b for a, b in moved)
    assert [None if math.isnan(z) else z for z in merged.z[:, 0].tolist()] == [row[3] for row in expected]


def test_several_sensors_with_inputs_of_their_own_share_the_axis():
    gps, landmarks = ([0.5, 2.5], [[1, 2], [3, 4]]), ([1.5, 0.5], [[9, 0.1], [8, 0.2]], [[5, 6], [7, 8]])
    merged = merge(([0, 1, 2], U[:3]), {"gps": gps, "camera": landmarks}, longest=1.0, start=0.25)
    assert merged.time.tolist() == [0.5, 0.5, 1.0, 1.5, 2.0, 2.5]
    assert merged.dt.tolist() == [0.25, 0.0, 0.5, 0.5, 0.5, 0.5]
    assert merged.which.tolist() == [0, 1, 0, 1, 0, 0]
    assert merged.u[:, 3:].tolist() == [[0, 0], [7, 8], [0, 0], [5, 6], [0, 0], [0, 0]]
    f = presets.gpb(ROBOT, Position(1.0))
    sensors = [Position(1.0), RangeBearing([0.1, 0.02], frame="body")]
    prior = Gaussian.from_std([0, 0, 0], 1.0)
    estimate = f(merged.z, prior, dt=merged.dt, u=merged.u, sensors=sensors, which=merged.which)
    assert not estimate.failed


QUIET = BodyOdometry(along=1e-3, across=1e-4, heading=1e-6, turn=1e-5, longest=97.0)


def drive(seed, seconds=300.0, rate=10.0):
    """A robot that drives and turns for a while: times, true poses and the velocities of its odometry."""
    rng, n = np.random.default_rng(seed), int(seconds * rate)
    time = np.arange(n + 1) / rate
    u = np.stack([1 + 0.3 * np.sin(time[:-1] / 7), 0 * time[:-1], 0.4 * np.sin(time[:-1] / 9)], -1)
    pose = [torch.zeros(3).double()]
    for row in torch.from_numpy(u):
        pose.append(QUIET(pose[-1], torch.tensor(1 / rate).double(), row))
    way, turn = np.hypot(u[:, 0], u[:, 1]) / rate, np.abs(u[:, 2]) / rate
    std = rate * np.sqrt(np.stack([1e-3 * way, 1e-4 * way, 1e-6 * way + 1e-5 * turn], -1))
    return time, torch.stack(pose).numpy(), u + std * rng.normal(size=u.shape)


@pytest.mark.slow
def test_every_reading_counts_over_97_s_without_a_fix_and_a_gap_in_them_is_an_error():
    time, pose, u = drive(0)
    kept = ~((time[:-1] > 100) & (time[:-1] < 197))
    rows = np.flatnonzero((time[:-1] % 1 == 0) & kept)[1:]
    fixes = (time[rows], pose[rows, :2] + 0.5 * np.random.default_rng(1).normal(size=(len(rows), 2)))
    f, prior = presets.srckf(QUIET, Position(0.5)), Gaussian.from_std(pose[0], [1.0, 1.0, 0.1])

    def error_before_the_fix(merged):
        """m, at the end of the gap, before the fix there: that of a prediction."""
        z = merged.z.clone()
        last = int((merged.time == 197).nonzero()[0])
        z[last:] = torch.nan
        place = f(z, prior, dt=merged.dt, u=merged.u).mean[last, :2]
        return float((place - torch.from_numpy(pose[np.flatnonzero(time == 197)[0], :2])).norm())

    assert error_before_the_fix(merge((time[:-1], u), {"gps": fixes}, longest=0.2)) < 3
    with pytest.raises(ValueError, match=r"odometry: .*longest.*none from 100 to 197 s"):
        merge((time[:-1][kept], u[kept]), {"gps": fixes}, longest=0.2)
    assert error_before_the_fix(merge((time[:-1][kept], u[kept]), {"gps": fixes}, longest=97.0)) > 40


def test_a_gap_before_the_start_is_in_no_step():
    merged = merge(([0.0, 50.0, 51.0], [[1.0]] * 3), {"gps": ([51.5], [[1.0]])}, longest=1.0, start=50.5)
    assert merged.time.tolist() == [51.0, 51.5]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"odometry": ([0.0, 1.0], [[1.0]])}, r"odometry: expected times \(S,\) and readings \(S, k\)"),
        ({"odometry": ([1.0, 0.0], [[1.0], [1.0]])}, r"odometry: expected finite times that increase"),
        ({"measurements": {}}, r"measurements: expected those of one sensor or more, received none"),
        ({"measurements": {"gps": ([0.5], [1.0])}}, r"measurements: gps: expected \(J,\), \(J, m\)"),
        ({"measurements": {"gps": ([-0.5], [[1.0]])}}, r"measurements: .*none before 0 s, received one at -0\.5 s"),
        ({"measurements": {"gps": ([2.5], [[1.0]])}}, r"odometry: .*none from 1 to 2\.5 s"),
        ({"measurements": {"gps": ([math.nan], [[1.0]])}}, r"measurements: gps: expected finite times"),
        ({"longest": 0.5}, r"odometry: expected a reading every 0\.5 s at least .*none from 0 to 1 s"),
        ({"longest": 0.0}, r"longest: expected seconds above 0"),
        ({"start": -1.0}, r"start: expected seconds from 0 to 1, received -1"),
    ],
)  # fmt: skip
def test_what_cannot_be_merged_is_named(change, message):
    given = {"odometry": ([0.0, 1.0], [[1.0], [1.0]]), "measurements": {"gps": ([0.5], [[1.0]])}, "longest": 1.0}
    given |= change
    with pytest.raises(ValueError, match=message):
        merge(given.pop("odometry"), given.pop("measurements"), **given)


# ---------------------------------------------------------------- all of it


@pytest.mark.slow
def test_a_robot_among_landmarks_is_located_as_well_as_its_filter_says():
    """200 robots with landmarks and an antenna on a lever arm: the normalised error squared is 3 on average."""
    runs, steps, dt = 200, 60, 0.5
    generator = torch.Generator().manual_seed(0)
    prior = Gaussian.from_std([0, 0, 0], [0.5, 0.5, 0.1])
    x = torch.randn(runs, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.5, 0.5, 0.1])
    sensor = Mounted(RangeBearing([0.2, 0.03], position=[10.0, 8.0], frame="body"), at=[0.5, 0.2])
    seconds, poses, z = torch.tensor(dt).double(), [], []
    u = torch.stack([torch.tensor([1.0, 0.1, 0.3 * math.sin(k / 8)]) for k in range(steps)]).double()
    for k in range(steps):
        x = ROBOT(x, seconds.expand(runs), u[k].expand(runs, 3))
        root = ROBOT.process_noise_at(ROBOT.process_noise(seconds, u[k]), x, seconds)
        x = x + (root @ torch.randn(runs, 4, 1, generator=generator, dtype=torch.float64)).squeeze(-1)
        poses.append(x)
        noise = torch.randn(runs, 2, generator=generator, dtype=torch.float64) * torch.tensor([0.2, 0.03])
        z.append(sensor(x) + noise)
    truth, z = torch.stack(poses, 1), torch.stack(z, 1)
    estimate = presets.srckf(ROBOT, sensor)(z, prior, dt=dt, u=u)
    gap = ROBOT.difference(estimate.mean, truth)
    nees = (gap.unsqueeze(-2) @ torch.linalg.inv(estimate.covariance) @ gap.unsqueeze(-1)).flatten(1).mean(0)
    assert float(nees.mean()) == pytest.approx(3, rel=0.1)


@pytest.mark.slow
def test_a_gap_fails_the_track_in_a_kernel_which_cannot_raise():
    f = presets.srckf(ROBOT, Position(1.0)).compile()
    prior, z, dt = Gaussian.from_std([0, 0, 0], 1.0), torch.zeros(4, 2).double(), torch.tensor([1.0, 1.0, 97.0, 1.0])
    assert not f(z, prior, dt=torch.ones(4).double(), u=U).failed
    estimate = f(z, prior, dt=dt.double(), u=U)
    assert bool(estimate.failed)
    assert int(estimate.failure.step) == 2


@pytest.mark.slow
def test_kernels_and_motions_around_it_have_its_inputs_too():
    motion = Augmented(ROBOT, RandomWalk(1e-4, 1, kind="bias"))
    sensor = Mounted(RangeBearing([0.2, 0.03], position=[10.0, 8.0], frame="body"), at=[0.5, 0.2])
    prior, z = Gaussian.from_std([0, 0, 0, 0], 0.5), torch.tensor([[12.0, 0.6]] * 4).double()
    f, compiled = presets.srckf(motion, sensor), presets.srckf(motion, sensor).compile()
    for method in ("forward", "smooth"):
        found, plain = getattr(compiled, method)(z, prior, u=U), getattr(f, method)(z, prior, u=U)
        torch.testing.assert_close(found.mean, plain.mean, rtol=0, atol=1e-10)
        torch.testing.assert_close(found.covariance, plain.covariance, rtol=0, atol=1e-10)
