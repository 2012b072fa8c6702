"""What became of a track, in numbers and in a line for people."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from torchfra.cleaning import Cleaned, Found
from torchfra.cleaning.cleaned import FLAGS
from torchfra.cleaning.outputs.course import course
from torchfra.tables import printable

LONGEST_NAME = 100
"""Characters of a target's name in a line."""
_NOUNS = {"climbing": "climb", "descending": "descent", "speeding up": "acceleration", "slowing down": "deceleration"}
"""What a manoeuvre is called that is counted."""


def summary(cleaned: Cleaned) -> dict[str, Any]:
    """Counts, distances in m and what was found of a track."""
    measured, rejected = cleaned.row >= 0, cleaned.flag == "outlier"
    off, found, name = np.linalg.norm(cleaned.raw - cleaned.position, axis=1), cleaned.found, cleaned.recording.name
    counts = {flag or "usual": int((cleaned.flag[measured] == flag).sum()) for flag in FLAGS}
    of = course(cleaned)
    return {
        "name": name,
        "fixes": int(measured.sum()),
        "steps": len(cleaned.time),
        "seconds": float(cleaned.time[-1]),
        "flags": counts,
        "median_correction": _quantile(off[measured & ~rejected], 0.5),
        "largest_correction": _quantile(off[measured & ~rejected]),
        "largest_rejected": _quantile(off[rejected]),
        "median_std": _quantile(np.sqrt((of.along**2 + of.across**2) / 2), 0.5),
        "failed": bool(cleaned.failed.any()),
        "repairs": cleaned.recording.repairs,
        "filter": found.filter, "smooth": found.smooth, "bank": found.bank, "sigma": found.sigma, "q": found.q,
        "nis": found.nis, "doubt": found.doubt, "found": sorted(found.found), "said": list(found.said),
        "segments": [segment._asdict() for segment in cleaned.segments],
        "regimes": list(cleaned.regimes),
    }  # fmt: skip


def line(cleaned: Cleaned) -> str:
    """One line for a person: how many fixes, what was rejected, how far they were moved, how sure the track is."""
    of = summary(cleaned)
    rejected, unclear = of["flags"]["outlier"], of["flags"]["unclear"]
    parts = [f"{of['fixes']:,} fixes in {duration(of['seconds'])}, {rejected:,} rejected"]
    if rejected:
        parts[0] += f" (up to {metres(of['largest_rejected'])} off)"
    if unclear:
        parts.append(f"{unclear:,} unclear")
    if cleaned.segments:
        parts.append(manoeuvres(cleaned))
    parts.append(f"moved by {metres(of['median_correction'])} (median) to {metres(of['largest_correction'])}")
    parts.append(f"sure to {metres(of['median_std'])} per axis")
    if np.isfinite(of["nis"]):
        parts.append(f"NIS {of['nis']:.2f} of 1")
    if of["doubt"]:
        parts.append(of["doubt"])
    if of["repairs"]:
        parts.append("repaired: " + ", ".join(f"{count} {what}" for what, count in of["repairs"].items()))
    if of["failed"]:
        parts.append("FAILED: NaN or infinity")
    return f"{printable(of['name'], LONGEST_NAME)}: {'; '.join(parts)}"


def settings_line(found: Found) -> str:
    """With what a track was cleaned, and which of it was found."""

    def how(name: str) -> str:
        return "told" if name not in found.found else "found, unsure" if name == "sigma" and found.doubt else "found"

    sigma = f"{found.sigma:.2g} times as stated" if found.stated else metres(found.sigma)
    return (
        f"{found.filter}, {'smoothed' if found.smooth else 'on line'}, for {found.bank} ({how('bank')}); "
        f"sigma {sigma} ({how('sigma')}), q {found.q:.3g} m^2/s^3 ({how('q')})"
    )


def manoeuvres(cleaned: Cleaned) -> str:
    """How many there are of which kind, and how long they take together."""
    kinds = Counter(_NOUNS.get(segment.kind, segment.kind) for segment in cleaned.segments)
    listed = ", ".join(f"{count} {kind}{'s' * (count > 1)}" for kind, count in kinds.items())
    return f"{listed} in {duration(sum(segment.end - segment.begin for segment in cleaned.segments))}"


def metres(value: float) -> str:
    """A length as one says it."""
    if not np.isfinite(value):
        return "an unknown length"
    if abs(value) >= 10_000:
        return f"{value / 1000:,.0f} km"
    return f"{value:,.0f} m" if abs(value) >= 20 else f"{value:.2g} m" if abs(value) < 1 else f"{value:.1f} m"


def duration(seconds: float) -> str:
    """A time as one says it."""
    if seconds >= 2 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 120 else f"{seconds:.0f} s"


def _quantile(values: Any, share: float = 1.0) -> float:
    """A quantile of what is finite; NaN of nothing."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if len(known) else np.nan
