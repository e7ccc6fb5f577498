"""Flight, errors and disturbances of Wei, Qin, Zhang & Zhang (2012), as far as they are printed.

A platform INS with 24 error sources in wander azimuth flies 44 stages in 8424 s; a filter of 11
states sees latitude and longitude against GPS every second, and estimates the INS's errors in open
loop.  Printed: errors (table 1), stages (table 2), outages and GPS faults, noise of GPS.  Not
printed, chosen here: speeds, climb, turn rate, period, truth's and filter's noises.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from signals.constants import STANDARD_GRAVITY
from signals.noise import generator
from ultratight.filters.adaptive import SageHusa
from ultratight.filters.gaussian import Gaussian
from ultratight.filters.linear import FIXED, LinearRun, run_linear
from ultratight.ins.wander_azimuth import EARTH_RADIUS, FlightProfile, fly
from ultratight.ins.wander_azimuth_errors import (
    N_NAVIGATION,
    NAVIGATION,
    SENSORS,
    propagate,
    transitions,
)

ARCSEC = np.pi / 180.0 / 3600.0
ARCMIN = 60.0 * ARCSEC
DEG_PER_H = ARCSEC  # per second
N_EPOCH, STEPS = 8424, 10
K = np.arange(1, N_EPOCH + 1)
"""Time of each measurement [s]"""
OUTAGE = ((K >= 301) & (K <= 899)) | ((K >= 5301) & (K <= 5899))
FAULT = ARCSEC * (
    300.0 * ((K >= 1001) & (K <= 1003))
    + 60.0 * ((K >= 1501) & (K <= 1800))
    + 0.067 * (K - 2000) * ((K >= 2001) & (K <= 2600))
)
"""Jump, step and ramp of both GPS coordinates [rad]"""

ERRORS = {
    "dVx": 0.02, "dVy": 0.03, "dL": 0.2 * ARCMIN, "dlon": 0.3 * ARCMIN,
    "phi_x": 20 * ARCSEC, "phi_y": 20 * ARCSEC, "phi_z": 30 * ARCSEC, "da": -600 * ARCSEC,
    "e_x": -0.02 * DEG_PER_H, "e_y": 0.02 * DEG_PER_H, "e_z": 0.05 * DEG_PER_H,
    "b_x": 2e-5 * STANDARD_GRAVITY, "b_y": 1e-5 * STANDARD_GRAVITY,
    "th_xz": 6 * ARCSEC, "th_yz": 10 * ARCSEC,
    "Kg_x": 7e-4, "Kg_y": -7e-4, "Kg_z": 7e-4, "Ka_x": 7e-4, "Ka_y": -6e-4,
    "m_XX": 1.5 * DEG_PER_H, "q_ZX": 0.5 * DEG_PER_H,
    "m_YY": 1.0 * DEG_PER_H, "q_ZY": 0.5 * DEG_PER_H,
}  # fmt: skip
"""Table 1; the drifts by mass unbalance and quadrature are per g"""

TURNS = (
    # bank, turn, roll out, level [s]; left is negative
    (466, 467, 507, 508, -1), (808, 809, 1009, 1010, -1), (1510, 1511, 1811, 1812, 1),
    (2412, 2413, 2613, 2614, -1), (3114, 3115, 3415, 3416, 1), (3916, 3917, 4417, 4418, -1),
    (5018, 5019, 5219, 5220, 1), (5920, 5921, 6421, 6422, -1), (7222, 7223, 7823, 7824, 1),
)  # fmt: skip
"""Table 2, stages 8 to 43; before them take-off, climb and acceleration"""
TURN_RATE, CLIMB = np.radians(1.8), np.radians(8.0)

GPS_SIGMA = 0.3 * ARCSEC
VELOCITY_WALK, TILT_WALK = 3e-3, 8.7e-7  # m/s and rad in a second: the truth's
START = Gaussian(
    np.zeros(N_NAVIGATION),
    np.diag(
        np.array(
            [0.1, 0.1, 0.3 * ARCMIN, 0.3 * ARCMIN, 30 * ARCSEC, 30 * ARCSEC, 60 * ARCSEC,
             600 * ARCSEC, 0.05 * DEG_PER_H, 0.05 * DEG_PER_H, 0.05 * DEG_PER_H]
        ) ** 2
    ),
)  # fmt: skip
H = np.zeros((2, N_NAVIGATION))
H[0, NAVIGATION.index("dL")] = H[1, NAVIGATION.index("dlon")] = 1.0


def process_noise(drift_deg_per_h: float, tilt_rad: float = TILT_WALK) -> np.ndarray:
    """Q_0 per second: the truth's noise of velocity, a tilt and a gyro drift."""
    sigma = [VELOCITY_WALK] * 2 + [0.0] * 2 + [tilt_rad] * 3 + [0.0]
    return np.diag(np.array(sigma + [drift_deg_per_h * DEG_PER_H] * 3) ** 2)


Q0 = {"over-stated": process_noise(0.1, 1e-6), "matched": process_noise(0.001)}
"""The first covers the drift that the filter does not model (1 deg/h in a turn); the second is
the truth's own noise"""


@dataclass(frozen=True)
class World:
    """Which errors and disturbances there are."""

    outages: bool = True
    faults: bool = False
    errors: Mapping[str, float] | None = None  # changes of `ERRORS`
    quadrature: str = "calibrated"
    speed_mps: float = 200.0  # from 426 s on
    turn_rate: float = TURN_RATE
    heading_deg: float = 45.0  # at the start


SCENARIOS = {
    "1": World(),
    "2": World(errors={"th_yz": ERRORS["th_yz"] + 120 * ARCSEC, "Ka_x": ERRORS["Ka_x"] + 0.0037}),
    "3": World(faults=True),
    "section 5": World(outages=False, errors=dict.fromkeys(SENSORS, 0.0)),
    "full quadrature": World(quadrature="full"),
}


class Flown(NamedTuple):
    """Errors of the estimate and standard deviations, per second (8424, ..)."""

    error: np.ndarray  # (.., 11) truth - estimate
    run: LinearRun


def matrices(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Phi and Gamma of every second."""
    return _matrices(world.quadrature, world.speed_mps, world.turn_rate, world.heading_deg)


@cache
def _matrices(
    quadrature: str, speed_mps: float, turn_rate: float, heading_deg: float
) -> tuple[np.ndarray, np.ndarray]:
    rows = [(0, 0.0, 0.0, 0.0), (20, 90.0, 0.0, 0.0), (23, 90.0, CLIMB, 0.0),
            (183, 90.0, CLIMB, 0.0), (186, 90.0, 0.0, 0.0), (386, 90.0, 0.0, 0.0),
            (426, speed_mps, 0.0, 0.0)]  # fmt: skip
    for bank, turn, roll_out, level, side in TURNS:
        rate = side * turn_rate
        knots = ((bank, 0.0), (turn, rate), (roll_out, rate), (level, 0.0))
        rows += [(t, speed_mps, 0.0, w) for t, w in knots]
    profile = FlightProfile(*np.array(rows).T)
    middles = (np.arange(N_EPOCH * STEPS) + 0.5) / STEPS
    angles = {"lat": 34.25, "lon": 108.9, "heading": heading_deg, "wander": 45.0}
    flight = fly(profile, middles, **{name: np.radians(a) for name, a in angles.items()})
    return transitions(flight, STEPS, quadrature)


def measure(world: World, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """True errors (8424, 11) of the INS and INS minus GPS (8424, 2), NaN in an outage."""
    noise = np.zeros((N_EPOCH, N_NAVIGATION))
    noise[:, :2] = VELOCITY_WALK * generator(seed, "velocity").standard_normal((N_EPOCH, 2))
    noise[:, 4:7] = TILT_WALK * generator(seed, "tilt").standard_normal((N_EPOCH, 3))
    if world.outages:
        noise[OUTAGE, :2] = 0.0
    errors = ERRORS | dict(world.errors or {})
    start = [errors[name] for name in (*NAVIGATION, *SENSORS)]
    x = propagate(*matrices(world), start, noise)[1:]
    z = x @ H.T + GPS_SIGMA * generator(seed, "gps").standard_normal((N_EPOCH, 2))
    if world.faults:
        z += FAULT[:, None]
    if world.outages:
        z[OUTAGE] = np.nan
    return x, z


def estimate(
    world: World, x: np.ndarray, z: np.ndarray, Q: np.ndarray, noise: SageHusa | None,
    first: tuple[float, float] = (1.0, 1.0),
) -> Flown:  # fmt: skip
    """Fly one filter over what was measured; ``first``: factors of the sigmas in P_0 and R_0."""
    start = START._replace(cov=first[0] ** 2 * START.cov)
    R0 = (first[1] * GPS_SIGMA) ** 2 * np.eye(2)
    run = run_linear(start, matrices(world)[0], Q, H, R0, z, noise or FIXED)
    return Flown(x - run.mean, run)


# -- figures of merit -----------------------------------------------------------------------------

SETTLED = K >= 200
BRIDGED_S = 30


def merits(flown: Flown) -> dict[str, float]:
    """Of one flight, from 200 s on; a run without a number at its end counts as infinite.

    peak_x, peak_y [m/s] and when [s]; rms of both velocity errors [m/s]; rms_late, of 2900 to
    5200 s; azimuth: rms of its tilt [arcsec]; long_a_x ..: duration [s] of the stretch around the
    peak above a quarter of it, long_b above 0.5 m/s, gaps of 30 s bridged; sqrt_R_s: time with
    sqrt(R^) above 100 m, sqrt_R its maximum [m]; lost: epoch of the first loss of definiteness.
    """
    run, v = flown.run, np.abs(flown.error[:, :2])
    v = np.where(np.isfinite(v), v, np.inf)
    out: dict[str, float] = {}
    for axis, name in enumerate("xy"):
        e = np.where(SETTLED, v[:, axis], 0.0)
        top = int(e.argmax())
        out |= {f"peak_{name}": e[top], f"when_{name}": float(K[top])}
        out[f"long_a_{name}"] = stretch(e > 0.25 * e[top], top)
        out[f"long_b_{name}"] = stretch(e > 0.5, top)
    late = (K >= 2900) & (K <= 5200)
    out["rms"] = float(np.sqrt(np.mean(v[SETTLED] ** 2)))
    out["rms_late"] = float(np.sqrt(np.mean(v[late] ** 2)))
    azimuth = flown.error[SETTLED, NAVIGATION.index("phi_z")]
    out["azimuth"] = float(np.sqrt(np.mean(azimuth**2)) / ARCSEC)
    root = EARTH_RADIUS * np.sqrt(np.maximum(run.R_variance.max(axis=1), 0.0))
    out |= {"sqrt_R_s": float((root > 100.0).sum()), "sqrt_R": float(root.max())}
    mishaps = [k for k in run.first if k >= 0]
    return out | {"lost": float(min(mishaps)) if mishaps else np.nan}


def stretch(above: np.ndarray, top: int) -> float:
    """Length [s] of the run of true entries around ``top``, gaps up to 30 s bridged."""
    hits = np.flatnonzero(above)
    if hits.size == 0 or not above[top]:
        return 0.0
    ends = np.flatnonzero(np.diff(hits) > BRIDGED_S + 1)
    group = np.searchsorted(ends, np.searchsorted(hits, top))
    first = hits[0] if group == 0 else hits[ends[group - 1] + 1]
    last = hits[-1] if group == ends.size else hits[ends[group]]
    return float(last - first + 1)
