"""What the script of other Pythons and torches tries, and what it refuses; it is run by CI itself."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts/versions.sh"


def versions(*arguments):
    return subprocess.run(["bash", SCRIPT, *arguments], capture_output=True, text=True, check=False, timeout=30)


def test_the_tests_that_are_named_are_there():
    (named,) = re.findall(r"^tests=\((.*?)\)", SCRIPT.read_text(), re.M | re.S)
    assert len(named.split()) > 10
    assert [name for name in named.split() if not [*ROOT.glob(f"tests/*/test_{name}.py")]] == []
    (quick,) = re.findall(r" tests/\{(.*?)\}\.py", (ROOT / "scripts/test.sh").read_text())
    assert [name for name in quick.split(",") if not (ROOT / "tests" / f"{name}.py").exists()] == []


def test_what_is_tried_without_arguments_are_versions_that_the_package_takes():
    (tried,) = re.findall(r"^tried=\((.*?)\)", SCRIPT.read_text(), re.M)
    project = (ROOT / "pyproject.toml").read_text()
    said = set(re.findall(r"Programming Language :: Python :: (3\.\d+)", project))
    assert {one.split(":")[0] for one in tried.split()} == said
    assert {f"torch>={one.split(':')[1].rpartition('.')[0]}" for one in tried.split()} >= set(
        re.findall(r"torch>=[\d.]+", project)
    )


@pytest.mark.parametrize("argument", ["3.12", "3.12:", "torch:2.7", "--all", "3.12:2"])
def test_an_argument_that_is_no_pair_of_versions_is_refused(argument):
    done = versions("3.98:2.99.1", argument)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"versions: expected PYTHON:TORCH such as 3.12:2.7.1 or 3.11:newest, received {argument}\n"


def test_help_says_what_is_tried():
    done = versions("--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "usage: bash scripts/versions.sh [--quick] [PYTHON:TORCH ...]" in done.stdout
    assert "3.10:2.4.1" in done.stdout
