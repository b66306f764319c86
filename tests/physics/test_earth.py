"""The Earth model against published values and against pymap3d."""

import numpy as np
import pymap3d
import pytest

from testbed.physics import earth


def test_normal_gravity_at_equator_and_pole():
    """WGS-84 normal gravity: 9.7803253359 m/s² at the equator, 9.8321849378 m/s² at the poles (NIMA TR8350.2)."""
    assert earth.gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert earth.gravity(np.pi / 2, 0.0) == pytest.approx(9.8321849378, abs=1e-9)


def test_gravity_falls_with_height_as_newton_says():
    """The free-air gradient is -2 g / R to first order: within 1 % of that over a kilometre."""
    drop = earth.gravity(0.7, 0.0) - earth.gravity(0.7, 1000.0)
    assert drop == pytest.approx(2000.0 * 9.80 / 6.371e6, rel=0.01)


def test_radii_of_curvature_are_the_derivative_of_position():
    """A small step in latitude and longitude, in ECEF by pymap3d, has the length that the radii give.

    The chord of a 1e-5 rad arc differs from it by 4e-12 relative; ECEF rounding of 1e-9 m on 64 m gives 2e-11.
    """
    lat, lon, h, step = 0.8, 0.3, 1200.0, 1e-5
    north, east = earth.metres_per_radian(lat, h)
    half = step / 2
    for size, (dlat, dlon) in ((north, (half, 0.0)), (east, (0.0, half))):
        a = np.array(pymap3d.geodetic2ecef(lat - dlat, lon - dlon, h, deg=False))
        b = np.array(pymap3d.geodetic2ecef(lat + dlat, lon + dlon, h, deg=False))
        assert np.linalg.norm(b - a) == pytest.approx(size * step, rel=1e-9)


def test_position_difference_wraps_at_the_date_line():
    north, east, down = earth.position_difference(0.1, -np.pi + 1e-6, 5.0, 0.1, np.pi - 1e-6, 7.0)
    assert north == 0.0
    assert east == pytest.approx(2e-6 * earth.metres_per_radian(0.1, 7.0)[1], rel=1e-9)
    assert down == 2.0


def test_functions_take_arrays_and_floats_alike():
    lat = np.array([0.1, 0.5, -1.2])
    for k, value in enumerate(lat):
        assert earth.gravity(lat, 10.0 * lat)[k] == earth.gravity(value, 10.0 * value)
        assert earth.transport_rate_n(lat, lat, lat, lat)[2][k] == earth.transport_rate_n(value, value, value, value)[2]


def test_transport_rate_is_the_rotation_of_the_navigation_frame():
    """Numerical derivative of C_ne along a motion, against the transport rate; central difference of step 1 s."""
    lat, lon, h, v_north, v_east = 0.9, -1.1, 3000.0, 120.0, 80.0

    def c_ne(time: float) -> np.ndarray:
        a = lat + time * v_north / earth.metres_per_radian(lat, h)[0]
        o = lon + time * v_east / earth.metres_per_radian(lat, h)[1]
        return np.array(
            [
                [-np.sin(a) * np.cos(o), -np.sin(a) * np.sin(o), np.cos(a)],
                [-np.sin(o), np.cos(o), 0.0],
                [-np.cos(a) * np.cos(o), -np.cos(a) * np.sin(o), -np.sin(a)],
            ]
        )

    skew = -(c_ne(0.5) - c_ne(-0.5)) @ c_ne(0.0).T
    rate = earth.transport_rate_n(lat, h, v_north, v_east)
    np.testing.assert_allclose([skew[2, 1], skew[0, 2], skew[1, 0]], rate, rtol=1e-6)
