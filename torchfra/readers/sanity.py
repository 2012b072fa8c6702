"""Refuses tracks that nothing can have moved along, with what the cause may be."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from torchfra.readers.columns import Array
from torchfra.readers.layouts import Layout
from torchfra.readers.names import unit
from torchfra.readers.options import AskError, listed
from torchfra.readers.recording import Recording
from torchfra.tables import plural

_TOO_MANY = 0.2
"""Share of the fixes from which on targets are not left out that a column may part."""
_MANY, _SOME, _SHORTEST = 25, 8, 1.0
"""Fixes from which on the speed of a track is judged, and whether it is of degrees; seconds that it lasts at least."""
_FASTEST, _FASTEST_METRES, _FASTEST_SHIP = 5000.0, 1000.0, 150.0
"""Speeds that half of the steps stay below, m/s: of all, of x and y without a unit, and of ships."""
_RESCUE = "111"
"""How numbers of aircraft of search and rescue begin, which receivers of ships hear."""
_ACROSS = 30.0
"""Speeds are means over so many seconds, so that noise does not count."""
_RADIANS, _NEAR = (math.pi / 2, math.pi), 0.06
"""Latitude and longitude at most, rad, and what both are below within 3.5 degrees of 0, 0."""
_SLOW = 340.0 * math.pi / 180
"""Speed of radians that are taken as degrees, m/s, if a target is no faster than sound."""
_DEGREES, _AS_DEGREES = np.array([180.0, 90.0]), (2e-6, 5e-3)
"""Longitude and latitude at most, and degrees a second of what moves by 0.2 to 500 m/s."""


def checked(recordings: Sequence[Recording], layout: Layout, places: Array) -> list[Recording]:
    """The recordings of possible speeds; the others are left out, and named in the repairs of the first one.

    Args:
        recordings: of a file.
        layout: of its table.
        places: ``(k, 2)`` coordinates of all, as in the file.

    Raises:
        ValueError: no recording that is long enough to be judged has possible speeds, or some with a fifth of the fixes
            have not, and a column that was not read may part them; or x and y are degrees, or have another unit than
            metres; or latitudes and longitudes may be radians.
    """
    options, source = layout.stated, layout.source
    if not layout.degrees and not options.units:
        _check_metres(recordings, layout)
    if layout.degrees and options.lat is None and not layout.certain:
        _check_degrees(recordings, layout, places)
    if options.time_format:
        return list(recordings)
    wrong = {recording: said for recording in recordings if (said := _impossible(recording))}
    good = [recording for recording in recordings if recording not in wrong]
    fixes, total = (sum(len(recording.time) for recording in several) for several in (wrong, recordings))
    judged = sum(len(recording.time) >= _MANY for recording in recordings)
    if wrong and (len(wrong) == judged or (any(layout.unread) and fixes > _TOO_MANY * total)):
        recording, said = next(iter(wrong.items()))
        raise AskError(f"{said} of {source.word} {recording.name}; ", *_cause(layout))
    if wrong:
        names = listed(recording.name for recording in wrong)
        word = plural(source.word) if len(wrong) > 1 else source.word
        good[0].repairs[f"fixes of {word} {names} dropped, of impossible speed"] = fixes
    return good


def _check_metres(recordings: Sequence[Recording], layout: Layout) -> None:
    """Refuses x and y without a unit that are degrees of longitude and latitude, or too fast for metres."""
    x, y = layout.columns["x"], layout.columns["y"]
    judged = [recording for recording in recordings if len(recording.time) >= _SOME]
    if not judged or layout.source.unit != 1 or unit(x):
        return
    speeds = [speed_across(recording) for recording in judged]
    many = max(len(recording.time) for recording in judged) >= _MANY
    if many and not layout.stated.time_format and _FASTEST_METRES < min(speeds) < _FASTEST:
        raise AskError(f"expected metres in {x} and {y}, received a speed of {min(speeds):,.0f} m/s: say their unit, "
                       "such as ", {"units": "mm"}, ", or ", {"units": "m"}, " if they are metres")  # fmt: skip
    places = np.concatenate([recording.position[:, :2] for recording in judged])
    steps = np.concatenate([np.abs(np.diff(recording.position[:, :2], axis=0)).max(1) for recording in judged])
    fine = np.abs(1e4 * places - np.rint(1e4 * places)).max(1) > 1e-3
    moved = max(np.ptp(recording.position[:, :2], 0).max() for recording in judged)
    lies = (np.abs(places).max(0) <= _DEGREES).all() and np.abs(np.median(places, 0)).max() > 1
    if lies and moved > 5 * np.median(steps) and fine.mean() > 0.5 and _AS_DEGREES[0] < max(speeds) < _AS_DEGREES[1]:
        raise AskError(f"expected metres in {x} and {y}, received what looks like degrees of longitude and latitude: "
                       "say ", {"lat": y, "lon": x}, "; or ", {"units": "m"}, " if they are metres")  # fmt: skip


def _check_degrees(recordings: Sequence[Recording], layout: Layout, places: Array) -> None:
    """Refuses latitudes and longitudes without a unit that may be radians: all in the Gulf of Guinea, and slow."""
    lat, lon = layout.columns["latitude"], layout.columns["longitude"]
    judged = [recording for recording in recordings if len(recording.time) >= _SOME]
    size = np.abs(places)
    if not judged or (size > _RADIANS).any() or np.median(size, 0).max() < _NEAR:
        return
    if all(speed_across(recording) < _SLOW for recording in judged):
        raise AskError(f"expected degrees in {lat} and {lon}, received what looks like radians: write degrees, or say ",
                       {"lat": lat, "lon": lon}, " if they are degrees")  # fmt: skip


def _impossible(recording: Recording) -> str:
    """What is wrong with a recording; "" if nothing is."""
    time = recording.time
    if len(time) < _MANY:
        return ""
    if time[-1] - time[0] < _SHORTEST:
        return f"expected more than {_SHORTEST:g} s, received {len(time)} fixes within {time[-1] - time[0]:.3g} s"
    speed = float(np.median(np.linalg.norm(np.diff(recording.position, axis=0), axis=1) / np.diff(time)))
    if speed > _FASTEST:
        return f"expected speeds below {_FASTEST / 1000:g} km/s, received {speed / 1000:.3g} km/s as the median"
    ship = recording.source.word == "ship" and not recording.name.startswith(_RESCUE)
    if ship and (speed := speed_across(recording)) > _FASTEST_SHIP:
        return f"expected speeds below {_FASTEST_SHIP:g} m/s, received {speed:.3g} m/s as the median"
    return ""


def speed_across(recording: Recording, share: float = 0.5) -> float:
    """Speed over 30 s on the ground that this share of the fixes does not exceed, m/s; 0 of a single fix or none."""
    there = np.isfinite(recording.position[:, :2]).all(1)
    time, position = recording.time[there], recording.position[there, :2]
    if not len(time):
        return 0.0
    later = np.searchsorted(time, time + _ACROSS).clip(max=len(time) - 1)
    passed = time[later] - time
    there = passed > 0
    if not there.any():
        return 0.0
    speed = np.linalg.norm(position[later] - position, axis=1)[there] / passed[there]
    return float(np.quantile(speed, share))


def _cause(layout: Layout) -> tuple[str | dict[str, str], ...]:
    """What the cause may be, and the options that say so."""
    clock, columns, causes = layout.clock, layout.columns, list[str | dict[str, str]]()
    if layout.degrees:
        lat, lon = columns["latitude"], columns["longitude"]
        causes += [f"{lon} and {lat} may be metres: ", {"x": lon, "y": lat}, "; "]
    causes += [f"{clock.column} may be another column or in another unit: ", {"time_format": "ms"}, " or ",
               {"time_format": "excel"}, ", say; or it is right: ", {"time_format": clock.kind.form}]  # fmt: skip
    parted = ("; rows of several targets in one look so too: name what parts them, such as ", *layout.other_ids)
    return *causes, *(parted if any(layout.unread) else ())
