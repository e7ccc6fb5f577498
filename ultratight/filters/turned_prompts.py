"""Half-bit prompts whose phase turns while they are integrated, by their exact complex mean.

A velocity or a drift that steps inside an integration turns the phase only from then on.  While
that is a fraction of a radian the mean prompt has the mean phase and full size, which is what
`seen_from_a_step` and the model of the half bits rest on.  With

    g = (1/h) integral of exp(j k d max(t - t0, 0)) dt       (half bit of length h, d in m/s)

neither holds beyond: 9 m/s at L1 turn half a bit through 3 rad.  Two such steps are told apart:

* one to be estimated (`stepped`): the prompts of the model are multiplied by g, d a fourth number
  of each channel.  Bit edges differ from satellite to satellite, hence few (t0, d) serve all of
  them, and a search finds the right ones (`searched`) where a Gaussian about the prior would
  settle on a wrong one;
* one that the receiver made (`freed_of_kink`): the feedback of the epoch before moved phase and
  rate of the NCO, and the integrations under way at that time are freed of its mean turn only.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import leggauss

from ultratight.filters.gaussian import Gaussian, Measurement, Prediction
from ultratight.filters.quadrature import gauss_hermite
from ultratight.filters.rules import Rule

REACH_MPS, STEP_MPS = 50.0, 0.4
"""Drifts that are tried"""
INSTANTS = 8
"""Instants of a step that are tried, per epoch"""
CLEARLY = 20.0
"""Fall of the squares [sigma^2] that speaks for another instant than the start of the epoch"""
SMALLEST = 1e-3
"""|g|^2 below which a prompt counts as that small: it says nothing either way"""
KINK_RAD = 0.2
"""A feedback of phase below is none"""
_INSTANT, _WEIGHT = leggauss(12)
_INSTANT, _WEIGHT = 0.5 * (1.0 + _INSTANT), 0.5 * _WEIGHT


def _points(d: int) -> tuple[np.ndarray, np.ndarray]:
    return gauss_hermite((3, 5, 3, 5), d)


STEPPED = Rule(
    "gh3x5x3x5", "projected", _points, "Gauss-Hermite tensor: range, phase, rate, step of the rate"
)
"""For the four numbers of `stepped`"""


def are_half_bits(measurement: Measurement) -> bool:
    """z = (I1, Q1, I2, Q2, S) with known times?"""
    nb, k = measurement.z.shape
    return measurement.span is not None and nb > 0 and k == 5


class SteppedPrompts:
    """h for y = (dr, p, dv, d): range, phase and rate before the step, how far the rate stepped.

    ``measurement`` has the model without a step; radians (nb, 2, m) turned per m/s at instants of
    that share (nb, 2) of each half which lies after it.
    """

    def __init__(self, measurement: Measurement, radians: np.ndarray, share: np.ndarray) -> None:
        self.h, self.h_jacobian = measurement.h, measurement.h_jacobian
        self.radians, self.share = radians, share

    def __call__(self, y: np.ndarray) -> np.ndarray:
        """Predicted z (nb, p, 5) at points y (nb, p, 4)."""
        z = self.h(np.ascontiguousarray(y[..., :3]))
        g = (
            1.0
            - self.share[:, None]
            + self.share[:, None]
            * (np.exp(1j * self.radians[:, None] * y[..., 3, None, None]) @ _WEIGHT)
        )
        return _times(z, g)

    def jacobian(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z (nb, 5) and dz/dy (nb, 5, 4) at y (nb, 4)."""
        z, J = self.h_jacobian(np.ascontiguousarray(y[:, :3]))
        turn = np.exp(1j * self.radians * y[:, 3, None, None])
        g = 1.0 - self.share + self.share * (turn @ _WEIGHT)
        slope = self.share * ((1j * self.radians * turn) @ _WEIGHT)
        out = np.empty((*z.shape, 4))
        for j in range(3):
            out[..., j] = _times(J[..., j], g)
        out[..., 3] = _times(z, slope)
        out[:, 4, 3] = z[:, 4] * 2.0 * (g.conj() * slope).real.mean(axis=1)
        return _times(z, g), out


def stepped(measurement: Measurement, prediction: Prediction, late_s: float = 0.0) -> Measurement:
    """The measurement of velocity and drift that step so late after the start of this epoch."""
    layout = prediction.layout
    first, last, h = _halves(measurement, prediction)
    before, after = np.maximum(first - late_s, 0.0), np.maximum(last - late_s, 0.0)
    k = radians_per_metre(measurement)[:, None, None]
    radians = k * (before[..., None] + (after - before)[..., None] * _INSTANT)
    columns = np.r_[layout.v, layout.cd]
    nb, _, n = measurement.A.shape
    A = np.zeros((nb, 4, n))
    A[:, :3] = measurement.A
    A[:, 3, columns] = A[:, 2, columns]
    A[:, 1, columns] = (late_s - prediction.T) * A[:, 2, columns]
    A[:, 2, columns] = 0.0
    model = SteppedPrompts(measurement, radians, (after - before) / h[:, None])
    return measurement._replace(A=A, h=model, h_jacobian=model.jacobian)


def searched(
    prior: Gaussian, measurement: Measurement, prediction: Prediction, *, since_before: bool
) -> tuple[float, float]:
    """Instant [s after the start of the epoch] and size [m/s] of a step of the clock drift.

    Those that explain all numbers best, all else at the prior mean; the start of the epoch unless
    another instant is clearly better.  since_before: it may have been in the epoch before.
    """
    cd, T = prediction.layout.cd.start, prediction.T
    d = np.arange(-REACH_MPS, REACH_MPS + 0.5 * STEP_MPS, STEP_MPS)
    tried = np.arange(1 - INSTANTS if since_before else 1, INSTANTS) * (T / INSTANTS)
    best, late_s, size = np.inf, 0.0, 0.0
    for late in (0.0, *tried):
        seen = stepped(measurement, prediction, late)
        y = np.repeat((seen.A @ prior.mean)[:, None, :], d.size, axis=1)
        y[..., 3] += d
        square = (seen.z[:, None, :] - seen.h(y)) ** 2 / np.diagonal(seen.R, 0, 1, 2)[:, None, :]
        badness = square.sum(axis=(0, 2)) + d**2 / prior.cov[cd, cd]
        if late:
            badness += CLEARLY
        k = int(np.argmin(badness))
        if badness[k] < best:
            best, late_s, size = float(badness[k]), float(late), float(d[k])
    return late_s, size


def freed_of_kink(
    measurement: Measurement, prediction: Prediction, fed: np.ndarray, stepped_s: float
) -> Measurement:
    """The measurement in an epoch at whose start the state (n,) was fed back.

    Until then the NCO was behind by the phases that were fed back and by their rates, these since
    ``stepped_s`` after the start of the epoch (negative; -inf: ever since), though the reference
    of what was integrated has been corrected all the way back.
    """
    layout, k = prediction.layout, radians_per_metre(measurement)
    phase = k * fed[layout.phase][measurement.channel]
    if not np.abs(phase).max() > KINK_RAD:
        return measurement
    columns = np.r_[layout.v, layout.cd]
    rate = k * (measurement.A[:, -1, columns] @ fed[columns])
    first, last, h = _halves(measurement, prediction)
    before, after = np.minimum(first, 0.0), np.minimum(last, 0.0)
    length = after - before
    t = before[..., None] + length[..., None] * _INSTANT
    turn = phase[:, None, None] + rate[:, None, None] * t
    share = length / h[:, None]
    mean = share * (turn @ _WEIGHT)
    still = np.maximum(stepped_s - t, 0.0) * rate[:, None, None]
    g = (1.0 - share + share * (np.exp(1j * (turn + still)) @ _WEIGHT)) * np.exp(-1j * mean)
    return _divided(measurement, g)


def radians_per_metre(measurement: Measurement) -> np.ndarray:
    """(nb,) 2 pi / wavelength of each channel: slope of Q over I where the error is zero."""
    z, J = measurement.h_jacobian(np.zeros(measurement.A.shape[:2]))
    return np.asarray(J[:, 1, 1] / z[:, 0])


def _times(z: np.ndarray, g: np.ndarray) -> np.ndarray:
    """z (..., 5) with its two prompts multiplied by g (..., 2), and S by the mean power."""
    prompts = (z[..., 0:4:2] + 1j * z[..., 1:4:2]) * g
    out = np.empty(prompts.shape[:-1] + (5,))
    out[..., 0:4:2], out[..., 1:4:2] = prompts.real, prompts.imag
    out[..., 4] = z[..., 4] * (g.real**2 + g.imag**2).mean(axis=-1)
    return out


def _halves(
    measurement: Measurement, prediction: Prediction
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start and end of the halves (nb, 2) after the start of the epoch, and their length (nb,)."""
    if measurement.span is None:
        raise ValueError("span: None, expected the times of the half bits")
    middle, h = measurement.span[:, 0] - (prediction.t_s - prediction.T), measurement.span[:, 1]
    first = np.column_stack([middle - h, middle])
    return first, first + h[:, None], h


def _divided(measurement: Measurement, g: np.ndarray) -> Measurement:
    """Prompts divided by g (nb, 2), variances by |g|^2."""
    power = np.maximum(g.real**2 + g.imag**2, SMALLEST)
    z, R = measurement.z.copy(), measurement.R.copy()
    freed = (z[:, 0:4:2] + 1j * z[:, 1:4:2]) * g.conj() / power
    z[:, 0:4:2], z[:, 1:4:2] = freed.real, freed.imag
    for q in range(4):
        R[:, q, q] /= power[:, q // 2]
    return measurement._replace(z=z, R=R)
