"""Checkpoints: everything that the next iteration depends on, so that a resumed run ends with the same bits."""

from __future__ import annotations

import csv
import dataclasses
import io
import sys
from pathlib import Path
from typing import Any

import torch

from torchfra.app import distributed
from torchfra.app.atomic_write import write, write_text
from train.training import Training


def save(training: Training, out: Path) -> None:
    """Writes checkpoint.pt, the best values as state_dict.pt, and log.csv.

    The checkpoint before stays as checkpoint-previous.pt.
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
    newest = out / "checkpoint.pt"
    if newest.exists():
        newest.replace(out / "checkpoint-previous.pt")
    write(newest, lambda file: torch.save(state, file))
    write(out / "state_dict.pt", lambda file: torch.save(training.best["filter"], file))
    text = io.StringIO()
    columns = dict.fromkeys(key for row in training.rows for key in row)
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(training.rows)
    write_text(out / "log.csv", text.getvalue())


def load(training: Training, out: Path) -> bool:
    """Continues from the newest checkpoint that can be read.

    Returns:
        Whether there was a checkpoint.

    Raises:
        ValueError: none of them can be read, or it belongs to other settings.
    """
    paths = [path for path in (out / "checkpoint.pt", out / "checkpoint-previous.pt") if path.exists()]
    for path in paths:
        state = _read(path, training.config.device)
        if state is None:
            continue
        settings = dataclasses.asdict(training.config)
        other = [key for key in settings if state["config"].get(key) != settings[key]]
        if other:
            raise ValueError(f"resume: expected the settings of {path}, these differ: {', '.join(other)}")
        training.iteration, training.stopped = state["iteration"], state["stopped"]
        training.best, training.rows = state["best"], state["rows"]
        training.filter.load_state_dict(state["filter"])
        training.optimiser.load_state_dict(state["optimiser"])
        if path != paths[0] and distributed.rank() == 0:  # or the damaged one would replace the good one when saving
            paths[0].replace(out / "checkpoint-damaged.pt")
        return True
    if paths:
        raise ValueError(f"resume: no checkpoint in {out} can be read")
    return False


def _read(path: Path, device: str) -> dict[str, Any] | None:
    """A checkpoint, or None with a warning if it is damaged."""
    try:
        state: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
        return state
    except Exception as error:  # the reader of torch raises errors of many types
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        if distributed.rank() == 0:
            print(f"train: {path} is damaged and is not used: {reason}", file=sys.stderr)
        return None
