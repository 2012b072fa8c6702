"""Cells that hold more than a number: points of data bases, objects of JSON, and numbers with their unit behind."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from torchfra.readers import read

ROWS = 40
LON, LAT, UP = 8 + np.arange(ROWS) * 1.23e-5, 47 + np.arange(ROWS) * 2.34e-5, 400 + np.arange(ROWS) % 3
START = 1_700_000_000


def table(names, cells):
    return [f"gid,ts,{names}", *(f"{i},{START + i},{cell}" for i, cell in enumerate(cells))]


def wkb(*place, srid=4326, order="<", iso=False):
    kind = (1001 if iso else 0x80000001) if len(place) == 3 else 1
    kind |= 0x20000000 if srid else 0
    grid = struct.pack(f"{order}I", srid) if srid else b""
    head = struct.pack(f"{order}BI", order == "<", kind)
    return (head + grid + struct.pack(f"{order}{len(place)}d", *place)).hex()


WAYS = {
    "little": lambda x, y, z: wkb(x, y, z).upper(), "big": lambda x, y, z: wkb(x, y, z, order=">"),
    "iso": lambda x, y, z: wkb(x, y, z, srid=0, iso=True), "wkt": lambda x, y, z: f"POINT Z ({x:.7f} {y:.7f} {z:g})",
    "ewkt": lambda x, y, z: f"SRID=4326;POINT({x:.7f} {y:.7f} {z:g})",
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_points_of_a_data_base_are_longitudes_latitudes_and_heights(write, way):
    (track,) = read(write(table("geom", map(WAYS[way], LON, LAT, UP))))
    (other,) = read(write(["t,lat,lon,alt", *(f"{i},{LAT[i]:.7f},{LON[i]:.7f},{UP[i]}" for i in range(ROWS))]))
    np.testing.assert_allclose(track.position, other.position, atol=0.02)
    assert "longitude, latitude, altitude: all in geom" in track.source.notes


def test_points_of_another_grid_are_metres(write):
    (track,) = read(write(table("geom", [wkb(500_000.0 + 3 * i, 5_200_000.0 - i, srid=32632) for i in range(ROWS)])))
    assert track.position[-1].tolist() == [500_117, 5_199_961]


def test_points_without_a_grid_in_a_room_are_metres(write):
    (track,) = read(write(table("geom", [f"POINT({i / 64:g} {i % 4 / 4:g})" for i in range(ROWS)])))
    assert track.position[-1] == pytest.approx([39 / 64, 0.75], abs=1e-6)


def test_points_without_a_grid_that_may_be_degrees_or_metres_are_refused(write):
    with pytest.raises(
        ValueError, match=r"SRID=4326;POINT\(9.75 3\) or .* received none: they may be degrees or metres"
    ):
        read(write(table("geom", [f"POINT({i / 4:g} {i % 4:g})" for i in range(ROWS)])))


def test_points_of_a_map_of_the_web_are_refused_with_how_to_convert_them(write):
    with pytest.raises(ValueError, match=r"points of SRID 3857, whose metres grow .* ST_Transform\(geom, 4326\)"):
        read(write(table("geom", [wkb(1e6 + i, 6e6, srid=3857) for i in range(ROWS)])))


def test_points_beside_columns_that_are_named_are_not_read(write):
    cells = [f"{10 * i},{5 * i},SRID=3857;POINT({1e6 + i} 6e6)" for i in range(ROWS)]
    (track,) = read(write(table("a,b,geom", cells)), x="a", y="b")
    assert track.position[-1].tolist() == [390, 195]


def test_objects_of_json_in_the_cells_of_a_table_are_columns(write):
    def quoted(i):
        value = {"device": {"lat": round(LAT[i], 7), "lon": round(LON[i], 7)}, "ts": "other", "battery": [1, 2]}
        return '"' + json.dumps(value).replace('"', '""') + '"'

    (track,) = read(write(table("payload", map(quoted, range(ROWS)))))
    assert track.source.columns == {"time": "ts", "latitude": "lat", "longitude": "lon"}
    assert "payload.ts, battery, lat, lon: all in payload" in track.source.notes


def test_a_unit_behind_each_number_is_that_of_the_column(write):
    rows = [f"{i},{LAT[i]:.6f},{LON[i]:.6f},{1000 + i} ft" for i in range(ROWS)]
    (track,) = read(write(["t,lat,lon,altitude", *rows]))
    assert track.origin[2] == pytest.approx(304.8)
    with pytest.raises(ValueError, match="expected a number in data row 1, column altitude, received '1000 ft'"):
        read(write(["t,lat,lon,altitude", *rows, "99,47,8,300 m"]))


def test_signs_of_degrees_beneath_a_header_are_units(write):
    """As a research vessel's data base exports them."""
    rows = [f"2021/04/09 08:{i:02}:00\t{LAT[i]:.6f}\t{LON[i]:.6f}\t10.1" for i in range(ROWS)]
    (track,) = read(write(["date time\tSYS.STR.PosLat\tSYS.STR.PosLon\tSYS.STR.Speed", "\t°\t°\tkn", *rows]))
    assert track.source.columns["latitude"] == "SYS.STR.PosLat"
    assert "lines of units beneath the header: 1" in track.source.notes
