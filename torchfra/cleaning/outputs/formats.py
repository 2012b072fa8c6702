"""Formats by the endings of files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs import csv_table, maps, parquet
from torchfra.cleaning.outputs.metadata import metadata
from torchfra.readers import Recording
from torchfra.running.atomic_write import write as write_whole
from torchfra.running.atomic_write import write_json

FORMATS: dict[str, Callable[[Sequence[Cleaned]], bytes]] = {
    ".csv": csv_table.encode,
    ".parquet": parquet.encode,
    ".gpx": maps.gpx,
    ".kml": maps.kml,
}
"""Encoders of some targets, by the ending of the file."""
MAPS = (".gpx", ".kml")
"""Formats that hold latitudes and longitudes only."""
_NEEDS = {".parquet": "pyarrow", ".gpx": "gpxpy"}
"""The package that a format needs."""


def check_format(ending: str, recordings: Sequence[Recording] = ()) -> None:
    """Checks, before any work, that recordings can be written in a format.

    Raises:
        ValueError: an unknown ending, or a format of maps for recordings without latitudes.
        ImportError: the package that writes it is missing.
    """
    if ending not in FORMATS:
        raise ValueError(f"out: expected a folder or a file ending in {', '.join(FORMATS)}, received {ending!r}")
    package = _NEEDS.get(ending)
    if package is not None and find_spec(package) is None:
        raise ImportError(f"out: {ending} needs {package}: pip install 'torchfra[formats]', or take .csv or .kml")
    if ending in MAPS:
        for recording in recordings:
            maps.origin_of(recording)


def write(results: Sequence[Cleaned], path: Path, settings: Mapping[str, Any]) -> None:
    """Writes some targets in the format of the file's ending, and their metadata beside it.

    Args:
        results: one or more, of one file.
        path: of the file.
        settings: as they were given.

    Raises:
        OSError: a file cannot be written.
        ValueError: a recording without latitudes in a format of maps.
    """
    content = FORMATS[path.suffix.lower()](results)
    write_whole(path, lambda file: file.write(content))
    write_json(beside(path), metadata(results, settings))


def beside(path: Path) -> Path:
    """The file with the metadata of a table."""
    return path.with_suffix(".meta.json")
