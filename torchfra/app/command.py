"""What the commands of this package have in common: options, errors in one line, exit status."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection
from pathlib import Path

from torchfra.app import distributed
from torchfra.app.memory import keep_memory
from torchfra.kernel.build import CompileError
from torchfra.readers.bounded import MAX_BYTES


def make_parser(description: str | None, program: str | None = None) -> argparse.ArgumentParser:
    """A parser whose help keeps the lines of the description as they are."""
    form = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(program, description=description, formatter_class=form)


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Adds ``--json FILE``."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")


def add_quiet_option(parser: argparse.ArgumentParser) -> None:
    """Adds ``--quiet``."""
    parser.add_argument("--quiet", action="store_true", help="no progress bar, and print nothing but errors")


def add_bound_option(add: Callable[..., object], default: int | None = MAX_BYTES) -> None:
    """Adds ``--max-bytes N`` by a parser's ``add_argument``; without a ``default`` one sees whether it was given."""
    about = f"text that a file may hold, unpacked: a row counts for 64 or more (default: {MAX_BYTES})"
    add("--max-bytes", type=int, default=default, metavar="N", help=about)


def add_runs_options(parser: argparse.ArgumentParser, runs: int, seed: int = 0) -> None:
    """Adds ``--runs M`` and ``--seed S`` with these defaults."""
    parser.add_argument("--runs", type=int, default=runs, metavar="M", help=f"Monte-Carlo runs (default: {runs})")
    parser.add_argument(
        "--seed", type=int, default=seed, metavar="S", help=f"seed of the random numbers (default: {seed})"
    )


def check_list(parser: argparse.ArgumentParser, option: str, value: str, known: Collection[str]) -> None:
    """Ends the program with a message unless ``value`` is a comma-separated list of known names."""
    unknown = [name for name in value.split(",") if name not in known]
    if unknown:
        parser.error(f"--{option}: expected names out of {', '.join(known)}, received {', '.join(unknown)}")


def check_folder(option: str, path: Path | None) -> None:
    """Checks that files can be written below a folder, which need not exist yet.

    Raises:
        ValueError: it is a file, or below one.
    """
    for place in (path, *path.parents) if path is not None else ():
        if place.is_file():
            raise ValueError(f"{option}: expected a folder, received the file {place}")


def exit_status(program: str, work: Callable[[], object]) -> int:
    """Runs ``work``, with memory kept for reuse.

    Args:
        program: name in front of an error message.
        work: what the command does; under ``torchrun`` in every process.

    Returns:
        0, or 2 after one line on standard error if an argument or a file was wrong.
    """
    keep_memory()
    try:
        work()
    except (ValueError, OSError, ImportError, CompileError) as error:
        if distributed.rank() == 0:
            print(f"{program}: error: {' '.join(_message(error).split())}", file=sys.stderr)
        return 2
    return 0


def _message(error: Exception) -> str:
    """What a user reads: of a file that cannot be opened, the reason and its name."""
    if not isinstance(error, OSError) or error.filename is None or error.strerror is None:
        return str(error)
    reason = "file not found" if isinstance(error, FileNotFoundError) else error.strerror.lower()
    return f"{reason}: {error.filename}"
