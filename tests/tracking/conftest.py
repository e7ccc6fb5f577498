"""Tracks of a receiver whose place is known, made from orbits and message without any samples."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from signals import satellites
from signals.code_start import code_phase_origin
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.navigation_message import lnav_bits
from signals.propagation import elevation_azimuth, pseudorange
from ultratight.ins.earth import ecef_from_geodetic
from ultratight.tracking.from_samples import Tracks

PLACE = ecef_from_geodetic(np.radians(39.9), np.radians(116.4), 60.0)


def seen_at(sky: satellites.Constellation, week: int, tow_s: float, mask_deg: float) -> list[int]:
    """PRNs above a mask."""
    prns, rows = sky.select(week, tow_s)
    u = [pseudorange(row, tow_s, PLACE, np.zeros(3), 0.0, 0.0)[2:] for row in rows]
    elevation, _ = elevation_azimuth(PLACE, np.array(u))
    return [int(p) for p, e in zip(prns, elevation, strict=True) if e > np.radians(mask_deg)]


def _tracks(
    duration_s: float,
    *,
    tow_s: float = 475_220.0,
    week: int = 2149,
    prns: list[int] | None = None,
    v: tuple[float, float, float] = (0.0, 0.0, 0.0),
    clock_m: float = 4000.0,
    drift_mps: float = 30.0,
    cn0_dbhz: float = 45.0,
    code_noise_m: float = 0.0,
    delay_m: dict[int, float] | Callable[[np.ndarray, np.ndarray, float], np.ndarray] | None = None,
    edge_off: dict[int, int] | None = None,
    sky: satellites.Constellation | None = None,
    seed: int = 1,
) -> Tracks:
    """Channels of a straight motion; the receiver's clock reads tow_s at sample 0.

    ``delay_m``: what is added to pseudoranges, by PRN or from (line of sight, r, tow).
    ``edge_off``: periods by which a channel's bits are taken to begin too late.
    """
    rng = np.random.default_rng(seed)
    sky = satellites.embedded() if sky is None else sky
    prns = seen_at(sky, week, tow_s, 10.0) if prns is None else prns
    _, rows = sky.select(week, tow_s)
    row_of = dict(zip(sky.select(week, tow_s)[0].tolist(), rows, strict=True))
    grid = np.arange(-0.01, duration_s + 0.01, 0.01)
    parts: list[list[np.ndarray]] = []
    for i, prn in enumerate(prns):
        out = np.empty((len(grid), 2))
        for k, t in enumerate(grid):
            b = clock_m + drift_mps * t
            r = PLACE + np.array(v) * t
            rho, rate, *u = pseudorange(row_of[prn], tow_s + t, r, np.array(v), b, drift_mps)
            extra = 0.0
            if callable(delay_m):
                extra = float(delay_m(np.array(u), r, tow_s + t))
            elif delay_m:
                extra = delay_m.get(prn, 0.0)
            out[k] = rho + extra, rate
        # 10 ms chords of a parabola with less than 1 m/s^2 are 13 um off
        fine = np.arange(grid[0], grid[-1], 1e-3)
        rho_m = np.interp(fine, grid, out[:, 0])
        chips = code_phase_origin(tow_s) + CA_CHIP_RATE_HZ * (fine - rho_m / C_MPS)
        ends = np.arange(np.ceil(chips[0] / 1023), np.floor(chips[-1] / 1023))
        ends = ends[1023 * ends > np.interp(0.0, fine, chips) + 1023]
        t_end = np.interp(1023 * ends, chips, fine)
        keep = t_end < duration_s
        ends, t_end = ends[keep].astype(int), t_end[keep]
        period = ends - 1
        bit = period // 20
        first_tow = np.floor(tow_s * 50) * 0.02 + 0.02 * bit[0]
        data = lnav_bits(sky, prn, week, round(first_tow * 50) * 0.02, bit[-1] - bit[0] + 1)
        sign = -1.0 if i % 2 else 1.0
        amplitude = np.sqrt(2.0 * 10 ** (cn0_dbhz / 10) * 1e-3)
        prompt = sign * amplitude * data[bit - bit[0]]
        noise = rng.standard_normal((2, len(prompt)))
        iq = np.zeros((len(prompt), 3), complex)
        iq[:, 1] = prompt + noise[0] + 1j * noise[1]
        away = _first_order(rng, len(prompt)) * code_noise_m * CA_CHIP_RATE_HZ / C_MPS
        shift = (edge_off or {}).get(prn, 0) - 20 * (bit[0] - 7 * i)
        cycles = -np.interp(t_end, fine, rho_m) * GPS_L1_HZ / C_MPS + (0.5 if i % 2 else 0.0)
        rate = np.interp(t_end, grid, out[:, 1])
        parts.append(
            [
                np.full(len(ends), i), period + shift, t_end, iq, -rate * GPS_L1_HZ / C_MPS,
                1023.0 * (ends + shift) + away, cycles,
            ]
        )  # fmt: skip
    columns: Any = [np.concatenate(c) for c in zip(*parts, strict=True)]
    n = len(prns)
    return Tracks(
        np.array(prns, np.int64), np.full(n, 0.995), *columns, np.ones(n, bool), np.ones(n),
        np.full(n, cn0_dbhz), [(0.1, i, "phase lock", "made") for i in range(n)],
    )  # fmt: skip


def _first_order(rng: np.random.Generator, n: int) -> np.ndarray:
    """Unit noise of a first-order loop of 1 Hz, every millisecond."""
    from scipy.signal import lfilter

    a = np.exp(-4.0 * 1e-3)
    return lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], rng.standard_normal(n + 2000))[2000:]


@pytest.fixture(scope="session")
def make_tracks() -> Callable[..., Tracks]:
    return _tracks


@pytest.fixture(scope="session")
def place() -> np.ndarray:
    return PLACE
