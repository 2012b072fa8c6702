"""A type checker knows what a filter's call and its states are, in code of a user's own."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CODE = """
from torch import Tensor
import torchfra
from torchfra import presets
from torchfra.filters import GPBState, JPDAState

scenario = torchfra.scenarios.bearings_outliers()
tracks = scenario.simulate(runs=2, seed=0)
gpb = presets.gpb(scenario.motion, scenario.sensor).compile()
mean: Tensor = gpb(tracks.z, tracks.prior, u=tracks.u).mean
state: GPBState = gpb.init(scenario.prior)
state, innovation = gpb.step(state, tracks.z[0, 0])
nis: Tensor = innovation.nis
jpda = presets.jpda(scenario.motion, scenario.sensor, clutter=torchfra.association.Clutter(1.0, rate=3.0))
scans: JPDAState = jpda.init(scenario.prior)
"""
WRONG = {
    "x: int = gpb(tracks.z, tracks.prior).mean": '"Tensor", variable has type "int"',
    "x: int = gpb.init(scenario.prior)": '"GPBState", variable has type "int"',
    "x: int = state.lagged": '"Gaussian", variable has type "int"',
    "x: int = scans": '"JPDAState", variable has type "int"',
    "gpb(tracks.z, tracks.prior, v=tracks.u)": 'Unexpected keyword argument "v"',
    "gpb.step(scans, tracks.z)": 'expected "GPBState"',
    "x: int = presets.srckf(scenario.motion, scenario.sensor)(tracks.z, tracks.prior)": '"Estimate", variable has',
    "x: int = presets.alphabeta(scenario.motion, scenario.sensor).init(scenario.prior)": '"AlphaBetaBankState", var',
}  # fmt: skip


@pytest.mark.slow
def test_a_type_checker_accepts_what_is_right_and_names_every_line_that_is_wrong(tmp_path):
    pytest.importorskip("mypy")
    path = tmp_path / "users.py"
    path.write_text(CODE + "\n".join(line.replace("x:", f"x{i}:") for i, line in enumerate(WRONG)) + "\n")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--no-color-output", "--no-error-summary", path],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    found = {int(line.split(":")[1]): line for line in done.stdout.splitlines() if ": error: " in line}
    first = CODE.count("\n") + 1
    assert sorted(found) == list(range(first, first + len(WRONG))), done.stdout + done.stderr
    for number, message in enumerate(WRONG.values(), first):
        assert message in found[number]
