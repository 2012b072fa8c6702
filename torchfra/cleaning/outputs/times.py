"""Times as text."""

from __future__ import annotations

import numpy as np

from torchfra.cleaning import Cleaned
from torchfra.readers.clocks import YEAR_1980


def dates(cleaned: Cleaned) -> list[str] | None:
    """UTC of each step in ISO 8601, to the microsecond; None where the times of the input are no dates."""
    times = cleaned.recording.time[0] + cleaned.time
    if times[0] < YEAR_1980:  # it counts from another start
        return None
    micro = np.rint(1e6 * times).astype("datetime64[us]")
    rounded = (micro.astype(f"datetime64[{unit}]") for unit in ("s", "ms", "us"))
    whole = next(moments for moments in rounded if (moments == micro).all())
    return [f"{stamp}Z" for stamp in whole.astype(str).tolist()]
