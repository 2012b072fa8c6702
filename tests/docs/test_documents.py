"""Every README is held to its word: its code runs, commands that no other test runs run small, its links exist."""

import ast
import contextlib
import functools
import importlib.util
import io
import json
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchfra import presets, register, scenarios
from torchfra.cli import main as cli
from train import simple, tune, values
from train.runs import configured

pytestmark = pytest.mark.usefixtures("short_tracks", "rough_figures")  # with which code and commands run as well

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / ".github/CONTRIBUTING.md",
    ROOT / "scripts/docs/gradients.md",
    ROOT / "scripts/docs/layer.md",
    *(p for d in ("torchfra", "train", "scripts") for p in sorted((ROOT / d).rglob("README.md"))),
    *sorted((ROOT / "scripts/results").glob("[a-z]*.md")),
]
NAMES = [str(path.relative_to(ROOT)) for path in DOCUMENTS]
RUN_ELSEWHERE = {"README.md": "test_scripts.py, which reads what it prints", "scripts/docs/layer.md": "test_layer.py"}
"""Documents whose code runs in another file, which looks at what it leaves."""
STARTS = ("python scripts/", "python -m train.", "python -m torchfra", "torchfra ", "torchrun ", "bash scripts/")
SETUP = (
    "pip install ", "python -m pip install ", "pre-commit install", "git clone ", "cd ", "python3 -m venv ", "source ",
)  # fmt: skip
"""Commands that prepare a machine, which are not run here."""

SMALL = {
    "torchfra compare": ({"--runs": "2"}, {"--filters": "srckf,fra"}),
    "scripts/reproduce.py clutter": ({"--runs": "2"}, {"--filters": "ukf_jpda_safe"}),
    "torchfra many": ({"--jobs": "1"}, {}),
    "scripts/peers_targets.py": (
        {"--runs": "1", "--scans": "10", "--targets": "2", "--clutter": "2"},
        {"--trackers": "srckf"},
    ),
    "scripts/bounds.py": ({"--runs": "2", "--jobs": "1", "--cells": "bearings-manoeuvre"}, {"--filters": "srckf"}),
    "scripts/benchmark.py": ({"--batch": "1", "--passes": "1", "--modes": "eager"}, {"--filters": "srckf"}),
    "scripts/targets.py": ({"--runs": "1", "--scans": "3", "--what": "many,crowd"}, {}),
    "scripts/examples/": ({}, {}),
    "scripts/": ({"--iterations": "2", "--tracks": "4", "--steps": "10"}, {}),
}
"""Options by the beginning of a command, the longest that fits: always these, and these where the line has none."""
SMALL_TRAINING = ["iterations=1", "batch=2", "validation_runs=2", "test_runs=2", "compile=false", "search={}"]
HELP_ONLY = {
    "torchfra compare --scenario bearings-outliers --learned": "run by test_cli.py",
    "torchfra compare --scenario bearings-outliers --runs 200 --table": "run by test_compare.py",
    "torchfra compare --ranges FOLDER": "run by test_cli.py",
    "scripts/examples/": "run by test_examples.py",
    "scripts/mutants.py": "runs many tests: run with few by test_mutants.py",
    "scripts/export.py": "compiles a program for each filter: run by test_export.py",
    "scripts/benchmark.py --what layer": "compiles a filter with gradients: run by test_scripts.py",
    "scripts/benchmark.py --what training": "compiles four filters with gradients: run by test_scripts.py",
    "scripts/benchmark.py --what long": "filters 10,000 steps in turn: the jobs are tested by test_peers.py",
    "scripts/benchmark.py --what roof": "compiles every filter: run by test_scripts.py",
    "scripts/benchmark.py --what linear": "filters of others: run by test_peers.py",
    "scripts/benchmark.py --peers": "its parts are run by test_scripts.py and test_peers.py",
    **{
        f"scripts/{name}.py": f"run by test_{name}.py"
        for name in (
            "certainty",
            "clean_check",
            "field",
            "gradients",
            "layer",
            "learning",
            "lorenz",
            "many",
            "okf",
            "particles",
            "regret",
        )
    },
    **{
        f"scripts/reproduce.py {name}": "run by test_scripts.py"
        for name in ("bearings", "adsb-turns", "alpha-beta", "growth", "reentry", "clutter-crossing", "noise-change")
    },
    "scripts/bearings.py": "run by test_scripts.py",
    "scripts/harbours.py": "run by test_harbour.py",
    "scripts/peers_targets.py --harbour": "reads such recordings, too: run by test_peers_targets.py",
    "scripts/recordings.py": "reads recordings that are not part of the project: run by test_recordings_script.py",
    "scripts/benchmark.py --what scaling": "compiles a filter for each number of states",
}
"""Commands of which only the arguments are checked, and why."""


# ---------------------------------------------------------------- what a document says


def blocks_of(text):
    """The fenced blocks of a document as (language, text), and what remains without them."""
    fences = re.compile(r"^```(\w*)\n(.*?)^```$", re.S | re.M)
    return [(m[1], m[2]) for m in fences.finditer(text)], fences.sub("", text)


def commands_of(text):
    """The command lines of a document: of shell blocks, of indented blocks, and of code within sentences."""
    blocks, rest = blocks_of(text)
    shell = "\n".join(block for language, block in blocks if language in ("", "sh", "bash", "shell", "console"))
    indented = re.findall(r"(?:^|\n)\n((?: {4}.*\n)+)", rest)
    for line in re.sub(r"\\\n\s*", " ", shell + "\n" + "".join(indented)).splitlines():
        command = " ".join(re.split(r"\s#\s", line.strip())[0].split()).removeprefix("$ ")
        if command and not command.startswith("#"):
            yield command
    prose = re.sub(r"(?:^|(?<=\n))(?: {4}.*\n)+", "", rest)
    for code in re.findall(r"`([^`]+)`", prose):
        command = " ".join(code.split())
        command = f"python {command}" if re.match(r"scripts/\S+\.py ", command) else command
        if command.startswith(STARTS):
            yield command


LINES = sorted({line for path in DOCUMENTS for line in commands_of(path.read_text(encoding="utf-8"))})


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name not in RUN_ELSEWHERE])
def test_every_block_of_code_runs(name, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    for known in ("FILTERS", "SCENARIOS"):  # what a block adds is gone after it
        entries = getattr(register, known)
        before = dict(entries)
        request.addfinalizer(lambda entries=entries, before=before: (entries.clear(), entries.update(before)))
    scope: dict[str, object] = {}
    for language, block in blocks_of((ROOT / name).read_text(encoding="utf-8"))[0]:
        if language == "python":
            exec(compile(block, name, "exec"), scope)


def anchors(path):
    """The anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", blocks_of(path.read_text(encoding="utf-8"))[1], re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", NAMES)
def test_links_and_images_lead_to_what_is_there(name):
    path, broken = ROOT / name, []
    for link in re.findall(r"\]\(([^)\s]+)\)", blocks_of(path.read_text(encoding="utf-8"))[1]):
        if not re.match(r"[a-z]+:", link):
            file, _, anchor = link.partition("#")
            target = (path.parent / file).resolve() if file else path
            if not target.exists() or (anchor and anchor not in anchors(target)):
                broken.append(link)
    assert not broken, broken


def sections_of(text):
    """The parts of a document from one heading of the first or second level to the next."""
    return re.split(r"^(?=##? )", text, flags=re.M)


def pictures_of(text):
    return re.findall(r"!\[[^\]]*\]\(([^)\s]+)\)", text)


@pytest.mark.parametrize("name", NAMES)
def test_beside_every_picture_stands_the_command_that_draws_it(name):
    for section in sections_of((ROOT / name).read_text(encoding="utf-8")):
        assert not pictures_of(section) or list(commands_of(section)), section.splitlines()[0]


def test_every_picture_of_the_results_is_shown():
    shown = {(p.parent / link).resolve() for p in DOCUMENTS for link in pictures_of(p.read_text(encoding="utf-8"))}
    assert set((ROOT / "scripts/results").glob("*.png")) <= shown


# ---------------------------------------------------------------- docstrings


def strings_that_stand_alone(path):
    """The docstrings of a module: of itself, its classes and functions, and those under attributes."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value


def paths_of(text):
    """The dotted paths into the library that a docstring writes in double backticks, with or without a call."""
    return re.findall(r"``(torchfra(?:\.\w+)+)(?:\([^`]*\))?``", text)


def resolves(path):
    try:
        pkgutil.resolve_name(path)
    except (ImportError, AttributeError):
        return (ROOT / path.replace(".", "/")).with_suffix(".py").exists()  # whose library may not be installed
    return True


@pytest.mark.slow
def test_paths_in_docstrings_lead_to_what_is_there():
    for module in sorted((ROOT / "torchfra").rglob("*.py")):
        paths = {path for text in strings_that_stand_alone(module) for path in paths_of(text)}
        assert not (broken := sorted(path for path in paths if not resolves(path))), f"{module}: {broken}"


# ---------------------------------------------------------------- command lines


@pytest.fixture(scope="session")
def flights(tmp_path_factory):
    """Five straight flights of 160 s with 25 m of measurement noise."""
    rng, paths = np.random.default_rng(0), []
    time = np.arange(40) * 4.0
    for i in range(5):
        paths.append(tmp_path_factory.mktemp("flights") / f"flight-{i}.csv")
        xy = np.stack([100 * time, (10 * i - 20) * time], 1) + 25 * rng.standard_normal((40, 2))
        paths[-1].write_text("t,x,y\n" + "".join(f"{t},{x},{y}\n" for t, (x, y) in zip(time, xy, strict=True)))
    return [str(path) for path in paths]


def as_data_set(folder, flights):
    """Writes two flights as a data set of Parquet."""
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import csv, parquet

    Path(folder).mkdir()
    for name in flights[:2]:
        table = csv.read_csv(name)
        table = table.append_column("id", pyarrow.array([Path(name).stem] * table.num_rows))
        parquet.write_table(table, Path(folder, f"{Path(name).stem}.parquet"))


def filled(words, flights):
    """The words of a command with files in place of placeholders."""
    for word in words:
        if word in ("FILE", "FILES", "FILE..."):
            yield from flights[: 1 if word == "FILE" else 2]
        elif word == "FLIGHTS":
            as_data_set(word, flights)
            yield word
        elif re.fullmatch(r"[\w-]+\.(csv|csv\.gz|json\.gz)", word):
            yield flights[0]
        else:
            yield word


def with_option(words, option, value):
    """Sets an option, in place of the value that it has."""
    words = [word for word in words if not word.startswith(f"{option}=")]
    if option in words:
        place = words.index(option)
        words = words[:place] + words[place + 2 :]
    return [*words, option, value]


def script(path):
    """The ``main`` of a script."""
    assert (ROOT / path).exists(), f"{path} does not exist"
    name = f"documented_{Path(path).stem}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, ROOT / path)
        sys.modules[name] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name].main


def run(main, arguments):
    """The exit status and all that was printed, both in-process."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            status = main(arguments)
        except SystemExit as stopped:
            status = stopped.code
    return status or 0, out.getvalue()


@functools.cache
def run_once(main, *arguments):
    """As `run`; a command that several lines come to is run for the first of them."""
    return run(main, list(arguments))


def help_of(main, arguments):
    """What ``--help`` prints after these arguments."""
    status, text = run(main, [*arguments, "--help"])
    assert status == 0, text
    return text


def small(line, main, words, known):
    """The arguments of a command made small, as far as its ``--help`` knows them."""
    always, otherwise = SMALL.get(
        max((start for start in SMALL if line.startswith(start)), key=len, default=""), ({}, {})
    )
    for option, value in always.items():
        words = with_option(words, option, value) if option in known else words
    for option, value in otherwise.items():
        words = with_option(words, option, value) if option not in words else words
    if "--no-compile" in known and "--compile" not in words:
        words = [*words, "--no-compile"]
    return words


def understood(line, flights):
    """The ``main`` that a command line calls, its arguments made small, and whether only its help is asked for."""
    words = shlex.split(line)
    if "train.tune" in words:  # of torchrun, one process: two are in test_train.py
        assert words[0] in ("python", "torchrun")
        beside = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # the environment need not be active
        assert words[0] == "python" or shutil.which("torchrun", path=beside)
        words = [w.replace("RUN", "fra_bearings") for w in words[words.index("train.tune") + 1 :]]
        own = any(word.startswith("scenario=") for word in words)
        if "--resume" in words or not (own or words[0] == "fra_bearings"):  # these: test_train.py, test_train_gpb.py
            configured(words[0], [word for word in words[1:] if not word.startswith("-")])
            return tune.main, words, True
        return tune.main, [*words, *SMALL_TRAINING], False
    if "-m" in words and words[words.index("-m") + 1] == "torchfra":
        words = words[words.index("-m") + 1 :]  # of torchrun, one process: two are in test_many.py
    if words[:3] == ["python", "-m", "train.simple"]:  # learns for a minute: run by test_simple.py
        return simple.main, words[3:], True
    if words[:3] == ["python", "-m", "train.values"]:  # measures for minutes: run by test_values.py
        return values.main, [], True
    main, words = (cli.main, words[1:]) if words[0] == "torchfra" else (script(words[1]), words[2:])
    line = line.removeprefix("python ")
    no_gpu = "--device cuda" in line and not torch.cuda.is_available()
    if no_gpu or line.startswith(tuple(HELP_ONLY)):
        return main, words, True
    known = help_of(main, words[:1] if main is cli.main else [])
    words = list(filled([*words, "FLIGHTS", "--out", "clean"] if words == ["many"] else words, flights))
    if main is cli.main and words and words[0] in ("track", "compare"):
        named = [w for w in words if w.endswith(".csv")]
        words += [] if named or {"--scenario", "--ranges"} & set(words) else flights[:1]
    return main, small(line, main, words, known), False


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_a_command_line_of_a_document_works(line, flights, tmp_path, monkeypatch):
    if line.startswith(SETUP):
        return
    assert line.startswith(STARTS), f"unknown command line: {line}"
    if line.startswith("bash "):
        file = ROOT / line.split()[1]
        assert file.exists()
        subprocess.run(["bash", "-n", file], check=True)
        return
    monkeypatch.chdir(tmp_path)
    main, arguments, help_only = understood(line, flights)
    if help_only:
        known = help_of(main, arguments)
        assert not [word for word in arguments if word.startswith("--") and word.split("=")[0] not in known]
        return
    status, text = run_once(main, *arguments)
    assert status == 0, f"{arguments}: {text}"


@pytest.mark.slow
def test_the_demo_compares_recorded_tracks(tmp_path, monkeypatch):
    """What scripts/demo.sh runs, on the shortest of its files and with two filters."""
    from torchfra.readers import samples

    try:
        files = [str(path) for path in samples("calibration", "gliders")]
    except (ImportError, ValueError) as missing:
        pytest.skip(str(missing))
    monkeypatch.chdir(tmp_path)
    (line,) = (
        line
        for line in (ROOT / "scripts/demo.sh").read_text(encoding="utf-8").splitlines()
        if line.startswith("torchfra ")
    )
    words = shlex.split(
        line.replace('"${files[@]}"', min(files, key=lambda file: Path(file).stat().st_size)).replace('"$@"', "")
    )
    words = small("torchfra compare", cli.main, words[1:], help_of(cli.main, ["compare"]))
    status, text = run(cli.main, words)
    assert status == 0, text
    assert json.loads(Path("out/recorded.json").read_text())["filters"].keys() == {"srckf", "fra"}
    assert Path("out/recorded.png").exists()


# ---------------------------------------------------------------- documents are read as they are meant


def test_command_lines_are_read_from_blocks_and_sentences():
    text = (
        "Run `torchfra compare --scenario\ngrowth`, see `torchfra.cli` or `scripts/regret.py`.\n\n"
        "    bash scripts/demo.sh    # the demo\n    make all\n\n"
        "```sh\npython scripts/reproduce.py growth \\\n    --runs 3\n```\n\n```python\ntorchfra = 1\n```\n"
    )
    assert sorted(commands_of(text)) == [
        "bash scripts/demo.sh", "make all", "python scripts/reproduce.py growth --runs 3",
        "torchfra compare --scenario growth",
    ]  # fmt: skip


def test_the_values_of_gpb_in_its_table_are_what_it_takes_and_its_own():
    page = (ROOT / "torchfra/filters/README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| ([-\d.e, ()]+) \|", page, re.MULTILINE)
    assert len(rows) == 10
    for argument, value in rows:
        value = ast.literal_eval(f"({value},)")
        scenario = scenarios.bearings_outliers()
        given = {argument: value[0] if len(value) == 1 and argument != "jump_factors" else value}
        one, own = (presets.gpb(scenario.motion, scenario.sensor, **options) for options in (given, {}))
        for (name, x), y in zip(one.state_dict().items(), own.state_dict().values(), strict=True):
            torch.testing.assert_close(x, y, rtol=1e-3, atol=0, msg=f"{argument}: {name}")
