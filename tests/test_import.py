"""Importing the package imports torch, itself and no more: what is slow or optional is imported when it is used."""

import importlib
import pkgutil
import subprocess
import sys

import pytest

import torchfra

HELP = """
sys.argv = ["torchfra", "--help"]
try:
    runpy.run_module("torchfra", run_name="__main__")
except SystemExit as end:
    assert not end.code
"""


@pytest.mark.parametrize("what", ["import torchfra", HELP], ids=["the package", "its command"])
def test_nothing_but_torch_and_itself_is_imported(what):
    code = f"""
import runpy, sys
import torch
before = set(sys.modules)
{what}
new = set(sys.modules) - before
here = set(sys.stdlib_module_names) | {{"torchfra", "torch", "numpy"}}
others = {{name for name in new if name.split(".")[0] not in here}}
slow = {{name for name in new if name.startswith(("torch._dynamo", "torch._inductor", "torch.distributed"))}}
print(*sorted(others | slow), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.split() == []


def test_no_function_hides_a_package_so_that_what_is_inside_can_be_imported():
    import torchfra.fitting.data as inside

    assert inside.batch_of
    packages = [found.name for found in pkgutil.walk_packages(torchfra.__path__, "torchfra.") if found.ispkg]
    assert len(packages) > 20
    for name in packages:
        package = importlib.import_module(name)
        above, _, last = name.rpartition(".")
        assert getattr(importlib.import_module(above), last) is package, name


def test_a_compiled_srckf_runs_without_the_compiler_of_torch():
    code = """
import sys
import torch, torchfra
scenario = torchfra.scenarios.bearings_outliers()
tracks = scenario.simulate(2, 0)
torchfra.presets.srckf(scenario.motion, scenario.sensor).compile()(tracks.z[:, :3], tracks.prior, u=tracks.u[:3])
print("torch._dynamo" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


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
