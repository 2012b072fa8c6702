# ruff: noqa: E501
"""Every format of the table is recognised by a file of ten lines and read as meant; else it is refused."""

from __future__ import annotations

import json
import math
import re
import struct
from datetime import datetime

import numpy as np
import pytest

import torchfra
from torchfra.cli.main import main
from torchfra.readers import read
from torchfra.readers.formats import FORMATS
from torchfra.readers.options import AskError

START, ROWS = 1_717_402_500, 10  # 2024-06-03T08:15:00Z
LATITUDES, LONGITUDES = 50 + np.arange(ROWS) / 1e4, 7 + np.arange(ROWS) / 1e4
SEMICIRCLE = 180 / 2**31
WEEK, TOW = 2317, 116_118.0
"""Of GPS, 18 s ahead of UTC."""


def rows(of):
    return [of(i, LATITUDES[i], LONGITUDES[i]) for i in range(ROWS)]


def table(header, of):
    return "\n".join([header, *rows(of)]) + "\n"


def day(i, form="2024-06-03 08:15:"):
    return f"{form}{i:02}"


PLT = "Geolife trajectory\nWGS 84\nAltitude is in Feet\nReserved 3\n0,2,255,My Track,0,0,2,8421376\n0"
VBO = "File created\n\n[column names]\nsats time lat long velocity height\n\n[data]"
GNSS = "# Version: v3\n# \n# Raw,utcTimeMillis\n# \n# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,UnixTimeMillis"
FMT = "FMT, 128, 89, FMT, BBnNZ, Type,Length\nFMT, 130, 50, GPS, QBBIHff, TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt"
NOVATEL = "#BESTPOSA,COM1,0,90.5,FINESTEERING"
FILES = {
    "NovAtel": "".join(rows(lambda i, a, o: f"#BESTVELA,COM1\n{NOVATEL},{WEEK},{TOW + i}00,02000040,cdba,32768;"
        f"SOL_COMPUTED,SINGLE,{a},{o},1000.0,-16.9,WGS84,1.6,1.2,2.5,\"\",0.0,0.0,35,30,30,30,00,06,39,33*2d0d0fc6\n")),
    "NAV-PVT of u-blox": table("iTOW,lat,lon,height,hMSL,hAcc",
        lambda i, a, o: f"{int(1000 * (TOW + i))},{a},{o},1000000,952000,1500"),
    "OpenLog Artemis of SparkFun": table("rtcDate,rtcTime,gps_Date,gps_Time,gps_Lat,gps_Long,gps_Alt,gps_SIV,gps_FixType",
        lambda i, a, o: f"2000/01/01,00:00:{i:02}.10,2024/06/03,08:15:{i:02}.000,{a * 1e7:.0f},{o * 1e7:.0f},1000000,12,3"),
    "state vectors of OpenSky": table("time,icao24,lat,lon,baroaltitude,geoaltitude,lastposupdate",
        lambda i, a, o: f"{START + i},abc,{a},{o},1000,1100,{START + i}"),
    "traffic": table("timestamp,icao24,latitude,longitude,altitude,last_position",
        lambda i, a, o: f"{START + i},abc,{a},{o},{1000 / 0.3048},{START + i}"),
    "BaseStation, of dump1090 on port 30003": "\n".join(rows(lambda i, a, o:
        f"MSG,3,1,1,4B1800,1,2024/06/03,08:15:{i:02}.000,2024/06/03,08:15:{i:02}.2,,{1000 / 0.3048},,,{a},{o},,,0,0,0,0")),
    "AeroAPI of FlightAware": table("timestamp,latitude,longitude,altitude,altitude_change,update_type",
        lambda i, a, o: f"{day(i, '2024-06-03T08:15:')}Z,{a},{o},{1000 / 30.48},C,A"),
    "ForeFlight": table("Timestamp,Latitude,Longitude,Altitude,Bank,Pitch,g Load",
        lambda i, a, o: f"{1000 * (START + i)},{a},{o},{1000 / 0.3048},1,2,1.0"),
    "G1000": table("Lcl Date, Lcl Time, UTCOfst, Latitude, Longitude, AltMSL (m)",
        lambda i, a, o: f"2024-06-03, 03:15:{i:02}, -05:00, {a}, {o}, 1000"),
    "degrees beside ECEF": table("UTC_Date,UTC_Time,ECEF_X [m],ECEF_Y [m],ECEF_Z [m],Latitude [°],Longitude [°],Height [m]",
        lambda i, a, o: f"2024-06-03,08:15:{i:02},4277000,625000,4671000,{a},{o},1000"),
    "flights": table("time,callsign,lat,lon,alt", lambda i, a, o: f"{START + i},AB1,{a},{o},{1000 / 0.3048}"),
    "DJI": table("time(ms),OSD.flyTime,OSD.latitude,OSD.longitude,OSD.height [m],altitude",
        lambda i, a, o: f"{1000 * (START + i)},{i},{a},{o},3,1000"),
    "AIS of the Danish Maritime Authority": table("# Timestamp,Type of mobile,MMSI,Latitude,Longitude,Name",
        lambda i, a, o: f"03/06/2024 08:15:{i:02},Class A,219000001,{a},{o},FERRY"),
    "AIS": table("MMSI,BaseDateTime,LAT,LON,VesselName",
        lambda i, a, o: f"219000001,{day(i)},{a},{o},FERRY"),
    "Wildlife Computers": table("DeployID,Ptt,Date,Type,Quality,Latitude,Longitude",
        lambda i, a, o: f"S1,9,08:15:{i:02} 03-Jun-2024,Argos,{'AB3'[i % 3]},{a},{o}"),
    "Movebank": table("event-id,visible,timestamp,location-long,location-lat,individual-local-identifier",
        lambda i, a, o: f"{i},true,{day(i)}.000,{o},{a},seal"),
    "Argos": table("id,date,loc_class,lon,lat", lambda i, a, o: f"t1,{day(i)},{'AB3'[i % 3]},{o},{a}"),
    "IBTrACS": table("SID,NAME,ISO_TIME,LAT,LON\n , , ,degrees_north,degrees_east",
        lambda i, a, o: f"2021208N,NOT_NAMED,{day(i)},{a},{o}"),
    "RTKLIB": table("% program   : RTKPOST\n%\n%  GPST       latitude(deg) longitude(deg)  height(m)   Q  ns",
        lambda i, a, o: f"{day(i, '2024/06/03 08:15:')}.000   {a} {o} 1000.0 1 12"),
    "GnssLogger": table(GNSS, lambda i, a, o: f"Raw,1,2\nFix,GPS,{a},{o},1000,{1000 * (START + i)}"),
    "ArduPilot": table(FMT, lambda i, a, o: f"ATT, 1, 2\nGPS, {i}, 0, 3, {1000 * (TOW + i):.0f}, {WEEK}, {a}, {o}, 1000"),
    "PX4, vehicle_gps_position": table("timestamp,time_utc_usec,lat,lon,alt,fix_type", lambda i, a, o:
        f"{i},{10**6 * (START + i)},{a * 1e7:.0f},{o * 1e7:.0f},1000000,3"),
    "PX4": table("timestamp,timestamp_sample,lat,lon,alt", lambda i, a, o: f"{10**6 * i},{i},{a},{o},1000"),
    "VBOX": table(VBO, lambda i, a, o: f"012 0815{i:02}.00 {a * 60:+.6f} {-o * 60:+.6f} 144.0 +1000.0"),
    "PLT of OziExplorer": table(PLT, lambda i, a, o:
        f"{a},{o},0,{1000 / 0.3048},{45_446 + (29_700 + i) / 86_400:.10f},2024-06-03,08:15:00"),
    "FIT as FitCSVTool writes its records": table(
        "record.timestamp[s],record.position_lat[semicircles],record.position_long[semicircles],record.altitude[m]",
        lambda i, a, o: f"{START + i - 631_065_600},{a / SEMICIRCLE:.0f},{o / SEMICIRCLE:.0f},1000"),
    "Suunto": table("UTC,EHPE,Latitude,Longitude,GPSAltitude", lambda i, a, o:
        f"{day(i)},5,{math.radians(a)},{math.radians(o)},1000"),
    "OwnTracks": table("tst,tid,acc,lat,lon,alt", lambda i, a, o: f"{START + i},m,8,{a},{o},1000"),
    "CoreLocation of Apple": table("timeIntervalSinceReferenceDate,latitude,longitude,altitude",
        lambda i, a, o: f"{START + i - 978_307_200},{a},{o},1000"),
    "Torque": table("GPS Time,Device Time,Longitude,Latitude,Altitude", lambda i, a, o:
        f"Mon Jun 03 10:15:{i:02} GMT+02:00 2024,x,{o},{a},1000"),
    "Traccar": table("valid,fixTime,deviceTime,latitude,longitude,altitude,deviceId", lambda i, a, o:
        f"true,{day(i)},{day(0)},{a},{o},1000,7"),
}  # fmt: skip
METRES = {
    "PX4, vehicle_local_position": table("timestamp,x,y,z,xy_valid,z_valid", lambda i, a, o: f"{10**6 * i},0,{i},-9,1,1"),
    "OptiTrack": table("Format Version,1.23,Length Units,Meters,Coordinate Space,Global\n\n,,Drone,Drone,Drone\nFrame,Time (Seconds),X,Y,Z",
        lambda i, a, o: f"{i},{i}.0,{i},1.{i},0"),
    "TUM": table("# timestamp tx ty tz qx", lambda i, a, o: f"{START + i} {i} 0 3 0.5"),
    "EuRoC": table("#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]", lambda i, a, o: f"{START + i}000000000,{i},0,3"),
    "NGSIM": table("Vehicle_ID,Frame_ID,Global_Time,Local_X,Local_Y", lambda i, a, o:
        f"2,{i},{1000 * (START + i)},{i / 0.3048},0"),
    "SUMO": table("timestep_time;vehicle_id;vehicle_x;vehicle_y", lambda i, a, o: f"{i}.00;v0;{i}.0;0.0"),
    "NFL": table("gameId,playId,nflId,time,x,y", lambda i, a, o: f"1,2,3,{day(i)},{i / 0.9144},0"),
    "Pozyx": table("time,tagId,success,version,x,y", lambda i, a, o: f"{START + i},7,1,1,{1000 * i},0"),
}  # fmt: skip
REFUSED = {
    "NovAtel without BESTPOSA": "#INSPVAA,COM1,0,31.0,FINESTEERING,2313,122403.0,0,54e2,0;2313,122403.0,51.1,-114.0,1000.0\n",
    "GPS_RAW_INT of MAVLink": table("time_boot_ms,fix_type,lat,lon,alt,eph,epv,h_acc",
        lambda i, a, o: f"{1000 * i},3,{a},{o},1000,121,200,1500"),
    "Google Smartphone Decimeter Challenge": table("utcTimeMillis,SvPositionXEcefMeters,SvPositionYEcefMeters,"
        "WlsPositionXEcefMeters,WlsPositionYEcefMeters,WlsPositionZEcefMeters", lambda i, a, o: f"{START}{i:03},1,2,3,4,5"),
    "Flightradar24": table("Timestamp,UTC,Callsign,Position,Altitude", lambda i, a, o:
        f'{START + i},{day(i, "2024-06-03T08:15:")}Z,AB1,"{a},{o}",{1000 / 0.3048}'),
    "ECEF": table("time,x-ecef(m),y-ecef(m),z-ecef(m)", lambda i, a, o: f"{i},4277000,625000,4671000"),
    "days of the year": table("year,doy,sod,lat,lon", lambda i, a, o: f"2024,155,{29700 + i},{a},{o}"),
    "Imaris": "\nPosition\n ==================== \n" + table("Position X,Position Y,Position Z,Unit,Category,Collection,Time,TrackID,ID,",
        lambda i, a, o: f"{i},2,3,um,Spot,Position,{i + 1},1000000000,{i},"),
}  # fmt: skip
OF_ADSB = {"ADS-B"}
"""Rows of columns that a reader of JSON makes: ``tests/readers/test_readsb.py``."""


def test_every_row_of_the_table_has_a_file():
    assert {row.name for row in FORMATS} == FILES.keys() | METRES.keys() | REFUSED.keys() | OF_ADSB


@pytest.mark.parametrize("name", FILES)
def test_degrees_of_every_format_are_read_as_they_are_meant(tmp_path, name):
    path = tmp_path / "track.txt"
    path.write_text(FILES[name], encoding="utf-8")
    (track,) = read(path)
    assert f"format: {name}" in track.source.notes
    assert np.diff(track.time) == pytest.approx(1, abs=1e-4)
    if name not in ("PX4", "VBOX", "NAV-PVT of u-blox"):
        assert track.time[0] == pytest.approx(START, abs=1e-3)
    assert track.origin[:2] == pytest.approx((50, 7), abs=1e-6)
    assert track.position[-1, :2] == pytest.approx([64.5, 100.1], abs=0.1)
    if re.search("alt|height|MSG", FILES[name][:300], re.IGNORECASE):
        assert track.origin[2] == pytest.approx(1000, rel=1e-6)


@pytest.mark.parametrize("name", METRES)
def test_metres_of_every_format_are_read_as_they_are_meant(tmp_path, name):
    path = tmp_path / "track.txt"
    path.write_text(METRES[name])
    (track,) = read(path)
    assert f"format: {name}" in track.source.notes
    assert np.diff(track.time) == pytest.approx(1, abs=1e-4)
    assert track.position[:, 0] == pytest.approx(np.arange(ROWS), abs=1e-6)
    assert np.ptp(track.position[:, 1]) == 0


@pytest.mark.parametrize("name", REFUSED)
def test_a_format_without_a_track_is_refused_with_what_to_do(tmp_path, name):
    path = tmp_path / "track.txt"
    path.write_text(REFUSED[name])
    said = next(row.refused for row in FORMATS if row.name == name)
    with pytest.raises(ValueError, match=re.escape(f"{name}: {said}")):
        read(path)


@pytest.mark.parametrize(("content", "word"), [
    ({"time": START, "states": [["abc", "AB1", "x", START + i, START, 7.0, 50 + i / 1e4, 1000.0] for i in range(ROWS)]},
     "aircraft"),
    ({"icao24": "abc", "callsign": "AB1", "path": [[START + i, 50 + i / 1e4, 7.0, 1000, 9] for i in range(ROWS)]}, "aircraft"),
])  # fmt: skip
def test_lists_of_numbers_in_json_are_fixes(tmp_path, content, word):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content))
    (track,) = read(path)
    assert (track.name, track.source.word, track.origin) == ("abc AB1", word, pytest.approx((50, 7, 1000)))


# ---------------------------------------------------------------- what is not known


def unknown(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(AskError) as error:
        read(path)
    return error.value


def test_columns_that_are_not_known_are_listed_with_three_values_and_the_options_to_copy(tmp_path, capsys):
    error = unknown(tmp_path, table("wann;hoch;breit", lambda i, a, o: f"{i};{2 * i}.5;{3 * i}.25"))
    assert "columns: wann (0, 1, 2), hoch (0.5, 2.5, 4.5), breit (0.25, 3.25, 6.25)" in str(error)
    assert "such as time='TIME', x='X', y='Y' (or lat='LAT', lon='LON')" in str(error)
    assert main(["track", str(tmp_path / "log.csv")]) == 2
    assert "such as --time TIME --x X --y Y (or --lat LAT --lon LON)" in capsys.readouterr().err


def test_a_message_has_a_rendering_for_python_and_one_for_commands(tmp_path):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"t": np.arange(30.0), "pos a x": np.arange(30.0), "pos a y": 2.0 * np.arange(30)})
    with pytest.raises(AskError, match="time='t', x='pos a x', y='pos a y'") as error:
        torchfra.clean(frame)
    assert "--time t --x 'pos a x' --y 'pos a y'" in error.value.command


def test_a_file_without_a_header_is_read_by_the_numbers_of_its_columns(tmp_path):
    error = unknown(tmp_path, "\n".join(rows(lambda i, a, o: f"{START + i} {a:.6f} {o:.6f}")))
    assert "time='TIME', x='X', y='Y' (or lat='LAT', lon='LON'); columns: 1 (" in str(error)
    assert len(read(tmp_path / "log.csv", time="1", lat="2", lon="3")[0].time) == ROWS


def test_the_phone_is_proposed_and_not_its_satellites(tmp_path):
    error = unknown(tmp_path, table("utc_ms,SvPosition X,SvPosition Y,WlsPosition X,WlsPosition Y",
                                    lambda i, a, o: f"{i},1.5,2.5,{i}.5,{i}.25"))  # fmt: skip
    assert "x='WlsPosition X', y='WlsPosition Y'" in str(error)


# ---------------------------------------------------------------- options never make reading worse


def test_a_number_of_a_column_does_not_stop_the_search_for_the_header(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("made by a logger\nversion 2\n" + table("clock,time,lat,lon", lambda i, a, o: f"9,{i},{a},{o}"))
    (track,) = read(path, time="2")
    assert track.time.tolist() == list(range(ROWS))
    assert track.origin[:2] == pytest.approx((50, 7))


def test_a_name_in_merged_cells_fills_down(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("Vehicle,Time,Lat,Lon\n" + "".join(
        f"{f'Van {k}' if not i else ''},{day(i)},{a + k},{o}\n" for k in range(2)
        for i, a, o in zip(range(ROWS), LATITUDES, LONGITUDES, strict=True)))  # fmt: skip
    for words in ({}, {"id": "Vehicle"}):
        assert [(track.name, len(track.time)) for track in read(path, **words)] == [("Van 0", ROWS), ("Van 1", ROWS)]
        assert read(path, **words)[0].repairs["rows named as the target above them"] == 2 * (ROWS - 1)


def test_rows_with_a_field_more_are_read_where_columns_are_named_and_it_is_said(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(table("time,lat,lon,place", lambda i, a, o: f"{i},{a},{o},here" + ", or there" * (i == 3)))
    with pytest.raises(
        ValueError, match="expected 4 fields in data row 4, received 5; rows with more than the first are"
    ):
        read(path)
    (track,) = read(path, time="time", lat="lat", lon="lon")
    assert len(track.time) == ROWS
    assert track.repairs == {"rows with more fields than the header read by their first fields": 1}


# ---------------------------------------------------------------- times


def walk(path, times, extra=""):
    path.write_text(
        "time,lat,lon\n" + "".join(f"{t},{50 + i / 1e5},{7 + i % 3 / 1e6}{extra}\n" for i, t in enumerate(times))
    )
    return path


def test_rows_within_whole_seconds_are_spread_by_their_order_and_it_is_said(tmp_path):
    (track,) = read(walk(tmp_path / "a.csv", [day(i // 5) for i in range(3, 200)]))
    assert np.diff(track.time) == pytest.approx(0.2)
    assert track.time[0] == START + 0.6
    assert list(track.repairs) == ["times within whole seconds spread by the order of rows"]


def test_rows_of_several_targets_within_whole_seconds_are_not_spread(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,car,lat,lon\n" + "".join(f"{day(i // 4)},{'abcd'[i % 4]}{i % 4},{50 + i % 4},{7 + i / 1e6}\n"
                                                   for i in range(160)))  # fmt: skip
    with pytest.raises(AskError, match=r"as of several targets: say id='car'"):
        read(path)
    assert len(read(path, id="car")) == 4


def test_a_clock_in_one_number_is_refused_with_the_form_that_reads_it(tmp_path):
    stamps = [123825000 + 20 * i for i in range(100)]  # of one minute at 50 Hz
    with pytest.raises(AskError, match="time_format='%H%M%S%f'"):
        read(walk(tmp_path / "a.csv", stamps))
    clock = [f"{12:02}{38 + i // 60:02}{i % 60:02}" for i in range(200)]
    with pytest.raises(AskError, match=r"a clock in one number .*: say time='time', time_format='%H%M%S'"):
        read(walk(tmp_path / "a.csv", clock))
    (track,) = read(tmp_path / "a.csv", time="time", time_format="%H%M%S")
    assert np.diff(track.time) == pytest.approx(1)


def test_a_time_that_counts_since_1970_goes_before_a_clock_in_one_number(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,millis,lat,lon\n" + "".join(
        f"{123825000 + 20 * i},{1000 * START + 20 * i},{50 + i / 1e6},7\n" for i in range(100)))  # fmt: skip
    (track,) = read(path)
    assert np.diff(track.time) == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize("sort", ["iso", "ms"])
def test_a_long_file_without_a_last_line_feed_is_read(tmp_path, sort):
    count = 40_000
    stamps = np.datetime64("2024-06-03T00:00:00") + np.arange(count).astype("timedelta64[s]")
    texts = stamps.astype(str) if sort == "iso" else (stamps.astype("datetime64[ms]").astype(int)).astype(str)
    for rest in range(3):
        path = tmp_path / f"{rest}.csv"
        lines = [f"{text},{50 + i / 1e6:.6f},7.000000" for i, text in enumerate(texts)]
        path.write_text("\n".join(["time,lat,lon", *lines[: count - rest]]))
        assert path.stat().st_size > 2**20
        assert len(read(path)[0].time) == count - rest


def test_sentences_behind_a_label_are_sentences(tmp_path):
    pytest.importorskip("pynmea2")
    lines = []
    for i in range(ROWS):
        body = f"GPGGA,08150{i}.00,5000.{100 + i},N,00700.000,E,1,08,0.9,100.0,M,47.0,M,,"
        total = 0
        for letter in body:
            total ^= ord(letter)
        lines.append(f"NMEA,${body}*{total:02X},{1000 * START + i}")
    (tmp_path / "gnss.txt").write_text("\n".join(lines))
    (track,) = read(tmp_path / "gnss.txt")
    assert len(track.time) == ROWS


def test_metres_called_latitude_and_longitude_are_named_as_the_cause(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,lat,lon\n" + "".join(f"{i},{2 + 0.1 * i:.3f},{12 + 0.3 * i:.3f}\n" for i in range(60)))
    with pytest.raises(AskError, match="lon and lat may be metres: x='lon', y='lat'"):
        read(path)


def test_pins_of_kml_are_no_targets(tmp_path):
    whens = "".join(f"<when>{day(i, '2024-06-03T08:15:')}Z</when>" for i in range(ROWS))
    places = "".join(f"<gx:coord>{o} {a} 9</gx:coord>" for a, o in zip(LATITUDES, LONGITUDES, strict=True))
    pin = (
        "<Placemark><name>Start</name><TimeStamp><when>2024-06-03T08:15:00Z</when></TimeStamp><Point><coordinates>7,50,9"
        "</coordinates></Point></Placemark>"
    )
    (tmp_path / "a.kml").write_text(
        '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>'
        f"{pin}<Placemark><name>Ride</name><gx:Track>{whens}{places}</gx:Track></Placemark>{pin}</Document></kml>"
    )
    (track,) = read(tmp_path / "a.kml")
    assert (track.name, len(track.time)) == ("Ride", ROWS)
    assert "pins left out: 2" in track.source.notes


@pytest.mark.parametrize("package", ["fitdecode", "openpyxl"])
def test_what_a_library_reads_says_what_to_install(tmp_path, monkeypatch, package):
    monkeypatch.setitem(__import__("sys").modules, package, None)
    path = tmp_path / ("a.fit" if package == "fitdecode" else "a.xlsx")
    path.write_bytes(
        b"\x0e\x10\x5d\x08\x64\x00\x00\x00.FIT" + bytes(99) if package == "fitdecode" else b"PK\x03\x04" + bytes(99)
    )
    with pytest.raises(ImportError, match=rf'needs the package {package}: pip install "torchfra\[formats\]"'):
        read(path)


def test_the_date_of_a_clock_is_the_one_that_is_called_alike_and_utc_goes_before_local_time(tmp_path):
    path = tmp_path / "collar.csv"
    path.write_text(
        "LMT_Date,LMT_Time,UTC_Date,UTC_Time,lat,lon\n"
        + "".join(f"04.06.2024,01:59:{i:02},03.06.2024,23:59:{i:02},{50 + i / 1e5},7\n" for i in range(ROWS))
    )
    (track,) = read(path)
    assert track.time[0] == START + (23 - 8) * 3600 + 44 * 60


def test_the_first_filled_sheet_of_a_workbook_is_read_as_csv_is(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    sheet = book.create_sheet("track")
    for row in (["made by me"], ["Time", "Lat", "Lon", "Vehicle"]):
        sheet.append(row)
    for i in range(ROWS):
        sheet.append([datetime(2024, 6, 3, 8, 15, i), LATITUDES[i], LONGITUDES[i], None if i else "Van 1"])
    book.save(tmp_path / "track.xlsx")
    (track,) = read(tmp_path / "track.xlsx")
    assert (track.name, track.time[0], len(track.time)) == ("Van 1", START, ROWS)


def fit_file():
    """Records, and laps between them."""
    utils = pytest.importorskip("fitdecode.utils")
    fields = bytes([253, 4, 0x86, 0, 4, 0x85, 1, 4, 0x85])  # timestamp, position_lat, position_long
    lap = bytes([0x41, 0, 0]) + struct.pack("<HB", 19, 1) + bytes([253, 4, 0x86])
    body = bytes([0x40, 0, 0]) + struct.pack("<HB", 20, 3) + fields + lap
    for i in range(ROWS):
        place = (round(LATITUDES[i] / SEMICIRCLE), round(LONGITUDES[i] / SEMICIRCLE))
        body += b"\x00" + struct.pack("<Iii", START + i - 631_065_600, *place)
        body += b"\x01" + struct.pack("<I", START + i - 631_065_600)
    head = struct.pack("<BBHI4s", 14, 0x10, 2132, len(body), b".FIT")
    data = head + struct.pack("<H", utils.compute_crc(head)) + body
    return data + struct.pack("<H", utils.compute_crc(data))


def test_records_of_fit_are_read_and_laps_are_not(tmp_path):
    (tmp_path / "run.fit").write_bytes(fit_file())
    (track,) = read(tmp_path / "run.fit")
    assert track.time.tolist() == [START + i for i in range(ROWS)]
    assert track.origin[:2] == pytest.approx((50, 7), abs=1e-6)


def test_damaged_fit_is_refused_whatever_its_library_stumbles_over(tmp_path):
    whole, path = fit_file(), tmp_path / "run.fit"
    cut = [whole[:k] for k in range(12, len(whole) - 2, 11)]
    changed = [whole[:k] + bytes([whole[k] ^ 0xFF]) + whole[k + 1 :] for k in (0, 5, 7, 19, 20, 22, 25)]
    for data in [*cut, *changed, b"<?xml ve.FIT" + bytes([255] * 200)]:
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"run\.fit: expected "):
            read(path)
