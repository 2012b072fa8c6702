"""A release is refused before any work where something is missing."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = ("scripts/release.sh", "torchfra/version.py", "CITATION.cff", "CHANGELOG.md")


@pytest.fixture
def clone(tmp_path):
    """A repository with the files that a release asks, with a heading of the version in the list of changes."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text((ROOT / name).read_text())
    (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n## [{version()}]\n")
    git(tmp_path, "init", "--quiet")
    commit(tmp_path)
    return tmp_path


def version():
    names = {}
    exec((ROOT / "torchfra/version.py").read_text(), names)
    return names["__version__"]


def git(folder, *words):
    author = ("-c", "user.name=somebody", "-c", "user.email=somebody@example.com")
    subprocess.run(["git", *author, *words], cwd=folder, check=True)


def commit(folder):
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "all")


def release(folder, *words):
    command = ["bash", "scripts/release.sh", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=30)


def refusal(folder, *words):
    done = release(folder, *words)
    assert done.returncode
    return done.stderr


def test_a_tree_that_is_not_clean_is_refused(clone):
    (clone / "new.txt").write_text("")
    assert "expected a clean tree" in refusal(clone, "--dry-run")


@pytest.mark.parametrize(
    ("name", "message"), [("CHANGELOG.md", "expected a heading"), ("CITATION.cff", "expected version")]
)
def test_a_version_that_a_file_does_not_have_is_refused(clone, name, message):
    path = clone / name
    path.write_text(path.read_text().replace(version(), "0.0.0"))
    commit(clone)
    assert f"{name}: {message}" in refusal(clone, "--dry-run")


def test_a_tag_that_is_there_is_not_set_again(clone):
    git(clone, "tag", f"v{version()}")
    assert f"there is a tag v{version()} already" in refusal(clone)


def test_the_changes_of_this_tree_become_those_of_a_version_from_which_a_release_can_be_made(clone):
    (clone / "CHANGELOG.md").write_text((ROOT / "CHANGELOG.md").read_text())
    commit(clone)
    done = release(clone, "--prepare", "7.8.9")
    assert done.returncode == 0, done.stderr
    before, after = ((folder / "CHANGELOG.md").read_text() for folder in (ROOT, clone))
    assert re.sub(r"\n\n## \[7\.8\.9\] - \d{4}-\d\d-\d\d\n", "\n", after) == before  # nothing else has changed
    assert re.search(r"^## \[Unreleased\]\n\n## \[7\.8\.9\]", after, re.M)
    assert '__version__ = "7.8.9"\n' in (clone / "torchfra/version.py").read_text()
    commit(clone)
    git(clone, "tag", "v7.8.9")
    assert "there is a tag v7.8.9 already" in refusal(clone, "--dry-run")  # the last that is asked before the work


def test_packages_are_built_of_a_commit_that_is_no_release(clone):
    """As between two releases: the version has no heading of its own, or a tag already."""
    (clone / "CHANGELOG.md").write_text("# Changelog\n\n## [Unreleased]\n")
    (clone / "scripts/setup.sh").write_text('echo "$1 would be installed" >&2; exit 3\n')
    commit(clone)
    git(clone, "tag", f"v{version()}")
    assert "expected a heading" in refusal(clone, "--dry-run")
    assert refusal(clone, "--packages") == "release would be installed\n"


@pytest.mark.parametrize(("words", "message"), [
    (["--prepare", "next"], "--prepare: expected a version such as 1.2.0, received next"),
    (["--prepare", "0.1.0"], "there is a heading [0.1.0] already"),
    (["--prepare", "7.8.9"], "expected changes below [Unreleased], there are none"),
    (["--prepare"], "expected --packages, --dry-run, --prepare VERSION or nothing, received --prepare"),
])  # fmt: skip
def test_a_version_that_cannot_be_prepared_is_refused_and_files_stay(clone, words, message):
    (clone / "CHANGELOG.md").write_text("# Changelog\n\n## [Unreleased]\n\n## [0.1.0] - 2026-01-01\n\n- All.\n")
    commit(clone)
    assert message in refusal(clone, *words)
    git(clone, "diff", "--exit-code")
