"""Delay of the L1 code in ionosphere and troposphere, as broadcast and standard models have it.

Ionosphere: Klobuchar's model with the coefficients of the navigation message (IS-GPS-200
20.3.3.5.2.5, figure 20-4).  The carrier is advanced by what the code is delayed.

Troposphere: zenith delays of Saastamoinen (Bibl. Int. Union Geod. Geophys. 1972; hydrostatic with
the constant of Davis et al., Radio Science 20, 1985) in the standard atmosphere, mapped to the
elevation with Black and Eisner (J. Geophys. Res. 89, 1984; RTCA DO-229D A.4.2.4).
"""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import kernel
from signals.constants import C_MPS

LOWEST_ELEVATION = math.radians(3.0)
"""The mapping of the troposphere is held below this elevation"""
RELATIVE_HUMIDITY = 0.5


def ionosphere_delay_m(
    lat: float | np.ndarray,
    lon: float | np.ndarray,
    az: float | np.ndarray,
    el: float | np.ndarray,
    tow_s: float | np.ndarray,
    alpha: tuple[float, ...] | np.ndarray,
    beta: tuple[float, ...] | np.ndarray,
) -> np.ndarray:
    """Delay of the L1 code in the ionosphere [m].

    Parameters
    ----------
    lat, lon
        Geodetic position of the antenna [rad].
    az, el
        Direction of the satellite, azimuth from north through east, elevation [rad].
    tow_s
        GPS time of week [s].
    alpha, beta : (4,)
        Coefficients in seconds per power of a semicircle (`IonoUtc`).

    Returns
    -------
    Of the shape to which the first five broadcast.

    Raises
    ------
    ValueError
        Coefficients that are not four finite numbers.
    """
    a, b = np.asarray(alpha, dtype=np.float64), np.asarray(beta, dtype=np.float64)
    for name, given in (("alpha", a), ("beta", b)):
        if given.shape != (4,) or not np.isfinite(given).all():
            raise ValueError(f"{name} is {given}: expected four finite numbers")
    arrays = np.broadcast_arrays(
        *(np.asarray(x, dtype=np.float64) for x in (lat, lon, az, el, tow_s))
    )
    flat = np.stack([x.ravel() for x in arrays])
    out = np.empty(flat.shape[1])
    _klobuchar_all(flat, a, b, out)
    return out.reshape(arrays[0].shape)


def troposphere_delay_m(
    lat: float | np.ndarray,
    height_m: float | np.ndarray,
    el: float | np.ndarray,
    relative_humidity: float = RELATIVE_HUMIDITY,
) -> np.ndarray:
    """Delay of code and carrier in the troposphere [m].

    Parameters
    ----------
    lat
        Geodetic latitude [rad].
    height_m
        Height above the ellipsoid, taken for that above sea level [m].
    el
        Elevation of the satellite [rad]; below 3 deg the mapping stays that of 3 deg.
    relative_humidity
        0 to 1, at every height.

    Returns
    -------
    Of the shape to which the first three broadcast.

    Raises
    ------
    ValueError
        A humidity outside 0 to 1.
    """
    if not 0.0 <= relative_humidity <= 1.0:
        raise ValueError(f"relative_humidity = {relative_humidity}: expected 0 to 1")
    arrays = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in (lat, height_m, el)))
    flat = np.stack([x.ravel() for x in arrays])
    out = np.empty(flat.shape[1])
    _saastamoinen_all(flat, relative_humidity, out)
    return out.reshape(arrays[0].shape)


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def klobuchar(
    lat: float,
    lon: float,
    az: float,
    el: float,
    tow_s: float,
    alpha: np.ndarray,
    beta: np.ndarray,
) -> float:
    """Delay on L1 [m] at lat, lon, towards az, el [rad]; letters of figure 20-4, semicircles."""
    e = el / math.pi
    psi = 0.0137 / (e + 0.11) - 0.022
    phi_i = min(max(lat / math.pi + psi * math.cos(az), -0.416), 0.416)
    lambda_i = lon / math.pi + psi * math.sin(az) / math.cos(math.pi * phi_i)
    phi_m = phi_i + 0.064 * math.cos(math.pi * (lambda_i - 1.617))
    t = (43_200.0 * lambda_i + tow_s) % 86_400.0
    period = beta[0] + phi_m * (beta[1] + phi_m * (beta[2] + phi_m * beta[3]))
    amplitude = alpha[0] + phi_m * (alpha[1] + phi_m * (alpha[2] + phi_m * alpha[3]))
    x = 2.0 * math.pi * (t - 50_400.0) / max(period, 72_000.0)
    seconds = 5e-9
    if abs(x) < 1.57:
        seconds += max(amplitude, 0.0) * (1.0 - x * x / 2.0 + x**4 / 24.0)
    return C_MPS * (1.0 + 16.0 * (0.53 - e) ** 3) * seconds


@kernel
def saastamoinen(lat: float, height_m: float, el: float, relative_humidity: float) -> float:
    """Delay [m] towards elevation el [rad] in the standard atmosphere.

    Pressure [hPa] and temperature [K] of ICAO's standard atmosphere to the tropopause (11 km) and
    above it; saturation pressure of water vapour after Magnus.
    """
    h = min(max(height_m, -1000.0), 11_000.0)
    temperature = 288.15 - 6.5e-3 * h
    pressure = 1013.25 * (temperature / 288.15) ** 5.25588
    if height_m > 11_000.0:
        pressure *= math.exp(-(height_m - 11_000.0) / 6341.62)
    celsius = temperature - 273.15
    vapour = relative_humidity * 6.1094 * math.exp(17.625 * celsius / (celsius + 243.04))
    if height_m > 11_000.0:
        vapour = 0.0
    gravity = 1.0 - 0.00266 * math.cos(2.0 * lat) - 0.28e-6 * height_m
    zenith = 0.0022768 * pressure / gravity
    zenith += 0.002277 * (1255.0 / temperature + 0.05) * vapour
    sine = math.sin(max(el, LOWEST_ELEVATION))
    return zenith * 1.001 / math.sqrt(0.002001 + sine * sine)


@kernel
def _klobuchar_all(x: np.ndarray, alpha: np.ndarray, beta: np.ndarray, out: np.ndarray) -> None:
    """Rows lat, lon, az, el, tow of x (5, n) into out (n,)."""
    for k in range(out.shape[0]):
        out[k] = klobuchar(x[0, k], x[1, k], x[2, k], x[3, k], x[4, k], alpha, beta)


@kernel
def _saastamoinen_all(x: np.ndarray, relative_humidity: float, out: np.ndarray) -> None:
    """Rows lat, height, el of x (3, n) into out (n,)."""
    for k in range(out.shape[0]):
        out[k] = saastamoinen(x[0, k], x[1, k], x[2, k], relative_humidity)
