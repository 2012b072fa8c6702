"""Common parts of the commands: options, errors in one line, exit status."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from torchfra.running import atomic_write, home  # noqa: F401  # home: before anything looks for one
from torchfra.running.memory import keep_memory
from torchfra.suggestions import meant
from torchfra.tables import printable

_STATUS = """exit status: 0; 1 if a part of the work failed or a result is not finite, and the rest is done; 2 if an
argument or a file was wrong; 130 after Ctrl-C; 141 if what reads the output has closed it"""
_LONGEST = 1000
"""Largest number of characters of an error message."""
_NO_MEMORY = ("can't allocate memory", "out of memory", "Storage size calculation overflowed")
"""Parts of the messages of torch when memory runs out."""


class Parser(argparse.ArgumentParser):
    """A parser that suggests known words for an unknown one."""

    def error(self, message: str) -> NoReturn:
        """Ends the program with a message."""
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        known = self._option_string_actions
        if wrong:
            message += meant(wrong[1], re.split(r"[', ]+", wrong[2].strip("'")))
        elif message.startswith("unrecognized arguments: "):
            message += meant(message.split()[2].partition("=")[0], known)
        super().error(message)


def make_parser(description: str | None, program: str | None = None) -> argparse.ArgumentParser:
    """A parser whose help keeps the lines of the description as they are, and explains the exit status."""
    form = argparse.RawDescriptionHelpFormatter
    return Parser(program, description=description, epilog=_STATUS, formatter_class=form)


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Adds ``--json FILE``."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")


def add_quiet_option(parser: argparse.ArgumentParser) -> None:
    """Adds ``--quiet``."""
    parser.add_argument("--quiet", action="store_true", help="no progress bar, and print nothing but errors")


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Adds ``--json FILE`` and ``--quiet``."""
    add_json_option(parser)
    add_quiet_option(parser)


def add_runs_options(parser: argparse.ArgumentParser, runs: int, seed: int = 0) -> None:
    """Adds ``--runs M`` and ``--seed S`` with these defaults."""
    parser.add_argument("--runs", type=int, default=runs, metavar="M", help=f"Monte-Carlo runs (default: {runs})")
    parser.add_argument(
        "--seed", type=int, default=seed, metavar="S", help=f"seed of the random numbers (default: {seed})"
    )


def check_least(options: argparse.Namespace, **least: int) -> None:
    """Checks, before any work, that numbers of a command are no less than these; None is not checked.

    Raises:
        ValueError: one is.
    """
    for name, lowest in least.items():
        value = getattr(options, name)
        if value is not None and value < lowest:
            raise ValueError(f"{name}: expected {lowest} or more, received {value}")


# ---------------------------------------------------------------- outputs


def check_files(outputs: Mapping[str, Path | None], inputs: Sequence[str | Path] = ()) -> None:
    """Checks, before any work, that output files can be written.

    Args:
        outputs: by option; None where it is not given.
        inputs: files that are read, none of which may be written to.

    Raises:
        OSError: one cannot be written.
        ValueError: one is an input, or two are the same.
    """
    known = {os.path.realpath(path): f"the input {path}" for path in inputs}
    for option, path in outputs.items():
        if path is None:
            continue
        atomic_write.check(path)
        place = os.path.realpath(path)
        if place in known and (path.is_file() or not path.exists()):
            raise ValueError(f"{option}: expected a file of its own, received {known[place]}")
        known[place] = f"{path}, as for {option}"


def check_folder(option: str, path: Path | None) -> None:
    """Checks, before any work, that files can be written below a folder, which need not exist yet.

    Raises:
        OSError: they cannot.
        ValueError: it is a file, or below one.
    """
    if path is None:
        return
    for place in (path, *path.parents):
        if place.is_file():
            raise ValueError(f"{option}: expected a folder, received the file {place}")
    atomic_write.check(path / "output")


# ---------------------------------------------------------------- errors


class IncompleteError(Exception):
    """The work is done, except for parts that failed: a message for each."""


class Failures:
    """Parts of the work that failed while the others went on."""

    def __init__(self) -> None:
        self.messages: list[str] = []

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        """Keeps an error of this part."""
        try:
            yield
        except BrokenPipeError:
            raise
        except Exception as error:
            self.messages.append(f"{part}: {message(error) or f'{type(error).__name__}: {error}'}")

    def end(self) -> None:
        """Ends the work.

        Raises:
            IncompleteError: a part failed.
        """
        if self.messages:
            raise IncompleteError(*self.messages)


def exit_status(program: str, work: Callable[[], object], alone: Callable[[], bool] = lambda: False) -> int:
    """Runs ``work``, with memory kept for reuse.

    Args:
        program: name in front of an error message.
        work: what the command does, from its arguments on; under ``torchrun`` in every process.
        alone: whether each process does work of its own and reports its errors; called at an error.

    Returns:
        0; 1 after a line on standard error for each part of the work that failed, or result that is not finite, where
        the rest is done; 2 after one line if an argument or a file was wrong; 130 after Ctrl-C; 141 if the reader of
        the output has closed it.
    """
    keep_memory()
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")  # names may have letters that the terminal cannot show
    try:
        try:
            work()
        finally:
            _flush()
    except IncompleteError as failures:
        _complain(program, alone(), *failures.args)
        return 1
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        _discard_output()
        return 141
    except Exception as error:
        text = message(error)
        if text is None:
            raise
        _discard_output()
        _complain(program, alone(), text)
        return 2
    return 0


def message(error: Exception) -> str | None:
    """The message of an error for the user, with options of commands; None for an error of the program itself."""
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(x in str(error) for x in _NO_MEMORY)):
        return f"not enough memory: {error}"
    if isinstance(error, OverflowError):
        return f"a number is too large: {error}"
    if isinstance(error, OSError) and error.strerror is not None:
        reason = "file not found" if isinstance(error, FileNotFoundError) else error.strerror.lower()
        return reason if error.filename is None else f"{reason}: {error.filename}"
    from torchfra.types import CompileError  # imports torch, which takes long

    known = (ValueError, OSError, ImportError, CompileError, NotImplementedError)
    return str(getattr(error, "command", error)) if isinstance(error, known) else None


def complain(program: str, *messages: str) -> None:
    """A line on standard error for each message."""
    for text in messages:
        print(f"{program}: error: {printable(' '.join(text.split()), _LONGEST)}", file=sys.stderr)


def _complain(program: str, alone: bool, *messages: str) -> None:
    """A line on standard error for each message; only from the first of processes that work together."""
    if alone or "WORLD_SIZE" not in os.environ or os.environ.get("RANK", "0") == "0":
        complain(program, *messages)


def _flush() -> None:
    if sys.stdout is not None:  # it may be closed from the start
        sys.stdout.flush()


def _discard_output() -> None:
    """Keeps Python from trying to write the rest of the output when it ends."""
    try:
        _flush()
    except (OSError, ValueError):
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
