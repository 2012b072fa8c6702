"""Maps hold the cleaned track."""

from xml.etree import ElementTree

import numpy as np
import pytest
from cleaned_tracks import straight

from torchfra.cleaning.outputs import FORMATS, MAPS, check_format
from torchfra.cleaning.outputs.maps import GX, KML, gpx, kml
from torchfra.geodesy import to_geodetic


def place(of, position):
    latitude, longitude, altitude = to_geodetic(position, of.recording.origin)
    return np.stack([longitude, latitude, altitude], 1)


def test_gpx_is_read_by_others():
    gpxpy = pytest.importorskip("gpxpy", reason="needs gpxpy")
    of = straight(10)
    file = gpxpy.parse(gpx([of, straight(4, name="other")]).decode())
    assert [track.name for track in file.tracks] == ["3c6444 DLH1AB", "other"]
    points = file.tracks[0].segments[0].points
    got = np.array([[point.longitude, point.latitude, point.elevation] for point in points])
    np.testing.assert_allclose(got, place(of, of.position), atol=1e-3)
    assert points[3].time.isoformat() == "2024-05-03T10:00:06+00:00"


def test_kml_has_a_track_with_times():
    of = straight(10)
    root = ElementTree.fromstring(kml([of]))
    (track,) = root.iter(f"{{{GX}}}Track")
    whens = [element.text for element in track.findall(f"{{{KML}}}when")]
    coords = np.array([[float(v) for v in element.text.split()] for element in track.findall(f"{{{GX}}}coord")])
    assert (len(whens), whens[1]) == (10, "2024-05-03T10:00:02Z")
    np.testing.assert_allclose(coords, place(of, of.position), atol=1e-3)


@pytest.mark.parametrize("ending", MAPS)
def test_seconds_that_are_no_dates_leave_the_times_out(ending):
    text = FORMATS[ending]([straight(4, start=0.0)]).decode()
    assert "1970" not in text
    assert "<when>" not in text
    assert "48.0" in text


@pytest.mark.parametrize("ending", MAPS)
def test_tracks_in_metres_are_refused_before_any_work(ending):
    with pytest.raises(ValueError, match=r"^out: maps need latitudes and longitudes, and flights.csv has x and y"):
        check_format(ending, [straight(3, origin=None).recording])


@pytest.mark.parametrize("ending", MAPS)
def test_strange_names_and_steps_that_failed_do_no_harm(ending):
    of = straight(6, d=2, name="<a&b>\x00]]>\ud800")
    of.mean[2] = np.nan
    text = FORMATS[ending]([of]).decode()
    assert len(list(ElementTree.fromstring(text).iter())) > 5


def test_a_format_that_needs_a_package_that_is_not_there_is_refused_by_name(monkeypatch):
    monkeypatch.setattr("torchfra.cleaning.outputs.formats.find_spec", lambda name: None)
    for ending, package in ((".gpx", "gpxpy"), (".parquet", "pyarrow")):
        with pytest.raises(ImportError, match=rf"^out: \{ending} needs {package}: pip install"):
            check_format(ending)
    check_format(".kml")
