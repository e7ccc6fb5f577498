"""From satellite to antenna: pseudorange, line of sight, and the phases that arrive."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from signals.arcs import MIDDLE, arc_at, arc_index, arcs
from signals.code_start import Nominal, code_phase_origin, nominal
from signals.codes import GPS_L1CA
from signals.compiled import borrowing
from signals.constants import C_MPS, OMEGA_EARTH, WGS84_A, WGS84_E2, WGS84_F
from signals.satellites import N_ELEMENT, orbit

MAX_PIECE_S = 5e-3
"""Longest piece of a `SignalState`: the cubic then follows 10 000 m/s^4 to 0.02 um"""


class SignalState(NamedTuple):
    """The truth as it reaches the antenna: phases of every channel in pieces of receiver time.

    Inside piece p, with dt = t - t_s[p], a phase is c0 + c1 dt + c2 dt^2 + c3 dt^3.

        code_phase_chips     = phi0 + f_chip (t - rho / c)      phi0: `code_phase_origin`
        carrier_phase_cycles = -rho f / c

    with f and f_chip those of the channel's signal.  The code phase is absolute: it is a multiple
    of the symbol's chips (L1 C/A: 20460) at each symbol's edge.
    """

    t_s: np.ndarray  # (n_piece + 1,) uniform nodes, receiver time since the start [s]
    code_phase_chips: np.ndarray  # (n_channel, n_piece, 4) c0 ... c3
    carrier_phase_cycles: np.ndarray  # (n_channel, n_piece, 4) c0 ... c3
    cn0_dbhz: np.ndarray  # (n_channel, n_piece)
    valid: np.ndarray  # (n_channel, n_piece) bool
    symbols: np.ndarray  # (n_channel, n_symbol) int8 of +-1
    first_symbol: int  # code phase x carries symbols[:, floor(x / symbol_chips) - first_symbol]


def signal_state(
    rows: np.ndarray,
    start_tow_s: float,
    t_s: np.ndarray,
    r_antenna: np.ndarray,
    v_antenna: np.ndarray,
    clock_m: np.ndarray,
    clock_rate_mps: np.ndarray,
    cn0_dbhz: np.ndarray,
    symbols: np.ndarray,
    first_symbol: int,
    valid: np.ndarray | None = None,
    of: Nominal | None = None,
) -> SignalState:
    """Turn motion and clock at the nodes into the phases at the antenna (Hermite cubics).

    Parameters
    ----------
    rows : (n_channel, N_ELEMENT)
        Ephemerides from `Constellation.select`.
    start_tow_s
        GPS time of week at t_s = 0 by the receiver's clock [s].
    t_s : (n_node,)
        Uniform nodes, at most 5 ms apart.
    r_antenna, v_antenna : (n_node, 3)
        Position [m] and velocity [m/s] in ECEF at the nodes; an acceleration may jump at a node.
    clock_m, clock_rate_mps : (n_node,)
        Receiver clock (`clock.simulate`).
    cn0_dbhz : (n_channel,), (n_channel, n_piece) or (n_channel, n_node)
        A piece between two nodes takes the mean of both.
    symbols : (n_channel, n_symbol) of +-1
        Must cover the run: see `symbol_span`.
    first_symbol
        Number of symbols[:, 0].
    valid : (n_channel,), (n_channel, n_piece) or (n_channel, n_node) of bool, optional
        Channels that are received (elevation mask, blockage); a piece needs both its nodes.
    of : Nominal, optional
        Carrier, chip rate and symbol length of each channel; L1 C/A where left out.

    Raises
    ------
    ValueError
        Shapes that do not fit, nodes that are not uniform or too far apart, numbers that are not
        finite, or symbols that do not cover the run.
    """
    t_s = np.ascontiguousarray(t_s, dtype=np.float64)
    rows = np.ascontiguousarray(rows, dtype=np.float64)
    n_channel, n_node = len(rows), len(t_s)
    _check_nodes(t_s)
    if rows.shape != (n_channel, N_ELEMENT):
        raise ValueError(f"rows has shape {rows.shape}, expected (n_channel, {N_ELEMENT})")
    motion = []
    for name, array, shape in (
        ("r_antenna", r_antenna, (n_node, 3)),
        ("v_antenna", v_antenna, (n_node, 3)),
        ("clock_m", clock_m, (n_node,)),
        ("clock_rate_mps", clock_rate_mps, (n_node,)),
    ):
        array = np.ascontiguousarray(array, dtype=np.float64)
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} contains a number that is not finite")
        motion.append(array)
    cn0 = _per_piece("cn0_dbhz", np.asarray(cn0_dbhz, dtype=np.float64), n_channel, n_node)
    on = np.ones(n_channel, dtype=bool) if valid is None else np.asarray(valid, dtype=bool)
    on = _per_piece("valid", on, n_channel, n_node)
    if not np.isfinite(cn0[on]).all():
        raise ValueError("cn0_dbhz contains a number that is not finite on a valid piece")
    code = np.empty((n_channel, n_node - 1, 4))
    carrier = np.empty_like(code)
    sky = arcs(rows, start_tow_s + t_s[0], start_tow_s + t_s[-1])
    of = nominal([GPS_L1CA] * n_channel) if of is None else of
    if len(of.carrier_hz) != n_channel:
        raise ValueError(f"of has {len(of.carrier_hz)} channels, expected {n_channel}")
    origin = code_phase_origin(start_tow_s, of)
    rates = (origin, of.chip_rate_hz, of.carrier_hz)
    room = np.empty((4, n_channel))
    _pieces(sky, start_tow_s, *rates, t_s, *motion, room, code, carrier)
    signs = np.ascontiguousarray(symbols, dtype=np.int8)
    _check_symbols(signs, first_symbol, code[..., 0], on, of)
    return SignalState(t_s, code, carrier, cn0, on, signs, int(first_symbol))


def elevation_azimuth(r: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Elevation above the ellipsoid's horizon and azimuth from north through east [rad].

    Parameters
    ----------
    r : (..., 3)
        Antenna position in ECEF [m].
    u : (..., 3)
        Unit vectors from the antenna to the satellites; broadcasts with r.
    """
    r = np.asarray(r, dtype=np.float64)
    u = np.asarray(u, dtype=np.float64)
    p = np.hypot(r[..., 0], r[..., 1])
    longitude = np.arctan2(r[..., 1], r[..., 0])
    # Bowring's reduced latitude, iterated: below 1e-12 rad from the ground to GPS orbits
    b = WGS84_A * (1.0 - WGS84_F)
    beta = np.arctan2(WGS84_A * r[..., 2], b * p)
    for _ in range(3):
        latitude = np.arctan2(
            r[..., 2] + WGS84_E2 / (1.0 - WGS84_E2) * b * np.sin(beta) ** 3,
            p - WGS84_E2 * WGS84_A * np.cos(beta) ** 3,
        )
        beta = np.arctan2((1.0 - WGS84_F) * np.sin(latitude), np.cos(latitude))
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    outward = cos_lon * u[..., 0] + sin_lon * u[..., 1]
    east = cos_lon * u[..., 1] - sin_lon * u[..., 0]
    north = cos_lat * u[..., 2] - sin_lat * outward
    up = cos_lat * outward + sin_lat * u[..., 2]
    return np.arctan2(up, np.hypot(north, east)), np.arctan2(east, north) % (2.0 * np.pi)


def _check_nodes(t_s: np.ndarray) -> None:
    if t_s.ndim != 1 or len(t_s) < 2:
        raise ValueError(f"t_s has shape {t_s.shape}, expected (n_node,) with at least 2 nodes")
    step = (t_s[-1] - t_s[0]) / (len(t_s) - 1)
    if not 0.0 < step <= MAX_PIECE_S * (1.0 + 1e-9):
        raise ValueError(f"t_s has steps of {step:g} s, expected more than 0 and at most 0.005 s")
    if not np.abs(np.diff(t_s) - step).max() <= 1e-9:
        raise ValueError("t_s is not uniform: its steps differ by more than 1 ns")


def _per_piece(name: str, values: np.ndarray, n_channel: int, n_node: int) -> np.ndarray:
    """(n_channel, n_piece) from values per channel, per piece or per node."""
    n_piece = n_node - 1
    if values.shape == (n_channel,):
        values = np.repeat(values[:, None], n_piece, axis=1)
    elif values.shape == (n_channel, n_node):
        left, right = values[:, :-1], values[:, 1:]
        values = left & right if values.dtype == bool else 0.5 * (left + right)
    elif values.shape != (n_channel, n_piece):
        raise ValueError(
            f"{name} has shape {values.shape}, expected ({n_channel},), "
            f"({n_channel}, {n_piece}) or ({n_channel}, {n_node})"
        )
    return values


def _check_symbols(
    symbols: np.ndarray, first: int, code: np.ndarray, on: np.ndarray, of: Nominal
) -> None:
    """Refuse symbols that are not signs or do not reach over the valid pieces."""
    if symbols.ndim != 2 or len(symbols) != len(code):
        raise ValueError(f"symbols has shape {symbols.shape}, expected ({len(code)}, n_symbol)")
    if not (np.abs(symbols) == 1).all():
        raise ValueError("symbols contains a value other than +1 and -1")
    if not on.any():
        return
    length = of.symbol_chips[:, None]
    low = math.floor((code / length)[on].min())
    # the last piece ends at most one piece's chips later than its start
    high = math.floor(((code + of.chip_rate_hz[:, None] * MAX_PIECE_S) / length)[on].max())
    if low < first or high >= first + symbols.shape[1]:
        raise ValueError(
            f"symbols cover {first} to {first + symbols.shape[1] - 1}, "
            f"the run needs {low} to {high} (see symbol_span)"
        )


@borrowing(inline="always")
def light_time(
    x: float, y: float, z: float, vx: float, vy: float, vz: float, back: float, tau: float,
    r: np.ndarray,
) -> float:  # fmt: skip
    """Light time to r (3,) from where the satellite is ``back`` seconds after x, y, z [s].

    The Sagnac effect is that of the light time ``tau``: to be iterated.
    """
    sin_a = OMEGA_EARTH * tau  # 6e-6: the next terms of sine and cosine are below 1e-16
    cos_a = 1.0 - 0.5 * sin_a * sin_a
    px = x + vx * back
    py = y + vy * back
    dx = cos_a * px + sin_a * py - r[0]
    dy = cos_a * py - sin_a * px - r[1]
    dz = z + vz * back - r[2]
    return math.sqrt(dx * dx + dy * dy + dz * dz) / C_MPS


@borrowing(inline="always")
def seen(
    satellite: Any, back: float, tau: float, r: np.ndarray, v: np.ndarray, clock_m: float,
    clock_rate_mps: float,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """`pseudorange` of a ``satellite`` as `orbit` gives it, ``back`` seconds later, at light time.

    With s the satellite at transmission, turned into the frame of reception, and u the unit
    vector from antenna to s:

        rho = |s - r| + clock_m - c b_sv(t - tau)
        r'  = u.(R v_s - v) / (1 - u.(w k - R v_s) / c),     k = (s_y, -s_x, 0)
        rho_rate = (r' - c b_sv' (1 - r'/c)) (1 - clock_rate/c) + clock_rate
    """
    x, y, z, vx, vy, vz, clock, clock_rate = satellite
    sin_a = OMEGA_EARTH * tau
    cos_a = 1.0 - 0.5 * sin_a * sin_a
    px = x + vx * back
    py = y + vy * back
    sx = cos_a * px + sin_a * py
    sy = cos_a * py - sin_a * px
    dx, dy, dz = sx - r[0], sy - r[1], z + vz * back - r[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    ux, uy, uz = dx / distance, dy / distance, dz / distance
    wx = cos_a * vx + sin_a * vy
    wy = cos_a * vy - sin_a * vx
    along = ux * wx + uy * wy + uz * vz
    turning = OMEGA_EARTH * (ux * sy - uy * sx)
    approach = along - (ux * v[0] + uy * v[1] + uz * v[2])
    rate = approach / (1.0 - (turning - along) / C_MPS)
    rho = distance + clock_m - C_MPS * clock
    slow = clock_rate_mps / C_MPS
    rho_rate = (rate - clock_rate * (C_MPS - rate)) * (1.0 - slow) + clock_rate_mps
    return rho, rho_rate, ux, uy, uz


@borrowing
def pseudorange(
    row: np.ndarray,
    tow_s: float,
    r: np.ndarray,
    v: np.ndarray,
    clock_m: float,
    clock_rate_mps: float,
) -> tuple[float, float, float, float, float]:
    """Pseudorange [m], its rate [m/s] and line of sight (3) of one satellite, from its elements.

    ``tow_s`` is what the receiver clock reads, GPS time is tow_s - clock_m / c; r (3,), v (3,) are
    the antenna's position and d r / d(GPS time) in ECEF.  The rate is the exact derivative with
    respect to the receiver's time; see `seen`.
    """
    b = clock_m / C_MPS
    tau = 0.075
    # Two evaluations of the orbit: the first, within 20 ms of the time sought, gives that time to
    # 1e-12 s by its own velocity; the second then leaves no error that a double can hold.
    t_at = tow_s - (tau + b)
    lag = tow_s - t_at  # exact, where t_at has been rounded (0.1 us x 800 m/s at 6e5 s)
    x, y, z, vx, vy, vz, _, _ = orbit(row, t_at)
    for _ in range(2):
        tau = light_time(x, y, z, vx, vy, vz, lag - (tau + b), tau, r)
    t_at = tow_s - (tau + b)
    lag = tow_s - t_at
    satellite = orbit(row, t_at)
    x, y, z, vx, vy, vz, _, _ = satellite
    tau = light_time(x, y, z, vx, vy, vz, lag - (tau + b), tau, r)
    return seen(satellite, lag - (tau + b), tau, r, v, clock_m, clock_rate_mps)


@borrowing(inline="always")
def pseudorange_by_arc(
    arc: np.ndarray,
    i: int,
    tow_s: float,
    r: np.ndarray,
    v: np.ndarray,
    clock_m: float,
    clock_rate_mps: float,
) -> tuple[float, float, float, float, float]:
    """`pseudorange` of satellite i of an arc: within 3e-8 m and 1e-9 m/s of it, 6 times as fast."""
    since = tow_s - arc[MIDDLE, i] - clock_m / C_MPS
    tau = 0.075
    x, y, z, vx, vy, vz, _, _ = arc_at(arc, i, since - 0.075)
    for _ in range(2):
        tau = light_time(x, y, z, vx, vy, vz, 0.075 - tau, tau, r)
    return seen(arc_at(arc, i, since - tau), 0.0, tau, r, v, clock_m, clock_rate_mps)


@borrowing
def predict_channels(
    arcs: np.ndarray,
    tow_s: float,
    r: np.ndarray,
    v: np.ndarray,
    clock_m: float,
    clock_rate_mps: float,
    out_rho: np.ndarray,
    out_rate: np.ndarray,
    out_u: np.ndarray,
) -> None:
    """Pseudoranges of all channels of `arcs.arcs` at one time.

    Into out_rho (n_channel,), out_rate (n_channel,), out_u (n_channel, 3); see `pseudorange`.
    """
    arc = arcs[arc_index(arcs, tow_s)]
    for i in range(arc.shape[1]):
        out_rho[i], out_rate[i], out_u[i, 0], out_u[i, 1], out_u[i, 2] = pseudorange_by_arc(
            arc, i, tow_s, r, v, clock_m, clock_rate_mps
        )


@borrowing
def predict_epochs(
    arcs: np.ndarray,
    tow_s: np.ndarray,
    r: np.ndarray,
    v: np.ndarray,
    clock_m: np.ndarray,
    clock_rate_mps: np.ndarray,
    out_rho: np.ndarray,
    out_rate: np.ndarray,
    out_u: np.ndarray,
) -> None:
    """`predict_channels` at each time tow_s (n,), into arrays with n in front."""
    for k in range(tow_s.size):
        predict_channels(
            arcs, tow_s[k], r[k], v[k], clock_m[k], clock_rate_mps[k], out_rho[k], out_rate[k],
            out_u[k],
        )  # fmt: skip


@borrowing
def _pieces(
    arcs: np.ndarray,
    start_tow_s: float,
    origin: np.ndarray,
    chip_rate_hz: np.ndarray,
    carrier_hz: np.ndarray,
    t_s: np.ndarray,
    r: np.ndarray,
    v: np.ndarray,
    clock_m: np.ndarray,
    clock_rate_mps: np.ndarray,
    room: np.ndarray,
    code: np.ndarray,
    carrier: np.ndarray,
) -> None:
    """Hermite cubics of all channels into code, carrier (n_channel, n_piece, 4); room (4, n)."""
    n_piece = len(t_s) - 1
    h = (t_s[n_piece] - t_s[0]) / n_piece
    n = arcs.shape[2]
    y0, m0, y1, m1 = room[0], room[1], room[2], room[3]
    for k in range(n_piece + 1):
        tow_s = start_tow_s + t_s[k]
        arc = arcs[arc_index(arcs, tow_s)]
        here, moving = (r[k, 0], r[k, 1], r[k, 2]), (v[k, 0], v[k, 1], v[k, 2])
        ahead_m, ahead_mps = clock_m[k], clock_rate_mps[k]
        for i in range(n):  # alone in its loop, so that several channels share a register
            y1[i], m1[i], _, _, _ = pseudorange_by_arc(
                arc, i, tow_s, here, moving, ahead_m, ahead_mps
            )
        for i in range(n if k > 0 else 0):
            chips_per_m = chip_rate_hz[i] / C_MPS
            cycles_per_m = carrier_hz[i] / C_MPS
            mean = (y1[i] - y0[i]) / h
            a2 = (3.0 * mean - 2.0 * m0[i] - m1[i]) / h
            a3 = (m0[i] + m1[i] - 2.0 * mean) / (h * h)
            code[i, k - 1, 0] = origin[i] + chip_rate_hz[i] * t_s[k - 1] - chips_per_m * y0[i]
            code[i, k - 1, 1] = chip_rate_hz[i] - chips_per_m * m0[i]
            code[i, k - 1, 2] = -chips_per_m * a2
            code[i, k - 1, 3] = -chips_per_m * a3
            carrier[i, k - 1, 0] = -cycles_per_m * y0[i]
            carrier[i, k - 1, 1] = -cycles_per_m * m0[i]
            carrier[i, k - 1, 2] = -cycles_per_m * a2
            carrier[i, k - 1, 3] = -cycles_per_m * a3
        for i in range(n):
            y0[i], m0[i] = y1[i], m1[i]
