"""GPS satellites from broadcast ephemerides: position, velocity, clock (IS-GPS-200 20.3.3.3-4)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.constants import F_RELATIVITY, GM_GPS, OMEGA_EARTH, WEEK_S

# Columns of a set of elements; letters and units of IS-GPS-200 tables 20-I and 20-II, with
# semicircles already turned into radians (as RINEX has them).
TOE = 0  # [s] of `Constellation.week`
TOC = 1  # [s] of the same week, hence outside [0, 604800) where the clock's own week differs
SQRT_A = 2  # [sqrt(m)]
ECC = 3
M0 = 4  # [rad]
DELTA_N = 5  # [rad/s]
OMEGA0 = 6  # longitude of the node at the start of the week [rad]
OMEGA_DOT = 7  # [rad/s]
I0 = 8  # [rad]
IDOT = 9  # [rad/s]
OMEGA = 10  # argument of perigee [rad]
CUC = 11  # [rad]
CUS = 12
CRC = 13  # [m]
CRS = 14
CIC = 15  # [rad]
CIS = 16
AF0 = 17  # [s]
AF1 = 18  # [s/s]
AF2 = 19  # [s/s^2]
TGD = 20  # [s]
N_ELEMENT = 21

# Columns of a set's other facts (IS-GPS-200 20.3.3.3.1 and 20.3.3.4.3)
IODC = 0
URA = 1  # user range accuracy, index 0-15
CODE_ON_L2 = 2  # 1: P, 2: C/A
L2P_OFF = 3  # 1: no data on the P code of L2
FIT_INTERVAL = 4  # 0: 4 h, 1: longer
N_STATUS = 5

MAX_AGE_S = 7200.0
"""|t - toe| up to which a set is used: half of the 4 h fit interval (IS-GPS-200 20.3.4.4)"""


class IonoUtc(NamedTuple):
    """What page 18 of subframe 4 says to all (IS-GPS-200 20.3.3.5.1.6-7); zeros: nothing known."""

    alpha: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Klobuchar amplitude [s, s/semicircle, ...]"""
    beta: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Klobuchar period [s, s/semicircle, ...]"""
    a0: float = 0.0
    """GPS - UTC beyond leap seconds at the reference time [s]"""
    a1: float = 0.0
    """[s/s]"""
    tot_s: float = 0.0
    """Reference time of UTC [s of week_t]"""
    week_t: int = 0
    leap_s: int = 0
    """GPS - UTC, whole seconds"""
    week_lsf: int = 0
    """Week of the last or next leap second (full)"""
    day: int = 0
    """Day of that week at whose end it comes, 1 (Sunday) to 7; 0: unknown"""
    leap_future_s: int = 0
    """GPS - UTC after it"""


NO_IONO_UTC = IonoUtc()


@dataclass(frozen=True)
class Constellation:
    """Broadcast ephemerides, one row per set; a satellite has as many rows as it sent sets.

    Attributes
    ----------
    prn, week, health, iode : (n_set,) int64
        ``week`` is the full GPS week of toe; health 0 is "all signals OK".
    elements : (n_set, N_ELEMENT) float64
        Columns are `TOE` ... `TGD` of this module.
    transmission_s : (n_set,) float64
        Time of transmission in seconds of ``week`` (it may be negative).
    source : str
        Where the numbers come from.
    status : (n_set, N_STATUS) int64
        Columns are `IODC` ... `FIT_INTERVAL`.  Unless given: IODC equal to IODE, code P on L2 and
        else zeros.
    iono_utc : IonoUtc
        Ionosphere and UTC parameters.
    """

    prn: np.ndarray
    week: np.ndarray
    elements: np.ndarray
    health: np.ndarray
    iode: np.ndarray
    transmission_s: np.ndarray
    source: str
    status: np.ndarray = field(default_factory=lambda: np.empty((0, N_STATUS), dtype=np.int64))
    iono_utc: IonoUtc = NO_IONO_UTC

    def __post_init__(self) -> None:
        n_set = len(self.prn)
        if not len(self.status):
            status = np.zeros((n_set, N_STATUS), dtype=np.int64)
            status[:, IODC], status[:, CODE_ON_L2] = self.iode, 1
            object.__setattr__(self, "status", status)
        if self.elements.shape != (n_set, N_ELEMENT):
            raise ValueError(
                f"elements has shape {self.elements.shape}, expected ({n_set}, {N_ELEMENT})"
            )
        if self.status.shape != (n_set, N_STATUS):
            raise ValueError(
                f"status has shape {self.status.shape}, expected ({n_set}, {N_STATUS})"
            )
        for name in ("prn", "week", "health", "iode", "transmission_s"):
            if getattr(self, name).shape != (n_set,):
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}, expected ({n_set},)"
                )
        if not np.isfinite(self.elements).all():
            raise ValueError(f"elements of {self.source} contain a number that is not finite")
        for name in ("prn", "week", "elements", "health", "iode", "transmission_s", "status"):
            getattr(self, name).flags.writeable = False

    def __len__(self) -> int:
        return len(self.prn)

    def select(self, week: int, tow_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Take each healthy satellite's set for one time.

        Parameters
        ----------
        week, tow_s
            GPS week (full) and time of week [s].

        Returns
        -------
        prns : (n,) int64
            Ascending.
        rows : (n, N_ELEMENT)
            The set with the smallest |t - toe| <= 2 h (of equals the one sent later); TOE and
            TOC count from the start of ``week``, so that ``tow_s`` may run on past its end.

        Raises
        ------
        ValueError
            No healthy satellite has a set for that time.
        """
        if not np.isfinite(tow_s):
            raise ValueError(f"tow_s = {tow_s}: expected a finite time of week [s]")
        prns = np.unique(self.prn)
        chosen = np.array([self.choose(week, tow_s, int(p)) for p in prns])
        found = chosen >= 0
        if not found.any():
            raise ValueError(self.refusal(week, tow_s))
        return prns[found], self.rows(chosen[found], week)

    def choose(self, week: int, tow_s: float, prn: int, max_age_s: float = MAX_AGE_S) -> int:
        """Index of the set that `select` takes for a satellite, -1 where there is none."""
        return int(self._choose(week, np.array([tow_s]), prn, max_age_s)[0])

    def at(
        self, week: int, tow_s: float | np.ndarray, prn: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate one satellite, each time from the set that `select` would take.

        Parameters
        ----------
        week, tow_s
            GPS week and time of week [s], the latter of any shape.
        prn
            Satellite.

        Returns
        -------
        r_es_e, v_es_e : (..., 3)
            Position [m] and velocity [m/s] of the antenna phase centre in the ECEF frame of that
            very time.
        clock_s, clock_rate : (...)
            Satellite clock correction for L1 C/A, polynomial + relativity - T_GD [s], and its
            rate [s/s].

        Raises
        ------
        ValueError
            The satellite has no healthy set for one of the times.
        """
        tow = np.asarray(tow_s, dtype=np.float64)
        chosen = self._choose(week, tow.ravel(), prn)
        if (chosen < 0).any():
            raise ValueError(self.refusal(week, float(tow.ravel()[chosen < 0][0]), prn))
        out = np.empty((tow.size, 8))
        _orbits(self.rows(chosen, week), tow.ravel(), out)
        out = out.reshape(*tow.shape, 8)
        return out[..., 0:3], out[..., 3:6], out[..., 6], out[..., 7]

    def _choose(
        self, week: int, tow_s: np.ndarray, prn: int, max_age_s: float = MAX_AGE_S
    ) -> np.ndarray:
        """Index of the set to use at each time (n,), -1 where there is none."""
        sets = np.flatnonzero((self.prn == prn) & (self.health == 0))
        if not len(sets):
            return np.full(tow_s.shape, -1)
        # of equal ages argmin takes the first: the one transmitted last
        sent = self.transmission_s + WEEK_S * (self.week - week)
        sets = sets[np.argsort(-sent[sets], kind="stable")]
        toe = self.elements[sets, TOE] + WEEK_S * (self.week[sets] - week)
        age = np.abs(tow_s[:, None] - toe)
        best = age.argmin(axis=1)
        usable = age[np.arange(len(tow_s)), best] <= max_age_s
        return np.where(usable, sets[best], -1)

    def rows(self, sets: np.ndarray, week: int) -> np.ndarray:
        """Copy of the elements with times counted from the start of ``week``."""
        rows = self.elements[sets]
        shift = WEEK_S * (self.week[sets] - week)
        rows[:, TOE] += shift
        rows[:, TOC] += shift
        # OMEGA0 is the node's longitude at the start of toe's own week (table 20-IV subtracts
        # OMEGA_EARTH toe): refer it to the new week.
        rows[:, OMEGA0] += OMEGA_EARTH * shift
        return rows

    def refusal(self, week: int, tow_s: float, prn: int | None = None) -> str:
        """Say that there is no set for a time, and which times there are."""
        who = "no satellite" if prn is None else f"G{prn:02d}"
        sets = self.health == 0 if prn is None else (self.health == 0) & (self.prn == prn)
        what = "has a healthy" if prn is None else "has no healthy"
        text = f"week {week}, tow {tow_s:.10g} s: {who} {what} ephemeris within 2 h of toe"
        if not sets.any():
            return f"{text} ({self.source} has none at all)"
        toe = self.elements[sets, TOE] + WEEK_S * self.week[sets]
        first, last = toe.min() - MAX_AGE_S, toe.max() + MAX_AGE_S
        return (
            f"{text}; {self.source} covers week {first // WEEK_S:.0f}, tow {first % WEEK_S:.10g} s "
            f"to week {last // WEEK_S:.0f}, tow {last % WEEK_S:.10g} s"
        )


def embedded() -> Constellation:
    """Return the real GPS constellation that the package carries: 2021-03-19, East Asia's sky."""
    from signals.embedded_2021_03_19 import ALPHA, BETA, LEAP, SETS, SOURCE, URA_1

    table = np.array(SETS)
    prn, iode = table[:, 0].astype(np.int64), table[:, 3].astype(np.int64)
    status = np.zeros((len(table), N_STATUS), dtype=np.int64)
    status[:, IODC] = iode
    status[:, URA] = [(int(p), toe) in URA_1 for p, toe in zip(prn, table[:, 5], strict=True)]
    status[:, CODE_ON_L2] = 1
    return Constellation(
        prn=prn,
        week=table[:, 1].astype(np.int64),
        health=table[:, 2].astype(np.int64),
        iode=iode,
        transmission_s=table[:, 4].copy(),
        elements=table[:, 5:].copy(),
        source=SOURCE,
        status=status,
        iono_utc=IonoUtc(ALPHA, BETA, **LEAP),
    )


@kernel
def orbit(
    row: np.ndarray, tow_s: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """Position, velocity (ECEF of that time), clock and clock rate of one set at GPS time tow_s.

    IS-GPS-200 table 20-IV with its velocity extension; clock 20.3.3.3.3.1-2.
    """
    a = row[SQRT_A] * row[SQRT_A]
    ecc = row[ECC]
    n = math.sqrt(GM_GPS / (a * a * a)) + row[DELTA_N]
    t_k = tow_s - row[TOE]
    m_k = row[M0] + n * t_k
    e_k = m_k + ecc * math.sin(m_k)
    for _ in range(20):  # Newton; 3 rounds at e < 0.03
        step = (e_k - ecc * math.sin(e_k) - m_k) / (1.0 - ecc * math.cos(e_k))
        e_k -= step
        if abs(step) < 1e-9:  # the next step would be below 1e-18
            break
    sin_e = math.sin(e_k)
    cos_e = math.cos(e_k)
    q = 1.0 - ecc * cos_e
    e_dot = n / q
    root = math.sqrt(1.0 - ecc * ecc)
    # argument of latitude Phi = nu + omega, without the arc tangent
    sin_nu = root * sin_e / q
    cos_nu = (cos_e - ecc) / q
    phi_dot = root * e_dot / q
    sin_w = math.sin(row[OMEGA])
    cos_w = math.cos(row[OMEGA])
    sin_phi = sin_nu * cos_w + cos_nu * sin_w
    cos_phi = cos_nu * cos_w - sin_nu * sin_w
    s2 = 2.0 * sin_phi * cos_phi
    c2 = (cos_phi - sin_phi) * (cos_phi + sin_phi)
    # second-harmonic corrections and their rates
    du = row[CUS] * s2 + row[CUC] * c2
    r = a * q + row[CRS] * s2 + row[CRC] * c2
    i = row[I0] + row[IDOT] * t_k + row[CIS] * s2 + row[CIC] * c2
    u_dot = phi_dot * (1.0 + 2.0 * (row[CUS] * c2 - row[CUC] * s2))
    r_dot = a * ecc * sin_e * e_dot + 2.0 * phi_dot * (row[CRS] * c2 - row[CRC] * s2)
    i_dot = row[IDOT] + 2.0 * phi_dot * (row[CIS] * c2 - row[CIC] * s2)
    sin_du = math.sin(du)
    cos_du = math.cos(du)
    sin_u = sin_phi * cos_du + cos_phi * sin_du
    cos_u = cos_phi * cos_du - sin_phi * sin_du
    # orbital plane
    x = r * cos_u
    y = r * sin_u
    x_dot = r_dot * cos_u - y * u_dot
    y_dot = r_dot * sin_u + x * u_dot
    # The constant part of the node's longitude is brought near 0 first: rounding at 36 rad would
    # put 0.1 um of jitter on the position.
    node = row[OMEGA0] - OMEGA_EARTH * row[TOE]
    node -= 2.0 * math.pi * math.floor(node / (2.0 * math.pi) + 0.5)
    node_dot = row[OMEGA_DOT] - OMEGA_EARTH
    node += node_dot * t_k
    sin_n = math.sin(node)
    cos_n = math.cos(node)
    sin_i = math.sin(i)
    cos_i = math.cos(i)
    across = y * cos_i
    across_dot = y_dot * cos_i - y * sin_i * i_dot
    px = x * cos_n - across * sin_n
    py = x * sin_n + across * cos_n
    vx = x_dot * cos_n - across_dot * sin_n - py * node_dot
    vy = x_dot * sin_n + across_dot * cos_n + px * node_dot
    vz = y_dot * sin_i + y * cos_i * i_dot
    t_c = tow_s - row[TOC]
    relativity = F_RELATIVITY * ecc * row[SQRT_A]
    clock = row[AF0] + t_c * (row[AF1] + t_c * row[AF2]) + relativity * sin_e - row[TGD]
    clock_rate = row[AF1] + 2.0 * row[AF2] * t_c + relativity * cos_e * e_dot
    return px, py, y * sin_i, vx, vy, vz, clock, clock_rate


@kernel
def _orbits(rows: np.ndarray, tow_s: np.ndarray, out: np.ndarray) -> None:
    """Evaluate row k at tow_s[k] into out (n, 8)."""
    for k in range(len(tow_s)):
        (
            out[k, 0],
            out[k, 1],
            out[k, 2],
            out[k, 3],
            out[k, 4],
            out[k, 5],
            out[k, 6],
            out[k, 7],
        ) = orbit(rows[k], tow_s[k])
