"""Positions on the earth and metres about a place go into each other, as pymap3d has them too."""

import numpy as np
import pymap3d
import pytest

from torchfra.geodesy import to_enu, to_geodetic

ORIGINS = [(47.0, 8.0, 430.0), (0.0, 0.0, 0.0), (-33.9, 151.2, 12.0), (89.9, -170.0, 3000.0), (-90.0, 10.0, 0.0)]


@pytest.fixture(scope="module")
def places():
    random = np.random.default_rng(4)
    return random.uniform(-90, 90, 400), random.uniform(-180, 180, 400), random.uniform(-500, 40e3, 400)


@pytest.mark.parametrize("origin", ORIGINS)
def test_metres_east_north_and_up_are_those_of_pymap3d(places, origin):
    expected = np.stack(pymap3d.geodetic2enu(*places, *origin), -1)
    np.testing.assert_allclose(to_enu(*places, origin), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("origin", ORIGINS)
def test_a_way_there_and_back_ends_where_it_began(places, origin):
    enu = to_enu(*places, origin)
    np.testing.assert_allclose(to_enu(*to_geodetic(enu, origin), origin), enu, rtol=0, atol=1e-6)
    np.testing.assert_allclose(to_geodetic(enu, origin)[2], places[2], rtol=0, atol=1e-6)


@pytest.mark.parametrize("origin", ORIGINS)
def test_latitudes_and_longitudes_are_those_that_pymap3d_puts_back_there(origin):
    enu = np.random.default_rng(5).normal(scale=1e5, size=(400, 3))
    found = to_geodetic(enu, origin)  # pymap3d's own way back is off by 0.1 mm here
    np.testing.assert_allclose(np.stack(pymap3d.geodetic2enu(*found, *origin), -1), enu, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found[2], pymap3d.enu2geodetic(*enu.T, *origin)[2], rtol=0, atol=1e-6)


@pytest.mark.parametrize("origin", ORIGINS[:3])
def test_a_target_without_altitude_stays_at_that_of_the_origin(origin):
    random = np.random.default_rng(6)
    latitude, longitude = origin[0] + random.uniform(-2, 2, 100), origin[1] + random.uniform(-2, 2, 100)
    flat = to_enu(latitude, longitude, origin[2], origin)[:, :2]
    found = to_geodetic(flat, origin)
    np.testing.assert_allclose(to_enu(*found, origin)[:, :2], flat, rtol=0, atol=1e-4)
    np.testing.assert_allclose(found[0], latitude, rtol=0, atol=1e-8)
    assert (found[2] == origin[2]).all()


def test_a_target_without_altitude_may_be_a_quarter_of_the_earth_away():
    latitude, longitude, origin = 59.0 - np.arange(0, 90.0, 5), np.full(18, 10.0), (59.0, 10.0, 0.0)
    found = to_geodetic(to_enu(latitude, longitude, 0.0, origin)[:, :2], origin)
    np.testing.assert_allclose(found[:2], [latitude, longitude], rtol=0, atol=1e-8)


def test_one_place_and_batches_of_any_shape_are_taken():
    origin = ORIGINS[0]
    assert to_enu(47.01, 8.0, 430.0, origin).shape == (3,)
    assert to_enu(np.full((2, 5), 47.01), 8.0, 430.0, origin).shape == (2, 5, 3)
    assert to_geodetic(np.zeros((2, 5, 2)), origin)[0].shape == (2, 5)
    np.testing.assert_allclose(to_geodetic([0.0, 0.0, 0.0], origin), origin, rtol=1e-11)
