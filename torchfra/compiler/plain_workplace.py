"""Where kernels are compiled on systems without process groups, locks and a shell of POSIX: on Windows.

A killed process may leave its temporary folder behind, and a compilation may end a little later than who started it.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

_running: set[subprocess.Popen[str]] = set()


@contextmanager
def workplace() -> Iterator[Path]:
    """A temporary folder; a library in it that is loaded stays, as Windows removes no file that is open.

    Raises:
        OSError: there is no place for it.
    """
    with tempfile.TemporaryDirectory(prefix="torchfra-compiles-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def run(command: Sequence[str], folder: Path) -> tuple[int, str]:
    """Runs a command whose temporary files go to ``folder``.

    Returns:
        Its exit status, and what it wrote.
    """
    places = dict.fromkeys(("TMP", "TEMP", "TMPDIR"), str(folder))
    with subprocess.Popen(
        command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        errors="replace", env={**os.environ, **places},
    ) as process:  # fmt: skip
        _running.add(process)
        try:
            said = process.communicate()[0]
        except BaseException:
            process.kill()
            raise
        finally:
            _running.discard(process)
    return process.returncode, said


def stop() -> None:
    """Ends all compilations of this process, in whichever thread."""
    for process in list(_running):
        process.kill()
