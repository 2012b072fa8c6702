"""What the columns of a file of tracks hold."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.clocks import Clock, clock_of
from torchfra.readers.columns import Array, Head, Kind, grouped, number_or_nan, texts_of, values_of, word_of
from torchfra.readers.formats import Format, format_of
from torchfra.readers.hints import unclear
from torchfra.readers.names import (
    FLIGHT_LEVEL,
    LENGTHS,
    MARKS,
    METRES,
    OTHER_UNIT,
    TIMES,
    found,
    in_brackets,
    name_words,
    plain,
    unit,
)  # fmt: skip
from torchfra.readers.noises import noise_of
from torchfra.readers.options import AskError, ReadOptions, instead_of, listed
from torchfra.readers.recording import Source

_LIMITS = {"latitude": 90.0, "longitude": 180.0}
_BELOW = {"latitude": {"s", "south"}, "longitude": {"w", "west"}}
_ABOVE = {"latitude": {"n", "north"}, "longitude": {"e", "east"}}
"""Words for the sides of degrees below and above 0, which here have a sign."""
_BESIDE = {"lat", "latitude", "lon", "long", "longitude", "ns", "ew", "hemisphere", "indicator"}
"""Words of names of columns that may say on which side a fix is."""
SIDES = ("side", "other_side")
"""Columns that do."""
_SIDES = {"n": 0, "north": 0, "e": 0, "east": 0, "ne": 0, "s": 1, "south": 1, "se": 1, "w": 2, "west": 2, "nw": 2,
          "sw": 3}  # fmt: skip
"""What they hold: 1 for the south and 2 for the west, or both."""
_ZONES = {"zone", "zonenumber", "utmzone", "utmzonenumber"}
_ANGLES, _OF_AIRCRAFT = {"azimuth", "az"}, {"gs", "groundspeed", "verticalrate", "vertrate"}
"""Names beside which an elevation is an angle, and a track a direction."""
_OF_HEIGHTS = {"msl", "amsl", "asl", "agl", "hae", "mean", "above", "sea", "ground", "level", "ellipsoid", "wgs", "egm",
               "84", "96", "wgs84", "egm96", "gps", "gnss", "baro", "barometric", "pressure"}  # fmt: skip
"""Words in brackets behind heights that are no unit."""
_PRIVATE = ("call", "update", "valid", "zone", *SIDES, *MARKS)
"""What columns hold that ``Source.columns`` does not name."""
WORDS_OF_MARKS = {"true": 1.0, "false": 0.0, "1": 1.0, "0": 0.0, "t": 1.0, "f": 0.0, "yes": 1.0, "no": 0.0}
"""What marks say, in small letters."""
_WORDS_OF_FIXES = WORDS_OF_MARKS | dict.fromkeys(("none", "no fix", "no_fix", "nofix", "invalid"), 0.0)
_COUNTERS = {"id", "name", "uuid", "object", "objectid", "track", "trip", "tripid", "entityid"}
"""Names that may number the rows instead of the targets."""
_OFTEN, _JUMPS = 8, 4.0
"""Rows on average of a target among others, and how many times as long as their own ways those between them are."""
_OPTIONS = {"latitude": "lat", "longitude": "lon", "altitude": "alt"}
_ADVICE = (
    ": latitudes and longitudes may be swapped, or be degrees and minutes in one number (4730.5), parts of degrees "
    "(1e-7), or metres; the options lat and lon name columns of degrees, x and y of metres, and missing a number that "
    "stands for none"
)


@dataclass(frozen=True)
class Layout:
    """What is read of a file, and what it means."""

    wanted: dict[str, Kind | None]
    """The columns to read by their names, and the kind of their numbers; None for text."""
    columns: dict[str, str]
    """Names of columns by what they hold: those of ``Source.columns``, ``call``, ``update``, ``valid``,
    ``MARKS``."""
    noise: tuple[str, ...]
    """Columns of which ``per_axis`` makes standard deviations, one for all axes or one for each."""
    per_axis: Callable[[list[Array]], list[Array]]
    clock: Clock
    source: Source
    stated: ReadOptions
    """What the caller says."""
    unread: tuple[str, ...] = ()
    """Columns that are not read."""
    certain: bool = False
    """Whether the format or a name of a column says that latitudes are degrees."""

    @property
    def other_ids(self) -> tuple[dict[str, str] | str, ...]:
        """What to say where rows are of several targets: the option that parts them, and the columns that may."""
        unread = [name for name in self.unread if name]
        other = unread[0] if len(unread) == 1 else "ID"
        return {"id": f"{self.stated.id},{other}" if self.stated.id else other}, (
            f"; columns that are not read: {listed(unread)}"
        )

    @property
    def degrees(self) -> bool:
        """Whether positions are latitudes and longitudes."""
        return "latitude" in self.columns


def layout_of(head: Head, options: ReadOptions, name: str) -> Layout:
    """What the columns of a file hold: as the caller says, or the format of the table, or else by their names.

    Args:
        head: of its table.
        options: of the caller.
        name: of the file.

    Raises:
        ValueError: columns that are needed are missing, or the times are not understood.
    """
    asked = options.among(head.names)
    format = head.format or format_of(head.names)
    for one in (format, format_of(head.names)):
        if one is not None and one.refused and not asked.keys() & {"x", "latitude", "time"}:
            raise ValueError(f"{one.name}: {one.refused}")
    roles = {**(_of_format(format, head) if format else {}), **asked}
    columns = _places(head, roles)
    said = (*head.said, *([f"format: {format.name}"] if format else []))
    comma = options.decimal == "," or (options.decimal is None and head.commas and _has_commas(head, columns.values()))
    if comma:
        head, said = head._replace(cells=_with_points(head)), (*said, "decimal commas")
    rest = [one for one in head.names if one not in columns.values() or one in roles.get("time", ())]
    try:
        clock, unused = clock_of(head._replace(names=rest), options, roles, format)
    except LookupError:
        moments = [one for one in rest if isinstance(cells := head.cells(one), np.ndarray) and cells.dtype.kind == "M"]
        if len(moments) != 1:
            raise unclear(head, "a time", _stated(columns)) from None
        clock, unused = clock_of(head, options, {"time": (moments[0],)}, None)
    word = head.word or (format.word if format else "") or "target"
    columns |= _labels(head, roles, word)
    columns |= _grid(head, columns)
    length = _length(columns, options, format, head)
    if not options.time_format:
        _check_units(head, [clock.column], clock.form, "time_format", TIMES)
    noise = noise_of(head, roles, 1.0 if "latitude" in columns else length, word == "ship",
                     stated=options.sigma_column is not None, units=format.units if format else {})  # fmt: skip
    wanted: dict[str, Kind | None] = {clock.column: clock.kind}
    wanted |= {column: _kind(role, column, length, format, options) for role, column in columns.items()}
    wanted |= noise.columns
    if comma:
        wanted = {column: kind and replace(kind, decimal=",") for column, kind in wanted.items()}
    used = {*clock.columns, *columns.values(), *noise.columns, *roles.get("id", ())}
    ignored = [column for column in head.names if column and column not in used and column not in unused]
    if "id" not in columns and not noise.columns:  # an accuracy may be that of another source, as cells of phones
        _check_interleaved(head, columns, ignored)
    others = f"; not {listed(unused)} (option time takes another)" if unused else ""
    lines = (
        *said, f"time: {' and '.join(clock.columns)}, {clock.said}{others}", *_said(columns, length, options),
        *noise.said, *([f"ignored: {listed(ignored)}"] if ignored else []),
    )  # fmt: skip
    public = {role: column for role, column in columns.items() if role not in _PRIVATE}
    public |= dict(zip(("date", "time")[-len(clock.columns) :], clock.columns[-2:], strict=True))
    if noise.columns:
        public["sigma"] = next(iter(noise.columns))
    source = Source(name, public, length, word, lines, noise.argos)
    certain = head.degrees or bool(unit(columns.get("latitude", "")) or (format and format.says_degrees))
    unread = (*ignored, *unused)
    return Layout(wanted, columns, tuple(noise.columns), noise.per_axis, clock, source, options, unread, certain)


def _of_format(format: Format, head: Head) -> dict[str, tuple[str, ...]]:
    """The columns that a format says, of those that there are; of several the first that is not empty."""
    named = {plain(name): name for name in reversed(head.names)}

    def column(word: str) -> str:
        there = [named[one] for one in word.split("|") if one in named]
        return next((one for one in there if texts_of(head.cells(one))), *there[:1] or [""])

    every = {role: tuple(map(column, words.split())) for role, words in format.columns.items()}
    return {role: columns for role, columns in every.items() if all(columns)}


def _stated(columns: Mapping[str, str]) -> dict[str, str]:
    """Columns by the options that name them."""
    return {_OPTIONS.get(role, role): name for role, name in columns.items() if role not in ("altitude", "z")}


def _places(head: Head, roles: Mapping[str, tuple[str, ...]]) -> dict[str, str]:
    """Columns of the coordinates, of degrees where there are both of these.

    Raises:
        ValueError: there are none, or others are named as well, as ``pos_lat`` beside ``gps_lat``; or degrees have no
            sign.
    """
    axes = ("latitude", "longitude", "altitude", "x", "y", "z")
    best = {role: [*roles[role]] if role in roles else found(head.names, role) for role in axes}
    names = {*map(plain, head.names)}
    no_height = {"height"} if "width" in names else {"elevation", "elev"} if names & _ANGLES else set[str]()
    for role in ("altitude", "z"):
        best[role] = [one for one in best[role] if role in roles or plain(one) not in no_height]
    every = {role: columns[0] for role, columns in best.items() if columns}
    stated = [roles[role][0] for role in axes if roles.get(role)]
    if len({*stated}) < len(stated):
        raise ValueError(f"expected a column for each coordinate, received {listed(stated)}")
    degrees = {"latitude", "longitude"} <= every.keys() and "x" not in roles
    if not degrees and not {"x", "y"} <= every.keys():
        times = roles.get("time") or found(head.names, "time")[:1]
        lacking = "a position (x and y, or latitude and longitude)" if times else "a time and a position"
        known = {axis: name for axis, name in every.items() if axis not in ("altitude", "z")}
        raise unclear(head, lacking, _stated(known) | ({"time": ",".join(times)} if times else {}))
    columns = {role: every[role] for role in (axes[:3] if degrees else axes[3:]) if role in every}
    for role in axes[:2] if degrees else axes[3:5]:
        if degrees:
            _check_signs(head, role, columns)
        words = plain(columns[role]), len(name_words(columns[role]))
        alike = [one for one in best[role] if (plain(one), len(name_words(one))) == words]
        if len(alike) > 1:
            raise AskError(f"expected one column of {role}, received {listed(alike)}: say which, such as ",
                           _stated({axis: every[axis] for axis in (axes[:2] if degrees else axes[3:5])}))  # fmt: skip
    return columns


def _check_signs(head: Head, role: str, columns: Mapping[str, str]) -> None:
    """Refuses degrees whose name says that they have no sign, or whose minutes another column says."""
    column, names = columns[role], head.names
    values, whole = values_of(head.cells(column)), re.sub("(?:deg(?:ree)?s?|dd?)$", "", "".join(name_words(column)))
    words = {*name_words(column)}
    if words & _BELOW[role] and not words & _ABOVE[role] and not (len(values) and min(values) < 0):
        raise without_sign(column, "its name")
    for name in names:
        finer = re.fullmatch(f"{whole}(?:min(?:ute)?s?|m[mn]?|sec(?:ond)?s?|ss?)", "".join(name_words(name)))
        if finer and not (values % 1).any():
            raise ValueError(f"column {column}: expected degrees with their parts, received whole ones beside {name}: "
                             "write one column of degrees + minutes / 60")  # fmt: skip


def without_sign(column: str, says: str) -> ValueError:
    """The error for degrees south or west that have no sign."""
    return ValueError(f"column {column}: expected degrees that grow to the north and east, received others, as "
                      f"{says} says: write a sign in front of each")  # fmt: skip


def _grid(head: Head, columns: Mapping[str, str]) -> dict[str, str]:
    """Columns that say on which side of the equator and of Greenwich a fix is, or in which zone of a grid."""
    if plain(columns.get("x", "")) in ("east", "easting", "e") and "id" not in columns:
        return dict(zip(("zone",), (name for name in head.names if plain(name) in _ZONES), strict=False))
    places, sides, before = {columns[role]: role for role in _BELOW if role in columns}, list[str](), ""
    for name in head.names if places else ():
        letters, of = {cell.lower() for cell in texts_of(head.cells(name))}, places.get(before)
        near = {*name_words(name)} & _BESIDE or (of and letters <= _BELOW[of] | _ABOVE[of])
        if letters and letters <= _SIDES.keys() and near and name not in places:
            sides.append(name)
        before = name
    return dict(zip(SIDES, sides, strict=False))


def _labels(head: Head, roles: Mapping[str, tuple[str, ...]], word: str) -> dict[str, str]:
    """Columns that say which target a row is of, what else it is called, and what marks a new or a wrong position."""
    ids = (
        [" ".join(roles["id"])] if "id" in roles else [one for one in found(head.names, "id") if not _counts(one, head)]
    )
    if "id" not in roles and _OF_AIRCRAFT & {*map(plain, head.names)}:
        ids = [one for one in ids if plain(one) != "track"]
    calls = [one for one in found(head.names, "call") if (plain(one) == "callsign") == (word == "aircraft")]
    calls = calls if word in ("aircraft", "ship") else []
    if not ids and len({*texts_of(head.cells(calls[0]))} if calls else ()) > 1:
        ids = calls[:1]
    likely = {"id": ids[:1], "call": [one for one in calls if one not in ids[:1]][:1]}
    likely |= {role: found(head.names, role)[:1] for role in (MARKS if word == "animal" else ())}
    likely["valid"] = [one for one in found(head.names, "valid")
                       if any(_WORDS_OF_FIXES.get(word, word) for word in map(word_of, head.cells(one)))]  # fmt: skip
    likely |= {role: list(roles[role]) for role in ("update",) if role in roles}
    return {role: columns[0] for role, columns in likely.items() if columns}


def _counts(name: str, head: Head) -> bool:
    """Whether a column numbers the rows instead of naming targets."""
    cells = texts_of(cell for cell in head.cells(name) if not isinstance(cell, list | dict | bool))
    return plain(name) in _COUNTERS and len({*cells}) == len(cells) > 2


def _check_interleaved(head: Head, columns: Mapping[str, str], others: Iterable[str]) -> None:
    """Refuses rows that jump to and fro, and do not among those with the same word in another column."""
    places = [columns[role] for role in ("latitude", "longitude", "x", "y") if role in columns]
    place = np.array([[number_or_nan(cell) for cell in head.cells(name)] for name in places]).T
    known = np.flatnonzero(np.isfinite(place).all(1))

    def ways(rows: NDArray[np.intp]) -> Array:
        return np.asarray(np.linalg.norm(np.diff(place[rows], axis=0), axis=1))

    parting = list[str]()
    for name in others if len(known) > 1 else ():
        cells = head.cells(name)
        parts = grouped([str(cells[i]) for i in known])
        if 1 < len(parts) < len(known) / _OFTEN:
            inside = np.concatenate([ways(known[rows]) for rows in parts.values()])
            parting += [name] * bool(_JUMPS * np.median(inside) < np.median(ways(known)))
    if parting:
        asks = [part for name in parting for part in (" or ", {"id": name})][1:]
        raise AskError(f"rows jump to and fro, and do not where {' or '.join(parting)} stays the same, as of several "
                       "targets: say ", *asks, ", or leave such columns out of the file")  # fmt: skip


def _length(columns: Mapping[str, str], options: ReadOptions, format: Format | None, head: Head) -> float:
    """Metres in the unit of x, y and z, or of altitudes.

    Raises:
        ValueError: it is not known, columns have several, or grow downwards.
    """
    lengths = [columns[role] for role in ("altitude", "x", "y", "z") if role in columns]
    for column in [columns[role] for role in ("latitude", "longitude") if role in columns] + lengths:
        word, bracketed = unit(column), in_brackets(column)
        flat = column not in (columns.get("altitude"), columns.get("z"))
        if OTHER_UNIT.fullmatch(word) and not (options.units and "x" in columns):
            if word == "nm":
                raise AskError(
                    f"column {column}: nm are nautical miles or nanometres: say ", {"units": "nmi"}, ", or another"
                )
            advice = (", or ", *instead_of(word)) if "x" in columns else ()
            raise AskError(f"column {column}: expected metres or degrees, received {word}: convert them", *advice)
        other = "" if word in LENGTHS or options.units or column not in lengths else word or bracketed
        if (flat and other) or not {*name_words(other)} <= _OF_HEIGHTS:
            degrees = ("degrees are named by ", {"lat": "LAT", "lon": "LON"}, ", ") if flat else ()
            raise AskError(f"column {column}: expected lengths, received {other}: ", *degrees, "a unit by ",
                           {"units": "m"}, ", say")  # fmt: skip
    if down := [column for column in lengths if {"down", "depth"} & {*name_words(column)} or plain(column) == "posd"]:
        raise ValueError(f"column {down[0]}: expected heights, which grow upwards: name a column of its negative")
    stated = format.units if format else {}
    units = {column: LENGTHS.get(unit(column), "") or stated.get(plain(column), "") for column in lengths}
    if options.units:
        return METRES[options.units]
    if len({*filter(None, units.values())}) > 1:
        raise ValueError(f"expected one unit of lengths, received {listed(units)}: convert one, or leave it out")
    one = next(filter(None, units.values()), "m")
    _check_units(head, lengths, one, "units", LENGTHS)
    return FLIGHT_LEVEL if one == "FL" else METRES[one]


def _check_units(head: Head, columns: Iterable[str], read: str, option: str, words: Mapping[str, str]) -> None:
    """Refuses units in a column of their own that are others than those in which columns are read."""
    bare = [plain(column).removesuffix("value") for column in columns]
    for name in head.names if bare else ():
        of_all = plain(name) in ("unit", "units") and option == "units"
        if of_all or any(re.fullmatch(f"{one}units?|units?{one}", "".join(name_words(name))) for one in bare):
            for cell in texts_of(head.cells(name)):
                if option == "units" and OTHER_UNIT.fullmatch(cell):
                    raise AskError(f"expected {read}, received {cell} in the column {name}: ", *instead_of(cell))
                if words.get(cell.lower(), read if of_all else "") != read:
                    raise AskError(f"expected {read}, received {cell} in the column {name}: say ",
                                   {option: words.get(cell.lower(), read)})  # fmt: skip


def _kind(role: str, column: str, length: float, format: Format | None, options: ReadOptions) -> Kind | None:
    """What the numbers of a column are; None for text."""
    if role in ("id", "call", "zone"):
        return None
    if role in SIDES:
        return Kind("N, S, E or W", words=tuple(_SIDES.items()))
    if role in ("valid", *MARKS):
        words = _WORDS_OF_FIXES if role == "valid" else WORDS_OF_MARKS
        return Kind("true or false", words=tuple(words.items()), others=role == "valid")
    absent = tuple(value for name, value in (format.missing if format else {}).items() if name == plain(column))
    absent += options.absent
    if role not in _LIMITS:
        return Kind(unit=1.0 if role == "update" else length, absent=absent)
    degrees = format.degrees[role == "longitude"] if format else 1.0
    if unit(column) in ("semicircles", "e7"):
        degrees = 180 / 2**31 if unit(column) == "semicircles" else 1e-7
    limit = _LIMITS[role] / abs(degrees) * (1 + 1e-9)
    parts = f"{abs(degrees):.3g} degrees, at most {limit:g} of them"
    said = f"degrees within +-{_LIMITS[role]:g}" if degrees == 1 else parts
    whole = (0.0, 2 * _LIMITS["longitude"]) if abs(degrees) < 1e-6 else (math.inf, math.inf)  # of degrees, not parts
    return Kind(said, limit=limit, unit=degrees, between=whole, absent=absent, advice=_ADVICE)


def _has_commas(head: Head, columns: Iterable[str]) -> bool:
    """Whether a coordinate or a time is written as 1,5."""
    cells = [str(cell) for name in (*columns, *found(head.names, "time")) for cell in head.cells(name)]
    parted = re.compile(r"[+-]?[0-9]*,[0-9]*(?:[eE][+-]?[0-9]+)?")
    return any(parted.fullmatch(cell.strip()) for cell in cells)


def _with_points(head: Head) -> Callable[[str], list[Any]]:
    return lambda name: [cell.replace(",", ".") if isinstance(cell, str) else cell for cell in head.cells(name)]


def _said(columns: Mapping[str, str], length: float, options: ReadOptions) -> list[str]:
    """Lines on positions and targets."""
    places = [columns[role] for role in ("latitude", "longitude", "x", "y", "z") if role in columns]
    words = {FLIGHT_LEVEL: "flight levels (hundreds of feet)", 1.0: "metres", METRES["ft"]: "feet"}
    said = words.get(length) or next(one for one, metres in METRES.items() if metres == length)
    others = "" if options.units or any(unit(place) for place in places) else "; option units takes others"
    lines = [f"position: {', '.join(places)}" + ("" if "latitude" in columns else f", in {said}{others}")]
    if "altitude" in columns:
        lines.append(
            f"altitude: {columns['altitude']}, in {said}{'' if options.units else '; option units takes others'}"
        )
    marks = [columns[role] for role in MARKS if role in columns]
    lines += [f"marks of outliers: {listed(marks)}"] if marks else []
    lines += [f"marks of valid fixes: {columns['valid']}"] if "valid" in columns else []
    return lines + ([f"targets: {columns['id']}"] if "id" in columns else [])
