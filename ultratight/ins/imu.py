"""Inertial measurement unit: increments, and what real sensors do to them.

    f_meas     = clip(M_a LP(f) + b_a, +-saturation) + white
    omega_meas = M_g omega + G_g f + b_g + white

with M = I + diag(scale factor) + misalignment, LP a first-order lag, b a turn-on constant plus a
first-order Gauss-Markov process and G_g the gyros' g-dependence (Groves, 2nd ed., 4.16-4.18).
All of it acts on increments, so a lag of zero and errors of zero return the truth bit for bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.constants import STANDARD_GRAVITY
from signals.noise import generator


class Increments(NamedTuple):
    """What an IMU hands over: integrals between the nodes t_s."""

    t_s: np.ndarray  # (m + 1,) receiver time [s]
    alpha_ib_b: np.ndarray  # (m, 3) integral of omega_ib_b, body axes [rad]
    nu_ib_b: np.ndarray  # (m, 3) integral of f_ib_b, body axes [m/s]


# Units of data sheets, to SI.


def deg_per_h(x: float) -> float:
    """deg/h -> rad/s."""
    return math.radians(x) / 3600.0


def deg_per_sqrt_h(x: float) -> float:
    """deg/sqrt(h) -> rad/sqrt(s)."""
    return math.radians(x) / 60.0


def deg_per_h_per_g(x: float) -> float:
    """deg/h/g -> rad/s per m/s2."""
    return deg_per_h(x) / STANDARD_GRAVITY


def mg(x: float) -> float:
    """1e-3 g -> m/s2."""
    return x * 1e-3 * STANDARD_GRAVITY


def ug(x: float) -> float:
    """1e-6 g -> m/s2; also ug/sqrt(Hz) -> m/s/sqrt(s)."""
    return x * 1e-6 * STANDARD_GRAVITY


def mps_per_sqrt_h(x: float) -> float:
    """m/s/sqrt(h) -> m/s/sqrt(s)."""
    return x / 60.0


def ppm(x: float) -> float:
    """1e-6 -> 1."""
    return x * 1e-6


@dataclass(frozen=True)
class ImuErrors:
    """Error model of an IMU, in SI units; the default has none.

    Unless fixed, a value is the standard deviation of a normal draw, one per axis or per element.
    """

    accel_bias_turn_on: float = 0.0  # constant during a run [m/s2]
    accel_bias_in_run: float = 0.0  # steady-state sigma of the Gauss-Markov process [m/s2]
    accel_bias_tau_s: float = 100.0  # its correlation time [s]
    vrw: float = 0.0  # velocity random walk [m/s/sqrt(s)]
    accel_scale_factor: tuple[float, float, float] = (0.0, 0.0, 0.0)  # fixed, see `corrupt`
    accel_scale_factor_sigma: float = 0.0  # drawn, in addition
    accel_misalignment: float = 0.0  # each off-diagonal element [rad]
    lag_s: float = 0.0  # fixed time constant of the accelerometers [s]
    saturation_mps2: float | None = None  # fixed; None or inf: off
    gyro_bias_turn_on: float = 0.0  # [rad/s]
    gyro_bias_in_run: float = 0.0  # [rad/s]
    gyro_bias_tau_s: float = 100.0  # [s]
    arw: float = 0.0  # angular random walk [rad/sqrt(s)]
    gyro_scale_factor_sigma: float = 0.0
    gyro_misalignment: float = 0.0  # [rad]
    gyro_g_dependence: float = 0.0  # each element of G_g [rad/s per m/s2]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "accel_scale_factor":
                if len(value) != 3 or not all(math.isfinite(x) for x in value):
                    raise ValueError(f"accel_scale_factor = {value}: expected three finite numbers")
            elif field.name == "saturation_mps2":
                if value is not None and not value > 0.0:
                    raise ValueError(f"saturation_mps2 = {value}: expected > 0, or None for off")
            elif not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{field.name} = {value}: expected a finite number >= 0")
            elif field.name.endswith("tau_s") and value == 0.0:
                raise ValueError(f"{field.name} = 0: expected a correlation time > 0")


_INDUSTRIAL = ImuErrors(
    accel_bias_turn_on=mg(1.0),
    accel_bias_in_run=ug(50.0),
    vrw=1e-3,
    accel_misalignment=0.3e-3,
    lag_s=2.5e-3,
    gyro_bias_turn_on=deg_per_h(10.0),
    gyro_bias_in_run=deg_per_h(2.0),
    arw=4.4e-5,
    gyro_scale_factor_sigma=ppm(300.0),
    gyro_g_dependence=deg_per_h_per_g(2.0),
)
# biases and white noise of the grade above, nothing else: the model that the filters hold
_MATCHED = ImuErrors(
    accel_bias_turn_on=_INDUSTRIAL.accel_bias_turn_on,
    accel_bias_in_run=_INDUSTRIAL.accel_bias_in_run,
    vrw=_INDUSTRIAL.vrw,
    gyro_bias_turn_on=_INDUSTRIAL.gyro_bias_turn_on,
    gyro_bias_in_run=_INDUSTRIAL.gyro_bias_in_run,
    arw=_INDUSTRIAL.arw,
)

GRADES: dict[str, ImuErrors] = {
    "perfect": ImuErrors(),
    "matched": _MATCHED,
    "noise-only": _MATCHED,
    # MEMS of the better kind; set the scale factor to what its temperature calibration leaves
    "industrial-mems": _INDUSTRIAL,
    # The three sensors of the demonstrations on the CD of Groves, 2nd ed. (Inertial_Demo_1 to 3):
    # r.m.s. over the axes of the biases, middle of the range of the other errors.
    "navigation": ImuErrors(
        accel_bias_turn_on=ug(34.6),
        vrw=ug(20.0),
        accel_scale_factor_sigma=ppm(105.0),
        accel_misalignment=120e-6,
        gyro_bias_turn_on=deg_per_h(0.00102),
        arw=deg_per_sqrt_h(0.002),
        gyro_scale_factor_sigma=ppm(7.0),
        gyro_misalignment=120e-6,
    ),
    "tactical": ImuErrors(
        accel_bias_turn_on=ug(1023.0),
        vrw=ug(100.0),
        accel_scale_factor_sigma=ppm(525.0),
        gyro_bias_turn_on=deg_per_h(10.2),
        arw=deg_per_sqrt_h(0.01),
        gyro_scale_factor_sigma=ppm(350.0),
        gyro_g_dependence=deg_per_h_per_g(1.1),
    ),
    "consumer": ImuErrors(
        accel_bias_turn_on=ug(10230.0),
        vrw=ug(1000.0),
        accel_scale_factor_sigma=ppm(40_000.0),
        gyro_bias_turn_on=deg_per_h(205.0),
        arw=deg_per_sqrt_h(1.0),
        gyro_scale_factor_sigma=ppm(28_750.0),
        gyro_g_dependence=deg_per_h_per_g(110.0),
    ),
    # Honeywell brochure N61-1619: 1 mg, 0.065 ft/s/sqrt(h) at most, 1 deg/h, 0.125 deg/sqrt(h)
    "hg1700": ImuErrors(
        accel_bias_turn_on=mg(1.0),
        vrw=mps_per_sqrt_h(0.0198),
        gyro_bias_turn_on=deg_per_h(1.0),
        arw=deg_per_sqrt_h(0.125),
    ),
    # Tang, Niu et al., KF-GINS, table 1: Gauss-Markov biases of 4 h; no turn-on bias is given
    "leador-a15": ImuErrors(
        accel_bias_in_run=mg(0.0153),
        accel_bias_tau_s=4 * 3600.0,
        vrw=mps_per_sqrt_h(0.03),
        accel_scale_factor_sigma=ppm(300.0),
        gyro_bias_in_run=deg_per_h(0.027),
        gyro_bias_tau_s=4 * 3600.0,
        arw=deg_per_sqrt_h(0.003),
        gyro_scale_factor_sigma=ppm(300.0),
    ),
    # Analog Devices data sheets (rev. G and B) as read by NaveGo's example, correlation times its
    "adis16488": ImuErrors(
        accel_bias_turn_on=mg(16.0),
        accel_bias_in_run=mg(0.1),
        vrw=mps_per_sqrt_h(0.029),
        gyro_bias_turn_on=deg_per_h(720.0),
        gyro_bias_in_run=deg_per_h(6.5),
        arw=deg_per_sqrt_h(0.3),
    ),
    "adis16405": ImuErrors(
        accel_bias_turn_on=mg(50.0),
        accel_bias_in_run=mg(0.2),
        vrw=mps_per_sqrt_h(0.2),
        gyro_bias_turn_on=deg_per_h(10_800.0),
        gyro_bias_in_run=deg_per_h(25.2),
        arw=deg_per_sqrt_h(2.0),
    ),
}
"""Error models by name"""


def corrupt(
    true: Increments, errors: ImuErrors, seed: int, sign: float = 1.0
) -> tuple[Increments, dict[str, np.ndarray]]:
    """Measured increments, and the errors that were drawn.

    Each noise source has its own stream ``imu.<sensor>.<source>`` of ``seed``: changing one source
    leaves the others' bits alone, and a longer run begins like a shorter one.  ``sign`` multiplies
    the fixed ``accel_scale_factor`` (campaigns alternate it).  The lag is at rest at the first
    force, and exact for a force that is constant inside each interval.

    Returns
    -------
    increments : Increments
    truth : dict
        ``accel_bias`` [m/s2] and ``gyro_bias`` [rad/s] (m + 1, 3) at the nodes (an increment has
        the mean of its two nodes); ``accel_matrix``, ``gyro_matrix``, ``g_dependence`` (3, 3);
        ``accel_scale_factor`` (3,), the diagonal of accel_matrix - I.
    """
    dt = np.diff(true.t_s)
    m = dt.size
    if m == 0 or true.alpha_ib_b.shape != (m, 3) or true.nu_ib_b.shape != (m, 3):
        raise ValueError(f"increments over {m} intervals: expected alpha, nu of shape ({m}, 3)")
    if not np.all(dt > 0.0):
        raise ValueError("t_s of the increments: expected strictly increasing times")
    e = errors
    scale = sign * np.array(e.accel_scale_factor)
    scale = scale + _draw(seed, "accel.scale_factor", e.accel_scale_factor_sigma, 3)
    accel_matrix = _matrix(seed, "accel.misalignment", scale, e.accel_misalignment)
    gyro_scale = _draw(seed, "gyro.scale_factor", e.gyro_scale_factor_sigma, 3)
    gyro_matrix = _matrix(seed, "gyro.misalignment", gyro_scale, e.gyro_misalignment)
    g_dependence = _draw(seed, "gyro.g_dependence", e.gyro_g_dependence, (3, 3))
    accel_bias = _bias(
        seed, "accel", e.accel_bias_turn_on, e.accel_bias_in_run, e.accel_bias_tau_s, dt
    )
    gyro_bias = _bias(seed, "gyro", e.gyro_bias_turn_on, e.gyro_bias_in_run, e.gyro_bias_tau_s, dt)

    felt = true.nu_ib_b
    if e.lag_s > 0.0:
        felt = np.empty_like(felt)
        _lag(np.ascontiguousarray(true.nu_ib_b), dt, e.lag_s, felt)
    step = dt[:, None]
    nu = felt @ accel_matrix.T + 0.5 * (accel_bias[1:] + accel_bias[:-1]) * step
    if e.saturation_mps2 is not None:
        nu = np.clip(nu, -e.saturation_mps2 * step, e.saturation_mps2 * step)
    nu = nu + _draw(seed, "accel.white", e.vrw, (m, 3)) * np.sqrt(step)
    alpha = true.alpha_ib_b @ gyro_matrix.T + true.nu_ib_b @ g_dependence.T
    alpha = alpha + 0.5 * (gyro_bias[1:] + gyro_bias[:-1]) * step
    alpha = alpha + _draw(seed, "gyro.white", e.arw, (m, 3)) * np.sqrt(step)
    return Increments(true.t_s, alpha, nu), {
        "accel_bias": accel_bias,
        "gyro_bias": gyro_bias,
        "accel_matrix": accel_matrix,
        "gyro_matrix": gyro_matrix,
        "g_dependence": g_dependence,
        "accel_scale_factor": scale,
    }


def _draw(seed: int, source: str, sigma: float, shape: int | tuple[int, ...]) -> np.ndarray:
    if sigma == 0.0:
        return np.zeros(shape)
    return sigma * generator(seed, f"imu.{source}").standard_normal(shape)


def _matrix(seed: int, source: str, scale: np.ndarray, misalignment: float) -> np.ndarray:
    M = _draw(seed, source, misalignment, (3, 3))
    np.fill_diagonal(M, 1.0 + scale)
    return M


def _bias(
    seed: int, sensor: str, turn_on: float, in_run: float, tau_s: float, dt: np.ndarray
) -> np.ndarray:
    """(m + 1, 3): turn-on constant + stationary Gauss-Markov process, exact at the nodes."""
    b = np.zeros((dt.size + 1, 3)) + _draw(seed, f"{sensor}.turn_on", turn_on, 3)
    if in_run > 0.0:
        noise = _draw(seed, f"{sensor}.in_run", in_run, (dt.size + 1, 3))
        _gauss_markov(np.exp(-dt / tau_s), noise)
        b += noise
    return b


# --- kernels --------------------------------------------------------------------------------


@kernel
def _gauss_markov(phi: np.ndarray, x: np.ndarray) -> None:
    """x[k + 1] <- phi[k] x[k] + sqrt(1 - phi[k]^2) x[k + 1], in place: white to Gauss-Markov."""
    for k in range(phi.shape[0]):
        fresh = math.sqrt(1.0 - phi[k] * phi[k])
        for i in range(x.shape[1]):
            x[k + 1, i] = phi[k] * x[k, i] + fresh * x[k + 1, i]


@kernel
def _lag(nu: np.ndarray, dt: np.ndarray, tau: float, out: np.ndarray) -> None:
    """Integral over each interval of y, tau y' = f - y, for f constant in it; nu = f dt."""
    for i in range(3):
        y = nu[0, i] / dt[0]
        for k in range(dt.shape[0]):
            f = nu[k, i] / dt[k]
            gone = -math.expm1(-dt[k] / tau)
            out[k, i] = nu[k, i] + (y - f) * tau * gone
            y += (f - y) * gone
