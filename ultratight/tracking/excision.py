"""Narrow-band interference taken out of samples by blanking its bins.

Short overlapping spectra under a Hann window, whose side lobes fall fast, so that a strong line
does not spread; bins far above the median, and their neighbours inside the main lobe, are blanked
(frequency-domain excision: Kaplan & Hegarty, 3rd ed., 9.2.5; Capozza et al., ION GNSS 1999).  At
half overlap the windows add up to one: what holds no line is given back as it was.
"""

from __future__ import annotations

import numpy as np

HALF = 512
"""Half the samples of a spectrum"""
_ABOVE_MEDIAN = 30.0
"""Of the power: 13 dB above the mean of the noise, which a bin exceeds once in 10^9; a satellite of
60 dB-Hz adds as much as the noise"""
_MAIN_LOBE = 2
"""Bins on each side of a line"""


def excised(z: np.ndarray) -> np.ndarray:
    """Samples (n,) complex64 without lines; ``z`` itself where it has none.

    If there are any the first and the last half spectrum's samples fade out: a line that ends
    abruptly spreads over all bins.
    """
    from scipy.fft import fft, ifft

    n_frame = -(-len(z) // HALF) + 1
    padded = np.zeros((n_frame + 1) * HALF, np.complex64)
    padded[HALF : HALF + len(z)] = z
    window = (0.5 - 0.5 * np.cos(np.pi * np.arange(2 * HALF) / HALF)).astype(np.float32)
    frames = np.lib.stride_tricks.sliding_window_view(padded, 2 * HALF)[::HALF] * window
    spectra = fft(frames, axis=1, workers=1)
    power = spectra.real**2 + spectra.imag**2
    lines = power > _ABOVE_MEDIAN * np.median(power)
    if not lines.any():
        return z
    near = lines.copy()
    for k in range(1, _MAIN_LOBE + 1):
        near |= np.roll(lines, k, axis=1) | np.roll(lines, -k, axis=1)
    spectra[near] = 0.0
    spectra[0] = 0.0
    spectra[(np.arange(n_frame) + 1) * HALF > len(z)] = 0.0
    halves = ifft(spectra, axis=1, workers=1).reshape(n_frame, 2, HALF)
    out = np.zeros((n_frame + 1, HALF), np.complex64)
    out[:-1] += halves[:, 0]
    out[1:] += halves[:, 1]
    return out.reshape(-1)[HALF : HALF + len(z)]
