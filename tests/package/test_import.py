"""What is imported when: nothing before it is named, for a filter what filters need, what is slow when it is used."""

import importlib
import os
import pkgutil
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import torchfra

LIBRARY, TESTS = Path(torchfra.__file__).parent, Path(__file__).parents[1]
CORE = {
    "adaptive", "angles", "association", "coordinates", "entries", "filters", "gaussian", "hyper", "linalg", "loading",
    "motion", "numbers", "presets", "register", "robust", "sensors", "steps", "suggestions", "tables", "tree", "types",
    "version",
}  # fmt: skip
"""The parts of the package that a filter needs."""
FILTER = """
motion, sensor = torchfra.motion.ConstantVelocity(1.0, 2), torchfra.sensors.Position(torch.tensor([3.0, 3.0]), dims=2)
prior = torchfra.Gaussian(torch.zeros(4), 10 * torch.eye(4))
f = torchfra.presets.{preset}(motion, sensor)
assert f.smooth(torch.ones(5, 2), prior).mean.isfinite().all()
"""
CODE = f"""
import runpy, sys
import torchfra

def loaded():
    print("loaded:", *(name for name in sys.modules if name.split(".")[0] in ("torch", "numpy", "torchfra")))

loaded()
sys.argv = ["torchfra", "--help"]
try:
    runpy.run_module("torchfra", run_name="__main__")
except SystemExit as end:
    assert not end.code
loaded()
import torch
before = set(sys.modules)
torchfra.presets
here = set(sys.stdlib_module_names) | {{"torchfra", "torch", "numpy"}}
slow = ("torch._dynamo", "torch._inductor", "torch.distributed")
print("loaded:", *(name for name in set(sys.modules) - before
                   if name.split(".")[0] not in here or name.startswith(slow)))
{FILTER.format(preset="srckf")}
print("loaded:", *{{"sympy", "torch._dynamo"}} & (set(sys.modules) - before))
loaded()
f.compile()(torch.ones(5, 2).requires_grad_(), prior).mean.sum().backward()
from torchfra.evaluation.fixes import fixes
scenario = torchfra.scenarios.bearings_outliers()
assert fixes(scenario, scenario.simulate(1, 0)).isfinite().any()
print("loaded:", *{{"sympy", "torch._dynamo", "torch.distributed.tensor"}} & (set(sys.modules) - before))
"""


@pytest.fixture(scope="module")
def imported():
    """What one process has imported after each of six steps."""
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    return [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("loaded:")]


@pytest.mark.slow
def test_importing_the_package_imports_nothing_but_its_version(imported):
    assert imported[0] == ["torchfra.version", "torchfra.loading", "torchfra"]


def test_the_help_of_the_command_needs_neither_torch_nor_numpy(imported):
    assert "torchfra.cli.main" in imported[1]
    assert [name for name in imported[1] if not name.startswith("torchfra")] == []


def test_filters_import_nothing_but_torch_and_the_package(imported):
    assert imported[2] == []


def test_a_filter_runs_without_symbolic_algebra_and_the_compiler_of_torch(imported):
    assert imported[3] == []


def test_a_filter_loads_what_filters_need_and_nothing_else(imported):
    command = set(imported[1])  # which the help has loaded
    parts = {name.split(".")[1] for name in set(imported[4]) - command if name.startswith("torchfra.")}
    assert parts == CORE - {"coordinates", "entries"} - {"loading", "suggestions", "tables", "version"}


def test_a_compiled_srckf_and_its_gradient_are_made_without_what_torch_takes_half_a_second_to_load(imported):
    assert imported[5] == []


def test_pictures_of_a_track_need_no_filters_and_no_evaluation():
    code = (
        "import sys, torchfra.cleaning.figures; print(*(name for name in sys.modules if name.startswith('torchfra.')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    rooms = {name.split(".")[1] for name in done.stdout.split()}
    assert rooms >= {"plotting", "cleaning"}
    assert not rooms & {"presets", "filters", "scenarios", "evaluation", "catalogue"}


# ---------------------------------------------------------------- names


def test_every_name_at_the_top_is_there_and_is_shown():
    assert {*torchfra.__all__, "__version__"} == set(dir(torchfra))
    assert [name for name in dir(torchfra) if not hasattr(torchfra, name)] == []


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'torchfra' has no attribute 'preset'"):
        torchfra.preset  # noqa: B018


def test_no_function_hides_a_package_so_that_what_is_inside_can_be_imported():
    import torchfra.fitting.data as inside

    assert inside.batch_of
    packages = [found.name for found in pkgutil.walk_packages(torchfra.__path__, "torchfra.") if found.ispkg]
    assert len(packages) > 20
    for name in packages:
        package = importlib.import_module(name)
        above, _, last = name.rpartition(".")
        assert getattr(importlib.import_module(above), last) is package, name


# ---------------------------------------------------------------- a room that is gone


@pytest.fixture(scope="module")
def core(tmp_path_factory):
    """Runs Python beside copies of the tests and of the package; no part of it is left but those that filters need."""
    root = tmp_path_factory.mktemp("core")
    for folder in (LIBRARY, TESTS):
        shutil.copytree(folder, root / folder.name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(TESTS.parent / "pyproject.toml", root)
    gone = [path for path in (root / "torchfra").iterdir() if path.stem not in CORE | {"__init__", "py"}]
    for path in gone:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert {"cleaning", "cli", "fitting", "readers", "scenarios", "stream", "targets"} <= {path.stem for path in gone}

    def run(*arguments):
        environment = os.environ | {"PYTHONPATH": str(root)}
        return subprocess.run(
            [sys.executable, *arguments], cwd=root, env=environment, capture_output=True, text=True, check=False
        )

    return run


@pytest.mark.slow
def test_filters_and_their_tests_run_where_every_part_that_they_do_not_need_is_deleted(core):
    lines = "".join(FILTER.format(preset=preset) for preset in ("gpb", "fra", "hghckf", "iaukf"))
    files = [f"tests/filters/test_{name}.py" for name in ("own_sides", "predict")]
    arguments = ["--noconftest", "-p", "no:cacheprovider", "-k", "not compiled", *files]
    code = f"import pytest, torch, torchfra{lines}print(torchfra.presets.jpda, torchfra.__file__)\n"
    done = core("-c", f"{code}raise SystemExit(pytest.main({arguments}))")
    assert done.returncode == 0, done.stdout + done.stderr
    assert str(LIBRARY) not in done.stdout.splitlines()[0]


# ---------------------------------------------------------------- systems


@pytest.mark.slow
def test_the_package_runs_where_there_is_no_fcntl_as_on_windows():
    code = """
import sys
import torch  # which brings what the standard library has for this system
sys.modules["fcntl"], sys.platform = None, "win32"
import torchfra
scenario = torchfra.scenarios.bearings_outliers()
tracks = scenario.simulate(2, 0)
print(torchfra.presets.srckf(scenario.motion, scenario.sensor)(tracks.z, tracks.prior, u=tracks.u).failed.any().item())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
