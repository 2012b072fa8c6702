"""Makes the named sets of values of presets, and measures their errors.

    python -m train.values --jobs 4                            measures all sets, in four processes
    python -m train.values --jobs 4 --resume                   only cells without a result
    python -m train.values --take out/train/fra_bearings       takes the learned values of runs of train.tune first
    python -m train.values --sets 'fra-*' --cells reentry      some sets, some scenarios

Each set is compared with the preset's defaults where it was learned (the tasks of its run) and in all other scenarios
of the catalogue that the filter takes, on the same runs, of a seed that no training has used.  All is written to
torchfra/presets/values.json, which ``torchfra.values()`` prints, after each scenario: an interrupted command
continues with ``--resume``.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import torch

import torchfra
from torchfra.catalogue import FILTERS, SCENARIOS, filters_for, scenario_filter
from torchfra.cli.command import add_quiet_option, add_runs_options, check_files, check_least, exit_status, make_parser
from torchfra.filters import Filter
from torchfra.presets.values import FILE, made_with
from torchfra.running.atomic_write import write_json
from torchfra.running.jobs import add_jobs_option, finished
from torchfra.running.progress import progress_bar
from torchfra.running.versions import versions
from torchfra.scenarios import Scenario
from train.batches import task_scenario
from train.config import Task
from train.runs import RUNS

Figures = dict[str, Any]
"""A set of values with its results, or one result, as in the file."""
CHUNK = 100
"""Runs that are filtered at once: a bank of seven motions takes megabytes for each."""


class Source(NamedTuple):
    """A named run as a set of values."""

    name: str
    learned_on: str
    elsewhere: tuple[Task, ...] = ()
    """Further tasks beside the scenarios of the catalogue at their defaults."""


SOURCES = {
    "fra_bearings": Source("bearings", "two moving stations that take bearings: priors, outliers, a manoeuvre"),
    "switching": Source("turns", "positions of aircraft that fly straight and turn, five motions",
                        (Task("adsb-turns", {"std": 10.0}), Task("adsb-turns", {"std": 100.0}))),
    "contaminated": Source("contaminated", "three in ten measurements with 15 times the standard deviation"),
    "association": Source("clutter", "two targets among false measurements, noise as assumed and four times that"),
}  # fmt: skip
"""The name of each run's set, and the data of its learning."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    parser = make_parser(__doc__, "python -m train.values")
    parser.add_argument("--take", metavar="DIR", type=Path, nargs="+", default=[], help="folders of runs")
    parser.add_argument("--out", metavar="FILE", type=Path, default=FILE, help="where to write (default: the package)")
    parser.add_argument("--sets", metavar="A,B", default="*", help="PRESET-VALUES, or patterns of them (default: all)")
    parser.add_argument("--cells", metavar="A,B", default="*", help="scenarios, or patterns of them (default: all)")
    parser.add_argument("--resume", action="store_true", help="keep results of the output with these runs and values")
    add_jobs_option(parser)
    add_runs_options(parser, 300, seed=77)
    add_quiet_option(parser)
    return exit_status("values", lambda: measure(parser.parse_args(arguments)))


def measure(options: argparse.Namespace) -> None:
    """Takes learned values, measures the sets and writes the file.

    Raises:
        ValueError: a folder without the results of a run of ``SOURCES``, a seed that was learned on, fewer than 2 runs,
            fewer than 1 job, unknown sets or scenarios, or some of them where the output has other settings.
    """
    check_least(options, jobs=1, runs=2)
    check_files({"out": options.out})
    sets = {name_of(record): record for record in read(FILE)["sets"]}
    sets |= {name_of(record): record for record in map(set_of, options.take)}
    if used := [record["run"] for record in sets.values() if options.seed in record["seeds"]]:
        expected = "one that no set was learned on"
        raise ValueError(f"seed: expected {expected}, received {options.seed}, of {', '.join(used)}")
    settings = {"seed": options.seed, "versions": versions(), "by": "python -m train.values"}
    take_results(sets, settings, options.out, everything=(options.sets, options.cells) == ("*", "*"))
    cells = {name: list(cells_of(record)) for name, record in sets.items() if matches(name, options.sets)}
    todo = [(name, *cell) for name, of in cells.items() for cell in of if matches(cell[0].scenario, options.cells)]
    if not todo:
        raise ValueError(f"cells: expected scenarios of {options.sets}, received {options.cells}")
    if options.resume:
        todo = [part for part in todo if not measured(sets[part[0]], part[1], options.runs)]
    parts = [(sets[name], task, learned_on, options.runs, options.seed) for name, task, learned_on in todo]
    for number, figures in progress_bar(finished(compared, parts, options.jobs), "cell", not options.quiet):
        name = todo[number][0]
        add_result(sets[name], figures, [task for task, _ in cells[name]])
        write_json(options.out, {"settings": settings, "sets": list(sets.values())})


def set_of(folder: Path) -> Figures:
    """A set, without results, from the folder of a run of ``train.tune``.

    Raises:
        ValueError: the run is none of ``SOURCES``.
    """
    result = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    run, config = result["config"]["name"], result["config"]
    if run not in SOURCES:
        raise ValueError(f"take: expected one of {', '.join(SOURCES)}, received {run}")
    start, learned = result["values"]["start"], result["values"]["learned"]
    arguments, factors = dict(result.get("preset", {})), {}
    for path in {} if arguments else learned:
        kind, _, rest = path.removeprefix("inner.").partition(".")
        if kind in ("motion", "sensor"):
            factors[f"{kind}.{rest}"] = learned[path] / start[path]
        else:
            _put(arguments, path, learned[path])
    if "gate.size" in arguments:
        arguments["gate"] = {"size": arguments.pop("gate.size"), "probability": 0.9999}
    head = {"preset": config["filter"], "values": SOURCES[run].name, "run": f"python -m train.tune {run}"}
    data = {"learned_on": SOURCES[run].learned_on, "seeds": [config["seed"], config["validation_seed"]]}
    return {**head, **data, "versions": result["versions"], "arguments": arguments, "factors": factors, "results": []}


def _put(arguments: Figures, path: str, value: float) -> None:
    """Puts one number in its place: ``"transition[0,1]"`` into a list of lists, in the order of the indices."""
    name, _, indices = path.partition("[")
    key = name if name == "gate.size" else name.rpartition(".")[2]
    if not indices:
        arguments[key] = value
        return
    *outer, _ = map(int, indices.rstrip("]").split(","))
    place = arguments.setdefault(key, [])
    for index in outer:
        if index == len(place):
            place.append([])
        place = place[index]
    place.append(value)


def cells_of(record: Figures) -> Iterator[tuple[Task, bool]]:
    """Tasks, and whether the set was learned there: those of its run, then the rest of the catalogue."""
    run = record["run"].split()[-1]
    tasks = [replace(task, weight=1.0) for task in RUNS[run]().tasks]
    catalogue = [*SOURCES[run].elsewhere, *map(Task, SCENARIOS)]
    found: list[Task] = []
    for task in (*tasks, *catalogue):
        if task not in found and fits(record, scenario_of(task)):
            found.append(task)
            yield task, task in tasks


def scenario_of(task: Task) -> Scenario:
    """The scenario, without its bank for a task of one motion."""
    return task_scenario(task, RUNS["noise"](), held_out=True)


def fits(record: Figures, scenario: Scenario) -> bool:
    """Whether filter and set fit the models of a scenario."""
    if record["preset"] not in filters_for(scenario):
        return False
    try:
        made(record, scenario)
    except ValueError:  # a bank of another size, a motion without the values that the set changes
        return False
    return True


def made(record: Figures, scenario: Scenario) -> Filter:
    """The filter with the set; its detection is that of the set where it has one."""
    entry = FILTERS[record["preset"]]
    models = scenario.motion if scenario.bank is None or not (entry.bank or entry.either) else scenario.bank
    scans = {} if scenario.clutter is None else {"clutter": scenario.clutter}
    first = next(iter(inspect.signature(entry.preset).parameters))
    f: Filter = made_with(entry.preset, record, {first: models, "sensor": scenario.sensor, **scans})
    return f


@torch.no_grad()
def compared(record: Figures, task: Task, learned_on: bool, runs: int, seed: int) -> Figures:
    """Errors of a filter at its defaults and with a set on the same runs, and their ratio with its 95 % interval."""
    scenario = scenario_of(task)
    filters = {"defaults": scenario_filter(record["preset"], scenario), "set": made(record, scenario)}
    comparison = torchfra.compare(filters, scenario, runs=runs, seed=seed, compile=True, bound=False, chunk=CHUNK)
    before, after = (comparison.of_runs(kind) for kind in filters)
    ratio = (after.mean() / before.mean()).item()
    spread = (after - ratio * before).std().item() / before.mean().item() / math.sqrt(runs)
    figures: Figures = {"scenario": task.scenario, "options": task.options, "models": task.models}
    figures |= {"learned_on": learned_on, "runs": runs}
    figures |= {"defaults": before.mean().item(), "set": after.mean().item()}
    figures |= {"change": ratio - 1, "half": 1.96 * spread}
    return figures | {f"{kind}_lost": comparison.results[kind]["divergence_rate"] for kind in filters}


def read(file: Path) -> Figures:
    """The contents of a file of sets; no sets if it does not exist."""
    contents: Figures = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"sets": []}
    return contents


def name_of(record: Figures) -> str:
    """The name of a set: its preset and its own name."""
    return f"{record['preset']}-{record['values']}"


def take_results(sets: dict[str, Figures], settings: Figures, file: Path, *, everything: bool) -> None:
    """Sets the results of each set to those of the file with equal settings and values; else to none.

    Args:
        sets: changed in place.
        settings: of the measurements.
        file: the output.
        everything: whether all is measured, so that no result of the file is lost.

    Raises:
        ValueError: the file has other settings, and only a part is measured.
    """
    before = read(file)
    if before["sets"] and before["settings"] != settings and not everything:
        expected = f"expected all, as {file} has results of other settings, {before['settings']}"
        raise ValueError(f"cells: {expected}, received a part of them")
    known = {name_of(record): record for record in before["sets"] if before["settings"] == settings}
    for name, record in sets.items():
        same = name in known and all(known[name][part] == record[part] for part in ("arguments", "factors"))
        record["results"] = known[name]["results"] if same else []


def measured(record: Figures, task: Task, runs: int) -> bool:
    """Whether a set has a result of a scenario with this number of runs."""
    return any(_is_of(result, task) and result["runs"] == runs for result in record["results"])


def add_result(record: Figures, figures: Figures, tasks: list[Task]) -> None:
    """Puts a result in place of the one of the same scenario, in the order of the tasks."""
    results = [figures, *record["results"]]
    found = (next((result for result in results if _is_of(result, task)), None) for task in tasks)
    record["results"] = [result for result in found if result is not None]


def _is_of(result: Figures, task: Task) -> bool:
    return (result["scenario"], result["options"], result["models"]) == (task.scenario, task.options, task.models)


def matches(name: str, patterns: str) -> bool:
    """Whether a name is one of a comma-separated list of names and patterns."""
    return any(fnmatchcase(name, pattern) for pattern in patterns.split(","))


if __name__ == "__main__":
    sys.exit(main())
