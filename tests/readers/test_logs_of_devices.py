"""Logs of watches, phones, cars, aeroplanes and receivers of ships are read without an option."""

from __future__ import annotations

import json
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from torchfra.readers import read

START = datetime(2026, 5, 3, 8, 15, tzinfo=timezone.utc)
ROWS = 40
PLACES = [(50 + i / 1e4, 7 + i / 1e4) for i in range(ROWS)]
MOMENTS = [START + timedelta(seconds=i) for i in range(ROWS)]


def assert_in_place(track):
    assert track.time - START.timestamp() == pytest.approx(np.arange(ROWS), abs=1e-3)
    assert track.origin[:2] == pytest.approx((50, 7), abs=1e-6)
    assert track.position[-1, :2] == pytest.approx([279.4, 433.8], abs=1)


# ---------------------------------------------------------------- a glass cockpit


def g1000(offset="-05:00", units="#yyy-mm-dd, hh:mm:ss,   hh:mm,      degrees,      degrees,  ft msl"):
    local = [moment - timedelta(hours=5) for moment in MOMENTS]
    return [
        '#airframe_info, log_version="1.00", airframe_name="Cessna 172S"', units,
        "  Lcl Date, Lcl Time, UTCOfst,     Latitude,    Longitude,  AltMSL",
        *(f"{moment:%Y-%m-%d, %H:%M:%S},  {offset},   {lat:.7f},  {lon:.7f},  1000.0"
          for moment, (lat, lon) in zip(local, PLACES, strict=True)),
    ]  # fmt: skip


def test_units_above_the_header_count(write):
    (track,) = read(write(g1000()))
    assert track.origin[2] == pytest.approx(304.8)
    assert "units in the comment before the header" in track.source.notes


def test_a_comment_of_other_words_is_no_row_of_units(write):
    (track,) = read(write(g1000(units="# one, two, three, four, five, six")))
    assert track.origin[2] == 1000


def test_columns_are_asked_for_by_the_names_in_the_header_where_their_units_stand_in_a_row(write):
    (track,) = read(write(g1000()), lat="Latitude", lon="Longitude", alt="AltMSL")
    assert track.origin[2] == pytest.approx(304.8)


def test_an_offset_beside_times_that_are_not_called_local_is_not_added(write):
    rows = [
        f"{moment:%Y-%m-%d %H:%M:%S},-05:00,{lat},{lon}" for moment, (lat, lon) in zip(MOMENTS, PLACES, strict=True)
    ]
    assert_in_place(read(write(["time,utc_offset,lat,lon", *rows]))[0])


# ---------------------------------------------------------------- a car


def test_dates_as_java_writes_them_are_read(write):
    local = [moment + timedelta(hours=2) for moment in MOMENTS]
    rows = [f"{moment:%a %b %d %H:%M:%S} GMT+02:00 2026,{lon},{lat},5.0"
            for moment, (lat, lon) in zip(local, PLACES, strict=True)]  # fmt: skip
    first = "Sun May 03 10:14:59 GMT+02:00 2026,-,-,-"
    (track,) = read(write(["GPS Time, Longitude, Latitude, Horizontal Dilution of Precision", first, *rows]))
    assert_in_place(track)
    assert track.time[0] == 1_777_796_100
    assert track.repairs == {"rows without position dropped": 1}
    assert track.sigma == pytest.approx(25 / np.sqrt(2))


# ---------------------------------------------------------------- a watch


SEMICIRCLE = 180 / 2**31
FIT = [
    (round(moment.timestamp()) - 631_065_600, round(lat / SEMICIRCLE), round(lon / SEMICIRCLE))
    for moment, (lat, lon) in zip(MOMENTS, PLACES, strict=True)
]


def test_a_table_of_fit_whose_times_count_since_1970_stays_so(write):
    names = "record.timestamp,record.position_lat,record.position_long"
    (track,) = read(write([names, *(f"{time + 631_065_600},{lat},{lon}" for time, lat, lon in FIT)]))
    assert_in_place(track)


# ---------------------------------------------------------------- receivers of ships


CLASS_A = "!AIVDM,1,1,,B,15NG6V0P01G?cFhE`R2IU?wn28R>,0*05"
"""Of ship 367380120 at 37.806948, -122.404333, as pyais documents it."""


def checksum(text):
    return f"{np.bitwise_xor.reduce(list(text.encode())):02X}"


def tagged(message, time, more="s:r003669945,"):
    block = f"{more}c:{time}"
    return f"\\{block}*{checksum(block)}\\{message}"


def test_the_ship_itself_is_read_where_it_hears_others(write):
    pytest.importorskip("pynmea2")
    own = ["$GPGGA,092750.000,5321.6802,N,00630.3372,W,1,8,1.03,61.7,M,55.2,M,,*76",
           "$GPGGA,092751.000,5321.6802,N,00630.3371,W,1,8,1.03,61.7,M,55.3,M,,*75"]  # fmt: skip
    (track,) = read(write([tagged(CLASS_A, 1_777_788_733), *own], "ais.log"))
    assert track.origin[:2] == pytest.approx((53.36133, -6.50562), abs=1e-4)
    assert any("1 AIS messages left out" in note for note in track.source.notes)


# ---------------------------------------------------------------- apps and services


def state(moment, lat, lon, name="3c6444"):
    time = round(moment.timestamp())
    return [name, "DLH9LF  ", "Germany", time, time + 1, lon, lat, 3000.0, False, 220.0, 0.0, 0.0, None, 3050.0, "1000"]


def test_a_moment_without_state_vectors_is_none_of_theirs(write):
    lines = [json.dumps({"time": round(moment.timestamp()), "states": [state(moment, *place)] if i % 4 else None})
             for i, (moment, place) in enumerate(zip(MOMENTS, PLACES, strict=True))]  # fmt: skip
    (track,) = read(write(lines, "states.jsonl"))
    assert len(track.time) == ROWS - ROWS // 4


def samples():
    return [
        {
            "EHPE": 5,
            "GPSAltitude": 408,
            "Latitude": np.radians(lat),
            "Longitude": np.radians(lon),
            "UTC": moment.isoformat(),
        }
        for moment, (lat, lon) in zip(MOMENTS, PLACES, strict=True)
    ]


def test_a_watch_may_tell_radians(write):
    (track,) = read(write(json.dumps([{"HR": 2.3, "TimeISO8601": "x"}, *samples()]), "a.json"))
    assert_in_place(track)
    assert track.origin[2] == 408


def test_small_degrees_of_records_that_are_no_samples_of_a_watch_are_no_radians(write):
    records = [{"EHPE": 5, "UTC": moment.isoformat(), "Latitude": lat - 50, "Longitude": lon - 7}
               for moment, (lat, lon) in zip(MOMENTS, PLACES, strict=True)]  # fmt: skip
    (track,) = read(write(json.dumps(records), "a.json"))
    assert np.ptp(track.position[:, 1]) == pytest.approx(110_574 * np.ptp([lat for lat, _ in PLACES]), rel=1e-3)


def test_degrees_beside_an_altitude_by_gps_are_no_radians(write):
    records = [
        {"time": i, "Latitude": lat, "Longitude": lon, "GPSAltitude": 408} for i, (lat, lon) in enumerate(PLACES)
    ]
    assert read(write(json.dumps(records), "a.json"))[0].origin[0] == 50


def test_the_time_of_a_fix_goes_before_that_of_the_device(write):
    rows = [f"{moment + timedelta(seconds=3):%Y-%m-%dT%H:%M:%SZ},{moment:%Y-%m-%dT%H:%M:%SZ},{lat},{lon}"
            for moment, (lat, lon) in zip(MOMENTS, PLACES, strict=True)]  # fmt: skip
    assert_in_place(read(write(["deviceTime,fixTime,latitude,longitude", *rows]))[0])


# ---------------------------------------------------------------- languages and cells


def test_sentences_of_a_receiver_in_cells_of_csv_are_read(tmp_path):
    lines = ["timestamp,type,id,message"]
    for k in range(20):
        sentence = f"GPRMC,0120{k:02}.00,A,3649.{2000 + 10 * k},S,17448.0023,E,5.9,34.3,140226,,,A"
        total = 0
        for letter in sentence:
            total ^= ord(letter)
        lines += [f'2026-02-14T01:20:{k:02}.259Z,NMEA0183,,"${sentence}*{total:02X}"',
                  f'2026-02-14T01:20:{k:02}.259Z,NMEA0183,,"$SDDBT,26.2,f,8.0,M,,F*16"']  # fmt: skip
    (tmp_path / "a.csv").write_text("\n".join(lines))
    (track,) = read(tmp_path / "a.csv")
    assert len(track.time) == 20
