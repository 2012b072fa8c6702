"""What a caller says of a file, where the file itself does not or says it wrongly."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

from torchfra.readers.spelling import OTHER_UNIT, instead_of
from torchfra.readers.times import FORMS, per_second

Words: TypeAlias = "str | tuple[str, ...] | None"
"""What a keyword of ``read`` may say."""
METRES = {
    "m": 1.0, "ft": 0.3048, "km": 1e3, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "mi": 1609.344, "nmi": 1852.0, "yd": 0.9144,
}  # fmt: skip
"""Units of length, by what ``units`` calls them."""
_COLUMNS = {"time", "x", "y", "z", "lat", "lon", "alt", "id", "sigma_column"}
_DELIMITERS = {"tab": "\t", "space": " ", "comma": ",", "semicolon": ";"}


@dataclass(frozen=True)
class ReadOptions:
    """Names of columns, and how their cells are written; None where the file is to tell."""

    time: str | None = None
    """Column of the times, whose numbers are then seconds even where they are not since 1970; or several, with commas
    between, as of a date and a time of the day."""
    x: str | None = None
    y: str | None = None
    z: str | None = None
    lat: str | None = None
    lon: str | None = None
    alt: str | None = None
    id: str | None = None
    """Column that says which target a row is of; or several, with commas between, as of a number and its operator."""
    sigma_column: str | None = None
    """Column of the standard deviation of each fix per axis, in the unit of positions."""
    units: str | None = None
    """``"m"``, ``"ft"``, ``"km"``, ... of ``METRES``: of x, y, z, or of altitudes beside latitudes."""
    delimiter: str | None = None
    """One character between cells, or ``"tab"``, ``"space"``, ``"comma"``, ``"semicolon"``."""
    decimal: str | None = None
    """``"."`` or ``","``."""
    time_format: str | None = None
    """``"seconds"``, ``"ms"``, ``"us"``, ``"ns"``, ``"minutes"``, ``"hours"``, ``"days"``; ``"excel"``, ``"mjd"``,
    ``"jd"`` and ``"matlab"`` for days since a date of theirs; ``"gps"`` and ``"gps_ms"`` for what of the week of GPS
    has passed, beside a column of weeks; ``"gps_seconds"`` for all of its seconds since 1980, ``"apple"`` for seconds
    since 2001, ``"fit"`` for those since the last day of 1989; ``"25fps"`` for numbers of frames, here 25 a second;
    ``"iso"``; or a form of ``datetime.strptime``, such as ``"%d%m%y %H%M%S"`` for two columns of digits."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and (not isinstance(value, str) or not value):
                raise ValueError(f"{field.name}: expected text, received {value!r}")
        if self.units is not None and self.units not in METRES and OTHER_UNIT.fullmatch(self.units):
            raise ValueError(f"units: expected {', '.join(METRES)}, received {self.units!r}: {instead_of(self.units)}")
        self._check("units", tuple(METRES))
        self._check("decimal", (".", ","))
        if self.delimiter is not None and len(self.sign) != 1:
            raise ValueError(
                f"delimiter: expected one character or tab, space, comma, semicolon, received {self.delimiter!r}"
            )
        form = self.time_format
        if form is not None and form not in FORMS and "%" not in form and not per_second(form):
            raise ValueError(
                f"time_format: expected one of {', '.join(FORMS)}, or such as 25fps or %d.%m.%Y %H:%M:%S, "
                f"received {form!r}"
            )
        for one, other in (("x", "y"), ("lat", "lon")):
            if (getattr(self, one) is None) != (getattr(self, other) is None):
                raise ValueError(f"{one}, {other}: expected both or neither, received only one of them")
        if self.x is not None and self.lat is not None:
            raise ValueError("x, lat: expected columns of metres or of degrees, received both")

    @property
    def sign(self) -> str:
        """Between cells; "" where the file tells."""
        return _DELIMITERS.get(self.delimiter or "", self.delimiter or "")

    def columns(self) -> dict[str, str]:
        """The columns that are named, by what they hold."""
        roles = {
            "time": self.time, "x": self.x, "y": self.y, "z": self.z, "latitude": self.lat, "longitude": self.lon,
            "altitude": self.alt, "id": self.id, "sigma": self.sigma_column,
        }  # fmt: skip
        return {role: name for role, name in roles.items() if name is not None}

    def among(self, names: Iterable[str]) -> ReadOptions:
        """These, with columns called as in a table that has units behind their names, such as ``AltMSL (ft)``."""
        full = {name.rpartition(" (")[0]: name for name in names} | {name: name for name in names}
        named = {field.name: getattr(self, field.name) for field in fields(self) if field.name in _COLUMNS}
        return replace(self, **{word: full.get(name, name) for word, name in named.items()})

    def named(self, names: Collection[str]) -> set[str]:
        """The columns that are named, out of these where an id or a time of several is one of them as it stands."""
        asked, several = {*self.columns().values()}, {name for name in (self.id, self.time) if name} - {*names}
        return asked - several | {part for name in several for part in name.split(",")}

    def _check(self, name: str, known: tuple[str, ...]) -> None:
        value = getattr(self, name)
        if value is not None and value not in known:
            raise ValueError(f"{name}: expected {', '.join(known[:-1])} or {known[-1]}, received {value!r}")


def read_options(words: Mapping[str, Words]) -> ReadOptions:
    """What a caller says by keyword; ``id`` may be a tuple of columns.

    Raises:
        ValueError: an unknown keyword, or a value out of its range.
    """
    known = [field.name for field in fields(ReadOptions)]
    if unknown := [word for word in words if word not in known]:
        raise ValueError(f"{unknown[0]}: expected one of {', '.join(known)}")
    return ReadOptions(**{name: ",".join(word) if name == "id" and isinstance(word, tuple) else word
                          for name, word in words.items()})  # type: ignore[arg-type]  # fmt: skip
