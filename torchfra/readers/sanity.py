"""Refuses tracks that nothing can have moved along, and guesses what was meant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchfra.readers.clocks import days_of
from torchfra.readers.layouts import Layout
from torchfra.readers.recording import Recording
from torchfra.readers.repairs import plural
from torchfra.readers.sheets import listed
from torchfra.readers.spelling import unit as unit_of
from torchfra.readers.times import PER_SECOND, SINCE_1970, per_second

_TOO_MANY = 0.1
"""Share of the fixes from which on targets are not left out that the file can part."""
_SEVERAL = "rows of several targets in one look so"
"""What an error message says of steps between targets."""
_MANY = 25
"""Fixes from which on a track is judged."""
_SHORTEST = 1.0
"""Seconds that such a track lasts at least."""
_FASTEST = 5000.0
"""Speed that half of the steps stay below, m/s."""
_FASTEST_METRES = 1000.0
"""Speed over 30 s up to which x and y without a unit are taken as metres, m/s."""
_FASTEST_SHIP = 150.0
"""Speed that half of the steps of a ship stay below, m/s; numbers of aircraft of search and rescue begin with
``_RESCUE``."""
_RESCUE = "111"
_LARGEST, _OFF_THE_ORIGIN = np.array([180.0, 90.0]), 1.0
"""Degrees of longitude and latitude, and how far from 0 most of the earth is."""
_AS_DEGREES, _ROUNDED, _FAR = (2e-6, 5e-3), 1e-3, 5.0
"""Degrees a second of what moves by 0.2 to 500 m/s; what is left of rounding, in the fourth decimal; and how many steps
a target goes that does not rest."""
_ACROSS = 30.0
"""Speeds are means over so many seconds, so that noise does not count."""
_USUAL = (0.05, 1000.0)
"""Speeds of what is tracked, m/s."""


def possible(recordings: Sequence[Recording], layout: Layout) -> list[Recording]:
    """The recordings of possible speeds; the others are left out, and named in the repairs of the first one.

    Raises:
        ValueError: no recording has possible speeds, with what the times may be instead; or some with many of the fixes
            have not, and a column parts them.
    """
    wrong = {recording: said for recording in recordings if (said := _impossible(recording))}
    if not wrong:
        return list(recordings)
    if len(wrong) == sum(len(recording.time) >= _MANY for recording in recordings):
        recording, said = next(iter(wrong.items()))
        raise ValueError(f"{said} of {layout.source.word} {recording.name}; {_guess(recording, layout)}")
    good = [recording for recording in recordings if recording not in wrong]
    names, fixes = listed(recording.name for recording in wrong), sum(len(recording.time) for recording in wrong)
    word = plural(layout.source.word) if len(wrong) > 1 else layout.source.word
    if layout.source.id_options and fixes > _TOO_MANY * sum(len(recording.time) for recording in recordings):
        recording, said = next(iter(wrong.items()))
        raise ValueError(f"{said} of {word} {names}, of {fixes:,} fixes; {_SEVERAL}: use {layout.source.id_options[0]}")
    good[0].repairs[f"fixes of {word} {names} dropped, of impossible speed"] = fixes
    return good


def check_metres(recordings: Sequence[Recording], layout: Layout) -> None:
    """Refuses x and y that are degrees of longitude and latitude, as maps of the world export them.

    They have five decimals or more, are no larger than degrees, and move more slowly than any target whose motion can
    be distinguished from noise.

    Raises:
        ValueError: they are.
    """
    x, y = layout.columns["x"], layout.columns["y"]
    for recording in recordings:
        place = recording.position[np.isfinite(recording.position).all(1), :2]
        if len(place) < _MANY or layout.source.unit != 1 or (np.abs(place).max(0) > _LARGEST).any():
            return
        fine = np.abs(1e4 * place - np.rint(1e4 * place)).max(1) > _ROUNDED
        moved, steps = np.ptp(place, 0).max(), np.abs(np.diff(place, axis=0)).max(1)
        lies = np.abs(np.median(place, 0)).max() > _OFF_THE_ORIGIN and moved > _FAR * np.median(steps)
        if not (lies and fine.mean() > 0.5 and _AS_DEGREES[0] < speed_across(recording) < _AS_DEGREES[1]):
            return
    raise ValueError(
        f"expected metres in {x} and {y}, received what looks like degrees of longitude and latitude: say --lat {y} "
        f"--lon {x}; or --units m if they are metres"
    )


def check_unit(recordings: Sequence[Recording], layout: Layout) -> None:
    """Refuses x and y without a stated unit that, in metres, would move faster than all but rockets.

    Raises:
        ValueError: all do.
    """
    names = [layout.columns["x"], layout.columns["y"]]
    speeds = [speed_across(recording) for recording in recordings if len(recording.time) >= _MANY]
    if speeds and min(speeds) > _FASTEST_METRES and not any(unit_of(name, asked=True) for name in names):
        raise ValueError(
            f"expected metres in {' and '.join(names)}, received a speed of {min(speeds):,.0f} m/s: say their unit, "
            "such as --units mm, or --units m if they are metres"
        )


def _impossible(recording: Recording) -> str:
    """What is wrong with a recording; "" if nothing is."""
    time = recording.time
    if len(time) < _MANY:
        return ""
    if time[-1] - time[0] < _SHORTEST:
        return f"expected more than {_SHORTEST:g} s, received {len(time)} fixes within {time[-1] - time[0]:.3g} s"
    if (speed := _speed(recording)) > _FASTEST:
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


def _speed(recording: Recording) -> float:
    """The median between fixes, m/s."""
    legs = np.linalg.norm(np.diff(recording.position, axis=0), axis=1)
    return float(np.median(legs / np.diff(recording.time)))


def _guess(recording: Recording, layout: Layout) -> str:
    """What the times may be instead, and what to do."""
    if layout.source.id_options:
        return f"{_SEVERAL}: use {layout.source.id_options[0]}"
    column, form, speed = layout.clock.column, layout.clock.form, _speed(recording)
    now = per_second(form)
    if not now:  # text, whose unit nobody can mistake
        return f"if it is right, --time-format '{form}' takes it; or say the unit of positions (--units)"
    if form == "seconds" and (days := days_of(recording.time, column)):
        return f"column {column} looks like days of {days}: use --time-format {days}"
    likely = []
    for unit, other in PER_SECOND.items():
        seconds = (recording.time[-1] - recording.time[0]) * now / other
        if other != now and _USUAL[0] < speed * other / now < _USUAL[1] and seconds >= _SHORTEST:
            likely.append(unit)
    for unit in likely:
        if unit in SINCE_1970:
            return f"column {column} looks like {unit}: use --time-format {unit}, or name another column by --time"
    if likely:
        return f"column {column} may be in {' or '.join(likely)}: say by --time-format, or name another by --time"
    return f"column {column} may be no time: name another by --time, or its unit by --time-format"
