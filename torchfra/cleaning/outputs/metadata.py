"""Metadata of a table: its input, settings, origin and manoeuvres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.summary import summary
from torchfra.cleaning.outputs.table import about, columns
from torchfra.running.versions import versions


def metadata(results: Sequence[Cleaned], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Metadata of some targets of a file, for JSON.

    Args:
        results: of one file.
        settings: as they were given.
    """
    alike = {(one.raw.shape[1], one.recording.origin is None): one for one in results}
    names = dict.fromkeys(name for one in alike.values() for name in columns(one))
    source = results[0].recording.source
    return {
        "input": source.name,
        "input_columns": source.columns,
        "metres_per_unit": source.unit,
        "input_notes": list(source.notes),
        "settings": dict(settings),
        "versions": versions(),
        "columns": about(list(names)),
        "tracks": [_of(cleaned) for cleaned in results],
    }


def _of(cleaned: Cleaned) -> dict[str, Any]:
    origin = cleaned.recording.origin
    named = None if origin is None else dict(zip(("latitude", "longitude", "altitude"), origin, strict=True))
    return {"origin": named, "first_time": float(cleaned.recording.time[0])} | summary(cleaned)
