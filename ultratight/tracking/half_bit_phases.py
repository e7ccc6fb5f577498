"""Model C with the two half-bit prompts kept apart: phase and frequency, both coherent.

y = (dr, p, dv) as in `measurements`, z = (I1, Q1, I2, Q2, S): with half h = 1, 2 centred T_h / 2
before and after t_mid, P_h its prompt with the data bit wiped off, A^2 its squared amplitude,

    I_h - j Q_h = P_h / A,      p_h = p -+ (T_h / 2) dv,
    h_I,h + j h_Q,h = R(d) sinc(f T_h) exp(j 2 pi p_h / wavelength),      h_S as in model D.

Both halves together are half a bit's prompt; apart they hold where a drift turns the phase of a
whole bit through pi, twice as far out (|sinc| > 0.5 up to 11.5 m/s in place of 5.7 m/s at L1).
"""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import borrowing, kernel
from ultratight.filters.conditioning import condition_on
from ultratight.filters.gaussian import Measurement
from ultratight.filters.rules import chain, place_projected, project_means, regress_projected
from ultratight.tracking.code_model import (
    CHIP,
    HALF,
    OFFSET,
    SPACING,
    WAVELENGTH,
    correlation,
    slope,
)
from ultratight.tracking.half_bits import PROMPT, Bits
from ultratight.tracking.measurements import NO_BITS
from ultratight.tracking.tap_model import TapModel

K = 5
"""Numbers per channel"""


class HalfBitPhases:
    """h for y = (dr, p, dv); ``params`` (nb, .) as of a `TapModel`."""

    def __init__(self, params: np.ndarray) -> None:
        self.params = params

    def __call__(self, y: np.ndarray) -> np.ndarray:
        """Predicted z (nb, p, 5) at points y (nb, p, 3)."""
        z, J = np.empty((*y.shape[:2], K)), np.empty((K, 3))
        _evaluate(y, self.params, z, J)
        return z

    def jacobian(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z (nb, 5) and dz/dy (nb, 5, 3) at y (nb, 3).

        As in `tap_functions` the prompt's R(d) counts as constant.
        """
        z, J = np.empty((y.shape[0], K)), np.empty((y.shape[0], K, 3))
        _tangent(y, self.params, z, J)
        return z, J

    def condition(self, inner: int, *arrays: np.ndarray) -> float:
        """The update in one call, see `ultratight.filters.gaussian.CompiledModel`."""
        return _condition(self.params, *arrays)


def kept_apart(
    coherent: Measurement,
    bits: Bits,
    pilot: np.ndarray,
    data_bits: np.ndarray | None,
    first_bit: int,
) -> Measurement:
    """The coherent measurement of the same bits, its prompt replaced by those of the halves.

    pilot (n_channel,) bool and data_bits (n_channel, n_bit) as in `measurements.measure`.
    """
    model = coherent.h
    if not isinstance(model, TapModel):
        raise TypeError(f"half-bit prompts: h is {type(model).__name__}, expected a TapModel")
    nb = bits.channel.size
    z, R = np.empty((nb, K)), np.zeros((nb, K, K))
    _keep_apart(
        bits.iq, bits.channel, bits.number, pilot, NO_BITS if data_bits is None else data_bits,
        first_bit, coherent.z, coherent.R, z, R,
    )  # fmt: skip
    apart = HalfBitPhases(model.params)
    return coherent._replace(z=z, R=R, h=apart, h_jacobian=apart.jacobian)


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def _condition(
    params: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
    lin_mean: np.ndarray,
    lin_cov: np.ndarray,
    z: np.ndarray,
    A: np.ndarray,
    R: np.ndarray,
    table: np.ndarray,
    nu: np.ndarray,
    H: np.ndarray,
    noise: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> float:
    """`Rule.linearise` at (lin_mean, lin_cov), then condition; returns the NIS."""
    nb, p = A.shape[0], table.shape[1]
    if p:
        Y, root = place_projected(lin_mean, lin_cov, A, table)
        Z = np.empty((nb, p, K))
        _evaluate(Y, params, Z, np.empty((K, 3)))
        zbar, slope, Omega = regress_projected(A, root, table, Z)
        H[:], noise[:] = slope, Omega
    else:
        at, J = np.empty((nb, K)), np.empty((nb, K, 3))
        _tangent(project_means(lin_mean, A), params, at, J)
        chain(J, A, H)
        zbar = at.reshape(-1)
        noise[:] = 0.0
    return condition_on(mean, cov, lin_mean, zbar, H, z, R, nu, noise, m1, P1)


@kernel
def _evaluate(y: np.ndarray, params: np.ndarray, z: np.ndarray, J: np.ndarray) -> None:
    for b in range(y.shape[0]):
        for i in range(y.shape[1]):
            _point(y[b, i], params[b], z[b, i], J, False)


@kernel
def _tangent(y: np.ndarray, params: np.ndarray, z: np.ndarray, J: np.ndarray) -> None:
    for b in range(y.shape[0]):
        _point(y[b], params[b], z[b], J[b], True)


@kernel
def _keep_apart(
    iq: np.ndarray,
    channel: np.ndarray,
    number: np.ndarray,
    pilot: np.ndarray,
    data_bits: np.ndarray,
    first_bit: int,
    whole_z: np.ndarray,
    whole_R: np.ndarray,
    z: np.ndarray,
    R: np.ndarray,
) -> None:
    """z (nb, 5) and the diagonal of R (nb, 5, 5), which is zero elsewhere."""
    for b in range(channel.size):
        i = channel[b]
        data = 1.0
        if data_bits.size > 0 and not pilot[i]:
            data = float(data_bits[i, number[b] - first_bit])
        variance = 2.0 * whole_R[b, 0, 0]  # that of the whole bit is 1 / (2 A^2)
        scale = data * math.sqrt(variance)
        for h in range(2):
            prompt = iq[b, h, PROMPT] * scale
            z[b, 2 * h], z[b, 2 * h + 1] = prompt.real, -prompt.imag
        z[b, 4] = whole_z[b, 2]
        for q in range(4):
            R[b, q, q] = variance
        R[b, 4, 4] = whole_R[b, 2, 2]


@borrowing
def _point(
    y: np.ndarray, params: np.ndarray, z: np.ndarray, J: np.ndarray, with_slope: bool
) -> None:
    """z (5,) at y (3,); J (5, 3) too, where it is wanted."""
    spacing, half = params[SPACING], params[HALF]
    d = (y[0] + params[OFFSET]) / params[CHIP]
    per_m = 2.0 * math.pi / params[WAVELENGTH]
    to_x = 0.5 * per_m * half
    x = to_x * y[2]
    if abs(x) < 1e-4:
        sinc, dsinc = 1.0 - x * x / 6.0, -x / 3.0
    else:
        sinc = math.sin(x) / x
        dsinc = (math.cos(x) - sinc) / x
    r = correlation(d, params)
    split = correlation(d - spacing, params) - correlation(d + spacing, params)
    z[4] = sinc * sinc * r * split
    if with_slope:
        J[:] = 0.0
        steep = slope(d - spacing, params) - slope(d + spacing, params)
        J[4, 0] = sinc * sinc * r * steep / params[CHIP]
        J[4, 2] = 2.0 * sinc * dsinc * to_x * r * split
    for h in range(2):
        back = (h - 0.5) * half
        phase = per_m * (y[1] + back * y[2])
        c, s = math.cos(phase), math.sin(phase)
        z[2 * h], z[2 * h + 1] = r * sinc * c, r * sinc * s
        if with_slope:
            J[2 * h, 1], J[2 * h + 1, 1] = -per_m * z[2 * h + 1], per_m * z[2 * h]
            J[2 * h, 2] = r * dsinc * to_x * c + back * J[2 * h, 1]
            J[2 * h + 1, 2] = r * dsinc * to_x * s + back * J[2 * h + 1, 1]
