"""What smoothing gains in a cell: errors by how far a filter looks ahead, ratios to the filtered ones, and NEES."""

import json
from functools import partial

import pytest
import regret
import short_tracks
import torch
from regrets import smoothed
from short_tracks import short

from torchfra import Gaussian, metrics, presets
from torchfra.catalogue import make_scenario, scenario_filters
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position


@pytest.fixture(scope="module", autouse=True)
def eight_steps():
    """Simulated tracks are so short."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(short_tracks, "STEPS", 8)
        yield


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The JSON of a small run."""
    path = tmp_path_factory.mktemp("smooth") / "r.json"
    arguments = ["--smooth", "--cells", "2-std", "--runs", "4", "--filters", "fra,gpb", "--quiet", "--json", str(path)]
    with short():
        assert regret.main([*arguments, "--plot", str(path.with_suffix(".png"))]) == 0
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    return json.loads(path.read_text())["cells"]["2-std"]


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_each_kind_of_estimate_looks_as_far_ahead_as_it_says(result):
    scenario = make_scenario("bearings-manoeuvre", outliers="std", initial="truth")
    tracks = scenario.simulate(4, 3)
    for name, f in scenario_filters(["fra", "gpb"], scenario).items():
        given = {"z": tracks.z, "prior": tracks.prior, "u": tracks.u, "dt": scenario.dt}
        filtered, whole = f(**given), f.smooth(**given)
        early = filtered.info.provisional if name == "fra" else filtered.info.filtered
        means = {"filtered": early.mean, "lag 5": f.smooth(**given, lag=5).mean, "smoothed": whole.mean}
        for kind, mean in means.items():
            expected = metrics.rmse(mean, tracks.truth, scenario.position).mean().item()
            of = result["smoothing"][name][kind]
            assert of["rmse"] == pytest.approx(expected)
            assert of["ratio"] == pytest.approx(of["rmse"] / result["smoothing"][name]["filtered"]["rmse"])
            assert of["interval"][0] <= of["ratio"] <= of["interval"][1]
        nees = metrics.nees(whole, tracks.truth, scenario.position).mean().item() / 2
        assert result["smoothing"][name]["smoothed"]["nees"] == pytest.approx(nees)


@pytest.mark.slow
def test_the_table_has_a_line_for_each_filter(result):
    lines = smoothed.table({"2-std": result}).splitlines()
    assert len(lines) >= 3
    assert all("2-std" in line for line in lines[-2:])


def test_where_the_model_holds_smoothed_covariances_are_honest():
    motion, sensor = ConstantVelocity(1.0), Position(5.0)
    one, rng = torch.ones((), dtype=torch.float64), torch.Generator().manual_seed(0)
    normal = partial(torch.randn, dtype=torch.float64, generator=rng)
    x, truth = normal(400, 4), []
    for _ in range(20):
        x = x @ motion.transition(one).mT + normal(400, 2) @ motion.process_noise(one).mT
        truth.append(x)
    truth = torch.stack(truth, 1)
    prior = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
    estimate = presets.srckf(motion, sensor).smooth(truth[..., :2] + 5 * normal(400, 20, 2), prior)
    assert metrics.nees(estimate, truth).mean().item() / 4 == pytest.approx(1.0, abs=0.05)


def test_bands_are_those_of_the_estimates_and_narrower_when_smoothed():
    scenario = make_scenario("bearings-manoeuvre", outliers="std", initial="truth")
    f, tracks = scenario_filters(["srckf"], scenario)["srckf"], scenario.simulate(1, 5)
    run = smoothed.one_run(f, scenario, 5)
    expected = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
    error, std = run["filtered"]
    torch.testing.assert_close(error, (expected.mean - tracks.truth)[0, :, 0])
    torch.testing.assert_close(std, expected.covariance[0, :, 0, 0].sqrt())
    assert list(run) == ["filtered", "lag 1", "smoothed"]
    assert run["smoothed"][1][50] < run["lag 1"][1][50] < std[50]


def test_what_goes_with_comparisons_alone_is_named(capsys):
    assert regret.main(["--smooth", "--figure", "a.png"]) == 2
    assert "smooth: expected no learned values, --tuned or --figure" in capsys.readouterr().err
    assert regret.main(["--plot", "a.png"]) == 2
    assert "plot: expected --smooth beside it" in capsys.readouterr().err
