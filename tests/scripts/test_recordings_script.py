"""Recordings with published figures are read as they are laid out, and the table says how far presets are from them."""

import gzip
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import recordings
import torch
from learned import campus
from recorded_bench import autoferry, nclt, smartloc, uwb
from recorded_bench.compass import steadied
from recorded_bench.tracks import Track, followed, judged

from torchfra.angles import wrap
from torchfra.types import Estimate, Gaussian

HEADER = "time,gps_x,gps_y,wheel_left,wheel_right,yaw,yaw_rate,truth_x,truth_y,truth_yaw"


def day(folder, name="2012-11-16", steps=25, replaced=None):
    """A robot that drives east at 1 m/s, with fixes every other second; ``replaced`` cells by (row, column)."""
    rows = [[t, t + 1, 1, 1, 1, 0, 0, t, 0, 0] for t in range(steps)]
    for row in rows[1::2]:
        row[1:3] = ["", ""]
    for (row, column), value in (replaced or {}).items():
        rows[row][HEADER.split(",").index(column)] = value
    path = folder / f"{name}.csv"
    path.write_text("\n".join([HEADER, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def run_of_ranges(folder, results="LS RMSE: 1.5 m\nLS RMSE_2d: 1.25\nESKF RMSE_2d: 0.75\n"):
    """A tag that is pulled past three anchors for 2 s, in a folder."""
    path = folder / "LOS" / "Trajectory_A" / "Case_1"
    path.mkdir(parents=True)
    time = np.arange(0, 2.05, 0.1)
    for name, place in (("A1", (0, 0, 1)), ("A2", (8, 0, 1)), ("A3", (4, 6, 1))):
        ranges = np.sqrt((2 + time - place[0]) ** 2 + (1 - place[1]) ** 2 + 1)
        rows = [f"{t},{place[0]},{place[1]},{place[2]},{r}" for t, r in zip(time, ranges, strict=True)]
        (path / f"{name}.csv").write_text("\n".join(["t,x,y,z,range", *rows]) + "\n")
    rows = [f"{t},{2 + t},1,0" for t in time]
    (path / "trajectory.csv").write_text("\n".join(["timestamp,x,y,z", *rows]) + "\n")
    (path / "RMSD_results.txt").write_text(results)
    return path


# ---------------------------------------------------------------- a robot on a campus


def test_a_day_has_fixes_where_there_are_new_ones_and_the_speed_of_both_wheels(tmp_path):
    track = nclt.read(day(tmp_path, replaced={(24, "wheel_left"): 0.5}))
    assert track.name == "2012-11-16"
    assert track.z[::2].isfinite().all()
    assert track.z[1::2].isnan().all()
    speed, heading = track.u.unbind(-1)
    assert speed.tolist() == [1.0] * 24 + [0.75]
    torch.testing.assert_close(heading[:24], nclt.deviation(torch.zeros(24).double()))
    assert track.prior.mean.tolist() == [0.0, 0.0, 0.0, nclt.SCALE]


def test_a_day_that_others_have_published_has_their_figures_and_any_other_has_none(tmp_path):
    assert nclt.read(day(tmp_path)).published["KalmanNet"] == 5.61
    assert nclt.read(day(tmp_path, "2013-01-10")).published == {}


def test_errors_are_per_axis_over_all_rows(tmp_path):
    track = nclt.read(day(tmp_path))
    found = judged(followed(*nclt.make("srckf", track), track), track, nclt.METRIC)
    by_hand = (found.mean - track.truth).square().mean().sqrt().item()
    assert found.figures["rmse_axis"] == pytest.approx(by_hand)


def test_a_bias_is_in_covariances_and_changes_no_estimate(tmp_path):
    track = nclt.read(day(tmp_path))
    f, prior = nclt.make("srckf", track)
    plain, found = (judged(followed(f, prior, track, bias=bias), track, nclt.METRIC) for bias in (None, nclt.BIAS))
    torch.testing.assert_close(found.mean, plain.mean)
    for name in ("nees", "nees_smoothed"):
        assert 0 < found.figures[name] < plain.figures[name]


@pytest.mark.slow
def test_positions_that_are_wrong_for_minutes_do_not_move_the_robot_of_interacting_models(tmp_path):
    yaw = torch.zeros(1).double()
    for _ in range(50):
        yaw = -nclt.deviation(yaw)  # of a robot that heads east
    wrong = {(t, "gps_y"): 61 for t in range(60, 160, 2)}
    track = nclt.read(day(tmp_path, steps=240, replaced=wrong | {(t, "yaw"): yaw.item() for t in range(240)}))
    worst = {}
    for name in ("imm", "rsrckf"):
        f, prior = nclt.make(name, track)
        worst[name] = (f(track.z, prior, dt=track.dt, u=track.u).mean[..., :2] - track.truth).norm(dim=-1).max().item()
    assert worst["imm"] < 10.0
    assert worst["rsrckf"] > 20.0


@pytest.mark.parametrize(("replaced", "said"), [
    ({(4, "yaw"): ""}, r"2012-11-16.csv: yaw: expected a number in every row, received none in row 6"),
    ({(4, "time"): 3}, r"2012-11-16.csv: time: expected times that grow, received 3 after 3, in row 6"),
    ({(0, "truth_x"): ""}, r"2012-11-16.csv: truth_x, truth_y: expected a start in the first row, received none"),
    ({(4, "gps_x"): "east"}, r"2012-11-16.csv: expected a number in data row 5, column gps_x, received 'east'"),
], ids=["no yaw", "time stands still", "no start", "text"])  # fmt: skip
def test_a_day_that_cannot_be_right_is_refused_by_file_and_column(tmp_path, replaced, said):
    with pytest.raises(ValueError, match=said):
        nclt.read(day(tmp_path, replaced=replaced))


# ---------------------------------------------------------------- a heading that the wheels steady


def turning(steps=120):
    """A heading that turns slowly, its turns, and readings of it good to 0.05 rad."""
    rng = torch.Generator().manual_seed(0)
    turns = 0.03 * torch.ones(steps).double()
    heading = wrap(turns.cumsum(0))
    return heading, turns, wrap(heading + 0.05 * torch.randn(steps, generator=rng, dtype=torch.float64))


def test_wheels_say_how_far_a_robot_turns_in_each_step_but_the_first():
    wheels = torch.tensor([[0.9, 1.1]] * 3 + [[0.9, 0.9]] + [[0.9, 1.1]] * 2).double()
    assert nclt.turns(wheels).tolist() == pytest.approx([0.0, -0.214, -0.214, -0.09, -0.124, -0.214])


def test_a_steadied_heading_follows_a_compass_that_is_right():
    heading, turns, readings = turning()
    found = steadied(readings, turns, torch.ones_like(turns).bool())
    assert wrap(found - heading).abs().max() < 0.15


def test_a_steadied_heading_stays_with_the_wheels_while_the_compass_turns_by_itself():
    heading, turns, readings = turning()
    readings[40:46] = wrap(readings[40:46] + 1.0)
    found = steadied(readings, turns, torch.ones_like(turns).bool())
    assert wrap(found - heading)[40:46].abs().max() < 0.4
    assert wrap(found - heading)[50:].abs().max() < 0.15


def test_a_steadied_heading_needs_no_later_reading():
    _, turns, readings = turning()
    moving = torch.ones_like(turns).bool()
    torch.testing.assert_close(steadied(readings, turns, moving)[:50], steadied(readings[:50], turns[:50], moving[:50]))


# ---------------------------------------------------------------- a network that says which filter is nearer


def simulated(seed, steps=240):
    """A robot that turns slowly; in each second half minute its fixes are off by 30 m, else by 1 m."""
    rng = torch.Generator().manual_seed(seed)
    u = torch.stack([torch.ones(steps), torch.linspace(0, 3, steps)], -1).double()
    truth = torch.stack([u[:, 1].cos(), u[:, 1].sin()], -1).cumsum(0)
    std = torch.where(torch.arange(steps) // 30 % 2 == 0, 1.0, 30.0).unsqueeze(-1)
    z = truth + std * torch.randn(steps, 2, generator=rng, dtype=torch.float64)
    prior = Gaussian(torch.tensor([3.0, 4.0, 0.0, 0.0]).double(), torch.eye(4).double())
    dt = torch.ones(steps, dtype=torch.float64)
    return Track("", z, u, dt, truth, prior, fixes=None, published={}, per_axis=True)


def says(mean, **info):
    """An estimate of unit covariance."""
    root = torch.eye(mean.shape[-1]).to(mean).expand(*mean.shape, -1)
    return Estimate(mean, root, mean[..., 0], mean[..., 0], SimpleNamespace(**info))


def trusting(z, prior, u, dt):
    """Takes each fix for the truth."""
    return says(z, outlier=torch.zeros_like(z[..., :1]))


def coasting(z, prior, u, dt):
    """Goes by the wheels alone."""
    way = torch.stack([u[..., 1].cos(), u[..., 1].sin()], -1).cumsum(-2)
    mean = torch.cat([prior.mean[..., None, :2] + way, torch.zeros_like(way)], -1)
    return says(mean, probabilities=torch.ones_like(mean[..., :3]) / 3)


TWO = trusting, coasting


def learned(*days):
    """What the mean of networks says of a day, ``(T,)``, after they have learned on others."""
    networks = campus.learned(days, TWO, lambda prior: prior)

    def weight(day):
        with torch.no_grad():
            return torch.stack([network(campus.heard(day, TWO, lambda prior: prior).signals) for network in networks])

    return lambda day: weight(day).mean(0)


@pytest.fixture
def small(monkeypatch):
    """Little to learn from, in few steps."""
    for name, value in {
        "ITERATIONS": 150,
        "PIECES": 4,
        "LENGTH": 60,
        "MOVED": 0.0,
        "PENALTY": 0.0,
        "RATE": 0.05,
    }.items():
        monkeypatch.setattr(campus, name, value)
    return lambda name, value: monkeypatch.setattr(campus, name, value)


def test_networks_learn_which_filter_is_nearer_and_say_it_on_another_day(small):
    day = simulated(1)
    weight, positions = learned(simulated(0))(day), campus.heard(day, TWO, lambda prior: prior).positions

    def error(estimate):
        return (estimate - day.truth).square().mean().sqrt()

    assert error(campus.weighed(weight, positions)) < 0.9 * min(error(positions[:, 0]), error(positions[:, 1]))
    bad = torch.arange(len(weight)) // 30 % 2 == 1
    assert weight[bad].median() > 0.2 + weight[~bad].median()


def test_what_a_network_hears_at_a_step_needs_no_later_signal():
    day = simulated(0, 400)
    day.z[::3] = torch.nan
    later = day._replace(z=day.z.clone(), u=day.u.clone())
    for x in (later.z, later.u):
        x[300:] += 7.0
    now, other = (campus.signals(one.z, *told(one)) for one in (day, later))
    torch.testing.assert_close(now[:300], other[:300], rtol=0, atol=0)
    assert not now[300:].equal(other[300:])


def told(day):
    """Both filters; the first one knows something where there is no fix."""
    first, second = (f(day.z, day.prior, day.u, day.dt) for f in TWO)
    return first._replace(mean=first.mean.nan_to_num()), second


@pytest.mark.slow
def test_a_mixture_has_the_moments_of_both_estimates_and_their_mean_level(tmp_path, small):
    small("ITERATIONS", 0)  # weights of a half
    track = nclt.read(day(tmp_path))
    both = [nclt.make(name, track)[0] for name in nclt.MIXED]
    of = [followed(*nclt.make(name, track), track) for name in nclt.MIXED]
    mixed = nclt.learned_mixture([track], both, 0, iter)(track, of)
    (a, b), (p, q) = (
        [f(one.estimate) for one in of] for f in (lambda e: e.mean[:, :2], lambda e: e.covariance[:, :2, :2])
    )
    torch.testing.assert_close(mixed.estimate.mean, (a + b) / 2)
    spread = (a - b).unsqueeze(-1) * (a - b).unsqueeze(-2) / 4
    torch.testing.assert_close(mixed.estimate.covariance, (p + q) / 2 + spread)
    torch.testing.assert_close(mixed.level, (of[0].level + of[1].level) / 2)


@pytest.mark.slow
def test_the_table_has_what_networks_weigh_that_have_learned_on_another_day(tmp_path, small, capsys):
    small("ITERATIONS", 20)
    out = tmp_path / "r.json"
    options = ["--filters", "gpb", "--network", str(day(tmp_path, "2013-02-23")), "--json", str(out)]
    assert recordings.main(["nclt", str(day(tmp_path)), *options]) == 0
    assert "network rmse_axis" in capsys.readouterr().out
    found = json.loads(out.read_text())["nclt"]["2012-11-16"]
    assert {*found} == {"gpb", "network"}
    assert found["gpb"] != found["network"]


def test_a_network_is_refused_where_it_cannot_learn(tmp_path, capsys):
    path, without = str(day(tmp_path)), str(day(tmp_path, "2013-02-23", replaced={(4, "truth_x"): ""}))
    assert recordings.main(["nclt", path, "--filters", "gpb", "--network", without]) == 2
    assert (
        "network: expected a day with a truth at 2 steps or more, received 25 steps, 1 without"
        in capsys.readouterr().err
    )
    assert recordings.main(["uwb", str(run_of_ranges(tmp_path)), "--network", path]) == 2
    assert "network: expected recordings of nclt, received uwb" in capsys.readouterr().err


# ---------------------------------------------------------------- pseudoranges to a car

PLACE = np.array([3785108.0, 899901.0, 5037234.0])
SEEN = ((80, 10), (62, 200), (45, 120), (40, 300), (35, 30), (30, 250), (25, 170))
"""Elevation and azimuth of satellites, degrees; the last three are of another system."""


def drive(folder, steps=30, late=0.0, name="a_drive"):
    """A car that drives north at 5 m/s; the last satellite's signals come so many metres late."""
    axes, input_lines, truth_lines = smartloc._axes(PLACE), [], []
    for k in range(steps):
        time, place = 0.2 * k, PLACE + axes.T @ [0.0, k, 0.0]
        truth_lines.append(f"point3 {time} {' '.join(map(repr, place.tolist()))}" + " 0" * 9)
        input_lines.append(f"odom3 {time} 5.0 0 0 0 0 0.0" + " 1e-3" * 6)
        for i, (elevation, azimuth) in enumerate(SEEN):
            up, round_ = math.radians(elevation), math.radians(azimuth)
            way = [math.cos(up) * math.sin(round_), math.cos(up) * math.cos(round_), math.sin(up)]
            satellite = PLACE + 2.2e7 * axes.T @ np.array(way)
            away = np.linalg.norm(satellite - place)
            measured = away + 1000.0 - 10.0 * k + 4.0 * (i > 3) + late * (i == len(SEEN) - 1)
            turn = -smartloc.TURN * measured / smartloc.LIGHT  # back to where it was when it sent
            x, y, z = satellite
            sent = math.cos(turn) * x + math.sin(turn) * y, math.cos(turn) * y - math.sin(turn) * x, z
            numbers = [time, measured, 25.0, *sent, i, 1 if i <= 3 else 4, elevation, 45]
            input_lines.append("pseudorange3 " + " ".join(map(repr, map(float, numbers))))
    (folder / f"{name}_GT.txt").write_text("\n".join(truth_lines))
    path = folder / f"{name}_Input.txt"
    path.write_text("\n".join(input_lines))
    return path


def worst(track, name):
    f, prior = smartloc.make(name, track)
    return (f(track.z, prior, dt=track.dt, u=track.u).mean[10:, :3] - track.truth[10:]).norm(dim=-1).max().item()


def test_a_drive_has_satellites_by_their_elevation_and_odometry_in_front(tmp_path):
    track = smartloc.read(drive(tmp_path))
    assert track.z.shape == (30, len(SEEN))
    assert track.groups == (0, 0, 0, 0, 1, 1, 1)
    assert track.u[0, :2].tolist() == [5.0, 0.0]
    torch.testing.assert_close(track.truth[-1], torch.tensor([0.0, 29, 0]).double(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["srckf", "gpb_odometry"])
def test_without_noise_a_car_is_where_it_was(tmp_path, name):
    assert worst(smartloc.read(drive(tmp_path)), name) < 1.0


def test_a_signal_that_comes_late_is_believed_by_filters_that_do_not_expect_it_alone(tmp_path):
    track = smartloc.read(drive(tmp_path, late=60.0))
    assert worst(track, "srckf") > 10.0
    assert worst(track, "gpb") < 5.0


def test_a_weak_signal_of_a_drive_is_missing(tmp_path):
    path = drive(tmp_path)
    all_there = smartloc.read(path).z
    words = [line.split() for line in path.read_text().splitlines()]
    first = next(line for line in words if line[0] == "pseudorange3")
    first[-1] = "29.9"
    path.write_text("\n".join(map(" ".join, words)))
    assert (smartloc.read(path).z.isnan() & ~all_there.isnan()).sum() == 1


@pytest.mark.parametrize(("change", "said"), [
    (lambda path: path.rename(path.with_name("drive.txt")), r"drive.txt: expected the file of a drive, NAME_Input.txt"),
    (lambda path: path.write_text("odom3 0 1") and path, r"_Input.txt: expected lines of pseudorange3 .* received 0"),
    (lambda path: path.write_text("pseudorange3 0 1") and path, r"expected lines of pseudorange3 and 10 numbers"),
])  # fmt: skip
def test_a_drive_that_cannot_be_right_is_refused_by_its_name(tmp_path, change, said):
    with pytest.raises(ValueError, match=said):
        smartloc.read(change(drive(tmp_path)))


# ---------------------------------------------------------------- ranges to a tag


def test_a_run_of_ranges_has_the_errors_in_the_plane_that_were_published_with_it(tmp_path):
    track = uwb.read(run_of_ranges(tmp_path))
    assert track.name == "LOS/A/Case_1"
    assert track.published == {"LS": 1.25, "ESKF": 0.75}


def test_errors_of_ranges_are_of_the_distance_in_the_plane(tmp_path):
    track = uwb.read(run_of_ranges(tmp_path))
    found = judged(followed(*uwb.make("srckf", track), track), track, uwb.METRIC)
    by_hand = (found.mean - track.truth).square().sum(-1).mean().sqrt().item()
    assert found.figures["rmse_2d"] == pytest.approx(by_hand)


# ---------------------------------------------------------------- the command


@pytest.mark.parametrize(("kind", "recording", "name", "bias"), [
    (nclt, day, "gpb", nclt.BIAS), (nclt, day, "imm", None), (smartloc, drive, "gpb_odometry", smartloc.BIAS),
], ids=["positions", "errors in the state", "satellites"])  # fmt: skip
def test_all_presets_but_those_with_errors_in_their_state_consider_a_bias(kind, recording, name, bias, tmp_path):
    path, out = recording(tmp_path, steps=5), tmp_path / "r.json"
    which = kind.__name__.rpartition(".")[2]
    assert recordings.main([which, str(path), "--filters", name, "--no-compile", "--json", str(out)]) == 0
    track = kind.read(path)
    expected = judged(followed(*kind.make(name, track), track, kind.UNNOTICED, bias), track, kind.METRIC)
    (found,) = json.loads(out.read_text())[which].values()
    assert found[name] == pytest.approx(expected.figures)


def test_the_table_and_the_json_have_our_figures_and_those_of_others(tmp_path, capsys):
    out = tmp_path / "r.json"
    files = [str(day(tmp_path)), str(day(tmp_path, "2013-04-05"))]
    assert recordings.main(["nclt", *files, "--filters", "srckf", "--json", str(out)]) == 0
    result = json.loads(out.read_text())
    figures = result["nclt"]["2012-11-16"]["srckf"]
    assert figures.keys() == {"rmse_axis", "nees", "smoothed", "nees_smoothed", "beyond"}
    assert all(math.isfinite(value) for value in figures.values())
    assert result["published"]["2012-11-16"]["rmse_axis"] == {"EKF": 12.29, "KalmanNet": 5.61}
    printed = capsys.readouterr().out
    assert "5.61" in printed
    assert "mean" in printed
    assert "Song et al. (2024)" in printed


@pytest.mark.usefixtures("rough_figures")
def test_the_figure_has_path_and_error_of_each_recording(tmp_path):
    out = tmp_path / "r.png"
    assert recordings.main(["nclt", str(day(tmp_path)), "--filters", "srckf", "--figure", str(out), "--quiet"]) == 0
    assert out.stat().st_size > 1000


def test_a_recording_that_is_given_twice_is_refused(tmp_path, capsys):
    path = str(day(tmp_path))
    assert recordings.main(["nclt", path, path]) == 2
    assert "files: expected each recording once, received 2012-11-16 several times" in capsys.readouterr().err


def test_a_filter_that_is_unknown_is_refused_with_those_that_are_known(tmp_path, capsys):
    with pytest.raises(SystemExit):
        recordings.main(["nclt", str(day(tmp_path)), "--filters", "kalman"])
    assert "--filters: expected some of" in capsys.readouterr().err


# ---------------------------------------------------------------- boats in a harbour


def harbour(folder, steps=40, change=lambda detections, boats: None):
    """A boat that passes, with a buoy beside it, seen from a ferry by radar, by lidar once it is near.

    What the radar sees is where things were half a turn before.
    """
    rng, detections, boats = np.random.default_rng(0), [], []
    for k in range(2 * steps):
        ferry, boat, buoy = np.array([5.0, 0.5 * k]), np.array([30.0, -100.0 + 3.0 * k]), np.array([60.0, 40.0])
        radar, near = k % 2 == 0, np.linalg.norm(boat - ferry) < 70
        seen = [boat - 0.84 * np.array([0.0, 3.0]), buoy] if radar else [boat] if near else []
        z = np.array([x - ferry + (2.0 if radar else 0.5) * rng.standard_normal(2) for x in seen]).reshape(-1, 2)
        detections.append(
            {"sensorID": 2 if radar else 1, "time": 1000.0 + k, "ownshipPosition": ferry.tolist(),
             "measurement": z.T.tolist()}
        )  # fmt: skip
        boats.append([{"targetID": 1, "position": [*boat, 0.0], "time": 1000.0 + k}])
    change(detections, boats)
    folder.mkdir(exist_ok=True)
    with gzip.open(folder / "sea_detections.json.gz", "wt") as file:
        json.dump(detections, file)
    (folder / "sea_groundTruth.json").write_text(json.dumps(boats))
    return folder / "sea_detections.json.gz"


@pytest.mark.slow
def test_the_boat_is_followed_and_the_buoy_is_not(tmp_path):
    scene = autoferry.read(harbour(tmp_path))
    assert scene.name == "sea"
    assert len(scene.z) == 80
    torch.testing.assert_close(scene.truth[0, 1], torch.tensor([30.0, -94.0]).double())
    for name in autoferry.OWN_PRESETS:
        found = autoferry.follow(name, scene)
        assert found.mean.shape == (1, 40, 2)
        assert found.figures["gospa"] < 6.0
        assert found.figures["followed"] > 0.7
        assert found.figures["followed_seen"] == found.figures["followed"]
        assert found.figures["switches"] == found.figures["false_per_minute"] == 0


def test_scans_of_the_radar_are_older_than_their_times_say(tmp_path, monkeypatch):
    scene = autoferry.read(harbour(tmp_path))

    def behind():
        return float((scene.truth - autoferry.follow("radar", scene).mean)[0, 20:, 1].mean())  # the boat goes east

    assert abs(behind()) < 0.5
    monkeypatch.setitem(autoferry.AGE, autoferry.RADAR, 0.0)
    assert behind() == pytest.approx(0.84 * 3.0, abs=0.5)


def test_scans_of_a_boat_that_nobody_measures_count_as_not_seen(tmp_path):
    def unseen(detections, boats):
        for of in detections[50:]:
            of["measurement"] = [[], []]

    found = autoferry.follow("radar", autoferry.read(harbour(tmp_path, change=unseen)))
    assert found.figures["followed"] + 0.1 < found.figures["followed_seen"]


def test_what_is_no_recording_of_a_harbour_is_said(tmp_path):
    with pytest.raises(ValueError, match=r"expected NAME_detections\.json or NAME_detections\.json\.gz"):
        autoferry.read(tmp_path / "sea.json")
    with pytest.raises(ValueError, match=r"expected sea_groundTruth\.json beside it, received none"):
        autoferry.read(tmp_path / "sea_detections.json")
    with pytest.raises(ValueError, match=r"expected 79 entries as sea_detections\.json\.gz has, received 80"):
        autoferry.read(harbour(tmp_path, change=lambda detections, boats: detections.pop()))
    with pytest.raises(ValueError, match="expected detections and truths of the harbour, received KeyError"):
        autoferry.read(harbour(tmp_path, change=lambda detections, boats: detections[3].pop("ownshipPosition")))


def test_the_table_of_a_harbour_has_the_sets_of_sensors_and_a_picture(tmp_path, capsys):
    path, out = harbour(tmp_path / "in", steps=12), tmp_path / "out.json"
    options = ["autoferry", str(path), "--json", str(out), "--figure", str(tmp_path / "out.png")]
    assert recordings.main(options) == 0
    assert "radar_lidar gospa" in capsys.readouterr().out
    figures = json.loads(out.read_text())["autoferry"]["sea"]
    assert {*figures} == {"radar", "radar_lidar"}
    assert {*figures["radar"]} == {*autoferry.PARTS}
    assert (tmp_path / "out.png").stat().st_size > 10_000
    with pytest.raises(SystemExit):
        recordings.main(["autoferry", str(path), "--filters", "gpb"])
    assert "expected some of radar, radar_lidar, received gpb" in capsys.readouterr().err
