"""Times as text."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

from torchfra.cleaning import Cleaned

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_FIRST_DATE = 315_532_800.0
"""Seconds at the beginning of 1980: what counts from less is no date."""


def dates(cleaned: Cleaned) -> list[str] | None:
    """UTC of each step in ISO 8601, to the millisecond; None where the times of the input are no dates."""
    times = cleaned.recording.time[0] + cleaned.time
    if times[0] < _FIRST_DATE:
        return None
    return [f"{_EPOCH + timedelta(milliseconds=round(1000 * t)):%Y-%m-%dT%H:%M:%S.%f}"[:-3] + "Z" for t in times]
