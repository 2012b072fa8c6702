"""What the columns of a file of tracks hold."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.clocks import Clock, clock_of
from torchfra.readers.columns import BEHIND, Array, Head, Kind, is_missing, joined, number, numbers, word_of
from torchfra.readers.degrees import advice
from torchfra.readers.guesses import cartesian, looks_like, polar
from torchfra.readers.identities import counts_rows, likely_ids, option
from torchfra.readers.noises import noise_of
from torchfra.readers.options import METRES, ReadOptions
from torchfra.readers.placeholders import PLACEHOLDERS
from torchfra.readers.recording import Source
from torchfra.readers.sheets import listed
from torchfra.readers.species import COLUMNS as OF_SPECIES
from torchfra.readers.species import kind_of
from torchfra.readers.spelling import (
    ANGLE,
    ANIMALS,
    DEPTHS,
    FLIGHT_LEVELS,
    MARKS,
    NAMES,
    OTHER_UNIT,
    TARGETS,
    UNITS_BESIDE,
    WORDS_OF_MARKS,
    ZONES,
    found,
    instead_of,
    name_words,
    plain,
    unit,
)  # fmt: skip
from torchfra.readers.tables import HEADERS, Wanted
from torchfra.suggestions import meant

_LIMITS = {"latitude": 90.0, "longitude": 180.0}
_SIDES = {"latitude": "NS", "longitude": "EW"}
_ABSENT = {"latitude": 91.0, "longitude": 181.0}
"""What receivers of ships say where they have no position."""
_EASTINGS = {"east", "easting", "e", "rechtswert", "ostwert", "ost", "este"}
"""Names of x in a grid, which has zones."""
_SIDE = re.compile(
    "(?P<latitude>(?:ns|northsouth)(?:ind|indicator|hemisphere)?|lat(?:itude)?(?:ns|dir|direction|hem|hemi|hemisphere|ref))"
    "|(?P<longitude>(?:ew|eastwest)(?:ind|indicator|hemisphere)?|lon(?:g|gitude)?(?:ew|dir|direction|hem|hemi|hemisphere|ref))"
)
"""Names of columns that say on which side of the equator or of Greenwich a fix is."""
_ALTITUDES_IN_FEET = {"altitude", "alt", "altbaro", "altgeom"}
"""Columns that hold feet, as aircraft send them; baroaltitude and geoaltitude of OpenSky hold metres."""

_PRIVATE = ("call", "update", "zone", "valid", *MARKS)
"""What columns hold that ``Source.columns`` does not name."""
_MARK = Kind("true or false", words=tuple(WORDS_OF_MARKS.items()))
_PLAIN = (str, int, float, np.generic)
"""What cells are that are neither missing nor nested."""
_FLIGHT_LEVEL = 100 * METRES["ft"]
_LENGTHS = {
    1.0: "metres", METRES["ft"]: "feet", 1e-3: "millimetres", _FLIGHT_LEVEL: "flight levels (hundreds of feet)",
    1e3: "km", 0.1: "dm", 1e-2: "cm", METRES["mi"]: "miles", METRES["nmi"]: "nautical miles", METRES["yd"]: "yards",
}  # fmt: skip
_GROWING = "sigma: none; noise that grows with range needs a column of it (--sigma-column)"
"""What is said of positions beside the ranges and bearings that they were made of."""
_WHOLE = re.compile(r"[+-]?([0-9]+)(?:\.0*)?")
"""A whole number; tables write it with decimals, all 0, where the column has gaps."""
_AUTOPILOT = 1e-7
"""Degrees in the numbers of autopilots, whose altitudes are in millimetres."""
_HIGH, _LEVEL = 10_000.0, 5.0
"""Whole altitudes below the first that change by no more than the second from row to row are metres."""
_SEMICIRCLE = 180 / 2**31
"""Degrees in the numbers of FIT files, of watches and bicycle computers."""
_SEMICIRCLES = ("position_lat", "position_long")
"""How names of coordinates end in FIT files."""
_OF_A_PHONE = "latitudee7"
"""Plain name of whole numbers for latitudes beside which altitudes are metres; an autopilot's are mm."""


@dataclass(frozen=True)
class Layout:
    """What is read of a file, and what it means."""

    wanted: Wanted
    columns: dict[str, str]
    """Names of columns by what they hold: those of ``Source.columns``, ``call``, ``update``, ``second``, ``valid``,
    ``MARKS``."""
    noise: tuple[str, ...]
    """Columns of which ``per_axis`` makes standard deviations, one for all axes or one for each."""
    per_axis: Callable[[list[Array]], list[Array]]
    clock: Clock
    source: Source
    other_times: tuple[str, ...] = ()
    """Columns of times that are not taken."""
    time_stated: bool = False
    """Whether the caller names the column of times."""

    @property
    def degrees(self) -> bool:
        """Whether positions are latitudes and longitudes."""
        return "latitude" in self.columns


def layout_of(head: Head, options: ReadOptions, name: str) -> Layout:
    """What the columns of a file hold.

    Args:
        head: of its table.
        options: of the caller.
        name: of the file.

    Raises:
        ValueError: columns that are needed are missing, or the times are not understood.
    """
    options = options.among(head.names)
    asked = options.columns()
    if absent := [column for column in asked.values() if column not in head.names]:
        close = meant(absent[0], head.names)
        raise ValueError(f"expected a column {listed(absent)}, received {listed(head.names)}{close}")
    columns = _places(head, asked)
    comma = options.decimal == "," or (options.decimal is None and head.commas and _has_commas(head, columns))
    if comma:
        head = head._replace(cells=_with_points(head), said=(*head.said, "decimal commas"))
    clock, unused = _clock(head, options, columns)
    word = _word(head)
    columns |= _labels(head, asked, word)
    zones = [name for name in head.names if plain(name) in ZONES | {"utm"} and plain(columns.get("x", "")) in _EASTINGS]
    columns |= dict(zip(("zone",), zones, strict=False))
    length = _length(columns, options, word, head)
    noise = noise_of(head, asked, 1.0 if "latitude" in columns else length, word == "ship")
    wanted: Wanted = {clock.column: clock.kind}
    wanted |= {column: _kind(role, columns, head, length, word) for role, column in columns.items()}
    wanted |= noise.columns
    sides = _sides(head, columns)
    wanted |= {column: replace(kind, joined=(column, sides[column])) for column, kind in wanted.items()
               if kind is not None and column in sides}  # fmt: skip
    if comma:
        wanted = {column: kind and replace(kind, decimal=",") for column, kind in wanted.items()}
    used = {*clock.columns, *columns.values(), *noise.columns, *sides.values(), *options.named(())}
    ignored = [column for column in head.names if column and column not in used and column not in unused]
    others = f"; not {listed(unused)} (--time takes another)" if unused else ""
    lines = (
        *head.said, f"time: {' and '.join(clock.columns)}, {clock.said}{others}",
        *_said(columns, length, options, wanted),
        *([_GROWING] if polar(head.names) and not noise.columns and "x" in columns else []),
        *([f"sides of {' and '.join(sides)}: {' and '.join(sides.values())}"] if sides else []), *noise.said,
        *([f"ignored: {listed(ignored)}"] if ignored else []),
    )  # fmt: skip
    public = {role: column for role, column in columns.items() if role in NAMES and role not in _PRIVATE}
    public |= clock.roles
    if noise.columns:
        public["sigma"] = next(iter(noise.columns))
    ids = _parting(head, clock, columns, wanted, [*ignored, *unused])
    source = Source(name, public, clock.form, length, word, lines, ids)
    return Layout(
        wanted, columns, tuple(noise.columns), noise.per_axis, clock, source, tuple(unused), options.time is not None
    )


def _places(head: Head, asked: Mapping[str, str]) -> dict[str, str]:
    """Columns of the coordinates, of degrees where there are both of these."""
    names = head.names

    def chosen(*roles: str) -> dict[str, str]:
        best = {role: [asked[role]] if role in asked else found(names, role) for role in roles}
        lengths = [role for role in roles if role in ("altitude", "z") and role not in asked]
        best |= {role: [name for name in best[role] if not ANGLE.fullmatch(name_words(name)[-1])] for role in lengths}
        return {role: columns[0] for role, columns in best.items() if columns}

    degrees, metres = chosen("latitude", "longitude", "altitude"), chosen("x", "y", "z")
    places = [asked[role] for role in ("latitude", "longitude", "altitude", "x", "y", "z") if role in asked]
    if len({*places}) < len(places):
        raise ValueError(f"expected a column for each coordinate, received {listed(places)}")
    if "x" in asked or not {"latitude", "longitude"} <= degrees.keys():
        if {"x", "y"} <= metres.keys():
            return metres
        some, pairs = {*degrees, *metres}, (("latitude", "longitude"), ("x", "y"))
        missing = [role for pair in pairs if some & {*pair} for role in pair if role not in some]
        lacking = f"missing {listed(missing)}, " if missing else ""
        if not missing and {"altitude", "z"} & some:
            lacking = "missing x, y (of what only goes up and down: columns x and y of 0), "
        raise ValueError(f"{HEADERS}; {lacking}received {listed(names)}{looks_like(head)}")
    return degrees


def _clock(head: Head, options: ReadOptions, columns: Mapping[str, str]) -> tuple[Clock, list[str]]:
    """``clock_of`` the columns that are no coordinates, whatever they are called; or of the only one of moments."""
    names = [name for name in head.names if name not in columns.values() or name == options.time]
    try:
        return clock_of(head._replace(names=names), options)
    except LookupError:
        moments = [name for name in names if getattr(head.cells(name), "dtype", np.dtype(float)).kind == "M"]
        if len(moments) == 1:
            return clock_of(head._replace(names=names), replace(options, time=moments[0]))
        guess = looks_like(head, columns.values())
        raise ValueError(f"{HEADERS}; missing time, received {listed(head.names)}{guess}") from None


def _word(head: Head) -> str:
    """What the targets are: as the format says, or the columns; animals by their species, or else by their names."""
    names = {plain(name) for name in head.names}
    traffic = head.json and {"timestamp", "latitude", "longitude"} <= {*head.names} and not found(head.names, "sigma")
    word = head.word or next((word for word, columns in TARGETS.items() if names & columns), "")
    word = word or ("aircraft" if traffic else "target")
    if word not in ("animal", "target"):
        return word
    species = {text for name in head.names if plain(name) in OF_SPECIES for text in _texts(head, [name])} - {""}
    called = {*_texts(head, found(head.names, "id"))} - {""} if word == "animal" else ()
    return kind_of(species) or kind_of(called) or word


def _labels(head: Head, asked: Mapping[str, str], word: str) -> dict[str, str]:
    """Columns that say which target a row is of, what else it is called, and what marks a new position."""
    ids = [asked["id"]] if "id" in asked else [name for name in found(head.names, "id") if not counts_rows(name, head)]
    calls = [name for name in found(head.names, "call") if (plain(name) == "callsign") == (word == "aircraft")]
    calls = calls if word in ("aircraft", "ship") else []
    if not ids and len(set(filter(None, _texts(head, calls)))) > 1:
        ids = calls[:1]
    likely = {"id": ids, "call": [name for name in calls if name not in ids[:1]]}
    if word in ANIMALS:
        likely |= {role: found(head.names, role) for role in MARKS}
    likely["valid"] = [name for name in found(head.names, "valid") if _tells_some_valid(head.cells(name))]
    if word == "aircraft":
        likely["update"] = found(head.names, "update")
        altitudes = {plain(name): name for name in reversed(found(head.names, "altitude"))}
        if "altitude" not in altitudes and altitudes.keys() >= {"baroaltitude", "geoaltitude"}:
            likely["second"] = [altitudes["geoaltitude"]]
    return {role: columns[0] for role, columns in likely.items() if columns}


def _tells_some_valid(cells: Sequence[Any] | NDArray[Any]) -> bool:
    """Whether some cells are true; other words than these and false say nothing that is known."""
    return any(WORDS_OF_MARKS.get(word) for word in {*map(word_of, cells)})


def _parting(
    head: Head, clock: Clock, columns: Mapping[str, str], wanted: Wanted, names: Sequence[str]
) -> tuple[str, ...]:
    """Options for the columns that may name the target of a row, or part what the column with the targets does not."""

    def values(name: str) -> Array:
        kind = wanted[name]
        assert kind is not None
        return numbers(joined(head.cells, kind.joined) if kind.joined else head.cells(name), kind, name)

    known = [columns["id"]] if "id" in columns else []
    places = [columns[role] for role in (("latitude", "longitude") if "latitude" in columns else ("x", "y"))]
    with suppress(ValueError):  # of a cell, which is refused when all are read
        likely = likely_ids(head, values(clock.column), np.stack([*map(values, places)], 1), names, known)
        return tuple(option(*known, name) for name in likely)
    return ()


def _texts(head: Head, names: Sequence[str]) -> list[str]:
    """The cells of the first of these columns that are text or numbers."""
    cells = head.cells(names[0]) if names else []
    return [str(cell).strip() for cell in cells if isinstance(cell, _PLAIN)]


def _is_whole(head: Head, name: str | None, digits: int) -> bool:
    """Whether a column has whole numbers, one of at least so many digits."""
    texts = [] if name is None else [text for text in _texts(head, [name]) if text.lower() not in ("", "nan")]
    whole = [match[1] for text in texts if (match := _WHOLE.fullmatch(text))]
    return max(map(len, whole), default=0) >= digits and len(whole) == len(texts)


def _in_millimetres(head: Head, altitude: str | None) -> bool:
    """Whether altitudes are whole, and many or change as much as only millimetres do: trackers round to metres."""
    if not _is_whole(head, altitude, 1):
        return False
    values = np.array([float(text or "nan") for text in _texts(head, [altitude or ""])])
    return not np.nanmax(np.abs(values)) < _HIGH or np.nanmedian(np.abs(np.diff(values))) > _LEVEL


def _length(columns: Mapping[str, str], options: ReadOptions, word: str, head: Head) -> float:
    """Metres in the unit of x, y and z, or of altitudes."""
    for role in ("altitude", "z"):
        if plain(column := columns.get(role, "")) in DEPTHS:
            raise ValueError(f"{role}: expected heights, which grow upwards, received {column}: name its negative")
    lengths = [columns[role] for role in ("altitude", "x", "y", "z") if role in columns]
    if angles := [column for column in lengths if ANGLE.fullmatch((name_words(column) or [""])[-1])]:
        degrees = "; --lat and --lon name latitudes and longitudes, in degrees" if "x" in columns else ""
        raise ValueError(f"column {angles[0]}: expected lengths, received an angle{cartesian(head.names) or degrees}")
    ends = {column: _unit_behind(head, column) or unit(column, asked=True) or "" for column in lengths}
    units = [METRES[ending] for ending in ends.values() if ending in METRES]
    if not options.units and len({*units}) > 1:
        raise ValueError(f"expected one unit of lengths, received {listed(ends)}: convert one, or leave it out")
    if not options.units and (short := [column for column in lengths if plain(column).endswith("nm")]):
        raise ValueError(f"column {short[0]}: nm are nautical miles or nanometres: say --units nmi, or another")
    for name in [columns[role] for role in ("latitude", "longitude") if role in columns] + lengths:
        ending = name_words(name)[1:]
        if ending and OTHER_UNIT.fullmatch(ending[-1]) and not (options.units and "x" in columns):
            other = f", or {instead_of(ending[-1])}" if "x" in columns else ""
            raise ValueError(f"column {name}: expected metres or degrees, received {ending[-1]}: convert them{other}")
    if "ecef" in plain(columns.get("x", "")):
        raise ValueError(
            f"{columns['x']}: expected east, north and up, received coordinates from the centre of the earth: convert "
            "them to degrees, such as by pyproj.Transformer.from_crs(4978, 4979).transform(x, y, z)"
        )
    if {"xyvalid", "zvalid"} <= {*map(plain, head.names)} and plain(columns.get("x", "")) == "x":
        raise ValueError(
            "x, y, z: expected east, north and up, received north, east and down of an autopilot: --x y --y x, and "
            "give z another name or its negative"
        )
    feet = word == "aircraft" and plain(columns.get("altitude", "")) in _ALTITUDES_IN_FEET
    if options.units or units:
        return METRES[options.units] if options.units else units[0]
    if plain(columns.get("z", "")) in FLIGHT_LEVELS:
        raise ValueError(f"z: expected heights in the unit of x and y, received flight levels in {columns['z']}")
    beside = next((unit for names, unit in UNITS_BESIDE if names <= {*map(plain, head.names)}), "")
    if beside:
        return METRES.get(beside, _FLIGHT_LEVEL)
    if plain(columns.get("altitude", "")) in FLIGHT_LEVELS:
        return _FLIGHT_LEVEL
    autopilot = _is_whole(head, columns.get("latitude"), 7) and _in_millimetres(head, columns.get("altitude"))
    latitude = columns.get("latitude", "")
    in_metres = _in_semicircles(latitude) or plain(latitude) == _OF_A_PHONE
    return 1e-3 if autopilot and not in_metres else METRES["ft" if feet else "m"]


def _kind(role: str, columns: Mapping[str, str], head: Head, length: float, word: str) -> Kind | None:
    """What the numbers of a column are; None for text."""
    if role in ("id", "call", "zone"):
        return None
    if role == "update":
        return Kind()
    if role in ("valid", *MARKS):
        return replace(_MARK, others=role == "valid")
    if role not in _LIMITS:
        return Kind(unit=length, behind=_unit_behind(head, columns[role]))
    column, other = columns[role], columns["latitude" if role == "longitude" else "longitude"]
    limit = _LIMITS[role]
    absent = (*PLACEHOLDERS, _ABSENT[role]) if word == "ship" else PLACEHOLDERS
    kind = Kind(f"degrees within +-{limit:g}", limit=limit, absent=absent, sides=_SIDES[role])
    kind = replace(kind, advice=advice(_some_degrees(head, column), _some_degrees(head, other), limit))
    if unit(column) != "semicircles" and not _is_whole(head, column, 7):
        return kind
    degrees = _SEMICIRCLE if _in_semicircles(column) else _AUTOPILOT
    return replace(kind, limit=limit / degrees, unit=degrees, absent=(), advice="")


def _unit_behind(head: Head, column: str) -> str:
    """The length that stands behind all numbers of a column, as in "154 m"; "" where there is none."""
    matches = [BEHIND.fullmatch(text) for text in _texts(head, [column]) if not is_missing(text)]
    units = {match["unit"].lower() if match else "" for match in matches}
    return units.pop() if len(units) == 1 and units <= METRES.keys() and len(matches) > 1 else ""


def _in_semicircles(column: str) -> bool:
    return unit(column) == "semicircles" or column.lower().endswith(_SEMICIRCLES)


def _some_degrees(head: Head, name: str) -> list[float]:
    """The cells that hold degrees, with or without a letter of the hemisphere."""
    values = []
    for text in _texts(head, [name]):
        with suppress(ValueError):
            values.append(number(text.rstrip(" NSEW")))
    return [value for value in values if value == value and value not in PLACEHOLDERS]


def _sides(head: Head, columns: Mapping[str, str]) -> dict[str, str]:
    """Columns with the letters of the sides, by the columns of latitudes and longitudes that have no signs."""
    sides = {}
    for name in head.names:
        role = match.lastgroup if (match := _SIDE.fullmatch(re.sub("[^a-z]", "", name.lower()))) else None
        if role is None or role not in columns or name in columns.values():
            continue
        letters = {text.upper() for text in _texts(head, [name])} - {""}
        values = _some_degrees(head, columns[role])
        if letters and letters <= {*_SIDES[role]} and min(values, default=-1) >= 0:
            sides[columns[role]] = name
    return sides


def _has_commas(head: Head, columns: Mapping[str, str]) -> bool:
    """Whether a coordinate or a time is written as 1,5 and none as 1.5."""
    cells = [str(cell) for name in (*columns.values(), *found(head.names, "time")) for cell in head.cells(name)]
    parted = re.compile(r"[+-]?(?:[0-9]*|[0-9]{1,3}(?:[.'\u2019 \u00a0\u202f][0-9]{3})+),[0-9]*(?:[eE][+-]?[0-9]+)?")
    return any(parted.fullmatch(cell.strip()) for cell in cells)


def _with_points(head: Head) -> Callable[[str], list[Any]]:
    return lambda name: [cell.replace(",", ".") if isinstance(cell, str) else cell for cell in head.cells(name)]


def _said(columns: Mapping[str, str], length: float, options: ReadOptions, wanted: Wanted) -> list[str]:
    """Lines on positions and targets."""
    unit_said = _LENGTHS[length]
    places = [columns[role] for role in ("latitude", "longitude", "x", "y", "z") if role in columns]
    others = "" if options.units or any(unit(place, asked=True) for place in places) else "; --units takes others"
    how = "" if "latitude" in columns else f", in {unit_said}{others}"
    if any(kind is not None and kind.unit == _AUTOPILOT for kind in wanted.values()):
        how = ", in 1e-7 degrees"
    elif any(kind is not None and kind.unit == _SEMICIRCLE for kind in wanted.values()):
        how = ", in semicircles (180 / 2^31 degrees)"
    lines = [f"position: {', '.join(places)}{how}"]
    if "altitude" in columns:
        lines.append(
            f"altitude: {columns['altitude']}, in {unit_said}" + ("" if options.units else "; --units takes others")
        )
    marks = [columns[role] for role in MARKS if role in columns]
    lines += [f"marks of outliers: {listed(marks)}"] if marks else []
    lines += [f"marks of valid fixes: {columns['valid']}"] if "valid" in columns else []
    return lines + ([f"targets: {columns['id']}"] if "id" in columns else [])
