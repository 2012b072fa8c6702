"""The output files, and the targets of each."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from torchfra.cleaning.outputs.formats import beside, check_format
from torchfra.cleaning.outputs.summary import LONGEST_NAME
from torchfra.readers import Recording
from torchfra.tables import printable

MOST_PICTURES = 20
"""Largest number of targets that have a picture each by default."""
_MOST_LISTED = 5
"""Largest number of files that are listed by their names."""
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in range(1, 10))}
"""Names that no file can have on Windows, with any ending."""


class Plan(NamedTuple):
    """The files of one call."""

    tables: dict[Path, list[Recording]]
    """The targets of each table."""
    pictures: dict[Recording, Path]
    """The picture of each target; empty without pictures."""

    def paths(self) -> Iterator[Path]:
        """All files."""
        for path in self.tables:
            yield path
            yield beside(path)
        yield from self.pictures.values()


def ending_of(out: Path, form: str | None) -> tuple[bool, str]:
    """Whether ``out`` is one file for all targets, and the ending of tables.

    Raises:
        ValueError: a file of another format, an unknown format, or a format beside the name of a file.
        ImportError: the package that writes the format is missing.
    """
    ending = "" if out.is_dir() else out.suffix.lower()
    if ending and form is not None:
        raise ValueError(f"format: expected a folder as --out, received the file {out}")
    one = ending != ""
    check_format(ending if one else f".{form or 'csv'}")
    return one, ending if one else f".{form or 'csv'}"


def plan(recordings: Sequence[Recording], out: Path, form: str | None = None, plots: bool | None = None) -> Plan:
    """Files for all targets: a table of all if ``out`` has the ending of one, or else a folder with a table of each.

    Args:
        recordings: one or more.
        out: a file or a folder.
        form: of the tables in a folder; None for ``"csv"``.
        plots: whether each target has a picture; None draws no more than ``MOST_PICTURES`` targets.

    Raises:
        ValueError: a format that does not fit the recordings.
    """
    one, ending = ending_of(out, form)
    check_format(ending, recordings)
    folder, several = (out.parent if one else out), len(recordings) > 1
    used = set[str]()
    names = {recording: unused(recording.name, used) for recording in recordings}
    if one:  # pictures lie beside the table
        names = {recording: f"{out.stem}-{name}" if several else out.stem for recording, name in names.items()}
    tables = {out: list(recordings)} if one else {folder / f"{name}{ending}": [r] for r, name in names.items()}
    drawn = plots if plots is not None else len(recordings) <= MOST_PICTURES
    pictures = {recording: folder / f"{name}.png" for recording, name in names.items()} if drawn else {}
    return Plan(tables, pictures)


def in_brief(paths: Sequence[Path]) -> str:
    """The names of a few files; for many, the number of each ending in each folder."""
    if len(paths) <= _MOST_LISTED:
        return ", ".join(printable(str(path)) for path in paths)
    of_folder: dict[Path, Counter[str]] = {}
    for path in paths:
        of_folder.setdefault(path.parent, Counter())["".join(path.suffixes[-2:])] += 1
    return "; ".join(
        f"{', '.join(f'{count:,} {ending}' for ending, count in counts.items())} in {printable(str(folder))}"
        for folder, counts in of_folder.items()
    )


def unused(name: str, used: set[str]) -> str:
    """A file name, without its ending, that differs from those in ``used`` in more than case."""
    name = re.sub(r"[^\w.-]+", "_", name).encode()[:LONGEST_NAME].decode(errors="ignore").strip("_.") or "track"
    if name.split(".")[0].casefold() in _DEVICES:
        name = f"track-{name}"
    number, candidate = 2, name
    while candidate.casefold() in used:
        number, candidate = number + 1, f"{name}-{number}"
    used.add(candidate.casefold())
    return candidate
