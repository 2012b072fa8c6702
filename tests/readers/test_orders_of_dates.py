"""Dates of two digits are read in the order by which they go on from row to row; where several do, they are refused."""

from __future__ import annotations

from datetime import datetime, timedelta

ROWS = 60
LATE = datetime(2021, 4, 9, 22)


def lines(form, step, start=LATE):
    """Rows of a track, an hour apart or so."""
    times = [f"{start + timedelta(hours=step * i):{form} %H:%M:%S}" for i in range(ROWS)]
    return ["time,x,y", *(f"{time},{i},{i % 7}" for i, time in enumerate(times))]
