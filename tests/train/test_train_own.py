"""Training takes simulators of one's own by ``file.py:function``, and recordings by their files."""

import json

import pytest

from train import tune
from train.config import Task
from train.runs import configured

pytestmark = pytest.mark.usefixtures("rough_figures")

SIMULATOR = '''
import torch
import torchfra
from torchfra.scenarios import Scenario, Tracks


def drifting(q=0.5):
    """Targets that drift, as a constant velocity with this process noise, measured with 2 m."""
    motion, sensor = torchfra.motion.ConstantVelocity(q), torchfra.sensors.Position(2.0)
    prior = torchfra.Gaussian(torch.zeros(4).double(), 10 * torch.eye(4).double())

    def block(rng, numbers):
        def draw(*shape):
            return torch.as_tensor(rng.normal(size=(len(numbers), *shape)))

        x, states = 10 * draw(4), []
        for push in draw(20, 2).unbind(1):
            push = q**0.5 * push
            x = torch.cat([x[:, :2] + x[:, 2:] + push / 2, x[:, 2:] + push], 1)
            states.append(x)
        truth = torch.stack(states, 1)
        mean = prior.mean.expand(len(numbers), 4)
        return Tracks(truth, truth[..., :2] + 2 * draw(20, 2), None, torchfra.Gaussian(mean, prior.scale_tril))

    return Scenario("drifting", motion, sensor, prior, 1.0, 20, block, {"q": q})


def wrong():
    return 1
'''
SMALL = ("iterations=10", "batch=8", "validate_every=10", "validation_runs=4", "test_runs=0", "lr=0.2",
         "compile=false", 'start={"std":5.0}')  # fmt: skip


@pytest.fixture
def simulator(tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text(SIMULATOR)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "own.py"


def test_a_run_learns_on_a_simulator_of_ones_own(simulator, tmp_path):
    out = tmp_path / "run"
    changes = ["scenario=own.py:drifting", "learn=std", *SMALL]
    assert tune.main(["noise", *changes, "--out", str(out), "--quiet"]) == 0
    result = json.loads((out / "results.json").read_text())
    assert result["values"]["start"]["sensor.std"] == pytest.approx(5.0)
    assert result["values"]["learned"]["sensor.std"] == pytest.approx(2.0, rel=0.5)
    assert [task["scenario"] for task in result["config"]["tasks"]] == ["own.py:drifting"]


def test_its_function_takes_the_options_of_a_task(simulator):
    task = Task("own.py:drifting", {"q": 2.0})
    assert tune.Training(configured("noise", [f"tasks={json.dumps([vars(task)])}"])).scenarios[0].settings["q"] == 2.0


def test_names_of_the_catalogue_and_places_make_several_tasks():
    tasks = configured("noise", ["scenario=bearings-outliers,own.py:drifting"]).tasks
    assert tasks == (Task("bearings-outliers"), Task("own.py:drifting"))


@pytest.mark.parametrize(("changes", "message"), [
    (["scenario=own.py:nothing"], "expected own.py to have a function nothing, received nothing; it has drifting"),
    (["scenario=own.py:wrong"], "own.py:wrong: expected () to return a Scenario, received int"),
    (['tasks=[{"scenario":"own.py:drifting","options":{"speed":1}}]'], "speed: own.py:drifting takes no such option"),
    (["scenario=sonar"], "scenario: expected one of bearings-outliers"),
    (["scenario="], "tasks, learn: expected at least one of each"),
    (["files=a.csv"], "files: expected a task 'recorded' beside them, received tasks bearings-outliers"),
])  # fmt: skip
def test_what_cannot_be_learned_on_is_said_before_any_work(simulator, tmp_path, capsys, changes, message):
    assert tune.main(["noise", *changes, "--out", str(tmp_path / "x")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_recordings_of_ones_own_are_learned_from_without_a_truth(tmp_path):
    files = []
    for number in range(5):
        files.append(str(tmp_path / f"{number}.csv"))
        rows = [f"{4 * i},{400 * i + (i * 7919 % 41)},{(10 * number) * i + (i * 104729 % 37)}" for i in range(130)]
        (tmp_path / files[-1]).write_text("\n".join(["t,x,y", *rows]))
    few = ("iterations=1", "batch=2", "validation_runs=1", "test_runs=1", "compile=false")
    arguments = ["scenario=recorded", f"files={','.join(files)}", *few, "--out", str(tmp_path / "run"), "--quiet"]
    assert tune.main(["fra_recorded", *arguments]) == 0
    assert json.loads((tmp_path / "run" / "config.json").read_text())["files"] == files
