"""``torchfra track``: cleans recorded tracks."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from torchfra import readers
from torchfra.cleaning import DEFAULT, Cleaned, check_settings, clean_tracks, outputs
from torchfra.cli import page
from torchfra.cli import plan as plans
from torchfra.cli.command import Failures, add_output_options, check_files, check_least
from torchfra.cli.compiling import reporters
from torchfra.cli.reading_options import add_bound_option, add_cleaning_options, add_reading_options, reading_of
from torchfra.readers import Recording
from torchfra.running import distributed
from torchfra.running.atomic_write import write_json
from torchfra.running.jobs import add_jobs_option, cores
from torchfra.running.progress import progress_bar
from torchfra.tables import printable

FILES = """FILE holds one or several recorded tracks: CSV with a header and any delimiter, such as of Movebank, Argos,
AIS and OpenSky, JSON, GPX, KML, VBOX, IGC, PLT, GeoJSON, NMEA 0183, Parquet or Feather, gzipped or not.
Columns are found by their names; the output states which were taken, and the options for reading name others."""

_ABOUT = f"""Clean a recorded track: positions with their standard deviations, wrong fixes, and manoeuvres.
Writes a table (and NAME.meta.json beside it, with metadata) and a picture.

{FILES}"""

_EXAMPLES = f"""examples:
  torchfra track flight.csv                          # out/flight.csv and out/flight.png; the noise is estimated
  torchfra track flight.csv --out clean.parquet      # one table of all targets: {", ".join(outputs.FORMATS)}
  torchfra track flights.csv --format gpx            # out/NAME.gpx for each target
  torchfra track walk.csv --sigma 5 --bank person    # known values are not estimated
  torchfra track log.csv --time when --lat breite --lon laenge --delimiter ";" --decimal ,
  torchfra track flight.csv --no-smooth --filter vsimm_srckf    # another filter, on line
  torchfra track flight.csv --dt 1 --html flight.html           # also every second, and an interactive page

A row of the table is a fix: its row in the input (from 0), its time in UTC (or seconds), the recorded and the cleaned
position in the input's own coordinates, speed, course, climb, standard deviations along and across the course, the
probability of an outlier, the residual, the probability of a manoeuvre, a flag, and the covariance."""


def add_to(command: argparse.ArgumentParser) -> None:
    """Adds the description, the options and the function of the command to its parser."""
    command.description, command.epilog = _ABOUT, _EXAMPLES
    add = command.add_argument
    add("file", metavar="FILE", type=Path)
    endings = ", ".join(outputs.FORMATS)
    add("--out", type=Path, default=Path("out"), metavar="PATH",
        help=f"a file for all targets ({endings}) or a folder for one of each (default: out)")  # fmt: skip
    add("--format", metavar="NAME", choices=[ending[1:] for ending in outputs.FORMATS],
        help=f"format of the tables in a folder: {endings.replace('.', '')} (default: csv)")  # fmt: skip
    add("--plots", action=argparse.BooleanOptionalAction,
        help=f"a picture of each target (default: for {plans.MOST_PICTURES} targets or fewer)")  # fmt: skip
    add("--html", type=Path, metavar="FILE", help="write a page with interactive pictures; needs plotly")
    add("--share-script", action=argparse.BooleanOptionalAction,
        help="keep the page's script, of some 5 MB, in a file beside it, which all pages of a folder share, or inside "
        "the page (default: beside it)")  # fmt: skip
    cleaning = command.add_argument_group("cleaning").add_argument
    add_cleaning_options(cleaning)
    cleaning("--filter", default=DEFAULT, metavar="NAME",
             help=f"a filter that torchfra compare --help lists (default: {DEFAULT})")  # fmt: skip
    add_reading_options(command.add_argument_group("reading").add_argument)
    add_jobs_option(command, None, "the most processes that share the work, where there are 20,000 fixes or more for "
                    "each (default: as many as processors)")  # fmt: skip
    add("--verbose", action="store_true", help="say more: settings, notes and how well the model fits")
    add_bound_option(add)
    add_output_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command, in the first process alone."""
    if distributed.rank():
        return
    extra = {"json": options.json, "html": options.html}
    check_least(options, jobs=1)
    plans.ending_of(options.out, options.format)
    if options.html is not None:
        page.check_script()
    if options.html is None and options.share_script is not None:
        raise ValueError("share-script: expected --html beside it, received none")
    if options.html is not None and options.share_script is not False:
        extra["share-script"] = page.script_beside(options.html)
    check_files(extra, [options.file])
    check_settings(options.filter, dt=options.dt, sigma=options.sigma, q=options.q, bank=options.bank)
    options.jobs = options.jobs or cores()
    words: dict[str, Any] = reading_of(options)
    recordings = readers.read(options.file, max_bytes=options.max_bytes, **words)
    files = plans.plan(recordings, options.out, options.format, options.plots)
    check_files(extra | {f"out, {path.name}": path for path in files.paths()}, [options.file])
    if files.pictures:
        # With matplotlib it takes half a second, in which others work.
        threading.Thread(target=import_module, args=("torchfra.cleaning.figures",)).start()
    tell, _ = reporters(None, options.quiet)
    read = list(dict.fromkeys(printable(note) for recording in recordings for note in recording.source.notes))
    for line in read if options.verbose else ["; ".join(read)]:
        tell(f"Read: {line}")
    failures = Failures()
    results = _cleaned(recordings, options, failures)
    if not results:
        failures.end()
    if not options.quiet:
        for line in outputs.report(list(results.values()), verbose=options.verbose):
            tell(line)
    _write(results, files, options, failures)
    _draw(results, files, options, failures)
    if options.json is not None:
        with failures.of("json"):
            write_json(options.json, outputs.metadata(list(results.values()), _settings(options)))
    written = [*files.paths(), *filter(None, extra.values())]
    tell(f"Written: {plans.in_brief([path for path in written if path.exists()])}")
    failures.end()


def _settings(options: argparse.Namespace) -> dict[str, Any]:
    return {key: getattr(options, key) for key in ("filter", "bank", "sigma", "q", "no_smooth", "no_repair", "dt")}


def _cleaned(
    recordings: Sequence[Recording], options: argparse.Namespace, failures: Failures
) -> dict[Recording, Cleaned]:
    """The targets that could be cleaned."""
    results = clean_tracks(
        recordings, filter=options.filter, bank=options.bank, sigma=options.sigma, q=options.q,
        smooth=not options.no_smooth, dt=options.dt, repair=not options.no_repair,
        jobs=options.jobs,
    )  # fmt: skip
    done = {}
    for cleaned in results:
        if not cleaned.found.failure:
            done[cleaned.recording] = cleaned
        elif len(recordings) == 1:
            raise ValueError(cleaned.found.failure)
        else:
            with failures.of(printable(cleaned.recording.name)):
                raise ValueError(cleaned.found.failure)
    return done


def _write(
    results: dict[Recording, Cleaned], files: plans.Plan, options: argparse.Namespace, failures: Failures
) -> None:
    """Writes the tables."""
    for path, recordings in progress_bar(files.tables.items(), "table", not options.quiet):
        of = [results[recording] for recording in recordings if recording in results]
        if not of:
            continue
        with failures.of(printable(of[0].recording.name if len(of) == 1 else path.name)):
            outputs.write(of, path, _settings(options))
        for cleaned in of:
            with failures.of(printable(cleaned.recording.name)):
                _check(cleaned)


def _check(cleaned: Cleaned) -> None:
    """Checks that all estimates are numbers."""
    if failed := int(cleaned.failed.sum()):
        raise ValueError(f"NaN or infinity in {failed} of {len(cleaned.time)} steps")


def _draw(
    results: dict[Recording, Cleaned], files: plans.Plan, options: argparse.Namespace, failures: Failures
) -> None:
    """Writes the pictures and the page."""
    if files.pictures:
        from torchfra.cleaning import figures  # matplotlib takes long to import
        from torchfra.plotting import save

        for recording, path in progress_bar(files.pictures.items(), "picture", not options.quiet):
            if (cleaned := results.get(recording)) is not None:
                with failures.of(printable(recording.name)):
                    save(figures.cleaned(cleaned), path)
    if options.html is not None:
        with failures.of("html"):
            page.write(list(results.values()), options.html, share=options.share_script is not False)
