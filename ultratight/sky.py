"""The sky of a scenario: which sets the satellites use, where they stand, what they say.

Also what lies between them and the antenna: the atmosphere of the broadcast and standard models,
added to the truth where the scenario has it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from signals import satellites
from signals.atmosphere import ionosphere_delay_m, troposphere_delay_m
from signals.code_start import nominal, symbol_span
from signals.constants import C_MPS, GPS_L1_HZ, OMEGA_EARTH
from signals.navigation_message import lnav_bits
from signals.noise import generator
from signals.nominal import galileo_24, nominal_24
from signals.propagation import SignalState, elevation_azimuth
from signals.rinex import read_navigation
from signals.satellites import TOE, Constellation
from signals.signal_row import Signal
from ultratight.ins.earth import geodetic_from_ecef
from ultratight.scenario import InvalidInput, Scenario
from ultratight.tables import Disturbance
from ultratight.tracking.channels import Channels

_TYPICAL_LIGHT_TIME_S = 0.075


def constellation(s: Scenario) -> Constellation:
    """The ephemerides of a scenario: one healthy set per satellite, that of its start.

    Raises
    ------
    InvalidInput
        A navigation file that cannot be used, or no ephemeris at the start.
    """
    try:
        if s.constellation in _BUILT_IN:
            return _built_in(s.constellation, s.start_week, s.start_tow_s)
        return _at_start(read_navigation(Path(s.constellation)), s.start_week, s.start_tow_s)
    except (ValueError, OSError) as error:
        raise InvalidInput(f"constellation: {error}{other_sky(s)}") from None


_BUILT_IN: dict[str, Callable[[int, float], Constellation]] = {
    "embedded": lambda week, tow_s: satellites.embedded(),
    "nominal-24": nominal_24,
    "galileo-24": galileo_24,
}


@lru_cache(maxsize=8)
def _built_in(name: str, week: int, tow_s: float) -> Constellation:
    """The runs of a sweep have the same; its arrays cannot be written to."""
    sky = _at_start(_BUILT_IN[name](week, tow_s), week, tow_s)
    for array in vars(sky).values():
        if isinstance(array, np.ndarray):
            array.flags.writeable = False
    return sky


def _at_start(sky: Constellation, week: int, tow_s: float) -> Constellation:
    """One set per satellite; ValueError at a time without any."""
    sky.select(week, tow_s)
    return _one_set_each(sky, week, tow_s)


def other_sky(s: Scenario) -> str:
    """What to do about the sky of one day."""
    if s.constellation in ("nominal-24", "galileo-24"):
        return ""
    return '; for other places and dates: constellation = "nominal-24", or --nav FILE'


def _one_set_each(sky: Constellation, week: int, tow_s: float) -> Constellation:
    chosen = [sky.choose(week, tow_s, int(p)) for p in np.unique(sky.prn)]
    keep = [i for i in chosen if i >= 0]
    arrays = {
        field.name: getattr(sky, field.name)[keep]
        for field in dataclasses.fields(sky)
        if isinstance(getattr(sky, field.name), np.ndarray)
    }
    return dataclasses.replace(sky, **arrays)


def valid_until_s(sky: Constellation, prn: int, s: Scenario) -> float:
    """Time since the start at which the satellite's set is 2 h from its toe [s]."""
    row = sky.rows(np.flatnonzero(sky.prn == prn)[:1], s.start_week)[0]
    return float(row[TOE]) + satellites.MAX_AGE_S - s.start_tow_s


def look(
    sky: Constellation, prn: int, week: int, tow_s: np.ndarray, r_antenna: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Elevation and azimuth (n,) [rad] of a satellite from r_antenna (n, 3) at GPS times (n,)."""
    light = np.full(len(tow_s), _TYPICAL_LIGHT_TIME_S)
    for _ in range(2):  # the second time exact to 1e-9 s
        r = sky.at(week, tow_s - light, prn)[0]
        c, s = np.cos(OMEGA_EARTH * light), np.sin(OMEGA_EARTH * light)
        r = np.stack([c * r[:, 0] + s * r[:, 1], c * r[:, 1] - s * r[:, 0], r[:, 2]], axis=1)
        distance = np.linalg.norm(r - r_antenna, axis=1)
        light = distance / C_MPS
    return elevation_azimuth(r_antenna, (r - r_antenna) / distance[:, None])


def stands_between(
    s: Scenario,
    sky: Constellation,
    prn: np.ndarray,
    t_s: np.ndarray,
    r_antenna: np.ndarray,
    sector: Disturbance,
) -> np.ndarray:
    """Which satellites (n,) stand in the sector of a disturbance, seen from r_antenna (1, 3).

    t_s (1,): GPS time since the start.
    """
    low, high = sector.elevation_deg or (-90.0, 90.0)
    first, last = sector.azimuth_deg or (0.0, 360.0)
    width = (last - first) % 360.0 or 360.0
    inside = np.empty(prn.size, dtype=np.bool_)
    for i, p in enumerate(prn.tolist()):
        el, az = np.degrees(look(sky, p, s.start_week, s.start_tow_s + t_s, r_antenna))[:, 0]
        inside[i] = low <= el <= high and (az - first) % 360.0 <= width
    return inside


def symbols(
    s: Scenario,
    seed: int,
    sky: Constellation,
    signals: list[Signal],
    prn: np.ndarray,
    facts: Channels,
    t_s: np.ndarray,
) -> tuple[int, np.ndarray]:
    """Number of the first symbol, and the symbols (n_channel, n_symbol) that can be received.

    Overlays of pilots; LNAV as the satellites send it, or random data by the scenario's
    ``data_bits``, whatever other signals there are.
    """
    first, n = symbol_span(s.start_tow_s, t_s, of=facts.nominal)
    out = np.ones((len(signals), n), dtype=np.int8)
    for i, (row, p) in enumerate(zip(signals, prn.tolist(), strict=True)):
        own, count = symbol_span(s.start_tow_s, t_s, of=nominal([row]))
        if row.pilot:
            values = facts.pilot_symbols(i, np.arange(own, own + count))
        elif s.data_bits == "random":
            stream = f"data-bits.{row.channel(p).removesuffix(':L1CA')}"
            values = 1 - 2 * generator(seed, stream).integers(0, 2, count)
        else:
            # bit 0 is the one under way at the start, see `code_phase_origin`
            bit_hz = row.chip_rate_hz / row.symbol_chips
            sent_s = (math.floor(s.start_tow_s * bit_hz) + own) / bit_hz
            try:
                values = lnav_bits(sky, p, s.start_week, sent_s, count)
            except ValueError as error:
                raise InvalidInput(f"data_bits: {error}") from None
        out[i, own - first : own - first + count] = values
    return first, out


def with_atmosphere(
    s: Scenario,
    sky: Constellation,
    prn: np.ndarray,
    facts: Channels,
    r_antenna: np.ndarray,
    state: SignalState,
) -> SignalState:
    """The truth with the delays of the scenario's atmosphere; r_antenna (n_node, 3) at its nodes.

    The ionosphere delays the code and advances the carrier, by 1 / f^2 (IS-GPS-200 20.3.3.3.3.3),
    the troposphere delays both.  Linear
    between the nodes: in 5 ms the rates change by 1e-8 m/s.
    """
    a = s.atmosphere
    if not (a.ionosphere or a.troposphere):
        return state
    tow_s = s.start_tow_s + state.t_s
    lat, lon, h = geodetic_from_ecef(r_antenna)
    code, carrier = state.code_phase_chips.copy(), state.carrier_phase_cycles.copy()
    for i, p in enumerate(prn.tolist()):
        el, az = look(sky, p, s.start_week, tow_s, r_antenna)
        iono, tropo = np.zeros(len(tow_s)), np.zeros(len(tow_s))
        if a.ionosphere:
            alpha, beta = sky.iono_utc.alpha, sky.iono_utc.beta
            iono = ionosphere_delay_m(lat, lon, az, el, tow_s, alpha, beta)
            iono *= (GPS_L1_HZ / facts.carrier_hz[i]) ** 2
        if a.troposphere:
            tropo = troposphere_delay_m(lat, h, el)
        for phase, per_m, delay in (
            (code, facts.chip_rate_hz[i] / C_MPS, tropo + iono),
            (carrier, facts.carrier_hz[i] / C_MPS, tropo - iono),
        ):
            phase[i, :, 0] -= per_m * delay[:-1]
            phase[i, :, 1] -= per_m * np.diff(delay) / np.diff(state.t_s)
    return state._replace(code_phase_chips=code, carrier_phase_cycles=carrier)
