"""Samples without the satellites that are known to be in them.

Codes are not orthogonal: a strong satellite correlates with every other code.  It is taken away
period by period: what its replica and two neighbours of it, early and late, explain of the samples
in the sense of least squares is subtracted, whatever the phase, the data bit and the amplitude
were.  The neighbours follow the rounding of a front-end filter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from signals.compiled import kernel
from signals.recording import IfSource, Recording
from signals.signal_row import Signal
from ultratight.tracking.fine_acquisition import Fine

_DELAYS_CHIPS = (-0.8, -0.4, 0.0, 0.4, 0.8)


def without(
    source: IfSource, signal: Signal, prns: Sequence[int], at: Fine, n0: int, n1: int
) -> Recording:
    """Samples n0 <= n < n1 without satellites that are ``at`` n0, the strongest taken first."""
    pairs = source.samples(n0, n1).astype(np.float64)
    z, real = pairs[:, 0] + 1j * pairs[:, 1], not pairs[:, 1].any()
    fs = source.sample_rate_hz
    if_turns = source.if_hz / fs
    for i in np.argsort(-at.cn0_dbhz).tolist():
        doppler = float(at.doppler_hz[i])
        rate_hz = signal.chip_rate_hz * (1.0 + doppler / signal.carrier_hz)
        values = signal.modulation.modulate(signal.chips(prns[i])).astype(np.float64)
        code = float(at.code_phase_chips[i]) * signal.per_chip
        step = rate_hz / fs * signal.per_chip
        delays = np.array(_DELAYS_CHIPS) * signal.per_chip
        _remove(z, code, step, if_turns * n0 % 1.0, if_turns + doppler / fs, values, delays, real)
    out = np.stack([z.real, z.imag], axis=1).astype(np.float32)
    return Recording(
        out[:, 0].copy() if real else out, fs, source.if_hz, source.sigma, first_sample=n0
    )


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def _remove(
    z: Any,
    code: float,
    step: float,
    turns: float,
    turn: float,
    values: Any,
    delays: Any,
    real: bool,
) -> None:
    """Subtract from z (n,) what the replicas explain, period by period.

    ``code`` and its ``step`` per sample in values of the period, ``turns`` and ``turn`` in cycles.
    """
    n, length, m = z.size, values.size, delays.size
    rows = np.empty((m, int(length / step) + 2))
    carrier = np.empty(rows.shape[1], np.complex128)
    rotation = complex(math.cos(2.0 * math.pi * turn), math.sin(2.0 * math.pi * turn))
    normal, right = np.empty((m, m)), np.empty(m, np.complex128)
    a = 0
    while a < n:
        period = math.floor((code + a * step) / length)
        b = min(max(math.ceil(((period + 1) * length - code) / step), a + 1), n)
        angle = 2.0 * math.pi * ((turns + turn * a) % 1.0)
        phase = complex(math.cos(angle), math.sin(angle))
        normal[:], right[:] = 0.0, 0.0
        for k in range(b - a):
            carrier[k] = phase
            phase *= rotation
            x = code + (a + k) * step
            wiped = z[a + k] * carrier[k].conjugate()
            for i in range(m):
                rows[i, k] = values[math.floor(x - delays[i]) % length]
                right[i] += rows[i, k] * wiped
                for j in range(i + 1):
                    normal[i, j] += rows[i, k] * rows[j, k]
        _solve(normal, right)
        for k in range(b - a):
            fitted = complex(0.0, 0.0)
            for i in range(m):
                fitted += right[i] * rows[i, k]
            fitted *= carrier[k]
            # of real samples a replica explains half, its conjugate the other
            z[a + k] -= 2.0 * fitted.real if real else fitted
        a = b


@kernel
def _solve(normal: Any, right: Any) -> None:
    """right = normal^-1 right by Cholesky, from the lower half; small where it is singular."""
    m = right.size
    trace = 0.0
    for i in range(m):
        trace += normal[i, i]
    for i in range(m):
        normal[i, i] += 1e-9 * trace
        for j in range(i + 1):
            for k in range(j):
                normal[i, j] -= normal[i, k] * normal[j, k]
            if j < i:
                normal[i, j] /= normal[j, j]
        normal[i, i] = math.sqrt(normal[i, i])
        for k in range(i):
            right[i] -= normal[i, k] * right[k]
        right[i] /= normal[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            right[i] -= normal[k, i] * right[k]
        right[i] /= normal[i, i]
