"""Times as text."""

from __future__ import annotations

import numpy as np

from torchfra.cleaning import Cleaned
from torchfra.readers.clocks import YEAR_1980


def dates(cleaned: Cleaned) -> list[str] | None:
    """UTC of each step in ISO 8601, to the millisecond; None where the times of the input are no dates."""
    times = cleaned.recording.time[0] + cleaned.time
    if times[0] < YEAR_1980:  # it counts from another start
        return None
    return [f"{stamp}Z" for stamp in np.rint(1000 * times).astype("datetime64[ms]").astype(str).tolist()]
