"""Energy over code delay and Doppler of many codes at once: parallel code phase search by FFT.

The block of samples x_n that begins at t_b, K code periods T long, is correlated with the code of
Fourier coefficients c_m (line m at m / T) at delay tau and carrier f as

    z_b(tau, f) = sum_m X_b(f + m / T) conj(c_m) exp(j 2 pi m (tau - s_b) / T)                (1)
    s_b         = t_b + (t_b + K T / 2) f_D / f_carrier    modulo T                          (2)
    S(tau, f)   = sum_b |z_b(tau, f)|^2                                                       (3)

with X_b the block's spectrum (van Nee & Coenen, Electron. Lett. 27(2), 1991; Borre et al., A
Software-Defined GPS and Galileo Receiver, 2007, 6.4; Kaplan & Hegarty, 3rd ed., 8.5.2).  (2) refers
all delays to the first sample: the code runs with the Doppler f_D, and blocks begin at whole
samples.  Only the lines of a code matter, hence one FFT of the block, filled up with zeros to P
times its length, holds every Doppler at steps of 1 / (P K T), the intermediate frequency included,
as every (P K)-th of its bins, and no carrier is ever wiped off.  The inverse FFT takes no more
lines than are wanted: delays come in steps of T / M for M lines.  The coefficients are those of
the waveform in continuous time, so that sampling rate and code need have nothing to do with each
other; a K T that is no whole number of samples is taken as the nearest one, which leaves a drift
of at most half a sample over the block (0.5 dB with 2 samples per chip, 0.1 dB with 10).

Losses, GPS C/A: two delays per chip (M = 2048) leave 90.3 % of the power, 0.44 dB, as an ideal
filter of 2.046 MHz does, and at most 1.2 dB between two of them (0.4 dB on average); half a
Doppler step of 1 / (2 K T) costs 0.9 dB (0.3 dB on average).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from signals.compiled import FAST_SUM, borrowing
from signals.recording import IfSource
from signals.signal_row import Signal
from ultratight.tracking.excision import HALF, excised

_ROOM = 1 << 24
"""Cells of the energies held at a time"""
_LEAST_POWER = 0.5
"""Of the code's, inside the band of the samples"""


class Grid(NamedTuple):
    """Where the energies of (3) are taken."""

    signal: Signal
    sample_rate_hz: float
    if_hz: float
    first_sample: int
    n_block: int
    n_sample: int
    """Of a block"""
    n_fft: int
    stride: int
    """Bins between two lines of the code"""
    n_delay: int
    bins: np.ndarray
    """(n_doppler,) int64: bin of the carrier"""

    @property
    def doppler_hz(self) -> np.ndarray:
        """(n_doppler,) Doppler of each row; its steps need not hold 0."""
        return self.bins * (self.sample_rate_hz / self.n_fft) - self.if_hz

    @property
    def period_s(self) -> float:
        """Of the primary code."""
        return self.signal.length_chips / self.signal.chip_rate_hz

    @property
    def code_phase_chips(self) -> np.ndarray:
        """(n_delay,) code phase at the first sample of each column, modulo the period."""
        length = self.signal.length_chips
        return -np.arange(self.n_delay) * (length / self.n_delay) % length

    @property
    def block_s(self) -> float:
        """Length of a block: what is summed coherently."""
        return self.stride * self.period_s * self.n_sample / self.n_fft

    def block_at(self, b: int) -> int:
        """Number of the first sample of a block."""
        return self.first_sample + round(b * self.block_s * self.sample_rate_hz)

    @property
    def end_sample(self) -> int:
        """One past the last sample that is used."""
        return self.block_at(self.n_block - 1) + self.n_sample


def grid(
    source: IfSource,
    signal: Signal,
    *,
    first_sample: int,
    periods: int,
    blocks: int,
    doppler_hz: float,
    steps: int = 2,
    delays_per_chip: float | None = None,
) -> Grid:
    """The grid of ``blocks`` of ``periods`` code periods from ``first_sample`` on.

    Doppler up to +-``doppler_hz`` at least, ``steps`` rows per 1 / (K T); ``delays_per_chip`` at
    least, None: 2 of a BPSK, 4 of a BOC signal, whose main lobes are as wide.

    Raises
    ------
    ValueError
        A sampling rate below the chip rate.
    """
    fs = source.sample_rate_hz
    if fs < 1.00001 * signal.chip_rate_hz:  # by more than any Doppler
        raise ValueError(
            f"sample_rate_hz is {fs:g}: expected more than the chip rate of {signal.name}, "
            f"{signal.chip_rate_hz:g} Hz"
        )
    block_s = periods * signal.length_chips / signal.chip_rate_hz
    n_sample = round(block_s * fs)
    n_fft = steps * n_sample
    centre = round(source.if_hz * n_fft / fs)
    side = math.ceil(doppler_hz * n_fft / fs - 1e-9)
    per_chip = (
        (2.0 if signal.per_chip == 1 else 4.0) if delays_per_chip is None else delays_per_chip
    )
    return Grid(
        signal, fs, source.if_hz, first_sample, blocks, n_sample, n_fft, steps * periods,
        _fast_length(math.ceil(per_chip * signal.length_chips)),
        np.arange(centre - side, centre + side + 1),
    )  # fmt: skip


def _fast_length(n: int) -> int:
    """The least length from ``n`` on that an FFT takes fast, even."""
    from scipy.fft import next_fast_len  # slow to import

    return 2 * int(next_fast_len(-(-n // 2)))


def lines(signal: Signal, prn: int, n: int) -> np.ndarray:
    """Fourier coefficients (n,) complex128 of the primary code in continuous time, in FFT order.

    Sum of |c_m|^2 over all m is 1 (the mean power of the modulated chips); c_m is the coefficient
    of exp(j 2 pi m t / T) of the code that begins at t = 0.
    """
    values = signal.modulation.modulate(signal.chips(prn)).astype(np.float64)
    m = np.fft.fftfreq(n, 1.0 / n).astype(np.int64)
    held = np.sinc(m / values.size) * np.exp(-1j * np.pi * m / values.size)
    return np.fft.fft(values)[m % values.size] / values.size * held


def replicas(grid_: Grid, prns: Sequence[int], real: bool) -> np.ndarray:
    """conj(c_m) (n_prn, n_delay) complex64 of unit energy, without lines outside the samples' band.

    Raises
    ------
    ValueError
        Less than half of the code's power is in the band.
    """
    g = grid_
    m = np.fft.fftfreq(g.n_delay, 1.0 / g.n_delay)
    f = g.if_hz + m / g.period_s
    inside = (f > 0.0) & (f < g.sample_rate_hz / 2.0) if real else abs(f) < g.sample_rate_hz / 2.0
    out = np.empty((len(prns), g.n_delay), np.complex64)
    for row, prn in zip(out, prns, strict=True):
        c = np.where(inside, lines(g.signal, prn, g.n_delay), 0.0)
        power = float(np.vdot(c, c).real)
        if power < _LEAST_POWER * (1.0 - g.signal.modulation.left_out):
            raise ValueError(
                f"sample_rate_hz is {g.sample_rate_hz:g} at if_hz {g.if_hz:g}: expected a band "
                f"that holds half of the power of {g.signal.name}; it holds {power:.0%}"
            )
        row[:] = c.conj() / math.sqrt(power)
    return out


def energies(
    source: IfSource, grid_: Grid, prns: Sequence[int]
) -> Iterator[tuple[Sequence[int], np.ndarray]]:
    """Some PRNs at a time and their S of (3), (n_prn, n_doppler, n_delay) float32.

    The scale is arbitrary, the same for all.  Samples are taken about their mean, and without lines
    (`excision`).  The array is used again for the next PRNs.

    Raises
    ------
    ValueError
        Samples that are not finite, or as `replicas` does.
    """
    g = grid_
    cells = len(g.bins) * g.n_delay
    at_once = max(1, min(len(prns), _ROOM // cells))
    total = np.empty((at_once, len(g.bins), g.n_delay), np.float32)
    product = np.empty((at_once, g.n_delay), np.complex64)
    for k in range(0, len(prns), at_once):
        some = prns[k : k + at_once]
        part = total[: len(some)]
        part[:] = 0.0
        codes: np.ndarray | None = None
        for b in range(g.n_block):
            spectrum, real = _spectrum(source, g, b)
            if codes is None:
                codes = replicas(g, some, real)
            _add_block(spectrum, g, b, codes, product[: len(some)], part)
        yield some, part


def _spectrum(source: IfSource, g: Grid, b: int) -> tuple[np.ndarray, bool]:
    """X_b (n_fft,) complex64, and whether the samples are real."""
    from scipy.fft import fft

    n = g.block_at(b)
    # beyond the block too, where there is more: there the excision fades out
    first = max(n - HALF, int(getattr(source, "first_sample", n)))
    end = min(n + g.n_sample + HALF, int(getattr(source, "end_sample", n + g.n_sample)))
    pairs = source.samples(first, end).astype(np.float32)
    mean = pairs.mean(axis=0)
    if not np.isfinite(mean).all():
        bad = int(np.argmin(np.isfinite(pairs).all(axis=1)))
        name = getattr(source, "name", "the source")
        raise ValueError(f"{name}: sample {first + bad} is {pairs[bad]}, expected finite values")
    real = not pairs[:, 1].any()
    z = excised((pairs - mean).view(np.complex64)[:, 0])[n - first :][: g.n_sample]
    # a spectrum of real samples costs half
    return fft(z.real if real else z, g.n_fft, workers=1).astype(np.complex64, copy=False), real


def _add_block(
    spectrum: np.ndarray, g: Grid, b: int, codes: np.ndarray, product: np.ndarray, total: np.ndarray
) -> None:
    from scipy.fft import ifft

    t = (g.block_at(b) - g.first_sample) / g.sample_rate_hz
    shift = t + (t + 0.5 * g.block_s) * g.doppler_hz / g.signal.carrier_hz
    turns = shift / g.period_s % 1.0
    line = np.empty(g.n_delay, np.complex64)
    for d, (k, turn) in enumerate(zip(g.bins.tolist(), turns.tolist(), strict=True)):
        _take_lines(spectrum, k, g.stride, turn, line)
        _multiply(line, codes, product)
        # the scale of the inverse does not matter
        z = ifft(product, axis=1, norm="forward", overwrite_x=True, workers=1)
        _accumulate(z, d, total)


# ---- kernels ---------------------------------------------------------------------------------


@borrowing(fastmath=FAST_SUM)
def _take_lines(spectrum: Any, carrier: int, stride: int, turn: float, out: Any) -> None:
    """Lines of the spectrum about ``carrier``, in FFT order, delayed by ``turn`` periods."""
    n = out.size
    step = complex(math.cos(2.0 * math.pi * turn), -math.sin(2.0 * math.pi * turn))
    for half in range(2):
        first = -(n // 2) * half
        back = -2.0 * math.pi * turn * first
        phase = complex(math.cos(back), math.sin(back))
        k = (carrier + stride * first) % spectrum.size
        for m in range(first, first + n // 2):
            out[m + half * n] = spectrum[k] * np.complex64(phase)
            phase *= step
            k += stride
            if k >= spectrum.size:
                k -= spectrum.size


@borrowing(fastmath=FAST_SUM)
def _multiply(line: Any, codes: Any, out: Any) -> None:
    """out[i] = line x codes[i]."""
    for i in range(codes.shape[0]):
        for m in range(line.size):
            out[i, m] = line[m] * codes[i, m]


@borrowing(fastmath=FAST_SUM)
def _accumulate(z: Any, d: int, total: Any) -> None:
    """total[i, d] += |z[i]|^2."""
    for i in range(z.shape[0]):
        for k in range(z.shape[1]):
            v = z[i, k]
            total[i, d, k] += v.real * v.real + v.imag * v.imag
