"""Tracks as KML 2.2, with the track of Google's extension where there are dates."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement, indent, register_namespace, tostring

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.points import Points, points
from torchfra.tables import printable

KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
_STYLES = {"track": ("ffb27200", 3), "manoeuvre": ("ff009fe6", 5), "rejected": ("ff005ed5", 1)}
"""Colour, as alpha, blue, green and red, and width of a line."""


def encode(results: Sequence[Cleaned]) -> bytes:
    """A folder of each target: its track, its manoeuvres, and its rejected fixes where they were recorded.

    Raises:
        ValueError: a recording without latitudes.
    """
    register_namespace("", KML)
    register_namespace("gx", GX)
    root = Element(f"{{{KML}}}kml")
    document = _add(root, "Document")
    for name, (colour, width) in _STYLES.items():
        style = _add(document, "Style", id=name)
        line, icon = _add(style, "LineStyle"), _add(style, "IconStyle")
        for part in (line, icon):
            _add(part, "color", colour)
        _add(line, "width", str(width))
        _add(icon, "scale", "0.6")
    schema = _add(document, "Schema", id="steps")
    known = [points(cleaned) for cleaned in results]
    for name in dict.fromkeys(name for of in known for name in of.attributes):
        SubElement(schema, f"{{{GX}}}SimpleArrayField", name=name, type="string" if name == "flag" else "float")
    for of in known:
        _folder(document, of)
    indent(root, " ")
    text = tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()


def _folder(document: Element, of: Points) -> None:
    folder = _add(document, "Folder")
    _add(folder, "name", printable(of.name))
    track = _placemark(folder, printable(of.name), "track")
    _track(track, of) if of.dates is not None else _line(track, of.place.tolist())
    for segment, steps in of.manoeuvres:
        mark = _placemark(folder, f"{segment.kind}, {segment.rate:.2g}", "manoeuvre")
        _line(mark, of.place[steps].tolist())
    for place, row in zip(of.rejected, of.rejected_rows, strict=True):
        mark = _placemark(folder, f"rejected, row {row}", "rejected")
        point = _add(mark, "Point")
        _mode(point, len(place) == 3)
        _add(point, "coordinates", _text(place, ","))


def _track(mark: Element, of: Points) -> None:
    track = SubElement(mark, f"{{{GX}}}Track")
    _mode(track, of.place.shape[1] == 3)
    for date in of.dates or ():
        _add(track, "when", date)
    for place in of.place.tolist():
        SubElement(track, f"{{{GX}}}coord").text = _text(place if len(place) == 3 else [*place, 0.0], " ")
    data = SubElement(_add(track, "ExtendedData"), f"{{{KML}}}SchemaData", schemaUrl="#steps")
    for name, values in of.attributes.items():
        array = SubElement(data, f"{{{GX}}}SimpleArrayData", name=name)
        for value in values:
            SubElement(array, f"{{{GX}}}value").text = "" if value is None else str(value)


def _line(mark: Element, places: list[list[float]]) -> None:
    line = _add(mark, "LineString")
    _mode(line, bool(places) and len(places[0]) == 3)
    _add(line, "coordinates", " ".join(_text(place, ",") for place in places))


def _placemark(folder: Element, name: str, style: str) -> Element:
    mark = _add(folder, "Placemark")
    _add(mark, "name", name)
    _add(mark, "styleUrl", f"#{style}")
    return mark


def _mode(geometry: Element, high: bool) -> None:
    """Says whether altitudes are above the sea, or the geometry is on the ground."""
    _add(geometry, "altitudeMode", "absolute" if high else "clampToGround")


def _text(place: list[float], between: str) -> str:
    return between.join(f"{v:.{8 if axis < 2 else 3}f}" for axis, v in enumerate(place))


def _add(parent: Element, name: str, text: str | None = None, **attributes: str) -> Element:
    element = SubElement(parent, f"{{{KML}}}{name}", attributes)
    element.text = text
    return element
