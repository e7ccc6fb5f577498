"""What the taps of a data bit say about range, rate and phase: models D and C.

Both work on the two half-bit dumps (10 ms each for GPS L1 C/A) of one data bit, at the receiver
time t_mid in its middle, and on errors (true - estimate) in metres and m/s along the line of
sight.  Writing P, E, L for prompt, early, late, A^2 for the squared amplitude of one half-bit
prompt in units of the noise variance, R for the correlation function of the code, T_h for the
half bit, f = dv / wavelength and d = (dr + known code offset) / chip (each channel's own):

* model D (differential, no data bits needed), y = (dr, dv), z = (Re D, Im D, S),
  D = P1 conj(P2) / A^2, S = mean_h Re((L_h - E_h) conj P_h) / A^2:

      h_I + j h_Q = R(d)^2 sinc^2(f T_h) exp(j 2 pi f T_h)
      h_S = sinc^2(f T_h) R(d) (R(d - spacing) - R(d + spacing))

* model C (coherent, data bits known), y = (dr, p, dv), z = (Re P, -Im P, S) with
  P = bit (P1 + P2) / (2 A), p the carrier-phase error in metres at t_mid; the bit of a pilot is 1:

      h_I + j h_Q = R(d) sinc(2 f T_h) exp(j 2 pi p / wavelength),   h_S as in D.

Receding faster than predicted (dv > 0) turns P2 clockwise against P1, hence Im D > 0.
A known rotation between NCO and reference (`steering`) is taken out of the taps before.

The oscillator's noise is common to all channels, and each channel sees it between its own bit
edges: its share of the noise of an epoch is no noise of its own.  In model C the state holds what
the clock did in this epoch (`ins.error_state.clock_step_into`), and a bit whose middle lies lag
before t has not met the share a = (lag - h) / T of it, h the shortest half bit, T the epoch:

    phase at t_mid = p + (t_mid - t) rate - a step.

The last h of the white frequency noise is left to the next epoch for all channels alike.  A
straight path stands for the mean over a bit: with epochs as long as bits the rest is at most
S_f T / 12 per channel, and the S_f h / 3 that the mean over a bit takes off a variance, a straight
path takes off too.  Measured in uniform motion with a TCXO (8 seeds), NIS of the Q rows in their
common mode and in the others: 0.99, 1.00 at 35 dB-Hz and 0.99, 0.96 at 45 dB-Hz.  With the noise
after t_mid taken off the diagonal of R instead these were 0.84, 1.13 and 0.71, 2.11.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.compiled import borrowing
from ultratight.filters.gaussian import Measurement
from ultratight.tracking.code_model import HALF as HALF_S
from ultratight.tracking.code_model import OFFSET, SPACING, WAVELENGTH, correlation
from ultratight.tracking.half_bits import EARLY, HALF, LATE, PROMPT, RANGE, T_MID, Bits
from ultratight.tracking.steering import Steering, lever, views
from ultratight.tracking.tap_model import TapModel

AMPLITUDE_GAIN = 0.02
"""Share of each bit in the running A^2: a time constant of 1 s"""
AMPLITUDE2_FLOOR = 0.5
BACK_SIGMAS, BACK_MORE = 6.0, 12.0
"""Noise, whose power has a longer tail than a Gaussian's, exceeds both with 2e-8 at most"""
NO_BITS = np.zeros((0, 0), dtype=np.int8)


class Amplitudes(NamedTuple):
    """What is believed of each channel's prompt; follows the bits that `measure` is given."""

    amplitude2: np.ndarray  # (n_channel,) A^2
    prompt: np.ndarray  # (n_channel,) complex: the last bit's, data wiped off where they are known


def measure(
    bits: Bits,
    steering: Steering,
    t_s: float,
    n_state: int,
    phase_start: int,
    codes: np.ndarray,
    pilot: np.ndarray,
    spacing_chips: float,
    clock_sf: float,
    amplitudes: Amplitudes,
    data_bits: np.ndarray | None = None,
    first_bit: int = 0,
    clock_lag_s: float = 0.0,
    epoch_s: float = 0.02,
) -> Measurement:
    """Measurement of the error state at receiver time t_s, and amplitudes that have followed.

    Parameters
    ----------
    n_state, phase_start : number of states and first row of the channel phases; without phases
        (phase_start = n_state) it is model D, else model C.
    codes : `code_rows` of the channels.
    pilot : (n_channel,) bool: no data, all bits 1.
    clock_sf : density S_f of the clock's white frequency noise [m2/s]; model D.
    data_bits : (n_channel, n_bit) int8 of +-1 from bit ``first_bit`` on; model C needs them.
    clock_lag_s, epoch_s : h and T of the clock's step, the state after the phases; model C.

    Raises
    ------
    ValueError : model C without the data bit of a channel.
    """
    nb, d = bits.channel.size, 2 if phase_start == n_state else 3
    z, A, R = np.empty((nb, 3)), np.empty((nb, d, n_state)), np.empty((nb, 3, 3))
    params = np.empty((nb, codes.shape[1]))
    missing = measure_into(
        bits.channel, bits.number, bits.span, bits.iq, steering.buffer, t_s, phase_start, codes,
        pilot, spacing_chips, clock_sf, amplitudes.amplitude2, amplitudes.prompt,
        NO_BITS if data_bits is None else data_bits, first_bit, clock_lag_s, epoch_s, params, z, A,
        R,
    )  # fmt: skip
    if missing >= 0:
        raise bit_missing(bits.number[missing], bits.channel[missing])
    model = TapModel(params)
    return Measurement(z, A, R, model, model.jacobian, bits.channel, bits.span)


def bit_missing(number: int, channel: int) -> ValueError:
    """Says which data bit the coherent model misses."""
    return ValueError(
        f"receiver.knows.data_bits: none for bit {number} of channel {channel}: the coherent model "
        "needs them"
    )


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def measure_into(
    channel: np.ndarray,
    number: np.ndarray,
    span: np.ndarray,
    iq: np.ndarray,
    buffer: np.ndarray,
    t_s: float,
    phase_start: int,
    codes: np.ndarray,
    pilot: np.ndarray,
    spacing: float,
    clock_sf: float,
    amplitude2: np.ndarray,
    prompt: np.ndarray,
    data_bits: np.ndarray,
    first_bit: int,
    clock_lag_s: float,
    epoch_s: float,
    params: np.ndarray,
    z: np.ndarray,
    A: np.ndarray,
    R: np.ndarray,
) -> int:
    """Fill params, z, A and R; returns the row whose data bit is missing, -1 for none."""
    s = views(buffer, amplitude2.size)
    R[:] = 0.0
    for b in range(channel.size):
        i = channel[b]
        power = _power(iq[b])
        if is_back(power, amplitude2[i]):
            amplitude2[i] = power
        for k in range(params.shape[1]):
            params[b, k] = codes[i, k]
        params[b, OFFSET] = span[b, RANGE]
        params[b, HALF_S] = span[b, HALF]
        params[b, SPACING] = spacing
        radians_per_m = 2.0 * math.pi / params[b, WAVELENGTH]
        dt = span[b, T_MID] - t_s
        range_rows(s, i, dt, phase_start - 17, A[b])
        data, column = 0.0, number[b] - first_bit
        if pilot[i]:
            data = 1.0
        elif 0 <= column < data_bits.shape[1]:
            data = float(data_bits[i, column])
        if A.shape[1] == 2:
            turned = radians_per_m**2 * clock_sf * (2.0 / 3.0) * span[b, HALF]
            _differential(iq[b], amplitude2[i], turned, z[b], R[b])
        else:
            if data == 0.0:
                return b
            _phase_row(s, i, dt, phase_start, A[b])
            if A.shape[2] > phase_start + amplitude2.size:
                share = min(max((-dt - clock_lag_s) / epoch_s, 0.0), 1.0)
                A[b, 0, -1], A[b, 1, -1] = -share, -share
            _coherent(iq[b], data, amplitude2[i], z[b], R[b])
        half = 1.0 - correlation(2.0 * spacing, params[b])
        z[b, 2], R[b, 2, 2] = _split(iq[b], half, amplitude2[i])
        if data != 0.0:
            prompt[i] = data * (iq[b, 0, PROMPT] + iq[b, 1, PROMPT])
    for b in range(channel.size):
        i = channel[b]
        follow = amplitude2[i] + AMPLITUDE_GAIN * (_power(iq[b]) - amplitude2[i])
        amplitude2[i] = max(follow, AMPLITUDE2_FLOOR)
    return -1


@borrowing
def _power(iq: np.ndarray) -> float:
    """A^2 by the two prompts of a symbol; its variance is 2 A^2 + 2."""
    return 0.5 * (_norm2(iq[0, PROMPT]) + _norm2(iq[1, PROMPT])) - 2.0


@borrowing
def is_back(power: float, amplitude2: float) -> bool:
    """Whether a symbol has so much more power than A^2 that a signal has come back.

    In the scale of an amplitude that has sunk while it was away its first symbols would look like
    errors of many radians.
    """
    return power > amplitude2 + BACK_SIGMAS * math.sqrt(2.0 * amplitude2 + 2.0) + BACK_MORE


@borrowing
def _norm2(x: complex) -> float:
    return x.real * x.real + x.imag * x.imag


@borrowing
def range_rows(s: Steering, i: int, dt: float, n_scale: int, A: np.ndarray) -> None:
    """Rows of range (first) and range rate (last) of channel i at t + dt, from the state at t.

    y = A Phi(dt) x, gravity gradient left out.
    """
    rate = A.shape[0] - 1
    C, f = s.C_b_e, s.mean_force
    ux, uy, uz = s.u[i, 0], s.u[i, 1], s.u[i, 2]
    x, y, w, vx, vy, vz = lever(s)
    fx = C[0, 0] * f[0, 0] + C[0, 1] * f[0, 1] + C[0, 2] * f[0, 2]
    fy = C[1, 0] * f[0, 0] + C[1, 1] * f[0, 1] + C[1, 2] * f[0, 2]
    fz = C[2, 0] * f[0, 0] + C[2, 1] * f[0, 1] + C[2, 2] * f[0, 2]
    # d/d psi of -u.(psi x f) is -(f x u), and so for the lever arm and its velocity
    turn = (vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux)
    arm = (y * uz - w * uy, w * ux - x * uz, x * uy - y * ux)
    tilt = (fy * uz - fz * uy, fz * ux - fx * uz, fx * uy - fy * ux)
    A[:] = 0.0
    for k in range(3):
        A[0, k] = -s.u[i, k]
        A[0, 3 + k] = -s.u[i, k] * dt
        A[0, 6 + k] = -arm[k] - dt * turn[k] - 0.5 * dt * dt * tilt[k]
        A[rate, 3 + k] = -s.u[i, k]
        A[rate, 6 + k] = -turn[k] - dt * tilt[k]
        axis = C[0, k] * ux + C[1, k] * uy + C[2, k] * uz
        A[0, 9 + k] = 0.5 * dt * dt * axis
        A[rate, 9 + k] = dt * axis
    A[0, 15] = 1.0
    A[0, 16] = dt
    A[rate, 16] = 1.0
    for k in range(n_scale):  # a scale factor acts as a bias of f_k
        A[0, 17 + k] = f[0, k] * A[0, 9 + k]
        A[rate, 17 + k] = f[0, k] * A[rate, 9 + k]


@borrowing
def _phase_row(s: Steering, i: int, dt: float, phase_start: int, A: np.ndarray) -> None:
    """Row 1: the carrier-phase error at t + dt; it moves like the range, without its level."""
    x, y, w, _, _, _ = lever(s)
    ux, uy, uz = s.u[i, 0], s.u[i, 1], s.u[i, 2]
    arm = (y * uz - w * uy, w * ux - x * uz, x * uy - y * ux)
    for k in range(3, 12):
        A[1, k] = A[0, k]
    for k in range(3):
        A[1, 6 + k] += arm[k]
    A[1, 16] = dt
    for k in range(17, phase_start):
        A[1, k] = A[0, k]
    A[1, phase_start + i] = 1.0


@borrowing
def _split(iq: np.ndarray, half: float, a2: float) -> tuple[float, float]:
    """S of two halves and its variance; L - E has 2 (1 - R(2 spacing)) per component and half."""
    s1 = ((iq[0, LATE] - iq[0, EARLY]) * iq[0, PROMPT].conjugate()).real
    s2 = ((iq[1, LATE] - iq[1, EARLY]) * iq[1, PROMPT].conjugate()).real
    return 0.5 * (s1 + s2) / a2, half * (1.0 / a2 + 2.0 / a2**2)


@borrowing
def _differential(iq: np.ndarray, a2: float, turned: float, z: np.ndarray, R: np.ndarray) -> None:
    """``turned``: white frequency noise of the oscillator turns one half against the other."""
    turn = iq[0, PROMPT] * iq[1, PROMPT].conjugate() / a2
    z[0], z[1] = turn.real, turn.imag
    r = 2.0 / a2 + 2.0 / a2**2
    R[0, 0] = r
    R[1, 1] = r + turned


@borrowing
def _coherent(iq: np.ndarray, data: float, a2: float, z: np.ndarray, R: np.ndarray) -> None:
    p = data * (iq[0, PROMPT] + iq[1, PROMPT]) / (2.0 * math.sqrt(a2))
    z[0], z[1] = p.real, -p.imag
    R[0, 0] = 0.5 / a2
    R[1, 1] = R[0, 0]
