"""Tracks as GeoJSON (RFC 7946)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.points import Points, points
from torchfra.readers.columns import Array


def encode(results: Sequence[Cleaned]) -> bytes:
    """A line of each target, its manoeuvres as lines of their own, and its rejected fixes where they were recorded.

    The track's ``coordTimes`` and ``coordinateProperties`` hold the times and the attributes of its points, nested as
    the coordinates are.

    Raises:
        ValueError: a recording without latitudes.
    """
    features = [feature for cleaned in results for feature in _features(points(cleaned))]
    return (json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n").encode()


def _features(of: Points) -> list[dict[str, Any]]:
    pieces = _pieces(of.place)
    properties: dict[str, Any] = {"name": of.name, "what": "track"}
    if of.dates is not None:
        properties["coordTimes"] = _nested(of.dates, pieces)
    properties["coordinateProperties"] = {name: _nested(values, pieces) for name, values in of.attributes.items()}
    track = {"type": "Feature", "geometry": _line(of.place, pieces), "properties": properties}
    manoeuvres = [
        {"type": "Feature", "geometry": _line(of.place[steps], _pieces(of.place[steps])),
         "properties": {"name": of.name, "what": "manoeuvre", **segment._asdict()}}
        for segment, steps in of.manoeuvres if len(steps) > 1
    ]  # fmt: skip
    rejected = {
        "type": "Feature",
        "geometry": {"type": "MultiPoint", "coordinates": of.rejected},
        "properties": {"name": of.name, "what": "rejected fixes", "row": of.rejected_rows},
    }
    return [track, *manoeuvres, *([rejected] if len(of.rejected) else [])]


def _pieces(place: Array) -> list[NDArray[np.intp]]:
    """Numbers of the points between crossings of the antimeridian, over which no line may go."""
    cuts = np.flatnonzero(np.abs(np.diff(place[:, 0])) > 180) + 1
    return np.split(np.arange(len(place)), cuts)


def _nested(values: Sequence[Any], pieces: list[NDArray[np.intp]]) -> list[Any]:
    parts = [[values[i] for i in piece] for piece in pieces]
    return parts[0] if len(parts) == 1 else parts


def _line(place: Array, pieces: list[NDArray[np.intp]]) -> dict[str, Any]:
    kind = "LineString" if len(pieces) == 1 else "MultiLineString"
    return {"type": kind, "coordinates": _nested(place.tolist(), pieces)}
