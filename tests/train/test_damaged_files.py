"""A file that is damaged, or that holds something else, is refused in one line, and nothing good is lost."""

import dataclasses
import errno
import json
import os
import struct
import zipfile

import numpy as np
import pytest
import torch

from torchfra import presets, state_files
from torchfra.catalogue import learned_filter, make_scenario
from torchfra.cli import main as cli
from torchfra.fitting.descent import Descent
from torchfra.hyper import hypers
from torchfra.running import atomic_write, checkpoints
from train import tune
from train.gpb.evolution import Evolution
from train.runs import configured
from train.training import Training

SMALL = ["batch=2", "iterations=2", "validation_runs=1", "test_runs=0", "compile=false"]
SCENARIO = make_scenario("bearings-outliers")


def signature(data):
    """The data as ``pack`` ends them: its last two bytes say how long the comment of the archive is."""
    body = data[:-2] + struct.pack("<H", state_files._LENGTH)
    return body + state_files._digest(body)


def made(preset=presets.fra, **options):
    """A filter around models of its own."""
    scenario = make_scenario("bearings-outliers")
    return preset(scenario.motion, scenario.sensor, **options)


def flipped(data, tries):
    """The data with one bit changed, in so many ways."""
    for bit in np.random.default_rng(0).choice(8 * len(data), tries, replace=False):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << (bit % 8)
        yield bytes(changed)


def prepare(*changes):
    return Training(configured("fra_bearings", [*SMALL, *changes]))


def saved(out, iterations=2):
    """A descent after some iterations, each of which is saved."""
    training = prepare()
    descent = Descent(training, training.filter, torch.tensor(torch.inf), dataclasses.asdict(training.config))
    for iteration in range(1, iterations + 1):
        descent.iteration = iteration
        row = {"iteration": iteration, "loss": 1.0, "left out": 0, "seconds": 0.0}
        descent.rows.append(row | training.natural())
        tune.save(descent, out)
    return descent


# ---------------------------------------------------------------- one bit


def test_a_file_with_a_digest_is_read_by_torch_and_by_zip(tmp_path):
    path, values = tmp_path / "a.pt", {"a": torch.arange(5.0), "n": [1, "x"]}
    path.write_bytes(state_files.pack(values))
    for read in (state_files.read(path), torch.load(path, weights_only=True)):
        assert torch.equal(read["a"], values["a"])
        assert read["n"] == values["n"]
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None


def test_no_changed_bit_of_learned_values_is_loaded(tmp_path):
    saved(tmp_path)
    path = tmp_path / "state_dict.pt"
    assert isinstance(learned_filter(path, SCENARIO), torch.nn.Module)
    for data in flipped(path.read_bytes(), 40):
        path.write_bytes(data)
        with pytest.raises(
            ValueError, match=r"^learned: expected .*state_dict\.pt to hold a state dictionary of fra: "
        ):
            learned_filter(path, SCENARIO)


def test_no_changed_bit_of_a_checkpoint_is_resumed_from(tmp_path, capsys):
    descent = saved(tmp_path, 1)
    path = tmp_path / "checkpoint.pt"
    assert descent.resume(path, "train")
    for data in flipped(path.read_bytes(), 40):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"no checkpoint in .* can be read"):
            descent.resume(path, "train")
        assert "checkpoint.pt is damaged and is not used" in capsys.readouterr().err


def test_a_changed_bit_of_what_torch_saved_never_changes_a_value(tmp_path):
    path, f = tmp_path / "f.pt", made(threshold=0.5)
    torch.save(f.state_dict(), path)
    refused = 0
    for data in flipped(path.read_bytes(), 40):
        path.write_bytes(data)
        try:
            found = learned_filter(path, SCENARIO).state_dict()
        except ValueError:
            refused += 1
        else:
            assert all(torch.equal(found[key], value) for key, value in f.state_dict().items())
    assert refused > 20


@pytest.mark.parametrize("signed", [True, False])
def test_what_would_take_a_hundred_times_the_memory_of_its_file_is_refused(signed, tmp_path):
    torch.save({"a": torch.zeros(100_000)}, tmp_path / "a.pt")
    with (
        zipfile.ZipFile(tmp_path / "a.pt") as plain,
        zipfile.ZipFile(tmp_path / "b.pt", "w", zipfile.ZIP_DEFLATED) as small,
    ):
        for part in plain.infolist():
            small.writestr(part.filename, plain.read(part))
    data = (tmp_path / "b.pt").read_bytes()
    assert len(data) < 4000
    (tmp_path / "b.pt").write_bytes(signature(data) if signed else data)
    with pytest.raises(ValueError, match=r"^it is damaged \(400\d\d\d bytes in a file of \d{4}\)$"):
        state_files.read(tmp_path / "b.pt")


def test_a_digest_does_not_make_an_archive_of_something_else(tmp_path):
    """Such as of a format whose numbers may claim any size."""
    torch.save({"a": torch.zeros(4)}, tmp_path / "a.pt", _use_new_zipfile_serialization=False)
    data = (tmp_path / "a.pt").read_bytes()
    (tmp_path / "a.pt").write_bytes(signature(data + b"PK"))
    with pytest.raises(ValueError, match=r"^it is damaged, or torch\.save did not write it$"):
        state_files.read(tmp_path / "a.pt")


# ---------------------------------------------------------------- values


@pytest.mark.parametrize("path", {str(hyper.constraint): path for path, hyper in hypers(made()).items()}.values())
@pytest.mark.parametrize("raw", [torch.nan, 1e6, -1e6])
def test_values_that_are_not_finite_or_out_of_range_are_refused_by_name(path, raw, tmp_path):
    f = made()
    hyper = hypers(f)[path]
    state = f.state_dict() | {f"{path}.raw": torch.full_like(hyper.raw, raw)}
    torch.save(state, tmp_path / "f.pt")
    hyper.raw.fill_(raw)
    value = hyper()
    if value.isfinite().all() and hyper.constraint.check(value).all():
        assert isinstance(learned_filter(tmp_path / "f.pt", SCENARIO), torch.nn.Module)
    else:
        with pytest.raises(ValueError, match=rf"of fra: .*{path}: expected .*, received (nan|inf|0\.0)"):
            learned_filter(tmp_path / "f.pt", SCENARIO)


def test_an_infinite_value_that_the_filter_has_itself_is_no_mistake():
    f = made(presets.rsrckf, threshold=torch.inf)
    state_files.load_values(f, f.state_dict())
    with pytest.raises(ValueError, match=r"^robust\.threshold: expected a value above 0 that is finite, received inf$"):
        state_files.load_values(made(presets.rsrckf), f.state_dict())


def test_numbers_that_are_no_hyperparameters_must_be_finite_too():
    f = made()
    state = f.state_dict()
    state["motion_rule.points"] = torch.full_like(state["motion_rule.points"], torch.nan)
    with pytest.raises(ValueError, match=r"^motion_rule\.points: expected finite numbers, received"):
        state_files.load_values(f, state)


# ---------------------------------------------------------------- other content


@pytest.mark.parametrize("content", [
    b"[]", b"3", b"null", b"{", b"", b"\xff\xfe", b"[" * 100_000, b'{"filter": "fra", "options": []}',
    b'{"filter": "fra", "options": null}', b'{"filter": "fra", "options": {"nope": 1}}',
    b'{"filter": "fra", "options": {"threshold": "x"}}', b'{"filter": "fra", "options": {"threshold": -1}}',
    b'{"filter": "fra", "options": {"motion": 1}}', b'{"filter": "fra", "options": {"learn": 5}}',
])  # fmt: skip
def test_settings_with_other_content_are_an_error_in_one_line(content, tmp_path, capsys):
    torch.save(made().state_dict(), tmp_path / "f.pt")
    (tmp_path / "config.json").write_bytes(content)
    arguments = ["compare", "--scenario", "bearings-outliers", "--filters", "srckf", "--runs", "1", "--quiet"]
    assert cli.main([*arguments, "--figure", str(tmp_path / "f.png"), "--learned", str(tmp_path / "f.pt")]) == 2
    said = capsys.readouterr().err
    assert f"learned: {tmp_path}/config.json: expected the settings of a training run" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("content", [[], 3, None, torch.zeros(3), {"a": 3}, {3: torch.zeros(1)}, {}])
@pytest.mark.parametrize("models", [True, False])
def test_other_content_than_values_is_refused(content, models, tmp_path):
    torch.save(content, tmp_path / "f.pt")
    with pytest.raises(ValueError, match=r"^learned: expected .*f\.pt to hold a state dictionary of fra: "):
        learned_filter(tmp_path / "f.pt", SCENARIO, models=models)


def others(good):
    """Checkpoints with other content."""
    yield from ([], {}, 3, None, torch.zeros(3), {"settings": 3}, good["values"])
    yield from (good | {key: 3.5} for key in good)
    yield from ({key: value for key, value in good.items() if key != missing} for missing in good)
    yield from (good | {key: {}} for key in ("best", "values", "optimiser"))
    yield good | {"rows": [3, 4]}
    yield good | {"rows": []}
    yield good | {"scores": torch.zeros(3)}
    for name in ("best", "values"):
        yield good | {name: {key: value.expand(3, *value.shape).clone() for key, value in good[name].items()}}
        yield good | {name: {key: torch.full_like(value, torch.nan) for key, value in good[name].items()}}


def test_a_checkpoint_with_other_content_is_not_used_and_the_one_before_it_is(tmp_path, capsys):
    descent = saved(tmp_path)
    newest = tmp_path / "checkpoint.pt"
    good = torch.load(newest, weights_only=True)
    for content in others(good):
        torch.save(content, newest)
        descent.iteration = 7
        assert descent.resume(newest, "train")
        assert descent.iteration == len(descent.rows) == 1
        assert "checkpoint.pt is damaged and is not used" in capsys.readouterr().err
        assert (tmp_path / "checkpoint-damaged.pt").exists()


def test_a_search_does_not_continue_from_the_state_of_another():
    training = prepare()
    search = Evolution(torch.zeros(3), step=0.1, population=4, seed=0)
    for state in ({}, training.optimiser.state_dict(), search.state_dict() | {"mean": torch.zeros(4)},
                  search.state_dict() | {"step": "x"}):  # fmt: skip
        with pytest.raises((KeyError, TypeError)):
            search.load_state_dict(state)
    search.load_state_dict(search.state_dict())


# ---------------------------------------------------------------- the good checkpoint


def test_a_full_disk_leaves_the_good_checkpoint_and_the_message_says_so(tmp_path, monkeypatch, capsys):
    descent, real, calls = saved(tmp_path), os.fsync, []
    before = (tmp_path / "checkpoint.pt").read_bytes()

    def fsync(descriptor):
        calls.append(descriptor)
        if len(calls) > 1:  # there is room for the one before
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor)

    monkeypatch.setattr(atomic_write.os, "fsync", fsync)
    descent.iteration = 3
    descent.rows.append(descent.rows[0])
    message = r"No space left on device, the checkpoint before is as it was: '.*/checkpoint\.pt'"
    with pytest.raises(OSError, match=message):
        tune.save(descent, tmp_path)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before
    assert (tmp_path / "checkpoint-previous.pt").read_bytes() == before
    assert not list(tmp_path.glob(".*"))
    assert tune.main(["noise", *SMALL, "--out", str(tmp_path / "new"), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert said == f"train: error: no space left on device: {tmp_path}/new/config.json\n"


def test_there_is_a_good_checkpoint_at_every_moment(tmp_path, monkeypatch):
    descent, moments = saved(tmp_path, 1), []

    def write(path, fill):
        moments.append((tmp_path / "checkpoint.pt").exists())
        return atomic_write.write(path, fill)

    for module in (tune, checkpoints):
        monkeypatch.setattr(module, "write", write)
    tune.save(descent, tmp_path)
    assert moments == [True] * 3


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_a_lone_checkpoint_of_the_one_before_is_not_overwritten_and_is_used(tmp_path, capsys):
    saved(tmp_path)
    (tmp_path / "checkpoint.pt").unlink()
    before = (tmp_path / "checkpoint-previous.pt").read_bytes()
    run = ["fra_bearings", *SMALL, "--out", str(tmp_path), "--quiet"]
    assert tune.main(run) == 2
    assert "holds a run already: --resume continues it" in capsys.readouterr().err
    assert tune.main([*run, "--resume"]) == 0
    assert capsys.readouterr().err == f"train: {tmp_path}/checkpoint-previous.pt is used\n"
    assert (tmp_path / "checkpoint-previous.pt").read_bytes() == before
    assert json.loads((tmp_path / "results.json").read_text())["iterations"] == 2


def test_json_takes_integers_of_numpy_as_numbers(tmp_path):
    held = {"runs": np.int64(3), "compiled": True, "error": float("nan")}
    path = atomic_write.write_json(tmp_path / "settings.json", held)
    assert json.loads(path.read_text()) == {"runs": 3, "compiled": True, "error": None}
