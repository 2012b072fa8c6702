"""Summaries of cleaned tracks, in numbers and in sentences."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchfra.cleaning import Cleaned, Found
from torchfra.cleaning.cleaned import FLAGS
from torchfra.cleaning.kinds import UNKNOWN
from torchfra.cleaning.outputs.course import course
from torchfra.cleaning.segments import spans
from torchfra.tables import duration, in_words, metres, plural, printable, text_table

_OF_EACH = ("Sigma of the height",)
"""Beginnings of notes that every target has."""
LONGEST_NAME = 100
"""Characters of a target's name in a line."""
_NOUNS = {"climbing": "climb", "descending": "descent", "speeding up": "acceleration", "slowing down": "deceleration"}
"""Nouns for counts of manoeuvres."""


def summary(cleaned: Cleaned) -> dict[str, Any]:
    """Counts, distances in m and the settings of a track."""
    measured, rejected = cleaned.row >= 0, cleaned.flag == "outlier"
    residual, found, name = cleaned.residual, cleaned.found, cleaned.recording.name
    counts = {flag or "usual": int((cleaned.flag[measured] == flag).sum()) for flag in FLAGS}
    of = course(cleaned)
    return {
        "name": name,
        "fixes": int(measured.sum()),
        "steps": len(cleaned.time),
        "seconds": float(cleaned.time[-1]),
        "flags": counts,
        "median_correction": _quantile(residual[measured & ~rejected], 0.5),
        "largest_correction": _quantile(residual[measured & ~rejected]),
        "largest_rejected": _quantile(residual[rejected]),
        "median_std": _quantile(np.sqrt((of.along**2 + of.across**2) / 2)[measured], 0.5),
        "failed": bool(cleaned.failed.any()),
        "repairs": cleaned.recording.repairs,
        "filter": found.filter, "smooth": found.smooth, "bank": found.bank, "sigma": found.sigma,
        "stated": found.stated, "stated_sigma": _stated(cleaned), "q": found.q, "nis": found.nis,
        "sigma_unsure": found.sigma_unsure,
        "estimated": sorted(found.estimated),
        "notes": list(found.notes),
        "segments": [segment._asdict() for segment in cleaned.segments],
    }  # fmt: skip


def sentences(cleaned: Cleaned) -> list[str]:
    """The summary of a track in sentences of a line each: how good it is, and what decides whether to trust it."""
    of = summary(cleaned)
    said = [headline(of), noise(of)]
    if math.isfinite(of["median_std"]):
        median, most = metres(of["median_correction"]), metres(of["largest_correction"])
        moved = f"; fixes moved {median}, at most {most}" if math.isfinite(of["median_correction"]) else ""
        said.append(f"Path good to {metres(of['median_std'])} per axis ({LASTING}){moved}")
    if cleaned.segments:
        said.append(manoeuvres(cleaned))
    said += [note for note in of["notes"] if note.startswith(TRUST)]
    if of["sigma_unsure"]:
        said.append(of["sigma_unsure"])
    if _is_unlikely(of):
        said.append(UNLIKELY)
    elif 10 * of["flags"]["outlier"] >= of["fixes"]:
        said.append(MANY)
    if of["repairs"]:
        said.append(f"Repaired: {in_words(of['repairs'])}")
    return said


def headline(of: Mapping[str, Any]) -> str:
    """The first sentence on a track, from its ``summary``: its fixes, and what was rejected."""
    rejected, unclear = of["flags"]["outlier"], of["flags"]["unclear"]
    text = f"{printable(of['name'], LONGEST_NAME)}: {of['fixes']:,} fixes in {duration(of['seconds'])}"
    text += f", {rejected:,} rejected"
    if rejected:
        text += f" (up to {metres(of['largest_rejected'])} off)"
    if unclear:
        text += f", {unclear:,} unclear"
    return text + ("; FAILED: NaN or infinity" if of["failed"] else "")


def noise(of: Mapping[str, Any]) -> str:
    """What fixes are off by, from a ``summary``: as found, as given, and as the file states."""
    size = metres(of["sigma"] * of["stated_sigma"] if of["stated"] else of["sigma"])
    if of["stated"] and of["sigma"] == 1:
        return f"Noise of a fix: {size} per axis, as the file states"
    stated = f"; the file states {metres(of['stated_sigma'])}" if of["stated"] else ""
    if "sigma" not in of["estimated"]:
        return f"Noise of a fix: {size} per axis, as given{stated}"
    return f"Noise found: {size} per axis{', unsure' if of['sigma_unsure'] else ''}{stated}"


def _stated(cleaned: Cleaned) -> float:
    """The median standard deviation across the ground that the file states, m; NaN if it states none."""
    sigma = cleaned.recording.sigma
    return math.nan if sigma is None else float(np.median(sigma.reshape(len(sigma), -1)[:, :2]))


LASTING = "slowly varying errors aside"
"""What standard deviations do not contain: a track alone does not tell such errors, as of satellites, from motion."""
TRUST = ("Time stamps were off", "Standard deviations are as stated", "Sigma varies", "not smoothed", "Faster than")
"""Beginnings of notes that decide whether to trust a result."""


UNLIKELY = (
    "A third of the fixes or more were rejected: do not trust the path. Columns, units or times may be other than "
    "taken, there may be several targets in one (--id), or it may move as none of its kind does (--bank, --sigma)"
)
"""The warning for a track that its fixes contradict."""


MANY = (
    "A tenth of the fixes or more were rejected. There may be several targets in one (--id); if noise varies along the "
    "track, as with the range of a radar, give each fix its standard deviation in a column sigma"
)
"""What is said of a track of which many, but not most, fixes were rejected."""


def _is_unlikely(of: Mapping[str, Any]) -> bool:
    """Whether so many fixes were rejected that it is rather the path that is wrong."""
    return bool(3 * of["flags"]["outlier"] >= of["fixes"] > 0)


COLUMNS = ("fixes", "lasting", "rejected", "farthest", "unclear", "manoeuvres", "moved", "std", "sigma")
"""Columns of a table of several targets."""
LEGEND = (
    "farthest: of the rejected fixes; moved: the others, in the median",
    f"std: of the cleaned path per axis at fixes, in the median, {LASTING}",
    "sigma: of a fix per axis, or a factor on what the file states",
)
"""What some of these columns hold."""


def cells(of: Mapping[str, Any]) -> list[str]:
    """What is written of a ``summary`` for each of ``COLUMNS``; "" for what is not known."""
    counts = of["fixes"], of["flags"]["outlier"], of["flags"]["unclear"], len(of["segments"])
    fixes, rejected, unclear, manoeuvres = (f"{n:,}" for n in counts)
    sizes = of["largest_rejected"], of["median_correction"], of["median_std"]
    farthest, moved, std = (metres(x) if math.isfinite(x) else "" for x in sizes)
    sigma = sigma_in_words(of["sigma"], of["stated"]) if math.isfinite(of["sigma"]) else ""
    return [fixes, duration(of["seconds"]), rejected, farthest, unclear, manoeuvres, moved, std, sigma]


def overview(results: Sequence[Cleaned]) -> list[str]:
    """The summary of several tracks: a table with a row for each, and sentences on all."""
    rows = [[printable(of["name"], 24), *cells(of)] for of in map(summary, results)]
    table = text_table([results[0].recording.source.word, *COLUMNS], rows)
    return [table, *LEGEND, *sentences_on_all(results)]


def sentences_on_all(results: Sequence[Cleaned]) -> list[str]:
    """What is said of several tracks together, and which of them are not to be trusted."""
    every, word = [summary(cleaned) for cleaned in results], results[0].recording.source.word
    fixes, rejected = sum(of["fixes"] for of in every), sum(of["flags"]["outlier"] for of in every)
    said = [f"{len(every):,} {plural(word)}: {fixes:,} fixes, {rejected:,} rejected"]
    said += [note for note in notes(results) if note.startswith(TRUST)]
    if unsure := [of["name"] for of in every if of["sigma_unsure"]]:
        said.append(f"Sigma is unsure of {listed(unsure)}: --sigma gives it if it is known")
    if unlikely := [of["name"] for of in every if _is_unlikely(of)]:
        said.append(f"Not to be trusted (a third of their fixes rejected): {listed(unlikely)}")
    if failed := [of["name"] for of in every if of["failed"]]:
        said.append(f"FAILED: NaN or infinity in {listed(failed)}")
    if repairs := sum((Counter(of["repairs"]) for of in every), Counter[str]()):
        said.append(f"Repaired: {in_words(repairs)}")
    return said


def report(results: Sequence[Cleaned], *, verbose: bool = False) -> list[str]:
    """The summary of one track or of several; with ``verbose``, also their settings, NIS and all notes."""
    said = sentences(results[0]) if len(results) == 1 else overview(results)
    if not verbose:
        return said
    of = summary(results[0])
    fit = f"Normalised innovation squared per axis (NIS): {of['nis']:.2f}; it is 1 if sigma and q are right"
    more = [fit] if len(results) == 1 and math.isfinite(of["nis"]) else []
    return [*said, *settings_lines(results), *(note for note in notes(results) if note not in said), *more]


def listed(names: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    more = f" and {len(names) - 3:,} more" if len(names) > 3 else ""
    return ", ".join(printable(name, 24) for name in names[:3]) + more


def notes(results: Sequence[Cleaned]) -> list[str]:
    """The notes that all tracks have; and for those that some have, the number of these."""
    said = Counter(text for cleaned in results for text in cleaned.found.notes)
    some = Counter(text.partition(":")[0] for text, count in said.items() for _ in range(count) if count < len(results))
    lines = [text for text, count in said.items() if count == len(results)]
    return lines + [f"{what}: {count:,} of {len(results):,}" for what, count in some.items() if what not in _OF_EACH]


def settings_lines(results: Sequence[Cleaned]) -> list[str]:
    """The settings of tracks, and which of them were estimated; of several tracks only what they have in common."""
    lines = Counter(
        f"{_method(of.found)}; sigma {sigma_in_words(of.found.sigma, of.found.stated)} ({_how(of.found, 'sigma')}), "
        f"q {of.found.q:.3g} m^2/s^3 ({_how(of.found, 'q')})"
        for of in results
    )
    if len(lines) > 1:
        lines = Counter(_method(of.found) for of in results)
    word = plural(results[0].recording.source.word)
    return [line if len(lines) == 1 else f"{line}: {count:,} {word}" for line, count in lines.items()]


def _method(found: Found) -> str:
    kind = "" if found.bank == UNKNOWN else f", for {found.bank}"
    return f"{found.filter}, {'smoothed' if found.smooth else 'on line'}{kind}"


def sigma_in_words(sigma: float, stated: bool) -> str:
    """The standard deviation of a fix, or the factor on what the file states of each."""
    if not stated:
        return metres(sigma)
    return "as stated" if sigma == 1 else f"{sigma:.2g} times as stated"


def _how(found: Found, name: str) -> str:
    unsure = ", unsure" if name == "sigma" and found.sigma_unsure else ""
    return f"found{unsure}" if name in found.estimated else "given"


def manoeuvres(cleaned: Cleaned) -> str:
    """The number of manoeuvres of each kind, and their total duration."""
    kinds = Counter(_NOUNS.get(segment.kind, segment.kind) for segment in cleaned.segments)
    counts = ", ".join(f"{count} {kind}{'s' * (count > 1)}" for kind, count in kinds.most_common())
    return f"Manoeuvres: {counts}; {duration(sum(end - begin for begin, end in spans(cleaned.segments)))} in all"


def _quantile(values: Any, share: float = 1.0) -> float:
    """A quantile of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if len(known) else np.nan
