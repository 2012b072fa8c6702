"""Small errors that are put into the code: which there are, and that the script tells those that no test finds."""

import json
import re
import subprocess
import sys
from pathlib import Path

import mutants
import pytest

ROOT = Path(__file__).parents[2]


def changes(tmp_path, code):
    (tmp_path / "a.py").write_text(code)
    return [mutant.text for mutant in mutants.mutants(tmp_path / "a.py")]


def test_operators_comparisons_numbers_calls_and_statements_are_changed(tmp_path):
    assert changes(tmp_path, "x = a + 2") == ["a + 2  ->  a - 2", "2  ->  3"]
    assert changes(tmp_path, "x = a < -b") == ["a < -b  ->  a <= -b", "a < -b  ->  a >= -b", "-b  ->  b"]
    assert changes(tmp_path, "x = torch.where(a, b, c).mT") == [
        "torch.where(a, b, c).mT  ->  torch.where(a, b, c)", "torch.where(a, b, c)  ->  torch.where(a, c, b)"
    ]  # fmt: skip
    assert changes(tmp_path, "x = y.detach().amax(k)") == [
        "y.detach().amax(k)  ->  y.detach().amin(k)", "y.detach()  ->  y"
    ]  # fmt: skip
    assert changes(tmp_path, "if a:\n    f(b)") == ["if a: f(b)  ->  if not a: f(b)", "f(b)  ->  pass"]


def test_texts_annotations_messages_and_assertions_stay(tmp_path):
    code = """
'''A text of 3 lines.'''
from a import b
__all__ = ["b"] + []
@cached(3)
def f(x: Literal[3]) -> Literal[4]:
    '''Another.'''
    assert x < 4
    zip(a, b, strict=True)
    raise ValueError(f"expected {x + 1}")
"""
    assert changes(tmp_path, code) == [
        "zip(a, b, strict=True)  ->  pass", "raise ValueError(f'expected {x + 1}')  ->  pass"
    ]  # fmt: skip


def test_a_change_is_tried_by_what_runs_the_lines_of_its_statement_without_those_of_its_body(tmp_path):
    code = ["def f(a,", "      b=1):", "    if (a", "            > 2):", "        return g(", "            a + 3)"]
    (tmp_path / "a.py").write_text("\n".join(code))
    lines = {mutant.text: [*mutant.lines] for mutant in mutants.mutants(tmp_path / "a.py")}
    assert lines["1  ->  2"] == [1, 2, 3, 4, 5, 6]
    assert lines["2  ->  3"] == [3, 4]
    assert lines["a + 3  ->  a - 3"] == lines["return g(a + 3)  ->  return None"] == [5, 6]


@pytest.mark.slow
def test_what_no_test_finds_is_said_and_no_file_is_changed(tmp_path):
    before = {path: path.read_bytes() for path in (ROOT / "torchfra/robust").glob("*.py")}
    given = ["--rooms", "robust", "--tests", "huber_determined", "--sample", "4", "--seed", "1"]
    command = [sys.executable, ROOT / "scripts/mutants.py", *given, "--json", tmp_path / "a.json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    found, tried, left = map(int, re.search(r"(\d+) of (\d+) found, .*; there are (\d+)", done.stdout).groups())
    assert 0 <= found < tried <= 4 < left  # which they are depends on the code; some cannot be put in
    survivors = json.loads((tmp_path / "a.json").read_text())["survivors"]
    assert len(survivors) == tried - found
    assert "no test runs it" in {x["verdict"] for x in survivors}
    assert all(f"{x['where']}: {x['change']} (" in done.stdout for x in survivors)
    assert {path: path.read_bytes() for path in before} == before
