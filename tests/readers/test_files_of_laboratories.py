"""Files of laboratories, autopilots and open data are read as their makers mean them, or refused with what to do."""

from __future__ import annotations

import numpy as np
import pytest

import torchfra
from torchfra.cleaning.outputs.summary import UNLIKELY, overview, sentences
from torchfra.readers import read

ROWS = 60
EAST = np.arange(ROWS) * 0.5


# ---------------------------------------------------------------- units and axes


def test_what_swims_under_a_microscope_is_cleaned_with_its_micrometres_as_millimetres(write):
    """A cell at 40 um/s that turns with 2 rad/s, five fixes in a hundred 30 um off."""
    rng, time = np.random.default_rng(4), np.arange(300) * 0.05
    place = np.stack([20 * np.cos(2 * time) + 3 * time, 20 * np.sin(2 * time)], 1)
    seen = place + rng.normal(0, 0.5, place.shape)
    wrong = np.arange(300) % 20 == 0
    seen[wrong] += 30
    path = write(["time,x,y", *(f"{t},{x},{y}" for t, (x, y) in zip(time, seen, strict=True))])
    (cleaned,) = torchfra.clean(path, units="mm")
    rejected = cleaned.flag == "outlier"
    assert rejected[wrong].all()
    assert rejected[~wrong].sum() <= 3
    assert np.sqrt(np.mean((1e3 * cleaned.position[~wrong] - place[~wrong]) ** 2)) < 0.35
    assert not any("below" in said for said in sentences(cleaned))


def test_decimetres_are_a_unit_of_names_and_of_options(write):
    rows = [f"{i},{x},0" for i, x in enumerate(EAST)]
    assert read(write(["time,x [dm],y [dm]", *rows]))[0].position[2, 0] == pytest.approx(0.1)
    assert read(write(["time,x,y", *rows]), units="dm")[0].position[2, 0] == pytest.approx(0.1)


def test_radians_are_refused_whatever_the_unit_of_lengths(write):
    path = write(["time,lat_rad,lon_rad", *(f"{i},{0.8 + i / 1e6},0.1" for i in range(ROWS))])
    with pytest.raises(ValueError, match=r"column lat_rad: expected metres or degrees, received rad: convert them$"):
        read(path, lat="lat_rad", lon="lon_rad", units="m")


def test_three_lines_beneath_a_header_are_looked_at_for_units(write):
    above = ["POSITION_T,POSITION_X,POSITION_Y", "T,X,Y", "T,X,Y", "(sec),(micron),(micron)"]
    with pytest.raises(ValueError, match=r"column POSITION_X \(micron\): .* received micron: convert"):
        read(write([*above, *(f"{i},{x},0" for i, x in enumerate(EAST))]))


def test_a_speed_that_only_rockets_have_asks_for_the_unit_of_metres(write):
    path = write(["time,x,y", *(f"{i / 100},{15 * i},0" for i in range(1000))])
    with pytest.raises(ValueError, match=r"received a speed of 1,\d00 m/s: say their unit, such as units='mm', or"):
        read(path)
    assert read(path, units="mm")[0].position[1, 0] == 0.015
    assert read(path, units="m")[0].position[1, 0] == 15


@pytest.mark.parametrize("name", ["zone", "UTM zone"])
def test_a_target_that_changes_the_zone_of_its_grid_is_refused(write, name):
    rows = [
        f"{i},{'32U' if i < 40 else '33U'},{700_000 + x if i < 40 else 200_000 + x},5e6" for i, x in enumerate(EAST)
    ]
    with pytest.raises(ValueError, match=r"expected one zone of the grid, received 32U, 33U: convert all to one"):
        read(write([f"time,{name},easting,northing", *rows]))
    rows = [f"{i % 30},{i // 30},3{i // 30}U,{700_000 + x},5e6" for i, x in enumerate(EAST)]
    assert len(read(write([f"time,id,{name},easting,northing", *rows]))) == 2


def test_zones_of_a_shop_are_no_zones_of_a_grid(write):
    assert len(read(write(["time,zone,x,y", *(f"{i},{i // 20},{x},0" for i, x in enumerate(EAST))]))) == 1


# ---------------------------------------------------------------- targets and repeated positions


def test_storms_of_one_name_are_parted_by_what_numbers_them(write):
    rows = [f"20212{s}8N,NOT_NAMED,2021-09-{1 + i // 8:02} {i % 8 * 3:02}:00:00,{18 + s + i / 50},{140 - i / 50:.2f}"
            for s in range(2) for i in range(ROWS)]  # fmt: skip
    beneath = " , , ,degrees_north,degrees_east"
    tracks = read(write(["SID,NAME,ISO_TIME,LAT,LON", beneath, *rows]))
    assert [track.name for track in tracks] == ["2021208N", "2021218N"]


def test_what_numbers_sensors_does_not_name_the_targets(write):
    tracks = read(write(["time,id,x,y,sid", *(f"{i // 2},{'ab'[i % 2]},{i},0,7" for i in range(ROWS))]))
    assert [track.name for track in tracks] == ["a", "b"]


def repeated(times, seed=5):
    """Positions to 0.1 mm that are each there so many times."""
    east = 1.4 * np.arange(ROWS) + np.random.default_rng(seed).normal(scale=2, size=ROWS)
    held = np.repeat(east, times)
    return ["time,x,y", *(f"{i / 10},{x:.4f},{x / 3:.4f}" for i, x in enumerate(held))]


def test_positions_that_a_faster_log_repeats_are_held(write):
    (track,) = read(write(repeated(10)))
    assert track.row.tolist() == [10 * i for i in range(ROWS)]
    assert track.repairs == {"held positions dropped": 9 * ROWS}


def test_a_target_that_rests_at_times_is_not_held(write):
    times = np.ones(ROWS, int)
    times[[10, 30]] = 200
    assert len(read(write(repeated(times)))[0].time) == times.sum()


def test_a_target_that_stays_at_one_of_a_few_receivers_is_not_held(write):
    rng = np.random.default_rng(2)
    places, stays = rng.uniform(0, 5000, (8, 2)), np.repeat(rng.integers(0, 8, 60), rng.integers(2, 15, 60))
    rows = [f"{60 * i},{x:.1f},{y:.1f}" for i, (x, y) in enumerate(places[stays])]
    assert len(read(write(["time,x,y", *rows]))[0].time) == len(stays)


def test_rounded_positions_of_a_slow_target_are_not_held(write):
    rows = [f"{i},{0.3 * i:.0f},0" for i in range(600)]
    assert len(read(write(["time,x,y", *rows]))[0].time) == 600


# ---------------------------------------------------------------- messages


def test_decimal_commas_may_have_exponents(write):
    rows = [f"{i / 10:.3E};{50 + i / 1e4:.9E};{7:.9E}".replace(".", ",") for i in range(ROWS)]
    assert np.diff(read(write(["Time (s);Latitude;Longitude", *rows]))[0].time) == pytest.approx(0.1)


# ---------------------------------------------------------------- other formats


PLT = ["Geolife trajectory", "WGS 84", "Altitude is in Feet", "Reserved 3", "0,2,255,My Track,0,0,2,8421376", "0"]


def test_microseconds_are_no_seconds(write):
    for unit in ("\u00b5s", "\u03bcs", "us"):
        (track,) = read(write([f"time [{unit}],x,y", *(f"{1_000_000 * i},{x},0" for i, x in enumerate(EAST))]))
        assert track.time[1] == pytest.approx(1)


# ---------------------------------------------------------------- what is said of a path


def test_a_path_that_its_fixes_contradict_is_said_not_to_be_trusted():
    time, jumps = np.arange(0, 20, 1 / 60), np.random.default_rng(2)
    places = np.repeat(jumps.uniform(0, 2000, (60, 2)), 20, axis=0) + jumps.normal(scale=8, size=(1200, 2))
    cleaned = torchfra.clean((time, places), bank="aircraft", sigma=0.3)
    assert UNLIKELY in sentences(cleaned)
    assert overview([cleaned])[-1].startswith("Not to be trusted")
