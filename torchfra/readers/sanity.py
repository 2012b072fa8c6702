"""Refuses tracks that nothing can have moved along, and guesses what was meant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchfra.readers.layouts import Layout
from torchfra.readers.recording import Recording
from torchfra.readers.repairs import plural
from torchfra.readers.times import PER_SECOND

_MANY = 25
"""Fixes from which on a track is judged."""
_SHORTEST = 1.0
"""Seconds that so many fixes last."""
_FASTEST = 5000.0
"""Speed that half of the steps stay below, m/s."""
_USUAL = (0.05, 1000.0)
"""Speeds of what is tracked, m/s."""


def possible(recordings: Sequence[Recording], layout: Layout) -> list[Recording]:
    """The recordings that can be.  Those that cannot are left out and counted with the others.

    Raises:
        ValueError: none can be; with what the times may be instead.
    """
    wrong = {recording: said for recording in recordings if (said := _impossible(recording))}
    if not wrong:
        return list(recordings)
    if len(wrong) == sum(len(recording.time) >= _MANY for recording in recordings):
        recording, said = next(iter(wrong.items()))
        raise ValueError(f"{said} of {layout.source.word} {recording.name}; {_guess(recording, layout)}")
    good = [recording for recording in recordings if recording not in wrong]
    for recording in good:
        recording.repairs[f"{plural(layout.source.word)} of impossible speed dropped"] = len(wrong)
    return good


def _impossible(recording: Recording) -> str:
    """What is wrong with a recording; "" if nothing is."""
    time = recording.time
    if len(time) < _MANY:
        return ""
    if time[-1] - time[0] < _SHORTEST:
        return f"expected more than {_SHORTEST:g} s, received {len(time)} fixes within {time[-1] - time[0]:.3g} s"
    if (speed := _speed(recording)) > _FASTEST:
        return f"expected speeds below {_FASTEST / 1000:g} km/s, received {speed / 1000:.3g} km/s as the median"
    return ""


def _speed(recording: Recording) -> float:
    """The median between fixes, m/s."""
    legs = np.linalg.norm(np.diff(recording.position, axis=0), axis=1)
    return float(np.median(legs / np.diff(recording.time)))


def _guess(recording: Recording, layout: Layout) -> str:
    """What the times may be instead, and what to do."""
    column, form, speed = layout.clock.column, layout.clock.form, _speed(recording)
    per_second = PER_SECOND.get(form, 1e3 if form == "iso" else 1.0)
    for unit, other in PER_SECOND.items():
        seconds = (recording.time[-1] - recording.time[0]) * per_second / other
        likely = _USUAL[0] < speed * other / per_second < _USUAL[1] and seconds >= _SHORTEST
        if other != per_second and likely:
            return f"column {column} looks like {unit}: use --time-format {unit}, or name another column by --time"
    return f"column {column} may be no time: name another by --time, or its unit by --time-format"
