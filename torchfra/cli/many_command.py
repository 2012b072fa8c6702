"""``torchfra many``: cleans the tracks of a data set, part by part, by several processes."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torchfra.cleaning import DEFAULT, check_settings
from torchfra.cleaning.many import Work, clean_part, summed
from torchfra.cli.command import IncompleteError, add_output_options, check_files, check_folder, check_least, complain
from torchfra.cli.compiling import reporters
from torchfra.cli.reading_options import add_cleaning_options, add_reading_options, reading_of
from torchfra.readers.datasets import open_data
from torchfra.running import distributed
from torchfra.running.jobs import add_jobs_option, finished
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.tables import duration, in_words, plural, printable

_ABOUT = """Clean the tracks of a data set in Parquet, a million of them say, as torchfra track does those of a file.

DATA is a file or a folder with files below it, whose rows are in any order: a target may have rows in all of them.
Targets are divided into parts by a hash of their ids, each part is read from all files, and its cleaned tracks go to
OUT/part-00000.parquet and so on: OUT is a data set itself, whose column row numbers the rows of DATA through all files,
in the order of their names. Memory does not grow with the data. A part exists completely or not at all, and an existing
one is done: after Ctrl-C, kill -9 or a power cut the same command continues where it was."""

_EXAMPLES = """examples:
  torchfra many flights --out clean --jobs 8           # eight processes
  torchfra many flights --out clean --no-smooth --json clean.json
  torchrun --nproc-per-node 8 -m torchfra many flights --out clean     # or on several machines with one file system

Where RANK and WORLD_SIZE are set, as by torchrun, each process takes every WORLD_SIZE-th part, from RANK on,
independently of the others; the one that ends last writes the summary. The same command once more summarises the
existing parts."""

PARTS, FEWEST, MOST = 64, 100_000, 1_000_000
"""Number of parts, and least and largest number of rows of one: all files are read for each, and an unfinished part
is repeated."""
_MOST_NAMED = 5
"""Largest number of failed targets that are named one by one."""


def add_to(command: argparse.ArgumentParser) -> None:
    """Adds the description, the options and the function of the command to its parser."""
    command.description, command.epilog = _ABOUT, _EXAMPLES
    add = command.add_argument
    add("data", metavar="DATA", type=Path)
    add("--out", type=Path, required=True, metavar="FOLDER", help="a new folder, or one that this command has begun")
    usual = f"a {PARTS}th of all, from {FEWEST:,} to {MOST:,}"
    add("--rows", type=int, metavar="N", help=f"approximate number of rows of a part (default: {usual})")
    add_jobs_option(command)
    add_cleaning_options(command.add_argument_group("cleaning").add_argument)
    add_reading_options(command.add_argument_group("reading").add_argument)
    add_output_options(command)
    command.set_defaults(run=run, together=False)


def run(options: argparse.Namespace) -> None:
    """Runs the command; under ``torchrun`` in every process, each of which does its parts."""
    check_least(options, jobs=1, rows=1)
    settings: dict[str, Any] = {name: getattr(options, name) for name in ("bank", "sigma", "q", "dt")}
    check_settings(DEFAULT, **settings)
    rank, size = distributed.launched()
    check_folder("out", options.out)
    if options.data.is_dir() and options.data.resolve() in (options.out / "part").resolve().parents:
        raise ValueError(f"out: expected a folder outside of {options.data}, received {options.out}")
    data = open_data(options.data, **reading_of(options))
    check_files({"json": options.json}, [file.path for file in data.files])
    rows = options.rows or min(max(-(-data.rows // PARTS), FEWEST), MOST)
    work = Work(data, options.out, rows, settings | {"smooth": not options.no_smooth, "repair": not options.no_repair})
    work.begin()
    tell, _ = reporters(None, options.quiet or rank > 0)
    for note in data.reader.layout.source.notes:
        tell(printable(note))
    _clean(work, range(rank, work.parts, size), options.jobs, tell, not options.quiet and rank == 0)
    every = work.facts()
    if len(every) == work.parts:  # in the process that ends last
        _end(options, work, summed(every))
    else:
        tell(f"{len(every):,} of {work.parts:,} parts are done; the others are not of this process")


def _clean(work: Work, mine: Sequence[int], jobs: int, tell: Callable[[str], None], show: bool) -> None:
    """Cleans the parts that are not done."""
    left = [(work, part) for part in mine if not work.is_done(part)]
    before = len(mine) - len(left)
    if before:
        tell(f"{before:,} of {len(mine):,} parts were done before")
    begun, rows = time.perf_counter(), 0
    for _, facts in progress_bar(finished(clean_part, left, jobs), "part", show, total=len(mine), done=before):
        rows += facts["rows"]
    if left:
        seconds = time.perf_counter() - begun
        tell(f"{rows:,} rows in {duration(seconds)}: {rows / seconds:,.0f} a second")


def _end(options: argparse.Namespace, work: Work, total: dict[str, Any]) -> None:
    """Prints and writes the summary."""
    tell, _ = reporters(None, options.quiet)
    word = plural(work.data.reader.layout.source.word)
    tell(f"{total['targets']:,} {word}: {total['fixes']:,} fixes, {total['outliers']:,} rejected")
    if total["repairs"]:
        tell(f"Repaired: {in_words(total['repairs'])}")
    if unnamed := work.data.rows - total["rows"]:
        tell(f"Left out: {unnamed:,} rows without an id")
    tell(f"Each process: {total['rows_per_second']:,.0f} rows a second, {total['memory'] / 1e6:,.0f} MB at most")
    tell(f"Written: {work.parts:,} parts in {printable(str(work.folder))}")
    settings = {"data": str(options.data), "rows": work.rows, **work.settings, **reading_of(options)}
    write_results(options.json, {"settings": settings, "parts": work.parts, **total})
    if failed := total["failed"]:
        lines = [f"{name}: {why}" for name, why in list(failed.items())[:_MOST_NAMED]]
        if len(failed) > _MOST_NAMED:
            lines.append(f"{len(failed):,} {word} failed: --json names all")
        complain("torchfra", *lines)
        raise IncompleteError
