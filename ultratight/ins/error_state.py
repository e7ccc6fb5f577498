"""Error state of the integrated receiver: its layout, transition and process noise.

error = true - estimate, C_true = (I + [psi x]) C_est, all resolved in ECEF axes
(Groves, 2nd ed., 14.2.3, with the opposite sign of his errors):

    r' = v
    v' = grad(g) r - 2 W x v + psi x (C f) - C b_a [- C diag(f) s] + white
    psi' = -W x psi - C b_g + white
    b_a', b_g', s' = white                                      (random walks)
    cb' = cd + white S_f,   cd' = white S_g
    p_i' = -u_i . (v + psi x w) - u_i' . r + cd + the same white S_f   (carrier phase, metres)
    step: what the clock's noises did to all phases in this epoch, see `clock_step_into`

with u_i the unit vector to the satellite and w the velocity C (omega x lever arm) of the antenna
with respect to the IMU.  The biases of a Gauss-Markov sensor error (sigma, tau) beside a constant
turn-on bias are modelled as a random walk of density 2 sigma^2 / tau: mean reversion of their sum
would pull towards the wrong value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from signals.compiled import borrowing
from signals.constants import OMEGA_EARTH
from ultratight.ins.earth import gravity_gradient_into

R, V, PSI, ACCEL_BIAS, GYRO_BIAS, CB, CD, SCALE_FACTOR = 0, 3, 6, 9, 12, 15, 16, 17
"""First rows of the blocks, for kernels; the phases follow the scale factors, if any."""
N_WITH_SCALE = SCALE_FACTOR + 3
"""States with the accelerometer scale factors, without phases"""
CLOCK_SF, CLOCK_SG, SCALE, PHASE = 4, 5, 6, 7
"""Where `ProcessNoise` has them; before them the blocks from V on"""


@dataclass(frozen=True)
class Layout:
    """Where each quantity stands in the error state; built once, nobody counts rows."""

    n: int
    n_scale: int  # 0 or 3
    n_phase: int
    r: slice
    v: slice
    psi: slice
    accel_bias: slice
    gyro_bias: slice
    cb: slice
    cd: slice
    accel_scale_factor: slice  # empty without scale factors
    phase: slice  # empty without phases
    clock_step: slice  # empty without it

    @classmethod
    def build(
        cls, scale_factor: bool = False, n_phase: int = 0, clock_step: bool = False
    ) -> Layout:
        """17 states, + 3 accelerometer scale factors, + one carrier phase per channel, + step."""
        if n_phase < 0:
            raise ValueError(f"n_phase = {n_phase}: expected >= 0")
        n_scale = 3 if scale_factor else 0
        phase = SCALE_FACTOR + n_scale
        return cls(
            n=phase + n_phase + clock_step,
            n_scale=n_scale,
            n_phase=n_phase,
            r=slice(R, R + 3),
            v=slice(V, V + 3),
            psi=slice(PSI, PSI + 3),
            accel_bias=slice(ACCEL_BIAS, ACCEL_BIAS + 3),
            gyro_bias=slice(GYRO_BIAS, GYRO_BIAS + 3),
            cb=slice(CB, CB + 1),
            cd=slice(CD, CD + 1),
            accel_scale_factor=slice(SCALE_FACTOR, phase),
            phase=slice(phase, phase + n_phase),
            clock_step=slice(phase + n_phase, phase + n_phase + clock_step),
        )


class ProcessNoise(NamedTuple):
    """Power spectral densities of the white noises, per axis."""

    velocity: float  # velocity random walk squared [m2/s3]
    attitude: float  # angular random walk squared [rad2/s]
    accel_bias: float  # [m2/s5]
    gyro_bias: float  # [rad2/s3]
    clock_sf: float  # S_f = c^2 h0 / 2 [m2/s]
    clock_sg: float  # S_g = 2 pi^2 c^2 h_-2 [m2/s3]
    scale_factor: float = 0.0  # [1/s]
    phase: float = 0.0  # of each channel alone [m2/s]


def transition(
    layout: Layout,
    noise: ProcessNoise,
    r_eb_e: np.ndarray,
    C_b_e: np.ndarray,
    f_ib_b: np.ndarray,
    u: np.ndarray,
    T: float,
    antenna_velocity_e: np.ndarray | None = None,
    u_rate: np.ndarray | None = None,
    clock_lag_s: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Phi = I + F T + (F T)^2 / 2 and Q = T (Phi G Phi' + G) / 2 over an epoch of T seconds.

    Parameters
    ----------
    layout, noise
        Which states there are, and the densities on the diagonal of G.
    r_eb_e, C_b_e, f_ib_b : arrays (3,), (3, 3), (3,)
        Position, attitude and mean specific force (body axes) of the epoch, best at its middle.
    u : (n_phase, 3) array
        Unit vectors to the satellites of the carrier phases; unused rows when there are none.
    T : float
    antenna_velocity_e : (3,) array, optional
        C (omega_eb x lever arm), velocity of the antenna with respect to the IMU.
    u_rate : (n_phase, 3) array, optional
        Turn of the lines of sight [1/s]: some 1e-4, a velocity where the position error is metres.
    clock_lag_s : float
        Of a layout with the clock's step: see `clock_step_into`.

    Returns
    -------
    Phi, Q : (n, n) arrays
        Q is the trapezium rule: its error is O(T^3) (r-r and the like start there themselves).
    """
    if layout.n_phase > u.shape[0]:
        raise ValueError(f"u of shape {u.shape}: expected ({layout.n_phase}, 3) or more rows")
    w = (0.0, 0.0, 0.0) if antenna_velocity_e is None else tuple(map(float, antenna_velocity_e))
    du = np.zeros(u.shape) if u_rate is None else u_rate
    Phi, Q = np.empty((layout.n, layout.n)), np.empty((layout.n, layout.n))
    densities = np.array(noise, dtype=np.float64)
    work = np.empty((layout.n + 1, layout.n))
    transition_into(
        r_eb_e, C_b_e, f_ib_b, T, u, du, w, layout.n_scale, layout.n_phase, densities, work, Phi, Q
    )
    if layout.n > layout.clock_step.start:
        clock_step_into(T, clock_lag_s, layout.n_scale, layout.n_phase, densities, Phi, Q)
    return Phi, Q


# --- kernels --------------------------------------------------------------------------------


@borrowing
def system_matrix(
    r: np.ndarray,
    C: np.ndarray,
    f: np.ndarray,
    u: np.ndarray,
    du: np.ndarray,
    w: tuple[float, float, float],
    n_scale: int,
    n_phase: int,
    F: np.ndarray,
) -> None:
    """Write F (n, n) of x' = F x; see `transition` for the arguments."""
    F[:] = 0.0
    gravity_gradient_into(r, F[V : V + 3, R : R + 3])
    for i in range(3):
        F[R + i, V + i] = 1.0
        for j in range(3):
            F[V + i, ACCEL_BIAS + j] = -C[i, j]
            F[PSI + i, GYRO_BIAS + j] = -C[i, j]
            if n_scale:
                F[V + i, SCALE_FACTOR + j] = -C[i, j] * f[j]
    F[V, V + 1], F[V + 1, V] = 2.0 * OMEGA_EARTH, -2.0 * OMEGA_EARTH
    F[PSI, PSI + 1], F[PSI + 1, PSI] = OMEGA_EARTH, -OMEGA_EARTH
    x = C[0, 0] * f[0] + C[0, 1] * f[1] + C[0, 2] * f[2]
    y = C[1, 0] * f[0] + C[1, 1] * f[1] + C[1, 2] * f[2]
    z = C[2, 0] * f[0] + C[2, 1] * f[1] + C[2, 2] * f[2]
    F[V, PSI + 1], F[V, PSI + 2] = z, -y  # psi x (C f) = -[C f x] psi
    F[V + 1, PSI], F[V + 1, PSI + 2] = -z, x
    F[V + 2, PSI], F[V + 2, PSI + 1] = y, -x
    F[CB, CD] = 1.0
    p = SCALE_FACTOR + n_scale
    for i in range(n_phase):
        for j in range(3):
            F[p + i, V + j] = -u[i, j]
            F[p + i, R + j] = -du[i, j]
        # -u . (psi x w) = (u x w) . psi
        F[p + i, PSI] = u[i, 1] * w[2] - u[i, 2] * w[1]
        F[p + i, PSI + 1] = u[i, 2] * w[0] - u[i, 0] * w[2]
        F[p + i, PSI + 2] = u[i, 0] * w[1] - u[i, 1] * w[0]
        F[p + i, CD] = 1.0


@borrowing
def transition_into(
    r: np.ndarray,
    C: np.ndarray,
    f: np.ndarray,
    T: float,
    u: np.ndarray,
    du: np.ndarray,
    w: tuple[float, float, float],
    n_scale: int,
    n_phase: int,
    density: np.ndarray,
    work: np.ndarray,
    Phi: np.ndarray,
    Q: np.ndarray,
) -> None:
    """Phi and Q (n, n); density: a `ProcessNoise` as array; work (n + 1, n).

    F is sparse, and both products walk over its entries only.
    """
    n = Phi.shape[0]
    F, column = work[:n], work[n]
    system_matrix(r, C, f, u, du, w, n_scale, n_phase, F)
    for i in range(n):
        for j in range(n):
            Phi[i, j] = F[i, j] * T
        Phi[i, i] += 1.0
        for k in range(n):
            a = 0.5 * T * T * F[i, k]
            if a != 0.0:
                for j in range(n):
                    Phi[i, j] += a * F[k, j]

    first_phase = SCALE_FACTOR + n_scale
    Q[:] = 0.0
    for k in range(n + 1):
        # column k of Phi sqrt(G); the last is S_f, which enters the clock and every phase alike
        if k == n:
            g = density[CLOCK_SF]
            for i in range(n):
                column[i] = Phi[i, CB]
                for j in range(first_phase, n):
                    column[i] += Phi[i, j]
        else:
            g = _density(k, n_scale, density)
            for i in range(n):
                column[i] = Phi[i, k]
        if g == 0.0:
            continue
        for i in range(n):
            if column[i] != 0.0:
                for j in range(n):
                    # in this order the two halves of Q get the same bits
                    Q[i, j] += 0.5 * T * g * (column[i] * column[j])
        if k < n:
            Q[k, k] += 0.5 * T * g
    for i in range(CB, n):
        for j in range(CB, n):
            if (i == CB or i >= first_phase) and (j == CB or j >= first_phase):
                Q[i, j] += 0.5 * T * density[CLOCK_SF]


@borrowing
def clock_step_into(
    T: float, lag: float, n_scale: int, n_phase: int, density: np.ndarray, Phi: np.ndarray,
    Q: np.ndarray,
) -> None:  # fmt: skip
    """Rows and columns of the clock's step, the last state, in Phi and Q of `transition_into`.

    What saw the clock at t - lag - T has met none of the noise of the epoch [t - T, t] of T
    seconds, and yet cb, cd and p at t, carried back by the drift, hold all of it:

        step = int (white S_f) - int (y + lag) (white S_g) dy,   y = time since t - T.

    What saw it later is short of a share of the step (`tracking.measurements`).  The step is new
    in every epoch, nothing follows from it, and its estimate is dropped.  Of the clock's states
    Q becomes exact: the trapezium's T^3 / 2 of the drift's noise is T^3 / 3.
    """
    n = Phi.shape[0]
    w, first = n - 1, SCALE_FACTOR + n_scale
    sf, sg = density[CLOCK_SF] * T, density[CLOCK_SG] * T
    level = sf - sg * T * (T / 6.0 + lag / 2.0)
    for i in range(n):
        Phi[i, w], Phi[w, i], Q[i, w], Q[w, i] = 0.0, 0.0, 0.0, 0.0
    for i in range(CB, first + n_phase):
        if i == CB or i >= first:
            Q[i, w], Q[w, i] = level, level
            for j in range(CB, first + n_phase):
                if j == CB or j >= first:
                    Q[i, j] -= sg * T * T / 6.0
    Q[CD, w] = -sg * (0.5 * T + lag)
    Q[w, CD] = Q[CD, w]
    Q[w, w] = sf + sg * (T * T / 3.0 + lag * (T + lag))


@borrowing
def _density(k: int, n_scale: int, density: np.ndarray) -> float:
    """Diagonal of G, without the clock's S_f."""
    if k < V or k == CB:
        return 0.0
    if k < CB:
        return density[(k - V) // 3]  # velocity, attitude, accelerometer and gyro bias
    if k == CD:
        return density[CLOCK_SG]
    return density[SCALE] if k < SCALE_FACTOR + n_scale else density[PHASE]
