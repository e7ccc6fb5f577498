"""Samples without the satellites that are known to be in them.

Codes are not orthogonal: a strong satellite correlates with every other code.  It is taken away
period by period: what its replica and two neighbours of it, early and late, explain of the samples
in the sense of least squares is subtracted, whatever the phase, the data bit and the amplitude
were.  The neighbours follow the rounding of a front-end filter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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
    for i in np.argsort(-at.cn0_dbhz).tolist():
        code_phase, doppler = float(at.code_phase_chips[i]), float(at.doppler_hz[i])
        fitted = _fitted(z, source, n0, signal, prns[i], code_phase, doppler)
        z -= 2.0 * fitted.real if real else fitted
    out = np.stack([z.real, z.imag], axis=1).astype(np.float32)
    return Recording(
        out[:, 0].copy() if real else out,
        source.sample_rate_hz, source.if_hz, source.sigma, first_sample=n0,
    )  # fmt: skip


def _fitted(
    z: np.ndarray, source: IfSource, n0: int, signal: Signal, prn: int, chips: float, doppler: float
) -> np.ndarray:
    """What a satellite explains of z (n,), complex; half of it where z is real."""
    n = np.arange(len(z))
    t = n / source.sample_rate_hz
    code = chips + signal.chip_rate_hz * (1.0 + doppler / signal.carrier_hz) * t
    turns = doppler * t + np.mod(source.if_hz / source.sample_rate_hz * (n0 + n), 1.0)
    carrier = np.exp(2j * np.pi * turns)
    values = signal.modulation.modulate(signal.chips(prn))
    late = np.array(_DELAYS_CHIPS)[:, None]
    index = np.floor((code - late) * signal.per_chip).astype(np.int64) % values.size
    taps = values.astype(np.float64)[index]
    wiped, fitted = z * carrier.conj(), np.empty_like(z)
    edges = np.flatnonzero(np.diff(np.floor(code / signal.length_chips))) + 1
    for a, b in zip([0, *edges], [*edges, len(z)], strict=True):
        rows, y = taps[:, a:b], wiped[a:b]
        # of few samples the replicas may not be independent: the least amplitudes of all that fit
        amplitudes = np.linalg.pinv(rows @ rows.T, rcond=1e-9) @ (
            rows @ y.real + 1j * (rows @ y.imag)
        )
        fitted[a:b] = amplitudes.real @ rows + 1j * (amplitudes.imag @ rows)
    return fitted * carrier
