"""Files that are written completely or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any


def write(path: str | Path, fill: Callable[[IO[bytes]], None]) -> Path:
    """Lets ``fill`` write a temporary file, and moves it to ``path`` when it is complete; makes the folder.

    Raises:
        OSError: it cannot be written; what was at ``path`` is as before.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with unfinished.open("wb") as file:
            fill(file)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def write_text(path: str | Path, text: str) -> Path:
    """Writes text, completely or not at all."""
    return write(path, lambda file: _put(file, text.encode()))


def write_json(path: str | Path, data: Any) -> Path:
    """Writes JSON, completely or not at all; NaN and infinity become null."""
    return write_text(path, json.dumps(_finite(data), indent=1, allow_nan=False) + "\n")


def _put(file: IO[bytes], data: bytes) -> None:
    file.write(data)


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not (abs(data) < float("inf")) else data
