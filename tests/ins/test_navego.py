"""A loosely coupled filter from our parts on data and against bars from outside.

The data are NaveGo's synthetic example (LGPL-3): 437 s of a car at 200 Hz with the errors of an
ADIS16488 (16 mg and 0.2 deg/s of turn-on bias), GNSS at 5 Hz with 5, 5, 10 m and 0.051 m/s.  A
minimal 15-state filter written by others reaches 0.23, 0.36, 0.50 m, 0.016 m/s and 0.02, 0.03,
0.09 deg after 60 s; the bars here leave a tenth more for our different first errors.
"""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from ultratight.filters.gaussian import Gaussian, Measurement, predict, update
from ultratight.filters.rules import RULES
from ultratight.ins.attitude import euler_from_rotation, rotation_from_euler
from ultratight.ins.earth import ecef_from_geodetic, rotation_e_from_n
from ultratight.ins.error_state import Layout, ProcessNoise, transition
from ultratight.ins.imu import Increments
from ultratight.ins.strapdown import NavState, correct, trace

DATA = Path(__file__).parents[3] / "shared" / "data" / "ins" / "navego_synthetic"
pytestmark = pytest.mark.skipif(
    not DATA.exists(), reason="needs the reference data folder beside the repository"
)
LAYOUT = Layout.build()
PIECE = 10  # IMU intervals per transition: 50 ms


def load(name):
    content = scipy.io.loadmat(DATA / f"{name}.mat", squeeze_me=True, struct_as_record=False)
    return content[name]


def increments(imu):
    """Rates at t[k] are means over the interval that ends there."""
    dt = np.diff(imu.t)[:, None]
    return Increments(imu.t, imu.wb[1:] * dt, imu.fb[1:] * dt)


def first_state(ref, imu, rng):
    """Truth plus errors of the stated sizes, and their covariance."""
    C_n_e = rotation_e_from_n(ref.lat[0], ref.lon[0])
    C = C_n_e @ rotation_from_euler(ref.roll[0], ref.pitch[0], ref.yaw[0])
    r = ecef_from_geodetic(ref.lat[0], ref.lon[0], ref.h[0])
    state = NavState(float(imu.t[0]), r, C_n_e @ ref.vel[0], C)
    sigma = np.zeros(17)
    sigma[LAYOUT.r], sigma[LAYOUT.v], sigma[LAYOUT.psi] = 5.0, 0.1, np.radians(0.5)
    wrong = correct(state, sigma * rng.standard_normal(17))
    sigma[LAYOUT.accel_bias], sigma[LAYOUT.gyro_bias] = imu.ab_sta[0], imu.gb_sta[0]
    cov = np.diag(sigma**2)
    yaw_axis = C_n_e[:, 2]
    cov[LAYOUT.psi, LAYOUT.psi] += np.radians(0.9) ** 2 * np.outer(yaw_axis, yaw_axis)
    yaw = np.zeros(17)
    yaw[LAYOUT.psi] = np.radians(0.9) * rng.standard_normal() * yaw_axis
    return correct(wrong, yaw), cov


def fix(gnss, k, state):
    """Position and velocity of fix k as one linear block of measurements of the error state."""
    C_n_e = rotation_e_from_n(gnss.lat[k], gnss.lon[k])
    assert not np.any(gnss.larm)  # no lever arm in these data
    z = np.zeros((1, 6))
    z[0, :3] = ecef_from_geodetic(gnss.lat[k], gnss.lon[k], gnss.h[k]) - state.r_eb_e
    z[0, 3:] = C_n_e @ gnss.vel[k] - state.v_eb_e
    R = np.zeros((1, 6, 6))
    R[0, :3, :3] = C_n_e @ np.diag(gnss.stdm.astype(float) ** 2) @ C_n_e.T
    R[0, 3:, 3:] = C_n_e @ np.diag(gnss.stdv**2) @ C_n_e.T
    A = np.eye(6, 17)[None]
    return Measurement(
        z, A, R, lambda y: y, lambda y: (y, np.eye(6)[None]), np.zeros(1, dtype=np.int64)
    )


def run(ref, imu, gnss, seed):
    """Times, errors of position NED [m], velocity NED [m/s] and angles [deg], NIS, at every fix."""
    inc = increments(imu)
    noise = ProcessNoise(
        float(imu.vrw[0]) ** 2,
        float(imu.arw[0]) ** 2,
        2 * float(imu.ab_dyn[0]) ** 2 / float(imu.ab_corr[0]),
        2 * float(imu.gb_dyn[0]) ** 2 / float(imu.gb_corr[0]),
        1e-6,
        1e-6,
    )
    state, cov = first_state(ref, imu, np.random.default_rng(seed))
    errors, nis = [], []
    none = np.zeros((0, 3))
    previous = None
    node = 0
    for k in range(1, gnss.t.size):
        end = round(gnss.t[k] * 200)
        while node < end:
            stop = min(node + PIECE, end)
            part = Increments(
                inc.t_s[node : stop + 1], inc.alpha_ib_b[node:stop], inc.nu_ib_b[node:stop]
            )
            r, v, C = trace(state, part, previous)
            T = float(part.t_s[-1] - part.t_s[0])
            force = part.nu_ib_b.sum(axis=0) / T - state.accel_bias
            middle = (stop - node) // 2
            Phi, Q = transition(LAYOUT, noise, r[middle], C[middle], force, none, T)
            cov = predict(Gaussian(np.zeros(17), cov), Phi, Q).cov
            state = state._replace(t_s=float(part.t_s[-1]), r_eb_e=r[-1], v_eb_e=v[-1], C_b_e=C[-1])
            previous, node = part, stop
        posterior = update(Gaussian(np.zeros(17), cov), fix(gnss, k, state), RULES["linearised"])
        state, cov = correct(state, posterior.mean), posterior.cov
        nis.append(posterior.nis)
        C_n_e = rotation_e_from_n(ref.lat[node], ref.lon[node])
        true_r = ecef_from_geodetic(ref.lat[node], ref.lon[node], ref.h[node])
        true = np.array([ref.roll[node], ref.pitch[node], ref.yaw[node]])
        angles = euler_from_rotation(C_n_e.T @ state.C_b_e) - true
        errors.append(
            np.concatenate(
                [
                    C_n_e.T @ (state.r_eb_e - true_r),
                    C_n_e.T @ state.v_eb_e - ref.vel[node],
                    np.degrees((angles + np.pi) % (2 * np.pi) - np.pi),
                ]
            )
        )
    return gnss.t[1:], np.array(errors), np.array(nis)


def test_loosely_coupled_navego():
    ref, imu, gnss = load("ref"), load("imu2"), load("gnss")
    t, error, nis = run(ref, imu, gnss, seed=1)
    late = t > 60.0
    rms = np.sqrt(np.mean(error[late] ** 2, axis=0))
    assert np.all(rms[:3] < [0.26, 0.40, 0.55])
    assert np.all(rms[3:6] < 0.018)
    assert np.all(rms[6:] < [0.025, 0.035, 0.10])
    # six numbers a fix: mean of chi2(6) over n fixes has the standard deviation sqrt(12 / n)
    assert nis[late].mean() == pytest.approx(6.0, abs=4 * np.sqrt(12 / late.sum()))
