"""Samples without a satellite, against least squares written out."""

from __future__ import annotations

import numpy as np
import pytest

from signals.codes import GPS_L1CA
from signals.recording import Recording
from ultratight.tracking.fine_acquisition import Fine
from ultratight.tracking.signal_removal import _DELAYS_CHIPS, without

FS = 2.5e6


def at(code_phase_chips: float, doppler_hz: float) -> Fine:
    return Fine(np.array([code_phase_chips]), np.array([doppler_hz]), np.array([50.0]))


@pytest.mark.nojit
@pytest.mark.parametrize(("real", "if_hz"), [(False, 1.0e5), (True, 6.0e5)])
def test_what_is_left_is_the_residual_of_least_squares(real: bool, if_hz: float) -> None:
    """Noise, as if a satellite were in it: every period's projection, to float32's rounding."""
    rng, n0, n = np.random.default_rng(4), 1000, 6000
    x = rng.standard_normal(n0 + n if real else (n0 + n, 2)).astype(np.float32)
    recording = Recording(x, FS, if_hz, 1.0)
    left = without(recording, GPS_L1CA, [5], at(123.4, 1234.0), n0, n0 + n).samples(n0, n0 + n)
    z = recording.samples(n0, n0 + n).astype(float)
    z = z[:, 0] + 1j * z[:, 1]
    k = np.arange(n)
    code = 123.4 + 1.023e6 * (1.0 + 1234.0 / 1575.42e6) * k / FS
    carrier = np.exp(2j * np.pi * (if_hz * (n0 + k) + 1234.0 * k) / FS)
    rows = [GPS_L1CA.chips(5)[np.floor(code - d).astype(int) % 1023] for d in _DELAYS_CHIPS]
    for period in range(4):
        own = np.flatnonzero(np.floor(code / 1023) == period)
        if own.size:
            replicas = (np.array(rows)[:, own] * carrier[own]).T
            fitted = replicas @ np.linalg.lstsq(replicas, z[own], rcond=None)[0]
            z[own] -= 2.0 * fitted.real if real else fitted
    np.testing.assert_allclose(left[:, 0], z.real, atol=1e-5)
    np.testing.assert_allclose(left[:, 1], z.imag, atol=1e-5)


def test_a_satellite_is_gone() -> None:
    """Without noise, through a filter of three samples, with a replica 0.02 chips off.

    2 % of the replica's samples are of the wrong chip, half of these of the other sign: 4 % of the
    power; its neighbours hold what the filter did.
    """
    k = np.arange(25_000)
    code = 700.0 + 1.023e6 * k / FS
    z = GPS_L1CA.chips(9)[np.floor(code).astype(int) % 1023] * np.exp(2j * np.pi * 500.0 * k / FS)
    z = np.convolve(z, [0.25, 0.5, 0.25], "same")
    pairs = np.stack([z.real, z.imag], axis=1).astype(np.float32)
    recording = Recording(pairs, FS, 0.0, 1.0)
    left = without(recording, GPS_L1CA, [9], at(700.02, 501.0), 0, 25_000).samples(0, 25_000)
    assert np.mean(left**2) < 0.04 * np.mean(pairs**2)
