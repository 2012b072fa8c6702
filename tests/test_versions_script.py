"""Other Pythons and torches are tried as far as they can be had, and only tests that fail are a failure."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
UV = """#!/bin/bash
last=${@: -1}
case "$1 $2" in
  "build "*) [ -z "$NO_TOOLS" ] || { echo "no setuptools" >&2; exit 1; }
    mkdir -p "$4/t/torchfra" && touch "$4/t.whl" && tar -czf "$4/t.tar.gz" -C "$4" t ;;
  "venv "*) mkdir -p "$last/bin" && printf '%s\\n' '#!/bin/bash' \\
    'case $1 in -c) echo 2.99.1+cpu ;; -m) echo "pytest $*"; exit $STATUS ;; esac' > "$last/bin/python"
    chmod +x "$last/bin/python" ;;
  "pip install") echo "no solution, because there is no $*" >&2; [[ "$*" != *torch==2.0* ]] ;;
esac
"""
"""Stands for uv: gives all but torch 2.0."""


def versions(folder, *arguments, **environment):
    """What the script says where there is a uv that gives no torch 2.0, and a Python 3.98."""
    for name, text in {
        "uv": UV,
        "python3.98": "#!/bin/bash\necho 3.98\n",
        "df": "#!/bin/bash\necho 1 1 1 9999999\n",
    }.items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    (folder / "tmp").mkdir()
    variables = {"PATH": f"{folder}:/usr/bin:/bin", "HOME": str(folder), "TMPDIR": str(folder / "tmp"), "STATUS": "0"}
    command = ["bash", str(ROOT / "scripts/versions.sh"), *arguments]
    done = subprocess.run(command, env=variables | environment, capture_output=True, text=True, check=False, timeout=30)
    assert list((folder / "tmp").iterdir()) == []
    return done


def test_the_tests_that_are_named_are_there():
    (named,) = re.findall(r"^tests=\((.*?)\)", (ROOT / "scripts/versions.sh").read_text(), re.M | re.S)
    assert len(named.split()) > 10
    assert [name for name in named.split() if not (ROOT / f"tests/test_{name}.py").exists()] == []


def test_what_is_tried_without_arguments_are_versions_that_the_package_takes():
    (tried,) = re.findall(r"^tried=\((.*?)\)", (ROOT / "scripts/versions.sh").read_text(), re.M)
    project = (ROOT / "pyproject.toml").read_text()
    said = set(re.findall(r"Programming Language :: Python :: (3\.\d+)", project))
    assert {one.split(":")[0] for one in tried.split()} == said
    assert {f"torch>={one.split(':')[1].rpartition('.')[0]}" for one in tried.split()} >= set(
        re.findall(r"torch>=[\d.]+", project)
    )


def test_each_is_passed_or_not_to_be_had_which_is_no_failure(tmp_path):
    done = versions(tmp_path, "3.98:2.99.1", "3.97:2.99.1", "3.98:2.0.1", "3.98:newest")
    assert done.returncode == 0, done.stderr
    first, second, third, last = done.stdout.splitlines()[-4:]
    assert re.fullmatch(r"Python 3\.98, torch 2\.99\.1\+cpu: passed, \d+ s", first)
    assert second == "Python 3.97, torch 2.99.1: not to be had: there is no Python 3.97"
    assert third.startswith(
        "Python 3.98, torch 2.0.1: not to be had: the registry does not give it (no solution, because"
    )
    assert re.fullmatch(r"Python 3\.98, torch 2\.99\.1\+cpu: passed, \d+ s", last)
    assert "tests/test_states.py" in done.stdout


def test_tests_that_fail_are_a_failure(tmp_path):
    done = versions(tmp_path, "3.98:2.99.1", "3.97:2.99.1", STATUS="1")
    assert done.returncode == 1
    assert re.search(r"^Python 3\.98, torch 2\.99\.1\+cpu: failed \(pytest: 1\), \d+ s$", done.stdout, re.M)


def test_without_a_registry_nothing_is_tried_and_nothing_fails(tmp_path):
    done = versions(tmp_path, NO_TOOLS="1")
    assert done.returncode == 0
    assert done.stdout.startswith("nothing was tried: the registry does not give uv or setuptools (no setuptools")


@pytest.mark.parametrize("argument", ["3.12", "3.12:", "torch:2.7", "--all", "3.12:2"])
def test_an_argument_that_is_no_pair_of_versions_is_refused(tmp_path, argument):
    done = versions(tmp_path, "3.98:2.99.1", argument)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"versions: expected PYTHON:TORCH such as 3.12:2.7.1 or 3.11:newest, received {argument}\n"


def test_quick_leaves_out_slow_tests(tmp_path):
    done = versions(tmp_path, "--quick", "3.98:2.99.1")
    assert done.returncode == 0, done.stderr
    assert "-m not slow tests/" in done.stdout


def test_help_says_what_is_tried(tmp_path):
    done = versions(tmp_path, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "usage: bash scripts/versions.sh [--quick] [PYTHON:TORCH ...]" in done.stdout
    assert "3.10:2.4.1" in done.stdout
