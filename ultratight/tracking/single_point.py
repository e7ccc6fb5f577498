"""Position, velocity and clock of one epoch: weighted least squares, DOP, and a test of residuals.

Gauss-Newton on pseudoranges with light time and the Sagnac effect (`signals.propagation`), from
the centre of the Earth where nothing better is known (Kaplan & Hegarty, 3rd ed., 2.5; Groves, 2nd
ed., 9.4.1).  With n satellites the weighted square sum of the residuals has n - 4 degrees of
freedom; above the value that it exceeds with the probability ``false_alarm`` the satellite without
which it is lowest is left out, if that is then below (Groves 17.3.1, 17.4.1).  With five there is
no telling which.

The variance of a pseudorange is that of the code loop (coherent early minus late, wide band, Kaplan
& Hegarty 8.9) and of what user range accuracy and models leave:

    B_L D / (2 C/N0) chip^2 + URA^2 + (half the ionosphere)^2 + (0.12 m / sin elevation)^2

(RTCA DO-229D, A.4.5, J.2; the last two only where they are corrected).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.atmosphere import ionosphere_delay_m, troposphere_delay_m
from signals.compiled import kernel
from signals.constants import C_MPS, CA_CHIP_RATE_HZ
from signals.propagation import elevation_azimuth, pseudorange
from signals.satellites import IonoUtc
from ultratight.ins.earth import geodetic_from_ecef, rotation_e_from_n

FALSE_ALARM = 1e-3
MASK = math.radians(5.0)
FEWEST = 4
_ITERATIONS = 12
_SMALL_STEP_M = 1e-4
_POOREST_DOP = 1000.0
_CODE_LOOP_HZ, _SPACING_CHIPS = 1.0, 1.0
_NOMINAL_URA_M = (2.0, 2.8, 4.0, 5.7, 8.0, 11.3, *(2.0 ** (k - 2) for k in range(6, 15)), 6144.0)
"""By index (IS-GPS-200 20.3.3.3.1.3)"""
_TROPOSPHERE_LEFT_M = 0.12


class Epoch(NamedTuple):
    """What is observed at a time, satellites (n,)."""

    tow_s: float  # receiver's clock
    rows: np.ndarray  # (n, N_ELEMENT) ephemerides, tow_s being of their week
    pseudorange_m: np.ndarray
    rate_mps: np.ndarray
    cn0_dbhz: np.ndarray
    ura: np.ndarray  # index


class Models(NamedTuple):
    """What is corrected."""

    atmosphere: bool = True
    iono_utc: IonoUtc = IonoUtc()
    """No coefficients: no correction of the ionosphere"""
    mask: float = MASK
    """Least elevation [rad]"""


class Dop(NamedTuple):
    """Dilutions of precision (Kaplan & Hegarty 11.2)."""

    geometric: float
    position: float
    horizontal: float
    vertical: float
    time: float


class Fix(NamedTuple):
    """A solution; vectors in ECEF, of the antenna, at the time of reception."""

    state: np.ndarray  # (8,) r [m], c b [m], v [m/s], c b' [m/s]
    cov: np.ndarray  # (4, 4) of the first four
    used: np.ndarray  # (n,) bool
    excluded: int  # index of a satellite left out because of its residual, -1: none
    residual_m: np.ndarray  # (n,)
    chi_square: float
    limit: float  # of chi_square; infinite without redundancy
    dop: Dop
    elevation: np.ndarray  # (n,) [rad]
    azimuth: np.ndarray  # (n,)

    @property
    def consistent(self) -> bool:
        """Do the residuals fit the stated variances?"""
        return self.chi_square <= self.limit


def solve(
    epoch: Epoch,
    models: Models,
    near: np.ndarray | None = None,
    false_alarm: float = FALSE_ALARM,
) -> Fix | None:
    """The fix of an epoch, from the state ``near`` (8,) on; None where there is none.

    Without ``near``: from the centre of the Earth, everything being in view.
    """
    n = len(epoch.rows)
    everything = np.ones(n, bool)
    state = np.zeros(8) if near is None else near.copy()
    nothing = np.zeros(n)
    if near is None:
        first = _gauss_newton(epoch, state, nothing, np.ones(n), everything)
        if first is None:
            return None
        state = first[0]
    look = looks(epoch, state)
    visible = look[0] >= models.mask
    if visible.sum() < FEWEST:
        return None
    delay, ionosphere = corrections(epoch, state, look, models)
    variance = variances(epoch, look[0], ionosphere, models.atmosphere)
    best = _judged(epoch, state, delay, variance, visible, -1, look, false_alarm)
    if best is not None and not best.consistent and visible.sum() > FEWEST + 1:
        best = _without_one(epoch, state, delay, variance, visible, best, look, false_alarm)
    if near is None and best is not None and best.consistent:
        # elevations and delays were those of a place that may be far off
        return solve(epoch, models, best.state, false_alarm)
    return best


def corrections(
    epoch: Epoch, state: np.ndarray, look: tuple[np.ndarray, np.ndarray], models: Models
) -> tuple[np.ndarray, np.ndarray]:
    """Delay of the code (n,) in the atmosphere and the ionosphere's share of it [m]."""
    nothing = np.zeros(len(epoch.rows))
    if not models.atmosphere:
        return nothing, nothing
    lat, lon, height = (float(x) for x in geodetic_from_ecef(state[:3]))
    elevation, azimuth = look
    iono = models.iono_utc
    ionosphere = nothing
    if any(iono.alpha) or any(iono.beta):
        ionosphere = ionosphere_delay_m(
            lat, lon, azimuth, elevation, epoch.tow_s, iono.alpha, iono.beta
        )
    return troposphere_delay_m(lat, height, elevation) + ionosphere, ionosphere


def variances(
    epoch: Epoch, elevation: np.ndarray, ionosphere: np.ndarray, atmosphere: bool
) -> np.ndarray:
    """Of the pseudoranges (n,) [m^2]."""
    out = code_variances(epoch.cn0_dbhz)
    out += np.array(_NOMINAL_URA_M)[np.clip(epoch.ura, 0, 15)] ** 2
    if atmosphere:
        sine = np.sin(np.maximum(elevation, MASK))
        out += (0.5 * ionosphere) ** 2 + (_TROPOSPHERE_LEFT_M / sine) ** 2
    return out


def code_variances(cn0_dbhz: np.ndarray) -> np.ndarray:
    """Of the code loop's noise (n,) [m^2]."""
    chip2 = _CODE_LOOP_HZ * _SPACING_CHIPS / (2.0 * 10.0 ** (cn0_dbhz / 10.0))
    out: np.ndarray = chip2 * (C_MPS / CA_CHIP_RATE_HZ) ** 2
    return out


def predicted(epoch: Epoch, state: np.ndarray) -> np.ndarray:
    """Pseudorange, rate and line of sight (n, 5) that a state (8,) lets expect."""
    out = np.empty((len(epoch.rows), 5))
    _predict(np.ascontiguousarray(epoch.rows), epoch.tow_s, state, out)
    return out


def limit_of(dof: int, false_alarm: float) -> float:
    """What chi-square exceeds with this probability; infinite without a degree of freedom."""
    from scipy.special import gammainccinv  # slow to import

    return 2.0 * float(gammainccinv(0.5 * dof, false_alarm)) if dof > 0 else math.inf


def dilutions(G: np.ndarray, r: np.ndarray) -> Dop:
    """From (H' H)^-1 (4, 4) with unit vectors in ECEF."""
    lat, lon, _ = geodetic_from_ecef(r)
    C = rotation_e_from_n(lat, lon)
    north, east, down = np.diag(C.T @ G[:3, :3] @ C)
    parts = np.trace(G), north + east + down, north + east, down, G[3, 3]
    return Dop(*(math.sqrt(float(p)) for p in parts))


def looks(epoch: Epoch, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Elevation and azimuth (n,) each, seen from a state (8,)."""
    return elevation_azimuth(state[:3], predicted(epoch, state)[:, 2:])


def _gauss_newton(
    epoch: Epoch, start: np.ndarray, delay: np.ndarray, weight: np.ndarray, use: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """State (8,) and geometry H (n_used, 4); None: too few, hardly any geometry, no end."""
    if use.sum() < FEWEST:
        return None
    x = start.copy()
    root = np.sqrt(weight[use])[:, None]
    for _ in range(_ITERATIONS):
        model = predicted(epoch, x)[use]
        H = np.column_stack([-model[:, 2:], np.ones(len(model))])
        right = np.column_stack(
            [
                epoch.pseudorange_m[use] - delay[use] - model[:, 0],
                epoch.rate_mps[use] - model[:, 1],
            ]
        )
        if not np.isfinite(H).all() or np.linalg.cond(H) > _POOREST_DOP:
            return None
        step = np.linalg.lstsq(root * H, root * right)[0]
        x[0:4] += step[:, 0]
        x[4:8] += step[:, 1]
        if np.abs(step).max() < _SMALL_STEP_M:
            return x, H
    return None


def _without_one(
    epoch: Epoch,
    start: np.ndarray,
    delay: np.ndarray,
    variance: np.ndarray,
    use: np.ndarray,
    best: Fix,
    look: tuple[np.ndarray, np.ndarray],
    false_alarm: float,
) -> Fix:
    """The fix without the satellite whose absence lowers chi-square most."""
    for i in np.flatnonzero(use).tolist():
        left = use.copy()
        left[i] = False
        other = _judged(epoch, start, delay, variance, left, i, look, false_alarm)
        if other is not None and other.chi_square < best.chi_square:
            best = other
    return best


def _judged(
    epoch: Epoch,
    start: np.ndarray,
    delay: np.ndarray,
    variance: np.ndarray,
    use: np.ndarray,
    excluded: int,
    look: tuple[np.ndarray, np.ndarray],
    false_alarm: float,
) -> Fix | None:
    """The solution of some satellites, and what their residuals say."""
    found = _gauss_newton(epoch, start, delay, 1.0 / variance, use)
    if found is None:
        return None
    x, H = found
    residual = epoch.pseudorange_m - delay - predicted(epoch, x)[:, 0]
    chi_square = float(np.sum(residual[use] ** 2 / variance[use]))
    cov = np.linalg.inv(H.T @ (H / variance[use][:, None]))
    dop = dilutions(np.linalg.inv(H.T @ H), x[:3])
    limit = limit_of(int(use.sum()) - FEWEST, false_alarm)
    return Fix(x, cov, use, excluded, residual, chi_square, limit, dop, *look)


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def _predict(rows: np.ndarray, tow_s: float, state: np.ndarray, out: np.ndarray) -> None:
    """Pseudorange, rate, line of sight of each satellite into out (n, 5)."""
    for i in range(rows.shape[0]):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = pseudorange(
            rows[i], tow_s, state[0:3], state[4:7], state[3], state[7]
        )
