"""What several test files share."""

import copy
import os
import shutil

import pytest
import torch
from short_tracks import short

from torchfra import presets, scenarios
from torchfra.kernel import compilers

PRESETS = ["ekf", "ukf", "srckf", "rsrckf", "mr_ckf", "asrckf", "rmckf", "iaukf", "fra_srckf", "fra", "gpb"]
STEPS = 12


def pytest_addoption(parser):
    parser.addoption("--thorough", action="store_true", help="all combinations of options in the battery of filters")


@pytest.fixture(scope="session")
def scenario():
    """Outliers, and an initial state near the truth."""
    return scenarios.bearings_outliers("std", initial="truth")


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
    """Three runs of 25 scans."""
    t = crossing.simulate(3, 3)
    return t._replace(truth=t.truth[:, :, :25], z=t.z[:, :25])


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
def short_tracks():
    """Scenarios that are made by the test have few steps."""
    with short():
        yield


@pytest.fixture(scope="session", autouse=True)
def kernels(tmp_path_factory):
    """Kernels of this session alone, compiled in a hurry: not optimised."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.getbasetemp()  # of one worker, where there are several
        folder = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "kernels"
        patch.setenv("TORCHFRA_CACHE", str(folder))
        patch.setenv("CXXFLAGS", f"-O0 {quick_linker()}")
        yield


def quick_linker():
    """The option for a linker that reads torch's symbols in a third of the time, where there is one."""
    gold = compilers.find().family == "gcc" and shutil.which("ld.gold")
    return "-fuse-ld=gold" if gold else ""
