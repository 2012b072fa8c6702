"""Options of the commands that read tracks: which columns hold what, and how they are written."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields

from torchfra.readers.told import Told

_ABOUT = {
    "time": ("COLUMN", "of times; numbers in it may be seconds since any start"),
    "x": ("COLUMN", "of positions"), "y": ("COLUMN", "of positions"), "z": ("COLUMN", "of positions"),
    "lat": ("COLUMN", "of latitudes"), "lon": ("COLUMN", "of longitudes"), "alt": ("COLUMN", "of altitudes"),
    "id": ("COLUMN", "that says which target a row is of"),
    "sigma_column": ("COLUMN", "of the std of each fix per axis"),
    "units": ("m|ft", "of x, y, z, or of altitudes"),
    "delimiter": ("SIGN", "between cells; or tab, space"),
    "decimal": ("SIGN", "before decimals: . or ,"),
    "time_format": ("FORM", "seconds, ms, us, ns, iso or such as %%d.%%m.%%Y %%H:%%M:%%S"),
}  # fmt: skip
"""What each option is followed by, and what it is about."""


def add_reading_options(add: Callable[..., object]) -> None:
    """Adds ``--time COLUMN`` and the others, by the ``add_argument`` of a parser or of a group."""
    for field in fields(Told):
        sign, about = _ABOUT[field.name]
        add(f"--{field.name.replace('_', '-')}", metavar=sign, help=about)


def reading_of(options: argparse.Namespace) -> dict[str, str | None]:
    """What the options say, as keywords of ``readers.read``."""
    return {field.name: getattr(options, field.name) for field in fields(Told)}
