"""Compiled kernels on disk: in a folder that one user alone can write to, each with a digest of what was compiled.

A kernel is code that runs with the rights of who loads it.  So none is loaded that another user could have put there
or changed: the folder and the file belong to this user, and nobody else may write to them.  The digest finds what is
damaged; it keeps nobody out, as who may write to the folder may write a digest as well.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import stat
import warnings
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

_DIGEST = 32
"""Bytes at the end of a file: the SHA-256 of its name and what is before them."""
_UNFINISHED, _ABANDONED = ".part", 60.0
"""End of the name of a file that is being written, and the age in seconds from which nobody writes it any more."""

_DESCRIPTORS = os.open in os.supports_dir_fd
"""Whether files can be named beside an open folder: not on Windows."""
_BINARY: int = getattr(os, "O_BINARY", 0)  # Windows would otherwise change line ends
Folder = int | Path
"""A folder: a descriptor where there are some, else its path."""


def read(name: str) -> bytes | None:
    """What has been kept under this name by ``write``; None unless it is undamaged, in a folder of this user alone."""
    folder = _open()
    if folder is None:
        return None
    try:
        return _content(folder, name)
    finally:
        _close(folder)


def write(name: str, content: bytes) -> None:
    """Keeps something for other processes if it can be, otherwise there is a warning."""
    folder = _open()
    if folder is None:
        return
    try:
        obstacle = _store(folder, name, content)
        if obstacle is not None:
            _warn(chosen(), obstacle)
    finally:
        _close(folder)


def chosen() -> str:
    """The folder as the user names it: ``TORCHFRA_CACHE``, or ``torchfra`` among the caches of this user."""
    return os.environ.get("TORCHFRA_CACHE") or os.path.join(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "torchfra")


def _open() -> Folder | None:
    """The folder, made if need be, as a file descriptor; None after a warning if this user alone cannot have it.

    All that follows goes through the descriptor: what has been checked is what is used, even if someone who may write
    to a folder above puts another in its place.  Windows has no such descriptors, and no owners and modes to look at:
    there it is the path, and what keeps others out is that it lies in the user's profile.
    """
    try:
        path = Path(chosen()).expanduser().resolve()
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _DESCRIPTORS:
            return path
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    except (OSError, RuntimeError) as error:  # a RuntimeError where there is no home
        _warn(chosen(), _reason(error))
        return None
    status = os.fstat(folder)
    if _is_private(status):
        return folder
    os.close(folder)
    foreign = status.st_uid != os.geteuid()
    owner, others = f"it belongs to user {status.st_uid}", "other users may write to it, which chmod go-w ends"
    _warn(chosen(), owner if foreign else others)
    return None


def _is_private(status: os.stat_result) -> bool:
    """Whether a file or folder belongs to this user, and nobody else may write to it."""
    return not _DESCRIPTORS or (status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def _close(folder: Folder) -> None:
    if isinstance(folder, int):
        os.close(folder)


def _beside(folder: Folder, name: str) -> tuple[str, int | None]:
    """A file of the folder, as functions of ``os`` take it: a path, and the descriptor it is beside."""
    return (name, folder) if isinstance(folder, int) else (str(folder / name), None)


def _content(folder: Folder, name: str) -> bytes | None:
    """What has been kept under this name, if it is as it was, and nobody else may have written it."""
    path, beside = _beside(folder, name)
    try:
        status = os.stat(path, dir_fd=beside, follow_symlinks=False)
        if not (stat.S_ISREG(status.st_mode) and _is_private(status)):
            return None
        with open(os.open(path, os.O_RDONLY | _BINARY, dir_fd=beside), "rb") as file:
            content = file.read()
    except OSError:
        return None
    content, digest = content[:-_DIGEST], content[-_DIGEST:]
    return content if digest == _digest(name, content) else None


def _digest(name: str, content: bytes) -> bytes:
    return hashlib.sha256(name.encode() + content).digest()


def _store(folder: Folder, name: str, content: bytes) -> str | None:
    """Writes it, or says why it cannot; others see all of it or nothing, also after a loss of power."""
    unfinished, beside = _beside(folder, f"{secrets.token_hex(8)}{_UNFINISHED}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _BINARY
    try:
        with open(os.open(unfinished, flags, 0o600, dir_fd=beside), "wb") as file:
            file.write(content + _digest(name, content))
            file.flush()
            os.fsync(file.fileno())
            now = os.fstat(file.fileno()).st_mtime
        os.replace(unfinished, _beside(folder, name)[0], src_dir_fd=beside, dst_dir_fd=beside)
    except OSError as error:
        with suppress(OSError):
            os.unlink(unfinished, dir_fd=beside)
        return _reason(error)
    _remove_abandoned(folder, now)
    return None


def _remove_abandoned(folder: Folder, now: float) -> None:
    """What others, who were killed, have left half written."""
    for left in os.listdir(folder):
        if left.endswith(_UNFINISHED):
            path, beside = _beside(folder, left)
            with suppress(OSError):  # another has been faster
                if now - os.stat(path, dir_fd=beside).st_mtime > _ABANDONED:
                    os.unlink(path, dir_fd=beside)


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).lower()


@lru_cache
def _warn(folder: str, reason: str) -> None:
    """Warns, once for each folder and reason."""
    text = (
        f"TORCHFRA_CACHE: expected a folder that you alone can write to, received {folder} ({reason}): kernels are "
        "compiled again by every process"
    )
    warnings.warn(text, RuntimeWarning, stacklevel=2)
