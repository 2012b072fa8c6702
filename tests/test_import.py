"""Importing the package imports torch, itself and no more: what is slow or optional is imported when it is used."""

import importlib
import pkgutil
import subprocess
import sys

import pytest

import torchfra

CODE = """
import runpy, sys
import torch
before = set(sys.modules)

def new():
    found = set(sys.modules) - before
    here = set(sys.stdlib_module_names) | {"torchfra", "torch", "numpy"}
    others = {name for name in found if name.split(".")[0] not in here}
    slow = {name for name in found if name.startswith(("torch._dynamo", "torch._inductor", "torch.distributed"))}
    print("new:", *sorted(others | slow))

import torchfra
new()
sys.argv = ["torchfra", "--help"]
try:
    runpy.run_module("torchfra", run_name="__main__")
except SystemExit as end:
    assert not end.code
new()
scenario = torchfra.scenarios.bearings_outliers()
tracks = scenario.simulate(2, 0)
f = torchfra.presets.srckf(scenario.motion, scenario.sensor)
f(tracks.z[:, :3], tracks.prior, u=tracks.u[:3])
print("new:", *{"sympy", "torch._dynamo"} & (set(sys.modules) - before))
f.compile()(tracks.z[:, :3], tracks.prior, u=tracks.u[:3])
print("new:", *(["torch._dynamo"] if "torch._dynamo" in sys.modules else []))
"""


@pytest.fixture(scope="module")
def imported():
    """What one process has imported after each of four steps."""
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    return [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("new:")]


@pytest.mark.slow
@pytest.mark.parametrize("step", [0, 1], ids=["the package", "its command"])
def test_nothing_but_torch_and_itself_is_imported(step, imported):
    assert imported[step] == []


def test_no_function_hides_a_package_so_that_what_is_inside_can_be_imported():
    import torchfra.fitting.data as inside

    assert inside.batch_of
    packages = [found.name for found in pkgutil.walk_packages(torchfra.__path__, "torchfra.") if found.ispkg]
    assert len(packages) > 20
    for name in packages:
        package = importlib.import_module(name)
        above, _, last = name.rpartition(".")
        assert getattr(importlib.import_module(above), last) is package, name


def test_a_filter_runs_without_symbolic_algebra_and_the_compiler_of_torch(imported):
    assert imported[2] == []


def test_a_compiled_srckf_runs_without_the_compiler_of_torch(imported):
    assert imported[3] == []


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
