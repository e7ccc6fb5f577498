"""From what a receiver has found of itself to what a closure is told at its start (`Knows`).

Scalar tracking, decoded messages and the position filter (`navigation`) know position, velocity,
clock and C/N0 at an instant, each with a sigma; a closure takes over there.  Nothing later is used.

The closures correct no atmosphere.  Where it is corrected, its delay of each satellite's code over
the time to come, seen from the place of the start, is put into the satellite's clock as a parabola
in time, which is what a broadcast clock is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals import satellites as s
from signals.codes import GPS_L1CA
from signals.constants import C_MPS
from signals.nco import Correlator, Nco, Taps
from ultratight.ins.error_state import ProcessNoise
from ultratight.tracking.channels import channels
from ultratight.tracking.knows import Knows
from ultratight.tracking.navigation import Navigation, Position, epoch_of
from ultratight.tracking.position_filter import Estimate
from ultratight.tracking.single_point import FEWEST, Epoch, Models, corrections, looks


class Inertial(NamedTuple):
    """What is known of attitude and IMU at the start; the default is a receiver without one."""

    C_b_e: np.ndarray = np.eye(3)
    sigma: np.ndarray = np.zeros(3)
    """Of the attitude about the axes of ECEF (3,) [rad]"""
    accel_bias_sigma: float = 0.0
    gyro_bias_sigma: float = 0.0
    first_alpha: np.ndarray = np.zeros(3)
    """The increments that ended at the start"""
    first_nu: np.ndarray = np.zeros(3)
    lever_b_m: np.ndarray = np.zeros(3)
    omega_eb_b: np.ndarray = np.zeros(3)
    """Turn rate over the Earth, for the lever arm"""


class Later:
    """A correlator for a receiver whose time zero is t0_s of the samples'; a `Correlator`."""

    def __init__(self, correlator: Correlator, t0_s: float) -> None:
        self.correlator, self.t0_s = correlator, t0_s
        self.offset_chips = correlator.offset_chips

    def __call__(self, nco: Nco) -> Taps:
        """Correlate over all pieces of the command."""
        taps = self.correlator(nco._replace(t_s=nco.t_s + self.t0_s))
        return taps._replace(t_start_s=taps.t_start_s - self.t0_s, t_end_s=taps.t_end_s - self.t0_s)


def estimates(nav: Navigation) -> list[tuple[Position, Estimate]]:
    """Epochs at which the position filter runs."""
    return [(p, p.estimate) for p in nav.positions if p.estimate is not None]


def knows_at(
    nav: Navigation,
    position: Position,
    t_s: float,
    duration_s: float,
    noise: ProcessNoise,
    *,
    inertial: Inertial | None = None,
    atmosphere: bool = False,
) -> Knows:
    """What is known at t_s [s from sample 0 on], at or soon after the epoch of ``position``.

    The atmosphere's delays hold for ``duration_s`` from then on.  Satellites are those that the
    position filter used.

    Raises
    ------
    ValueError
        No filter at that epoch, or fewer than four satellites in it.
    """
    of, seen, sky = position.estimate, nav.observations, nav.sky
    if of is None or seen is None or sky is None:
        raise ValueError(f"no filtered position at {position.t_s:.3f} s")
    k = int(np.searchsorted(seen.tow_ms, round(position.tow_s * 1e3)))
    channel, epoch = epoch_of(seen, k, sky, nav.week)
    used = of.used
    if used.sum() < FEWEST:
        raise ValueError(
            f"{int(used.sum())} satellites used at {position.t_s:.3f} s, expected {FEWEST}"
        )
    epoch = Epoch(epoch.tow_s, *(column[used] for column in epoch[1:]))
    own, later = inertial or Inertial(), t_s - position.t_s
    tow_s = position.tow_s + later
    r = of.state[:3] + later * of.state[4:7]
    sigma, rows = np.sqrt(np.diag(of.cov)), np.ascontiguousarray(epoch.rows)
    if atmosphere:
        models = Models(True, sky.iono_utc)
        rows = _with_delays(epoch, of.state, models, tow_s, duration_s)
    prn = nav.tracks.prn[channel[used]]
    return Knows(
        start_week=nav.week,
        start_tow_s=tow_s,
        prn=prn,
        elements=rows,
        channels=channels([GPS_L1CA] * len(prn), prn.tolist(), tow_s),
        cn0_dbhz=epoch.cn0_dbhz,
        r_eb_e=r - own.C_b_e @ own.lever_b_m,
        v_eb_e=of.state[4:7] - own.C_b_e @ np.cross(own.omega_eb_b, own.lever_b_m),
        C_b_e=own.C_b_e,
        clock_m=float(of.state[3] + later * of.state[7]),
        clock_rate_mps=float(of.state[7]),
        first_alpha=own.first_alpha,
        first_nu=own.first_nu,
        sigma=np.concatenate(
            [
                sigma[:3], sigma[4:7], own.sigma, np.full(3, own.accel_bias_sigma),
                np.full(3, own.gyro_bias_sigma), sigma[[3, 7]],
            ]
        ),
        lever_arm_b_m=own.lever_b_m,
        noise=np.array(noise),
    )  # fmt: skip


def _with_delays(
    epoch: Epoch, state: np.ndarray, models: Models, tow_s: float, duration_s: float
) -> np.ndarray:
    """Elements whose clocks are late by the code's delay, over duration_s from tow_s on."""
    h = 0.5 * max(duration_s, 1.0)
    d = np.empty((3, len(epoch.rows)))
    for m in range(3):
        then = epoch._replace(tow_s=tow_s + m * h)
        d[m] = corrections(then, state, looks(then, state), models)[0]
    # d = c0 + c1 x + c2 x^2, x = t - tow_s = (t - toc) + since
    c2 = (d[2] - 2.0 * d[1] + d[0]) / (2.0 * h * h)
    c1 = (d[1] - d[0]) / h - c2 * h
    rows = epoch.rows.copy()
    since = rows[:, s.TOC] - tow_s
    rows[:, s.AF0] -= (d[0] + since * (c1 + since * c2)) / C_MPS
    rows[:, s.AF1] -= (c1 + 2.0 * since * c2) / C_MPS
    rows[:, s.AF2] -= c2 / C_MPS
    return rows
