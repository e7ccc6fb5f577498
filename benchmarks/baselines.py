"""Plain code for the same work: what a first version would be, and what ratios are taken to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from scipy.fft import fft, ifft

from benchmarks.scene import N_CHANNEL, Scene
from signals.codes import GPS_L1CA
from signals.recording import Recording


@njit
def _plain_correlator(samples, code, rate, carrier, freq, chips, offsets, fs, out):
    for i in range(chips.shape[0]):
        for n in range(samples.shape[0]):
            t = n / fs
            phase = -2.0 * np.pi * (carrier[i] + freq[i] * t)
            z = complex(samples[n, 0], samples[n, 1]) * complex(np.cos(phase), np.sin(phase))
            for k in range(offsets.size):
                chip = int(np.floor(code[i] + rate[i] * t - offsets[k])) % chips.shape[1]
                out[i, k] += z * chips[i, chip]


def plain_correlator(scene: Scene, offsets: np.ndarray, n: int) -> np.ndarray:
    """The definition, sample by sample in float64, compiled."""
    nco, out = scene.nco, np.zeros((N_CHANNEL, offsets.size), np.complex128)
    _plain_correlator(
        scene.recording.samples(0, n), nco.code_phase_chips[0], nco.chip_rate_hz[0],
        nco.carrier_phase_cycles[0], nco.carrier_freq_hz[0], scene.chips, offsets, scene.fs, out,
    )  # fmt: skip
    return out


def numpy_correlator(scene: Scene, offsets: np.ndarray, n: int) -> np.ndarray:
    """The definition in numpy, channel by channel."""
    nco, t = scene.nco, np.arange(n) / scene.fs
    pairs = scene.recording.samples(0, n).astype(np.float64)
    z = pairs[:, 0] + 1j * pairs[:, 1]
    out = np.empty((N_CHANNEL, offsets.size), np.complex128)
    for i in range(N_CHANNEL):
        turns = nco.carrier_phase_cycles[0, i] + nco.carrier_freq_hz[0, i] * t
        wiped = z * np.exp(-2j * np.pi * turns)
        x = nco.code_phase_chips[0, i] + nco.chip_rate_hz[0, i] * t
        for k, offset in enumerate(offsets):
            index = np.floor(x - offset).astype(np.int64) % scene.chips.shape[1]
            out[i, k] = wiped @ scene.chips[i, index]
    return out


def plain_search(source: Recording, prns: Sequence[int], blocks: int) -> np.ndarray:
    """Highest energy over the median of each PRN: +-5 kHz in 500 Hz, sums of 1 ms, in numpy.

    One FFT of the wiped-off samples per Doppler, one inverse per PRN, all milliseconds at once.
    """
    fs = source.sample_rate_hz
    n = round(fs * 1e-3)
    z = source.samples(0, n * blocks).astype(np.float32).view(np.complex64)[:, 0]
    t, best = np.arange(n * blocks) / fs, np.zeros(len(prns))
    chip = np.floor(1.023e6 * t[:n]).astype(np.int64) % 1023
    codes = [np.conj(fft(GPS_L1CA.chips(prn)[chip].astype(np.complex64))) for prn in prns]
    for doppler in np.arange(-5000.0, 5001.0, 500.0):
        wiped = z * np.exp(-2j * np.pi * (source.if_hz + doppler) * t).astype(np.complex64)
        spectra = fft(wiped.reshape(blocks, n))
        for i, code in enumerate(codes):
            energy = (np.abs(ifft(spectra * code)) ** 2).sum(axis=0)
            best[i] = max(best[i], energy.max() / np.median(energy))
    return best


@njit
def _plain_generator(code, rate, carrier, freq, amplitude, chips, fs, out):
    for n in range(out.shape[0]):
        t = n / fs
        i_sum, q_sum = 0.0, 0.0
        for i in range(chips.shape[0]):
            phase = 2.0 * np.pi * (carrier[i] + freq[i] * t)
            chip = amplitude * chips[i, int(code[i] + rate[i] * t) % chips.shape[1]]
            i_sum += chip * np.cos(phase)
            q_sum += chip * np.sin(phase)
        out[n, 0] = np.int8(np.rint(i_sum))
        out[n, 1] = np.int8(np.rint(q_sum))


def plain_generator(scene: Scene, n: int) -> np.ndarray:
    """Sum of the satellites without noise, sample by sample in float64, compiled."""
    nco, out = scene.nco, np.empty((n, 2), np.int8)
    _plain_generator(
        nco.code_phase_chips[0], nco.chip_rate_hz[0], nco.carrier_phase_cycles[0],
        nco.carrier_freq_hz[0], 3.0, scene.chips, scene.fs, out,
    )  # fmt: skip
    return out


def joseph(
    mean: np.ndarray, cov: np.ndarray, phi: np.ndarray, q: np.ndarray, z: np.ndarray,
    H: np.ndarray, R: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Predict and update in numpy, Joseph's form."""
    mean, cov = phi @ mean, phi @ cov @ phi.T + q
    S = H @ cov @ H.T + R
    K = np.linalg.solve(S, H @ cov).T
    left = np.eye(mean.size) - K @ H
    return mean + K @ (z - H @ mean), left @ cov @ left.T + K @ R @ K.T
