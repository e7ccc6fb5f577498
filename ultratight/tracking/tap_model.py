"""What the taps of a data bit would say at given errors: h and its Jacobian, models D and C.

`measurements` has the formulas.  The filter's moments are sums of h over points of its own
choosing, channel after channel: `TapModel.condition` finds them, linearises and updates in one
compiled call.  Points lie in rows, (d, p), so that h is a handful of loops over p.
"""

from __future__ import annotations

import numpy as np

from signals.compiled import FAST_SUM, kernel
from signals.constants import C_MPS, CA_CHIP_RATE_HZ
from ultratight.filters.conditioning import condition_on
from ultratight.filters.rules import chain, project_mean, project_root, regress, scatter
from ultratight.tracking.steering import WAVELENGTH_M

CHIP_M = C_MPS / CA_CHIP_RATE_HZ
TINY = 1e-100
"""sin x / x is exactly 1 here"""


class TapModel:
    """h of model D for y = (dr, dv), of model C for y = (dr, p, dv).

    ``params`` (nb, 4): R at one chip, known code offset [m], T_h [s], spacing [chips].
    """

    def __init__(self, params: np.ndarray) -> None:
        self.params = params

    def __call__(self, y: np.ndarray) -> np.ndarray:
        """Predicted z (nb, p, 3) at points y (nb, p, d)."""
        z = np.empty((y.shape[0], y.shape[1], 3))
        _evaluate(y, self.params, z)
        return z

    def jacobian(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z (nb, 3) and dz/dy (nb, 3, d) at y (nb, d)."""
        J = np.empty((y.shape[0], 3, y.shape[1]))
        _jacobians(y, self.params, J)
        return self(y[:, None, :])[:, 0], J

    def condition(self, *arrays: np.ndarray) -> float:
        """The update in one call, see `ultratight.filters.gaussian.CompiledModel`."""
        return _condition(self.params, *arrays)


# ---------------------------------------------------------------------------------- kernels


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
    nb, d, _ = A.shape
    p = table.shape[1]
    y, L = np.empty(d), np.empty((d, d))
    zbar, G = np.empty((nb, 3)), np.empty((nb, 3, d))
    Y, Z = np.empty((d, max(p, 1))), np.empty((3, max(p, 1)))
    for b in range(nb):
        project_mean(A[b], lin_mean, y)
        if p == 0:
            Y[:, 0] = y
            _taps(Y, params[b], Z)
            zbar[b] = Z[:, 0]
            _jacobian(y, params[b], G[b])
            noise[b] = 0.0
        else:
            project_root(A[b], lin_cov, L)
            scatter(y, L, table, Y)
            _taps(Y, params[b], Z)
            regress(L, table, Z, zbar[b], G[b], noise[b])
    chain(G, A, H)
    return condition_on(mean, cov, lin_mean, zbar.reshape(-1), H, z, R, nu, noise, m1, P1)


@kernel
def _evaluate(y: np.ndarray, params: np.ndarray, z: np.ndarray) -> None:
    """z (nb, p, 3) at y (nb, p, d)."""
    points, values = np.empty((y.shape[2], y.shape[1])), np.empty((3, y.shape[1]))
    for b in range(y.shape[0]):
        points[:] = y[b].T
        _taps(points, params[b], values)
        z[b] = values.T


@kernel
def _jacobians(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    for b in range(y.shape[0]):
        _jacobian(y[b], params[b], J[b])


@kernel
def _taps(y: np.ndarray, params: np.ndarray, z: np.ndarray) -> None:
    """h of one channel: z (3, p) at y (d, p)."""
    if y.shape[0] == 2:
        _differential(y, params, z)
    else:
        _coherent(y, params, z)


@kernel
def _jacobian(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    """dz/dy (3, d) of one channel at y (d,)."""
    if y.size == 2:
        _jacobian_differential(y, params, J)
    else:
        _jacobian_coherent(y, params, J)


@kernel(fastmath={"contract"})
def sin_cos(x: np.ndarray, s: np.ndarray, c: np.ndarray) -> None:
    """Sine and cosine of x (p,), without branches or tables so that the loop is vectorised.

    x = k pi + r, |r| <= pi/2, and Taylor polynomials of r whose remainders are below 2e-17.  The
    second part of pi needs the sums as they stand, hence no reassociation; |x| < 1e6.
    """
    for i in range(x.size):
        k = np.floor(x[i] * (1.0 / np.pi) + 0.5)
        r = (x[i] - k * np.pi) - k * 1.2246467991473532e-16
        sign = 1.0 - 2.0 * (k - 2.0 * np.floor(0.5 * k))
        q = r * r
        u = 1.0 / 51090942171709440000.0
        u = u * q - 1.0 / 121645100408832000.0
        u = u * q + 1.0 / 355687428096000.0
        u = u * q - 1.0 / 1307674368000.0
        u = u * q + 1.0 / 6227020800.0
        u = u * q - 1.0 / 39916800.0
        u = u * q + 1.0 / 362880.0
        u = u * q - 1.0 / 5040.0
        u = u * q + 1.0 / 120.0
        u = u * q - 1.0 / 6.0
        s[i] = sign * (r + r * q * u)
        u = 1.0 / 2432902008176640000.0
        u = u * q - 1.0 / 6402373705728000.0
        u = u * q + 1.0 / 20922789888000.0
        u = u * q - 1.0 / 87178291200.0
        u = u * q + 1.0 / 479001600.0
        u = u * q - 1.0 / 3628800.0
        u = u * q + 1.0 / 40320.0
        u = u * q - 1.0 / 720.0
        u = u * q + 1.0 / 24.0
        c[i] = sign * (1.0 - 0.5 * q + q * q * u)


@kernel
def correlation(d: float, lag1: float) -> float:
    """R(d): linear between the code's own values at lags 0 and 1, flat beyond."""
    return 1.0 - min(abs(d), 1.0) * (1.0 - lag1)


@kernel(fastmath=FAST_SUM)
def _differential(y: np.ndarray, params: np.ndarray, z: np.ndarray) -> None:
    lag1, offset, half, spacing = params[0], params[1], params[2], params[3]
    p = y.shape[1]
    x, s, c = np.empty(p), np.empty(p), np.empty(p)
    for i in range(p):
        turn = np.pi / WAVELENGTH_M * half * y[1, i]
        x[i] = turn if abs(turn) > TINY else TINY
    sin_cos(x, s, c)
    for i in range(p):
        d = (y[0, i] + offset) * (1.0 / CHIP_M)
        r = correlation(d, lag1)
        loss = r * (s[i] / x[i]) ** 2
        z[0, i] = r * loss * (c[i] * c[i] - s[i] * s[i])
        z[1, i] = r * loss * 2.0 * c[i] * s[i]
        z[2, i] = loss * (correlation(d - spacing, lag1) - correlation(d + spacing, lag1))


@kernel(fastmath=FAST_SUM)
def _coherent(y: np.ndarray, params: np.ndarray, z: np.ndarray) -> None:
    lag1, offset, half, spacing = params[0], params[1], params[2], params[3]
    p = y.shape[1]
    x, s, c = np.empty(p), np.empty(p), np.empty(p)
    phase, cos_x, sinc = np.empty(p), np.empty(p), np.empty(p)
    for i in range(p):
        turn = np.pi / WAVELENGTH_M * half * y[2, i]
        x[i] = turn if abs(turn) > TINY else TINY
        phase[i] = 2.0 * np.pi / WAVELENGTH_M * y[1, i]
    sin_cos(x, s, cos_x)
    for i in range(p):
        sinc[i] = s[i] / x[i]
    sin_cos(phase, s, c)
    for i in range(p):
        d = (y[0, i] + offset) * (1.0 / CHIP_M)
        r = correlation(d, lag1)
        amplitude = r * sinc[i] * cos_x[i]  # sinc(2 x) = sinc(x) cos(x)
        z[0, i] = amplitude * c[i]
        z[1, i] = amplitude * s[i]
        split = correlation(d - spacing, lag1) - correlation(d + spacing, lag1)
        z[2, i] = sinc[i] * sinc[i] * r * split


@kernel
def _slope(d: float, lag1: float) -> float:
    """dR/dd, zero at the kinks."""
    return 0.0 if abs(d) >= 1.0 else -np.sign(d) * (1.0 - lag1)


@kernel
def _sinc(x: float) -> float:
    return 1.0 - x * x / 6.0 if abs(x) < 1e-4 else np.sin(x) / x


@kernel
def _sinc_slope(x: float) -> float:
    return -x / 3.0 if abs(x) < 1e-4 else (np.cos(x) - np.sin(x) / x) / x


# In the Jacobians the prompt's R(d) counts as constant: its peak is a kink, whose one-sided slope
# would tell an extended Kalman filter a range error from the amplitude alone.


@kernel
def _jacobian_differential(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    lag1, offset, half, spacing = params[0], params[1], params[2], params[3]
    d = (y[0] + offset) / CHIP_M
    to_x = np.pi / WAVELENGTH_M * half
    x = to_x * y[1]
    s = _sinc(x)
    ds = _sinc_slope(x)
    r = correlation(d, lag1)
    split = correlation(d - spacing, lag1) - correlation(d + spacing, lag1)
    split_slope = _slope(d - spacing, lag1) - _slope(d + spacing, lag1)
    c, q = np.cos(2.0 * x), np.sin(2.0 * x)
    J[:] = 0.0
    J[0, 1] = r * r * to_x * (2.0 * s * ds * c - 2.0 * s * s * q)
    J[1, 1] = r * r * to_x * (2.0 * s * ds * q + 2.0 * s * s * c)
    J[2, 0] = s * s * r * split_slope / CHIP_M
    J[2, 1] = 2.0 * s * ds * to_x * r * split


@kernel
def _jacobian_coherent(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    lag1, offset, half, spacing = params[0], params[1], params[2], params[3]
    d = (y[0] + offset) / CHIP_M
    phase = 2.0 * np.pi * y[1] / WAVELENGTH_M
    to_x = np.pi / WAVELENGTH_M * half
    x = to_x * y[2]
    s, s2 = _sinc(x), _sinc(2.0 * x)
    r = correlation(d, lag1)
    split = correlation(d - spacing, lag1) - correlation(d + spacing, lag1)
    split_slope = _slope(d - spacing, lag1) - _slope(d + spacing, lag1)
    c, q = np.cos(phase), np.sin(phase)
    J[:] = 0.0
    J[0, 1] = -r * s2 * q * 2.0 * np.pi / WAVELENGTH_M
    J[1, 1] = r * s2 * c * 2.0 * np.pi / WAVELENGTH_M
    J[0, 2] = r * c * _sinc_slope(2.0 * x) * 2.0 * to_x
    J[1, 2] = r * q * _sinc_slope(2.0 * x) * 2.0 * to_x
    J[2, 0] = s * s * r * split_slope / CHIP_M
    J[2, 2] = 2.0 * s * _sinc_slope(x) * to_x * r * split
