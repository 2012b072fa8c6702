"""Checkpoints on disk: the newest and the one before it, each complete or absent, with checksums against damage."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from torchfra import state_files
from torchfra.running import distributed
from torchfra.running.atomic_write import write


class OtherSettingsError(ValueError):
    """A checkpoint belongs to other settings."""


def found(newest: Path) -> list[Path]:
    """The checkpoints that are there, the newest first."""
    return [path for path in (newest, previous(newest)) if path.exists()]


def previous(newest: Path) -> Path:
    """Path of the checkpoint before the newest."""
    return newest.with_stem(f"{newest.stem}-previous")


def save(state: object, newest: Path) -> None:
    """Writes a checkpoint; the one before stays under another name.

    Raises:
        OSError: it cannot be written; the checkpoints are as before, and the message says so.
    """
    try:
        if newest.exists():
            before = newest.read_bytes()
            write(previous(newest), lambda file: file.write(before))
        write(newest, lambda file: file.write(state_files.pack(state)))
    except OSError as error:
        kept = "the checkpoint before is as it was" if found(newest) else "there is no checkpoint yet"
        raise OSError(error.errno, f"{error.strerror}, {kept}", error.filename) from None


def load(newest: Path, take: Callable[[Path], None], program: str) -> bool:
    """Continues from the newest checkpoint that can be read.

    Args:
        newest: where it should be.
        take: reads the checkpoint at a path and continues from it; raises ``ValueError`` for one that is damaged, and
            ``OtherSettingsError`` for one of another run.
        program: its name begins the line on standard error where one is damaged.

    Returns:
        Whether there was a checkpoint.

    Raises:
        ValueError: none of them can be read, or it belongs to other settings.
    """

    def warn(line: str) -> None:
        if distributed.rank() == 0:
            print(f"{program}: {line}", file=sys.stderr)

    paths = found(newest)
    for path in paths:
        try:
            take(path)
        except OtherSettingsError:
            raise
        except (ValueError, OSError) as error:
            warn(f"{path} is damaged and is not used: {error}")
            continue
        if path != newest:
            warn(f"{path} is used")
            if path != paths[0] and distributed.rank() == 0:  # or saving would put the damaged one in place of the good
                paths[0].replace(newest.with_stem(f"{newest.stem}-damaged"))
        return True
    if paths:
        raise ValueError(f"resume: no checkpoint in {newest.parent} can be read")
    return False
