"""WGS-84: NGA.STND.0036 and Somigliana's closed formula are the authorities."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from signals.constants import GM_EARTH, OMEGA_EARTH, WGS84_A
from ultratight.ins.earth import (
    ecef_from_geodetic,
    geodetic_from_ecef,
    gravity,
    gravity_gradient,
    rotation_e_from_n,
)

pytestmark = pytest.mark.nojit

LAT = st.floats(-np.pi / 2, np.pi / 2)
LON = st.floats(-np.pi, np.pi)
HEIGHT = st.floats(-11e3, 3e7)


@given(LAT, LON, HEIGHT)
def test_geodetic_round_trip(lat, lon, h):
    r = ecef_from_geodetic(lat, lon, h)
    back = ecef_from_geodetic(*geodetic_from_ecef(r))
    assert np.linalg.norm(back - r) < 4e-16 * 8 * np.linalg.norm(r)
    assert geodetic_from_ecef(r)[0] == pytest.approx(lat, abs=1e-14)
    assert geodetic_from_ecef(r)[2] == pytest.approx(h, abs=1e-7)


def test_axes_of_the_ellipsoid():
    """Equator and poles by definition of the ellipsoid: a and b = a (1 - f) = 6356752.3142 m."""
    np.testing.assert_allclose(ecef_from_geodetic(0.0, 0.0, 0.0), [WGS84_A, 0.0, 0.0], atol=1e-8)
    r = ecef_from_geodetic(np.pi / 2, 0.3, 10.0)
    np.testing.assert_allclose(r, [0.0, 0.0, 6356752.3142 + 10.0], atol=1e-4)


@given(LAT, LON)
def test_ned_axes_are_the_derivatives_of_position(lat, lon):
    C = rotation_e_from_n(lat, lon)
    np.testing.assert_allclose(C.T @ C, np.eye(3), atol=1e-15)
    assert np.linalg.det(C) == pytest.approx(1.0, abs=1e-14)
    d = 1e-6
    north = ecef_from_geodetic(lat + d, lon, 0.0) - ecef_from_geodetic(lat - d, lon, 0.0)
    down = ecef_from_geodetic(lat, lon, -1.0) - ecef_from_geodetic(lat, lon, 0.0)
    np.testing.assert_allclose(north / np.linalg.norm(north), C[:, 0], atol=2e-9)
    np.testing.assert_allclose(down, C[:, 2], atol=4e-9)


def normal_gravity(lat):
    """Somigliana's normal gravity on the ellipsoid, NGA.STND.0036 4-1 with WGS-84's constants."""
    gamma_e, k, e2 = 9.7803253359, 0.00193185265241, 6.69437999013e-3
    s2 = np.sin(lat) ** 2
    return gamma_e * (1 + k * s2) / np.sqrt(1 - e2 * s2)


@pytest.mark.parametrize("lat_deg", [-90, -60, -30, 0, 10, 45, 70, 90])
def test_gravity_against_somigliana(lat_deg):
    """Equal but for J4, which contributes 5 |J4| GM/a^2 P4(sin lat) to first order.

    J4 of the normal field is -2.37091e-6 (NGA.STND.0036); what is then left is J6 (6.08e-9) and
    flattening times J4, together below 2e-6 m/s2.
    """
    lat = np.radians(lat_deg)
    r = ecef_from_geodetic(lat, 0.4, 0.0)
    g_n = rotation_e_from_n(lat, 0.4).T @ gravity(r)
    s = np.sin(geodetic_from_ecef(r)[0])
    p4 = (35 * s**4 - 30 * s**2 + 3) / 8
    j4_term = 5 * -2.37091e-6 * GM_EARTH / WGS84_A**2 * p4
    assert g_n[2] == pytest.approx(normal_gravity(lat) + j4_term, abs=2e-6)
    assert abs(g_n[2] - normal_gravity(lat)) < 1.2e-4
    assert abs(g_n[1]) < 1e-14
    # normal gravity is vertical on its level ellipsoid; J4 tilts it by less than its size
    assert abs(g_n[0]) < 1.2e-4


def test_gravity_is_a_gradient_field():
    """The curl of gravity vanishes and its divergence is 2 W^2 (Laplace + centrifugal)."""
    r = ecef_from_geodetic(0.7, 2.0, 8000.0)
    step = 10.0 * np.eye(3)
    D = np.stack([(gravity(r + s) - gravity(r - s)) / 20.0 for s in step], axis=1)
    np.testing.assert_allclose(D, D.T, atol=1e-14)
    assert np.trace(D) == pytest.approx(2 * OMEGA_EARTH**2, abs=1e-14)
    assert np.abs(D - gravity_gradient(r)).max() < 1e-8  # J2 part, see the docstring
    assert np.abs(gravity_gradient(r)).max() > 2e-6
