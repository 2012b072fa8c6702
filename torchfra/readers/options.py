"""What a caller says of a file, where the file itself does not, and the errors that ask for it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from shlex import quote
from typing import TypeAlias

from torchfra.readers.names import METRES, OTHER_UNIT
from torchfra.readers.times import FORMS, per_second
from torchfra.suggestions import meant

Words: TypeAlias = "str | tuple[str, ...] | None"
"""What a keyword of ``read`` may say."""
_DELIMITERS = {"tab": "\t", "space": " ", "comma": ",", "semicolon": ";"}
_PAIRS = (("x", "y"), ("lat", "lon"))


class AskError(ValueError):
    """A file does not say what it holds; an option does.

    Its arguments are pieces of text, and options by name with their values.  As text these are arguments of Python,
    ``time='t', x='2'``; in ``command`` they are options of the command, ``--time t --x 2``.
    """

    def __str__(self) -> str:
        return self._written(lambda options: ", ".join(f"{name}={value!r}" for name, value in options.items()))

    @property
    def command(self) -> str:
        """The message for who types commands."""
        return self._written(
            lambda options: " ".join(f"--{name.replace('_', '-')} {quote(value)}" for name, value in options.items())
        )

    def _written(self, of: Callable[[Mapping[str, str]], str]) -> str:
        return "".join(of(part) if isinstance(part, dict) else str(part) for part in self.args)


def named(path: object, error: ValueError) -> ValueError:
    """The error with the name of a file in front."""
    if isinstance(error, AskError):
        return type(error)(f"{path}: ", *error.args)
    return ValueError(f"{path}: {error}")


@dataclass(frozen=True)
class ReadOptions:
    """Columns, by their names or by their numbers from 1 on, and how cells are written; None where the file tells."""

    time: str | None = None
    """Column of the times; or several, with commas between, as of a date and a time of the day."""
    x: str | None = None
    y: str | None = None
    z: str | None = None
    lat: str | None = None
    lon: str | None = None
    alt: str | None = None
    id: str | None = None
    """Column that says which target a row is of, and those beneath it that say nothing; or several."""
    sigma_column: str | None = None
    """Column of the standard deviation of each fix per axis, in the unit of positions."""
    units: str | None = None
    """``"m"``, ``"ft"``, ``"km"``, ... of ``METRES``: of x, y, z, or of altitudes beside latitudes."""
    delimiter: str | None = None
    """One character between cells, or ``"tab"``, ``"space"``, ``"comma"``, ``"semicolon"``."""
    decimal: str | None = None
    """``"."`` or ``","``."""
    missing: str | None = None
    """Numbers that stand for none in positions and altitudes, with commas between, such as ``"-999,9999"``; or
    ``"none"``, where such numbers are positions."""
    time_format: str | None = None
    """``"seconds"``, ``"ms"``, ``"us"``, ``"ns"``, ``"minutes"``, ``"hours"``, ``"days"``; ``"excel"``, ``"mjd"``,
    ``"jd"`` and ``"matlab"`` for days since a date of theirs; ``"gps_seconds"``, ``"apple"`` and ``"fit"`` for seconds
    since 1980, 2001 and the last day of 1989; ``"gps"`` and ``"gps_ms"`` for two columns, the week of GPS and what of
    it has passed; ``"25fps"`` for numbers of frames, here 25 a second; ``"iso"``; or a form of ``datetime.strptime``,
    such as ``"%d%m%y %H%M%S"`` for two columns of digits."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and (not isinstance(value, str) or not value):
                raise ValueError(f"{field.name}: expected text, received {value!r}")
        if self.units is not None and self.units not in METRES and OTHER_UNIT.fullmatch(self.units):
            raise AskError(f"units: expected {', '.join(METRES)}, received {self.units!r}: ", *instead_of(self.units))
        for name, known in (("units", tuple(METRES)), ("decimal", (".", ","))):
            value = getattr(self, name)
            if value is not None and value not in known:
                raise ValueError(f"{name}: expected {', '.join(known[:-1])} or {known[-1]}, received {value!r}")
        if self.delimiter is not None and len(self.sign) != 1:
            raise ValueError(
                f"delimiter: expected one character or tab, space, comma, semicolon, received {self.delimiter!r}"
            )
        _ = self.absent
        form = self.time_format
        if form is not None and form not in FORMS and "%" not in form and not per_second(form):
            raise ValueError(
                f"time_format: expected one of {', '.join(FORMS)}, or such as 25fps or %d.%m.%Y %H:%M:%S, "
                f"received {form!r}"
            )
        for one, other in _PAIRS:
            if (getattr(self, one) is None) != (getattr(self, other) is None):
                raise ValueError(f"{one}, {other}: expected both or neither, received only one of them")
        if self.x is not None and self.lat is not None:
            raise ValueError("x, lat: expected columns of metres or of degrees, received both")

    @property
    def sign(self) -> str:
        """Between cells; "" where the file tells."""
        return _DELIMITERS.get(self.delimiter or "", self.delimiter or "")

    @property
    def absent(self) -> tuple[float, ...]:
        """The numbers that stand for none.

        Raises:
            ValueError: something else.
        """
        try:
            return tuple(float(one) for one in (self.missing or "none").split(",") if one != "none")
        except ValueError:
            raise ValueError(
                f"missing: expected numbers with commas between, such as -999,9999, received {self.missing!r}"
            ) from None

    @property
    def columns(self) -> dict[str, tuple[str, ...]]:
        """The columns that are named, by what they hold."""
        roles = {
            "time": self.time, "x": self.x, "y": self.y, "z": self.z, "latitude": self.lat, "longitude": self.lon,
            "altitude": self.alt, "id": self.id, "sigma": self.sigma_column,
        }  # fmt: skip
        return {role: tuple(name.split(",")) if role in ("time", "id") else (name,)
                for role, name in roles.items() if name is not None}  # fmt: skip

    def among(self, names: list[str]) -> dict[str, tuple[str, ...]]:
        """The columns that are named, as a table calls them: with the unit that stands in a line of its own, say.

        Raises:
            ValueError: there is none of a name.
        """
        whole = {"time": self.time, "id": self.id}
        asked = {role: (one,) if (one := whole.get(role)) in names and one else several
                 for role, several in self.columns.items()}  # fmt: skip
        return {role: tuple(_column(name, names) for name in several) for role, several in asked.items()}


def without_unit(name: str) -> str:
    """A name without the unit in brackets that stands in a line of its own, say."""
    return re.sub(r" \([^()]*\)$", "", name)


def _column(name: str, names: list[str]) -> str:
    """The column of a name, or of a number."""
    bare = {without_unit(one): one for one in reversed(names)} | {one: one for one in names}
    if name in bare:
        return bare[name]
    if name.isascii() and name.isdigit() and 0 < int(name) <= len(names):
        return names[int(name) - 1]
    raise ValueError(f"expected a column {name}, received {listed(names)}{meant(name, names)}")


def read_options(words: Mapping[str, Words]) -> ReadOptions:
    """What a caller says by keyword; ``id`` may be a tuple of columns.

    Raises:
        ValueError: an unknown keyword, or a value out of its range.
    """
    known = [field.name for field in fields(ReadOptions)]
    if unknown := [word for word in words if word not in known]:
        raise ValueError(f"{unknown[0]}: expected one of {', '.join(known)}")
    return replace(ReadOptions(), **{name: ",".join(word) if name == "id" and isinstance(word, tuple) else word
                                     for name, word in words.items()})  # type: ignore[arg-type]  # fmt: skip


def instead_of(unit: str) -> tuple[str | dict[str, str], ...]:
    """What to say of positions in one of ``OTHER_UNIT``: they are cleaned right as another unit, which is then theirs.

    What moves under a microscope moves as people do if its micrometres are taken as millimetres.
    """
    tiny = re.fullmatch(r"[nu]m|[\u00b5\u03bc]m|mic.*|px|pixels?", unit, re.IGNORECASE)
    return "say ", {"units": "mm" if tiny else "m"}, f", and read {'mm' if tiny else 'metres'} in the results as these"


def listed(names: Iterable[str], longest: int = 200) -> str:
    """Names for a person, as many as fit into a line or two."""
    every, length = list(names), 0
    for count, name in enumerate(every):
        length += len(name) + 2
        if length > longest:
            return ", ".join([*every[:count], f"and {len(every) - count} more"]) if count else f"{name[:longest]}..."
    return ", ".join(every) or "(none)"
