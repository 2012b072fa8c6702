"""Checkpoints: everything that the next iteration depends on, so that a resumed run ends with the same bits."""

from __future__ import annotations

import csv
import dataclasses
import io
from pathlib import Path
from typing import Any

from torchfra import state_files
from torchfra.running import checkpoints
from torchfra.running.atomic_write import write, write_text
from torchfra.running.checkpoints import OtherSettingsError
from train.training import Training

_BEST: dict[str, type] = {"score": float, "iteration": int, "filter": dict}
_KINDS: dict[str, type] = {"config": dict, "iteration": int, "stopped": bool, "filter": dict, "optimiser": dict,
                           "best": dict, "rows": list}  # fmt: skip
"""Names and types of the contents of a checkpoint, and of its best values."""
NEWEST, BEST, LOG = "checkpoint.pt", "state_dict.pt", "log.csv"
FILES = NEWEST, checkpoints.previous(Path(NEWEST)).name, BEST, LOG


def found(out: Path) -> list[Path]:
    """The checkpoints in a folder, the newest first."""
    return checkpoints.found(out / NEWEST)


def save(training: Training, out: Path) -> None:
    """Writes checkpoint.pt, the best values as state_dict.pt, and log.csv.

    Raises:
        OSError: a file cannot be written; of a checkpoint the message says what is left.
    """
    state = {
        "config": dataclasses.asdict(training.config),
        "iteration": training.iteration,
        "stopped": training.stopped,
        "filter": training.filter.state_dict(),
        "optimiser": training.optimiser.state_dict(),
        "best": training.best,
        "rows": training.rows,
    }
    checkpoints.save(state, out / NEWEST)
    write(out / BEST, lambda file: file.write(state_files.pack(training.best["filter"])))
    text = io.StringIO()
    columns = dict.fromkeys(key for row in training.rows for key in row)
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(training.rows)
    write_text(out / LOG, text.getvalue())


def load(training: Training, out: Path) -> bool:
    """Continues from the newest checkpoint that can be read; whether there was one; see ``checkpoints.load``."""
    return checkpoints.load(out / NEWEST, lambda path: _continue(training, _read(path, training)), "train")


def _read(path: Path, training: Training) -> dict[str, Any]:
    """The state that ``save`` has written.

    Raises:
        OtherSettingsError: with other settings.
        ValueError: it is damaged, or something else.
    """
    state = state_files.read(path, training.config.device)
    if not _has(state, _KINDS) or not _has(state["best"], _BEST) or len(state["rows"]) != state["iteration"]:
        raise ValueError(f"expected {', '.join(_KINDS)}, received something else")
    settings = dataclasses.asdict(training.config)
    other = [key for key in settings if key not in state["config"] or state["config"][key] != settings[key]]
    if other:
        raise OtherSettingsError(f"resume: expected the settings of {path}, these differ: {', '.join(other)}")
    return dict(state)


def _has(data: Any, kinds: dict[str, type]) -> bool:
    """Whether ``data`` is a dictionary with values of these types, and lists in it have dictionaries."""
    return isinstance(data, dict) and all(
        isinstance(data.get(key), kind) and (kind is not list or all(isinstance(part, dict) for part in data[key]))
        for key, kind in kinds.items()
    )


def _continue(training: Training, state: dict[str, Any]) -> None:
    """Makes the training what it was.

    Raises:
        ValueError: values that do not go with it.
    """
    for values in (state["best"]["filter"], state["filter"]):
        state_files.load_values(training.filter, values)
    try:
        training.optimiser.load_state_dict(state["optimiser"])
    except Exception as error:  # torch raises errors of many types
        raise ValueError(f"expected the state of the optimiser, received something else ({error})") from None
    training.iteration, training.stopped = state["iteration"], state["stopped"]
    training.best, training.rows = state["best"], state["rows"]
