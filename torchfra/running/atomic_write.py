"""Files that are written completely or not at all."""

from __future__ import annotations

import errno
import json
import os
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from numbers import Integral
from pathlib import Path
from typing import IO, Any

if sys.platform != "win32":
    import fcntl


def write(path: str | Path, fill: Callable[[IO[bytes]], object]) -> Path:
    """Lets ``fill`` write a temporary file, and moves it to ``path`` when it is complete; makes the folder.

    Links are followed.  A file that is replaced keeps its permissions, and its owner where that is allowed.  What is no
    file, a device or a pipe, is written to and not replaced; so is the file to which standard output or standard error
    is redirected.

    Raises:
        OSError: it cannot be written, with ``path`` as its ``filename``; an older file there is unchanged.
    """
    path = Path(path)
    with _naming(path):
        stream = _stream(path)
        if stream is not None:
            with stream as file:
                fill(file)
        else:
            target = Path(os.path.realpath(path))
            target.parent.mkdir(parents=True, exist_ok=True)
            _replace(target, fill)
    return path


def check(path: str | Path) -> None:
    """Checks that ``write`` can write there, and leaves nothing behind.

    Raises:
        OSError: it cannot, for a reason that shows before writing, with ``path`` as its ``filename``.
    """
    path = Path(path)
    with _naming(path):
        mode = _mode(path)
        if mode is not None and not stat.S_ISREG(mode):
            _check_special(path, mode)
            return
        target = Path(os.path.realpath(path))
        folder = next(place for place in target.parents if place.exists())
        for part in target.relative_to(folder).parts:
            (folder / part).exists()  # raises the error of a name that is too long
        with _locked(_unfinished(folder / target.name)) as (_, unfinished):
            unfinished.unlink()


def write_text(path: str | Path, text: str) -> Path:
    """Writes text, completely or not at all."""
    return write(path, lambda file: file.write(text.encode()))


def write_json(path: str | Path, data: object) -> Path:
    """Writes JSON, completely or not at all; NaN and infinity become null, integers of numpy numbers."""
    return write_text(path, json.dumps(_plain(data), indent=1, allow_nan=False) + "\n")


def _plain(data: object) -> Any:
    if isinstance(data, dict):
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [_plain(value) for value in data]
    if isinstance(data, Integral):
        return data if isinstance(data, bool) else int(data)
    return None if isinstance(data, float) and not (abs(data) < float("inf")) else data


# ---------------------------------------------------------------- what is there


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Inside, errors name ``path`` where they name a temporary file or nothing."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise


def _mode(path: Path) -> int | None:
    """Mode of the file at a path, links followed; None if there is none."""
    try:
        return path.stat().st_mode
    except FileNotFoundError:
        return None


def _check_special(path: Path, mode: int) -> None:
    """Checks something that is no file, without opening it: a pipe would wait for a reader."""
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if stat.S_ISSOCK(mode):
        raise OSError(errno.ENXIO, os.strerror(errno.ENXIO))
    if not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def _stream(path: Path) -> IO[bytes] | None:
    """A stream to a device, a pipe or an output of this process; None for a regular file or a new path."""
    mode = _mode(path)
    if mode is None:
        return None
    for number, standard in ((1, sys.stdout), (2, sys.stderr)):
        if standard is not None and _same(path, number):
            standard.flush()
            return os.fdopen(os.dup(number), "wb")
    return None if stat.S_ISREG(mode) else path.open("wb")


def _same(path: Path, number: int) -> bool:
    """Whether a descriptor of this process is open on what is at ``path``."""
    try:
        return os.path.samestat(path.stat(), os.fstat(number))
    except OSError:
        return False


# ---------------------------------------------------------------- replacing


def _replace(target: Path, fill: Callable[[IO[bytes]], object]) -> None:
    with _locked(_unfinished(target)) as (file, unfinished):
        try:
            _keep_closed(file, target)
            fill(file)
            file.flush()
            os.fsync(file.fileno())
            if sys.platform == "win32":
                file.close()  # an open file cannot be moved there
            unfinished.replace(target)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise


def _keep_closed(file: IO[bytes], target: Path) -> None:
    """Gives an empty file the owner and the permissions of the one that it will replace, if there is one."""
    if sys.platform == "win32" or not target.exists():
        return
    old = target.stat()
    for owner, group in ((-1, old.st_gid), (old.st_uid, -1)):
        with suppress(PermissionError):  # who writes may, and then owns it
            os.fchown(file.fileno(), owner, group)
    os.fchmod(file.fileno(), stat.S_IMODE(old.st_mode))


def _unfinished(target: Path) -> Path:
    """The temporary file for a target; its name is fixed, so that the next write reuses what a killed one has left."""
    return target.with_name(f".{target.name[:60]}.part")


@contextmanager
def _locked(path: Path) -> Iterator[tuple[IO[bytes], Path]]:
    """An empty file that no other process writes; it waits for one that does."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        with os.fdopen(descriptor, "r+b") as file:
            if sys.platform != "win32":
                with suppress(OSError):  # where the file system has no locks
                    fcntl.flock(file, fcntl.LOCK_EX)
            if not _same(path, descriptor):
                continue  # the other one has moved it away
            file.truncate()
            yield file, path
            return
