"""What several test files share."""

import copy
import dataclasses
import gc
import math
import os
import sys

import joint
import pytest
import torch
from short_tracks import short

from torchfra import keep_memory, presets, scenarios
from torchfra.compiler import jit, llvm
from torchfra.compiler.engine import Compiled
from torchfra.motion import Bank, ConstantVelocity, CoordinatedTurn
from torchfra.types import Gaussian

keep_memory()  # as the command does in its processes
gc.disable()  # while modules are imported and tests are collected, of which nothing is garbage

OPTIMISED = {"test_divisions", "test_every_filter_compiles", "test_generated_source", "test_processors", "test_regions"}
"""Tests whose kernels are those that users have; in others LLVM does not optimise them, which is twice as fast."""
LEVEL = jit._LEVEL
PRESETS = ["ekf", "ukf", "srckf", "rsrckf", "mr_ckf", "asrckf", "rmckf", "iaukf", "fra_srckf", "fra", "gpb"]
STEPS = 8


def pytest_addoption(parser):
    parser.addoption("--thorough", action="store_true", help="all combinations of options in the battery of filters")
    parser.addoption("--draws", type=int, metavar="N", help="so many random settings of filters, others each time")


def pytest_collection_modifyitems(items):
    """Files with slow tests come first, so that no worker begins with one when the others have nothing left to do.

    Each file stays whole, and its fixtures are made once.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_collection_finish():
    """From here on garbage is collected, without looking through modules and tests each time."""
    gc.freeze()
    gc.set_threshold(50_000)  # writing a kernel makes many objects, of which few are garbage
    gc.enable()


@pytest.fixture
def write(tmp_path):
    """Writes a file for a reader: a text, or lines of one."""

    def write(lines, name="a.csv"):
        path = tmp_path / name
        path.write_text(lines if isinstance(lines, str) else "\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write


def without_acceleration(whole):
    """A scenario of bearings whose filters know position and velocity alone: their kernels are small."""

    def known(belief):
        return Gaussian(belief.mean[..., :4].contiguous(), belief.scale_tril[..., :4, :4].contiguous())

    def block(rng, numbers):
        drawn = whole.block(rng, numbers)
        return drawn._replace(truth=drawn.truth[..., :4].contiguous(), prior=known(drawn.prior))

    motion = ConstantVelocity(0.1)
    turns = [CoordinatedTurn(side * math.pi / 10, 0.1) for side in (1, -1)]
    bank = Bank([motion, *turns], neighbours=((1, 2), (0, 2), (0, 1)), first=(0, 1, 2))
    return dataclasses.replace(whole, motion=motion, prior=known(whole.prior), block=block, bank=bank, law=None)


@pytest.fixture(scope="session")
def scenario():
    """Outliers, and an initial state near the truth."""
    return without_acceleration(scenarios.bearings_outliers("std", initial="truth"))


@pytest.fixture(scope="session")
def tracks(scenario):
    """Four short tracks: an outlier, a missing element, a missing step."""
    t = scenario.simulate(4, 0)
    z = t.z[:, :STEPS].clone()
    z[0, 3, 0] = torch.nan
    z[1, 5] = torch.nan
    z[2, 4, 1] += 0.3
    return t._replace(z=z, u=t.u[:STEPS], truth=t.truth[:, :STEPS])


@pytest.fixture(scope="session")
def crossing():
    """Two targets that cross among false measurements, under measurement noise that grows."""
    return scenarios.clutter_crossing(noise_scale=4.0, change=8)


@pytest.fixture(scope="session")
def scans(crossing):
    """Three runs of the first scans."""
    t = crossing.simulate(3, 3)
    return t._replace(truth=t.truth[:, :, : joint.STEPS], z=t.z[:, : joint.STEPS])


@pytest.fixture
def make(scenario):
    """Makes a preset with models of its own, so that one that learns does not change another."""

    def build(name, **options):
        motion, sensor = copy.deepcopy(scenario.motion), copy.deepcopy(scenario.sensor)
        return getattr(presets, name)(motion, sensor, **options)

    return build


@pytest.fixture(autouse=True)
def seeded():
    """Random numbers of a test are the same in every run."""
    torch.manual_seed(0)


@pytest.fixture
def prepared(monkeypatch):
    """How often tracks had to be checked and prepared."""
    seen = []
    forward = Compiled.scan
    monkeypatch.setattr(Compiled, "scan", lambda *given: seen.append(1) or forward(*given))
    return seen


@pytest.fixture
def short_tracks():
    """Scenarios that are made by the test have few steps."""
    with short():
        yield


@pytest.fixture
def rough_figures(monkeypatch):
    """Figures have few dots, and no search for the places of their axes: both take most of the time."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    save = Figure.savefig
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda engine, figure: {})
    monkeypatch.setattr(Figure, "savefig", lambda figure, *given, **named: save(figure, *given, **named | {"dpi": 60}))


@pytest.fixture
def no_compiler(monkeypatch):
    """As where llvmlite is not installed."""
    for function in (llvm.binding, llvm.is_installed, llvm.missing):
        function.cache_clear()
    for name in ("llvmlite", "llvmlite.binding"):
        monkeypatch.setitem(sys.modules, name, None)
    yield
    monkeypatch.undo()
    for function in (llvm.binding, llvm.is_installed, llvm.missing):
        function.cache_clear()


@pytest.fixture(scope="module", autouse=True)
def optimised(request):
    """Whether LLVM optimises kernels: see ``OPTIMISED``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jit, "_LEVEL", LEVEL if request.module.__name__ in OPTIMISED else 0)
        yield


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory):
    """Kernels of this session alone, and bytecode for its processes where Python is told to write none."""
    folder = tmp_path_factory.getbasetemp()  # of one worker, where there are several
    folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHFRA_CACHE", str(folder / "kernels"))
        if os.environ.get("PYTHONDONTWRITEBYTECODE"):
            patch.delenv("PYTHONDONTWRITEBYTECODE")
            patch.setenv("PYTHONPYCACHEPREFIX", str(folder / "bytecode"))
        yield
