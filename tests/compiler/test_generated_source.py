"""Generated source can be read: it names the fields and inputs of a step, and the lines that each part came from."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import torchfra
from torchfra import presets
from torchfra.compiler.export import export
from torchfra.compiler.step import Input, Step
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

LIBRARY = Path(torchfra.__file__).parent
ORIGIN = re.compile(r"// (?:(?:gradient|derivative) of )?(\S+):(\d+) (\S+)$", re.MULTILINE)


class Slower(Position):
    """A sensor of a user, in this file."""

    def forward(self, x, u=None):
        return 0.5 * super().forward(x)


def exported():
    return export(presets.srckf(ConstantVelocity(0.1), Slower(2.0)), "tracker")["tracker.cpp"]


@pytest.fixture(scope="module")
def source():
    return exported()


def test_inputs_state_and_outputs_have_the_names_of_their_fields(source):
    step = source.partition("namespace advance")[2]
    for name in ("z_0", "z_1", "dt", "belief_mean_3", "belief_scale_tril_0", "next_belief_mean_3", "log_likelihood"):
        assert re.search(rf"const Scalar {name} = ", step), name
    declared = re.findall(r"const (?:Scalar|bool) (\w+) = [^;]*;", step)
    assert len(declared) > 100
    assert not re.search(r"_r\d+\(", step)  # no routines: it is not large


def test_comments_name_lines_of_functions_that_exist_and_none_of_the_tracing(source):
    origins = set(ORIGIN.findall(source))
    assert {"gaussian/update.py", "linalg/triangular.py", Path(__file__).name} <= {file for file, *_ in origins}
    for file, line, name in sorted(origins):
        assert not file.startswith("compiler/")
        path = Path(__file__) if file == Path(__file__).name else LIBRARY / file
        tree = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        spans = [range(f.lineno, f.end_lineno + 1) for f in tree if getattr(f, "name", None) == name]
        assert any(int(line) in span for span in spans), (file, line, name)


@pytest.mark.slow
def test_another_process_writes_the_same_text(source):
    code = "import sys, test_generated_source as t; sys.stdout.write(t.exported())"
    command = [sys.executable, "-c", code]
    again = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    assert again.stdout == source


def advance(module, state, data):
    return (state[0] * data["z"].sin(),), (state[0].exp(),)


def test_a_gradient_names_the_lines_it_is_the_gradient_of():
    inputs = {"z": Input(torch.Size([2]), True, False)}
    step = Step(torch.nn.Module(), lambda *_: (torch.ones(2, dtype=torch.float64),), advance, inputs, torch.float64)
    text = step.backwards((True,), ("z",)).cuda()
    line = advance.__code__.co_firstlineno + 1
    assert f"// gradient of {Path(__file__).name}:{line} advance\n" in text
    assert "gradient_state_part0_1 = " in text
    assert f"// derivative of {Path(__file__).name}:{line} advance\n" in step.tangent(("z",)).cuda()
