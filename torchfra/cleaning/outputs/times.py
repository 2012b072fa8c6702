"""Times as text."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

from torchfra.cleaning import Cleaned
from torchfra.readers.clocks import YEAR_1980

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def dates(cleaned: Cleaned) -> list[str] | None:
    """UTC of each step in ISO 8601, to the millisecond; None where the times of the input are no dates."""
    times = cleaned.recording.time[0] + cleaned.time
    if times[0] < YEAR_1980:  # it counts from another start
        return None
    return [f"{_EPOCH + timedelta(milliseconds=round(1000 * t)):%Y-%m-%dT%H:%M:%S.%f}"[:-3] + "Z" for t in times]
