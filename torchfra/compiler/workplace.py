"""Where kernels are compiled: a temporary folder and processes that do not outlive this one."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

if sys.platform != "win32":
    import fcntl

_PREFIX = "torchfra-kernel-"
_WATCHED = """
exec 3<&0
"$@" </dev/null & compiler=$!
{ read -r _ <&3; kill -KILL 0; } >/dev/null 2>&1 & watcher=$!
wait $compiler; status=$?
kill -KILL $watcher; wait $watcher 2>/dev/null
exit $status
"""
"""Runs a command; when standard input ends, because who started it has, all of its processes end."""

_running: set[int] = set()
"""Process groups."""


@contextmanager
def workplace() -> Iterator[Path]:
    """A temporary folder of this user alone; one that a killed process has left is removed by the next.

    Raises:
        OSError: there is no place for it.
    """
    _remove_abandoned()
    folder, lock = _locked()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def run(command: Sequence[str], folder: Path) -> tuple[int, str]:
    """Runs a command whose temporary files go to ``folder``; it ends when this process does, however that ends.

    Returns:
        Its exit status, and what it wrote on standard error.
    """
    watched, ours = os.pipe()
    try:
        with subprocess.Popen(
            ["/bin/sh", "-c", _WATCHED, "sh", *command], stdin=watched, stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True, errors="replace", env={**os.environ, "TMPDIR": str(folder)},
            start_new_session=True,
        ) as process:  # fmt: skip
            _running.add(process.pid)
            try:
                errors = process.communicate()[1]
            except BaseException:  # an interruption: nothing may write to the folder when it is removed
                stop()
                raise
            finally:
                _running.discard(process.pid)
    finally:
        os.close(watched)
        os.close(ours)
    return process.returncode, errors


def stop() -> None:
    """Ends all compilations of this process, in whichever thread."""
    for group in list(_running):
        with suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)


def _locked() -> tuple[Path, int]:
    """A new folder, and a descriptor that holds its lock: until it is closed, or this process has ended."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
        with suppress(FileNotFoundError):  # removed before it was locked
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            with suppress(OSError):  # a file system without locks, where folders stay
                fcntl.flock(lock, fcntl.LOCK_EX)
            if folder.exists():
                return folder, lock
            os.close(lock)


def _remove_abandoned() -> None:
    """Removes the folders of this user whose locks nobody holds."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):  # it is gone, or no folder, or locked
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(lock).st_uid == os.geteuid():
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)
