"""Filters are compared as a paper would: intervals, paired tests, consistency, bounds, tables and figures."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import torchfra
from torchfra.cli import main as cli
from torchfra.evaluation import divergence_limit, evaluate, table
from torchfra.evaluation.comparison import Comparison
from torchfra.metrics.statistics import mean_interval, signed_rank

SCENARIO = torchfra.scenarios.bearings_outliers(initial="truth")


@pytest.fixture(scope="module")
def comparison():
    return torchfra.compare(["srckf", "rsrckf", "ukf"], SCENARIO, runs=40)


def test_means_and_tests_are_those_of_the_errors_of_single_runs(comparison):
    tracks, errors = SCENARIO.simulate(40), {}
    for name in ("srckf", "rsrckf"):
        f = getattr(torchfra.presets, name)(SCENARIO.motion, SCENARIO.sensor)
        estimate = f(tracks.z, tracks.prior, u=tracks.u)
        errors[name] = torchfra.metrics.track_rmse(estimate.mean, tracks.truth, SCENARIO.position).detach()
        assert comparison.results[name]["mean_track_rmse_position"] == pytest.approx(mean_interval(errors[name]))
        nees = torchfra.metrics.nees(estimate, tracks.truth, SCENARIO.position).mean(-1) / 2
        assert comparison.results[name]["anees"] == pytest.approx(mean_interval(nees.detach()))
        assert comparison.results[name]["anis"] == pytest.approx(mean_interval(estimate.nis.mean(-1).detach() / 2))
    test = next(test for test in comparison.tests() if {test.one, test.other} == {"srckf", "rsrckf"})
    assert test.p == pytest.approx(signed_rank(errors["srckf"], errors["rsrckf"]))
    assert test.p <= test.corrected <= 3 * test.p
    assert comparison.best == min(errors, key=lambda name: errors[name].mean())
    assert comparison.p("srckf", "srckf") == 1.0


def test_an_honest_filter_is_within_its_bounds_and_one_that_is_too_sure_is_not():
    motion, sensor = torchfra.motion.ConstantVelocity(0.5), torchfra.sensors.Position(10.0)
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    one, state, states = torch.tensor(1.0).double(), 10 * draw(200, 4), []
    for _ in range(40):
        state = state @ motion.transition(one).mT + draw(200, 2) @ motion.process_noise(one).mT
        states.append(state)
    truth = torch.stack(states, 1)
    prior = torchfra.Gaussian(torch.zeros(200, 4).double(), 10 * torch.eye(4).double())
    tracks = torchfra.scenarios.Tracks(truth, truth[..., :2] + 10 * draw(200, 40, 2), None, prior)
    filters = {
        "consistent": torchfra.presets.srckf(motion, sensor),
        "sure": torchfra.presets.srckf(motion, torchfra.sensors.Position(5.0)),
    }
    results = torchfra.compare(filters, tracks).results
    for key in ("anees", "anis"):
        assert results["consistent"][f"{key}_inside"] > 0.85
        assert results["sure"][f"{key}_inside"] < 0.1
        low, high = results["consistent"][f"{key}_bounds"]
        assert low < results["consistent"][key][0] < high < results["sure"][key][0]


def test_the_bound_is_a_share_of_the_error(comparison):
    least = comparison.bound.rmse(SCENARIO.position).mean().item()
    for name, of in comparison.results.items():
        assert comparison.efficiency(name) == pytest.approx(least / of["mean_rmse_position"])
        assert 0 < comparison.efficiency(name) < 1
    without = torchfra.compare(["srckf"], SCENARIO, runs=3, bound=False)
    assert np.isnan(without.efficiency("srckf"))
    assert "bound" not in str(without)


def test_no_figure_has_the_name_of_another_one_in_the_table_of_the_command(comparison):
    headings = [set(re.split("  +", text.splitlines()[0])) for text in (table(comparison.results), comparison.table())]
    assert headings[0] & headings[1] == {"filter", "us/step"}


def test_the_table_comes_in_every_form_and_file(comparison, tmp_path):
    assert str(comparison).startswith(comparison.table())
    for ending, part in ((".txt", "RMSE m"), (".csv", "RMSE m +-"), (".tex", r"\toprule"), (".md", "| --- |")):
        assert part in comparison.save(tmp_path / f"table{ending}").read_text()
    held = json.loads(comparison.save(tmp_path / "all.json").read_text())
    assert held["filters"]["ukf"]["mean_rmse_position"] == comparison.results["ukf"]["mean_rmse_position"]
    forms = {".csv": comparison.table("csv"), ".tex": comparison.table("latex"), ".md": comparison.table("markdown")}
    assert all((tmp_path / f"table{ending}").read_text().startswith(text) for ending, text in forms.items())
    assert len(forms[".csv"].splitlines()) == 4
    with pytest.raises(ValueError, match=r"table: expected a file that ends in \.txt, \.csv, \.tex, \.md"):
        comparison.save(tmp_path / "table.html")


@pytest.mark.slow
def test_the_figure_is_drawn_for_print_in_vectors_and_the_same_each_time(comparison, tmp_path):
    figure = comparison.plot(tmp_path / "one.pdf", width=3.3)
    assert figure.get_figwidth() == 3.3
    comparison.plot(tmp_path / "two.pdf", width=3.3)
    assert (tmp_path / "one.pdf").read_bytes() == (tmp_path / "two.pdf").read_bytes()
    assert (tmp_path / "one.pdf").read_bytes().startswith(b"%PDF")
    comparison.plot(tmp_path / "one.svg")
    assert ">bound</text>" in (tmp_path / "one.svg").read_text()
    time, means = figure.axes
    assert [line.get_label() for line in time.lines] == ["srckf", "rsrckf", "ukf", "bound"]
    assert [label.get_text() for label in means.get_yticklabels()] == ["srckf", "rsrckf", "ukf"]


def test_a_figure_in_no_known_form_is_refused_before_it_is_drawn(comparison, tmp_path, monkeypatch):
    monkeypatch.setattr("torchfra.plotting.printed", None)
    with pytest.raises(ValueError, match=r"path: expected a file that ends in \.pdf, \.svg, \.png, received x\.docx"):
        comparison.plot("x.docx")


@pytest.mark.slow
def test_tracks_without_truth_are_compared_by_how_likely_their_measurements_were():
    tracks = SCENARIO.simulate(30)
    tracks = tracks._replace(truth=torch.full_like(tracks.truth, torch.nan))
    filters = {name: getattr(torchfra.presets, name)(SCENARIO.motion, SCENARIO.sensor) for name in ("srckf", "gpb")}
    found = torchfra.compare(filters, tracks)
    assert isinstance(found, Comparison)
    assert found.runs == 30
    assert found.best == "gpb"
    assert "log likelihood" in str(found)
    assert "RMSE" not in str(found)
    with pytest.raises(ValueError, match="plot: expected tracks with truth"):
        found.plot()


@pytest.mark.slow
def test_several_targets_of_a_run_are_one_run_in_tests():
    found = torchfra.compare(["ukf_jpda"], torchfra.scenarios.clutter_straight(), runs=3)
    assert found.of_runs("ukf_jpda").shape == (3,)
    assert "ANIS" not in str(found)


def test_what_cannot_be_compared_is_refused():
    f = torchfra.presets.srckf(SCENARIO.motion, SCENARIO.sensor)
    with pytest.raises(ValueError, match=r"data: expected a Scenario or Tracks \(truth, z, u, prior\), received int"):
        torchfra.compare({"a": f}, 3)
    with pytest.raises(ValueError, match="filters: expected a Filter as a, received int"):
        torchfra.compare({"a": 3}, SCENARIO)
    for name, value in (("runs", 1.5), ("seed", "a"), ("chunk", 0), ("limit", -1.0)):
        with pytest.raises(ValueError, match=f"{name}: expected"):
            torchfra.compare({"a": f}, SCENARIO, **{name: value})
    with pytest.raises(ValueError, match="filters: expected names, or filters by name"):
        torchfra.compare([f], SCENARIO)
    with pytest.raises(ValueError, match="tracks: expected a truth"):
        torchfra.compare({"a": f}, SCENARIO.simulate(2)._replace(prior=None))
    with pytest.raises(ValueError, match="filters: expected one or more, received none"):
        torchfra.compare({}, SCENARIO)
    with pytest.raises(ValueError, match="filters: expected filters by name with Tracks"):
        torchfra.compare(["srckf"], SCENARIO.simulate(2))
    with pytest.raises(ValueError, match=r"tracks: expected truth \(B, T, n\)"):
        torchfra.scenarios.of_tracks(SCENARIO.simulate(2)._replace(z=torch.zeros(2)), SCENARIO.motion, SCENARIO.sensor)


# ---------------------------------------------------------------- divergence


@pytest.mark.slow
def test_the_limit_of_divergence_is_the_scenarios_or_follows_its_scale():
    assert divergence_limit(torchfra.scenarios.bearings_outliers()) == 2000.0
    limits = {std: divergence_limit(torchfra.scenarios.adsb_turns(std=std)) for std in (3.0, 30.0)}
    median = 1.1774  # of a distance in the plane, in standard deviations per axis
    assert limits[30.0] == pytest.approx(10 * 30 * median, rel=0.03)
    assert limits[3.0] == pytest.approx(limits[30.0] / 10)
    assert divergence_limit(torchfra.scenarios.clutter_straight()) < 1000
    result = evaluate(torchfra.scenarios.bearings_outliers(), ["srckf"], runs=3, limit=1e-3)["srckf"]
    assert (result["limit"], result["diverged"]) == (1e-3, 3)


# ---------------------------------------------------------------- one's own

MINE = """
import torchfra

@torchfra.register.filter("mine_{0}")
def mine(motion, sensor, **options):
    return torchfra.presets.srckf(motion, sensor, **options)

@torchfra.register.scenario("own_{0}")
def own(outliers="none"):
    return torchfra.scenarios.bearings_outliers(outliers)

def wrong(*models):
    return 3
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mine.py"
    path.write_text(MINE.format(tmp_path.name.replace("-", "_")))
    before = dict(torchfra.register.FILTERS), dict(torchfra.register.SCENARIOS)
    yield tmp_path.name.replace("-", "_")
    for registry, old in zip((torchfra.register.FILTERS, torchfra.register.SCENARIOS), before, strict=True):
        registry.clear()
        registry.update(old)


def command(*options):
    return cli.main(["compare", "--runs", "3", "--figure", "f.png", *options])


@pytest.mark.usefixtures("short_tracks", "rough_figures")
def test_the_command_takes_functions_of_a_file(mine, capsys):
    assert command("--scenario", "mine.py:own", "--filters", "srckf,mine.py:mine", "--outliers", "std") == 0
    said = capsys.readouterr().out
    assert "outliers std" in said
    assert "mine.py:mine" in said


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks", "rough_figures")
def test_the_command_takes_registered_names_and_writes_tables_and_figures_for_print(mine, capsys):
    files = ["--table", "t.tex", "--print", "p.pdf"]
    assert command("--import", "mine.py", "--scenario", f"own_{mine}", "--filters", f"mine_{mine}", *files) == 0
    assert "Cramer-Rao bound" in capsys.readouterr().out
    with open("t.tex") as table, open("p.pdf", "rb") as figure:
        assert "booktabs" not in table.read()
        assert figure.read(4) == b"%PDF"


@pytest.mark.slow
def test_the_command_takes_tracks_of_ones_own_each_once(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("walks.py").write_text("""
import torchfra

def walks():
    like = torchfra.scenarios.bearings_outliers()
    return torchfra.scenarios.of_tracks(like.simulate(2), like.motion, like.sensor)
""")
    assert cli.main(["compare", "--scenario", "walks.py:walks", "--filters", "srckf", "--figure", "f.png"]) == 0
    assert "1: track 1\n2: track 2\n" in capsys.readouterr().out


@pytest.mark.parametrize(("options", "said"), [
    (["--scenario", "mine.py:nothing"], "to have a function nothing, received nothing; it has mine, own, wrong"),
    (["--scenario", "mine.py:wrong"], "mine.py:wrong: expected () to return a Scenario, received int"),
    (["--scenario", "reentry", "--filters", "mine.py:wrong"], "(motion, sensor) to return a Filter, received int"),
    (["--scenario", "clutter-straight", "--filters", "mine.py:mine"], "expected one of scans for clutter-straight"),
    (["--scenario", "missing.py:own"], "expected a module, or a file that ends in .py, received missing.py"),
    (["--import", "no.such.module", "--scenario", "reentry"], "received no.such.module (ModuleNotFoundError"),
    (["--scenario", "mine.py:own", "--sensor", "radar"], "sensor: expected beside files, received beside --scenario"),
    (["--scenario", "mine.py:"], "expected module:function or file.py:function, received 'mine.py:'"),
    (["--scenario", "reentry", "--table", "t.html"], "table: expected a file that ends in .txt, .csv, .tex, .md"),
])  # fmt: skip
def test_functions_that_are_not_there_or_return_something_else_are_refused(mine, options, said, capsys):
    assert command(*options) == 2
    assert said in capsys.readouterr().err


def test_registered_filters_are_known_to_the_catalogue_and_to_the_battery(mine):
    @torchfra.register.filter("again")
    def again(motion, sensor):
        return torchfra.presets.srckf(motion, sensor)

    assert "again" in torchfra.compare(["again"], SCENARIO, runs=2).results
    report = torchfra.testing.check_filter("again", only=["it_maps_over_tracks"], compiled=False)
    assert [outcome.verdict for outcome in report.outcomes] == ["passed"]
    torchfra.register.filter("again")(again)  # as in a notebook
    with pytest.raises(ValueError, match="name: expected one that is not taken, received 'again'"):
        torchfra.register.filter("again")(lambda motion, sensor: None)
    with pytest.raises(ValueError, match="name: expected letters, digits"):
        torchfra.register.scenario("a b")(again)
    with pytest.raises(ValueError, match="filter: expected a Filter or one of gpb"):
        torchfra.testing.check_filter("nobody")
