"""What no filter can beat: the velocity error when time and kind of the jump are known.

Posterior Cramer-Rao bound of the linearised coherent measurement: a Kalman covariance, without any
data.  States: velocity (3), accelerometer bias (3), clock drift, one carrier phase per satellite;
at each jump the covariance of a block is opened by the size that the surprise may have (1 sigma).
Attitude and gyro errors are left out, so the bound is a little low.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

import ultratight

T = 0.02
JUMPS_S = {20.0: 1.0, 30.0: 2.0}
"""Case 2: when the specific force steps, and by how many times 100 m/s2"""
END_S = 40.0
WAVELENGTH_M = 299_792_458.0 / 1575.42e6
CN0_HZ = 10.0**3.5
VELOCITY_WALK, BIAS_G, BIAS_TAU_S = 1e-3, 50e-6, 100.0
CLOCK_SF, CLOCK_SG = 4.5e-5, 0.0355
"""Data sheet of the presets: IMU [m/s/sqrt(s), g, s] and TCXO [m2/s, m2/s3]"""


def lines_of_sight(preset: str = "jump-2") -> np.ndarray:
    """Unit vectors to the satellites (n, 3), north-east-down, at the start of a preset."""
    run = ultratight.run(ultratight.load(preset, {"duration_s": 0.1, "profile": []}))
    elevation, azimuth = (np.radians(run[name][0]) for name in ("elevation", "azimuth"))
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), -np.sin(elevation)])


def velocity_bound(u: np.ndarray, opened: Mapping[str, float]) -> float:
    """R.m.s. of the velocity error from the first jump to the end [m/s].

    ``opened``: sigma per 100 m/s2 of "velocity" [m/s], "acceleration" [m/s2], "clock" [m/s].
    """
    n = 7 + len(u)
    F, G = np.zeros((n, n)), np.zeros((n, n))
    F[0:3, 3:6] = np.eye(3)
    F[7:, 0:3], F[7:, 6] = -u, 1.0
    G[0:3, 0:3] = VELOCITY_WALK**2 * np.eye(3)
    G[3:6, 3:6] = 2.0 * (BIAS_G * 9.80665) ** 2 / BIAS_TAU_S * np.eye(3)
    G[6, 6] = CLOCK_SG
    G[7:, 7:] = CLOCK_SF
    phi = np.eye(n) + 0.5 * T * F + 0.125 * T**2 * F @ F  # of half an epoch
    q = 0.25 * T * (phi @ G @ phi.T + G)
    H = np.eye(n)[7:]
    sigma = WAVELENGTH_M / (2.0 * np.pi * np.sqrt(2.0 * CN0_HZ * T))
    sizes = {"velocity": range(3), "acceleration": range(3, 6), "clock": range(6, 7)}
    P = np.diag([0.25] * 3 + [1e-4] * 3 + [0.25] + [1e-4] * len(u))
    trace = []
    for k in range(round(END_S / T)):
        force = JUMPS_S.get(round(k * T, 6), 0.0)
        for block, size in opened.items():
            power = 2 if block == "velocity" else 1  # a lag leaves an error of its step
            P[sizes[block], sizes[block]] += size**2 * force**power
        P = phi @ P @ phi.T + q
        K = np.linalg.solve(H @ P @ H.T + sigma**2 * np.eye(len(u)), H @ P).T
        P = P - K @ H @ P
        P = phi @ (0.5 * (P + P.T)) @ phi.T + q
        if k * T >= min(JUMPS_S):
            trace.append(np.trace(P[:3, :3]))
    return float(np.sqrt(np.mean(trace)))
