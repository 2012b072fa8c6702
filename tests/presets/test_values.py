"""Presets take named sets of learned values; a table says what these give where they were learned and elsewhere."""

import copy
import inspect
import json

import pytest

import torchfra
from torchfra import presets, scenarios
from torchfra.hyper import natural_values
from torchfra.presets.values import FILE
from train import values as measured
from train.config import Task
from train.runs import RUNS

RECORDS = torchfra.values()
NAMES = [f"{record['preset']}-{record['values']}" for record in RECORDS]


def models():
    scenario = scenarios.bearings_outliers("std", initial="truth")
    return scenario.motion, scenario.sensor


def bearings():
    (record,) = (r for r in RECORDS if (r["preset"], r["values"]) == ("fra", "bearings"))
    return record


# ---------------------------------------------------------------- what a preset makes of them


def test_a_preset_takes_the_values_of_the_set_and_scales_the_noise_of_its_models():
    motion, sensor = models()
    f, record = presets.fra(motion, sensor, values="bearings"), bearings()
    for name, value in record["arguments"].items():
        ((_, hyper),) = torchfra.hyper.named(f, (name,)).items()
        assert hyper().item() == pytest.approx(value, rel=1e-12), name
    assert f.motion.q().item() == pytest.approx(motion.q().item() * record["factors"]["motion.q"])
    assert f.sensor.std().item() == pytest.approx(sensor.std().item() * record["factors"]["sensor.std"])


def test_what_is_given_wins_over_the_set():
    f = presets.fra(*models(), values="bearings", gate=9.0, threshold=1.345)
    assert (f.gate().item(), f.robust.threshold().item()) == pytest.approx((9.0, 1.345))
    assert f.preference().item() == pytest.approx(bearings()["arguments"]["preference"])
    f = presets.fra(*models(), values="bearings", robust=torchfra.robust.Huber(0.7))
    assert f.robust.threshold().item() == pytest.approx(0.7)
    turns = scenarios.adsb_turns()
    f = presets.vsimm_srckf(turns.bank, turns.sensor, values="turns", self_transition=0.9)
    assert f.transition()[0, 0].item() == pytest.approx(0.9)


def test_the_models_that_are_handed_in_stay_as_they_are():
    motion, sensor = models()
    before = natural_values(motion) | natural_values(sensor)
    presets.fra(motion, sensor, values="bearings")
    assert natural_values(motion) | natural_values(sensor) == before
    turns = scenarios.adsb_turns()
    before = natural_values(turns.bank)
    presets.vsimm_srckf(turns.bank, turns.sensor, values="turns")
    assert natural_values(turns.bank) == before


def test_values_of_a_set_learn_on():
    f = presets.fra(*models(), values="bearings", learn=("gate", "q"))
    assert sorted(name for name, _ in f.named_parameters()) == ["gate.raw", "motion.q.raw"]
    assert f.gate().item() == pytest.approx(bearings()["arguments"]["gate"])


def test_no_set_is_no_change():
    assert natural_values(presets.fra(*models(), values=None)) == natural_values(presets.fra(*models()))


@pytest.mark.parametrize("preset", sorted({record["preset"] for record in RECORDS}))
def test_an_unknown_set_is_answered_with_those_of_the_preset(preset):
    known = ", ".join(record["values"] for record in RECORDS if record["preset"] == preset)
    clutter = {"clutter": torchfra.association.Clutter(1.0)} if preset == "iaukf_jpda" else {}
    with pytest.raises(ValueError, match=rf"values: expected None or one of {known} for {preset}, received 'calm'"):
        getattr(presets, preset)(*models(), values="calm", **clutter)


def test_a_model_without_what_the_set_changes_is_refused():
    motion = torchfra.motion.ConstantAcceleration(0.1)
    with pytest.raises(ValueError, match=r"expected a motion with models\.0\.q, .* received one without models\.2"):
        presets.vsimm_srckf([motion, copy.deepcopy(motion)], torchfra.sensors.Position(1.0), values="turns")


def test_presets_with_sets_say_so_and_no_others():
    with_sets = {name for name in presets.__all__ if "values" in inspect.signature(getattr(presets, name)).parameters}
    assert with_sets == {record["preset"] for record in RECORDS}


# ---------------------------------------------------------------- the table


def test_the_table_has_a_line_for_each_scenario_and_says_how_it_was_made():
    lines = str(RECORDS).splitlines()
    results = [result for record in RECORDS for result in record["results"]]
    assert len(lines) == 1 + len(results) + 3
    made = json.loads(FILE.read_text())["settings"]
    assert f"runs of seed {made['seed']}" in str(RECORDS)


@pytest.mark.parametrize("record", RECORDS, ids=NAMES)
def test_a_set_says_what_it_was_learned_on_and_was_measured_elsewhere_on_other_seeds(record):
    run = RUNS[record["run"].split()[-1]]()
    tasks = [(task.scenario, task.options, task.models) for task in run.tasks]
    results = [((of["scenario"], of["options"], of["models"]), of["learned_on"]) for of in record["results"]]
    learned_on = [cell for cell, there in results if there]
    assert all(task in learned_on for task in tasks)
    assert all(cell in tasks for cell in learned_on)
    assert not all(result["learned_on"] for result in record["results"])
    assert record["seeds"] == [run.seed, run.validation_seed]
    assert json.loads(FILE.read_text())["settings"]["seed"] not in record["seeds"]


def test_every_figure_of_the_table_is_of_200_runs_or_more():
    assert min(result["runs"] for record in RECORDS for result in record["results"]) >= 200


def test_a_record_is_a_copy():
    torchfra.values()[0]["arguments"].clear()
    assert torchfra.values()[0]["arguments"]


# ---------------------------------------------------------------- the program that writes it


@pytest.mark.slow
def test_the_program_computes_the_figures_of_the_file():
    record = next(r for r in RECORDS if r["preset"] == "hghckf2")
    (known,) = (r for r in record["results"] if (r["scenario"], r["options"]) == ("growth", {}))
    settings = json.loads(FILE.read_text())["settings"]
    anew = measured.compared(record, Task("growth"), False, known["runs"], settings["seed"])
    assert anew.keys() == known.keys()
    for name in ("defaults", "set", "change"):
        assert anew[name] == pytest.approx(known[name], rel=1e-3), name


def test_a_seed_that_was_learned_on_is_refused(capsys, tmp_path):
    assert measured.main(["--seed", "0", "--out", str(tmp_path / "values.json")]) == 2
    assert "seed: expected one that no set was learned on, received 0" in capsys.readouterr().err


@pytest.fixture
def measure(tmp_path, monkeypatch):
    """Calls the program with a stand-in for what takes time; returns what was measured, and what the file has."""
    asked = []

    def stand_in(record, task, learned_on, runs, seed):
        asked.append((record["preset"], task.scenario))
        cell = {"scenario": task.scenario, "options": task.options, "models": task.models, "learned_on": learned_on}
        return cell | {"runs": runs, "change": float(len(asked))}

    def call(*arguments, status=0):
        asked.clear()
        assert measured.main(["--out", str(tmp_path / "values.json"), "--quiet", *arguments]) == status
        sets = json.loads((tmp_path / "values.json").read_text())["sets"]
        return list(asked), {record["preset"]: record["results"] for record in sets}

    monkeypatch.setattr(measured, "compared", stand_in)
    return call


def test_sets_and_scenarios_are_measured_by_name_and_all_others_stay(measure):
    asked, found = measure("--sets", "fra-*", "--cells", "reentry,growth")
    assert asked == [("fra", "growth"), ("fra", "reentry")]
    assert {name for name, results in found.items() if results} == {"fra"}
    asked, found = measure("--sets", "hghckf2-*", "--cells", "reentry")
    assert asked == [("hghckf2", "reentry")]
    assert {name: len(results) for name, results in found.items() if results} == {"fra": 2, "hghckf2": 1}


def test_a_command_that_was_ended_goes_on_with_what_is_missing(measure):
    measure("--sets", "fra-*", "--cells", "reentry")
    asked, found = measure("--sets", "fra-*", "--cells", "reentry,growth", "--resume")
    assert asked == [("fra", "growth")]
    assert [result["scenario"] for result in found["fra"]] == ["growth", "reentry"]  # in the order of the catalogue
    asked, found = measure("--sets", "fra-*", "--cells", "reentry", "--resume", "--runs", "9")  # other runs: anew
    assert asked == [("fra", "reentry")]
    assert [result["runs"] for result in found["fra"]] == [300, 9]


@pytest.mark.slow
def test_all_is_measured_in_one_go_where_settings_are_others(measure, capsys):
    measure("--sets", "hghckf2-*", "--cells", "growth")
    measure("--sets", "hghckf2-*", "--cells", "growth", "--seed", "78", status=2)
    assert "cells: expected all, as" in capsys.readouterr().err
    asked, found = measure("--seed", "78", "--resume")
    assert len(asked) == sum(map(len, found.values())) == sum(len(record["results"]) for record in RECORDS)


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "message"), [
    (["--cells", "calm"], "cells: expected scenarios of *, received calm"),
    (["--sets", "calm"], "cells: expected scenarios of calm, received *"),
    (["--runs", "1"], "runs: expected 2 or more, received 1"),
    (["--jobs", "0"], "jobs: expected 1 or more, received 0"),
])  # fmt: skip
def test_what_cannot_be_measured_is_named_and_nothing_is_written(arguments, message, tmp_path, capsys):
    assert measured.main([*arguments, "--out", str(tmp_path / "values.json")]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_run_is_taken_as_arguments_and_factors(tmp_path):
    config = {"name": "switching", "filter": "vsimm_srckf", "seed": 0, "validation_seed": 1}
    start = {"inner.motion.models.0.q": 2.0, "transition[0,0]": 0.5, "transition[0,1]": 0.5, "unlikely": 0.1}
    learned = {"inner.motion.models.0.q": 3.0, "transition[0,0]": 0.9, "transition[0,1]": 0.1, "unlikely": 0.2}
    result = {"config": config, "values": {"start": start, "learned": learned}, "versions": {}}
    (tmp_path / "results.json").write_text(json.dumps(result))
    record = measured.set_of(tmp_path)
    assert record["factors"] == {"motion.models.0.q": 1.5}
    assert record["arguments"] == {"transition": [[0.9, 0.1]], "unlikely": 0.2}
