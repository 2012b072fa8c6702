"""Tracks as KML 2.2, with the track of Google's extension where there are dates."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.points import Points, points
from torchfra.tables import printable

KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
_FILE = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="{kml}" xmlns:gx="{gx}"><Document>
{styles}
<Schema id="steps">
{fields}
</Schema>
{folders}
</Document></kml>
"""
_STYLE = """<Style id="{}"><LineStyle><color>{color}</color><width>{}</width></LineStyle>
<IconStyle><color>{color}</color><scale>0.6</scale></IconStyle></Style>"""
_STYLES = {"track": ("ffb27200", 3), "manoeuvre": ("ff009fe6", 5), "rejected": ("ff005ed5", 1)}
"""Colour, as alpha, blue, green and red, and width of a line."""
_MODES = {2: "<altitudeMode>clampToGround</altitudeMode>", 3: "<altitudeMode>absolute</altitudeMode>"}
"""Whether a place of so many numbers is on the ground or has an altitude above the sea."""
_MARK = "<Placemark><name>{}</name><styleUrl>#{}</styleUrl>\n{}\n</Placemark>"


def encode(results: Sequence[Cleaned]) -> bytes:
    """A folder of each target: its track, its manoeuvres, and its rejected fixes where they were recorded.

    Raises:
        ValueError: a recording without latitudes.
    """
    known = [points(cleaned) for cleaned in results]
    names = dict.fromkeys(name for of in known for name in of.attributes)
    return _FILE.format(
        kml=KML, gx=GX,
        styles="\n".join(_STYLE.format(name, width, color=color) for name, (color, width) in _STYLES.items()),
        fields="\n".join(
            f'<gx:SimpleArrayField name="{name}" type="{"string" if name == "flag" else "float"}"/>' for name in names
        ),
        folders="\n".join(map(_folder, known)),
    ).encode()  # fmt: skip


def _folder(of: Points) -> str:
    name = escape(printable(of.name))
    path = _geometry("LineString", of.place.tolist()) if of.dates is None else _track(of)
    marks = [_MARK.format(name, "track", path)]
    for segment, steps in of.manoeuvres:
        path = _geometry("LineString", of.place[steps].tolist())
        marks.append(_MARK.format(f"{segment.kind}, {segment.rate:.2g}", "manoeuvre", path))
    for place, row in zip(of.rejected, of.rejected_rows, strict=True):
        marks.append(_MARK.format(f"rejected, row {row}", "rejected", _geometry("Point", [place])))
    return "\n".join([f"<Folder><name>{name}</name>", *marks, "</Folder>"])


def _track(of: Points) -> str:
    values = "\n".join(
        f'<gx:SimpleArrayData name="{name}">\n'
        + "\n".join(f"<gx:value>{'' if value is None else value}</gx:value>" for value in every)
        + "\n</gx:SimpleArrayData>"
        for name, every in of.attributes.items()
    )
    whens = "\n".join(f"<when>{date}</when>" for date in of.dates or ())
    places = "\n".join(f"<gx:coord>{_text([*place, 0.0][:3], ' ')}</gx:coord>" for place in of.place.tolist())
    data = f'<ExtendedData><SchemaData schemaUrl="#steps">\n{values}\n</SchemaData></ExtendedData>'
    return f"<gx:Track>{_MODES[of.place.shape[1]]}\n{whens}\n{places}\n{data}</gx:Track>"


def _geometry(kind: str, places: list[list[float]]) -> str:
    mode = _MODES[len(places[0])] if places else ""
    return f"<{kind}>{mode}<coordinates>{' '.join(_text(place, ',') for place in places)}</coordinates></{kind}>"


def _text(place: list[float], between: str) -> str:
    return between.join(f"{v:.{8 if axis < 2 else 3}f}" for axis, v in enumerate(place))
