"""Named sets of learned values: ``presets.fra(motion, sensor, values="bearings")``.

``values.json`` holds the sets, the data they were learned on and their errors on those and other data; ``python -m
train.values`` writes it.
"""

from __future__ import annotations

import copy
import inspect
import json
from collections.abc import Callable, Sequence
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch

from torchfra.association.gates import Euclidean
from torchfra.hyper import hypers
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.tables import significant, text_table

P = ParamSpec("P")
F = TypeVar("F")
FILE = Path(__file__).with_name("values.json")
INSTEAD = {"robust": "threshold", "self_transition": "transition", "durations": "transition"}
"""Arguments that take the place of another argument if they are given."""


class ValueSets(list[dict[str, Any]]):
    """Records of sets of values, one dictionary each, which print as a table."""

    def __repr__(self) -> str:
        head = ("preset", "values", "scenario", "learned on", "runs", "defaults", "set", "change", "lost")
        rows = [_row(record, result) for record in self for result in record["results"]]
        return text_table(head, rows, align="<<<<>") + "\n" + _caption()


def values() -> ValueSets:
    """The sets of learned values that presets take by name, with their errors on the data of learning and on others.

    Each record has ``preset`` and ``values`` (the names), ``run`` (the command that learned them), ``learned_on`` (the
    data), ``arguments`` (of the preset), ``factors`` (on values of the motion and the sensor, by their path) and
    ``results``: a dictionary for each scenario, errors in m.

    Example:
        >>> {record["values"] for record in torchfra.values() if record["preset"] == "fra"}
        {'bearings'}
    """
    return ValueSets(copy.deepcopy(_contents()["sets"]))


def with_values(preset: Callable[P, F]) -> Callable[P, F]:
    """A preset that takes the name of a set of values as ``values``; arguments of the caller override the set.

    The motion and the sensor are copied where the set has factors on their values.
    """

    @wraps(preset)
    def chosen(*arguments: P.args, **options: P.kwargs) -> F:
        if options.get("values") is None:
            return preset(*arguments, **options)
        named: dict[str, Any] = dict(inspect.signature(preset).bind(*arguments, **options).arguments)
        named |= named.pop("options", {})
        return made_with(preset, _record(preset.__name__, named.pop("values")), named)

    return chosen


def made_with(preset: Callable[..., F], record: dict[str, Any], arguments: dict[str, Any]) -> F:
    """The filter of a preset with a set of values, which ``arguments`` by name override.

    Raises:
        ValueError: the motion or the sensor has no values that the set changes; or see the preset.
    """
    replaced = {INSTEAD[name] for name in INSTEAD.keys() & arguments.keys()}
    learned = {name: _argument(value) for name, value in record["arguments"].items() if name not in replaced}
    models = {}
    for kind, name in zip(("motion", "sensor"), inspect.signature(preset).parameters, strict=False):
        models[name] = _scaled(kind, arguments[name], record)
    return preset(**learned | arguments | models)


def _record(preset: str, name: object) -> dict[str, Any]:
    """The set of a name.

    Raises:
        ValueError: the preset has no such set; the message lists its sets.
    """
    sets = {record["values"]: record for record in _contents()["sets"] if record["preset"] == preset}
    if name not in sets:
        raise ValueError(f"values: expected None or one of {', '.join(sets)} for {preset}, received {name!r}")
    record: dict[str, Any] = sets[name]
    return record


@cache
def _contents() -> dict[str, Any]:
    contents: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return contents


def _argument(value: object) -> Any:
    """An argument of a preset from its form in the file: a list is a tensor, a dictionary a gate in metres."""
    if isinstance(value, dict):
        return Euclidean(**value)
    return torch.tensor(value, dtype=torch.float64) if isinstance(value, list) else value


def _scaled(kind: str, model: object, record: dict[str, Any]) -> Any:
    """The motion or sensor, or a copy of it with its values times the factors of the set.

    Raises:
        ValueError: it has no such value, or the product is out of its range.
    """
    prefix = f"{kind}."
    factors = {path.removeprefix(prefix): f for path, f in record["factors"].items() if path.startswith(prefix)}
    if not factors:
        return model
    if isinstance(model, Sequence) and not isinstance(model, Motion):
        model = Bank(model)
    own = copy.deepcopy(model)
    own_values = hypers(own) if isinstance(own, torch.nn.Module) else {}
    if missing := factors.keys() - own_values.keys():
        name = f"{record['values']!r} of {record['preset']}"
        expected = f"a {kind} with {', '.join(sorted(factors))} for {name}"
        raise ValueError(f"values: expected {expected}, received one without {', '.join(sorted(missing))}")
    for path, factor in factors.items():
        own_values[path].set(own_values[path]().detach() * factor, path)
    return own


def _row(record: dict[str, Any], result: dict[str, Any]) -> list[str]:
    stated = [f"{key} {value}" for key, value in result["options"].items()]
    options = ", ".join([*stated, *(["one motion"] if result["models"] == "motion" else [])])
    scenario = f"{result['scenario']} ({options})" if options else result["scenario"]
    change = f"{result['change']:+.1%} +- {result['half']:.1%}" if result["half"] < 1 else "-"
    lost = " -> ".join(f"{result[f'{kind}_lost']:.1%}" for kind in ("defaults", "set"))
    where = "yes" if result["learned_on"] else ""
    errors = [significant(result[kind]) for kind in ("defaults", "set")]
    return [record["preset"], record["values"], scenario, where, str(result["runs"]), *errors, change, lost]


def _caption() -> str:
    """The caption of the table: the meaning of its figures."""
    made = _contents()["settings"]
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items())
    return (
        f"RMSE of the position in a run, m: mean over runs of seed {made['seed']}, which no set was "
        "learned on;\nchange with its 95 % interval, - where that is wider than the error; lost: runs that diverge.\n"
        f"{versions}; {made['by']}"
    )
