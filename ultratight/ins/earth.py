"""The Earth: WGS-84 ellipsoid, its frames and its gravity.

Notation of Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
2nd ed. (2013), chapter 2.  Latitude and longitude are geodetic and in radians, heights
ellipsoidal and in metres; n is north-east-down.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from signals.compiled import borrowing, kernel
from signals.constants import GM_EARTH, OMEGA_EARTH, WGS84_A, WGS84_E2, WGS84_F, WGS84_J2


def ecef_from_geodetic(lat: ArrayLike, lon: ArrayLike, h: ArrayLike) -> np.ndarray:
    """ECEF position (..., 3) [m] of geodetic coordinates (Groves 2.112)."""
    lat, lon, h = np.broadcast_arrays(*(np.asarray(a, float) for a in (lat, lon, h)))
    radius_e = WGS84_A / np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    p = (radius_e + h) * np.cos(lat)
    z = ((1.0 - WGS84_E2) * radius_e + h) * np.sin(lat)
    return np.stack([p * np.cos(lon), p * np.sin(lon), z], axis=-1)


def geodetic_from_ecef(r: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Latitude, longitude [rad] and height [m] of ECEF positions (..., 3).

    Bowring's iteration (Survey Review 28, 1985) on the reduced latitude beta; four rounds reach
    the rounding error from the deep ocean to far beyond the GNSS orbits.
    """
    x, y, z = np.moveaxis(np.asarray(r, float), -1, 0)
    p = np.hypot(x, y)
    b = WGS84_A * (1.0 - WGS84_F)
    lat = np.arctan2(z, p * (1.0 - WGS84_E2))
    for _ in range(4):
        beta = np.arctan2((1.0 - WGS84_F) * np.sin(lat), np.cos(lat))
        lat = np.arctan2(
            z + WGS84_E2 / (1.0 - WGS84_E2) * b * np.sin(beta) ** 3,
            p - WGS84_E2 * WGS84_A * np.cos(beta) ** 3,
        )
    # this form of the height has no singularity, neither at the poles nor at the equator
    normal = WGS84_A * np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    return lat, np.arctan2(y, x), p * np.cos(lat) + z * np.sin(lat) - normal


def rotation_e_from_n(lat: ArrayLike, lon: ArrayLike) -> np.ndarray:
    """C_n_e (..., 3, 3): takes north-east-down components to ECEF (Groves 2.150, transposed)."""
    lat, lon = np.broadcast_arrays(np.asarray(lat, float), np.asarray(lon, float))
    slat, clat, slon, clon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    rows = [
        [-slat * clon, -slon, -clat * clon],
        [-slat * slon, clon, -clat * slon],
        [clat, np.zeros_like(lat), -slat],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


# --- kernels --------------------------------------------------------------------------------


@borrowing
def gravity_at(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Gravity (3) [m/s2] at x, y, z in ECEF axes: J2 gravitation + centrifugal (Groves 2.142).

    Beside the WGS-84 normal field it lacks the terms from J4 on: at most 5 |J4| GM/a^2, that is
    1.2e-4 m/s2.
    """
    r2 = x * x + y * y + z * z
    k = -GM_EARTH / (r2 * math.sqrt(r2))
    j = 1.5 * WGS84_J2 * WGS84_A * WGS84_A / r2
    s2 = 5.0 * z * z / r2
    horizontal = k * (1.0 + j * (1.0 - s2)) + OMEGA_EARTH * OMEGA_EARTH
    return horizontal * x, horizontal * y, k * (1.0 + j * (3.0 - s2)) * z


@kernel
def gravity(r: np.ndarray) -> np.ndarray:
    """`gravity_at` r (3,) -> (3,)."""
    g = np.empty(3)
    g[0], g[1], g[2] = gravity_at(r[0], r[1], r[2])
    return g


@kernel
def gravity_gradient(r: np.ndarray) -> np.ndarray:
    """d gravity / d r (3, 3) [1/s2]: point mass + centrifugal (Groves 14.30 with both terms).

    The J2 part, below 1e-8 1/s2, is left out: over a fix interval it is nothing.
    """
    G = np.empty((3, 3))
    gravity_gradient_into(r, G)
    return G


@borrowing
def gravity_gradient_into(r: np.ndarray, G: np.ndarray) -> None:
    """`gravity_gradient` written to G (3, 3)."""
    r2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    k = GM_EARTH / (r2 * math.sqrt(r2))
    for i in range(3):
        for j in range(3):
            G[i, j] = 3.0 * k * r[i] * r[j] / r2
        G[i, i] -= k
    G[0, 0] += OMEGA_EARTH * OMEGA_EARTH
    G[1, 1] += OMEGA_EARTH * OMEGA_EARTH
